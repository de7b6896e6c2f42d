"""Sensors of a log by the names of autopilots and ROS: gyro, accelerometer, magnetometers, the own attitude."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from arrays.io.errors import InputError
from arrays.typing import BoolArray, FloatArray
from magloc.logs.channels import Log

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

_XYZ = ("x", "y", "z")
_LEAST_RATE_Hz = 10.0  # slower topics are for supervision
_UNIT_WITHIN = 0.1  # largest error of the length of a quaternion
_GYROS = (
    r"sensor_combined\.gyro_rad\[0\]",
    r"vehicle_imu(\[\d+\])?\.delta_angle\[0\]",
    r"sensor_gyro(\[\d+\])?\.x",
    r"vehicle_angular_velocity\.xyz\[0\]",
    r"IMU\d?(\[\d+\])?\.GyrX",
    r".*\.angular_velocity\.x",
)
_ACCELEROMETERS = (
    r"sensor_combined\.accelerometer_m_s2\[0\]",
    r"vehicle_imu(\[\d+\])?\.delta_velocity\[0\]",
    r"sensor_accel(\[\d+\])?\.x",
    r"vehicle_acceleration\.xyz\[0\]",
    r"IMU\d?(\[\d+\])?\.AccX",
    r".*\.linear_acceleration\.x",
)
_MAGNETOMETERS = (
    r"vehicle_magnetometer(\[\d+\])?\.magnetometer_ga\[0\]",
    r"sensor_combined\.magnetometer_ga\[0\]",
    r"sensor_mag(\[\d+\])?\.x",
    r"MAG\d?(\[\d+\])?\.MagX",
    r".*\.magnetic_field\.x",
)


@dataclass(frozen=True, eq=False)
class VectorReadings:
    """Readings of a sensor of three axes, on its own clock.

    Attributes
    ----------
    name : str
        Channel of the first axis.
    time_s : ndarray, shape (n,)
        Ascending times.
    values : ndarray, shape (n, 3)
        rad/s, m/s² or T, in the axes of the log.
    """

    name: str
    time_s: FloatArray
    values: FloatArray


@dataclass(frozen=True, eq=False)
class LogSensors:
    """Sensors of a log.

    Attributes
    ----------
    gyro, accelerometer : VectorReadings
    magnetometers : tuple of VectorReadings
        Those that work, the calibrated ones first.
    own_attitude : tuple of (ndarray, Rotation), optional
        Times and attitudes that the log itself states, east, north, up from the axes of the log.
    warnings : tuple of str
        Sentences about sensors that are ignored.
    """

    gyro: VectorReadings
    accelerometer: VectorReadings
    magnetometers: tuple[VectorReadings, ...]
    own_attitude: tuple[FloatArray, Rotation] | None
    warnings: tuple[str, ...]


def find_sensors(log: Log) -> LogSensors:
    """Return the sensors of a log of PX4, ArduPilot or ROS.

    Raises
    ------
    InputError
        The log has no gyro or accelerometer, one of them stands still, or a clock goes back.
    """
    gyro, accelerometer = _inertial(log, "gyro", _GYROS), _inertial(log, "accelerometer", _ACCELEROMETERS)
    found = list(_candidates(log, _MAGNETOMETERS))
    working = [sensor for sensor in found if readings_vary(sensor.values)]
    warnings = [
        f"{log.path}: the magnetometer {sensor.name} reads {sensor.values[0].tolist()} T in all rows and is ignored"
        for sensor in found
        if sensor not in working
    ]
    return LogSensors(gyro, accelerometer, tuple(working), _own_attitude(log), tuple(warnings))


def magnetometer_names(log: Log) -> list[str]:
    """Return the first channels of the magnetometers of a log, by the best of the names that an autopilot has."""
    found = ([name for name in log if re.fullmatch(pattern, name)] for pattern in _MAGNETOMETERS)
    return next(filter(None, found), [])


def _inertial(log: Log, kind: str, patterns: Sequence[str]) -> VectorReadings:
    """Return the first sensor that is fast enough, or the one with the most readings."""
    found = list(_candidates(log, patterns))
    if not found:
        expected = "one of PX4 (sensor_combined, vehicle_imu), ArduPilot (IMU) or ROS (sensor_msgs/Imu), or a CSV file"
        raise InputError(f"{log.path}: found no {kind}, expected {expected}.")
    fast = (each for each in found if log[each.name].rate_Hz >= _LEAST_RATE_Hz)
    chosen = next(fast, max(found, key=lambda each: len(each.time_s)))
    if not readings_vary(chosen.values):
        values = chosen.values[0].tolist()
        raise InputError(f"{log.path}: found a {kind} {chosen.name} that stands at {values}, expected one that works.")
    return chosen


def _candidates(log: Log, patterns: Sequence[str]) -> Iterator[VectorReadings]:
    """Yield the sensors whose first channel matches, in the order of the patterns."""
    for pattern in patterns:
        for name in log:
            if not re.fullmatch(pattern, name) or len(log[name]) < 2:
                continue
            names = axes_of(name)
            if not set(names) <= set(log):
                continue
            time_s, values = log.vectors(names)
            if ".delta_" in name:  # PX4 logs angles and speeds over their time
                kind = "angle" if "angle" in name else "velocity"
                topic = name.partition(".")[0]
                over_s = log.vectors([*names, f"{topic}.delta_{kind}_dt"])[1][:, 3:]
                values = values / np.where(over_s > 0.0, over_s, np.nan)
            yield VectorReadings(name, time_s, values)


def readings_vary(values: FloatArray) -> bool:
    """Return whether the complete rows of readings (n, k) differ; those of a dead sensor are equal or missing."""
    known = values[np.isfinite(values).all(axis=1)]
    return len(known) > 0 and bool(np.ptp(known, axis=0).any())


def axes_of(name: str) -> tuple[str, str, str]:
    """Return the channels of the three axes, given the channel of the first."""
    if name.endswith("[0]"):
        stem = name.removesuffix("[0]")
        return f"{stem}[0]", f"{stem}[1]", f"{stem}[2]"
    stem, last = name[:-1], name[-1]
    x, y, z = _XYZ if last == "x" else ("X", "Y", "Z")
    return stem + x, stem + y, stem + z


def are_attitudes(quaternions: FloatArray) -> BoolArray:
    """Return the rows (n,) of quaternions (n, 4) whose length is 1 to a tenth."""
    return np.asarray(np.abs(np.linalg.norm(quaternions, axis=1) - 1.0) < _UNIT_WITHIN)


def _own_attitude(log: Log) -> tuple[FloatArray, Rotation] | None:
    """Return times and attitudes that the log states; None if it states none."""
    from scipy.spatial.transform import Rotation

    # North, east, down become east, north, up: the axes of the body stay.
    enu_from_ned = Rotation.from_matrix([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    quaternions = [f"vehicle_attitude.q[{i}]" for i in (1, 2, 3, 0)]
    angles = [f"ATT.{name}" for name in ("Yaw", "Pitch", "Roll")]
    if set(quaternions) <= set(log):
        time_s, values = log.vectors(quaternions)
        is_whole = are_attitudes(values)
        return (time_s[is_whole], enu_from_ned * Rotation.from_quat(values[is_whole])) if is_whole.any() else None
    if set(angles) <= set(log):
        time_s, values = log.vectors(angles)
        return time_s, enu_from_ned * Rotation.from_euler("ZYX", values)
    for name in log:
        if name.endswith(".orientation.x"):
            time_s, values = log.vectors([f"{name[:-1]}{axis}" for axis in "xyzw"])
            if np.ptp(values, axis=0).any() and (np.linalg.norm(values, axis=1) > 0.5).all():
                return time_s, Rotation.from_quat(values)
    return None
