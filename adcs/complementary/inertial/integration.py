"""What goes on from row to row in the log of an inertial unit, by compiled kernels: gyro, level, low-pass."""

from __future__ import annotations

import numpy as np

from adcs.complementary.explicit import BLOCK
from arrays.typing import FloatArray
from magloc import core


def gyro_attitudes(rate_rad_s: FloatArray, dt_s: FloatArray) -> FloatArray:
    """Return the attitudes (n, 4) of the gyro alone, from the identity at the first instant on.

    ``rate_rad_s`` (n, 3): mean over the step ``dt_s`` (n,) that ends at each instant.
    """
    q = np.empty((len(dt_s), 4))
    work = core.problem("gyro", rate=np.ascontiguousarray(rate_rad_s), dt=np.ascontiguousarray(dt_s), q=q)
    core.run("gyro_attitudes", work, len(q), block=BLOCK, chain=len(q))
    return q


def levelled(q_gyro: FloatArray, up: FloatArray, part: FloatArray, start: FloatArray) -> FloatArray:
    """Return the attitudes (n, 4) of the gyro, turned so that a vector (n, 3) in its frame goes up.

    A part (n,) of the angle is corrected at each instant, as the explicit filter does with one vector: the error is
    across the level, so that the correction is gathered in a quaternion of its own, from ``start`` (4,) on.
    """
    q = np.empty_like(q_gyro)
    work = core.problem("level", start=tuple(start), q_gyro=q_gyro, up=up, part=part, q=q)
    core.run("level_attitudes", work, len(q), block=BLOCK, chain=len(q))
    return q


def low_pass(values: FloatArray, dt_s: FloatArray, time_s: float, start: FloatArray) -> FloatArray:
    """Return values (n, k) after a Butterworth filter of second order, in any steps (n,), at rest at ``start``.

    It rises to 1 - 1/e within ``time_s``. Within a step, whose input is the mean of both ends, it is exact: with s the
    inverse of that time and z the distance to the input, z'' + 2s z' + 2s² z = 0. NaN is the value before.
    """
    out = np.empty_like(values)
    steps = np.ascontiguousarray(dt_s) / time_s
    work = core.problem("butterworth", n_columns=values.shape[1], values=values, start=start, steps=steps, out=out)
    core.run("low_pass", work, len(values), block=BLOCK, chain=len(values))
    return out
