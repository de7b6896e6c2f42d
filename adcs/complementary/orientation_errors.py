"""Errors of an attitude on Earth, as the BROAD benchmark defines them.

Source: D. Laidig, M. Caruso, A. Cereatti, T. Seel, BROAD - A Benchmark for Robust Inertial Orientation Estimation,
Data 6(7), 2021.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from adcs import quaternion
from arrays.typing import BoolArray, FloatArray


@dataclass(frozen=True)
class OrientationErrors:
    """Root mean squares of an attitude's errors [rad]."""

    total: float
    heading: float
    inclination: float


def error_angles(q: FloatArray, q_true: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return total, heading and inclination errors, (n,) each [rad]; NaN where the truth is unknown.

    ``q``, ``q_true`` (n, 4): east, north, up from body.
    """
    error = quaternion.multiply(q, quaternion.conjugate(quaternion.normalised(q_true)))
    w, x, y, z = np.abs(error).T
    total = 2.0 * np.arctan2(np.sqrt(x * x + y * y + z * z), w)
    return total, 2.0 * np.arctan2(z, w), 2.0 * np.arctan2(np.hypot(x, y), np.hypot(w, z))


def without_heading_offset(q: FloatArray, q_true: FloatArray) -> tuple[FloatArray, float]:
    """Return `q_true` (n, 4) turned about up by the mean heading difference, and that difference [rad].

    True and magnetic north differ by the declination, which no inertial unit reads.
    """
    w, z = quaternion.multiply(q, quaternion.conjugate(quaternion.normalised(q_true))).T[[0, 3]]
    known = np.isfinite(w)
    offset = float(np.angle(np.sum((w[known] + 1j * z[known]) ** 2)))
    turn = np.array([math.cos(0.5 * offset), 0.0, 0.0, math.sin(0.5 * offset)])
    return quaternion.multiply(np.broadcast_to(turn, q_true.shape), q_true), offset


def orientation_errors(q: FloatArray, q_true: FloatArray, counted: BoolArray) -> OrientationErrors:
    """Return root mean squares of :func:`error_angles` over ``counted`` (n,) rows with known truth."""
    known = counted & np.isfinite(q_true).all(axis=1)
    angles = error_angles(q[known], q_true[known])
    return OrientationErrors(*(float(np.sqrt(np.mean(angle**2))) for angle in angles))
