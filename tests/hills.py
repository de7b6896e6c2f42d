"""Walks over hills and over flat ground: the same targets, noise and errors of the pose."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

import arrays
import magloc
from arrays.typing import FloatArray
from magloc.fields.points import field_at_points

RATE_Hz, SPEED_M_S, CLEARANCE_M = 12.0, 1.5, 1.2
AMBIENT_T = np.array([1e-6, 20e-6, -44e-6])
POSE = arrays.PoseUncertainty(position_m=0.02, correlation_s=10.0)
PAIR = arrays.SensorArray(
    (arrays.Sensor("low", "scalar", (0.0, 0.0, 0.0), 1e-10), arrays.Sensor("high", "scalar", (0.0, 0.0, 1.0), 1e-10)),
    pose=POSE,
)
Heights = Callable[[FloatArray], FloatArray]


def plain(xy_m: FloatArray) -> FloatArray:
    """Heights of flat ground."""
    return np.zeros(xy_m.shape[:-1])


def hills(xy_m: FloatArray) -> FloatArray:
    """Heights of hills with 2 m of relief and slopes of up to 20°."""
    x, y = xy_m[..., 0], xy_m[..., 1]
    return np.asarray(33.0 + 0.6 * np.sin(2.0 * np.pi * x / 18.0 + 1.0) + 0.4 * np.sin(2.0 * np.pi * y / 13.0))


def terrain_of(heights: Heights) -> magloc.Terrain:
    """The ground as a map of one point per square metre has it."""
    axis = np.arange(-25.0, 26.0)
    xy = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    return magloc.Terrain.from_points(np.column_stack([xy, heights(xy)]))


class Walk(NamedTuple):
    """Readings over buried dipoles, and these."""

    readings: magloc.Readings
    position_m: FloatArray
    depth_m: FloatArray


def walk(seed: int, heights: Heights, half_m: float, number: int, *, level: bool = False) -> Walk:
    """Lines a metre apart that follow the ground, or stay level above it, over targets and deep stones."""
    rng = np.random.default_rng(seed)
    x = np.arange(-half_m, half_m + 1e-9, SPEED_M_S / RATE_Hz)
    y = np.arange(-half_m, half_m + 0.1)
    xy = np.concatenate([np.column_stack([x[:: 1 - 2 * (i % 2)], np.full(len(x), at)]) for i, at in enumerate(y)])
    n = len(xy)
    time_s = np.arange(n) / RATE_Hz + np.repeat(3.0 * np.arange(len(y)), len(x))
    places = np.zeros((0, 2))
    while len(places) < number:
        place = rng.uniform(1.0 - half_m, half_m - 1.0, 2)
        if not len(places) or np.linalg.norm(places - place, axis=1).min() > 4.5:
            places = np.vstack([places, place])
    depth = rng.uniform(0.3, 1.5, number)
    moment = rng.normal(size=(number, 3))
    moment *= (10.0 ** rng.uniform(0.0, 1.2, number) / np.linalg.norm(moment, axis=1))[:, None]
    stones = rng.uniform(-half_m - 5.0, half_m + 5.0, (12, 2))
    buried = np.vstack([np.column_stack([places, -depth]), np.column_stack([stones, -rng.uniform(8.0, 12.0, 12)])])
    buried[:, 2] += heights(buried[:, :2])
    moments = np.vstack([moment, rng.normal(size=(12, 3), scale=15.0)])
    error = rng.normal(size=(n, 3), scale=POSE.position_m)
    lasting = np.exp(-np.diff(time_s) / POSE.correlation_s)
    for i in range(1, n):
        error[i] = lasting[i - 1] * error[i - 1] + math.sqrt(1.0 - lasting[i - 1] ** 2) * error[i]
    bob = CLEARANCE_M + 0.1 * np.sin(2.0 * np.pi * time_s / 7.0)
    ground = np.full(n, heights(xy).max()) if level else heights(xy)
    stated = np.column_stack([xy, ground + bob])
    fields = [field_at_points(stated + error + sensor, buried, moments) for sensor in PAIR.positions]
    values = np.linalg.norm(AMBIENT_T + np.array(fields), axis=2).T + rng.normal(size=(n, 2), scale=1e-10)
    turn = Rotation.from_quat(np.tile([0.0, 0.0, 0.0, 1.0], (n, 1)))
    readings = magloc.Readings(
        values,
        time_s=time_s,
        array_position_m=stated,
        array_rotation=turn,
        ambient_T=np.tile(AMBIENT_T, (n, 1)),
    )
    return Walk(readings, buried[:number], depth)


def depth_errors(flown: Walk, found: magloc.Survey) -> FloatArray:
    """Errors of the depths of all targets; infinite for one that was not found."""
    errors = np.full(len(flown.depth_m), np.inf)
    for i, position in enumerate(flown.position_m):
        apart = np.linalg.norm(found.position_m - position, axis=1)
        if apart.min(initial=np.inf) < 0.5:
            errors[i] = found[int(apart.argmin())].depth_m - flown.depth_m[i]
    return errors
