"""Compiled linearisation of the projected cost of one dipole at the trial states of many starts, one a lane.

``w[ROW + i]`` or ``r[ROW + i]`` for lane i (docs/theory/lanes.md). The readable twin is
``tests/variable_projection.py``; coordinates are :mod:`magloc.measurement.whitened_compiled`'s.
"""

from __future__ import annotations

import math

import numpy as np

from arrays.typing import FloatArray
from magloc.compilation import inlined, internal

# No int, here and in all that follows from it: numba compiles a function anew for each literal that it is given.
LANES: int = np.int64(16)  # type: ignore[assignment]
# A column of which less is left, squared and relative, consists of rounding alone.
_LOST = 1e-26

# Rows of a sensor, as offsets: what its three channels read.
GAIN = 0 * LANES  # (channel, axis)
SIGNAL = 9 * LANES
BASIS = 12 * LANES  # (channel, component of the moment), orthogonal in the end
RESIDUAL = 21 * LANES
DIRECTION = 24 * LANES  # from the source, and one over the distance
JACOBIAN = 28 * LANES  # (channel, tangent)
SENSOR_ROWS = 37 * LANES
# Rows of the workspace: the state with its moment, χ² and linearisation, and the same at the trial state.
STATE = 0 * LANES
NORMAL = 8 * LANES  # JᵀJ (00, 01, 02, 11, 12, 22), Jᵀr
LEFT = 17 * LANES  # by how much another moment alone promises to lower χ²: of moduli, which are not linear in it
TRIAL = 18 * LANES
MOMENT = 4 * LANES  # from either
CHI2 = 7 * LANES
DAMPING = 36 * LANES
PROMISED = 37 * LANES
TANGENT = 38 * LANES  # (tangent, component of q)
SQUARE = 50 * LANES  # of the basis's columns (3), and one over those of their parts that are free of the earlier ones
PRODUCT = 56 * LANES  # of the basis's columns (01, 02, 12), then with the signal (3)
ALONG = 62 * LANES  # of the basis's columns with the Jacobian's (3 × 3)
ITERATIONS = 71 * LANES
END = 72 * LANES
TOO_HIGH = 73 * LANES
WORKSPACE = 74 * LANES


@internal
def linearise(
    sensors: FloatArray, w: FloatArray, rows: FloatArray, common: FloatArray, dots: FloatArray, free_range: float
) -> None:
    """Scaled moment, χ² and normal equations of the trial states."""
    fill_directions(sensors, w, rows)
    fill_basis(rows)
    project(BASIS, rows, common, dots)
    orthogonalise(w, rows)
    fill_tangents(w, free_range)
    fill_jacobian(sensors, w, rows)
    project(JACOBIAN, rows, common, dots)
    fill_normal(w, rows)


@inlined
def _unit_readings(r: FloatArray, at: int, i: int, n: tuple[float, float, float], cube: float) -> tuple[float, ...]:
    """What the channel with the gain that begins at an offset reads of the three unit moments."""
    g0, g1, g2 = r[at + i], r[at + LANES + i], r[at + 2 * LANES + i]
    t = 3.0 * (n[0] * g0 + n[1] * g1 + n[2] * g2)
    return (t * n[0] - g0) * cube, (t * n[1] - g1) * cube, (t * n[2] - g2) * cube


@internal
def fill_directions(sensors: FloatArray, w: FloatArray, rows: FloatArray) -> None:
    """Directions from the source at the trial state to the sensors, and one over their distances."""
    for s in range(len(sensors)):
        x0, x1, x2 = sensors[s, 0], sensors[s, 1], sensors[s, 2]
        r = rows[s]
        for i in range(LANES):
            scale = w[TRIAL + 3 * LANES + i]
            v0, v1, v2 = (
                scale * x0 - w[TRIAL + i],
                scale * x1 - w[TRIAL + LANES + i],
                scale * x2 - w[TRIAL + 2 * LANES + i],
            )
            inverse = 1.0 / math.sqrt(v0 * v0 + v1 * v1 + v2 * v2)
            r[DIRECTION + i], r[DIRECTION + LANES + i] = v0 * inverse, v1 * inverse
            r[DIRECTION + 2 * LANES + i], r[DIRECTION + 3 * LANES + i] = v2 * inverse, inverse


@internal
def fill_basis(rows: FloatArray) -> None:
    """Readings of the three unit moments at the trial state."""
    for s in range(len(rows)):
        r = rows[s]
        for i in range(LANES):
            n, inverse = three(r, DIRECTION, i), r[DIRECTION + 3 * LANES + i]
            cube = inverse * inverse * inverse
            b0, b1, b2 = _unit_readings(r, GAIN, i, n, cube)
            r[BASIS + i], r[BASIS + LANES + i], r[BASIS + 2 * LANES + i] = b0, b1, b2
            b0, b1, b2 = _unit_readings(r, GAIN + 3 * LANES, i, n, cube)
            r[BASIS + 3 * LANES + i], r[BASIS + 4 * LANES + i], r[BASIS + 5 * LANES + i] = b0, b1, b2
            b0, b1, b2 = _unit_readings(r, GAIN + 6 * LANES, i, n, cube)
            r[BASIS + 6 * LANES + i], r[BASIS + 7 * LANES + i], r[BASIS + 8 * LANES + i] = b0, b1, b2


@internal
def project(at: int, rows: FloatArray, common: FloatArray, dots: FloatArray) -> None:
    """Remove the common field, three components at a time, from three columns of every sensor's rows."""
    for k in range(len(dots)):
        d = dots[k]
        d[:] = 0.0
        for s in range(len(rows)):
            r, c = rows[s, at : at + 9 * LANES], common[s, k]
            for i in range(LANES):
                c0, c1, c2 = column(c, 0, i), column(c, LANES, i), column(c, 2 * LANES, i)
                r0, r1, r2 = column(r, 0, i), column(r, LANES, i), column(r, 2 * LANES, i)
                d[i] += dot(c0, r0)
                d[LANES + i] += dot(c0, r1)
                d[2 * LANES + i] += dot(c0, r2)
                d[3 * LANES + i] += dot(c1, r0)
                d[4 * LANES + i] += dot(c1, r1)
                d[5 * LANES + i] += dot(c1, r2)
                d[6 * LANES + i] += dot(c2, r0)
                d[7 * LANES + i] += dot(c2, r1)
                d[8 * LANES + i] += dot(c2, r2)
        for s in range(len(rows)):
            r, c = rows[s, at : at + 9 * LANES], common[s, k]
            for i in range(LANES):
                c0, c1, c2 = column(c, 0, i), column(c, LANES, i), column(c, 2 * LANES, i)
                for_0 = less(column(r, 0, i), d[i], c0)
                for_1 = less(column(r, LANES, i), d[LANES + i], c0)
                for_2 = less(column(r, 2 * LANES, i), d[2 * LANES + i], c0)
                for_0 = less(less(for_0, d[3 * LANES + i], c1), d[6 * LANES + i], c2)
                for_1 = less(less(for_1, d[4 * LANES + i], c1), d[7 * LANES + i], c2)
                for_2 = less(less(for_2, d[5 * LANES + i], c1), d[8 * LANES + i], c2)
                _put_column(r, 0, i, for_0)
                _put_column(r, LANES, i, for_1)
                _put_column(r, 2 * LANES, i, for_2)


@inlined
def column(r: FloatArray, at: int, i: int) -> tuple[float, float, float]:
    """A column of three at an offset, of the three channels of a sensor."""
    return r[at + i], r[at + 3 * LANES + i], r[at + 6 * LANES + i]


@inlined
def _put_column(r: FloatArray, at: int, i: int, c: tuple[float, float, float]) -> None:
    r[at + i], r[at + 3 * LANES + i], r[at + 6 * LANES + i] = c


@inlined
def dot(a: tuple[float, float, float], b: tuple[float, float, float]) -> float:
    """Product of two vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inlined
def less(a: tuple[float, float, float], t: float, b: tuple[float, float, float]) -> tuple[float, float, float]:
    """A vector without a multiple of another."""
    return a[0] - t * b[0], a[1] - t * b[1], a[2] - t * b[2]


@internal
def orthogonalise(w: FloatArray, rows: FloatArray) -> None:
    """Modified Gram-Schmidt of the basis and the signal: scaled moment, residual and χ² of the trial state."""
    w[SQUARE:ALONG] = 0.0
    w[TRIAL + CHI2 : TRIAL + CHI2 + LANES] = 0.0
    for s in range(len(rows)):
        r = rows[s]
        for i in range(LANES):
            c0, c1, c2 = column(r, BASIS, i), column(r, BASIS + LANES, i), column(r, BASIS + 2 * LANES, i)
            y = (r[SIGNAL + i], r[SIGNAL + LANES + i], r[SIGNAL + 2 * LANES + i])
            w[SQUARE + i] += dot(c0, c0)
            w[SQUARE + LANES + i] += dot(c1, c1)
            w[SQUARE + 2 * LANES + i] += dot(c2, c2)
            w[PRODUCT + i] += dot(c0, c1)
            w[PRODUCT + LANES + i] += dot(c0, c2)
            w[PRODUCT + 3 * LANES + i] += dot(c0, y)
    for i in range(LANES):
        square = w[SQUARE + i]
        inverse = 1.0 / square if square > 0.0 else 0.0
        w[SQUARE + 3 * LANES + i] = inverse
        w[PRODUCT + i] *= inverse
        w[PRODUCT + LANES + i] *= inverse
        w[PRODUCT + 3 * LANES + i] *= inverse
    for s in range(len(rows)):
        r = rows[s]
        for i in range(LANES):
            c0 = column(r, BASIS, i)
            c1 = less(column(r, BASIS + LANES, i), w[PRODUCT + i], c0)
            c2 = less(column(r, BASIS + 2 * LANES, i), w[PRODUCT + LANES + i], c0)
            y = (r[SIGNAL + i], r[SIGNAL + LANES + i], r[SIGNAL + 2 * LANES + i])
            y = less(y, w[PRODUCT + 3 * LANES + i], c0)
            _put_column(r, BASIS + LANES, i, c1)
            _put_column(r, BASIS + 2 * LANES, i, c2)
            r[RESIDUAL + i], r[RESIDUAL + LANES + i], r[RESIDUAL + 2 * LANES + i] = y
            w[SQUARE + 4 * LANES + i] += dot(c1, c1)
            w[PRODUCT + 2 * LANES + i] += dot(c1, c2)
            w[PRODUCT + 4 * LANES + i] += dot(c1, y)
    for i in range(LANES):
        square = w[SQUARE + 4 * LANES + i]
        inverse = 1.0 / square if square > _LOST * w[SQUARE + LANES + i] else 0.0
        w[SQUARE + 4 * LANES + i] = inverse
        w[PRODUCT + 2 * LANES + i] *= inverse
        w[PRODUCT + 4 * LANES + i] *= inverse
    for s in range(len(rows)):
        r = rows[s]
        for i in range(LANES):
            c1 = column(r, BASIS + LANES, i)
            c2 = less(column(r, BASIS + 2 * LANES, i), w[PRODUCT + 2 * LANES + i], c1)
            y = (r[RESIDUAL + i], r[RESIDUAL + LANES + i], r[RESIDUAL + 2 * LANES + i])
            y = less(y, w[PRODUCT + 4 * LANES + i], c1)
            _put_column(r, BASIS + 2 * LANES, i, c2)
            r[RESIDUAL + i], r[RESIDUAL + LANES + i], r[RESIDUAL + 2 * LANES + i] = y
            w[SQUARE + 5 * LANES + i] += dot(c2, c2)
            w[PRODUCT + 5 * LANES + i] += dot(c2, y)
    for i in range(LANES):
        square = w[SQUARE + 5 * LANES + i]
        inverse = 1.0 / square if square > _LOST * w[SQUARE + 2 * LANES + i] else 0.0
        w[SQUARE + 5 * LANES + i] = inverse
        mu2 = w[PRODUCT + 5 * LANES + i] * inverse
        mu1 = w[PRODUCT + 4 * LANES + i] - w[PRODUCT + 2 * LANES + i] * mu2
        w[PRODUCT + 5 * LANES + i] = mu2
        w[TRIAL + MOMENT + i] = w[PRODUCT + 3 * LANES + i] - w[PRODUCT + i] * mu1 - w[PRODUCT + LANES + i] * mu2
        w[TRIAL + MOMENT + LANES + i], w[TRIAL + MOMENT + 2 * LANES + i] = mu1, mu2
    for s in range(len(rows)):
        r = rows[s]
        for i in range(LANES):
            y = (r[RESIDUAL + i], r[RESIDUAL + LANES + i], r[RESIDUAL + 2 * LANES + i])
            y = less(y, w[PRODUCT + 5 * LANES + i], column(r, BASIS + 2 * LANES, i))
            r[RESIDUAL + i], r[RESIDUAL + LANES + i], r[RESIDUAL + 2 * LANES + i] = y
            w[TRIAL + CHI2 + i] += dot(y, y)


@inlined
def tangents(w: FloatArray, at: int, i: int) -> tuple[float, ...]:
    """Orthonormal tangents of the sphere at the state of an offset: two that turn u at one range, and along the range.

    Duff et al., "Building an orthonormal basis, revisited".
    """
    u0, u1, u2, s = w[at + i], w[at + LANES + i], w[at + 2 * LANES + i], w[at + 3 * LANES + i]
    square = u0 * u0 + u1 * u1 + u2 * u2
    length = math.sqrt(square)
    inverse = 1.0 / length if square > 1e-24 else 0.0
    x, y, z = u0 * inverse, u1 * inverse, u2 * inverse if square > 1e-24 else 1.0
    sign = 1.0 if z >= 0.0 else -1.0
    a = -1.0 / (sign + z)
    b = x * y * a
    return 1.0 + sign * x * x * a, sign * b, -sign * x, b, sign + y * y * a, -y, x * s, y * s, z * s, -length


@internal
def fill_tangents(w: FloatArray, free_range: float) -> None:
    """Tangents at the trial state, of which the third one counts where the range is free."""
    for i in range(LANES):
        t00, t01, t02, t10, t11, t12, t20, t21, t22, t23 = tangents(w, TRIAL, i)
        w[TANGENT + i], w[TANGENT + LANES + i], w[TANGENT + 2 * LANES + i] = t00, t01, t02
        w[TANGENT + 3 * LANES + i], w[TANGENT + 4 * LANES + i], w[TANGENT + 5 * LANES + i] = t10, t11, t12
        w[TANGENT + 6 * LANES + i], w[TANGENT + 7 * LANES + i] = free_range * t20, free_range * t21
        w[TANGENT + 8 * LANES + i], w[TANGENT + 9 * LANES + i] = free_range * t22, free_range * t23


@inlined
def _change(
    d: tuple[float, float, float], n: tuple[float, float, float], m: tuple[float, float, float], quartic: float
) -> tuple[float, float, float]:
    """Change of the field of a moment with a displacement d; quartic is three over the distance to the fourth power."""
    along, of_moment, of_direction = dot(n, m), dot(d, m), dot(n, d)
    by_n, by_d, by_m = quartic * (of_moment - 5.0 * along * of_direction), quartic * along, quartic * of_direction
    return (
        by_d * d[0] + by_n * n[0] + by_m * m[0],
        by_d * d[1] + by_n * n[1] + by_m * m[1],
        by_d * d[2] + by_n * n[2] + by_m * m[2],
    )


@inlined
def three(r: FloatArray, at: int, i: int) -> tuple[float, float, float]:
    """Three successive rows at an offset."""
    return r[at + i], r[at + LANES + i], r[at + 2 * LANES + i]


@internal
def fill_jacobian(sensors: FloatArray, w: FloatArray, rows: FloatArray) -> None:
    """Derivative of the readings along the tangents at the trial state, of its moment."""
    for s in range(len(sensors)):
        x0, x1, x2 = sensors[s, 0], sensors[s, 1], sensors[s, 2]
        r = rows[s]
        for i in range(LANES):
            n, m = three(r, DIRECTION, i), three(w, TRIAL + MOMENT, i)
            inverse2 = r[DIRECTION + 3 * LANES + i] * r[DIRECTION + 3 * LANES + i]
            quartic = 3.0 * inverse2 * inverse2
            t0, t1, t2 = three(w, TANGENT, i), three(w, TANGENT + 3 * LANES, i), three(w, TANGENT + 6 * LANES, i)
            t23 = w[TANGENT + 9 * LANES + i]
            # What moves the source moves a sensor the other way.
            b0, b1 = _change((-t0[0], -t0[1], -t0[2]), n, m, quartic), _change((-t1[0], -t1[1], -t1[2]), n, m, quartic)
            b2 = _change((t23 * x0 - t2[0], t23 * x1 - t2[1], t23 * x2 - t2[2]), n, m, quartic)
            g0, g1, g2 = three(r, GAIN, i), three(r, GAIN + 3 * LANES, i), three(r, GAIN + 6 * LANES, i)
            _put_column(r, JACOBIAN, i, (dot(g0, b0), dot(g1, b0), dot(g2, b0)))
            _put_column(r, JACOBIAN + LANES, i, (dot(g0, b1), dot(g1, b1), dot(g2, b1)))
            _put_column(r, JACOBIAN + 2 * LANES, i, (dot(g0, b2), dot(g1, b2), dot(g2, b2)))


@internal
def fill_normal(w: FloatArray, rows: FloatArray) -> None:
    """Normal equations of the trial state, by Kaufman's form: the moment's part of every column is taken out."""
    w[ALONG : ALONG + 9 * LANES] = 0.0
    w[TRIAL + NORMAL : TRIAL + NORMAL + 9 * LANES] = 0.0
    for s in range(len(rows)):
        r = rows[s]
        for i in range(LANES):
            c0, c1, c2 = column(r, BASIS, i), column(r, BASIS + LANES, i), column(r, BASIS + 2 * LANES, i)
            j0, j1, j2 = column(r, JACOBIAN, i), column(r, JACOBIAN + LANES, i), column(r, JACOBIAN + 2 * LANES, i)
            w[ALONG + i] += dot(c0, j0)
            w[ALONG + LANES + i] += dot(c0, j1)
            w[ALONG + 2 * LANES + i] += dot(c0, j2)
            w[ALONG + 3 * LANES + i] += dot(c1, j0)
            w[ALONG + 4 * LANES + i] += dot(c1, j1)
            w[ALONG + 5 * LANES + i] += dot(c1, j2)
            w[ALONG + 6 * LANES + i] += dot(c2, j0)
            w[ALONG + 7 * LANES + i] += dot(c2, j1)
            w[ALONG + 8 * LANES + i] += dot(c2, j2)
    for i in range(LANES):
        for_0, for_1, for_2 = three(w, SQUARE + 3 * LANES, i)
        w[ALONG + i] *= for_0
        w[ALONG + LANES + i] *= for_0
        w[ALONG + 2 * LANES + i] *= for_0
        w[ALONG + 3 * LANES + i] *= for_1
        w[ALONG + 4 * LANES + i] *= for_1
        w[ALONG + 5 * LANES + i] *= for_1
        w[ALONG + 6 * LANES + i] *= for_2
        w[ALONG + 7 * LANES + i] *= for_2
        w[ALONG + 8 * LANES + i] *= for_2
    for s in range(len(rows)):
        r = rows[s]
        for i in range(LANES):
            c0, c1, c2 = column(r, BASIS, i), column(r, BASIS + LANES, i), column(r, BASIS + 2 * LANES, i)
            a0, a1, a2 = column(w, ALONG, i), column(w, ALONG + LANES, i), column(w, ALONG + 2 * LANES, i)
            j0, j1, j2 = column(r, JACOBIAN, i), column(r, JACOBIAN + LANES, i), column(r, JACOBIAN + 2 * LANES, i)
            j0 = less(less(less(j0, a0[0], c0), a0[1], c1), a0[2], c2)
            j1 = less(less(less(j1, a1[0], c0), a1[1], c1), a1[2], c2)
            j2 = less(less(less(j2, a2[0], c0), a2[1], c1), a2[2], c2)
            y = three(r, RESIDUAL, i)
            w[TRIAL + NORMAL + i] += dot(j0, j0)
            w[TRIAL + NORMAL + LANES + i] += dot(j0, j1)
            w[TRIAL + NORMAL + 2 * LANES + i] += dot(j0, j2)
            w[TRIAL + NORMAL + 3 * LANES + i] += dot(j1, j1)
            w[TRIAL + NORMAL + 4 * LANES + i] += dot(j1, j2)
            w[TRIAL + NORMAL + 5 * LANES + i] += dot(j2, j2)
            w[TRIAL + NORMAL + 6 * LANES + i] += dot(j0, y)
            w[TRIAL + NORMAL + 7 * LANES + i] += dot(j1, y)
            w[TRIAL + NORMAL + 8 * LANES + i] += dot(j2, y)
