"""Compiled linearisation of the projected cost of one dipole by normal equations of all columns at once.

Half the work of :mod:`magloc.localization.fit.linearisation_compiled`, whose lanes it shares, and half the digits, for
sensors whose noise is the same in all directions: fields, less that at the first sensor, are summed with one weight a
sensor, and the common field and the moment are eliminated from the sums. Tests hold it to that module.
"""

from __future__ import annotations

import math

from arrays.typing import FloatArray
from magloc.compilation import inlined, internal
from magloc.localization.fit.linearisation_compiled import (
    CHI2,
    LANES,
    MOMENT,
    NORMAL,
    TANGENT,
    TRIAL,
    WORKSPACE,
    dot,
    fill_tangents,
    less,
    three,
)
from magloc.measurement.whitened_compiled import LaneModel

# Sum of squares of readings whose χ² this has the digits for.
_MOST_ENERGY = 1e11
# A pivot of which less is left consists of rounding alone.
_LOST = 1e-13
# By how much the weights of a sensor may differ.
_SAME_WEIGHT = 1e-12
# Rows of a sensor, as offsets; symmetric matrices are (00, 01, 02, 11, 12, 22).
DIRECTION = 0 * LANES  # from the source, and one over the distance
FIELD = 4 * LANES  # of the three unit moments, less that at the first sensor
PULL = 10 * LANES  # Gᵀy
WEIGHT = 13 * LANES  # GᵀG
NARROW_ROWS = 14 * LANES
# Rows of the workspace behind those of the state.
ENERGY = WORKSPACE + 0 * LANES  # yᵀy
COMMON = WORKSPACE + 1 * LANES  # one over the sum of all weights
FIRST = WORKSPACE + 2 * LANES  # field at the first sensor
OFFSET = WORKSPACE + 8 * LANES  # common field that fits best
SUM_FIELD = WORKSPACE + 11 * LANES  # of fields, weighted
SQUARE = WORKSPACE + 17 * LANES  # of fields, weighted
PRODUCT = WORKSPACE + 23 * LANES  # of fields with the readings
SUM_JACOBIAN = WORKSPACE + 26 * LANES  # of the Jacobian's columns, weighted (3 × 3, by tangent)
ALONG = WORKSPACE + 35 * LANES  # of fields with the Jacobian's columns, weighted (3 × 3, by tangent)
SPACE = WORKSPACE + 44 * LANES


@internal
def has_digits(signal: FloatArray, gain: FloatArray, model: LaneModel) -> bool:
    """Whether this serves a signal (s, 3) with gains (s, 9): not large ones, nor where noise has a direction."""
    energy = 0.0
    for s in range(len(gain)):
        g = gain[s]
        weight = g[0] * g[0] + g[3] * g[3] + g[6] * g[6]
        for i in range(3):
            energy += signal[s, i] * signal[s, i]
            for j in range(i, 3):
                square = g[i] * g[j] + g[3 + i] * g[3 + j] + g[6 + i] * g[6 + j]
                if not abs(square - (weight if i == j else 0.0)) <= _SAME_WEIGHT * weight:
                    return False
    return model.is_unknown and energy <= _MOST_ENERGY


@internal
def load(i: int, signal: FloatArray, gain: FloatArray, w: FloatArray, rows: FloatArray) -> None:
    """Sensors and readings of lane i."""
    total = energy = 0.0
    for s in range(len(gain)):
        y0, y1, y2 = signal[s, 0], signal[s, 1], signal[s, 2]
        for a in range(3):
            rows[s, PULL + a * LANES + i] = gain[s, a] * y0 + gain[s, 3 + a] * y1 + gain[s, 6 + a] * y2
        weight = gain[s, 0] * gain[s, 0] + gain[s, 3] * gain[s, 3] + gain[s, 6] * gain[s, 6]
        rows[s, WEIGHT + i] = weight
        total += weight
        energy += y0 * y0 + y1 * y1 + y2 * y2
    w[COMMON + i], w[ENERGY + i] = 1.0 / total, energy


@inlined
def _six(r: FloatArray, at: int, i: int) -> tuple[float, ...]:
    return (
        r[at + i], r[at + LANES + i], r[at + 2 * LANES + i],
        r[at + 3 * LANES + i], r[at + 4 * LANES + i], r[at + 5 * LANES + i],
    )  # fmt: skip


@inlined
def _put_six(r: FloatArray, at: int, i: int, a: tuple[float, ...]) -> None:
    r[at + i], r[at + LANES + i], r[at + 2 * LANES + i] = a[0], a[1], a[2]
    r[at + 3 * LANES + i], r[at + 4 * LANES + i], r[at + 5 * LANES + i] = a[3], a[4], a[5]


@inlined
def _times(a: tuple[float, ...], x: tuple[float, float, float]) -> tuple[float, float, float]:
    """Product of a symmetric matrix and a vector."""
    return (
        a[0] * x[0] + a[1] * x[1] + a[2] * x[2],
        a[1] * x[0] + a[3] * x[1] + a[4] * x[2],
        a[2] * x[0] + a[4] * x[1] + a[5] * x[2],
    )


@inlined
def _add(r: FloatArray, at: int, i: int, x: tuple[float, float, float]) -> None:
    r[at + i] += x[0]
    r[at + LANES + i] += x[1]
    r[at + 2 * LANES + i] += x[2]


@inlined
def _root(a: tuple[float, ...]) -> tuple[float, ...]:
    """LDLᵀ of a symmetric matrix: one over its pivots, 0 for those that are lost, and the factors (10, 20, 21)."""
    i0 = 1.0 / a[0] if a[0] > 0.0 else 0.0
    l1, l2 = a[1] * i0, a[2] * i0
    d1 = a[3] - l1 * a[1]
    i1 = 1.0 / d1 if d1 > _LOST * a[3] else 0.0
    t = a[4] - l1 * a[2]
    l3 = t * i1
    d2 = a[5] - l2 * a[2] - l3 * t
    return i0, i1, 1.0 / d2 if d2 > _LOST * a[5] else 0.0, l1, l2, l3


@inlined
def _solved(root: tuple[float, ...], b: tuple[float, float, float]) -> tuple[float, float, float]:
    i0, i1, i2, l1, l2, l3 = root
    y1 = b[1] - l1 * b[0]
    x2 = (b[2] - l2 * b[0] - l3 * y1) * i2
    x1 = y1 * i1 - l3 * x2
    return b[0] * i0 - l1 * x1 - l2 * x2, x1, x2


@internal
def fill_normal_equations(sensors: FloatArray, w: FloatArray, rows: FloatArray, free_range: float) -> None:
    """Scaled moment, χ² and normal equations of the trial states."""
    fill_tangents(w, free_range)
    w[SUM_FIELD:SPACE] = 0.0
    w[TRIAL + NORMAL : TRIAL + NORMAL + 9 * LANES] = 0.0
    for s in range(len(sensors)):
        _fill_fields(sensors[s], s == 0, w, rows[s])
    _fit_moments(w)
    for s in range(len(sensors)):
        _fill_jacobian(sensors[s], w, rows[s])
    _eliminate(w)


@inlined
def _fill_fields(sensor: FloatArray, first: bool, w: FloatArray, r: FloatArray) -> None:
    """Fields at a sensor, and what it adds to their sums."""
    x0, x1, x2 = sensor[0], sensor[1], sensor[2]
    for i in range(LANES):
        scale = w[TRIAL + 3 * LANES + i]
        v = (scale * x0 - w[TRIAL + i], scale * x1 - w[TRIAL + LANES + i], scale * x2 - w[TRIAL + 2 * LANES + i])
        inverse = 1.0 / math.sqrt(dot(v, v))
        n = (v[0] * inverse, v[1] * inverse, v[2] * inverse)
        r[DIRECTION + i], r[DIRECTION + LANES + i], r[DIRECTION + 2 * LANES + i] = n
        r[DIRECTION + 3 * LANES + i] = inverse
        cube = inverse * inverse * inverse
        t0, t1, t2 = 3.0 * cube * n[0], 3.0 * cube * n[1], 3.0 * cube * n[2]
        f = (t0 * n[0] - cube, t0 * n[1], t0 * n[2], t1 * n[1] - cube, t1 * n[2], t2 * n[2] - cube)
        _put_six(r, FIELD, i, f)
    if first:
        for i in range(6 * LANES):
            w[FIRST + i] = r[FIELD + i]
    for i in range(LANES):
        f, f0, weight, z = _six(r, FIELD, i), _six(w, FIRST, i), r[WEIGHT + i], three(r, PULL, i)
        f = (f[0] - f0[0], f[1] - f0[1], f[2] - f0[2], f[3] - f0[3], f[4] - f0[4], f[5] - f0[5])
        a0, a1, a2 = (f[0], f[1], f[2]), (f[1], f[3], f[4]), (f[2], f[4], f[5])
        _add(w, SUM_FIELD, i, _scaled(weight, a0))
        _add(w, SUM_FIELD + 3 * LANES, i, (weight * f[3], weight * f[4], weight * f[5]))
        _add(w, SQUARE, i, _scaled(weight, (dot(a0, a0), dot(a0, a1), dot(a0, a2))))
        _add(w, SQUARE + 3 * LANES, i, _scaled(weight, (dot(a1, a1), dot(a1, a2), dot(a2, a2))))
        _add(w, PRODUCT, i, _times(f, z))
        _put_six(r, FIELD, i, f)


@inlined
def _scaled(t: float, x: tuple[float, float, float]) -> tuple[float, float, float]:
    return t * x[0], t * x[1], t * x[2]


@internal
def _fit_moments(w: FloatArray) -> None:
    """Moment and common field that fit best, and their χ²."""
    for i in range(LANES):
        common, square, product, energy = w[COMMON + i], _six(w, SQUARE, i), three(w, PRODUCT, i), w[ENERGY + i]
        f = _six(w, SUM_FIELD, i)
        a0, a1, a2 = (f[0], f[1], f[2]), (f[1], f[3], f[4]), (f[2], f[4], f[5])
        square = (
            square[0] - common * dot(a0, a0), square[1] - common * dot(a0, a1), square[2] - common * dot(a0, a2),
            square[3] - common * dot(a1, a1), square[4] - common * dot(a1, a2), square[5] - common * dot(a2, a2),
        )  # fmt: skip
        m = _solved(_root(square), product)
        offset = _times(f, m)
        _put_six(w, SQUARE, i, square)
        w[TRIAL + MOMENT + i], w[TRIAL + MOMENT + LANES + i], w[TRIAL + MOMENT + 2 * LANES + i] = m
        w[TRIAL + CHI2 + i] = energy - dot(product, m)
        w[OFFSET + i], w[OFFSET + LANES + i], w[OFFSET + 2 * LANES + i] = _scaled(-common, offset)


@inlined
def _fill_jacobian(sensor: FloatArray, w: FloatArray, r: FloatArray) -> None:
    """What a sensor adds to the normal equations."""
    x0, x1, x2 = sensor[0], sensor[1], sensor[2]
    for i in range(LANES):
        f, weight, m = _six(r, FIELD, i), r[WEIGHT + i], three(w, TRIAL + MOMENT, i)
        n, inverse = three(r, DIRECTION, i), r[DIRECTION + 3 * LANES + i]
        quartic = 3.0 * inverse * inverse * inverse * inverse
        along = quartic * dot(n, m)
        f0, f1, f2 = 5.0 * along * n[0], 5.0 * along * n[1], 5.0 * along * n[2]
        q0, q1, q2 = quartic * n[0], quartic * n[1], quartic * n[2]
        change = (  # gradient tensor of the moment's field
            along + 2.0 * q0 * m[0] - f0 * n[0], q0 * m[1] + q1 * m[0] - f0 * n[1], q0 * m[2] + q2 * m[0] - f0 * n[2],
            along + 2.0 * q1 * m[1] - f1 * n[1], q1 * m[2] + q2 * m[1] - f1 * n[2], along + 2.0 * q2 * m[2] - f2 * n[2],
        )  # fmt: skip
        t0, t1, t2 = three(w, TANGENT, i), three(w, TANGENT + 3 * LANES, i), three(w, TANGENT + 6 * LANES, i)
        t23 = w[TANGENT + 9 * LANES + i]
        # What moves the source moves a sensor the other way.
        j0, j1 = _times(change, (-t0[0], -t0[1], -t0[2])), _times(change, (-t1[0], -t1[1], -t1[2]))
        j2 = _times(change, (t23 * x0 - t2[0], t23 * x1 - t2[1], t23 * x2 - t2[2]))
        h, z, c = _times(f, m), three(r, PULL, i), three(w, OFFSET, i)
        left = less(z, weight, (h[0] + c[0], h[1] + c[1], h[2] + c[2]))
        b0, b1, b2 = _scaled(weight, j0), _scaled(weight, j1), _scaled(weight, j2)
        _add(w, SUM_JACOBIAN, i, b0)
        _add(w, SUM_JACOBIAN + 3 * LANES, i, b1)
        _add(w, SUM_JACOBIAN + 6 * LANES, i, b2)
        _add(w, ALONG, i, _times(f, b0))
        _add(w, ALONG + 3 * LANES, i, _times(f, b1))
        _add(w, ALONG + 6 * LANES, i, _times(f, b2))
        _add(w, TRIAL + NORMAL, i, (dot(j0, b0), dot(j0, b1), dot(j0, b2)))
        _add(w, TRIAL + NORMAL + 3 * LANES, i, (dot(j1, b1), dot(j1, b2), dot(j2, b2)))
        _add(w, TRIAL + NORMAL + 6 * LANES, i, (dot(j0, left), dot(j1, left), dot(j2, left)))


@internal
def _eliminate(w: FloatArray) -> None:
    """Take the common field's and the moment's part out of the normal equations."""
    for i in range(LANES):
        common, square, n, f = w[COMMON + i], _six(w, SQUARE, i), _six(w, TRIAL + NORMAL, i), _six(w, SUM_FIELD, i)
        b0, b1 = three(w, SUM_JACOBIAN, i), three(w, SUM_JACOBIAN + 3 * LANES, i)
        b2 = three(w, SUM_JACOBIAN + 6 * LANES, i)
        a0, a1, a2 = three(w, ALONG, i), three(w, ALONG + 3 * LANES, i), three(w, ALONG + 6 * LANES, i)
        root = _root(square)
        c0, c1, c2 = _scaled(common, b0), _scaled(common, b1), _scaled(common, b2)
        a0, a1, a2 = less(a0, 1.0, _times(f, c0)), less(a1, 1.0, _times(f, c1)), less(a2, 1.0, _times(f, c2))
        m0, m1, m2 = _solved(root, a0), _solved(root, a1), _solved(root, a2)
        n = (
            n[0] - dot(b0, c0) - dot(a0, m0), n[1] - dot(b0, c1) - dot(a0, m1), n[2] - dot(b0, c2) - dot(a0, m2),
            n[3] - dot(b1, c1) - dot(a1, m1), n[4] - dot(b1, c2) - dot(a1, m2), n[5] - dot(b2, c2) - dot(a2, m2),
        )  # fmt: skip
        _put_six(w, TRIAL + NORMAL, i, n)
