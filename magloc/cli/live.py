"""``magloc live``: one source, or several, tracked while readings arrive."""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

from cyclopts import Parameter

from arrays.io.errors import LARGEST, InputError, naming, naming_options
from arrays.io.outputs import refuse_unwritable
from magloc.cli.framework import ABOVE_ZERO, Flag, QuietOptions, note, print_json, refuse_outside
from magloc.cli.moments.magnet import MagnetOptions
from magloc.cli.options import STREAM, KnownOptions, MotionOptions, Port, naming_place

if TYPE_CHECKING:
    from arrays.io.csv import Column
    from magloc.live.follower import Follower, LivePoint
    from magloc.viewer.live_view import LiveView
    from magloc.viewer.view import View

_Live = TypeVar("_Live", bound="View")
_SWITCH_S = 5e-4
"""Time after which a thread of the page yields to the tracker."""


@Parameter(name="*", group="Live calibration")
@dataclass(frozen=True)
class TurningOptions:
    """Calibration of vector sensors while they are turned in a uniform field.

    Parameters
    ----------
    calibrate : bool
        Calibrate instead of tracking: a JSON line a second with the directions covered, the turn that is missing and
        the standard deviations. It ends when they are enough, and writes --out-array.
    out_array : Path, optional
        Array file to write with the calibrations.
    modulus_nT : float, optional
        Modulus of the field [nT]; by default that at --place and --date, or else the mean gain of the sensors stays as
        in the array file.
    goal_nT : float, optional
        Standard deviation of the offsets that is enough [nT]; by default a thousandth of the modulus.
    """

    calibrate: Flag = False
    out_array: Path | None = None
    modulus_nT: Annotated[float | None, Parameter(name="--modulus-nT")] = None
    goal_nT: Annotated[float | None, Parameter(name="--goal-nT")] = None

    def check(self, *, out: Path | None, rest_s: float, sources: str | None) -> None:
        """Refuse options that contradict each other."""
        refuse_unwritable(self.out_array, "--out-array", ".toml")
        refuse_outside(ABOVE_ZERO, LARGEST, "a positive number", modulus_nT=self.modulus_nT, goal_nT=self.goal_nT)
        own = {"--out-array": self.out_array, "--modulus-nT": self.modulus_nT, "--goal-nT": self.goal_nT}
        others = {"--out": out, "--rest-s": rest_s or None, "--sources": sources}
        for name, value in (others if self.calibrate else own).items():
            if value is not None:
                found = "together with" if self.calibrate else "without"
                expected = "one of them" if self.calibrate else "both"
                raise InputError(f"{name}: found {found} --calibrate, expected {expected}.")
        if self.calibrate and self.out_array is None:
            raise InputError("--calibrate: found no --out-array, expected the array file to write.")


@Parameter(name="*", group="Live page")
@dataclass(frozen=True)
class PageOptions:
    """Page that shows a source while it moves.

    Parameters
    ----------
    view : bool
        Serve a page that shows the source while it moves. The page stays until Ctrl-C.
    port : int
        Port of the server; the next free one if it is in use.
    open : bool
        Open the page in the browser.
    """

    view: Flag = False
    port: Port = 8080
    open: Flag = False


def live(
    *,
    array: Path,
    source: Annotated[str, Parameter(name="--from", allow_leading_hyphen=True)] = STREAM,
    rest_s: float = 0.0,
    replay_speed: float = 1.0,
    out: Path | None = None,
    body: Path | None = None,
    turning: TurningOptions = TurningOptions(),
    page: PageOptions = PageOptions(),
    known: KnownOptions = KnownOptions(),  # noqa: B008 - frozen
    motion: MotionOptions = MotionOptions(),  # noqa: B008 - frozen
    magnet: MagnetOptions = MagnetOptions(),  # noqa: B008 - frozen
    common: QuietOptions = QuietOptions(),  # noqa: B008 - frozen
) -> None:
    """Track one source, or several, while readings arrive.

    Every row gives one JSON line at once, as magloc track --jsonl does, with latency_ms. Rows are CSV, after a header
    with the columns of a readings file, or JSON objects with these names. Late, lost, doubled and garbled rows are
    counted and named on stderr; tracking goes on.

    Parameters
    ----------
    array : Path
        Array file (TOML).
    source : str
        Source of the rows: - for standard input, tcp://HOST:PORT to connect to, udp://HOST:PORT to listen at,
        serial:DEVICE@BAUD (extra serial), or replay:FILE for a readings file in its own time.
    rest_s : float
        Duration of a rest without a source at the beginning [s]. Its mean is subtracted from all later readings. Only
        for vector sensors of an array that does not move.
    replay_speed : float
        Speed of a replay, over that of the recording.
    out : Path, optional
        CSV file to write, with the columns of track.csv of magloc track --out: a row for every line and source, as soon
        as it is known.
    body : Path, optional
        Body file (TOML) of a rigid body of two or more magnets; its pose is tracked, in the array's frame.
    turning : TurningOptions
        Calibration instead of tracking.
    page : PageOptions
        Page that shows the source.
    known : KnownOptions
        Prior knowledge of the sensors, of the source when a track starts, and of the ambient field.
    motion : MotionOptions
        Number of sources, and the model of their motion.
    magnet : MagnetOptions
        Shape of a magnet.
    common : QuietOptions
        Common options.
    """
    from arrays.io.outputs import GrowingTable
    from magloc.measurement.magnet import array_near

    refuse_outside(0.0, LARGEST, "0 or a positive number", rest_s=rest_s)
    refuse_outside(ABOVE_ZERO, LARGEST, "a positive number", replay_speed=replay_speed)
    refuse_unwritable(out, "--out", ".csv")
    turning.check(out=out, rest_s=rest_s, sources=motion.sources)
    used = array_near(known.array(array), magnet.shape(sources=motion.sources))
    if turning.calibrate:
        from magloc.cli.calibration.live_turning import calibrate_live

        with naming_place(), naming(str(array), readings=source, time_s=source):
            calibrate_live(used, array, source, replay_speed, turning, known.where, page)
        return
    with naming(str(array), sources=f"--sources {motion.sources}"):
        if body is None:
            follower = motion.follower(used, known, known.where, rest_s)
        else:
            from magloc.cli.moments.body_poses import body_follower

            follower = body_follower(used, body, motion, known, rest_s)
    with ExitStack() as open_page:
        view = open_page.enter_context(open_live_page(follower, page)) if page.view else None
        table = None if out is None else open_page.enter_context(GrowingTable(out))
        try:
            with naming_place(), naming(str(array), readings=source, time_s=source):
                for point in follower.follow(source, replay_speed=replay_speed):
                    _print(point, motion)
                    if table is not None:
                        table.add(_columns(point, moves=follower.moves))
                    if view is not None:
                        view.update(point)
        finally:
            if follower.tally.rows:
                note(str(follower.tally))
        if view is not None:
            view.wait()
    if body is not None and not follower.tally.tracked:
        raise InputError(f"{source}: found no row in which the body can be tracked.")


def open_live_page(follower: Follower, page: PageOptions) -> LiveView:
    """Open a page of a tracker, and print its address."""
    import magloc.viewer

    return open_page_of(partial(magloc.viewer.LiveView, follower.array, controls=follower), page)


def open_page_of(make: Callable[..., _Live], page: PageOptions) -> _Live:
    """Open a page that takes a port and whether to open a browser, and print its address."""
    with naming_options("port"):
        view = make(port=page.port, open=page.open)
    sys.setswitchinterval(_SWITCH_S)
    note(f"open {view.address} in a browser; Ctrl-C ends the page")
    return view


def _print(point: LivePoint, motion: MotionOptions) -> None:
    """Print the JSON line of a row at once."""
    from magloc.live.body import BodyPoint

    latency_ms = 1e3 * point.latency_s
    if not isinstance(point.sources, BodyPoint):
        motion.print_entry(point, latency_ms=latency_ms)
        return
    (entry,) = point.sources.poses.entries()
    print_json(entry | {"latency_ms": latency_ms})
    sys.stdout.flush()


def _columns(point: LivePoint, *, moves: bool) -> dict[str, Column]:
    """Return the columns of one row, or of one row for each of several sources."""
    from magloc.live.body import BodyPoint
    from magloc.tracking.files import columns_of_track

    if isinstance(point.sources, BodyPoint):
        return point.sources.poses.columns()
    if point.sources is not None:
        return columns_of_track(point.sources.tracks, ids=[track.id for track in point.sources.tracks])
    return columns_of_track([point], point.row.origin_m[None] if moves else None)
