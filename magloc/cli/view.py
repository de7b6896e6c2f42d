"""``magloc view``: a result seen in three dimensions, in a browser, as a page or as a picture."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter
from cyclopts.validators import Number

from arrays.io.arguments import Flag, whole_number
from arrays.io.errors import InputError
from arrays.io.outputs import refuse_unwritable
from magloc.cli.framework import CommonOptions, progress
from magloc.cli.options import print_note

if TYPE_CHECKING:
    import viser

    from arrays.array import SensorArray
    from magloc.localization.fit.fixes import Fixes
    from magloc.readings import Readings
    from magloc.viewer.pages.open_result import ReadingsResult, Result
    from magloc.viewer.pages.pages import Page


Port = Annotated[int, Parameter(converter=whole_number, validator=Number(gte=0, lte=65535))]
_MOST_ROWS = 2000


def view(
    path: Path,
    /,
    *,
    array: Path | None = None,
    readings: Path | None = None,
    html: Path | None = None,
    png: Path | None = None,
    port: Port = 8080,
    open: Flag = False,
    common: CommonOptions = CommonOptions(),  # noqa: B008 - frozen
) -> None:
    """See an array, readings, a track or a map in three dimensions.

    Starts a server on this machine and prints its address, which any browser on this machine opens; Ctrl-C ends it.
    With --html or --png a file is written instead.

    Parameters
    ----------
    path : Path
        Array file (TOML), readings or truth file (CSV), track of magloc track --json or --jsonl, or folder of magloc
        map.
    array : Path
        Array file that readings or a track belong to; for readings by default NAME-array.toml or array.toml beside
        them.
    readings : Path
        Readings file (CSV) that a track belongs to.
    html : Path
        Write one static HTML file that needs no server.
    png : Path
        Write a picture; needs Chromium or Chrome.
    port : int
        Port of the server; the next one that is free if it is in use.
    open : bool
        Open the browser.
    common : CommonOptions
        Common options.
    """
    from magloc.viewer.chromium import BrowserError, find_chromium
    from magloc.viewer.pages.open_result import ReadingsResult, read_result
    from magloc.viewer.server import address, free_port, opened, wait_for_interruption, write_page, write_picture

    if html is not None:
        refuse_unwritable(html, "--html")
    if png is not None:
        refuse_unwritable(png, "--png", ".png")
    if png is not None:
        try:
            find_chromium()
        except InputError as error:
            raise InputError(f"--png: {error}") from None
    result = read_result(path, array)
    with_track = _with_track(result, array, readings)
    fixes = _fixes(result, quiet=common.quiet) if isinstance(result, ReadingsResult) else None
    written = html is not None or png is not None
    used = 0 if written else free_port(port)
    if used not in (0, port) and port and not common.quiet:
        print_note(f"port {port} is in use, {used} is taken")
    with opened(used, f"magloc · {path.name or path.resolve().name}") as server:
        page = _filled(server, result, with_track, fixes, live=not written)
        if html is not None:
            write_page(server, page, html)
        if png is not None:
            try:
                write_picture(server, png)
            except BrowserError as error:
                raise InputError(f"--png: {error}") from None
        if written:
            if not common.quiet:
                print_note(f"wrote {', '.join(str(file) for file in (html, png) if file is not None)}")
            return
        print(address(server), flush=True)
        if not common.quiet:
            print_note("open this address in a browser; Ctrl-C ends the viewer")
        if open:
            import webbrowser

            webbrowser.open(address(server))
        wait_for_interruption()
        page.close()


def _with_track(
    result: Result, array: Path | None, readings: Path | None
) -> tuple[SensorArray | None, Readings | None]:
    """The array and the readings that a track belongs to."""
    from arrays.array_file import read_sensors
    from magloc.tracking.results import TrackResult
    from magloc.viewer.pages.open_result import ReadingsResult, read_rows

    if not isinstance(result, TrackResult):
        if readings is not None:
            raise InputError(f"--readings {readings}: found it without a track, expected it with a track.")
        if array is not None and not isinstance(result, ReadingsResult):
            raise InputError(f"--array {array}: found it with what has its own, expected it with readings or a track.")
        return None, None
    if readings is None:
        return None if array is None else read_sensors(array), None
    rows = read_rows(readings, array)
    return rows.array, rows.readings


def _fixes(result: ReadingsResult, *, quiet: bool) -> tuple[Fixes, Readings]:
    """Fixes of the rows as ``magloc locate`` finds them, in its frame; of 2000 rows at most, evenly."""
    from magloc.ambient import with_ambient_field
    from magloc.localization.fit.fixes import Fixes
    from magloc.localization.locator import locate

    step = -(-len(result.readings) // _MOST_ROWS)
    if step > 1 and not quiet:
        print_note(f"note: every {step}th of {len(result.readings)} rows is fixed and shown")
    rows = _every(result.readings, step)
    used, ambient_T = with_ambient_field(result.array, rows, None, gradient=False)
    with progress(len(rows), "rows", quiet=quiet) as advance:
        try:
            return locate(used, rows, ambient_T=ambient_T, progress=advance), rows
        except ValueError as error:
            # Readings can be looked at although nothing can be located.
            return Fixes.unsolved(rows.time_s, str(error).removeprefix("Input ")), rows


def _every(rows: Readings, step: int) -> Readings:
    from dataclasses import fields, replace

    parts = {field.name: getattr(rows, field.name) for field in fields(rows)}
    return replace(rows, **{name: part[::step] for name, part in parts.items() if part is not None})


def _filled(
    server: viser.ViserServer,
    result: Result,
    with_track: tuple[SensorArray | None, Readings | None],
    fixes: tuple[Fixes, Readings] | None,
    *,
    live: bool,
) -> Page:
    """The scene and the panels of a result."""
    from magloc.viewer.pages.open_result import ArrayResult, MapResult, ReadingsResult
    from magloc.viewer.pages.pages import array_page, map_page, readings_page, track_page

    if isinstance(result, ArrayResult):
        return array_page(server, result, live=live)
    if isinstance(result, MapResult):
        return map_page(server, result)
    if isinstance(result, ReadingsResult):
        if fixes is None:
            raise ValueError("Input fixes must be those of the readings; instead received None.")
        return readings_page(server, result, *fixes)
    return track_page(server, result, *with_track)
