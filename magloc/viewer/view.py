"""View of an array or a result in three dimensions, in a browser, in a notebook, as a page, picture or film."""

from __future__ import annotations

import sys
import webbrowser
from collections.abc import Callable
from contextlib import ExitStack
from functools import cached_property
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import viser

from arrays.array import SensorArray
from arrays.io.closing import Closing
from arrays.io.errors import own_sentence
from magloc.localization.fit.fixes import Fixes
from magloc.readings import Readings
from magloc.surveying.results import Survey
from magloc.tracking.results import TrackResult
from magloc.truth import Truth
from magloc.viewer.film import write_film
from magloc.viewer.outputs import check_outputs
from magloc.viewer.pages.open_result import MapResult, map_result, track_of_truth
from magloc.viewer.pages.pages import Page, array_page, map_page, readings_page, survey_page, track_page
from magloc.viewer.server import (
    FIRST_PORT,
    address,
    free_port,
    open_server,
    page_html,
    wait_for_interruption,
    write_page,
    write_screenshot,
)

if TYPE_CHECKING:
    import xarray as xr

    from magloc.bodies.body import MagnetBody
    from magloc.bodies.poses import BodyPoses
    from magloc.tracking.multi_target.track import SourcesTrack
    from magloc.tracking.track import Track

    Shown = Readings | Fixes | Track | SourcesTrack | TrackResult | Truth | BodyPoses | Survey | xr.Dataset | MapResult

_MOST_ROWS = 2000
_INLINE_PX = 560


class View(Closing):
    """View of a scene in a browser; as a context manager it closes the server at the end.

    Attributes
    ----------
    address : str
        Address of the page on this machine until the view is closed.
    """

    def __init__(self, title: str, fill: Callable[[viser.ViserServer], Page], port: int) -> None:
        with ExitStack() as stack:
            self._server = stack.enter_context(open_server(free_port(port), title))
            self._page = fill(self._server)
            stack.callback(self._page.close)
            self._open = stack.pop_all()
        self.address = address(self._server)

    @cached_property
    def html(self) -> str:
        """Self-contained static page."""
        return page_html(self._server, self._page)

    def write_png(self, path: Path) -> None:
        """Write the page in a headless Chromium as a picture."""
        write_screenshot(self._server, path)

    def write_movie(self, path: Path, progress: Callable[[int], None] | None = None) -> None:
        """Write the rows of the page, or a turn around its scene, as a film (.mp4, .gif, .apng)."""
        write_film(self._server, self._page, path, progress)

    def wait(self) -> None:
        """Wait for Ctrl-C, and close the view."""
        wait_for_interruption()
        self.close()

    def close(self) -> None:
        """Stop the server. A notebook keeps its page."""
        self._open.close()

    def __repr__(self) -> str:
        return f"View({self._page.title!r}, {self.address})"

    def _repr_html_(self) -> str:
        return f'<iframe srcdoc="{escape(self.html)}" style="width:100%;height:{_INLINE_PX}px;border:0"></iframe>'


def view(
    array: SensorArray | None,
    result: (
        Readings
        | Fixes
        | Track
        | SourcesTrack
        | TrackResult
        | Truth
        | BodyPoses
        | Survey
        | xr.Dataset
        | MapResult
        | None
    ) = None,
    *,
    body: MagnetBody | None = None,
    readings: Readings | None = None,
    html: str | Path | None = None,
    png: str | Path | None = None,
    movie: str | Path | None = None,
    open: bool = True,
    port: int = FIRST_PORT,
    title: str = "",
    file: str | Path | None = None,
    progress: Callable[[int], None] | None = None,
) -> View:
    """View an array, its readings or its results in three dimensions.

    The page opens in a browser of this machine, until the view is closed or Python ends: end a script with
    ``view(…).wait()``. In a notebook the view is a page without a server, which a saved notebook keeps.

    Parameters
    ----------
    array : SensorArray, optional
        None for a map, a Survey or a Track, which have their own array, and for a path without an array.
    result : Readings, Fixes, Track, SourcesTrack, TrackResult, Truth, BodyPoses, Survey or xarray.Dataset, optional
        Result for the array; a Dataset is a map over starts or sources. Readings are located first, at most 2000 rows,
        evenly spaced. Without a result the page shows the array, with a dipole that the user can drag.
    body : MagnetBody, optional
        Body of poses, or of readings, whose magnets are shown as they turn.
    readings : Readings, optional
        Rows of the fixes, or of a track without its own rows, for their plot and the array's poses.
    html, png : path, optional
        Write a static page or, by Chromium, a picture, and serve nothing.
    movie : path, optional
        Write a film by Chromium, .mp4 (H.264), .gif or .apng: row by row, or once around an array or a map.
    open : bool
        Open the browser.
    port : int
        Port of the server; if it is in use, the next free one is used.
    title : str
        Title of the browser's tab; by default the name of the array.
    file : path, optional
        File of the array, which the page may replace after sensors were dragged. Otherwise the page writes new files
        only, below the working directory.
    progress : callable, optional
        Called with the number of readings located since the previous call.

    Returns
    -------
    View
        The open page, or the one that was written.

    Raises
    ------
    ValueError
        The result is of another kind, or an argument is missing or superfluous.
    InputError
        A file cannot be written, or there is no Chromium.

    Examples
    --------
    >>> import arrays
    >>> import magloc
    >>> view = magloc.view(arrays.grid(3, 3, 0.1), html="board.html", title="board")
    """
    check_outputs(html, png, movie)
    live = not _is_static(html, png, movie)
    if body is not None:
        result, readings = _magnets(array, body, result, readings)
    fill = _choose_page(array, result, readings, progress, None if file is None else Path(file), live=live)
    name = title or (array.name if array is not None else "") or "view"
    return open_view(f"magloc · {name}", fill, html=html, png=png, movie=movie, open=open, port=port)


def view_survey(
    found: Survey, save: Callable[[Survey], str], *, open: bool = True, port: int = FIRST_PORT, title: str = "survey"
) -> View:
    """View a survey with its review.

    Parameters
    ----------
    found : Survey
    save : callable
        Function that saves a reviewed survey and returns a sentence for the page.
    open, port, title
        As for :func:`view`.
    """
    fill = lambda server: survey_page(server, found, save=save, live=True)  # noqa: E731
    return open_view(f"magloc · {title}", fill, html=None, png=None, movie=None, open=open, port=port)


def _is_static(*files: str | Path | None) -> bool:
    """Return whether a view is written to files or into a notebook instead of served."""
    return any(file is not None for file in files) or _in_notebook()


def open_view(
    title: str,
    fill: Callable[[viser.ViserServer], Page],
    *,
    html: str | Path | None,
    png: str | Path | None,
    movie: str | Path | None,
    open: bool,
    port: int,
) -> View:
    """Serve and open a view with the page of `fill`, or write it to checked files."""
    is_static = _is_static(html, png, movie)
    view = View(title, fill, 0 if is_static else port)
    if not is_static:
        if open:
            webbrowser.open(view.address)
        return view
    with view:
        if html is not None:
            write_page(view.html, Path(html))
        if png is not None:
            view.write_png(Path(png))
        if movie is not None:
            view.write_movie(Path(movie))
        if _in_notebook():
            _ = view.html  # computed now, because it needs the server
    return view


def _in_notebook() -> bool:
    """Return whether this process is the kernel of a notebook."""
    kernel = sys.modules.get("ipykernel.kernelapp")
    return kernel is not None and bool(kernel.IPKernelApp.initialized())


def _magnets(
    array: SensorArray | None, body: MagnetBody, result: Any, readings: Readings | None
) -> tuple[TrackResult, Readings | None]:
    """Return the tracks of a body's magnets, and the rows."""
    from magloc.bodies.locator import BodyLocator
    from magloc.viewer.scene.magnet_tracks import magnet_tracks

    if isinstance(result, Readings):
        if array is None:
            raise ValueError("Input array must be the array of the readings; instead received None.")
        readings = thin_readings(result)
        result = BodyLocator(array, body).fit_rows(readings.values_T, time_s=readings.time_s)
    if not hasattr(result, "n_poses"):
        raise ValueError(
            f"Input result must be readings or poses where a body is given; instead received {type(result).__name__}."
        )
    return magnet_tracks(body, result), readings


def _choose_page(
    array: SensorArray | None,
    result: Any,
    readings: Readings | None,
    progress: Callable[[int], None] | None,
    file: Path | None,
    *,
    live: bool,
) -> Callable[[viser.ViserServer], Page]:
    """Return the function that fills the page, after all checks and slow computations."""
    if isinstance(result, Truth):
        result = track_of_truth(result)
    if hasattr(result, "as_result"):
        array = result.tracker.array if array is None and hasattr(result, "tracker") else array
        readings = result.readings if readings is None else readings
        result = result.as_result
    if isinstance(result, Survey):
        return lambda server: survey_page(server, result, live=live)
    if isinstance(result, TrackResult):
        if not any(point.is_on_track for track in result.tracks for point in track):
            raise ValueError("Input result must have a row where the source is tracked; instead received none.")
        return lambda server: track_page(server, result, array, readings)
    if not isinstance(result, MapResult | Readings | Fixes | None):
        if not hasattr(result, "data_vars"):
            raise ValueError(
                "Input result must be readings, fixes, a track, a truth, a survey or a map; instead received "
                f"{type(result).__name__}."
            )
        result = map_result(result)
    if isinstance(result, MapResult):
        return lambda server: map_page(server, result)
    if array is None:
        raise ValueError("Input array must be the array of the result; instead received None.")
    if result is None:
        return lambda server: array_page(server, array, live=live, file=file)
    if isinstance(result, Readings):
        readings = thin_readings(result)
        result = locate_readings(array, readings, progress)
    fixes, rows = result, readings
    if rows is not None and len(rows) != len(fixes):
        raise ValueError(
            f"Input readings must have a row for each of {len(fixes)} fixes; instead received {len(rows)}."
        )
    if fixes.frame == "world" and (rows is None or rows.pose is None):
        raise ValueError("Input readings must have poses for fixes in the world frame; instead received none.")
    return lambda server: readings_page(server, array, fixes, rows)


def thin_readings(rows: Readings) -> Readings:
    """Return evenly spaced rows, at most 2000."""
    return rows[:: -(-len(rows) // _MOST_ROWS)]


def locate_readings(array: SensorArray, rows: Readings, progress: Callable[[int], None] | None = None) -> Fixes:
    """Return the fixes of readings in their ambient field, or unsolved ones with a reason."""
    # These modules take a second to load, and other results do not need them.
    from magloc.ambient import with_ambient_field
    from magloc.localization.locator import locate

    used, ambient_T = with_ambient_field(array, rows, None, gradient=False)
    try:
        return locate(used, rows, ambient_T=ambient_T, progress=progress)
    except ValueError as error:
        return Fixes.unsolved(rows.time_s, own_sentence(error))
