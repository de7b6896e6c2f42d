"""Line levelling for maps: offset and drift of every line, from a robust fit beside a smooth surface."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import sparse
from scipy.interpolate import BSpline
from scipy.sparse.linalg import spsolve

from arrays.typing import FloatArray
from magloc.measurement.plausibility import robust_sigma
from magloc.navigation.flight_lines import FlightLine, covers_area, line_spacing

FEWEST_LINES = 4
_NODES = 4.0  # distance of the surface's nodes, in spacings of lines: levels of neighbouring lines are no surface
_MOST_NODES = 40  # on each axis
_MOST_ROWS = 20_000  # that the fit uses
_DEGREE = 3
_SMOOTH, _RIDGE = 1e-6, 1e-3  # penalties, relative to the information of the rows: the surface takes what both explain
_HUBER, _TUKEY = 1.345, 4.685  # 95 % efficient for Gaussian errors
_STEPS = 12


def line_levels(place_m: FloatArray, values: FloatArray, lines: Sequence[FlightLine]) -> FloatArray:
    """Return the level of every row (n,): offset and linear drift of its line.

    Values are the sum of a smooth surface, of the levels, and of a remainder with outliers. The surface contains
    only wavelengths above about eight spacings of lines. Where lines cross, their levels are determined at all
    wavelengths, up to a bilinear surface.

    Parameters
    ----------
    place_m : ndarray, shape (n, 3)
    values : ndarray, shape (n,)
    lines : sequence of FlightLine

    Returns
    -------
    ndarray
        Zero for fewer than four lines, and for rows of no line.
    """
    levels = np.zeros(len(values))
    if len(lines) < FEWEST_LINES or not covers_area(place_m[:, :2]):
        return levels
    step = -(-len(values) // _MOST_ROWS)
    effects = _line_effects(len(values), lines)
    on_line = np.diff(effects.indptr) > 0
    used = np.flatnonzero(on_line)[::step]
    surface, roughness = _surface(place_m[used, :2])
    n_nodes, n_levels = surface.shape[1], effects.shape[1]
    A = sparse.hstack([surface, effects[used]], format="csr")
    penalty = sparse.block_diag(
        [
            (_SMOOTH * len(used) / n_nodes) * roughness,
            (_RIDGE * len(used) / n_levels) * sparse.eye(n_levels),
        ]
    )
    weights = np.ones(len(used))
    middle = float(np.median(values[used]))
    for number in range(_STEPS):
        weighted = A.multiply(weights[:, None]).tocsr()
        solution = spsolve((weighted.T @ A + penalty).tocsc(), weighted.T @ (values[used] - middle))
        left = np.abs(values[used] - middle - A @ solution)
        ratio = left / max(robust_sigma(left), np.finfo(np.float64).tiny)
        if number < _STEPS // 2:
            weights = np.minimum(1.0, _HUBER / np.maximum(ratio, _HUBER))
        else:
            weights = np.maximum(1.0 - (ratio / _TUKEY) ** 2, 0.0) ** 2
    return np.asarray(effects @ solution[n_nodes:])


def _line_effects(n: int, lines: Sequence[FlightLine]) -> sparse.csr_array:
    """Return the columns (n, 2 K) of offset and drift of every line; a drift goes from -1 to 1 along its line."""
    rows = np.concatenate([np.arange(line.rows.start, line.rows.stop) for line in lines])
    which = np.repeat(np.arange(len(lines)), [line.rows.stop - line.rows.start for line in lines])
    along = np.concatenate([np.linspace(-1.0, 1.0, line.rows.stop - line.rows.start) for line in lines])
    data = np.concatenate([np.ones(len(rows)), along])
    where = np.tile(rows, 2), np.concatenate([2 * which, 2 * which + 1])
    return sparse.csr_array((data, where), shape=(n, 2 * len(lines)))


def _surface(xy_m: FloatArray) -> tuple[sparse.csr_array, sparse.csr_array]:
    """Return the columns (n, P) of cubic splines on a grid, and the square of their roughness (P, P)."""
    pitch_m = max(_NODES * line_spacing(xy_m), float(np.ptp(xy_m, axis=0).max()) / _MOST_NODES)
    axes, rough, sizes = [], [], []
    for axis in xy_m.T:
        cells = max(1, int(np.ceil(np.ptp(axis) / pitch_m)))
        low = axis.min() - 0.5 * (cells * pitch_m - np.ptp(axis))
        knots = low + pitch_m * np.arange(-_DEGREE, cells + _DEGREE + 1)
        size = cells + _DEGREE
        axes.append(BSpline.design_matrix(axis, knots, _DEGREE))
        bend = np.diff(np.eye(size), n=2, axis=0)
        rough.append(bend.T @ bend)
        sizes.append(size)
    n, per_row = len(xy_m), _DEGREE + 1
    (x, y), (n_x, n_y) = axes, sizes
    data = x.data.reshape(n, per_row, 1) * y.data.reshape(n, 1, per_row)
    columns = x.indices.reshape(n, per_row, 1) * n_y + y.indices.reshape(n, 1, per_row)
    starts = np.arange(n + 1) * per_row**2
    surface = sparse.csr_array((data.ravel(), columns.ravel(), starts), shape=(n, n_x * n_y))
    roughness = np.kron(rough[0], np.eye(n_y)) + np.kron(np.eye(n_x), rough[1])
    return surface, sparse.csr_array(roughness)
