"""Inertial unit, magnetometers and currents of a log: CSV files, and the logs of autopilots and robots."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path

import numpy as np

from adcs.io.imu_files import read_imu
from adcs.log_calibration.record import Series, VehicleLog
from arrays.io.csv import read_table
from arrays.io.errors import InputError, naming
from arrays.typing import FloatArray
from magloc.logs.channels import Log
from magloc.logs.read import log_reader, read_log

_GYRO = ("sensor_combined.gyro_rad[{012}]", "IMU.Gyr{XYZ}", "*angular_velocity.{xyz}")
_FORCE = ("sensor_combined.accelerometer_m_s2[{012}]", "IMU.Acc{XYZ}", "*linear_acceleration.{xyz}")
_MAGNETOMETERS = (
    ("sensor_mag.{xyz}", "sensor_mag[1].{xyz}", "sensor_mag[2].{xyz}", "sensor_mag[3].{xyz}"),
    ("vehicle_magnetometer.magnetometer_ga[{012}]", "vehicle_magnetometer[1].magnetometer_ga[{012}]"),
    ("sensor_combined.magnetometer_ga[{012}]",),
    ("MAG.Mag{XYZ}", "MAG[1].Mag{XYZ}", "MAG[2].Mag{XYZ}"),
    ("*magnetic_field.{xyz}",),
)
_CURRENTS = ("battery_status.current_a", "BAT.Curr", "actuator_controls_0.control[3]", "CTUN.ThO")
_PLACES = (
    ("vehicle_gps_position", "lat", "lon", "alt"),
    ("vehicle_gps_position", "latitude_deg", "longitude_deg", "altitude_msl_m"),
    ("GPS", "Lat", "Lng", "Alt"),
)
_LEAST_ROWS, _LEAST_RATE_Hz, _LONGEST_GAP_S = 20, 5.0, 0.25
_LEAST_RANGE = {"A": 0.5, "": 0.02}
_TEXT_CURRENTS = ("_A", "throttle")


@dataclass(frozen=True, eq=False)
class VehicleFile:
    """Log of a vehicle, with what its file states besides.

    Attributes
    ----------
    log : VehicleLog
    place : tuple of 3 floats, optional
        Latitude, longitude [deg] and height [m] of the receiver's first fix.
    date : str, optional
        Date of the log, ISO 8601.
    is_corrected : bool
        Whether the autopilot has corrected the fields by its own parameters.
    warnings : tuple of str
    """

    log: VehicleLog
    place: tuple[float, float, float] | None = None
    date: str | None = None
    is_corrected: bool = False
    warnings: tuple[str, ...] = ()


def read_vehicle(
    path: str | PathLike[str], layout: str | PathLike[str] | None = None, currents: Sequence[str] = ()
) -> VehicleFile:
    """Read the log of a vehicle.

    Parameters
    ----------
    path : str or path-like
        CSV file as for :func:`adcs.read_imu`, with more magnetometers in columns such as mast_x_nT and currents in
        columns such as battery_A or throttle; or a log that :func:`magloc.read_log` reads.
    layout : str or path-like, optional
        Layout of a CSV file, as for :func:`adcs.read_imu`.
    currents : sequence of str
        Columns or channels of currents; by default those that are found.

    Returns
    -------
    VehicleFile
        Readings of the vehicle, with place and date if the log states them.

    Raises
    ------
    InputError
        The log cannot be read, or has no gyro, accelerometer or magnetometer.

    Examples
    --------
    >>> import adcs
    >>> file = adcs.read_vehicle(adcs.datasets.load("imu").path)
    >>> [magnetometer.name for magnetometer in file.log.magnetometers]
    ['field']
    """
    if log_reader(path) is None:
        log = _text_log(path, layout, currents)
        alive = tuple(one for one in log.magnetometers if _is_alive(one))
        dead = [one.name for one in log.magnetometers if not _is_alive(one)]
        if not alive:
            return VehicleFile(log)
        warnings = tuple(f"{name} has no readings that vary, and is left out" for name in dead)
        return VehicleFile(replace(log, magnetometers=alive), warnings=warnings)
    if layout is not None:
        raise InputError(f"{path}: found a binary log with a layout (--config), expected a CSV file, or no layout.")
    return _binary_log(read_log(path), currents)


def _text_log(path: str | PathLike[str], layout: str | PathLike[str] | None, currents: Sequence[str]) -> VehicleLog:
    """Return the log of a CSV or MAT file."""
    record = read_imu(path, layout).record
    magnetometers = [Series("field", record.time_s, record.field_T)] if record.has_field else []
    found: list[Series] = []
    if Path(path).suffix.lower() != ".mat":
        table = read_table(path, "a header with a time, and columns of gyro and accelerometer")
        header = table.header
        ids = [name.removesuffix("_x_nT") for name in header if name.endswith("_x_nT")]
        for one in ids:
            columns = [f"{one}_{axis}_nT" for axis in "xyz"]
            if one != "field" and table.has_group(columns):
                values = 1e-9 * table.finite_or_missing(columns)
                magnetometers.append(Series(one, record.time_s, values))
        for name in currents:
            table.require(name, ())
        names = currents or [name for name in header if name.endswith(_TEXT_CURRENTS)]
        found = [Series(name, record.time_s, table.finite_or_missing([name])[:, 0]) for name in names]
    elif currents:
        raise InputError(f"{path}: found a MAT file, which has no currents, expected no --currents.")
    with naming(str(path)):
        return VehicleLog(
            record.time_s,
            record.rate_rad_s,
            record.acceleration_m_s2,
            tuple(magnetometers),
            tuple(one for one in found if _varies(one, 0.0)),
            record.gyro_samples,
        )


def _binary_log(log: Log, currents: Sequence[str]) -> VehicleFile:
    """Return the sensors of the log of an autopilot or robot."""
    gyro, force = (
        _first_triple(log, patterns, what) for patterns, what in ((_GYRO, "gyro"), (_FORCE, "accelerometer"))
    )
    choices = [[found for one in group if (found := _triple(log, one)) is not None] for group in _MAGNETOMETERS]
    good = [[one for one in group if _is_dense(one)] for group in choices]
    best = next((group for group in good if group), [])
    if not best:
        expected = "a magnetometer of 5 Hz or more, such as sensor_mag (PX4), MAG (ArduPilot), magnetic_field (ROS)"
        raise InputError(f"{log.path}: found no readings of a magnetometer, expected {expected}.")
    names = currents or [name for name in _CURRENTS if name in log]
    series = [Series(name, (channel := log.require(name)).time_s, channel.values) for name in names]
    if not currents:
        units = [log[name].unit for name in names]
        kept = [one for one, unit in zip(series, units, strict=True) if _varies(one, _LEAST_RANGE.get(unit, 0.02))]
        series = kept[:1]
    corrected = best[0].name.startswith(("vehicle_magnetometer", "sensor_combined", "MAG"))
    if corrected and len(best) == 1 and (raw := _uncorrected(best[0], log)) is not None:
        best, corrected = [raw], False
    with naming(log.path):
        vehicle = VehicleLog(
            gyro.time_s, gyro.values, _at(force, gyro.time_s), tuple(best), tuple(_whole(one) for one in series)
        )
    place = _place(log)
    date = None
    if log.unix_zero_s is not None:
        at = datetime.datetime.fromtimestamp(log.unix_zero_s + float(gyro.time_s[0]), datetime.UTC)
        date = at.date().isoformat()
    warnings = () if not corrected else (_CORRECTED.format(best[0].name.partition(".")[0]),)
    return VehicleFile(vehicle, place, date, corrected, warnings)


_CORRECTED = (
    "the fields of {} are those that the autopilot has corrected: the calibration adds to its parameters, and does not"
    " replace them"
)


def _uncorrected(series: Series, log: Log) -> Series | None:
    """Return fields without the calibration of PX4's parameters; None where they are unknown or turn the axes."""
    values = log.parameters
    slots = [k for k in range(4) if values.get(f"CAL_MAG{k}_ID")]
    prime = [k for k in slots if values[f"CAL_MAG{k}_ID"] == values.get("CAL_MAG_PRIME")]
    if not slots or values.get("CAL_MAG_COMP_TYP"):
        return None
    k = (prime or slots)[0]
    begin = f"CAL_MAG{k}_"
    # An internal magnetometer (-1) has the rotation of the board.
    number = values.get(f"{begin}ROT", 0.0)
    if number > 0.0 or (number < 0.0 and values.get("SENS_BOARD_ROT")):
        return None
    scale = np.diag([values.get(f"{begin}{axis}SCALE", 1.0) or 1.0 for axis in "XYZ"])
    for axis, i, j in (("X", 0, 1), ("Y", 0, 2), ("Z", 1, 2)):
        scale[i, j] = scale[j, i] = values.get(f"{begin}{axis}ODIAG", 0.0)
    offset_T = 1e-4 * np.array([values.get(f"{begin}{axis}OFF", 0.0) for axis in "XYZ"])
    raw = series.values @ np.linalg.inv(scale).T + offset_T
    return replace(series, values=raw, device_id=int(values[f"{begin}ID"]))


def _triple(log: Log, pattern: str) -> Series | None:
    """Return the vector channel of a pattern; None if the log has none."""
    begin, axes = pattern.index("{"), pattern[pattern.index("{") + 1 : pattern.index("}")]
    head, tail = pattern[:begin], pattern[pattern.index("}") + 1 :]
    if head.startswith("*"):
        heads = [name.removesuffix(f"{axes[0]}{tail}") for name in log if name.endswith(f"{head[1:]}{axes[0]}{tail}")]
        head = heads[0] if heads else head
    names = [f"{head}{axis}{tail}" for axis in axes]
    if any(name not in log for name in names):
        return None
    time_s, values = log.vectors(names)
    name = head.rstrip("[.").removesuffix("Mag").rstrip(".").partition(".magnetometer_ga")[0]
    return Series(name, time_s, values, _device(log, names[0]))


def _device(log: Log, name: str) -> int:
    """Return the identifier of the device beside a channel; 0 if the log has none."""
    beside = f"{name.rpartition('.')[0]}.device_id"
    return int(log[beside].values[0]) if beside in log and len(log[beside]) else 0


def _first_triple(log: Log, patterns: Sequence[str], what: str) -> Series:
    for pattern in patterns:
        found = _triple(log, pattern)
        if found is not None:
            return found
    shown = " or ".join(pattern.translate(str.maketrans("{}", "[]")) for pattern in patterns)
    raise InputError(f"{log.path}: found no {what}, expected channels such as {shown}.")


def _is_dense(series: Series) -> bool:
    """Return True for a sensor with readings often enough that are not all equal."""
    often = len(series.time_s) >= _LEAST_RATE_Hz * np.ptp(series.time_s)
    return len(series.time_s) >= _LEAST_ROWS and bool(often) and _is_alive(series)


def _is_alive(series: Series) -> bool:
    """Return True for a magnetometer whose readings are not all missing or equal."""
    values = series.finite().values
    return len(values) > 1 and bool((np.ptp(values, axis=0) > 0.0).any())


def _varies(series: Series, least: float) -> bool:
    known = series.values[np.isfinite(series.values)]
    return len(known) > 1 and bool(np.ptp(known) > least)


def _whole(series: Series) -> Series:
    """Return a current as numbers that are not missing."""
    return replace(series, values=np.asarray(series.values, np.float64))


def _at(series: Series, time_s: FloatArray) -> FloatArray:
    """Return a vector series at other times, NaN where its next sample is far."""
    clean = series.finite()
    values = np.stack([np.interp(time_s, clean.time_s, axis) for axis in clean.values.T], axis=1)
    after = np.clip(np.searchsorted(clean.time_s, time_s), 1, len(clean.time_s) - 1)
    far = np.minimum(np.abs(clean.time_s[after] - time_s), np.abs(time_s - clean.time_s[after - 1])) > _LONGEST_GAP_S
    values[far] = np.nan
    return values


def _place(log: Log) -> tuple[float, float, float] | None:
    """Return the first place of the receiver that is not 0, 0."""
    for topic, *names in _PLACES:
        channels = [f"{topic}.{name}" for name in names]
        if all(name in log for name in channels):
            values = np.stack([log[name].values for name in channels], axis=1)
            known = (
                np.isfinite(values).all(axis=1) & (np.abs(values[:, 0]) <= 90.0) & (values[:, :2] != 0.0).any(axis=1)
            )
            if known.any():
                latitude, longitude, height = values[int(np.argmax(known))].tolist()
                return latitude, longitude, height
    return None
