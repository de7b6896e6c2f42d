"""Compiled loops of :mod:`adcs.complementary.inertial_magnetic`, each over all rows of a record.

They are held to the explicit filter, to SciPy's filter, and to NumPy.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from adcs.complementary.filters_compiled import exp, unit
from adcs.satellite.dynamics_compiled import conjugate, multiply, normalised, quaternion_at, rotate_back, vector_at
from magloc.compilation import compiled

Array = NDArray[np.float64]


@compiled
def gyro_attitudes(rate_rad_s: Array, dt_s: Array) -> Array:
    """Attitudes (n, 4) of the gyro alone, from the identity at the first instant on; the rate is the mean of a step."""
    found = np.empty((len(rate_rad_s), 4))
    q = (1.0, 0.0, 0.0, 0.0)
    for i in range(len(rate_rad_s)):
        if i > 0:
            h, w = dt_s[i], rate_rad_s[i]
            q = normalised(multiply(q, exp((h * w[0], h * w[1], h * w[2]))))
        found[i, 0], found[i, 1], found[i, 2], found[i, 3] = q
    return found


@compiled
def rotated(q: Array, v: Array) -> Array:
    """Vectors (n, 3) turned by attitudes (n, 4), :func:`adcs.quaternion.rotate`."""
    found = np.empty((len(v), 3))
    for i in range(len(v)):
        found[i, 0], found[i, 1], found[i, 2] = rotate_back(conjugate(quaternion_at(q[i])), vector_at(v[i]))
    return found


@compiled
def levelled(q_gyro: Array, steady: Array, part: Array, start: Array) -> Array:
    """Attitudes (n, 4) of the gyro, turned so that a vector (n, 3) in its frame goes up, by a part (n,) of the angle.

    That of :func:`adcs.complementary.explicit.explicit_track` with one vector: the error is across the level, so that
    the correction is gathered in a quaternion of its own, from ``start`` (4,) on.
    """
    found = np.empty_like(q_gyro)
    correction = quaternion_at(start)
    for i in range(len(steady)):
        e, n, _ = rotate_back(conjugate(correction), unit(vector_at(steady[i])))
        correction = normalised(multiply(exp((part[i] * n, -part[i] * e, 0.0)), correction))
        found[i, 0], found[i, 1], found[i, 2], found[i, 3] = multiply(correction, quaternion_at(q_gyro[i]))
    return found


@compiled
def window_scatter(values: Array, window: NDArray[np.intp]) -> tuple[Array, Array, NDArray[np.intp]]:
    """Means (k, 3) of each window's readings, their largest standard deviation (k,), and how many there are (k,)."""
    k = window[-1] + 1
    means, squares, counts = np.zeros((k, 3)), np.zeros((k, 3)), np.zeros(k, np.intp)
    for second in (False, True):
        for i in range(len(values)):
            x, y, z = values[i]
            if np.isnan(x + y + z):
                continue
            if second:
                squares[window[i], 0] += (x - means[window[i], 0]) ** 2
                squares[window[i], 1] += (y - means[window[i], 1]) ** 2
                squares[window[i], 2] += (z - means[window[i], 2]) ** 2
            else:
                counts[window[i]] += 1
                means[window[i], 0] += x
                means[window[i], 1] += y
                means[window[i], 2] += z
        if not second:
            for j in range(k):
                means[j] /= counts[j]
    scatter = np.empty(k)
    for j in range(k):
        scatter[j] = np.sqrt(squares[j].max() / counts[j])
    return means, scatter, counts


@compiled
def low_pass(values: Array, dt_s: Array, time_s: float, start: Array) -> Array:
    """Butterworth filter of second order of (n, k) in any steps (n,), at rest at ``start``; NaN is the value before.

    It rises to 1 - 1/e within ``time_s``. Within a step, whose input is the mean of both ends, it is exact: with z the
    distance to it, z'' + 2s z' + 2s² z = 0.
    """
    s = 1.0 / time_s
    width = values.shape[1]
    found, y, slope, before = np.empty_like(values), start.copy(), np.zeros(width), start.copy()
    h = decay = c = d = 0.0
    for i in range(len(values)):
        if i > 0 and dt_s[i] != h:
            h = dt_s[i]
            decay, c, d = np.exp(-s * h), np.cos(s * h), np.sin(s * h)
        for axis in range(width):
            now = before[axis] if np.isnan(values[i, axis]) else values[i, axis]
            if i > 0:
                u = 0.5 * (before[axis] + now)
                z, fall = y[axis] - u, slope[axis] / s
                y[axis] = u + decay * (z * c + (fall + z) * d)
                slope[axis] = s * decay * (fall * c - (fall + 2.0 * z) * d)
            found[i, axis], before[axis] = y[axis], now
    return found


@compiled
def change_without_turns(
    q: Array, time_s: Array, rows: NDArray[np.intp], field_T: Array, good: NDArray[np.bool_], apart: int, lag_s: float
) -> float:
    """Sum of the squared differences of :func:`without_turns` between good rows (k,) that are so many apart."""
    steady, total = without_turns(q, time_s, rows, field_T, lag_s), 0.0
    for k in range(apart, len(rows)):
        if good[k] and good[k - apart]:
            for axis in range(3):
                total += (steady[k, axis] - steady[k - apart, axis]) ** 2
    return total


@compiled
def without_turns(q: Array, time_s: Array, rows: NDArray[np.intp], field_T: Array, lag_s: float) -> Array:
    """Readings (k, 3) of some rows, in a frame that does not turn, of a sensor that lags behind its attitude (n, 4).

    Attitudes between two rows are on straight lines; :func:`adcs.complementary.inertial_magnetic.turned_back` is the
    readable twin.
    """
    found, j = np.empty((len(rows), 3)), 0
    for k in range(len(rows)):
        then = time_s[rows[k]] - lag_s
        while j < len(time_s) - 2 and time_s[j + 1] <= then:
            j += 1
        part = min(max((then - time_s[j]) / (time_s[j + 1] - time_s[j]), 0.0), 1.0)
        a, b = quaternion_at(q[j]), quaternion_at(q[j + 1])
        between = (
            a[0] + part * (b[0] - a[0]),
            a[1] + part * (b[1] - a[1]),
            a[2] + part * (b[2] - a[2]),
            a[3] + part * (b[3] - a[3]),
        )
        found[k, 0], found[k, 1], found[k, 2] = rotate_back(conjugate(normalised(between)), vector_at(field_T[rows[k]]))
    return found
