"""Bags of ROS 1 and ROS 2, also as MCAP, read by rosbags."""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from arrays.io.errors import InputError, of_extra
from magloc.logs.channels import Log, Topic
from magloc.logs.units import PLACE, LoggedUnit, logged_unit

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader

_LONGEST = 36  # numbers of an array that are channels; longer ones are pictures, clouds and scans
_UNITS = (
    ("sensor_msgs/msg/MagneticField", "magnetic_field", "T"),
    ("sensor_msgs/msg/Imu", "angular_velocity", "rad/s"),
    ("sensor_msgs/msg/Imu", "linear_acceleration", "m/s2"),
    ("sensor_msgs/msg/NavSatFix", "altitude", "m"),
    ("sensor_msgs/msg/NavSatFix", "latitude", PLACE),
    ("sensor_msgs/msg/NavSatFix", "longitude", PLACE),
    ("sensor_msgs/msg/BatteryState", "voltage", "V"),
    ("sensor_msgs/msg/BatteryState", "current", "A"),
    ("sensor_msgs/msg/FluidPressure", "fluid_pressure", "Pa"),
    ("sensor_msgs/msg/Temperature", "temperature", "degC"),
)
_OF_FIELDS = {"position": "m", "translation": "m", "linear": "m/s", "angular": "rad/s"}


def read_bag(path: Path) -> Log:
    """Return the channels of a bag: a file of ROS 1, a folder or file of ROS 2, or MCAP.

    A message has the time of its stamp or, without a stamp, of its recording.

    Raises
    ------
    InputError
        The extra "logs" is not installed, or the bag has no messages that can be read.
    """
    with of_extra("logs", "a bag of ROS"):
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    warnings: list[str] = []
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as reader:
            topics = list(_topics(reader, str(path), warnings))
            kind = "ROS 2 bag" if reader.is2 else "ROS 1 bag"
    except Exception:  # rosbags raises many kinds of errors for damaged bags
        raise InputError(
            f"{path}: found a bag that cannot be read, expected a whole one of ROS 1, ROS 2 or ROS in MCAP."
        ) from None
    if not topics:
        raise InputError(f"{path}: found a bag without numbers, expected messages of sensors.")
    return Log(str(path), kind, tuple(topics), unix_zero_s=0.0, warnings=tuple(warnings))


def _topics(reader: AnyReader, path: str, warnings: list[str]) -> Iterator[Topic]:
    publishers: dict[tuple[str, str], list[Any]] = {}  # a driver that starts again is another one
    for connection in reader.connections:
        publishers.setdefault((connection.topic, connection.msgtype), []).append(connection)
    for (topic, kind), connections in publishers.items():
        times = array("d")
        columns: dict[str, array[float]] = {}
        try:
            for _, stamp_ns, raw in reader.messages(connections):
                message = reader.deserialize(raw, kind)
                found = dict(_numbers(message, ""))
                if not columns:
                    columns = {name: array("d") for name in found}
                if not columns or found.keys() != columns.keys():
                    break
                times.append(_stamp_s(message) or 1e-9 * stamp_ns)
                for name, value in found.items():
                    columns[name].append(value)
        except Exception:  # the end of a cut bag
            warnings.append(f"{path}: parts of {topic} are damaged or cut; the whole messages are read")
        if times:
            fields = {name: np.array(of) for name, of in columns.items()}
            units = {name: unit for name in fields if (unit := _unit(kind, name)) is not None}
            yield Topic(topic, np.array(times), fields, units, "unix")


def _numbers(value: Any, name: str) -> Iterator[tuple[str, float]]:
    """Yield the numbers of a message with their paths, without its header and long arrays."""
    if isinstance(value, int | float):
        yield name, float(value)
    elif isinstance(value, np.ndarray):
        if value.size <= _LONGEST and value.dtype.kind in "biuf":
            yield from ((f"{name}[{i}]", float(each)) for i, each in enumerate(value.ravel()))
    elif hasattr(value, "__dataclass_fields__"):
        for each in value.__dataclass_fields__:
            if each not in ("header", "__msgtype__"):
                yield from _numbers(getattr(value, each), f"{name}.{each}" if name else each)


def _stamp_s(message: Any) -> float:
    """Return the stamp of a message since 1970 [s]; 0 if it has none."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    return 0.0 if stamp is None else float(stamp.sec) + 1e-9 * float(stamp.nanosec)


def _unit(message: str, field: str) -> LoggedUnit | None:
    parts = field.split(".")
    for of, name, unit in _UNITS:
        if of == message and name == parts[0]:
            return unit if isinstance(unit, LoggedUnit) else logged_unit(unit)
    named = next((unit for part, unit in _OF_FIELDS.items() if part in parts), None)
    return None if named is None else logged_unit(named)
