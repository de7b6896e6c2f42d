"""Readings of an array, row by row, and readings files.

A readings file is CSV with one row per instant: ``time_s``, then ``<id>_x_nT, <id>_y_nT, <id>_z_nT`` for every vector
sensor and ``<id>_nT`` for every scalar sensor, in any order. An empty cell, or ``nan``, is a missing reading. Optional
groups of columns, each complete or absent: the pose of a moving array in the world frame (``array_x_m, array_y_m,
array_z_m, array_qx, array_qy, array_qz, array_qw``), the ambient field in the array's frame (``ambient_x_nT,
ambient_y_nT, ambient_z_nT``), velocities and rates (:mod:`magloc.navigation.measured_motion`), and standard deviations
of the pose (``array_sigma_m, array_sigma_deg``).

A fault in a file raises :class:`arrays.io.errors.InputError`: file, line, column, value found, value expected.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from arrays.array import AMBIENT_CHANNELS, SensorArray
from arrays.columns import LINE, POSITION_COLUMNS, ROTATION_COLUMNS
from arrays.io.csv import Columns, Table, table_of_columns
from arrays.io.errors import InputError
from arrays.io.text import write_text
from arrays.io.values import LARGEST_T, fields, numbers, seconds
from arrays.logs.format import LogFormat, without_dummies
from arrays.logs.lines import line_starts
from arrays.sensor import Sensor
from arrays.typing import FloatArray, IntArray
from magloc.conditioning import NO_BACKGROUND, Background, without_hum
from magloc.logs.readings_table import table_of_file
from magloc.navigation.course import turned_to_course
from magloc.navigation.fixes import without_gaps
from magloc.navigation.measured_motion import MOTION_COLUMNS, MeasuredMotion, motion_columns, motion_of_table
from magloc.navigation.poses import rotations_at, unit_rotation, vectors_at

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

POSE_SIGMA_COLUMNS = ("array_sigma_m", "array_sigma_deg")
AMBIENT_COLUMNS = tuple(f"{name}_nT" for name in AMBIENT_CHANNELS)
_OPTIONAL_COLUMNS = (*POSITION_COLUMNS, *ROTATION_COLUMNS, *POSE_SIGMA_COLUMNS, *AMBIENT_COLUMNS, *MOTION_COLUMNS, LINE)
EXPECTED_HEADER = "a header with time_s and the sensors' columns"
_ROW_SHAPES = {"time_s": (), "array_position_m": (3,), "ambient_T": (3,), "pose_sigma": (2,), "interpolated_m": ()}
_T_IN_nT = 1e9
_SIGMA_UNITS = np.array([1.0, np.pi / 180.0])  # A file has a pose's standard deviations in m and degrees.
_SATURATION_RTOL = 1e-12
_LARGEST_nT = LARGEST_T * _T_IN_nT
_SAME_AMBIENT_RTOL = 1e-3  # Moduli may be averaged if the ambient field changes by less: 50 nT in 50 µT.
_SENSOR_COLUMN = re.compile(r"(?P<id>.+?)(_[xyz])?_nT")


@dataclass(frozen=True, eq=False)
class Readings:
    """Raw readings of an array at n instants; iteration yields the rows as readings of length one.

    Attributes
    ----------
    values_T : ndarray, shape (n, C)
        Raw readings [T] in the array's channel order; NaN, masked or beyond 1e6 T where a reading is missing.
    time_s : ndarray, shape (n,), optional
        Instants [s], as durations or as dates (UTC, seconds since 1970). By default one row per second from zero.
    array_position_m : ndarray, shape (n, 3), optional
        Origin of the array's frame in the world frame [m].
    array_rotation : Rotation of n, optional
        From the array's frame to the world frame.
    ambient_T : ndarray, shape (n, 3), optional
        Ambient field in the array's frame [T].
    motion : MeasuredMotion of n, optional
        Measured velocities and rates of array and object.
    pose_sigma : ndarray, shape (n, 2), optional
        Standard deviations per axis of position [m] and attitude [rad], instead of :class:`arrays.PoseUncertainty`.
    interpolated_m : ndarray, shape (n,), optional
        Standard deviation along each axis that interpolation between fixes adds to the error of a position [m].
    lines : tuple of (float, str)
        Times [s] at which survey lines begin, and their names.
    background : Background
        Model of the part of the values that is no signal, from :meth:`detrended` and :meth:`high_passed`.

    Raises
    ------
    ValueError
        The shapes do not fit, a time is not finite, or a position comes without a rotation or the other way round.

    Examples
    --------
    >>> import numpy as np
    >>> import arrays
    >>> import magloc
    >>> readings = magloc.Readings(np.zeros((3, 12)), time_s=[0.0, 0.1, 0.2])
    >>> len(readings), len(readings[readings.time_s > 0.05])
    (3, 2)
    >>> array = arrays.axial(1.0, "scalar")
    >>> columns = {"time_s": [0.0], "s1_nT": [48e3], "s2_nT": [48.1e3]}
    >>> magloc.Readings.from_columns(columns, array).values_T
    array([[4.80e-05, 4.81e-05]])
    """

    values_T: FloatArray
    _: KW_ONLY
    time_s: FloatArray = None  # type: ignore[assignment]  # never None after __post_init__
    array_position_m: FloatArray | None = None
    array_rotation: Rotation | None = None
    ambient_T: FloatArray | None = None
    motion: MeasuredMotion | None = None
    pose_sigma: FloatArray | None = None
    interpolated_m: FloatArray | None = None
    lines: tuple[tuple[float, str], ...] = ()
    background: Background = NO_BACKGROUND

    def __post_init__(self) -> None:
        for name in ("values_T", *_ROW_SHAPES):
            if (value := getattr(self, name)) is not None:
                read = fields if name == "values_T" else seconds if name == "time_s" else numbers
                object.__setattr__(self, name, read(value))
        if self.values_T.ndim != 2:
            raise ValueError(f"Input values_T must have shape (n, C); instead received {self.values_T.shape}.")
        n = len(self.values_T)
        if self.time_s is None:
            object.__setattr__(self, "time_s", np.arange(float(n)))  # type: ignore[unreachable]
        for name, shape in _ROW_SHAPES.items():
            if (value := getattr(self, name)) is not None and value.shape != (n, *shape):
                raise ValueError(f"Input {name} must have shape {(n, *shape)}; instead received {value.shape}.")
        if (bad := ~np.isfinite(self.time_s)).any():
            raise ValueError(f"Input time_s must be finite; instead row {bad.argmax() + 1} has {self.time_s[bad][0]}.")
        if (self.array_position_m is None) != (self.array_rotation is None):
            raise ValueError(
                "Inputs array_position_m and array_rotation must come together; instead received one of them."
            )
        if self.array_rotation is not None and np.shape(self.array_rotation.as_quat()) != (n, 4):
            received = 1 if self.array_rotation.single else len(self.array_rotation)
            raise ValueError(f"Input array_rotation must have {n} rotations; instead received {received}.")
        if self.pose_sigma is not None and self.array_position_m is None:
            raise ValueError("Input pose_sigma must come with a pose; instead received it without array_position_m.")
        if self.motion is not None and len(self.motion) != n:
            raise ValueError(f"Input motion must have {n} rows; instead received {len(self.motion)}.")

    @classmethod
    def from_columns(cls, columns: Columns, array: SensorArray) -> Readings:
        """Return readings from a data frame, or any mapping, with the columns of a readings file.

        Parameters
        ----------
        columns : mapping or DataFrame
            Maps the names of a file's columns, with their units, to numbers. NaN is a missing reading.
        array : SensorArray
            Array whose sensors the columns belong to.

        Raises
        ------
        InputError
            The columns are not those of this array's readings. The text names the column and the row, counted from one.
        """
        return readings_of_table(table_of_columns(columns, "the readings"), array, None)

    def __len__(self) -> int:
        return len(self.values_T)

    def __getitem__(self, rows: int | slice | NDArray[np.bool_] | IntArray) -> Readings:
        """Return selected rows; an integer gives readings of length one."""
        if isinstance(rows, (int, np.integer)):
            rows = np.arange(len(self))[[rows]]

        columns: dict[str, Any] = {name: getattr(self, name) for name in ("values_T", *_ROW_SHAPES, "array_rotation")}
        chosen = {name: column[rows] for name, column in columns.items() if column is not None}
        return replace(self, motion=None if self.motion is None else self.motion.of_rows(rows), **chosen)

    def __iter__(self) -> Iterator[Readings]:
        return (self[row] for row in range(len(self)))

    def detrended(self) -> Readings:
        """Return readings with a linear trend of every channel declared as background.

        The values do not change. A track estimates the slopes; a fix of single rows removes the lines first.

        Raises
        ------
        InputError
            A channel has fewer than two readings.
        """
        return self._with(replace(self.background, trend_about_s=float(np.mean(self.time_s))))

    def high_passed(self, hz: float) -> Readings:
        """Return readings with offsets and changes slower than a corner frequency `hz` declared as background.

        The values do not change. A track estimates a random walk of every channel, as large as its noise at the corner.
        A fix of single rows filters first, by a Butterworth filter of second order, forwards and backwards.

        Raises
        ------
        InputError
            The rows are not at equal intervals without gaps, or the corner is not below half their rate.
        """
        return self._with(replace(self.background, corner_Hz=hz))

    def _with(self, background: Background) -> Readings:
        background.taken_out(self.time_s, self.values_T)  # raises InputError if no filter can
        return replace(self, background=background)

    def without_hum(self, mains_hz: float) -> Readings:
        """Return readings without the mains frequency and its harmonics below half the rate of the rows.

        Raises
        ------
        InputError
            For the same reasons as :meth:`high_passed`.
        """
        return replace(self, values_T=without_hum(self.time_s, self.values_T, mains_hz))

    def posed_later(self, latency_s: float) -> Readings:
        """Return readings with the poses of a later time, to correct poses that lag the readings by a latency [s]."""
        if self.pose is None:
            raise ValueError("Input readings must have a pose; instead received none.")
        (position_m, rotation), later_s = self.pose, self.time_s + latency_s
        return replace(
            self,
            array_position_m=vectors_at(later_s, self.time_s, position_m),
            array_rotation=rotations_at(later_s, self.time_s, rotation),
        )

    @property
    def pose(self) -> tuple[FloatArray, Rotation] | None:
        """Origin (n, 3) [m] and rotation of the array's frame in the world frame; None without a pose."""
        if self.array_position_m is None or self.array_rotation is None:
            return None
        return self.array_position_m, self.array_rotation


def as_readings(values: Readings | ArrayLike) -> Readings:
    """Return readings unchanged, or make them from values (n, C) or (C,) [T]."""
    return values if isinstance(values, Readings) else Readings(np.atleast_2d(numbers(values)))


def read_readings(
    path: str | PathLike[str],
    array: SensorArray,
    *,
    sensors: Sequence[str] | None = None,
    ordered: bool = False,
    still: bool = False,
) -> Readings:
    """Read the readings of an array from a CSV file.

    Parameters
    ----------
    path : str or path-like
        A readings file (CSV): fields in nT, times in s. Or a log whose channels the array's columns name.
    array : SensorArray
        Array whose sensors the file must have, with a column for each channel.
    sensors : sequence of str, optional
        Ids of a subset of the array. Only their columns are read; columns of other sensors are ignored. Without this
        argument, columns of other sensors raise an error.
    ordered : bool
        Raise an error if times do not increase from row to row.
    still : bool
        Raise an error if the array moves or the ambient field changes, as :func:`magloc.averages.average` does.

    Returns
    -------
    Readings
        Readings with the channels of ``array``, or of ``array.subset(sensors)``.

    Raises
    ------
    InputError
        The file cannot be read, or is not a readings file of this array.

    Examples
    --------
    >>> import magloc
    >>> board = magloc.datasets.load("board")
    >>> magloc.read_readings(board.path, board.array).values_T.shape
    (101, 90)
    """
    form = log_format(array, sensors)
    table, error_m = without_gaps(table_of_file(path, form))
    if array.columns is not None:
        table = turned_to_course(table, array, array.columns)
    readings = replace(readings_of_table(table, array, sensors), interpolated_m=error_m)
    if array.columns is not None and array.columns.pose_latency_s:
        readings = readings.posed_later(array.columns.pose_latency_s)
    if ordered:
        table.refuse_back("time_s", ~(np.diff(readings.time_s) > 0.0), "time to increase from row to row", "{:.15g}")
    if still and (change := change_between_rows(readings)) is not None:
        what, row, expected = change
        lines = f"lines {table.line_numbers[0]} and {table.line_numbers[row]}"
        raise InputError(f"{path}: found {what} between {lines}, expected {expected}.")
    return readings


def log_format(array: SensorArray, sensors: Sequence[str] | None) -> LogFormat:
    """Return the format of a file or stream of readings of some or all sensors."""
    channels = {of.id: _columns_of(of) for of in array.sensors if sensors is None or of.id in sensors}
    return LogFormat(channels, array.columns, EXPECTED_HEADER, _OPTIONAL_COLUMNS)


def readings_of_table(table: Table, array: SensorArray, sensors: Sequence[str] | None) -> Readings:
    """Return readings as :func:`read_readings` does, from a table, which may have no rows."""
    if sensors is not None:
        array = array.subset(sensors)
    channels = [f"{name}_nT" for name in array.channel_names]
    _check_sensor_columns(table, array, channels, ignore_others=sensors is not None)
    return readings_of_checked(without_dummies(table, log_format(array, None)), array)


def readings_of_checked(table: Table, array: SensorArray) -> Readings:
    """Return readings of a table without dummies whose header :func:`readings_of_table` has checked."""
    channels = [f"{name}_nT" for name in array.channel_names]
    time_s = table.times()
    position_m = rotation = ambient_T = pose_sigma = None
    if table.has_group(POSITION_COLUMNS + ROTATION_COLUMNS):
        position_m, rotation = table.complete(POSITION_COLUMNS), unit_rotation(table, ROTATION_COLUMNS)
    if table.has_group(POSE_SIGMA_COLUMNS):
        if position_m is None:
            place = table.header_place(POSE_SIGMA_COLUMNS[0])
            raise InputError(f"{place}: found no pose, expected array_x_m and so on with it.")
        pose_sigma = table.complete(POSE_SIGMA_COLUMNS) * _SIGMA_UNITS
        table.refuse(pose_sigma < 0.0, POSE_SIGMA_COLUMNS, "found a number below zero, expected a standard deviation")
    if table.has_group(AMBIENT_COLUMNS):
        ambient_T = table.complete(AMBIENT_COLUMNS) / _T_IN_nT
    motion = motion_of_table(table, posed=position_m is not None)
    values_nT = table.finite_or_missing(channels)
    table.refuse(np.abs(values_nT) > _LARGEST_nT, channels, f"found a field above {_LARGEST_nT:g} nT, expected less")
    return Readings(
        values_nT / _T_IN_nT,
        time_s=time_s,
        array_position_m=position_m,
        array_rotation=rotation,
        ambient_T=ambient_T,
        motion=motion,
        pose_sigma=pose_sigma,
        lines=line_starts(table),
    )


def write_readings(path: str | PathLike[str], readings: Readings, array: SensorArray) -> None:
    """Write a readings file with the array's columns; an existing file is replaced.

    Fields are written in nT with 15 significant digits, the other numbers exactly.
    """
    _check_channels(readings, array)
    header = ["time_s", *(f"{name}_nT" for name in array.channel_names)]
    plain: list[FloatArray] = []
    fields = [readings.values_T]
    if readings.ambient_T is not None:
        header += AMBIENT_COLUMNS
        fields.append(readings.ambient_T)
    if readings.pose is not None:
        header += POSITION_COLUMNS + ROTATION_COLUMNS
        plain += [readings.pose[0], readings.pose[1].as_quat()]
    if readings.pose_sigma is not None:
        header += POSE_SIGMA_COLUMNS
        plain.append(readings.pose_sigma / _SIGMA_UNITS)
    if readings.motion is not None:
        names, numbers_of_motion = motion_columns(readings.motion)
        header += names
        plain.append(numbers_of_motion)
    fields_nT = (np.hstack(fields) * _T_IN_nT).tolist()
    numbers = np.hstack(plain).tolist() if plain else [[]] * len(readings)
    lines = [",".join(header)]
    for time, nanotesla, row in zip(readings.time_s.tolist(), fields_nT, numbers, strict=True):
        cells = ["" if math.isnan(value) else f"{value:.15g}" for value in nanotesla]
        lines.append(",".join([repr(time), *cells, *map(repr, row)]))
    write_text("\n".join([*lines, ""]), path)


def change_between_rows(readings: Readings) -> tuple[str, int, str] | None:
    """Return why rows cannot be averaged, the first row that differs, and the expected input; None if they can."""
    ambient_T = readings.ambient_T
    if readings.pose is not None:
        pose = np.hstack([readings.pose[0], readings.pose[1].as_quat()])
        moved = np.any(pose != pose[0], axis=1)
        if moved.any():
            return "the array moved", int(moved.argmax()), "one pose for all rows that are averaged"
    if ambient_T is not None:
        changed = np.linalg.norm(ambient_T - ambient_T[0], axis=1) > _SAME_AMBIENT_RTOL * np.linalg.norm(ambient_T[0])
        if changed.any():
            expected = "one ambient field for all rows that are averaged"
            return "the ambient field changed", int(changed.argmax()), expected
    return None


def without_saturated(readings: Readings, array: SensorArray) -> Readings:
    """Return readings with NaN for each value whose modulus reaches the ``saturation_T`` of its sensor."""
    _check_channels(readings, array)
    # A limit and a reading with the same digits in two files may differ by their rounding.
    saturated = np.abs(readings.values_T) >= array.channel_saturation_T * (1.0 - _SATURATION_RTOL)
    return replace(readings, values_T=np.where(saturated, np.nan, readings.values_T))


def _check_channels(readings: Readings, array: SensorArray) -> None:
    if (n := readings.values_T.shape[1]) != array.n_channels:
        expected = f"the {array.n_channels} channels of the array"
        raise ValueError(f"Input readings must have {expected}; instead received {n}.")


def _check_sensor_columns(table: Table, array: SensorArray, channels: Sequence[str], *, ignore_others: bool) -> None:
    known, called = ("time_s", *channels, *_OPTIONAL_COLUMNS), f"array {array.name!r}" if array.name else "the array"
    table.require("time_s", known)
    for sensor in array.sensors:
        for name in _columns_of_other_kind(sensor):
            if name in table.header and name not in known:
                own = ", ".join(_columns_of(sensor))
                raise InputError(
                    f"{table.header_place(name)}: found a column of another kind of sensor, expected {own} "
                    f"because sensor {sensor.id} of {called} is a {sensor.kind} sensor."
                )
    missing = {sensor.id for sensor in array.sensors if not set(_columns_of(sensor)) & set(table.header)}
    if missing and len(missing) < array.n_sensors and not set(table.header) - set(known):
        raise InputError(
            f"{table.header_place(next(c for s in array.sensors if s.id in missing for c in _columns_of(s)))}: found no"
            f" column of sensor {_listed(sorted(missing))}, expected those of all sensors of {called}, or those of a"
            f" subset of it: {_listed([name for name in array.ids if name not in missing])}."
        )
    for name in channels:
        table.require(name, known)
    for name in table.header:
        sensor_column = _SENSOR_COLUMN.fullmatch(name)
        if name in known or (sensor_column and ignore_others):
            continue
        if sensor_column:
            raise InputError(
                f"{table.header_place(name)}: found a column of sensor {sensor_column['id']}, "
                f"which {called} does not have, expected columns of {_listed(array.ids)}."
            )
        raise InputError(
            f"{table.header_place(name)}: found an unknown column, expected time_s, "
            "<sensor>_x_nT and so on, and optionally array_x_m and so on (pose), array_vx_m_s and so on (motion) or"
            " ambient_x_nT and so on."
        )


def _columns_of(sensor: Sensor) -> list[str]:
    return [f"{channel}_nT" for channel in sensor.channel_names]


def _columns_of_other_kind(sensor: Sensor) -> list[str]:
    """Return the columns that a sensor of the other kind would have."""
    return [f"{sensor.id}_nT"] if sensor.kind == "vector" else [f"{sensor.id}_{axis}_nT" for axis in "xyz"]


def _listed(ids: Sequence[str], most: int = 6) -> str:
    return ", ".join(ids) if len(ids) <= most else f"{', '.join(ids[: most - 1])} … {ids[-1]}"
