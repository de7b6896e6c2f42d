"""Compiled recursions over the log of an inertial unit: gyro, level attitude, low-pass."""

from __future__ import annotations

import numpy as np

from adcs.complementary.explicit import BLOCK
from arrays.typing import FloatArray
from magloc import core


def gyro_attitudes(rate_rad_s: FloatArray, dt_s: FloatArray) -> FloatArray:
    """Return the attitudes (n, 4) of the gyro alone, starting with the identity.

    ``rate_rad_s`` (n, 3): mean over the step ``dt_s`` (n,) that ends at each instant.
    """
    q = np.empty((len(dt_s), 4))
    work = core.problem("gyro", rate=np.ascontiguousarray(rate_rad_s), dt=np.ascontiguousarray(dt_s), q=q)
    core.run("gyro_attitudes", work, len(q), block=BLOCK, chain=len(q))
    return q


def level_attitudes(q_gyro: FloatArray, up: FloatArray, part: FloatArray, start: FloatArray) -> FloatArray:
    """Rotate the attitudes (n, 4) of the gyro so that a vector (n, 3) in its frame points upwards.

    A part (n,) of the angle is corrected at each instant, as in the explicit filter with one vector. The corrections
    accumulate in a separate quaternion, which begins with ``start`` (4,).
    """
    q = np.empty_like(q_gyro)
    work = core.problem("level", start=tuple(start), q_gyro=q_gyro, up=up, part=part, q=q)
    core.run("level_attitudes", work, len(q), block=BLOCK, chain=len(q))
    return q


def low_pass(values: FloatArray, dt_s: FloatArray, time_s: float, start: FloatArray) -> FloatArray:
    """Filter values (n, k) by a Butterworth low-pass of second order, initially at rest at ``start``.

    Steps ``dt_s`` (n,) are arbitrary. The step response reaches 1 - 1/e after ``time_s``. The input within a step is
    the mean of both ends, and the solution is exact: z'' + 2s z' + 2s² z = 0 with s = 1/``time_s`` and z the distance
    from the input. NaN repeats the value before.
    """
    out = np.empty_like(values)
    steps = np.ascontiguousarray(dt_s) / time_s
    work = core.problem("butterworth", n_columns=values.shape[1], values=values, start=start, steps=steps, out=out)
    core.run("low_pass", work, len(values), block=BLOCK, chain=len(values))
    return out
