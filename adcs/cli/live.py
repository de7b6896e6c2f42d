"""``adcs live``: attitude of an inertial unit while its readings arrive."""

from __future__ import annotations

import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from adcs.cli.imu import MAGNETS
from arrays.io.errors import LARGEST
from magloc.cli.framework import ABOVE_ZERO, QuietOptions, note, print_json, refuse_outside
from magloc.cli.live import PageOptions, open_page_of
from magloc.cli.options import STREAM


def live(
    *,
    source: Annotated[str, Parameter(name="--from", allow_leading_hyphen=True)] = STREAM,
    config: Path | None = None,
    method: Literal["auto", "plain", "reject", "subtract"] = "auto",
    lag_s: float = 0.0,
    replay_speed: float = 1.0,
    page: PageOptions = PageOptions(),  # noqa: B008 - frozen
    common: QuietOptions = QuietOptions(),  # noqa: B008 - frozen; the framework reads it
) -> None:
    """Estimate the attitude of an inertial unit while readings arrive.

    Every row gives one JSON line at once, with the columns of adcs imu and its flags. Rows are CSV, after a header with
    the columns of a log of adcs imu, or JSON objects with these names. Lines that are no rows, and rows that come late,
    twice or with a time that jumps, are counted and named on stderr. After ten rows of a clock that was set back, the
    filter starts anew. The unit should rest during the first second.

    Parameters
    ----------
    source : str
        Source of the rows: - for standard input, tcp://HOST:PORT to connect to, udp://HOST:PORT to listen at,
        serial:DEVICE@BAUD (extra serial), or replay:FILE for a log in its own time.
    config : Path, optional
        TOML file whose table log states other names of columns, units and mountings.
    method : str
        Treatment of a field that contradicts the filter, as of adcs imu.
    lag_s : float
        Lag of the magnetometer behind the gyro [s], at most 0.04; adcs.AttitudeConfig.from_log measures it.
    replay_speed : float
        Speed of a replay, relative to the recording.
    page : PageOptions
        Page that shows attitude, σ and disturbance.
    common : QuietOptions
        Common options.
    """
    from adcs.complementary.inertial_magnetic import LONGEST_LAG_S
    from adcs.io.imu_streams import ImuStream, entry_of

    refuse_outside(0.0, LONGEST_LAG_S, f"0 to {LONGEST_LAG_S:g} s", unit=" s", lag_s=lag_s)
    refuse_outside(ABOVE_ZERO, LARGEST, "a positive number", replay_speed=replay_speed)
    stream = ImuStream(config, magnet=MAGNETS[method], lag_s=lag_s)
    with ExitStack() as open_page:
        view = None
        if page.view:
            from adcs.viewer.live_attitude import LiveAttitudeView

            view = open_page.enter_context(open_page_of(LiveAttitudeView, page))
        try:
            for estimate in stream.follow(source, replay_speed=replay_speed):
                print_json(entry_of(estimate))
                sys.stdout.flush()
                if view is not None:
                    view.update(estimate, stream.tally)
        finally:
            if (tally := stream.tally).rows:
                rows = f"{tally.rows} rows, {tally.late} late, {tally.garbled} garbled, {tally.doubled} doubled"
                note(f"{rows}, clock set back {tally.restarts} times")
        if view is not None:
            view.wait()
