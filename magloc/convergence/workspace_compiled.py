"""Workspace of a block of lanes, and small linear algebra on it; see :mod:`magloc.convergence.filters_compiled`."""

from __future__ import annotations

import numpy as np

from arrays.typing import FloatArray
from magloc.compilation import inlined, internal

LANES = 32
# Rows, as offsets into the workspace. The first four groups are the linearisation at the state of its first six rows.
STATE = 0
NORMAL = 6 * LANES  # JᵀJ, upper triangle by rows
RIGHT = 27 * LANES  # Jᵀr
CHI2 = 33 * LANES
LINEARISATION = 34  # rows of the groups above
BEST = 34 * LANES  # damped: the same at the best state so far
PRIOR = 68 * LANES  # mean of the prior, which is the start
INFORMATION = 74 * LANES  # repeated: information of the predicted state, upper triangle by rows
DAMPING = 95 * LANES  # of the step; zero for all but damped
KEPT_DAMPING = 96 * LANES  # damped: of the next step that has one
COST = 97 * LANES  # damped: χ² and prior at the best state so far
ACCEPT = 98 * LANES  # damped: whether the last step led there
ITERATIONS = 99 * LANES
CHANGE = 100 * LANES  # parts of ‖ΔG‖² (3)
DONE = 103 * LANES
STOPPED = 104 * LANES
SENSOR = 105 * LANES  # one sensor: residual (3), gradient tensor (xx, xy, xz, yy, yz), ∂B/∂m (xx, xy, xz, yy, yz)
COMMON = 118 * LANES  # their weighted means over the sensors so far
BASE = 131 * LANES  # residual at the base sensor (3)
ROW = 134 * LANES  # one difference: residual, Jacobian (6)
START = 141 * LANES  # number of the lane's start
WORKSPACE = 142 * LANES
SENSOR_ROWS = 13
DIAGONAL = (0, 6, 11, 15, 18, 20)  # rows of an upper triangle


@internal
def aligned(size: int) -> FloatArray:
    """Zeros that begin on a cache line, where a vector register never reaches into the next."""
    zeros = np.zeros(size + 8)
    first = (-(zeros.ctypes.data // 8)) % 8
    return zeros[first : first + size]


@inlined
def lanes_of(lane: int | None) -> range:
    """The lanes that a thread computes: all of its block, as vector instructions, or one on a graphics processor."""
    if lane is None:
        return range(LANES)
    return range(lane, lane + 1)


@inlined
def add_identity(w: FloatArray, at: int, i: int, factor: float) -> None:
    """Add 1 to the diagonal of a triangle, and multiply the sum."""
    w[at + i] = factor * (w[at + i] + 1.0)
    w[at + 6 * LANES + i] = factor * (w[at + 6 * LANES + i] + 1.0)
    w[at + 11 * LANES + i] = factor * (w[at + 11 * LANES + i] + 1.0)
    w[at + 15 * LANES + i] = factor * (w[at + 15 * LANES + i] + 1.0)
    w[at + 18 * LANES + i] = factor * (w[at + 18 * LANES + i] + 1.0)
    w[at + 20 * LANES + i] = factor * (w[at + 20 * LANES + i] + 1.0)


@inlined
def triangle(w: FloatArray, at: int, i: int) -> tuple[float, ...]:
    """Lane i of the 21 rows that begin at an offset."""
    return (
        w[at + i], w[at + LANES + i], w[at + 2 * LANES + i], w[at + 3 * LANES + i], w[at + 4 * LANES + i],
        w[at + 5 * LANES + i], w[at + 6 * LANES + i], w[at + 7 * LANES + i], w[at + 8 * LANES + i],
        w[at + 9 * LANES + i], w[at + 10 * LANES + i], w[at + 11 * LANES + i], w[at + 12 * LANES + i],
        w[at + 13 * LANES + i], w[at + 14 * LANES + i], w[at + 15 * LANES + i], w[at + 16 * LANES + i],
        w[at + 17 * LANES + i], w[at + 18 * LANES + i], w[at + 19 * LANES + i], w[at + 20 * LANES + i],
    )  # fmt: skip


@inlined
def vector(w: FloatArray, at: int, i: int) -> tuple[float, float, float, float, float, float]:
    """Lane i of the 6 rows that begin at an offset."""
    return (
        w[at + i], w[at + LANES + i], w[at + 2 * LANES + i],
        w[at + 3 * LANES + i], w[at + 4 * LANES + i], w[at + 5 * LANES + i],
    )  # fmt: skip


@inlined
def swept(t: tuple[float, ...]) -> tuple[float, ...]:
    """Upper triangle of -A⁻¹ by rows and A⁻¹ b, from those of A and b: the sweep operator on every variable."""
    return swept_once(swept_once(swept_once(swept_once(swept_once(swept_once(t))))))


@inlined
def swept_once(t: tuple[float, ...]) -> tuple[float, ...]:
    """Gauss-Jordan step of a symmetric (A, b) with the first variable, which becomes the last.

    After six all are in their place again. What the caller leaves unused the compiler leaves uncomputed.
    """
    (a00, a01, a02, a03, a04, a05, a11, a12, a13, a14, a15, a22, a23, a24, a25, a33, a34, a35, a44, a45, a55,
     b0, b1, b2, b3, b4, b5) = t  # fmt: skip
    d = 1.0 / a00
    c1, c2, c3, c4, c5 = d * a01, d * a02, d * a03, d * a04, d * a05
    return (
        a11 - c1 * a01, a12 - c1 * a02, a13 - c1 * a03, a14 - c1 * a04, a15 - c1 * a05, c1,
        a22 - c2 * a02, a23 - c2 * a03, a24 - c2 * a04, a25 - c2 * a05, c2,
        a33 - c3 * a03, a34 - c3 * a04, a35 - c3 * a05, c3,
        a44 - c4 * a04, a45 - c4 * a05, c4,
        a55 - c5 * a05, c5,
        -d,
        b1 - c1 * b0, b2 - c2 * b0, b3 - c3 * b0, b4 - c4 * b0, b5 - c5 * b0, d * b0,
    )  # fmt: skip
