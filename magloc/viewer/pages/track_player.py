"""A track played through time: slider, play and pause, speed, tail.

Use, inside a tab or folder of the GUI::

    player = TrackPlayer(
        server,
        points,                              # sequence of TrackPoint in the order of time, one for every row
        size_m,                              # length of the arrow [m]
        array_poses=(position_m (n, 3), rotation_xyzw (n, 4)) or None,     # where the readings hold them, row by row
        on_pose=glyphs.set_pose,             # called with (position_m, rotation_xyzw) of the row
        on_row=[readings_plot.show_row],     # called with the index of the row
    )
    player.show_row(index)
    player.play()
    player.pause()                           # ends the playing thread; call it before server.stop()
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from html import escape

import numpy as np
import viser
from matplotlib import colormaps
from numpy.typing import NDArray

from arrays.typing import ByteArray, FloatArray
from magloc.tracking.results import TrackPoint, stacked
from magloc.viewer.pages import words
from magloc.viewer.panels.played_time import PlayedTime, time_strip
from magloc.viewer.scene.glyphs import (
    DIPOLE_COLOUR,
    TRACK_COLOUR,
    DipoleGlyph,
    length_text,
    screen_label,
    screen_lines,
)
from magloc.viewer.scene.ruler import DropLines
from magloc.viewer.scene.track_glyph import TrackGlyph, track_segments

Poses = tuple[FloatArray, FloatArray]
_BRIGHTEST = 0.88
_WHOLE_COLOUR = (190, 196, 203)


class TrackPlayer(PlayedTime):
    """A track in the scene at one time, and the panels that move the time.

    Parameters
    ----------
    server : viser.ViserServer
        The panels are added where its GUI is at present.
    points : sequence of TrackPoint
        In the order of time.
    size_m : float
        Length of the moment's arrow [m].
    array_poses : tuple of ndarrays, shapes (n, 3) and (n, 4), optional
        Position [m] and rotation (xyzw) of the array in every row.
    on_pose : callable, optional
        Called with the pose of the array in the row that is shown.
    on_row : sequence of callable
        Called with the index of the row that is shown.
    name : str
        Of the scene node that holds the track.

    Attributes
    ----------
    index : int
        Row that is shown.
    drop : DropLines
        From the source at this time to the floor.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        points: Sequence[TrackPoint],
        size_m: float,
        *,
        array_poses: Poses | None = None,
        on_pose: Callable[[FloatArray, FloatArray], None] | None = None,
        on_row: Sequence[Callable[[int], None]] = (),
        name: str = "/track",
    ) -> None:
        self._server, self.points = server, points
        self._poses, self._on_pose, self._on_row = array_poses, on_pose, on_row
        time = stacked(points, "time_s")
        self._since_first_s = time - time[0]
        self._span_s = float(self._since_first_s[-1])
        positions, self._moments = stacked(points, "position_m", 3), stacked(points, "moment_Am2", 3)
        self._tracked = np.array([point.position_m is not None for point in points])
        whole = positions[track_segments(positions, 0, len(positions) - 1)]
        self.whole = screen_lines(server.scene, f"{name}/whole", whole, _WHOLE_COLOUR, 1.0)
        has_any = any(point.covariance is not None for point in points)
        covariances = stacked(points, "covariance", 6, 6)[:, :3, :3] if has_any else None
        self.glyph = TrackGlyph(
            server.scene, f"{name}/tail", positions, covariances, size_m=0.15 * size_m, colours=time_colours(time)
        )
        self.dipole = DipoleGlyph(server.scene, f"{name}/moment", size_m, DIPOLE_COLOUR)
        self.drop = DropLines(server.scene, f"{name}/drop", DIPOLE_COLOUR)
        self.time_label = screen_label(server.scene, f"{name}/now", "", np.zeros(3), "center-left")
        tracked = np.flatnonzero(self._tracked)
        self._ends = {int(row) for row in tracked[[0, -1]]} if tracked.size else set()  # which have times of their own
        self.index = int(tracked[-1]) if self._tracked.any() else 0
        self._add_panels(server.gui)
        self.show_row(self.index)

    def show_row(self, index: int) -> None:
        """Show the track at the time of a row.

        Parameters
        ----------
        index : int
            Rows before the first and after the last are those.
        """
        index = min(max(index, 0), len(self.points) - 1)
        self.move_to(float(self._since_first_s[index]))

    def _add_panels(self, gui: viser.GuiApi) -> None:
        with gui.add_folder("Time"):
            self.strip_panel = gui.add_html(_strip(self._since_first_s, self._tracked))
            super().__init__(gui, self._span_s, self._show, "magloc-track-player")
            self.row_buttons = gui.add_button_group("Row", ("previous", "next"))
            longest, still = self.time_slider.max, self.time_slider.disabled
            self.tail_slider = gui.add_slider(
                "Tail [s]", 0.0, longest, self.step_s, longest, disabled=still, hint="length of the tail"
            )
            self.whole_checkbox = gui.add_checkbox("Whole track", True, hint="a thin line, of all times")
        with gui.add_folder("At this time"):
            self.row_panel = gui.add_html("")
        self.row_buttons.on_click(lambda _: self._step_row(self.row_buttons.value))
        self.tail_slider.on_update(self._follow)
        self.whole_checkbox.on_update(self._follow)

    def _step_row(self, direction: str) -> None:
        self.pause()
        self.show_row(self.index + (1 if direction == "next" else -1))

    def _show_rest(self, first: int, last: int) -> None:
        """The thin line before and after the tail, not through it."""
        positions = self.glyph.positions_m
        parts = ((0, first), (last, len(positions) - 1))
        ends = np.concatenate([track_segments(positions, *part) for part in parts])
        self.whole.visible = self.whole_checkbox.value and bool(len(ends))
        if len(ends):
            self.whole.points = positions[ends].astype(np.float32)

    def _show(self) -> None:
        index = max(0, int(np.searchsorted(self._since_first_s, self.now_s, side="right")) - 1)
        self.index, point, now = index, self.points[index], float(self._since_first_s[index])
        first = int(np.searchsorted(self._since_first_s, now - self.tail_slider.value - 1e-9 * self._span_s))
        with self._server.atomic():
            self.glyph.show_until(index, index - first)
            self._show_rest(first, index)
        self.dipole.show(self.glyph.positions_m[index], self._moments[index])
        self.drop.show(self.glyph.positions_m[index])
        self.time_label.visible = bool(self._tracked[index]) and index not in self._ends
        if self.time_label.visible:
            self.time_label.text, self.time_label.position = f"   {point.time_s:.6g} s", self.glyph.positions_m[index]
        if self._poses is not None and self._on_pose is not None:
            self._on_pose(self._poses[0][index], self._poses[1][index])
        self._time.show(now)
        self.row_panel.content = row_words(point, index, len(self.points))
        for follow in self._on_row:
            follow(index)


def time_colours(time_s: FloatArray) -> ByteArray:
    """Colours (n, 3) of times (n,), evenly from the first to the last."""
    span = float(time_s[-1] - time_s[0])
    share = (time_s - time_s[0]) / span if span > 0.0 else np.zeros_like(time_s)
    # To where it is still seen on white.
    return np.asarray(colormaps["viridis"](_BRIGHTEST * share, bytes=True)[:, :3], dtype=np.uint8)


def row_words(point: TrackPoint, index: int, n_rows: int) -> str:
    """What is known of the source in one row, as HTML."""
    return point_words(point, f"row {index + 1} of {n_rows}, time {point.time_s:.3f} s")


def point_words(point: TrackPoint, when: str) -> str:
    """What is known of the source at a time, as HTML."""
    lines = [when]
    if point.position_m is None:
        return words.panel([*lines, f"<b>not tracked</b>: {escape(point.status or 'no reason given')}"], warning=True)
    lines.append(f"{escape(point.status)} at {words.place(point.position_m)}")
    if point.covariance is not None:
        x, y, z = (length_text(sigma) for sigma in np.sqrt(np.diagonal(point.covariance)[:3]).tolist())
        lines.append(f"σ x {x}, y {y}, z {z}")
    if point.moment_Am2 is not None:
        lines.append(f"moment {float(np.linalg.norm(point.moment_Am2)):.4g} A·m²")
    if np.isfinite(point.nis) and point.nis_dof:
        lines.append(f"NIS/dof {point.nis:.3g}/{point.nis_dof}")
    return words.panel(lines)


def _strip(since_first_s: FloatArray, tracked: NDArray[np.bool_]) -> str:
    """A strip along the time, coloured where the source is tracked."""
    text = f"tracked in {int(tracked.sum())} of {len(tracked)} rows" + ("" if tracked.all() else "; grey: not tracked")
    return words.panel([time_strip(since_first_s, tracked, TRACK_COLOUR), text])
