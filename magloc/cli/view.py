"""``magloc view``: a result in three dimensions, in a browser, as a page or as a picture."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

import arrays
from arrays.io.errors import InputError, naming
from magloc.cli.framework import CommonOptions, Flag, note, progress
from magloc.cli.options import STREAM, Port, naming_outputs

if TYPE_CHECKING:
    from arrays.array import SensorArray
    from magloc.bodies.body import MagnetBody
    from magloc.localization.fit.fixes import Fixes
    from magloc.readings import Readings
    from magloc.viewer.pages.open_result import ReadingsResult, Result
    from magloc.viewer.view import View


def view(
    path: Annotated[Path, Parameter(allow_leading_hyphen=True)],
    /,
    *,
    array: Path | None = None,
    readings: Path | None = None,
    body: Path | None = None,
    html: Path | None = None,
    png: Path | None = None,
    movie: Path | None = None,
    port: Port = 8080,
    open: Flag = False,
    common: CommonOptions = CommonOptions(),  # noqa: B008 - frozen
) -> None:
    """Show an array, readings, a track or a map in three dimensions.

    Starts a server on this machine and prints its address for a browser on this machine; Ctrl-C ends the server. With
    --html, --png or --movie the command writes a file instead.

    Parameters
    ----------
    path : Path
        Array file (TOML), readings or truth file (CSV), track of magloc track --json or --jsonl, folder of magloc
        map, or - for rows on standard input, whose source is tracked as by magloc live.
    array : Path
        Array file of readings or of a track; for readings by default NAME-array.toml or array.toml in their folder.
    readings : Path
        Readings file (CSV) of a track.
    body : Path
        Body file (TOML) of readings: its pose is found in every row, and its magnets are shown as they turn.
    html : Path
        HTML file to write; it needs no server.
    png : Path
        Picture to write (.png); needs Chromium or Chrome.
    movie : Path
        Film to write (.mp4, .gif or .apng): all rows, or once around an array or a map; needs Chromium or Chrome.
    port : int
        Port of the server; the next free one if it is in use.
    open : bool
        Open the page in the browser.
    common : CommonOptions
        Common options.
    """
    if str(path).startswith("-") and str(path) != STREAM:
        raise InputError(f"Unknown option: {path}.")
    import magloc
    from magloc.viewer.outputs import check_outputs
    from magloc.viewer.pages.open_result import ReadingsResult, read_result

    if str(path) == STREAM:
        if array is None or any(file is not None for file in (readings, html, png, movie)):
            raise InputError("-: found no --array, or a file to be read or written, expected --array alone.")
        _view_stream(array, port, open=open)
        return

    with naming_outputs():
        check_outputs(html, png, movie)
    result = read_result(path, array)
    sensors, rows = _with_track(result, array, readings)
    file = path if isinstance(result, arrays.SensorArray) else None
    shown: Any = result
    magnets = None if body is None else _read_body(body, result)
    if isinstance(result, ReadingsResult) and magnets is not None:
        sensors, shown = result.array, result.readings
    elif isinstance(result, ReadingsResult):
        sensors, (shown, rows) = result.array, _fixes(result)
    elif isinstance(result, arrays.SensorArray):
        sensors, shown = result, None
    written = [str(file) for file in (html, png, movie) if file is not None]
    title = path.name or path.resolve().name

    def scene(port: int) -> View:
        return magloc.view(
            sensors,
            shown,
            body=magnets,
            readings=rows,
            html=html,
            png=png,
            movie=movie,
            open=open,
            port=port,
            title=title,
            file=file,
        )

    write_or_serve(scene, written, port)


def _read_body(path: Path, result: Result) -> MagnetBody:
    from magloc.bodies.body_file import read_body
    from magloc.viewer.pages.open_result import ReadingsResult

    if not isinstance(result, ReadingsResult):
        raise InputError(f"--body {path}: found without readings, expected a readings file.")
    return read_body(path)


def write_or_serve(scene: Callable[[int], View], written: Sequence[str], port: int) -> None:
    """Make a scene; it writes files, or a server shows it until Ctrl-C."""
    from magloc.viewer.server import free_port

    with naming_outputs():
        used = port if written else free_port(port)
        if used != port and port:
            note(f"port {port} is in use, {used} is taken")
        view = scene(used)
    if written:
        note(f"wrote {', '.join(written)}")
        return
    with suppress(KeyboardInterrupt):  # Ctrl-C may come before the waiting begins
        note("open this address in a browser; Ctrl-C ends the viewer")
        print(view.address, flush=True)
        view.wait()
    view.close()


def _view_stream(array: Path, port: int, *, open: bool) -> None:
    """Show a source that is tracked through rows on standard input, until Ctrl-C."""
    from magloc.cli.live import PageOptions, open_live_page
    from magloc.live.follower import Follower

    follower = Follower(arrays.read_array(array))
    with open_live_page(follower, PageOptions(port=port, open=open)) as scene, naming(str(array)):
        print(scene.address, flush=True)
        for point in follower.follow(STREAM):
            scene.update(point)
        scene.wait()


def _with_track(
    result: Result, array: Path | None, readings: Path | None
) -> tuple[SensorArray | None, Readings | None]:
    """Read the array and the readings of a track."""
    from arrays.array_file import read_sensors
    from magloc.tracking.results import TrackResult
    from magloc.viewer.pages.open_result import ReadingsResult, read_rows

    if not isinstance(result, TrackResult):
        if readings is not None:
            raise InputError(f"--readings {readings}: found without a track, expected with one.")
        if array is not None and not isinstance(result, ReadingsResult):
            raise InputError(f"--array {array}: found with a file that has one, expected with readings or a track.")
        return None, None
    if readings is None:
        return None if array is None else read_sensors(array), None
    rows = read_rows(readings, array)
    return rows.array, rows.readings


def _fixes(result: ReadingsResult) -> tuple[Fixes, Readings]:
    """Locate the source in every row, of at most 2000 rows, as ``magloc locate`` does."""
    from magloc.viewer.view import locate_readings, thin_readings

    rows, n = thin_readings(result.readings), len(result.readings)
    if len(rows) < n:
        note(f"note: every {-(-n // len(rows))}th of {n} rows is located and shown")
    with progress(len(rows), "rows") as advance:
        return locate_readings(result.array, rows, advance), rows
