"""Rulers of a scene: labelled axes around it, and vertical lines from points to its floor."""

from __future__ import annotations

import numpy as np
import viser
from numpy.typing import ArrayLike

from arrays.typing import FloatArray
from magloc.viewer.scene.framing import Extent, Floor
from magloc.viewer.scene.glyphs import (
    Colour,
    LabelAnchor,
    add_label,
    add_lines,
    length_unit,
    round_length,
    show_segments,
)

_RULER_COLOUR: Colour = (110, 116, 124)
_TICKS = 4.0
_TICK_LENGTH = 0.12  # in steps
_MOST_NUMBERS = 5
_CROSS_SIZE = 0.02  # in radii of the scene


def add_ruler(scene: viser.SceneApi, extent: Extent, floor: Floor) -> FloatArray:
    """Add labelled axes at the edges of an extent, and return their ends (6, 3).

    The x axis is in front, y at the right and z at the left: the first camera sees these edges at the border. The last
    number of an axis has its name. An axis has few numbers, because on a phone it is only a hundred pixels long.
    """
    low, high = extent.points_m.min(axis=0), extent.points_m.max(axis=0)
    low[2] = floor.height_m
    step = round_length(max(float((high - low).max()), 1e-9) / _TICKS)
    low, high = step * np.floor(low / step + 1e-9), step * np.ceil(high / step - 1e-9)
    high = np.maximum(high, low + step)
    low[2] = floor.height_m
    unit, metres = length_unit(0.1 * float((high - low).max()))
    tick = _TICK_LENGTH * step
    left, right, front = low[0], high[0], low[1]
    # Begin of every axis, vector of its ticks, and anchor of its labels.
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
        # The first number of y and z would overlap those of x and y, and the last one has the name of the axis.
        first = np.floor(low[i] / every + 1e-9) + 1.0 if i > 0 else np.ceil(low[i] / every - 1e-9)
        for value in (*(every * np.arange(first, np.ceil(high[i] / every - 0.6))), high[i]):
            place = np.array(begin)
            place[i] = value
            segments.append([place, place + outwards])
            number = f"{round(value / metres, 9) + 0.0:.6g}"
            text = f"{axis} = {number} {unit}" if value == high[i] else number
            add_label(scene, f"/ruler/{axis}/{number}", text, place + 2.0 * np.array(outwards), anchor)
    add_lines(scene, "/ruler/edges", np.array(segments), _RULER_COLOUR, 1.2)
    return np.array(corners)


class DropLines:
    """Vertical lines from points to the floor, with a cross on the floor.

    Parameters
    ----------
    scene : viser.SceneApi
    name : str
        Name of the node.
    colour : tuple of 3 ints
    """

    def __init__(self, scene: viser.SceneApi, name: str, colour: Colour = _RULER_COLOUR) -> None:
        self._lines = add_lines(scene, name, np.zeros((1, 2, 3)), colour, 1.5, visible=False)
        self._points = np.zeros((0, 3))
        self._height_m: float | None = None
        self._cross_m = 0.0

    def set_floor(self, floor: Floor, extent: Extent) -> None:
        """Set the floor; without it there are no lines."""
        self._height_m, self._cross_m = floor.height_m, _CROSS_SIZE * extent.radius_m
        self.show(self._points)

    def show(self, points_m: ArrayLike) -> None:
        """Show the lines of points.

        Parameters
        ----------
        points_m : array-like, shape (k, 3)
            Points [m]; those that are not finite have no line.
        """
        points = np.asarray(points_m, dtype=np.float64).reshape(-1, 3)
        self._points = points[np.isfinite(points).all(axis=1)]
        if self._height_m is None:
            return
        feet = self._points.copy()
        feet[:, 2] = self._height_m
        crosses = [(feet - arm, feet + arm) for arm in self._cross_m * np.eye(3)[:2]]
        show_segments(
            self._lines, np.concatenate([np.stack(ends, axis=1) for ends in ((self._points, feet), *crosses)])
        )
