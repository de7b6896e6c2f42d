"""How another program names and counts the columns of its logs: the table ``columns`` of an array file.

The columns of a log become those of a readings file: names, units and times are translated, geodetic places become
east, north, up of an origin, and yaw, pitch and roll a quaternion. Columns that nothing names are left out.
"""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace

import msgspec
import numpy as np

from arrays.io.csv import DUMMY, table_of_header, table_of_text, unix_seconds
from arrays.io.csv import Table as CsvTable
from arrays.io.dummies import dummy_cells, may_be_dummies
from arrays.io.errors import InputError, naming, of_extra
from arrays.io.toml import Table
from arrays.typing import FloatArray, Vector

_LOG = logging.getLogger(__name__)
POSITION_COLUMNS = ("array_x_m", "array_y_m", "array_z_m")
ROTATION_COLUMNS = ("array_qx", "array_qy", "array_qz", "array_qw")
_NANOTESLA = {"nT": 1.0, "uT": 1e3, "µT": 1e3, "mT": 1e6, "T": 1e9, "mG": 1e2, "G": 1e5}
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "iso": 1.0}
_SEPARATORS = {"comma": ",", "semicolon": ";", "tab": "\t", "space": " "}
_CHOICES = {"separator": _SEPARATORS, "decimal": (".", ","), "time_unit": _SECONDS}
_ENU_FROM_NED = ((0, 1, 0), (1, 0, 0), (0, 0, -1))
_BODY_FROM_ARRAY = ((1, 0, 0), (0, -1, 0), (0, 0, -1))
_FEW_ROWS = 20  # whose cells are screened before columns are


@dataclass(frozen=True, kw_only=True)
class ValidRows:
    """Rows of a log whose readings count.

    Attributes
    ----------
    column : str
        Name of a column of numbers.
    equals : tuple of float
        Its values in rows that count; rows with another one, or with none, have no reading.

    Examples
    --------
    >>> import arrays
    >>> arrays.LogColumns(valid=arrays.ValidRows(column="MagValid", equals=(1.0,))).valid.column
    'MagValid'
    """

    column: str
    equals: tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class LogColumns:
    """Columns of a log that is no readings file.

    Attributes
    ----------
    separator : str
        "comma", "semicolon", "tab" or "space".
    decimal : str
        "." or ",", of its numbers.
    time : str or tuple of 2 str
        Name of the column with the time, or with "iso" those of the date and of the time.
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
        With `geodetic`: latitude, longitude [deg] and height [m] of the world's origin, one for all logs.
    quaternion : tuple of 4 str, optional
        Columns of the attitude, from the array's frame to the world, x, y, z, w.
    angles : tuple of str, optional
        In its place: yaw, or yaw, pitch and roll [deg], from north, east, down to forward, right, down; the array's own
        axes are forward, left, up. Without any attitude its axes are those of the world.
    pose_latency_s : float
        How much older the pose of a row is than its readings [s].
    dummy : tuple of float and str
        Numbers, in the unit of the log, and words that stand where there is no reading.
    valid : ValidRows, optional
        Rows whose readings count; by default all.

    Raises
    ------
    ValueError
        A value is none of those above, or two do not fit each other.

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
    position: tuple[str, str, str] | None = None
    geodetic: tuple[str, str, str] | None = None
    origin: Vector | None = None
    quaternion: tuple[str, str, str, str] | None = None
    angles: tuple[str, ...] | None = None
    pose_latency_s: float = 0.0
    dummy: tuple[float | str, ...] = ()
    valid: ValidRows | None = None

    def __post_init__(self) -> None:
        for name, choices in _CHOICES.items():
            if (value := getattr(self, name)) not in choices:
                raise ValueError(f"Input {name} must be one of {', '.join(choices)}; instead received {value!r}.")
        if self.unit not in _NANOTESLA and not (isinstance(self.unit, float | int) and 0.0 < self.unit < math.inf):
            expected = f"one of {', '.join(_NANOTESLA)}, or how many nT a count is"
            raise ValueError(f"Input unit must be {expected}; instead received {self.unit!r}.")
        if len(self.clock) > 1 and self.time_unit != "iso":
            raise ValueError(f"Input time_unit must be iso for a date and a time; instead received {self.time_unit!r}.")
        if self.decimal == "," and self.separator == "comma":
            raise ValueError("Input decimal must not be ',' beside the separator comma.")
        for first, second in (("position", "geodetic"), ("quaternion", "angles")):
            if getattr(self, first) is not None and getattr(self, second) is not None:
                raise ValueError(f"Input {second} must not come together with {first}.")
        if self.angles is not None and len(self.angles) not in (1, 3):
            raise ValueError(
                f"Input angles must be yaw, or yaw, pitch, roll; instead received {len(self.angles)} names."
            )
        if not self.place and (self.attitude or self.pose_latency_s):
            raise ValueError(
                "Inputs position or geodetic must come with an attitude or a latency; instead received none."
            )
        if (self.geodetic is None) != (self.origin is None):
            raise ValueError("Inputs geodetic and origin must come together; instead received one of them.")
        numbers = (self.pose_latency_s, *(self.origin or ()))
        if not np.isfinite(numbers).all():
            raise ValueError(f"Inputs origin and pose_latency_s must be finite; instead received {numbers}.")

    @property
    def unit_nT(self) -> float:
        """Unit of the sensors' columns [nT]."""
        return self.unit if isinstance(self.unit, float | int) else _NANOTESLA[self.unit]

    @property
    def clock(self) -> tuple[str, ...]:
        """Column of the time, or those of date and time."""
        return (self.time,) if isinstance(self.time, str) else self.time

    @property
    def place(self) -> tuple[str, ...]:
        """Columns of the array's place."""
        return self.position or self.geodetic or ()

    @property
    def attitude(self) -> tuple[str, ...]:
        """Columns of its attitude."""
        return self.quaternion or self.angles or ()

    def of_sensors(self, channels: Mapping[str, Sequence[str]]) -> dict[str, str]:
        """By the names of a readings file those of the log; sensors that are not among ``channels`` are left out."""
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
    position: tuple[str, str, str] | None = None
    geodetic: tuple[str, str, str] | None = None
    origin: Vector | None = None
    quaternion: tuple[str, str, str, str] | None = None
    angles: list[str] | None = None
    pose_latency_s: float = 0.0
    dummy: list[float | str] = msgspec.field(default_factory=list)
    valid: ValidTable | None = None

    def columns(self, path: str, channels: Mapping[str, Sequence[str]]) -> LogColumns:
        """What the table of the array file `path` says, whose sensors have these channels."""
        said = msgspec.structs.asdict(self)
        sensors = {name: tuple(of) if isinstance(of, list) else of for name, of in self.sensors.items()}
        said |= {"sensors": sensors, "angles": None if self.angles is None else tuple(self.angles)}
        said |= {"dummy": tuple(self.dummy)}
        if self.valid is not None:
            said |= {"valid": ValidRows(column=self.valid.column, equals=tuple(self.valid.equals))}
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


def columns_toml(columns: LogColumns) -> list[str]:
    """Lines of the table of an array file."""
    said = {each.name: getattr(columns, each.name) for each in fields(columns) if each.name != "sensors"}
    lines = ["", "[columns]", *(f"{key} = {_toml(value)}" for key, value in said.items() if value is not None)]
    if columns.sensors:
        lines += ["", "[columns.sensors]", *(f"{_toml(key)} = {_toml(of)}" for key, of in columns.sensors.items())]
    return lines


def _toml(value: object) -> str:
    if isinstance(value, ValidRows):
        return f"{{column = {_toml(value.column)}, equals = {_toml(value.equals)}}}"
    return json.dumps(list(value) if isinstance(value, tuple) else value, ensure_ascii=False)


@dataclass(frozen=True)
class LogFormat:
    """How the text of a readings file, or of a log, becomes a table with the names and units of a readings file.

    Attributes
    ----------
    channels : dict
        Columns of a readings file for every sensor, by its id.
    columns : LogColumns, optional
        Of a log; None: of a readings file.
    expected : str
        What the header should have, in words.
    others : collection of str
        Further columns of a readings file that are taken as they are.
    """

    channels: Mapping[str, Sequence[str]]
    columns: LogColumns | None
    expected: str
    others: Collection[str]

    @property
    def separator(self) -> str:
        """Between the cells of a row."""
        return "," if self.columns is None else _SEPARATORS[self.columns.separator]

    def begins(self, line: str) -> bool:
        """Whether a line names columns, the time among them."""
        if self.columns is None:
            return "time_s" in line
        return self.columns.clock[0] in self._names(line)

    def clock(self, header: str) -> Callable[[str], float]:
        """What tells the time [s] of a row below a header; ValueError or IndexError where it has none."""
        columns, names = self.columns, self._names(header)
        at = [names.index(name) for name in (("time_s",) if columns is None else columns.clock) if name in names] or [0]

        def seconds(row: str) -> float:
            cells = row.split(self.separator)
            told = "T".join(cells[i].strip() for i in at)
            if columns is None:
                return float(told)
            if columns.time_unit == "iso":
                return float(unix_seconds("", told))
            return _SECONDS[columns.time_unit] * float(told.replace(columns.decimal, "."))

        return seconds

    def _names(self, line: str) -> list[str]:
        return [cell.strip().strip('"') for cell in line.split(self.separator)]

    def header(self, line: str, name: str, number: int) -> CsvTable:
        """Table without rows, as the log names its columns, from its first line."""
        return table_of_header(line, name, self.expected, number=number, separator=self.separator)

    def table(self, text: str, name: str, *, first_line: int | None = None, head: CsvTable | None = None) -> CsvTable:
        """Table of a text; rows that begin at a line below a header `head` have none of their own."""
        columns = self.columns
        if columns is None:
            return table_of_text(text, name, self.expected, first_line=first_line, head=head)
        table = table_of_text(
            text,
            name,
            self.expected,
            first_line=first_line,
            only={*self._theirs(columns), *self._own, *self.others},
            instant=columns.clock if columns.time_unit == "iso" else (),
            separator=self.separator,
            decimal=columns.decimal,
            head=head,
            dummy=[each for each in columns.dummy if isinstance(each, str)],
        )
        return self.translated(table)

    def translated(self, logged: CsvTable) -> CsvTable:
        """The table with the names and units of a readings file."""
        columns = self.columns
        if columns is None:
            return logged
        theirs, own = self._theirs(columns), self._own
        for name in theirs:
            logged.require(name, theirs)
        index = {name: i for i, name in enumerate(logged.header)}
        found = {name: logged.values[:, i] for name, i in index.items() if name in own or name in self.others}
        named = columns.of_sensors(self.channels)
        found |= {ours: logged.values[:, index[in_log]] for ours, in_log in named.items()}
        unusable = np.zeros(len(logged.values), np.bool_)
        if columns.valid is not None:
            unusable = ~np.isin(logged.values[:, index[columns.valid.column]], columns.valid.equals)
            if unusable.any() and logged.header_line:  # of a file, not of a stream
                fault = f"{columns.valid.column} that is not {' or '.join(map('{:g}'.format, columns.valid.equals))}"
                _LOG.warning(f"{logged.path}: the readings of {unusable.sum()} rows have {fault} and are left out")
        readings = {name: np.where(unusable, np.nan, columns.unit_nT * found[name]) for name in own & found.keys()}
        found |= {name: np.where(found[name] == DUMMY, DUMMY, of) for name, of in readings.items()}
        found["time_s"] = _SECONDS[columns.time_unit] * logged.complete_and_distinct(columns.clock[0])
        if columns.place:
            found |= zip(POSITION_COLUMNS, _position(logged, columns).T, strict=True)
        if columns.attitude or (columns.place and not set(ROTATION_COLUMNS) & found.keys()):
            found |= zip(ROTATION_COLUMNS, _quaternion(logged, columns).T, strict=True)
        values = np.stack([*found.values()], axis=1)
        return CsvTable(logged.path, tuple(found), logged.header_line, values, logged.line_numbers)

    @property
    def _own(self) -> set[str]:
        return {name for of_sensor in self.channels.values() for name in of_sensor}

    def _theirs(self, columns: LogColumns) -> tuple[str, ...]:
        valid = () if columns.valid is None else (columns.valid.column,)
        named = columns.of_sensors(self.channels).values()
        return (*columns.clock, *named, *columns.place, *columns.attitude, *valid)


READINGS_FILE = LogFormat({}, None, "", ())
"""Of a readings file, of whatever sensors."""


def _position(table: CsvTable, columns: LogColumns) -> FloatArray:
    """Places (n, 3) [m] in the world."""
    place = table.complete(columns.place)
    if columns.origin is None:
        return place
    with of_extra("geo", "latitude and longitude"):
        from pymap3d import geodetic2enu
    return np.stack(geodetic2enu(*place.T, *columns.origin), axis=1)


def _quaternion(table: CsvTable, columns: LogColumns) -> FloatArray:
    """Attitudes (n, 4), from the array's axes to the world's, which they are where nothing is known."""
    from scipy.spatial.transform import Rotation

    logged = table.complete(columns.attitude)
    if columns.quaternion is not None:
        return logged
    if not columns.attitude:
        return np.tile([0.0, 0.0, 0.0, 1.0], (len(logged), 1))
    angles = np.zeros((len(logged), 3))
    angles[:, : logged.shape[1]] = logged
    enu_from_ned, body_from_array = map(Rotation.from_matrix, (_ENU_FROM_NED, _BODY_FROM_ARRAY))
    turn = enu_from_ned * Rotation.from_euler("ZYX", angles, degrees=True) * body_from_array
    return np.asarray(turn.as_quat())


def without_dummies(
    table: CsvTable, form: LogFormat, name: Callable[[str, int], None] | None = None, before: FloatArray | None = None
) -> CsvTable:
    """Return a table of readings with NaN in place of dummy values, which are counted and named.

    Parameters
    ----------
    table : Table
        With the columns of a readings file.
    form : LogFormat
        Its sensors, and which dummies are declared.
    name : callable, optional
        Called with a sentence and the number of dummies; by default a warning is logged.
    before : ndarray, shape (m, columns), optional
        Rows that came before.
    """
    columns = form.columns or LogColumns()
    declared = [columns.unit_nT * each for each in columns.dummy if not isinstance(each, str)]
    values = table.values.copy()
    earlier = values[:0] if before is None else before
    all_rows, units = np.concatenate([earlier, values]), sorted({1.0, columns.unit_nT})
    is_quick = 0 < len(values) <= _FEW_ROWS
    suspected = may_be_dummies(all_rows, len(values), declared, units).tolist() if is_quick else None
    found: dict[str, int] = {}
    index = {name: i for i, name in enumerate(table.header)}
    for sensor, channels in form.channels.items():
        own = [index[channel] for channel in channels]
        if suspected is not None and not any(suspected[i] for i in own):
            continue
        cells = dummy_cells(all_rows[:, own], declared, units)[len(earlier) :]
        if cells.any():
            numbers = ", ".join("*" if n == DUMMY else f"{n:.10g}" for n in np.unique(values[:, own][cells]))
            found[f"of sensor {sensor} ({numbers})"] = int(cells.any(axis=1).sum())
            values[:, own] = np.where(cells, np.nan, values[:, own])
    if found:
        total = sum(found.values())
        each = ", ".join(f"{count} {where}" for where, count in found.items())
        words = f"{table.path}: dummy values are left out: {total} in all, {each}"
        if name is None:
            _LOG.warning(words)
        else:
            name(words, total)
    return replace(table, values=values)
