"""``magloc live``: one source followed while its readings come in, or several."""

from __future__ import annotations

import sys
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from arrays.io.errors import LARGEST, naming, naming_options
from arrays.io.outputs import refuse_unwritable
from magloc.cli.framework import ABOVE_ZERO, Flag, QuietOptions, note, refuse_outside
from magloc.cli.options import STREAM, KnownOptions, MotionOptions, Port, naming_place

if TYPE_CHECKING:
    from arrays.io.csv import Column
    from magloc.live.follower import Follower, LivePoint
    from magloc.viewer.live_view import LiveView

_SWITCH_S = 5e-4
"""After so long a thread of the page lets a row that has come be followed."""


@Parameter(name="*", group="Live page")
@dataclass(frozen=True)
class PageOptions:
    """The live page.

    Parameters
    ----------
    view : bool
        Serve a page that shows the source while it moves; it stays until Ctrl-C.
    port : int
        Port of its server; the next one that is free if it is in use.
    open : bool
        Open the browser.
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
    page: PageOptions = PageOptions(),
    known: KnownOptions = KnownOptions(),  # noqa: B008 - frozen
    motion: MotionOptions = MotionOptions(),  # noqa: B008 - frozen
    common: QuietOptions = QuietOptions(),  # noqa: B008 - frozen
) -> None:
    """Follow one source, or several, while their readings come in.

    Every row is answered by one JSON line at once, as of magloc track --jsonl, with latency_ms. Rows are CSV, first a
    header with the columns of a readings file, or JSON objects with these names. Those that are late, lost, doubled or
    garbled are counted and named on stderr, and end nothing.

    Parameters
    ----------
    array : Path
        Array file (TOML).
    source : str
        Where rows come from: - for standard input, tcp://HOST:PORT to connect to, udp://HOST:PORT to listen at,
        serial:DEVICE@BAUD (extra serial), or replay:FILE for a readings file in its own time.
    rest_s : float
        The first seconds are a rest, without a source, whose mean is taken off all later readings; vector sensors of an
        array that stands.
    replay_speed : float
        How much faster than in its own time a file is replayed.
    out : Path, optional
        CSV file with the columns of track.csv of magloc track --out, a row for every line, or for every source of it.
        Every row is in the file as soon as it is known.
    page : PageOptions
        The live page.
    known : KnownOptions
        What is known of the sensors, of the source when a track starts, and of the ambient field.
    motion : MotionOptions
        How many sources there are, and what is known of their motion.
    common : QuietOptions
        Common options.
    """
    from arrays.io.csv import GrowingTable

    refuse_outside(0.0, LARGEST, "0 or a positive number", rest_s=rest_s)
    refuse_outside(ABOVE_ZERO, LARGEST, "a positive number", replay_speed=replay_speed)
    refuse_unwritable(out, "--out", ".csv")
    used = known.array(array)
    with naming(str(array), sources=f"--sources {motion.sources}"):
        follower = motion.follower(used, known, known.where, rest_s)
    with ExitStack() as open_page:
        view = open_page.enter_context(shown(follower, page)) if page.view else None
        table = None if out is None else open_page.enter_context(GrowingTable(out))
        try:
            with naming_place(), naming(str(array), readings=source, time_s=source):
                for point in follower.follow(source, replay_speed=replay_speed):
                    motion.print_entry(point, latency_ms=1e3 * point.latency_s)
                    if table is not None:
                        table.add(_columns(point, moves=follower.moves))
                    if view is not None:
                        view.update(point)
        finally:
            if follower.tally.rows:
                note(str(follower.tally))
        if view is not None:
            view.wait()


def shown(follower: Follower, page: PageOptions) -> LiveView:
    """A page of what a follower follows, and a note of its address."""
    import magloc.viewer

    with naming_options("port"):
        view = magloc.viewer.LiveView(follower.array, controls=follower, port=page.port, open=page.open)
    sys.setswitchinterval(_SWITCH_S)
    note(f"open {view.address} in a browser; Ctrl-C ends the page")
    return view


def _columns(point: LivePoint, *, moves: bool) -> dict[str, Column]:
    """Columns of the file with one row, or of several sources one of each."""
    from magloc.tracking.files import columns_of_track

    if point.sources is not None:
        return columns_of_track(point.sources.tracks, ids=[track.id for track in point.sources.tracks])
    return columns_of_track([point], point.row.origin_m[None] if moves else None)
