"""PX4 ULog files, read by pyulog."""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from arrays.io.errors import InputError, of_extra
from arrays.io.text import read_bytes
from arrays.typing import FloatArray
from magloc.logs.channels import Log, Topic
from magloc.logs.sensors import are_attitudes
from magloc.logs.units import PLACE, PLACE_E7, LoggedUnit, logged_unit, unit_of_field

_NO_TIME = 0x7FFFFFFF  # relative time of a sensor without a sample
_INSIDE = re.compile(r"(accelerometer|magnetometer)_(?!timestamp)")
_OF_TOPICS = (
    (r"sensor_mag", r"[xyz]", "G"),
    (r"sensor_gyro|vehicle_angular_velocity", r"[xyz]|xyz\[\d\]", "rad/s"),
    (r"vehicle_angular_acceleration", r"xyz\[\d\]", "rad/s/s"),
    (r"sensor_accel|vehicle_acceleration", r"[xyz]|xyz\[\d\]", "m/s2"),
    (r"vehicle_imu", r"delta_angle\[\d\]", "rad"),
    (r"vehicle_imu", r"delta_velocity\[\d\]", "m/s"),
    (r"vehicle_imu", r"delta_(angle|velocity)_dt", "us"),
    (r"sensor_combined", r"gyro_rad\[\d\]", "rad/s"),
    (r"vehicle_local_position(_groundtruth)?", r"[xyz]|alt_max", "m"),
    (r"vehicle_local_position(_groundtruth)?", r"v[xyz]", "m/s"),
    (r"vehicle_global_position|vehicle_gps_position|sensor_gps", r"(latitude|longitude)_deg", PLACE),
    (r"vehicle_global_position(_groundtruth)?|home_position", r"lat|lon", PLACE),
    (r"vehicle_gps_position|sensor_gps", r"lat|lon", PLACE_E7),
    (r"vehicle_gps_position|sensor_gps", r"alt|alt_ellipsoid", "mm"),
    (r"vehicle_global_position", r"alt|alt_ellipsoid", "m"),
    (r"estimator_sensor_bias", r"gyro_bias\[\d\]", "rad/s"),
    (r"estimator_sensor_bias", r"accel_bias\[\d\]", "m/s2"),
    (r"estimator_sensor_bias", r"mag_bias\[\d\]", "G"),
    (r"actuator_controls_\d|actuator_motors", r"control\[\d+\]", "1"),
)


def read_ulog(place: Path) -> Log:
    """Return the channels of a ULog file.

    Raises
    ------
    InputError
        The extra "logs" is not installed, or the file has no data that can be read.
    """
    with of_extra("logs", "a ULog file"):
        from pyulog import ULog
    path, data = str(place), read_bytes(place, "a ULog file")
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # pyulog prints what it meets
            file = ULog(io.BytesIO(data))
    except Exception:  # pyulog raises many kinds of errors for other files
        raise InputError(f"{path}: found a header of ULog without readable messages, expected a whole log.") from None
    topics = [part for message in file.data_list for part in _topics(message)]
    if not topics:
        raise InputError(f"{path}: found a ULog file without messages, expected logged sensors.")
    warnings = [f"{path}: parts of the log are damaged or cut; the whole messages are read"] * file.file_corruption
    if file.dropouts:
        lost_s = 1e-3 * sum(each.duration for each in file.dropouts)
        warnings.append(
            f"{path}: the autopilot could not write during {len(file.dropouts)} times, {lost_s:.2g} s in all"
        )
    parameters = {str(name): float(value) for name, value in file.initial_parameters.items()}
    return Log(path, "PX4 ULog", tuple(topics), parameters, _unix_zero_s(topics), tuple(warnings))


def _topics(message: Any) -> Iterator[Topic]:
    """Yield the topics of a message: one for each clock."""
    columns: dict[str, NDArray[Any]] = dict(message.data)
    if "timestamp" not in columns:  # its format is damaged
        return
    name = f"{message.name}[{message.multi_id}]" if message.multi_id else str(message.name)
    stamp = columns.get("timestamp_sample")
    if stamp is None or not stamp.all():
        stamp = columns["timestamp"]
    time_us = stamp.astype(np.int64)
    fields = {field: of for field, of in columns.items() if field not in ("timestamp", "timestamp_sample")}
    if message.name == "vehicle_attitude" and "q[3]" in fields:
        fields |= _angles_deg(fields)
    units = {field: _unit(str(message.name), field) for field in fields}
    units = {field: unit for field, unit in units.items() if unit.logged}
    whole = Topic(name, _seconds(time_us), fields, units, "boot")
    inside = []
    for sensor in ("accelerometer", "magnetometer"):
        later = columns.get(f"{sensor}_timestamp_relative")
        own = {field: of for field, of in fields.items() if field.startswith(f"{sensor}_") and "timestamp" not in field}
        if later is None or not own:
            continue
        own_us = time_us + later
        is_new = (later != _NO_TIME) & (np.diff(own_us, prepend=-1) != 0)  # a sample stands until the next
        values = {field: of[is_new] for field, of in own.items()}
        inside.append(replace(whole, time_s=_seconds(own_us[is_new]), fields=values))
        fields = {field: of for field, of in fields.items() if field not in own}
    yield from (replace(whole, fields=fields), *inside)


def _angles_deg(fields: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Return yaw, pitch and roll (n,) [deg] of the quaternion, from north, east, down to forward, right, down.

    They are NaN where the quaternion has not the length 1: the estimator has no attitude yet.
    """
    q = np.stack([fields[f"q[{i}]"].astype(np.float64) for i in range(4)], axis=1)
    w, x, y, z = np.where(are_attitudes(q)[:, None], q, np.nan).T
    yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    pitch = np.arcsin(np.clip(2.0 * (w * y - x * z), -1.0, 1.0))
    roll = np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    return {"yaw_deg": np.degrees(yaw), "pitch_deg": np.degrees(pitch), "roll_deg": np.degrees(roll)}


def _seconds(time_us: NDArray[Any]) -> FloatArray:
    return np.asarray(1e-6 * time_us, dtype=np.float64)


def _unit(topic: str, field: str) -> LoggedUnit:
    for topics, fields, unit in _OF_TOPICS:
        if re.fullmatch(topics, topic) and re.fullmatch(fields, field):
            return unit if isinstance(unit, LoggedUnit) else logged_unit(unit)
    return unit_of_field(field)


def _unix_zero_s(topics: list[Topic]) -> float | None:
    """Return the time since 1970 at the start of the autopilot, by its receiver."""
    for topic in topics:
        utc_us = topic.fields.get("time_utc_usec")
        if utc_us is not None and topic.name.startswith(("vehicle_gps_position", "sensor_gps")) and utc_us.any():
            first = int(np.flatnonzero(utc_us)[0])
            return float(1e-6 * float(utc_us[first]) - topic.time_s[first])
    return None
