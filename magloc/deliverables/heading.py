"""Heading error: how the readings of a sensor change with the course of the lines."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from arrays.typing import FloatArray
from magloc.measurement.plausibility import robust_sigma
from magloc.navigation.flight_lines import FlightLine

_ENDS = 0.15  # share of a line at either end that is excluded: turns
_STRAIGHT = 0.95  # least distance between the ends over the way
_FEWEST = 3  # lines with two neighbours on either side
_SEEN = 0.2  # least size of a direction of courses relative to the largest
_ROUNDS, _OUTLIER = 10, 2.0  # of the robust fit, and its threshold in standard deviations
_TINY_T = 1e-15  # residuals that are rounding errors
_WEIGHTS = np.array([1.0, -4.0, 6.0, -4.0, 1.0]) / 8.0  # of successive lines: their fourth difference


class HeadingError(NamedTuple):
    """Amplitude of a change with the course, and its standard deviation.

    With courses along one axis only, it is half the difference between both.
    """

    amplitude_T: float
    sigma_T: float


class _Line(NamedTuple):
    """Places (n, 2) and values (n,) of a straight line, and its course (2,)."""

    xy_m: FloatArray
    values_T: FloatArray
    course: FloatArray


def heading_error(xy_m: FloatArray, values_T: FloatArray, lines: Sequence[FlightLine]) -> HeadingError | None:
    """Return the part of values (n,) that is a sine of the course of lines; None if they do not determine it.

    Each line is compared with two lines before and two after it, row by row: their fourth difference contains
    little of the field of the ground and of slow changes of the ambient field. The median of a line counts.
    """
    straight = list(filter(None, (_straight_line(xy_m[line.rows], values_T[line.rows]) for line in lines)))
    n = len(straight) - len(_WEIGHTS) + 1
    if n < _FEWEST:
        return None
    differences = np.array([np.convolve(row, _WEIGHTS) for row in np.eye(n)])
    turns = differences @ np.array([line.course for line in straight])
    steps = np.array([_step(straight[i : i + len(_WEIGHTS)]) for i in range(n)])
    _, size, axes = np.linalg.svd(turns, full_matrices=False)
    if size[0] < 1.0:  # all lines have one course
        return None
    columns = turns @ axes[size > _SEEN * size[0]].T
    weight = np.ones(n)
    for _ in range(_ROUNDS):
        solve = np.linalg.pinv(columns * np.sqrt(weight)[:, None]) * np.sqrt(weight)
        residual = steps - columns @ (solve @ steps)
        spread = robust_sigma(residual)
        weight = np.minimum(1.0, (_OUTLIER * spread + _TINY_T) / (np.abs(residual) + _TINY_T))
    vector = solve @ steps
    dof = max(float(weight.sum()) - columns.shape[1], 1.0)
    # Lines are independent of each other, and so their differences are not.
    of_line = float(np.sum(weight * residual**2)) / dof / float(_WEIGHTS @ _WEIGHTS)
    covariance = of_line * (solve @ differences) @ (solve @ differences).T
    amplitude = float(np.linalg.norm(vector))
    direction = vector / amplitude if amplitude else np.eye(len(vector))[0]
    return HeadingError(amplitude, float(np.sqrt(direction @ covariance @ direction)))


def _straight_line(xy_m: FloatArray, values_T: FloatArray) -> _Line | None:
    """Return the middle of a line with its course; None if it is not straight or has no reading."""
    ends = int(_ENDS * len(xy_m))
    xy_m, values_T = xy_m[ends : len(xy_m) - ends], values_T[ends : len(values_T) - ends]
    known = np.isfinite(values_T)
    if known.sum() < 2:
        return None
    chord = xy_m[-1] - xy_m[0]
    length = float(np.linalg.norm(chord))
    if not length or length < _STRAIGHT * np.linalg.norm(np.diff(xy_m, axis=0), axis=1).sum():
        return None
    return _Line(xy_m[known], values_T[known], chord / length)


def _step(lines: Sequence[_Line]) -> float:
    """Return the median of the fourth difference of lines, at the places of the middle one."""
    at = lines[len(lines) // 2].xy_m
    nearest = [line.values_T[KDTree(line.xy_m).query(at)[1]] for line in lines]
    return float(np.median(_WEIGHTS @ np.array(nearest)))
