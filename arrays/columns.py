"""How another program names and counts the columns of its logs: the table ``columns`` of an array file.

The columns of a log become those of a readings file: names, units and times are translated, geodetic places become
east, north, up of an origin, and yaw, pitch and roll a quaternion. Columns that nothing names are left out.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from os import PathLike
from typing import Annotated

import msgspec
import numpy as np

from arrays.io.csv import Table as CsvTable
from arrays.io.csv import read_table, table_of_text
from arrays.io.errors import InputError, of_extra
from arrays.io.text import read_text
from arrays.io.toml import RefusalError, Table, one_of
from arrays.typing import FloatArray, Vector

_NANOTESLA = {"nT": 1.0, "uT": 1e3, "µT": 1e3, "mT": 1e6, "T": 1e9, "mG": 1e2, "G": 1e5}
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "iso": 1.0}
_SEPARATORS = {"comma": ",", "semicolon": ";", "tab": "\t", "space": " "}
_POSITION, _TURN = ("array_x_m", "array_y_m", "array_z_m"), ("array_qx", "array_qy", "array_qz", "array_qw")
_GEODETIC, _ANGLES = ("_latitude", "_longitude", "_height"), ("_yaw", "_pitch", "_roll")
_ENU_FROM_NED = ((0, 1, 0), (1, 0, 0), (0, 0, -1))
_BODY_FROM_ARRAY = ((1, 0, 0), (0, -1, 0), (0, 0, -1))


@dataclass(frozen=True, kw_only=True)
class LogColumns:
    """Columns of a log that is no readings file.

    Attributes
    ----------
    separator : str
        "comma", "semicolon", "tab" or "space".
    decimal : str
        "." or ",", of its numbers.
    time : str
        Name of the column with the time.
    time_unit : str
        "s", "ms", "us", or "iso" for instants such as 2026-11-21T12:00:00.5, UTC where they say nothing else.
    unit : str or float
        Of all sensors: "nT", "uT", "µT", "mT", "T", "mG", "G", or how many nT a count is.
    sensors : dict
        By the sensor's id the name of its column, or the three of a vector sensor. Others have the columns of a
        readings file.
    position : tuple of 3 str, optional
        Columns of the array's place [m], in a world frame whose z points up.
    geodetic : tuple of 3 str, optional
        In its place: those of latitude, longitude [deg] and height [m].
    origin : tuple of 3 floats, optional
        Latitude, longitude [deg] and height [m] of the world's origin; the place of the first row where it is left out.
    quaternion : tuple of 4 str, optional
        Columns of the attitude, from the array's frame to the world, x, y, z, w.
    angles : tuple of str, optional
        In its place: yaw, or yaw, pitch and roll [deg], from north, east, down to forward, right, down; the array's own
        axes are forward, left, up. Without any attitude its axes are those of the world.
    pose_latency_s : float
        How much older the pose of a row is than its readings [s].

    Examples
    --------
    >>> import arrays
    >>> columns = arrays.LogColumns(time="UTC", time_unit="iso", unit="uT", geodetic=("Lat", "Lon", "Alt"))
    >>> columns.separator
    'comma'
    """

    separator: str = "comma"
    decimal: str = "."
    time: str = "time_s"
    time_unit: str = "s"
    unit: str | float = "nT"
    sensors: dict[str, str | tuple[str, ...]] = field(default_factory=dict, hash=False)
    position: tuple[str, str, str] | None = None
    geodetic: tuple[str, str, str] | None = None
    origin: Vector | None = None
    quaternion: tuple[str, str, str, str] | None = None
    angles: tuple[str, ...] | None = None
    pose_latency_s: float = 0.0


class ColumnsTable(Table, kw_only=True):
    """The table ``columns`` of an array file."""

    separator: Annotated[str, one_of(tuple(_SEPARATORS))] = "comma"
    decimal: Annotated[str, one_of((".", ","))] = "."
    time: str = "time_s"
    time_unit: Annotated[str, one_of(tuple(_SECONDS))] = "s"
    unit: str | float = "nT"
    sensors: dict[str, str | list[str]] = msgspec.field(default_factory=dict)
    position: tuple[str, str, str] | None = None
    geodetic: tuple[str, str, str] | None = None
    origin: Vector | None = None
    quaternion: tuple[str, str, str, str] | None = None
    angles: list[str] | None = None
    pose_latency_s: float = 0.0

    def check(self) -> None:
        """Raise a RefusalError if its values do not fit each other."""
        if isinstance(self.unit, str) and self.unit not in _NANOTESLA:
            raise RefusalError("unit", f"found {self.unit!r}, expected {', '.join(_NANOTESLA)}, or nT of a count")
        for first, second in (("position", "geodetic"), ("quaternion", "angles")):
            if getattr(self, first) is not None and getattr(self, second) is not None:
                raise RefusalError(second, f"found it together with {first}, expected one of them")
        if self.angles is not None and len(self.angles) not in (1, 3):
            raise RefusalError("angles", f"found {len(self.angles)} names, expected yaw, or yaw, pitch and roll")
        if self.position is None and self.geodetic is None and (self.quaternion or self.angles or self.pose_latency_s):
            raise RefusalError("", "found an attitude or a latency without a place, expected position or geodetic")
        if self.decimal == "," and self.separator == "comma":
            raise RefusalError("decimal", "found ',' beside the separator comma, expected another separator")

    def columns(self) -> LogColumns:
        """What the table says."""
        said = msgspec.structs.asdict(self)
        sensors = {name: tuple(of) if isinstance(of, list) else of for name, of in self.sensors.items()}
        return LogColumns(**said | {"sensors": sensors, "angles": None if self.angles is None else tuple(self.angles)})


def columns_toml(columns: LogColumns) -> list[str]:
    """Lines of the table of an array file."""
    said = {each.name: getattr(columns, each.name) for each in fields(columns) if each.name != "sensors"}
    lines = ["", "[columns]", *(f"{key} = {_toml(value)}" for key, value in said.items() if value is not None)]
    if columns.sensors:
        lines += ["", "[columns.sensors]", *(f"{_toml(key)} = {_toml(of)}" for key, of in columns.sensors.items())]
    return lines


def _toml(value: object) -> str:
    return json.dumps(list(value) if isinstance(value, tuple) else value, ensure_ascii=False)


def read_log(
    path: str | PathLike[str], channels: Mapping[str, Sequence[str]], columns: LogColumns | None, expected: str
) -> CsvTable:
    """Table of a readings file, or of a log, with the columns ``channels`` of every sensor."""
    if columns is None:
        return read_table(path, expected)
    named = _named(channels, columns)
    own = {name for of_sensor in channels.values() for name in of_sensor}
    known = {"time_s", *own, *_POSITION, *_TURN}
    text = read_text(path, "a CSV file")
    table = table_of_text(
        text,
        str(path),
        expected,
        only={*named.values(), *known},
        instants=[columns.time] if columns.time_unit == "iso" else [],
        separator=_SEPARATORS[columns.separator],
        decimal=columns.decimal,
    )
    for name in named.values():
        table.require(name, tuple(named.values()))
    found = {name: table.values[:, i] for i, name in enumerate(table.header) if name in known}
    found |= {ours: table.values[:, table.header.index(theirs)] for ours, theirs in named.items()}
    unit = _NANOTESLA[columns.unit] if isinstance(columns.unit, str) else columns.unit
    found |= {name: unit * found[name] for name in own & found.keys()}
    found["time_s"] = _SECONDS[columns.time_unit] * found["time_s"]
    found |= _pose(found, columns, table)
    kept = [name for name in found if not name.startswith("_")]
    values = np.stack([found[name] for name in kept], axis=1)
    return CsvTable(table.path, tuple(kept), table.header_line, values, table.line_numbers)


def _named(channels: Mapping[str, Sequence[str]], columns: LogColumns) -> dict[str, str]:
    """What each column that the table names is for, or ``_latitude`` and so on."""
    named = {"time_s": columns.time}
    for sensor, theirs in columns.sensors.items():
        ours, names = channels.get(sensor, []), [theirs] if isinstance(theirs, str) else list(theirs)
        if len(ours) != len(names):
            raise InputError(
                f"key columns.sensors.{sensor}: found {len(names)} names, expected {len(ours)}, as the sensor has"
                " channels."
                if ours
                else f"key columns.sensors.{sensor}: found no such sensor, expected ids of the array."
            )
        named |= dict(zip(ours, names, strict=True))
    poses: list[tuple[tuple[str, ...], tuple[str, ...] | None]] = [
        (_POSITION, columns.position),
        (_GEODETIC, columns.geodetic),
        (_TURN, columns.quaternion),
        (_ANGLES, columns.angles),
    ]
    for of_pose, logged in poses:
        named |= dict(zip(of_pose, logged or (), strict=False))
    return named


def _pose(found: dict[str, FloatArray], columns: LogColumns, table: CsvTable) -> dict[str, FloatArray]:
    """Columns of the pose, where a place is known."""
    from scipy.spatial.transform import Rotation, Slerp

    if columns.geodetic is not None:
        place = np.stack([found[name] for name in _GEODETIC], axis=1)
        table.refuse(~np.isfinite(place), columns.geodetic, "found no place, expected one in every row")
        with of_extra("geo", "latitude and longitude"):
            from pymap3d import geodetic2enu
        position = np.stack(geodetic2enu(*place.T, *(place[0] if columns.origin is None else columns.origin)), axis=1)
    elif all(name in found for name in _POSITION):
        position = np.stack([found[name] for name in _POSITION], axis=1)
    else:
        return {}
    if "_yaw" in found:
        angles = np.stack([found.get(name, np.zeros(len(position))) for name in _ANGLES], axis=1)
        if not np.isfinite(angles).all():
            row = int(np.argmin(np.isfinite(angles).all(axis=1)))
            raise InputError(f"{table.row_place(row)}: found no angle, expected one in every row.")
        enu_from_ned, body_from_array = map(Rotation.from_matrix, (_ENU_FROM_NED, _BODY_FROM_ARRAY))
        turn = enu_from_ned * Rotation.from_euler("ZYX", angles, degrees=True) * body_from_array
        quaternion = turn.as_quat()
    elif all(name in found for name in _TURN):
        quaternion = np.stack([found[name] for name in _TURN], axis=1)
    else:
        quaternion = np.tile([0.0, 0.0, 0.0, 1.0], (len(position), 1))
    if columns.pose_latency_s:
        time_s = found["time_s"]
        later = np.clip(time_s + columns.pose_latency_s, time_s.min(), time_s.max())
        position = np.stack([np.interp(later, time_s, axis) for axis in position.T], axis=1)
        quaternion = Slerp(time_s, Rotation.from_quat(quaternion))(later).as_quat()
    return dict(zip((*_POSITION, *_TURN), np.concatenate([position, quaternion], axis=1).T, strict=True))
