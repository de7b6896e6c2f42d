"""Columns of logs of other programs: the table ``columns`` of an array file.

The columns of a log become those of a readings file: names, units and times are translated, geodetic places become
east, north, up of an origin, and yaw, pitch and roll a quaternion. Other columns are ignored.
"""

from __future__ import annotations

import codecs
import datetime
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import msgspec
import numpy as np

from arrays.io.errors import InputError, naming
from arrays.io.toml import Table, toml_value
from arrays.typing import Vector

POSITION_COLUMNS = ("array_x_m", "array_y_m", "array_z_m")
ROTATION_COLUMNS = ("array_qx", "array_qy", "array_qz", "array_qw")
LINE = "line"
NANOTESLA = {"nT": 1.0, "uT": 1e3, "µT": 1e3, "mT": 1e6, "T": 1e9, "mG": 1e2, "G": 1e5}
SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "iso": 1.0, "hhmmss": 1.0, "rows": 1.0}
SEPARATORS = {"comma": ",", "semicolon": ";", "tab": "\t", "space": " "}
_CHOICES = {
    "separator": SEPARATORS,
    "decimal": (".", ","),
    "time_unit": SECONDS,
    "height_is": ("ellipsoid", "geoid", "ground"),
}


@dataclass(frozen=True, kw_only=True)
class ValidRows:
    """Rows of a log whose readings count.

    Attributes
    ----------
    column : str
        Name of a column of numbers.
    equals : tuple of float
        Values of valid rows; rows with another value, or without one, have no reading.

    Examples
    --------
    >>> import arrays
    >>> arrays.LogColumns(valid=arrays.ValidRows(column="MagValid", equals=(1.0,))).valid.column
    'MagValid'
    """

    column: str
    equals: tuple[float, ...]


@dataclass(frozen=True)
class Track:
    """Positions of a log in another file.

    Attributes
    ----------
    path : str
    columns : LogColumns
        Columns of that file, with `geodetic` or `position`. Its clock is the log's.

    Examples
    --------
    >>> import arrays
    >>> where = arrays.LogColumns(geodetic=("Lat", "Lon", "Alt"))
    >>> arrays.LogColumns(track=arrays.Track("drone.csv", where)).is_placed
    True
    """

    path: str
    columns: LogColumns


@dataclass(frozen=True, kw_only=True)
class LogColumns:
    """Columns of a log of another program.

    Attributes
    ----------
    separator : str
        "comma", "semicolon", "tab" or "space".
    decimal : str
        Decimal mark of its numbers, "." or ",".
    time : str or tuple of 2 str
        Name of the column with the time, or with "iso" those of the date and of the time.
    time_unit : str
        "s", "ms", "us", "iso" for instants such as 2026-11-21T12:00:00.5 (UTC by default) and times of day such as
        09:14:03.5, "hhmmss" for numbers such as 091403.5, or "rows" for a log without times: one row per second.
    date : str, optional
        Date of the first row, such as 2026-05-12, for a log with times of day only; without it times are seconds
        since the midnight before the first row.
    time_offset_s : float
        Number of seconds to add to the times, such as -18 from the time of GPS to UTC.
    day_first : bool, optional
        True if dates such as 12/05/2026 begin with the day.
    unit : str or float
        Unit of all sensors: "nT", "uT", "µT", "mT", "T", "mG", "G", or the number of nT per count.
    sensors : dict
        Column of each sensor by its id, or three columns for a vector sensor. Other sensors have the columns of a
        readings file.
    position : tuple of 2 or 3 str, optional
        Columns of the array's position [m], in a world frame whose z points up; two with `height_m`.
    geodetic : tuple of 2 or 3 str, optional
        Instead of `position`: columns of latitude, longitude [deg] and, without `height_m`, height [m].
    track : Track, optional
        Instead of `position`: another file with the positions.
    crs : str, optional
        Coordinate system, such as "EPSG:32633", of easting and northing in `position`, or of latitude and longitude in
        `geodetic`. The world frame is east, north, up of the origin; convergence and scale of the grid are corrected.
    height_m : float, optional
        Constant height above the ground, which is at the height of the origin [m].
    height_is : str
        "ellipsoid", "geoid" (that of the origin is the same), or "ground": heights above ground.
    antenna_m : tuple of 3 floats, optional
        Position of the receiver's antenna in the array's frame [m].
    fix : ValidRows, optional
        Rows whose positions count; by default all. Other rows, and rows without a position, are interpolated.
    origin : tuple of 3 floats, optional
        With `geodetic` or `crs`: latitude, longitude [deg] and height [m] of the world's origin, the same for all logs.
    quaternion : tuple of 4 str, optional
        Columns of the attitude, from the array's frame to the world, x, y, z, w.
    angles : tuple of str, optional
        Instead of `quaternion`: columns of yaw, or of yaw, pitch and roll [deg], from north, east, down to forward,
        right, down. The array's axes are forward, left, up. Without an attitude they are the axes of the world.
    course : bool
        Instead of an attitude: the array's x axis points along the course over ground. Files only.
    pose_latency_s : float
        Time by which the pose of a row is older than its readings [s].
    dummy : tuple of float and str
        Numbers, in the unit of the log, and words that mark a missing reading.
    valid : ValidRows, optional
        Rows whose readings count; by default all.
    names : tuple of str
        Names of all columns, for a log without a header, or with one that does not fit its rows. The first row is then
        the first line with a number in each column that is read.
    line : str, optional
        Column with the number of the survey line.
    comment, skip : tuple of str
        Beginnings of rows to ignore: comments, and names of survey lines.
    encoding : str, optional
        Encoding of the text, such as "windows-1252"; by default UTF-8, or UTF-16 with a byte order mark.

    Raises
    ------
    ValueError
        A value is invalid, or two values contradict each other.

    Examples
    --------
    >>> import arrays
    >>> geodetic = {"geodetic": ("Lat", "Lon", "Alt"), "origin": (48.14, 11.57, 520.0)}
    >>> columns = arrays.LogColumns(time="UTC", time_unit="iso", unit="uT", **geodetic)
    >>> columns.separator
    'comma'
    """

    separator: str = "comma"
    decimal: str = "."
    time: str | tuple[str, str] = "time_s"
    time_unit: str = "s"
    unit: str | float = "nT"
    sensors: dict[str, str | tuple[str, ...]] = field(default_factory=dict, hash=False)
    date: str | None = None
    time_offset_s: float = 0.0
    day_first: bool | None = None
    position: tuple[str, ...] | None = None
    geodetic: tuple[str, ...] | None = None
    track: Track | None = None
    origin: Vector | None = None
    crs: str | None = None
    height_m: float | None = None
    height_is: str = "ellipsoid"
    antenna_m: Vector | None = None
    fix: ValidRows | None = None
    quaternion: tuple[str, str, str, str] | None = None
    angles: tuple[str, ...] | None = None
    course: bool = False
    pose_latency_s: float = 0.0
    dummy: tuple[float | str, ...] = ()
    valid: ValidRows | None = None
    names: tuple[str, ...] = ()
    line: str | None = None
    comment: tuple[str, ...] = ("#",)
    skip: tuple[str, ...] = ()
    encoding: str | None = None

    def __post_init__(self) -> None:
        for name, choices in _CHOICES.items():
            if (value := getattr(self, name)) not in choices:
                raise ValueError(f"Input {name} must be one of {', '.join(choices)}; instead received {value!r}.")
        if self.unit not in NANOTESLA and not (isinstance(self.unit, float | int) and 0.0 < self.unit < math.inf):
            expected = f"one of {', '.join(NANOTESLA)}, or how many nT a count is"
            raise ValueError(f"Input unit must be {expected}; instead received {self.unit!r}.")
        if len(self.clock) > 1 and self.time_unit != "iso":
            raise ValueError(f"Input time_unit must be iso for a date and a time; instead received {self.time_unit!r}.")
        if self.decimal == "," and self.separator == "comma":
            raise ValueError("Input decimal must not be ',' beside the separator comma.")
        for first, second in (("position", "geodetic"), ("quaternion", "angles")):
            if getattr(self, first) is not None and getattr(self, second) is not None:
                raise ValueError(f"Input {second} must not come together with {first}.")
        self._refuse_places()
        self._refuse_text()
        if self.angles is not None and len(self.angles) not in (1, 3):
            raise ValueError(
                f"Input angles must be yaw, or yaw, pitch, roll; instead received {len(self.angles)} names."
            )
        if self.course and self.attitude:
            raise ValueError("Input course must not come together with quaternion or angles.")
        if self.track is not None and self.place:
            raise ValueError("Input track must not come together with position or geodetic.")
        if not self.is_placed and (self.attitude or self.course or self.pose_latency_s):
            raise ValueError(
                "Input position or geodetic is needed by an attitude and by a latency; instead received neither."
            )
        if self.origin is not None and not self.is_geodetic:
            raise ValueError("Input origin must come with geodetic or crs; instead received neither.")
        numbers = (
            self.pose_latency_s,
            self.time_offset_s,
            self.height_m or 0.0,
            *(self.origin or ()),
            *(self.antenna_m or ()),
        )
        if not np.isfinite(numbers).all():
            names = "origin, height_m, antenna_m, time_offset_s and pose_latency_s"
            raise ValueError(f"Inputs {names} must be finite; instead received {numbers}.")

    def _refuse_places(self) -> None:
        n = 3 if self.height_m is None else 2
        for name in ("position", "geodetic"):
            if (names := getattr(self, name)) is not None and len(names) != n:
                why = "without height_m" if n == 3 else "with height_m"
                raise ValueError(f"Input {name} must have {n} names {why}; instead received {len(names)}.")
        of_places = (self.height_m, self.fix, self.crs, None if self.track else self.antenna_m)
        if not self.place and of_places != (None,) * len(of_places):
            names = "height_m, fix, crs and antenna_m"
            raise ValueError(f"Inputs {names} must come with position or geodetic; instead received neither.")

    def _refuse_text(self) -> None:
        if self.date is not None:
            try:
                datetime.date.fromisoformat(self.date)
            except ValueError:
                raise ValueError(f"Input date must be such as 2026-05-12; instead received {self.date!r}.") from None
        if "" in (*self.comment, *self.skip):
            raise ValueError("Inputs comment and skip must be beginnings of rows; instead received an empty text.")
        try:
            codecs.lookup(self.encoding or "utf-8")
        except LookupError:
            expected = "such as windows-1252, utf-16 or latin-1"
            raise ValueError(f"Input encoding must be one {expected}; instead received {self.encoding!r}.") from None

    @property
    def unit_nT(self) -> float:
        """Unit of the sensors' columns [nT]."""
        return self.unit if isinstance(self.unit, float | int) else NANOTESLA[self.unit]

    @property
    def clock(self) -> tuple[str, ...]:
        """Column of the time, or those of date and time; empty for a log without times."""
        if self.time_unit == "rows":
            return ()
        return (self.time,) if isinstance(self.time, str) else self.time

    @property
    def place(self) -> tuple[str, ...]:
        """Columns of the array's position."""
        return self.position or self.geodetic or ()

    @property
    def is_placed(self) -> bool:
        """True if the log has positions, or another file has them."""
        return bool(self.place) or self.track is not None

    @property
    def is_geodetic(self) -> bool:
        """True if positions are latitudes and longitudes, or coordinates of a grid."""
        columns = self if self.track is None else self.track.columns
        return columns.geodetic is not None or columns.crs is not None

    @property
    def above_ground(self) -> bool:
        """True if heights are above the ground."""
        columns = self if self.track is None else self.track.columns
        return columns.height_m is not None or columns.height_is == "ground"

    @property
    def attitude(self) -> tuple[str, ...]:
        """Columns of the array's attitude."""
        return self.quaternion or self.angles or ()

    def of_sensors(self, channels: Mapping[str, Sequence[str]]) -> dict[str, str]:
        """Return the columns of the log by those of a readings file, for the sensors in ``channels``."""
        named: dict[str, str] = {}
        for sensor, ours in channels.items():
            of_sensor = self.sensors.get(sensor, ())
            theirs = [of_sensor] if isinstance(of_sensor, str) else of_sensor
            if theirs and len(theirs) != len(ours):
                expected = f"{len(ours)} of them, as the sensor has channels"
                raise InputError(f"key columns.sensors.{sensor}: found {len(theirs)} names, expected {expected}.")
            named |= dict(zip(ours, theirs, strict=False))
        return named


class ValidTable(Table, kw_only=True):
    """The table ``columns.valid`` of an array file."""

    column: str
    equals: list[float]


class ColumnsTable(Table, kw_only=True):
    """The table ``columns`` of an array file."""

    separator: str = "comma"
    decimal: str = "."
    time: str | tuple[str, str] = "time_s"
    time_unit: str = "s"
    unit: str | float = "nT"
    sensors: dict[str, str | list[str]] = msgspec.field(default_factory=dict)
    date: str | None = None
    time_offset_s: float = 0.0
    day_first: bool | None = None
    position: list[str] | None = None
    geodetic: list[str] | None = None
    origin: Vector | None = None
    crs: str | None = None
    height_m: float | None = None
    height_is: str = "ellipsoid"
    antenna_m: Vector | None = None
    fix: ValidTable | None = None
    quaternion: tuple[str, str, str, str] | None = None
    angles: list[str] | None = None
    course: bool = False
    pose_latency_s: float = 0.0
    dummy: list[float | str] = msgspec.field(default_factory=list)
    valid: ValidTable | None = None
    names: list[str] = msgspec.field(default_factory=list)
    line: str | None = None
    comment: str | list[str] = "#"
    skip: str | list[str] = msgspec.field(default_factory=list)
    encoding: str | None = None

    def columns(self, path: str, channels: Mapping[str, Sequence[str]]) -> LogColumns:
        """Return the columns that the table in the array file `path` describes."""
        said = {key: _frozen(value) for key, value in msgspec.structs.asdict(self).items()}
        sensors: dict[str, str | tuple[str, ...]] = {name: _frozen(of) for name, of in self.sensors.items()}
        said |= {"sensors": sensors}
        said |= {key: (of,) for key in ("comment", "skip") if isinstance(of := said[key], str)}
        with naming(f"{path}, table columns"):
            columns = LogColumns(**said)
        for sensor in sensors:
            if sensor not in channels:
                expected = f"one of {', '.join(channels)}"
                raise InputError(f"{path}, key columns.sensors.{sensor}: found no such sensor, expected {expected}.")
        try:
            columns.of_sensors(channels)
        except InputError as error:
            raise InputError(f"{path}, {error}") from None
        return columns


def _frozen(value: Any) -> Any:
    if isinstance(value, ValidTable):
        return ValidRows(column=value.column, equals=tuple(value.equals))
    return tuple(value) if isinstance(value, list) else value


def columns_toml(columns: LogColumns) -> list[str]:
    """Return the lines of the table in an array file, without values that are those by default, and without a track."""
    by_default = LogColumns()
    own = {each.name: getattr(columns, each.name) for each in fields(columns) if each.name != "sensors"}
    own = {key: value for key, value in own.items() if value != getattr(by_default, key) and key != "track"}
    lines = ["", "[columns]", *(f"{key} = {_toml(value)}" for key, value in own.items())]
    if columns.sensors:
        lines += ["", "[columns.sensors]", *(f"{_toml(key)} = {_toml(of)}" for key, of in columns.sensors.items())]
    return lines


def _toml(value: object) -> str:
    if isinstance(value, ValidRows):
        return f"{{column = {_toml(value.column)}, equals = {_toml(value.equals)}}}"
    return toml_value(value)
