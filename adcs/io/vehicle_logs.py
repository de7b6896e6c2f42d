"""Inertial unit, magnetometers and currents of a log: CSV files, and the logs of autopilots and robots."""

from __future__ import annotations

import datetime
import itertools
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path

import numpy as np

from adcs.io.imu_files import ImuFile, csv_log, read_imu
from adcs.log_calibration.record import Series, VehicleLog
from arrays.io.csv import table_of_header, table_of_text
from arrays.io.errors import InputError, naming
from arrays.io.text import read_text
from arrays.io.toml import read_toml, section_of
from arrays.typing import FloatArray
from magloc.logs.channels import Log
from magloc.logs.read import log_reader, read_log
from magloc.logs.sensors import find_sensors
from magloc.logs.time_base import resample

_CURRENTS = ("battery_status.current_a", "BAT.Curr", "actuator_controls_0.control[3]", "CTUN.ThO")
_PLACES = (
    ("vehicle_gps_position", "lat", "lon", "alt"),
    ("vehicle_gps_position", "latitude_deg", "longitude_deg", "altitude_msl_m"),
    ("GPS", "Lat", "Lng", "Alt"),
)
_LEAST_ROWS, _LEAST_RATE_Hz = 20, 5.0
_LEAST_RANGE = {"A": 0.5, "": 0.02}
_TEXT_CURRENTS = ("_A", "throttle")
_COMPASS = ("OFS", "DIA", "ODI")  # parameters of ArduPilot
_ROUNDED_mG = 1.0  # largest difference of a logged offset and its parameter


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
        alive = tuple(one for one in log.magnetometers if _varies(one))
        dead = [one.name for one in log.magnetometers if not _varies(one)]
        if not alive:
            return VehicleFile(log)
        warnings = tuple(f"{name} has no readings that vary, and is ignored" for name in dead)
        return VehicleFile(replace(log, magnetometers=alive), warnings=warnings)
    if layout is not None:
        raise InputError(f"{path}: found a binary log with a layout (--config), expected a CSV file, or no layout.")
    return _binary_log(read_log(path), currents)


def _text_log(path: str | PathLike[str], layout: str | PathLike[str] | None, currents: Sequence[str]) -> VehicleLog:
    """Return the log of a CSV or MAT file."""
    found: tuple[list[Series], list[Series]] = [], []
    if Path(path).suffix.lower() == ".mat":
        record = read_imu(path, layout).record
        if currents:
            raise InputError(f"{path}: found a MAT file, which has no currents, expected no --currents.")
    else:
        described = {} if layout is None else read_toml(layout, "a layout of a log")
        named = None if layout is None else section_of(str(layout), described, ImuFile).log
        text = read_text(path, "a CSV file")  # once: a pipe has no second reading
        record = csv_log(text, str(path), named).record
        own = () if named is None or named.magnetometer is None else named.magnetometer.columns
        found = _more_columns(text, str(path), record.time_s, own, currents)
    magnetometers = [Series("field", record.time_s, record.field_T)] if record.has_field else []
    with naming(str(path)):
        return VehicleLog(
            record.time_s,
            record.rate_rad_s,
            record.acceleration_m_s2,
            (*magnetometers, *found[0]),
            tuple(one for one in found[1] if _varies(one)),
            record.gyro_samples,
        )


def _more_columns(
    text: str, name: str, time_s: FloatArray, own: Sequence[str], currents: Sequence[str]
) -> tuple[list[Series], list[Series]]:
    """Return the other magnetometers and the currents of a CSV file's text; ``own``: columns of the first sensor."""
    expected = "a header with a time, and columns of gyro and accelerometer"
    head = table_of_header(text, name, expected)
    ids = [column.removesuffix("_x_nT") for column in head.header if column.endswith("_x_nT")]
    groups = {one: [f"{one}_{axis}_nT" for axis in "xyz"] for one in ids if one != "field" and f"{one}_x_nT" not in own}
    for columns in groups.values():
        head.has_group(columns)
    for current in currents:
        head.require(current, ())
    names = currents or [column for column in head.header if column.endswith(_TEXT_CURRENTS)]
    table = table_of_text(text, name, expected, only={*names, *itertools.chain(*groups.values())})
    return (
        [Series(one, time_s, 1e-9 * table.finite_or_missing(columns)) for one, columns in groups.items()],
        [Series(current, time_s, table.finite_or_missing([current])[:, 0]) for current in names],
    )


def _binary_log(log: Log, currents: Sequence[str]) -> VehicleFile:
    """Return the sensors of the log of an autopilot or robot."""
    sensors = find_sensors(log)
    gyro, force = sensors.gyro, sensors.accelerometer
    found = [
        Series(one.name.rpartition(".")[0], one.time_s, one.values, _device(log, one.name))
        for one in sensors.magnetometers
    ]
    good = [one for one in found if _is_dense(one)]
    # Fields that the autopilot has not corrected, or else those of the first kind of message.
    kinds = [_message(one) for one in good]
    first = "sensor_mag" if "sensor_mag" in kinds else next(iter(kinds), "")
    best = [one for one, kind in zip(good, kinds, strict=True) if kind == first]
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
    raw = [_uncorrected(one, log, alone=len(best) == 1) for one in best] if corrected else []
    if known := [one for one in raw if one is not None]:
        # A calibration replaces the autopilot's parameters for all magnetometers, or adds to them.
        best, corrected = (known, False) if len(known) == len(best) else (best, True)
    with naming(log.path):
        vehicle = VehicleLog(
            gyro.time_s, gyro.values, resample(gyro.time_s, force.time_s, force.values), tuple(best), tuple(series)
        )
    place = _place(log)
    date = None
    if log.unix_zero_s is not None:
        at = datetime.datetime.fromtimestamp(log.unix_zero_s + float(gyro.time_s[0]), datetime.UTC)
        date = at.date().isoformat()
    warnings = [_CORRECTED.format(best[0].name)] if corrected else []
    return VehicleFile(vehicle, place, date, corrected, (*warnings, *sensors.warnings))


_CORRECTED = (
    "the fields of {} are those that the autopilot has corrected: the calibration adds to its parameters, and does not"
    " replace them"
)


def _uncorrected(series: Series, log: Log, *, alone: bool) -> Series | None:
    """Return fields without the autopilot's own calibration; None where it is unknown or turns the axes.

    PX4 does not state which of several magnetometers its parameters belong to.
    """
    if _message(series) == "MAG":
        return _ardupilot_raw(series, log)
    return _px4_raw(series, log) if alone else None


def _ardupilot_raw(series: Series, log: Log) -> Series | None:
    """Return fields without ArduPilot's parameters; None where the log does not state them.

    A logged field is S (raw + offset) scale + motor, with S of DIA and ODI (magfit_WMM.py of pymavlink). Offsets and
    motor fields are logged beside it; the offsets show which parameters belong to a magnetometer.
    """
    names = [f"{series.name}.{kind}{axis}" for kind in ("Ofs", "MO") for axis in "XYZ"]
    if not set(names) <= set(log):
        return None
    time_s, logged_T = log.vectors(names)
    at = np.searchsorted(time_s, series.time_s).clip(max=len(time_s) - 1)
    if not np.array_equal(time_s[at], series.time_s):
        return None
    offset_T, motor_T = logged_T[at, :3], logged_T[at, 3:]
    for slot in ("", "2", "3"):
        kinds = {kind: [log.parameters.get(f"COMPASS_{kind}{slot}_{axis}") for axis in "XYZ"] for kind in _COMPASS}
        stated = {kind: np.array(three, np.float64) for kind, three in kinds.items() if None not in three}
        if len(stated) < len(_COMPASS) or np.abs(1e7 * offset_T[-1] - stated["OFS"]).max() > _ROUNDED_mG:
            continue
        (xx, yy, zz), (xy, xz, yz) = stated["DIA"], stated["ODI"]
        S = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) if stated["DIA"].any() else np.eye(3)
        S = S * (log.parameters.get(f"COMPASS_SCALE{slot}") or 1.0)
        device = int(log.parameters.get(f"COMPASS_DEV_ID{slot}", 0.0))
        return replace(series, values=(series.values - motor_T) @ np.linalg.inv(S).T - offset_T, device_id=device)
    return None


def _px4_raw(series: Series, log: Log) -> Series | None:
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


def _message(series: Series) -> str:
    """Return the kind of message of a sensor, without the number of an instance."""
    return re.sub(r"(\d|\[\d+\])$", "", series.name)


def _device(log: Log, name: str) -> int:
    """Return the identifier of the device beside a channel; 0 if the log has none."""
    beside = f"{name.rpartition('.')[0]}.device_id"
    return int(log[beside].values[0]) if beside in log and len(log[beside]) else 0


def _is_dense(series: Series) -> bool:
    """Return True for a sensor with readings often enough that are not all equal."""
    often = len(series.time_s) >= _LEAST_RATE_Hz * np.ptp(series.time_s)
    return len(series.time_s) >= _LEAST_ROWS and bool(often) and _varies(series)


def _varies(series: Series, least: float = 0.0) -> bool:
    """Return True for a series whose readings are not all missing, or equal within a range."""
    values = series.finite().values
    return len(values) > 1 and bool((np.ptp(values, axis=0) > least).any())


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
