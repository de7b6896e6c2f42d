"""Table ``log`` of a scenario file: columns, units and conventions of a log."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from adcs import quaternion
from arrays.io.errors import InputError
from arrays.io.toml import RefusalError, Table, one_of
from arrays.typing import FloatArray, Vector

FIELD_UNITS = {"nT": 1e-9, "uT": 1e-6, "µT": 1e-6, "mT": 1e-3, "T": 1.0, "mG": 1e-7, "G": 1e-4}
RATE_UNITS = {"deg/s": math.pi / 180.0, "rad/s": 1.0, "mrad/s": 1e-3, "deg/h": math.pi / 648_000.0}
MOMENTUM_UNITS = {"Nms": 1.0, "mNms": 1e-3}
MOMENT_UNITS = {"Am2": 1.0, "mAm2": 1e-3}
ACCELERATION_UNITS = {"m/s2": 1.0, "g": 9.80665, "mg": 9.80665e-3}
_SI = {**FIELD_UNITS, **RATE_UNITS, **MOMENTUM_UNITS, **MOMENT_UNITS, **ACCELERATION_UNITS}  # all names differ
_SECONDS = {"seconds": 1.0, "milliseconds": 1e-3, "microseconds": 1e-6}
TIME_FORMATS = (*_SECONDS, "utc", "unix")
ORDERS = ("scalar-first", "scalar-last")
DIRECTIONS = ("inertial-from-body", "body-from-inertial")
_ALONG: tuple[Vector, Vector, Vector] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
Three = tuple[str, str, str]


class MountedTable(Table, kw_only=True):
    """Columns of a sensor, with its mounting."""

    mounting: tuple[Vector, Vector, Vector] = _ALONG  # body from sensor

    def check(self) -> None:
        """Raise RefusalError unless the mounting is a rotation."""
        matrix = np.array(self.mounting, dtype=np.float64)
        if np.abs(matrix @ matrix.T - np.eye(3)).max() > 1e-3:
            raise RefusalError("mounting", "found rows that are not orthonormal, expected a rotation, body from sensor")
        if np.linalg.det(matrix) < 0.0:
            raise RefusalError("mounting", "found a mirror (determinant -1), expected a rotation, body from sensor")

    def of(self, values: FloatArray) -> FloatArray:
        """Return readings of cells (n, 3) in SI and body axes."""
        return _SI.get(getattr(self, "unit", ""), 1.0) * values @ np.array(self.mounting, dtype=np.float64).T


class StarColumns(MountedTable, kw_only=True):
    """Columns of the star tracker's quaternions."""

    columns: tuple[str, str, str, str] = ("star_qw", "star_qx", "star_qy", "star_qz")
    order: Annotated[str, one_of(ORDERS)] = "scalar-first"
    direction: Annotated[str, one_of(DIRECTIONS)] = "inertial-from-body"

    def of(self, values: FloatArray) -> FloatArray:
        """Return attitudes of cells (n, 4), inertial from body, scalar last."""
        q = values if self.order == "scalar-first" else np.roll(values, 1, axis=1)
        if self.direction == "body-from-inertial":
            q = quaternion.conjugate(q)
        from scipy.spatial.transform import Rotation

        body_from_sensor = Rotation.from_matrix(np.array(self.mounting, dtype=np.float64))
        return np.roll(quaternion.multiply(q, quaternion.from_rotation(body_from_sensor.inv())), -1, axis=1)


class GyroColumns(MountedTable, kw_only=True):
    """Columns of the gyro's rates."""

    columns: Three = ("gyro_x_deg_s", "gyro_y_deg_s", "gyro_z_deg_s")
    unit: Annotated[str, one_of(RATE_UNITS)] = "deg/s"


class MagnetometerColumns(MountedTable, kw_only=True):
    """Columns of the magnetometer's fields."""

    columns: Three = ("field_x_nT", "field_y_nT", "field_z_nT")
    unit: Annotated[str, one_of(FIELD_UNITS)] = "nT"


class SunColumns(MountedTable, kw_only=True):
    """Columns of the direction to the Sun."""

    columns: Three = ("sun_x", "sun_y", "sun_z")


class WheelColumns(MountedTable, kw_only=True):
    """Columns of the total momentum of the wheels."""

    columns: Three = ("wheels_x_Nms", "wheels_y_Nms", "wheels_z_Nms")
    unit: Annotated[str, one_of(MOMENTUM_UNITS)] = "Nms"


class TorquerColumns(MountedTable, kw_only=True):
    """Columns of the commanded magnetic moment."""

    columns: Three = ("torquers_x_Am2", "torquers_y_Am2", "torquers_z_Am2")
    unit: Annotated[str, one_of(MOMENT_UNITS)] = "Am2"


class LogTable(Table, kw_only=True):
    """Table of the columns that are read, with their units; other columns are ignored."""

    time: str = "time_s"
    time_format: Annotated[str, one_of(TIME_FORMATS)] = "seconds"
    star_tracker: StarColumns | None = None
    gyro: GyroColumns | None = None
    magnetometer: MagnetometerColumns | None = None
    sun_sensor: SunColumns | None = None
    wheels: WheelColumns | None = None
    torquers: TorquerColumns | None = None


Columns = StarColumns | GyroColumns | MagnetometerColumns | SunColumns | WheelColumns | TorquerColumns
STANDARD: dict[str, Columns] = {
    "star": StarColumns(),
    "gyro_rad_s": GyroColumns(),
    "field_T": MagnetometerColumns(),
    "sun": SunColumns(),
    "wheels_Nms": WheelColumns(),
    "torquers_Am2": TorquerColumns(),
}
"""Columns of a log without a layout, by argument of :class:`adcs.Telemetry`."""


@dataclass(frozen=True, eq=False)
class LogLayout:
    """Columns, units and conventions of a log, as the table ``log`` of a scenario file states them.

    Attributes
    ----------
    start : datetime64
        Zero of the log's time, UTC.
    time : str
        Column of the time.
    time_format : str
        ``seconds``, ``milliseconds`` or ``microseconds`` since the start, ``utc`` (ISO 8601) or ``unix`` (seconds since
        1970).
    columns : dict
        Columns and their conventions by argument of :class:`adcs.Telemetry`.
    """

    start: np.datetime64
    time: str
    time_format: str
    columns: dict[str, Columns]

    @classmethod
    def of(cls, place: str, table: LogTable, start: np.datetime64) -> LogLayout:
        """Return the layout of a table; raise InputError unless it names a sensor."""
        named = (table.star_tracker, table.gyro, table.magnetometer, table.sun_sensor, table.wheels, table.torquers)
        columns = {name: given for name, given in zip(STANDARD, named, strict=True) if given is not None}
        if not columns:
            raise InputError(f"{place}: found no table of a sensor, expected one such as [log.gyro].")
        return cls(start, table.time, table.time_format, columns)

    def seconds(self, values: FloatArray) -> FloatArray:
        """Return times as seconds since the start."""
        if self.time_format in _SECONDS:
            return values * _SECONDS[self.time_format]
        return values - (self.start - np.datetime64("1970-01-01", "us")) / np.timedelta64(1, "s")
