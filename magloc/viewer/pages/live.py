"""Live page of tracked sources: the newest row, and the last seconds."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from itertools import combinations
from threading import Lock
from time import perf_counter
from typing import Protocol

import numpy as np
import viser
from scipy.spatial.transform import Rotation

from arrays.array import SensorArray
from arrays.io.errors import InputError
from arrays.typing import FloatArray
from magloc.bodies.field import body_fields
from magloc.live.body import BodyPoint
from magloc.live.follower import LivePoint
from magloc.live.tally import Tally
from magloc.readings import Readings
from magloc.tracking.results import SourcesPoint, TrackPoint, track_column
from magloc.tracking.rows import Row
from magloc.viewer.pages import texts
from magloc.viewer.pages.track_player import SOURCE_COLOURS, point_html
from magloc.viewer.panels.drawing_thread import DrawingThread
from magloc.viewer.panels.readings_plot import ReadingsPlot, residuals_of
from magloc.viewer.scene.glyphs import (
    DIPOLE_COLOUR,
    REGION_COLOUR,
    TRACK_COLOUR,
    ArrayGlyphs,
    Colour,
    DipoleGlyph,
    SurfaceGlyph,
    add_lines,
    length_text,
    show_segments,
)
from magloc.viewer.scene.legend import Entry, Swatch
from magloc.viewer.scene.shapes import ellipsoid, line_segments

WINDOW_S = 10.0
"""Length of the tail and of the plots."""
_MOST_ROWS = 400
_FRAMES_PER_SECOND = 15.0
_PLOT_S = 0.25
"""Time between two updates of the plots, which take longer than the scene."""
_RATE_ROWS = 200
_REST_S = 3.0
NOWHERE = np.full(3, np.nan)
SINGLE_ID = 0
"""Id of a source that is tracked on its own."""


class Controls(Protocol):
    """Protocol of the object that the buttons control, such as :class:`magloc.live.Follower`."""

    def stop(self) -> None:
        """Stop tracking."""

    def start(self) -> None:
        """Restart tracking."""

    def tare(self, rest_s: float) -> None:
        """Take the mean of the next seconds as the background."""


@dataclass(frozen=True, eq=False)
class LiveRow:
    """Row with its point."""

    point: TrackPoint | SourcesPoint
    row: Row | None


class LiveSource:
    """Source in the scene: moment, 95 % region, and track of the last seconds."""

    def __init__(self, scene: viser.SceneApi, name: str, array: SensorArray, colour: Colour, region: Colour) -> None:
        size = 0.5 * array.circumradius
        self.dipole = DipoleGlyph(scene, f"{name}/moment", size, DIPOLE_COLOUR)
        self._tail = add_lines(scene, f"{name}/tail", np.zeros((1, 2, 3)), colour, 3.0, visible=False)
        self._region = SurfaceGlyph(scene, f"{name}/region", region, 0.35)

    def show(self, point: TrackPoint | None, recent: Sequence[TrackPoint]) -> None:
        """Show the present source, if it is known, and its last points."""
        position, moment = (None, None) if point is None else (point.position_m, point.moment_Am2)
        self.dipole.show(NOWHERE if position is None else position, NOWHERE if moment is None else moment)
        covariance = None if point is None else point.covariance
        self._region.show(None if position is None or covariance is None else ellipsoid(position, covariance[:3, :3]))
        segments = line_segments(track_column(recent, "position_m", 3)) if len(recent) > 1 else np.zeros((0, 2, 3))
        show_segments(self._tail, segments)


class LivePage:
    """Page that draws the newest row in a separate thread, so that the caller never waits.

    Parameters
    ----------
    server : viser.ViserServer
    array : SensorArray
    controls : Controls, optional
        Object of the buttons; without it there are none.
    """

    def __init__(self, server: viser.ViserServer, array: SensorArray, controls: Controls | None) -> None:
        self._server, self._array, self._controls = server, array, controls
        self._lock = Lock()
        self._is_plotted, self._plot_time_s = True, 0.0
        self._newest: LiveRow | None = None
        self._tally: Tally | None = None
        self._latency_s = math.nan
        self._window: deque[LiveRow] = deque(maxlen=_MOST_ROWS + 1)
        self._arrivals: deque[float] = deque(maxlen=_RATE_ROWS)
        self._glyphs = ArrayGlyphs(server.scene, array)
        self._sources = {SINGLE_ID: LiveSource(server.scene, "/live", array, TRACK_COLOUR, REGION_COLOUR)}
        self._frame = add_lines(server.scene, "/live/body", np.zeros((1, 2, 3)), DIPOLE_COLOUR, 2.0, visible=False)
        self._add_panels()
        self._thread = DrawingThread(self._draw, _FRAMES_PER_SECOND)

    def entries(self) -> list[Entry]:
        """Return the entries of the legend."""
        return [
            Swatch(DIPOLE_COLOUR, "the source now: the arrow is its moment"),
            Swatch(TRACK_COLOUR, f"its track of the last {WINDOW_S:g} s; of several each has a colour"),
            Swatch(REGION_COLOUR, "95 % region of its position"),
        ]

    def update(self, point: TrackPoint | SourcesPoint, row: Row | None, tally: Tally | None, latency_s: float) -> None:
        """Set the newest row; rows that have not been drawn yet are skipped."""
        newest = LiveRow(point, row)
        with self._lock:
            self._newest, self._tally, self._latency_s = newest, tally, latency_s
            self._arrivals.append(perf_counter())
            window = self._window
            if window and point.time_s < window[-1].point.time_s:  # the sender's clock was set back
                window.clear()
            if not window or point.time_s - window[-1].point.time_s >= WINDOW_S / _MOST_ROWS:
                window.append(newest)
        self._thread.wake()

    def close(self) -> None:
        """End the thread. Call this before the server is stopped."""
        self._thread.close()

    def _add_panels(self) -> None:
        gui = self._server.gui
        if self._controls is not None:  # above the panels of variable height
            with gui.add_folder("Follow"):
                self._switch = gui.add_button("Stop", hint="Stop tracking until Start; rows are still counted.")
                self._tare = gui.add_button("Tare", hint="Subtract the mean of the next seconds from later readings.")
                self._rest = gui.add_number("Rest [s]", _REST_S, min=0.1, max=600.0, step=0.1)
                self._message = gui.add_html("")
                self._switch.on_click(self._on_switch)
                self._tare.on_click(self._on_tare)
        with gui.add_folder("Source"):
            self._source_panel = gui.add_html(texts.panel_html(["no row yet"]))
        with gui.add_folder("Stream"):
            self._stream_panel = gui.add_html(texts.panel_html(["no row yet"]))
        empty = Readings(np.full((1, self._array.n_channels), np.nan))
        self._plot = ReadingsPlot(self._server, empty, self._array, residuals_T=empty.values_T, window_s=WINDOW_S)

    def _on_switch(self, _: object) -> None:
        assert self._controls is not None
        if self._switch.label == "Stop":
            self._controls.stop()
            self._switch.label = "Start"
        else:
            self._controls.start()
            self._switch.label = "Stop"

    def _on_tare(self, _: object) -> None:
        assert self._controls is not None
        try:
            self._controls.tare(float(self._rest.value))
            self._message.content = ""
        except InputError as error:
            self._message.content = texts.panel_html([escape(str(error))], warning=True)

    def _draw(self, is_new: bool) -> float | None:
        """Draw the newest row and, less often, the plots; return the time until the next pending plot [s]."""
        with self._lock:
            newest, window = self._newest, list(self._window)
        if newest is None:
            return None
        if is_new:
            with self._server.atomic():
                self._show(newest, window)
            self._is_plotted = False
        if perf_counter() - self._plot_time_s >= _PLOT_S:
            self._show_plot(window)
            self._is_plotted, self._plot_time_s = True, perf_counter()
        return None if self._is_plotted else _PLOT_S

    def _show(self, newest: LiveRow, window: Sequence[LiveRow]) -> None:
        """Show the newest row in the scene and in the panels."""
        point, row = newest.point, newest.row
        if row is not None:
            self._glyphs.set_pose(row.origin_m, Rotation.from_matrix(row.R_world_from_array).as_quat())
        recent = [each.point for each in window if each.point.time_s >= point.time_s - WINDOW_S]
        now = sources_by_id(point)
        for id in now:
            if id not in self._sources:
                colour = SOURCE_COLOURS[(id - 1) % len(SOURCE_COLOURS)]
                self._sources[id] = LiveSource(self._server.scene, f"/live/{id}", self._array, colour, colour)
        for id, source in self._sources.items():
            missing = TrackPoint(point.time_s)
            source.show(now.get(id), [sources_by_id(each).get(id, missing) for each in recent])
        show_segments(self._frame, magnet_segments(point))
        self._source_panel.content = sources_html(point)
        self._stream_panel.content = texts.panel_html(self._stream_lines())

    def _stream_lines(self) -> list[str]:
        """Return lines with rate, latency and counts."""
        with self._lock:
            arrivals, tally, latency_s = list(self._arrivals), self._tally, self._latency_s
        lines = []
        if len(arrivals) > 1 and arrivals[-1] > arrivals[0]:
            lines.append(f"{(len(arrivals) - 1) / (arrivals[-1] - arrivals[0]):.3g} rows/s")
        if math.isfinite(latency_s):
            lines.append(f"latency {1e3 * latency_s:.2g} ms")
        if tally is not None:
            lines.append(f"{tally.rows} rows, {tally.tracked} tracked")
            lines.append(f"{tally.lost} lost, {tally.late} late, {tally.doubled} doubled, {tally.garbled} garbled")
            if tally.skipped:
                lines.append(f"{tally.skipped} skipped")
        return lines

    def _show_plot(self, window: Sequence[LiveRow]) -> None:
        """Show readings and residuals of the last seconds."""
        last_s = window[-1].point.time_s if window else 0.0
        shown = [(each.point, each.row) for each in window if each.point.time_s >= last_s - WINDOW_S]
        rows = [row for _, row in shown if row is not None]
        if len(rows) != len(shown) or not rows:
            return
        values = np.array([row.readings_T for row in rows])
        origins, R = np.array([row.origin_m for row in rows]), np.array([row.R_world_from_array for row in rows])
        time_s = np.array([point.time_s for point, _ in shown]) - last_s
        readings = Readings(values, time_s=time_s, array_position_m=origins, array_rotation=Rotation.from_matrix(R))
        bodies = [body_of(point) for point, _ in shown]
        if any(bodies):
            predicted = np.array([body_readings(self._array, each) for each in bodies])
            self._plot.replace_readings(readings, values - predicted)
            return
        of_rows = [sources_by_id(point) for point, _ in shown]
        residuals_T = np.where(np.array([[bool(sources)] for sources in of_rows]), values, np.nan)
        for id in set().union(*of_rows):
            has_source = np.array([id in sources for sources in of_rows])
            points = [sources[id] for sources in of_rows if id in sources]
            source = track_column(points, "position_m", 3), track_column(points, "moment_Am2", 3)
            residuals_T[has_source] += residuals_of(self._array, readings[has_source], *source) - values[has_source]
        self._plot.replace_readings(readings, residuals_T)


def sources_by_id(point: TrackPoint | SourcesPoint) -> dict[int, TrackPoint]:
    """Return the sources by their ids."""
    several = point.sources if isinstance(point, LivePoint) else point
    if isinstance(several, SourcesPoint):
        return {source.id: source for source in several.tracks}
    assert isinstance(point, TrackPoint)
    return {SINGLE_ID: point}


def body_of(point: TrackPoint | SourcesPoint) -> BodyPoint | None:
    """Return the pose of a body, None for other sources and for a row without a body."""
    several = point.sources if isinstance(point, LivePoint) else point
    return several if isinstance(several, BodyPoint) else None


def body_readings(array: SensorArray, point: BodyPoint | None) -> FloatArray:
    """Return the readings (C,) that a pose predicts, NaN without one."""
    if point is None or not point.tracks:
        return np.full(array.n_channels, np.nan)
    poses = point.poses
    fields = body_fields(point.body, array.positions, poses.position_m[0, 0], poses.R[0, 0])
    return array.readings_of(fields) - array.channel_offset_T


def magnet_segments(point: TrackPoint | SourcesPoint) -> FloatArray:
    """Return lines (n, 2, 3) between all magnets of a body, none for other sources."""
    body = body_of(point)
    if body is None or not body.tracks:
        return np.zeros((0, 2, 3))
    places = np.array([magnet.position_m for magnet in body.tracks])
    return np.stack([places[list(pair)] for pair in combinations(range(len(places)), 2)])


def body_html(point: BodyPoint) -> str:
    """Return the pose of a body with its standard deviations as HTML."""
    poses = point.poses
    lines = [f"time {point.time_s:.3f} s"]
    if not point.tracks:
        return texts.panel_html([*lines, f"<b>not tracked</b>: {escape(point.status)}"], warning=True)
    turn = np.degrees(poses.rotation.as_rotvec()[0])
    sigma = np.sqrt(np.diagonal(poses.covariance[0, 0]))
    lines.append(f"{escape(point.status)} at {texts.position_text(poses.position_m[0, 0])}")
    x, y, z = (length_text(each) for each in sigma[:3].tolist())
    lines.append(f"σ x {x}, y {y}, z {z}")
    lines.append(f"rotation vector ({', '.join(f'{each:.2f}' for each in turn)})°")
    lines.append(f"σ of the rotation ({', '.join(f'{each:.2g}' for each in np.degrees(sigma[3:]))})°")
    lines.append(f"NIS/dof {point.chi2:.3g}/{point.dof}")
    return texts.panel_html([*lines, *map(escape, poses.flags[0])], warning=bool(poses.flags[0]))


def sources_html(point: TrackPoint | SourcesPoint) -> str:
    """Return the states of the sources as HTML."""
    body = body_of(point)
    if body is not None:
        return body_html(body)
    time = f"time {point.time_s:.3f} s"
    sources = sources_by_id(point)
    if SINGLE_ID in sources:
        return point_html(sources[SINGLE_ID], time)
    known = [point_html(source, f"source {id}") for id, source in sources.items()]
    return "".join([texts.panel_html([time, escape(point.status)], warning=not known), *known])
