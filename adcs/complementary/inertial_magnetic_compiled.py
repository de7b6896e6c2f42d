"""Compiled loops of :mod:`adcs.complementary.inertial_magnetic`: a low-pass, as SciPy's filter, and turns undone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from adcs.satellite.dynamics_compiled import conjugate, normalised, quaternion_at, rotate_back, vector_at
from magloc.compilation import compiled

Array = NDArray[np.float64]


@compiled
def low_pass(values: Array, dt_s: Array, time_s: float, start: Array) -> Array:
    """Butterworth filter of second order of (n, 3) in any steps (n,), at rest at ``start``; NaN is the value before.

    It rises to 1 - 1/e within ``time_s``. Within a step, whose input is the mean of both ends, it is exact: with z the
    distance to it, z'' + 2s z' + 2s² z = 0.
    """
    s = 1.0 / time_s
    found = np.empty_like(values)
    for axis in range(3):
        y, slope, before = start[axis], 0.0, start[axis]
        for i in range(len(values)):
            now = before if np.isnan(values[i, axis]) else values[i, axis]
            if i > 0:
                u = 0.5 * (before + now)
                z, angle = y - u, s * dt_s[i]
                decay, c, d = np.exp(-angle), np.cos(angle), np.sin(angle)
                y = u + decay * (z * c + (slope / s + z) * d)
                slope = decay * (slope * c - (slope + 2.0 * s * z) * d)
            found[i, axis] = y
            before = now
    return found


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
