"""What heights and distances are read from: labelled axes around the scene, and lines that drop to its floor."""

from __future__ import annotations

import numpy as np
import viser
from numpy.typing import ArrayLike

from arrays.typing import FloatArray
from magloc.viewer.scene.framing import Extent, Floor
from magloc.viewer.scene.glyphs import Colour, LabelAnchor, length_unit, round_length, screen_label, screen_lines

_RULER_COLOUR: Colour = (110, 116, 124)
_TICKS = 4.0
_TICK_OF_STEP = 0.12
_MOST_NUMBERS = 5
_FOOT_OF_RADIUS = 0.02


def add_ruler(scene: viser.SceneApi, extent: Extent, floor: Floor, name: str = "/ruler") -> FloatArray:
    """Axes with numbers around all that should be in view: x in front, y to the right, z to the left.

    These are the edges that the first camera sees at the border; the last number of each says its name. Numbers are
    as large on a phone, where an edge is a hundred pixels long, so that they are few. Returns the ends (6, 3).
    """
    low, high = extent.points_m.min(axis=0), extent.points_m.max(axis=0)
    low[2] = floor.height_m
    step = round_length(max(float((high - low).max()), 1e-9) / _TICKS)
    low, high = step * np.floor(low / step + 1e-9), step * np.ceil(high / step - 1e-9)
    high = np.maximum(high, low + step)
    low[2] = floor.height_m
    unit, metres = length_unit(0.1 * float((high - low).max()))
    tick = _TICK_OF_STEP * step
    left, right, front = low[0], high[0], low[1]
    # Of every axis: where its numbers are from, the way its ticks point, and the side of its labels.
    edges: tuple[tuple[list[float], list[float], LabelAnchor], ...] = (
        ([left, front, low[2]], [0.0, -tick, 0.0], "center-right"),
        ([right, front, low[2]], [tick, 0.0, 0.0], "center-left"),
        ([left, front, low[2]], [-tick, 0.0, 0.0], "center-right"),
    )
    segments: list[list[FloatArray]] = []
    corners: list[FloatArray] = []
    for i, (begin, outwards, anchor) in enumerate(edges):
        axis, ends = "xyz"[i], np.array([begin, begin])
        ends[1, i] = high[i]
        segments.append(list(ends))
        corners += list(ends)
        every = step if high[i] - low[i] < (_MOST_NUMBERS + 0.5) * step else 2.0 * step
        # Where an axis begins, the one before has its last number, or its first; near its end it has its name.
        first = np.floor(low[i] / every + 1e-9) + 1.0 if i > 0 else np.ceil(low[i] / every - 1e-9)
        for value in (*(every * np.arange(first, np.ceil(high[i] / every - 0.6))), high[i]):
            place = np.array(begin)
            place[i] = value
            segments.append([place, place + outwards])
            number = f"{round(value / metres, 9) + 0.0:.6g}"
            words = f"{axis} = {number} {unit}" if value == high[i] else number
            screen_label(scene, f"{name}/{axis}/{number}", words, place + 2.0 * np.array(outwards), anchor)
    screen_lines(scene, f"{name}/edges", np.array(segments), _RULER_COLOUR, 1.2)
    return np.array(corners)


class DropLines:
    """Lines from points of the scene straight down, or up, to its floor, with a cross where they meet it.

    Parameters
    ----------
    scene : viser.SceneApi
    name : str
        Of the node.
    colour : tuple of 3 ints
    """

    def __init__(self, scene: viser.SceneApi, name: str, colour: Colour = _RULER_COLOUR) -> None:
        self._lines = screen_lines(scene, name, np.zeros((1, 2, 3)), colour, 1.5, visible=False)
        self._points = np.zeros((0, 3))
        self._height_m: float | None = None
        self._foot_m = 0.0

    def stand_on(self, floor: Floor, extent: Extent) -> None:
        """Say where the floor is; before, nothing is seen."""
        self._height_m, self._foot_m = floor.height_m, _FOOT_OF_RADIUS * extent.radius_m
        self.show(self._points)

    def show(self, points_m: ArrayLike) -> None:
        """Move them.

        Parameters
        ----------
        points_m : array-like, shape (k, 3)
            Those that are not finite have no line [m].
        """
        points = np.asarray(points_m, dtype=np.float64).reshape(-1, 3)
        self._points = points[np.isfinite(points).all(axis=1)]
        if self._height_m is None:
            return
        self._lines.visible = bool(len(self._points))
        if not len(self._points):
            return
        feet = self._points.copy()
        feet[:, 2] = self._height_m
        crosses = [(feet - arm, feet + arm) for arm in self._foot_m * np.eye(3)[:2]]
        segments = np.concatenate([np.stack(ends, axis=1) for ends in ((self._points, feet), *crosses)])
        self._lines.points = segments.astype(np.float32)
