"""Live page of tracked sources, for the command and for user code."""

from __future__ import annotations

import math
import webbrowser

import viser

from arrays.array import SensorArray
from magloc.live.follower import LivePoint
from magloc.readings import Readings
from magloc.tracking.results import SourcesPoint, TrackPoint
from magloc.tracking.rows import rows_of
from magloc.viewer.pages.live import Controls, LivePage
from magloc.viewer.pages.pages import Page, live_page
from magloc.viewer.server import FIRST_PORT
from magloc.viewer.view import View


class LiveView(View):
    """Page of tracked sources: scene, readings, residuals, rate, latency and lost rows.

    A separate thread draws the newest point, so that no row waits for the page. As a context manager it closes the
    page at the end.

    Parameters
    ----------
    array : SensorArray
        Array that the scene shows, and whose readings the page has.
    controls : Follower, optional
        Object that the buttons of the page stop, start and tare: a :class:`magloc.live.Follower`, or another one with
        these methods.
    port : int
        Port of the server; if it is in use, the next free one is used.
    open : bool
        Open the browser.
    title : str
        Title of the browser's tab; by default the name of the array.

    Attributes
    ----------
    address : str
        Address of the page on this machine until it is closed.

    Examples
    --------
    >>> import magloc
    >>> diver = magloc.datasets.load("diver")
    >>> tracker = magloc.Tracker(diver.array, magloc.RandomWalk(1e-3, 1e-3))
    >>> with magloc.viewer.LiveView(diver.array, open=False) as view:
    ...     for row in diver.readings[:3]:
    ...         view.update(tracker.update(row), row)
    """

    def __init__(
        self,
        array: SensorArray,
        *,
        controls: Controls | None = None,
        port: int = FIRST_PORT,
        open: bool = True,
        title: str = "",
    ) -> None:
        def fill(server: viser.ViserServer) -> Page:
            self._live = LivePage(server, array, controls)
            return live_page(server, array, self._live)

        super().__init__(title or array.name or "live", fill, port)
        if open:
            webbrowser.open(self.address)

    def update(self, point: TrackPoint | SourcesPoint, row: Readings | None = None) -> None:
        """Show a new point, unless a newer one comes before it is drawn.

        Parameters
        ----------
        point : TrackPoint or SourcesPoint
            Result of :meth:`magloc.Tracker.update`, :meth:`magloc.SourcesTracker.update` or :func:`magloc.live.track`,
            or a :class:`magloc.live.body.BodyPoint`.
        row : Readings of length one, optional
            Row of the point; a LivePoint contains it already.
        """
        if isinstance(point, LivePoint):
            self._live.update(point, point.row, point.tally, point.latency_s)
        else:
            self._live.update(point, None if row is None else next(rows_of(row)), None, math.nan)
