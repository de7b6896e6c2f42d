"""Readings of an inertial unit from logs of drones and robots: PX4, ArduPilot, ROS."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np

from adcs import quaternion
from adcs.complementary.inertial_magnetic import InertialMagneticRecord
from arrays.io.errors import naming
from arrays.typing import FloatArray
from magloc.logs.channels import Log
from magloc.logs.sensors import find_sensors
from magloc.logs.time_base import magnetometer_lag, resample
from magloc.navigation.poses import rotations_at

_LOG = logging.getLogger(__name__)
_SURE = 3.0  # standard deviations from which on a lag is corrected
_USEFUL_LAG_S = 0.01  # largest standard deviation of a lag that is corrected


@dataclass(frozen=True, eq=False)
class RobotRecord:
    """Readings of a robot's inertial unit in the rows of its gyro, in the axes of the log.

    Attributes
    ----------
    record : InertialMagneticRecord
    own_attitude : ndarray, shape (n, 4), optional
        Attitude that the autopilot estimated, east, north, up from body, scalar first, NaN where unknown.
    lag_s : tuple of 2 floats, optional
        Lag of the magnetometer behind the gyro and its standard deviation; None without a magnetometer.
    """

    record: InertialMagneticRecord
    own_attitude: FloatArray | None
    lag_s: tuple[float, float] | None


def robot_record(log: Log) -> RobotRecord:
    """Return the readings of a robot's log.

    A slower sensor has readings in the rows nearest to its samples. A lag of the magnetometer is corrected where the
    log determines it.

    Raises
    ------
    InputError
        A sensor is missing or stands still, or a clock goes back.
    """
    sensors = find_sensors(log)
    for warning in sensors.warnings:
        _LOG.warning(warning)
    is_read = np.isfinite(sensors.gyro.values).all(axis=1)
    time_s, rate_rad_s = sensors.gyro.time_s[is_read], sensors.gyro.values[is_read]
    acceleration = _in_rows(time_s, sensors.accelerometer.time_s, sensors.accelerometer.values)
    field_T, lag_s = np.full((len(time_s), 3), np.nan), None
    if sensors.magnetometers:
        magnetometer = sensors.magnetometers[0]
        lag_s = magnetometer_lag(time_s, rate_rad_s, magnetometer.time_s, magnetometer.values)
        is_sure = lag_s[1] < _USEFUL_LAG_S and abs(lag_s[0]) > _SURE * lag_s[1]
        field_T = _in_rows(time_s, magnetometer.time_s - lag_s[0] * is_sure, magnetometer.values)
    else:
        _LOG.warning(f"{log.path}: found no magnetometer that works; the heading is relative to the first row")
    begins = [int(np.argmax(known)) for each in (acceleration, field_T) if (known := np.isfinite(each[:, 0])).any()]
    rows = slice(max(begins, default=0), None)
    with naming(log.path):
        record = InertialMagneticRecord(time_s[rows], rate_rad_s[rows], acceleration[rows], field_T[rows])
    own = None
    if sensors.own_attitude is not None:
        own_s, rotation = sensors.own_attitude
        known = np.isfinite(resample(record.time_s, own_s, np.zeros((len(own_s), 1)))[:, 0])
        own = np.where(known[:, None], quaternion.from_rotation(rotations_at(record.time_s, own_s, rotation)), np.nan)
    return RobotRecord(record, own, lag_s)


def _in_rows(time_s: FloatArray, sample_s: FloatArray, values: FloatArray) -> FloatArray:
    """Return the samples of a vector in rows, without those of a sensor that is not ready yet and reads zero."""
    return resample(time_s, sample_s, np.where((values == 0.0).all(axis=1)[:, None], np.nan, values), sparse=True)
