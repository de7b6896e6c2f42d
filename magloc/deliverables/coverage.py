"""Coverage of an area by the lines of a survey."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from arrays.typing import FloatArray
from magloc.navigation.flight_lines import FlightLine, covers_area, line_spacing

_NEAR = 0.75  # distance of a covered place from a line, in spacings
_CELLS_PER_SPACING, _MOST_CELLS = 10.0, 200_000


class Coverage(NamedTuple):
    """Distances (nx, ny) from the nearest line, NaN beside the survey, in cells from a corner [m]."""

    distance_m: FloatArray
    corner_m: FloatArray
    cell_m: float
    spacing_m: float

    @property
    def widest_m(self) -> float:
        """Width of the widest strip between lines."""
        return 2.0 * float(np.nanmax(self.distance_m, initial=0.0))

    @property
    def covered(self) -> float:
        """Share of the area that is nearer to a line than three quarters of the usual spacing."""
        distances = self.distance_m[np.isfinite(self.distance_m)]
        return float(np.mean(distances <= _NEAR * self.spacing_m)) if distances.size else 1.0


def coverage_of(xy_m: FloatArray, lines: Sequence[FlightLine]) -> Coverage | None:
    """Return the distances from the nearest line between the outer ones; None for a single line."""
    if len(lines) < 2 or not covers_area(xy_m):
        return None
    spacing_m, low = line_spacing(xy_m), xy_m.min(axis=0)
    extent_m = np.ptp(xy_m, axis=0)
    cell_m = max(spacing_m / _CELLS_PER_SPACING, math.sqrt(float(np.prod(extent_m)) / _MOST_CELLS))
    tracks = np.concatenate([_dense(xy_m[line.rows], 0.5 * cell_m) for line in lines])
    shape = (extent_m / cell_m).astype(np.intp) + 1
    seen = np.zeros(shape, np.bool_)
    seen[tuple(np.minimum((tracks - low) / cell_m, shape - 1).astype(np.intp).T)] = True
    between = np.zeros(shape, np.bool_)
    for axis in range(2):  # lines on either side
        before = np.logical_or.accumulate(seen, axis=axis)
        after = np.flip(np.logical_or.accumulate(np.flip(seen, axis), axis=axis), axis)
        between |= before & after
    middles = low + cell_m * (np.argwhere(between) + 0.5)
    distance_m = np.full(shape, np.nan)
    distance_m[between] = KDTree(tracks).query(middles)[0]
    return Coverage(distance_m, low, cell_m, spacing_m)


def _dense(xy_m: FloatArray, step_m: float) -> FloatArray:
    """Return a track (n, 2) with places at most a step apart."""
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xy_m, axis=0), axis=1))])
    at = np.linspace(0.0, way[-1], math.ceil(way[-1] / step_m) + 1)
    return np.stack([np.interp(at, way, axis) for axis in xy_m.T], axis=-1)
