"""Trials of the BROAD benchmark, and errors of an attitude as it defines them.

Source: D. Laidig, M. Caruso, A. Cereatti, T. Seel, BROAD - A Benchmark for Robust Inertial Orientation Estimation,
Data 6(7), 2021.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from adcs import quaternion
from adcs.complementary.inertial_magnetic import InertialMagneticRecord
from arrays.typing import BoolArray, FloatArray


@dataclass(frozen=True)
class OrientationErrors:
    """Root mean squares of an attitude's errors [rad], as the BROAD benchmark defines them."""

    total: float
    heading: float
    inclination: float


def orientation_errors(q: FloatArray, q_true: FloatArray, counted: BoolArray) -> OrientationErrors:
    """Errors where they are counted and the truth is known: angle, its part around the vertical, and the rest.

    Shape ``counted`` (n,). ``q``, ``q_true`` (n, 4): east, north, up from body; NaN where the truth is unknown.
    """
    known = counted & np.isfinite(q_true).all(axis=1)
    error = quaternion.multiply(q[known], quaternion.conjugate(quaternion.normalised(q_true[known])))
    w, x, y, z = np.abs(error).T
    angles = (
        2.0 * np.arctan2(np.sqrt(x * x + y * y + z * z), w),
        2.0 * np.arctan2(z, w),
        2.0 * np.arctan2(np.hypot(x, y), np.hypot(w, z)),
    )
    return OrientationErrors(*(float(np.sqrt(np.mean(angle**2))) for angle in angles))


@dataclass(frozen=True, eq=False)
class Trial:
    """A recording with optical truth."""

    record: InertialMagneticRecord
    q_true: FloatArray  # (n, 4): east, north, up from body, NaN where unknown
    position_m: FloatArray  # (n, 3): NaN where unknown
    moving: BoolArray  # (n,): where errors are counted


def read_broad(path: Path) -> Trial:
    """Read a trial of the BROAD benchmark, a MAT file."""
    from scipy.io import loadmat

    content = loadmat(path)
    time_s = np.arange(len(content["imu_gyr"])) / float(content["sampling_rate"].item())
    record = InertialMagneticRecord(time_s, content["imu_gyr"], content["imu_acc"], 1e-6 * content["imu_mag"])
    return Trial(record, content["opt_quat"], content["opt_pos"], content["movement"].ravel().astype(bool))
