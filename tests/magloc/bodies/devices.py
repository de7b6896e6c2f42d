"""Arrays, bodies and poses that the tests of bodies share."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import Rotation

from arrays.array import SensorArray
from arrays.sensor import Sensor
from magloc.bodies.body import Magnet, MagnetBody, PoseLimits
from magloc.bodies.field import body_fields


def hall_ring(n: int = 3, *, noise_T: float = 1e-6, common_field_T: float | None = 50e-6) -> SensorArray:
    """Return n three-axis sensors on a circle of 20 mm, in the Earth's field."""
    angles = 2.0 * math.pi * np.arange(n) / n
    sensors = [
        Sensor(f"s{i + 1}", "vector", (0.01 * math.cos(a), 0.01 * math.sin(a), 0.0), noise_T=noise_T)
        for i, a in enumerate(angles)
    ]
    return SensorArray(tuple(sensors), common_field_T=common_field_T)


def knob(*, box_m: float = 0.003, angle_rad: float = math.radians(25.0), **of_magnets: float) -> MagnetBody:
    """Return a knob with three magnets that stand on a circle of 12 mm, 15 mm above the sensors."""
    directions = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, -1.0], [0.0, 1.0, -0.5]])
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    angles = 0.3 + 2.0 * math.pi * np.arange(3) / 3.0
    magnets = [
        Magnet(f"m{k + 1}", (0.006 * math.cos(a), 0.006 * math.sin(a), 0.0), tuple(0.05 * direction), **of_magnets)
        for k, (a, direction) in enumerate(zip(angles, directions, strict=True))
    ]
    limits = PoseLimits((-box_m, -box_m, 0.015 - box_m), (box_m, box_m, 0.015 + box_m), angle_rad)
    return MagnetBody(tuple(magnets), "knob", limits)


def random_poses(body: MagnetBody, n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return n poses, uniform within the limits of a body."""
    limits, R = body.limits, np.empty((0, 3, 3))
    position_m = rng.uniform(limits.low_m, limits.high_m, (n, 3))
    while len(R) < n:
        axis = rng.normal(size=(4 * n, 3))
        angle = rng.uniform(0.0, limits.angle_rad, 4 * n)
        kept = rng.uniform(size=4 * n) * (1.0 - math.cos(limits.angle_rad)) < 1.0 - np.cos(angle)
        vectors = (angle[:, None] * axis / np.linalg.norm(axis, axis=1)[:, None])[kept]
        R = np.concatenate([R, Rotation.from_rotvec(vectors).as_matrix()])
    return position_m, R[:n]


def readings_of(
    array: SensorArray, body: MagnetBody, position_m: np.ndarray, R: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Return readings (n, C) of poses in the array's ambient field and one that its prior describes, with noise."""
    fields = array.ambient_fields + body_fields(body, array.positions, position_m, R)
    if array.common_field_T is not None:
        fields = fields + array.common_field_T * rng.normal(size=(len(fields), 1, 3))
    return np.asarray(
        array.readings_of(fields) + array.channel_noise_T * rng.normal(size=(len(fields), array.n_channels))
    )
