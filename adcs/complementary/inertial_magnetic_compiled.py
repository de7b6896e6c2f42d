"""Compiled loop of :mod:`adcs.complementary.inertial_magnetic`: what it computes is what SciPy's filter does."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

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
