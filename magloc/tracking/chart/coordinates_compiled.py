"""The chart of one state in compiled loops, the twin of :mod:`magloc.tracking.chart.coordinates`."""

from __future__ import annotations

import math

import numpy as np

from arrays.typing import FloatArray
from magloc.compilation import internal
from magloc.linalg_compiled import fill_frame


@internal
def fill_chart(x: FloatArray, centroid: FloatArray, radius: float, frame: FloatArray) -> float:
    """Tangents and direction of the chart about a state as rows, and its length."""
    offset = np.empty(3)
    square = 0.0
    for i in range(3):
        offset[i] = x[i] - centroid[i]
        square += offset[i] * offset[i]
    if square == 0.0:
        offset[2] = 1.0
    r = fill_frame(offset, frame)
    if square == 0.0:
        r = 0.0
    return max(r, radius)


@internal
def is_firm(x: FloatArray, S: FloatArray, length: float, limit: float) -> bool:
    """Whether a root S (n, n) leaves so little of the moment open that it is moved by strength and direction."""
    square, variance = 0.0, 0.0
    for i in range(3, 6):
        square += x[i] * x[i]
        for c in range(S.shape[1]):
            variance += S[i, c] * S[i, c]
    unit = length * length * length * length
    return variance * unit * unit < limit * limit * square


@internal
def _move_firmly(x: FloatArray, e: FloatArray, scale: float, unit: float, there: FloatArray, L: FloatArray) -> None:
    """The moment at coordinates e about x by strength and direction, and its derivative by δμ, in place."""
    square, nu = 0.0, 0.0
    for i in range(3, 6):
        square += x[i] * x[i]
        nu += x[i] * e[i]
    nu *= unit / square
    size = math.sqrt(square)
    b, norm = np.empty(3), 0.0
    for i in range(3):
        b[i] = x[3 + i] * (1.0 - nu) / size + unit * e[3 + i] / size
        norm += b[i] * b[i]
    norm = math.sqrt(norm)
    strength, along = scale * size * math.exp(nu), 0.0
    for i in range(3):
        b[i] /= norm
        along += b[i] * x[3 + i] / size
    for i in range(3):
        there[3 + i] = strength * b[i]
        for j in range(3):
            mine = x[3 + j] / size
            across = ((1.0 if i == j else 0.0) - x[3 + i] / size * mine - b[i] * b[j] + along * b[i] * mine) / norm
            L[3 + i, 3 + j] = strength * unit / size * (b[i] * mine + across)


@internal
def move(
    x: FloatArray, e: FloatArray, frame: FloatArray, length: float, firm: bool, there: FloatArray, L: FloatArray
) -> None:
    """The state at coordinates e about x, and the derivative L (n, n): the twin of :class:`magloc.tracking.chart`."""
    n = x.size
    growth = math.exp(e[0])
    b, u = np.empty(3), np.empty(3)
    square = 0.0
    for i in range(3):
        b[i] = frame[2, i] + frame[0, i] * e[1] + frame[1, i] * e[2]
        square += b[i] * b[i]
    norm = math.sqrt(square)
    for i in range(3):
        u[i] = b[i] / norm
    reach = growth * length
    for i in range(n):
        there[i] = x[i] + e[i]
        for j in range(n):
            L[i, j] = 1.0 if i == j else 0.0
    scale, unit = growth * growth * growth * growth, length * length * length * length
    far = reach * reach * reach * reach
    if firm:
        _move_firmly(x, e, scale, unit, there, L)
    for i in range(3):
        there[i] = x[i] + length * (growth * u[i] - frame[2, i])
        L[i, i] = 0.0
        L[i, 0] = reach * u[i]
        if not firm:
            there[3 + i] = scale * (x[3 + i] + unit * e[3 + i])
            L[3 + i, 3 + i] = far
        L[3 + i, 0] = 4.0 * there[3 + i]
    for a in range(2):
        along = u[0] * frame[a, 0] + u[1] * frame[a, 1] + u[2] * frame[a, 2]
        for i in range(3):
            L[i, 1 + a] = reach * (frame[a, i] - u[i] * along) / norm
    if n >= 9:
        for i in range(6, 9):
            there[i] = growth * (x[i] + length * e[i])
            L[i, 0] = there[i]
            L[i, i] = reach


@internal
def into_chart(x: FloatArray, frame: FloatArray, length: float, rows: FloatArray) -> None:
    """Multiply rows (n, m) by the inverse of the chart's L at x, in place."""
    n, m = rows.shape
    unit = length * length * length * length
    for c in range(m):
        r0, r1, r2 = rows[0, c], rows[1, c], rows[2, c]
        along = (frame[2, 0] * r0 + frame[2, 1] * r1 + frame[2, 2] * r2) / length
        rows[0, c] = along
        rows[1, c] = (frame[0, 0] * r0 + frame[0, 1] * r1 + frame[0, 2] * r2) / length
        rows[2, c] = (frame[1, 0] * r0 + frame[1, 1] * r1 + frame[1, 2] * r2) / length
        for i in range(3, 6):
            rows[i, c] = (rows[i, c] - 4.0 * x[i] * along) / unit
        if n >= 9:
            for i in range(6, 9):
                rows[i, c] = (rows[i, c] - x[i] * along) / length
