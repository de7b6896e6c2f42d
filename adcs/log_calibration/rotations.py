"""Mountings of sensors as autopilots number them."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from arrays.typing import FloatArray

# Roll, pitch and yaw in units of 45°, in the order of MAVLink's MAV_SENSOR_ROTATION, which PX4 and ArduPilot share.
_ANGLES = (
    *((0, 0, yaw) for yaw in range(8)),
    *((4, 0, yaw) for yaw in range(4)),
    (0, 4, 0),
    *((4, 0, yaw) for yaw in range(5, 8)),
    *((2, 0, yaw) for yaw in range(4)),
    *((6, 0, yaw) for yaw in range(4)),
    (0, 2, 0),
    (0, 6, 0),
    (0, 4, 2),
    (0, 4, 6),
    (2, 2, 0),
    (4, 2, 0),
    (6, 2, 0),
    (2, 4, 0),
    (6, 4, 0),
    (2, 6, 0),
    (4, 6, 0),
    (6, 6, 0),
    (2, 4, 2),
    (2, 0, 6),
)


def rotation_matrices() -> FloatArray:
    """Return the rotations (38, 3, 3), body axes from sensor axes, in the order of their numbers."""
    euler = 45.0 * np.array(_ANGLES, dtype=np.float64)
    return Rotation.from_euler("xyz", euler, degrees=True).as_matrix()


def nearest_rotation(body_from_sensor: FloatArray) -> tuple[int, str]:
    """Return number and name of the nearest rotation, such as 2 and ROTATION_YAW_90."""
    number = int(np.argmax(np.einsum("kij,ij->k", rotation_matrices(), body_from_sensor)))
    parts = [
        f"{word}_{45 * steps}" for word, steps in zip(("ROLL", "PITCH", "YAW"), _ANGLES[number], strict=True) if steps
    ]
    return number, "_".join(["ROTATION", *parts]) if parts else "ROTATION_NONE"
