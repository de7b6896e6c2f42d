"""Player of tracks: time, speed and tail.

Use, inside a tab or folder of the GUI::

    player = TrackPlayer(
        server,
        TrackResult(points, is_truth=False), # of one source or several
        size_m,                              # length of the arrow [m]
        array_poses=(position_m (n, 3), rotation_xyzw (n, 4)) or None,     # of every row
        on_pose=glyphs.set_pose,             # called with (position_m, rotation_xyzw) of the row
        on_row=[readings_plot.show_row],     # called with the index of the row
    )
    player.show_row(index)
    player.play()
    player.pause()                           # ends the thread; call it before server.stop()
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from html import escape
from itertools import cycle

import numpy as np
import viser
from matplotlib import colormaps
from numpy.typing import NDArray

from arrays.typing import BoolArray, ByteArray, FloatArray
from magloc.tracking.results import TrackPoint, TrackResult, track_column
from magloc.viewer.pages import texts
from magloc.viewer.panels.events import EventButtons, rows_of_change
from magloc.viewer.panels.time_player import TimePlayer, time_strip
from magloc.viewer.scene.glyphs import (
    ARROW_COLOUR,
    DIPOLE_COLOUR,
    FIELD_LINE_COLOUR,
    OTHER_COLOUR,
    REGION_COLOUR,
    TRACK_COLOUR,
    Colour,
    DipoleGlyph,
    add_label,
    add_lines,
    length_text,
    show_segments,
)
from magloc.viewer.scene.ruler import DropLines
from magloc.viewer.scene.track_glyph import TrackGlyph, track_segments

Poses = tuple[FloatArray, FloatArray]
_DARKEST, _BRIGHTEST = 0.12, 0.88  # visible on a dark page and on white
_WHOLE_COLOUR = (190, 196, 203)
SOURCE_COLOURS: tuple[Colour, ...] = (TRACK_COLOUR, FIELD_LINE_COLOUR, ARROW_COLOUR, OTHER_COLOUR, REGION_COLOUR)


class Trail:
    """Source in the scene: whole track, and tail, ellipsoid, moment and mark at one time.

    Parameters
    ----------
    scene : viser.SceneApi
    name : str
        Name of the parent node.
    points : sequence of TrackPoint
    size_m : float
        Length of the moment's arrow [m].
    colour : tuple of 3 ints, optional
        Colour of the line; by default it is coloured by time.
    """

    def __init__(
        self, scene: viser.SceneApi, name: str, points: Sequence[TrackPoint], size_m: float, colour: Colour | None
    ) -> None:
        positions, self._moments = track_column(points, "position_m", 3), track_column(points, "moment_Am2", 3)
        self.tracked: BoolArray = np.array(np.isfinite(positions).all(axis=1))
        self._whole_m = positions[track_segments(positions, 0, len(positions) - 1)]
        self.whole = add_lines(scene, f"{name}/whole", self._whole_m, _WHOLE_COLOUR, 1.0)
        has_any = any(point.covariance is not None for point in points)
        covariances = track_column(points, "covariance", 6, 6)[:, :3, :3] if has_any else None
        shades = time_colours(track_column(points, "time_s")) if colour is None else None
        self.glyph = TrackGlyph(
            scene,
            f"{name}/tail",
            positions,
            covariances,
            size_m=0.15 * size_m,
            colour=TRACK_COLOUR if colour is None else colour,
            colours=shades,
        )
        self.dipole = DipoleGlyph(scene, f"{name}/moment", size_m, DIPOLE_COLOUR)
        self.drop = DropLines(scene, f"{name}/drop", DIPOLE_COLOUR)
        self.label = add_label(scene, f"{name}/now", "", np.zeros(3), "center-left")

    def show(self, first: int, last: int, text: str) -> None:
        """Show the rows of the tail, and the source at the last of them with an optional label."""
        positions = self.glyph.positions_m
        self.glyph.show_until(last, last - first)
        self.dipole.show(positions[last], self._moments[last])
        self.drop.show(positions[last])
        self.label.visible = bool(self.tracked[last]) and bool(text)
        if self.label.visible:
            self.label.text, self.label.position = f"   {text}", positions[last]

    def show_rest(self, first: int, last: int, *, visible: bool) -> None:
        """Show or hide the thin line before and after the tail."""
        positions = self.glyph.positions_m
        parts = ((0, first), (last, len(positions) - 1))
        ends = np.concatenate([track_segments(positions, *part) for part in parts])
        show_segments(self.whole, positions[ends if visible else ends[:0]])


class TrackPlayer(TimePlayer):
    """Player of tracks in the scene.

    Parameters
    ----------
    server : viser.ViserServer
        The panels are added to the present container of its GUI.
    result : TrackResult
        Tracks with points in the order of time.
    size_m : float
        Length of the moments' arrows [m].
    array_poses : tuple of ndarrays, shapes (n, 3) and (n, 4), optional
        Position [m] and rotation (xyzw) of the array in every row.
    on_pose : callable, optional
        Called with the pose of the array in the present row.
    on_row : sequence of callable
        Called with the index of the present row.

    Attributes
    ----------
    index : int
        Present row.
    trails : tuple of Trail
        Sources in the scene.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        result: TrackResult,
        size_m: float,
        *,
        array_poses: Poses | None = None,
        on_pose: Callable[[FloatArray, FloatArray], None] | None = None,
        on_row: Sequence[Callable[[int], None]] = (),
    ) -> None:
        self._server, self._result, points = server, result, result.points
        self._poses, self._on_pose, self._on_row = array_poses, on_pose, on_row
        time = track_column(points, "time_s")
        self._since_first_s = time - time[0]
        self._span_s = float(self._since_first_s[-1])
        nodes = [f"/track-{id}" for id in result.ids] or ["/track"]
        self.trails = tuple(
            Trail(server.scene, name, track, size_m, colour)
            for name, track, colour in zip(nodes, result.tracks, source_colours(result), strict=True)
        )
        self._tracked = np.any([trail.tracked for trail in self.trails], axis=0)
        tracked = np.flatnonzero(self._tracked)
        self._labelled_rows = (
            {int(row) for row in tracked[[0, -1]]} if tracked.size else set()
        )  # rows with labels of their times
        self.index = int(tracked[-1]) if tracked.size else 0
        self._add_panels(server.gui)
        self.show_row(self.index)

    def show_row(self, index: int) -> None:
        """Show the track at the time of a row.

        Parameters
        ----------
        index : int
            Row; it is limited to the track.
        """
        index = min(max(index, 0), len(self._since_first_s) - 1)
        self.move_to(float(self._since_first_s[index]))

    def _add_panels(self, gui: viser.GuiApi) -> None:
        with gui.add_folder("Time"):
            self.strip_panel = gui.add_html(_strip_html(self._since_first_s, self._tracked))
            super().__init__(gui, self._span_s, self._show, "magloc-track-player")
            self.row_buttons = gui.add_button_group("Row", ("previous", "next"))
            self.events = EventButtons(
                gui, rows_of_change(_row_states(self._result)), lambda: self.index, self.choose,
                "Rows in which a source is found or lost, or the status changes. Keys: E, and Shift E.",
            )  # fmt: skip
            longest, still = self.time_slider.max, self.time_slider.disabled
            self.tail_slider = gui.add_slider(
                "Tail [s]", 0.0, longest, self.step_s, longest, disabled=still, hint="length of the tail"
            )
            self.whole_checkbox = gui.add_checkbox("Whole track", True, hint="a thin line, for all times")
        with gui.add_folder("At this time"):
            self.row_panel = gui.add_html("")
        self.row_buttons.on_click(lambda _: self._step_row(1 if self.row_buttons.value == "next" else -1))
        gui.add_command("Next row", hotkey="pagedown").on_trigger(lambda _: self._step_row(1))
        gui.add_command("Previous row", hotkey="pageup").on_trigger(lambda _: self._step_row(-1))
        self.tail_slider.on_update(self._follow)
        self.whole_checkbox.on_update(self._follow)

    def choose(self, index: int) -> None:
        """Show a row that the user has selected, and pause."""
        self.pause()
        self.show_row(index)

    def _step_row(self, step: int) -> None:
        self.choose(self.index + step)

    def _label(self, source: int) -> str:
        """Return the label of a source: its id, or the time if the row has no other label."""
        if self._result.ids:
            return str(self._result.ids[source])
        return "" if self.index in self._labelled_rows else f"{self._result.points[self.index].time_s:.6g} s"

    def _show(self) -> None:
        index = max(0, int(np.searchsorted(self._since_first_s, self.now_s, side="right")) - 1)
        self.index, now = index, float(self._since_first_s[index])
        first = int(np.searchsorted(self._since_first_s, now - self.tail_slider.value - 1e-9 * self._span_s))
        with self._server.atomic():
            for source, trail in enumerate(self.trails):
                trail.show(first, index, self._label(source))
                trail.show_rest(first, index, visible=self.whole_checkbox.value)
        if self._poses is not None and self._on_pose is not None:
            self._on_pose(self._poses[0][index], self._poses[1][index])
        self._time.show(now)
        self.row_panel.content = row_html(self._result, index)
        for call in self._on_row:
            call(index)


def time_colours(time_s: FloatArray) -> ByteArray:
    """Return the colours (n, 3) of times (n,), evenly from the first to the last."""
    span = float(time_s[-1] - time_s[0])
    share = (time_s - time_s[0]) / span if span > 0.0 else np.zeros_like(time_s)
    return np.asarray(
        colormaps["viridis"](_DARKEST + (_BRIGHTEST - _DARKEST) * share, bytes=True)[:, :3], dtype=np.uint8
    )


def source_colours(result: TrackResult) -> list[Colour | None]:
    """Return the colour of every source; None for a single one, which is coloured by time."""
    return [colour for colour, _ in zip(cycle(SOURCE_COLOURS), result.ids, strict=False)] or [None]


def row_html(result: TrackResult, index: int) -> str:
    """Return the states of the sources in one row as HTML."""
    time = f"row {index + 1} of {len(result.points)}, time {result.points[index].time_s:.3f} s"
    if not result.ids:
        return point_html(result.points[index], time)
    now = [(id, track[index]) for id, track in zip(result.ids, result.tracks, strict=True)]
    known = [point_html(point, f"{result.kind} {id}") for id, point in now if point.position_m is not None]
    return "".join([texts.panel_html([time]), *known])


def point_html(point: TrackPoint, title: str) -> str:
    """Return the state of a source as HTML, below a title."""
    lines = [title]
    if point.position_m is None:
        return texts.panel_html(
            [*lines, f"<b>not tracked</b>: {escape(point.status or 'no reason given')}"], warning=True
        )
    without = "".join(f", without {name}" for name in point.dropped_sensors)
    lines.append(f"{escape(point.status + without)} at {texts.position_text(point.position_m)}")
    if point.covariance is not None:
        x, y, z = (length_text(sigma) for sigma in np.sqrt(np.diagonal(point.covariance)[:3]).tolist())
        lines.append(f"σ x {x}, y {y}, z {z}")
    if point.moment_Am2 is not None:
        lines.append(f"moment {float(np.linalg.norm(point.moment_Am2)):.4g} A·m²")
    if np.isfinite(point.nis) and point.nis_dof:
        lines.append(f"NIS/dof {point.nis:.3g}/{point.nis_dof}")
    return texts.panel_html(lines)


def _row_states(result: TrackResult) -> list[tuple[object, ...]]:
    """Return the states of every row whose changes are events."""
    each = [[(point.position_m is None, point.status, point.dropped_sensors) for point in t] for t in result.tracks]
    return list(zip(*each, strict=True))


def _strip_html(since_first_s: FloatArray, tracked: NDArray[np.bool_]) -> str:
    """Return a strip along the time, coloured where the source is tracked."""
    text = f"tracked in {int(tracked.sum())} of {len(tracked)} rows" + ("" if tracked.all() else "; grey: not tracked")
    return texts.panel_html([time_strip(since_first_s, tracked, TRACK_COLOUR), text])
