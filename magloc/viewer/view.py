"""What an array is, reads or finds, in three dimensions: in a browser, in a notebook, as a page or as a picture."""

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
from magloc.viewer.pages.open_result import MapResult, map_of, path_of_truth
from magloc.viewer.pages.pages import Page, array_page, map_page, readings_page, survey_page, track_page
from magloc.viewer.server import (
    FIRST_PORT,
    address,
    free_port,
    opened,
    page_html,
    wait_for_interruption,
    write_page,
    write_picture,
)

if TYPE_CHECKING:
    import xarray as xr

    from magloc.tracking.multi_target.track import SourcesTrack
    from magloc.tracking.track import Track

_MOST_ROWS = 2000
_INLINE_PX = 560


class View(Closing):
    """A scene; a context manager that closes it.

    Attributes
    ----------
    address : str
        Where a browser of this machine finds it until it is closed.
    """

    def __init__(self, title: str, fill: Callable[[viser.ViserServer], Page], port: int) -> None:
        with ExitStack() as stack:
            self._server = stack.enter_context(opened(free_port(port), title))
            self._page = fill(self._server)
            stack.callback(self._page.close)
            self._open = stack.pop_all()
        self.address = address(self._server)

    @cached_property
    def html(self) -> str:
        """One static page that needs nothing else."""
        return page_html(self._server, self._page)

    def write_png(self, path: Path) -> None:
        """Write the page as a headless Chromium shows it."""
        write_picture(self._server, path)

    def write_movie(self, path: Path, progress: Callable[[int], None] | None = None) -> None:
        """Write the rows of the page, or a turn around what it shows, as a film (.mp4, .gif, .apng)."""
        write_film(self._server, self._page, path, progress)

    def wait(self) -> None:
        """Serve until Ctrl-C, and close."""
        wait_for_interruption()
        self.close()

    def close(self) -> None:
        """Stop the server; the page remains where it was taken before."""
        self._open.close()

    def __repr__(self) -> str:
        return f"View({self._page.title!r}, {self.address})"

    def _repr_html_(self) -> str:
        return f'<iframe srcdoc="{escape(self.html)}" style="width:100%;height:{_INLINE_PX}px;border:0"></iframe>'


def view(
    array: SensorArray | None,
    result: (
        Readings | Fixes | Track | SourcesTrack | TrackResult | Truth | Survey | xr.Dataset | MapResult | None
    ) = None,
    *,
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
    """See an array, and what it reads or finds, in three dimensions.

    In a browser of this machine, until the view is closed or Python ends: a script ends with ``view(…).wait()``. In a
    notebook the view shows itself, as a page without a server, which a saved notebook keeps.

    Parameters
    ----------
    array : SensorArray, optional
        None for a map, a Survey or a Track, which have their own, and for a path without an array.
    result : Readings, Fixes, Track, SourcesTrack, TrackResult, Truth, Survey or xarray.Dataset, optional
        Of the array; a Dataset is a map over starts or sources. Readings are located first, 2000 rows at most, evenly.
        Without it the array alone is seen, with a dipole to be dragged.
    readings : Readings, optional
        Rows that fixes were made of, or a track that does not have its own, for their plot and the array's poses.
    html, png : path, optional
        Write a static page or, by Chromium, a picture, and serve nothing.
    movie : path, optional
        Write a film by Chromium, .mp4 (H.264), .gif or .apng: row by row, or once around an array or a map.
    open : bool
        Open the browser.
    port : int
        The next one that is free is taken if it is in use.
    title : str
        Of the browser's tab; by default the array's name.
    file : path, optional
        That the array was read from: the page, where sensors are dragged, may replace it. Otherwise it writes new files
        only, below the working directory.
    progress : callable, optional
        Called with the number of readings located since the last call.

    Raises
    ------
    ValueError
        The result is none that can be seen, or an argument is missing or too many.
    InputError
        A file cannot be written, or Chromium is not there.

    Examples
    --------
    >>> import arrays
    >>> import magloc
    >>> view = magloc.view(arrays.grid(3, 3, 0.1), html="board.html", title="board")
    """
    check_outputs(html, png, movie)
    live = not _is_static(html, png, movie)
    fill = _filling(array, result, readings, progress, None if file is None else Path(file), live=live)
    called = title or (array.name if array is not None else "") or "view"
    return shown(f"magloc · {called}", fill, html=html, png=png, movie=movie, open=open, port=port)


def _is_static(*files: str | Path | None) -> bool:
    """Whether a view is written or put into a notebook and not served."""
    return any(file is not None for file in files) or _in_notebook()


def shown(
    title: str,
    fill: Callable[[viser.ViserServer], Page],
    *,
    html: str | Path | None,
    png: str | Path | None,
    movie: str | Path | None,
    open: bool,
    port: int,
) -> View:
    """A scene that `fill` fills, served and opened, or written into files that have been checked."""
    static = _is_static(html, png, movie)
    view = View(title, fill, 0 if static else port)
    if not static:
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
            _ = view.html  # taken while there is a server; of a long record it takes seconds
    return view


def _in_notebook() -> bool:
    """Whether this process is a notebook's kernel; that its package is loaded says nothing yet."""
    kernel = sys.modules.get("ipykernel.kernelapp")
    return kernel is not None and bool(kernel.IPKernelApp.initialized())


def _filling(
    array: SensorArray | None,
    result: Any,
    readings: Readings | None,
    progress: Callable[[int], None] | None,
    file: Path | None,
    *,
    live: bool,
) -> Callable[[viser.ViserServer], Page]:
    """What fills the scene; all that can be wrong is found, and all that is slow is done, before it is opened."""
    if isinstance(result, Truth):
        result = path_of_truth(result)
    if hasattr(result, "as_result"):
        array = result.tracker.array if array is None and hasattr(result, "tracker") else array
        readings = result.readings if readings is None else readings
        result = result.as_result
    if isinstance(result, Survey):
        return lambda server: survey_page(server, result)
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
        result = map_of(result)
    if isinstance(result, MapResult):
        return lambda server: map_page(server, result)
    if array is None:
        raise ValueError("Input array must be the one that the result belongs to; instead received None.")
    if result is None:
        return lambda server: array_page(server, array, live=live, file=file)
    if isinstance(result, Readings):
        readings = thinned(result)
        result = fixes_of(array, readings, progress)
    fixes, rows = result, readings
    if rows is not None and len(rows) != len(fixes):
        raise ValueError(f"Input readings must have {len(fixes)} rows, one a fix; instead received {len(rows)}.")
    if fixes.frame == "world" and (rows is None or rows.pose is None):
        raise ValueError("Input readings must hold the poses of fixes in the world; instead received none.")
    return lambda server: readings_page(server, array, fixes, rows)


def thinned(rows: Readings) -> Readings:
    """Every so many of the rows, so that 2000 remain at most."""
    return rows[:: -(-len(rows) // _MOST_ROWS)]


def fixes_of(array: SensorArray, rows: Readings, progress: Callable[[int], None] | None = None) -> Fixes:
    """Fixes of readings in the ambient field that they show; without any, and a reason, where none can be located."""
    # What locates takes a second to load, and other results do without.
    from magloc.ambient import with_ambient_field
    from magloc.localization.locator import locate

    used, ambient_T = with_ambient_field(array, rows, None, gradient=False)
    try:
        return locate(used, rows, ambient_T=ambient_T, progress=progress)
    except ValueError as error:
        return Fixes.unsolved(rows.time_s, own_sentence(error))
