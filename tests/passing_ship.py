"""A ship that passes sensors on the bottom on several headings, and plain least squares of what they differ by."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import arrays
import magloc
from tests.oracles import magpylib_field

FloatArray = NDArray[np.float64]
ARRAY = arrays.tetrahedron(6.0, noise_T=1e-10)
AMBIENT_T = np.array([1.4e-6, 17.8e-6, -47.1e-6])
MU0 = 4e-7 * np.pi
PERMANENT_AM2 = np.array([9000.0, 1500.0, -16000.0])
POLARISABILITY_M3 = np.array([[400.0, 25.0, 40.0], [25.0, 200.0, -30.0], [40.0, -30.0, 150.0]])
EDDY_M3_S = np.array([60.0, 120.0, 90.0])
SPEED_M_S, REACH_M, DEPTH_M = 3.0, 45.0, 18.0
HEADINGS = (90.0, 0.0, 270.0, 180.0)


@dataclass(frozen=True)
class Pass:
    """One pass: what is true at the times of its rows."""

    time_s: FloatArray
    position_m: FloatArray
    rotation: Rotation

    @property
    def path(self) -> magloc.ObjectPath:
        return magloc.ObjectPath(self.time_s, self.position_m, self.rotation)


def straight_pass(heading_deg: float, *, aside_m: float = 5.0, start_s: float = 0.0, roll_deg: float = 0.0) -> Pass:
    """A straight pass, which rolls with a period of seven seconds."""
    t = np.arange(0.0, 2.0 * REACH_M / SPEED_M_S, 1.0)
    yaw = np.radians(90.0 - heading_deg)
    forward, left = np.array([np.cos(yaw), np.sin(yaw), 0.0]), np.array([-np.sin(yaw), np.cos(yaw), 0.0])
    position = np.outer(SPEED_M_S * t - REACH_M, forward) + aside_m * left + [0.0, 0.0, DEPTH_M]
    roll = roll_deg * np.sin(2.0 * np.pi * t / 7.0)
    angles = np.stack([np.full_like(t, 90.0 - heading_deg), np.zeros_like(t), roll], axis=-1)
    return Pass(start_s + t, position, Rotation.from_euler("ZYX", angles, degrees=True))


def four_passes(roll_deg: float = 0.0) -> list[Pass]:
    return [straight_pass(h, start_s=100.0 * k, roll_deg=roll_deg) for k, h in enumerate(HEADINGS)]


def moments(
    of_pass: Pass, polarisability_m3: FloatArray = POLARISABILITY_M3, eddy_m3_s: FloatArray | None = None
) -> FloatArray:
    """Moments (n, 3) in the world, written out row by row."""
    found = []
    field = of_pass.rotation.inv().apply(AMBIENT_T)
    rate = np.gradient(field, of_pass.time_s, axis=0)
    for R, b, db in zip(of_pass.rotation.as_matrix(), field, rate, strict=True):
        body = PERMANENT_AM2 + polarisability_m3 @ b / MU0
        if eddy_m3_s is not None:
            body = body - eddy_m3_s * db / MU0
        found.append(R @ body)
    return np.array(found)


def readings_of(
    of_pass: Pass, moment_Am2: FloatArray, seed: int | None = None, array: arrays.SensorArray = ARRAY
) -> magloc.Readings:
    """By magpylib, with the ambient field that its columns have; the sensors read it too."""
    fields = [magpylib_field(array.positions, p, m) for p, m in zip(of_pass.position_m, moment_Am2, strict=True)]
    values = array.readings_of(np.array(fields) + AMBIENT_T)
    if seed is not None:
        values = values + array.channel_noise_T * np.random.default_rng(seed).normal(size=values.shape)
    ambient = np.tile(AMBIENT_T, (len(values), 1))
    return magloc.Readings(values, time_s=of_pass.time_s, ambient_T=ambient)


def shifted(path: magloc.ObjectPath, offset_m: FloatArray) -> magloc.ObjectPath:
    return replace(path, position_m=path.position_m + offset_m)


def least_squares(readings: magloc.Readings, positions_m: FloatArray, M: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Parameters of m = M θ by plain base differences with their covariance (13), and their covariance."""
    rows, values = [], []
    root = np.linalg.inv(np.linalg.cholesky(1e-20 * np.kron(np.eye(3) + 1.0, np.eye(3))))
    for reading, p, basis in zip(readings.values_T, positions_m, M, strict=True):
        units = np.stack([magpylib_field(ARRAY.positions, p, axis) for axis in np.eye(3)], axis=-1)
        differences = (units[:3] - units[3]).reshape(9, 3)
        of_sensors = reading.reshape(4, 3)
        rows.append(root @ differences @ basis)
        values.append(root @ (of_sensors[:3] - of_sensors[3]).ravel())
    A, y = np.concatenate(rows), np.concatenate(values)
    return np.linalg.lstsq(A, y, rcond=None)[0], np.linalg.inv(A.T @ A)
