"""Readings of an array row by row, and the files that hold them.

A readings file is CSV with one row per instant: ``time_s``, then ``<id>_x_nT, <id>_y_nT, <id>_z_nT`` for every vector
sensor and ``<id>_nT`` for every scalar sensor, in any order. An empty cell, or ``nan``, is a missing reading. Optional
groups of columns, each complete or absent: the pose of a moving array in the world frame (``array_x_m, array_y_m,
array_z_m, array_qx, array_qy, array_qz, array_qw``) and the ambient field in the array's frame (``ambient_x_nT,
ambient_y_nT, ambient_z_nT``). A truth file has ``time_s, x_m, y_m[, z_m][, mx_Am2, my_Am2, mz_Am2]``.

Whatever is wrong with a file is an :class:`arrays.io.errors.InputError` of one sentence: the file, the line as an
editor counts it, the column, what was found and what was expected.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from arrays.array import SensorArray
from arrays.io.errors import InputError

if TYPE_CHECKING:
    pass
import math
import re
from dataclasses import dataclass
from os import PathLike

from arrays.array import AMBIENT_CHANNELS
from arrays.io.csv import Table, read_table, table_of_text
from arrays.io.text import write_text
from arrays.sensor import Sensor
from arrays.typing import FloatArray

IntArray = NDArray[np.int64]
POSITION_COLUMNS = ("array_x_m", "array_y_m", "array_z_m")
ROTATION_COLUMNS = ("array_qx", "array_qy", "array_qz", "array_qw")
AMBIENT_COLUMNS = tuple(f"{name}_nT" for name in AMBIENT_CHANNELS)
TRUE_POSITION_COLUMNS = ("x_m", "y_m", "z_m")
TRUE_MOMENT_COLUMNS = ("mx_Am2", "my_Am2", "mz_Am2")
_T_IN_nT = 1e9
SAME_TIME_S = 1e-6
_SATURATION_RTOL = 1e-12
_LARGEST_nT = 1e15  # a million tesla: a column of something else, or a broken line
# Change of the ambient field, relative, within which moduli may be averaged: 50 nT in 50 µT.
_SAME_AMBIENT_RTOL = 1e-3
_UNIT_QUATERNION_ATOL = 1e-3  # a log that keeps four decimals passes; the quaternion is normalised afterwards
_SENSOR_COLUMN = re.compile(r"(?P<id>.+?)(_[xyz])?_nT")


@dataclass(frozen=True, eq=False)
class Readings:
    """Raw readings of an array at n instants.

    Attributes
    ----------
    time_s : ndarray, shape (n,)
        Instants [s].
    values_T : ndarray, shape (n, C)
        Raw readings [T] in the array's channel order; NaN where a reading is missing.
    line_numbers : ndarray of int, shape (n,)
        Line of the file that each row came from, counted from 1.
    array_position_m : ndarray, shape (n, 3), optional
        Origin of the array's frame in the world frame [m].
    array_rotation_xyzw : ndarray, shape (n, 4), optional
        Unit quaternions, array frame to world frame.
    ambient_T : ndarray, shape (n, 3), optional
        Ambient field in the array's frame [T].
    """

    time_s: FloatArray
    values_T: FloatArray
    line_numbers: IntArray
    array_position_m: FloatArray | None = None
    array_rotation_xyzw: FloatArray | None = None
    ambient_T: FloatArray | None = None

    def __post_init__(self) -> None:
        n = len(self.time_s)
        if np.ndim(self.values_T) != 2:
            raise ValueError(f"Input values_T must have shape (n, C); instead received {np.shape(self.values_T)}.")
        expected = {
            "values_T": (n, self.values_T.shape[1]),
            "line_numbers": (n,),
            "array_position_m": (n, 3),
            "array_rotation_xyzw": (n, 4),
            "ambient_T": (n, 3),
        }
        for name, shape in expected.items():
            value = getattr(self, name)
            if value is not None and np.shape(value) != shape:
                raise ValueError(f"Input {name} must have shape {shape}; instead received {np.shape(value)}.")
        if (self.array_position_m is None) != (self.array_rotation_xyzw is None):
            raise ValueError(
                "Inputs array_position_m and array_rotation_xyzw must come together; instead received one of them."
            )

    def __len__(self) -> int:
        return len(self.time_s)

    @property
    def pose(self) -> tuple[FloatArray, Rotation] | None:
        """Origin (n, 3) [m] and rotation of the array's frame in the world frame, if they are known."""
        if self.array_position_m is None or self.array_rotation_xyzw is None:
            return None
        return self.array_position_m, Rotation.from_quat(self.array_rotation_xyzw)


@dataclass(frozen=True, eq=False)
class Truth:
    """Where the source truly was at n instants.

    Attributes
    ----------
    time_s : ndarray, shape (n,)
        Instants [s].
    position_m : ndarray, shape (n, 3)
        Position of the source [m]; z is NaN where the file does not give it.
    moment_Am2 : ndarray, shape (n, 3), optional
        Moment of the source [A·m²].
    """

    time_s: FloatArray
    position_m: FloatArray
    moment_Am2: FloatArray | None = None


def read_readings(path: str | PathLike[str], array: SensorArray, *, sensors: Sequence[str] | None = None) -> Readings:
    """Readings of an array from a CSV file.

    Parameters
    ----------
    path : path-like
    array : SensorArray
        Whose sensors the file must have, with a column for each channel.
    sensors : sequence of str, optional
        Ids of a subset of the array. Only their columns are read, and the columns of any other sensor are ignored;
        without it such columns are an error.

    Returns
    -------
    Readings
        With the channels of ``array``, or of ``array.subset(sensors)``.

    Raises
    ------
    InputError
        The file cannot be read, or is not a readings file of this array.
    """
    return _readings_of_table(read_table(path, "a header with time_s and the sensors' columns"), array, sensors)


def readings_of_text(
    text: str, name: str, array: SensorArray, *, sensors: Sequence[str] | None = None, first_line: int = 2
) -> Readings:
    """Readings as :func:`read_readings`, from CSV text.

    Parameters
    ----------
    text : str
        Header and rows.
    name : str
        What the text is called in errors.
    array, sensors
        As in :func:`read_readings`.
    first_line : int
        Line number of the first row, for errors.

    Returns
    -------
    Readings

    Raises
    ------
    InputError
        The text is not that of a readings file of this array.
    """
    table = table_of_text(text, name, "a header with time_s and the sensors' columns", first_line=first_line)
    return _readings_of_table(table, array, sensors)


def _readings_of_table(table: Table, array: SensorArray, sensors: Sequence[str] | None) -> Readings:
    if sensors is not None:
        array = array.subset(sensors)
    channels = [f"{name}_nT" for name in array.channel_names]
    _check_sensor_columns(table, array, channels, ignore_others=sensors is not None)
    time_s = table.complete_and_distinct("time_s")
    position_m = rotation_xyzw = ambient_T = None
    if table.has_group(POSITION_COLUMNS + ROTATION_COLUMNS):
        position_m = table.complete(POSITION_COLUMNS)
        rotation_xyzw = _unit_quaternions(table)
    if table.has_group(AMBIENT_COLUMNS):
        ambient_T = table.complete(AMBIENT_COLUMNS) / _T_IN_nT
    values_nT = table.finite_or_missing(channels)
    table.refuse(np.abs(values_nT) > _LARGEST_nT, channels, f"found a field above {_LARGEST_nT:g} nT, expected less")
    return Readings(time_s, values_nT / _T_IN_nT, table.line_numbers, position_m, rotation_xyzw, ambient_T)


def read_truth(path: str | PathLike[str]) -> Truth:
    """True positions, and moments where they are known, from a CSV file.

    Parameters
    ----------
    path : path-like

    Returns
    -------
    Truth

    Raises
    ------
    InputError
        The file cannot be read, or is not a truth file.
    """
    table = read_table(path, "a header with time_s, x_m and y_m")
    known = ("time_s", *TRUE_POSITION_COLUMNS, *TRUE_MOMENT_COLUMNS)
    for name in ("time_s", "x_m", "y_m"):
        table.require(name, known)
    for name in table.header:
        if name not in known:
            raise InputError(
                f"{table.header_place(name)}: found an unknown column, expected one of {', '.join(known)}."
            )
    time_s = table.complete_and_distinct("time_s")
    position_m = np.full((len(time_s), 3), np.nan)
    columns = TRUE_POSITION_COLUMNS if "z_m" in table.header else TRUE_POSITION_COLUMNS[:2]
    position_m[:, : len(columns)] = table.complete(columns)
    moment_Am2 = table.complete(TRUE_MOMENT_COLUMNS) if table.has_group(TRUE_MOMENT_COLUMNS) else None
    return Truth(time_s, position_m, moment_Am2)


def rows_of_same_time(readings: Readings, truth: Truth) -> tuple[IntArray, IntArray]:
    """Rows of readings and of a truth that have the same time, to a microsecond.

    Parameters
    ----------
    readings : Readings
    truth : Truth

    Returns
    -------
    in_readings, in_truth : ndarray of int, shape (k,)
        In the order of the readings; empty where no time agrees.
    """
    order = np.argsort(truth.time_s, kind="stable")
    times = truth.time_s[order]
    after = np.clip(np.searchsorted(times, readings.time_s), 1, max(1, len(times) - 1))
    before, after = after - 1, np.minimum(after, len(times) - 1)
    nearest = np.where(np.abs(times[before] - readings.time_s) <= np.abs(times[after] - readings.time_s), before, after)
    same = np.abs(times[nearest] - readings.time_s) <= SAME_TIME_S
    return np.flatnonzero(same), order[nearest[same]]


def write_readings(path: str | PathLike[str], readings: Readings, array: SensorArray) -> None:
    """Write a readings file.

    Fields are written in nT with 15 significant digits, which are those of the file that they were read from, if it had
    no more; the other numbers are written exactly.

    Parameters
    ----------
    path : path-like
        Replaced if it exists.
    readings : Readings
    array : SensorArray
        Names the columns.

    Raises
    ------
    ValueError
        The readings do not have the array's channels.
    """
    _check_channels(readings, array)
    header = ["time_s", *(f"{name}_nT" for name in array.channel_names)]
    plain: list[FloatArray] = []
    fields = [readings.values_T]
    if readings.ambient_T is not None:
        header += AMBIENT_COLUMNS
        fields.append(readings.ambient_T)
    if readings.array_position_m is not None and readings.array_rotation_xyzw is not None:
        header += POSITION_COLUMNS + ROTATION_COLUMNS
        plain += [readings.array_position_m, readings.array_rotation_xyzw]
    fields_nT = (np.hstack(fields) * _T_IN_nT).tolist()
    numbers = np.hstack(plain).tolist() if plain else [[]] * len(readings)
    lines = [",".join(header)]
    for time, nanotesla, row in zip(readings.time_s.tolist(), fields_nT, numbers, strict=True):
        cells = ["" if math.isnan(value) else f"{value:.15g}" for value in nanotesla]
        lines.append(",".join([repr(time), *cells, *map(repr, row)]))
    write_text("\n".join([*lines, ""]), path)


def average(readings: Readings) -> Readings:
    """All complete rows averaged to one.

    Complete are the rows with every channel that any row has. Rows with less are left out: the field common to all
    sensors changes from row to row, and cancels only between channels that are averaged over the same rows.

    Parameters
    ----------
    readings : Readings
        Of an array that does not move.

    Returns
    -------
    Readings
        One row, at the mean time and with the line number of the first complete one. A channel that no row has stays
        missing.

    Raises
    ------
    InputError
        The array moves, or the ambient field changes, between the rows, or no row is complete.
    """
    position_m, rotation_xyzw, ambient_T = readings.array_position_m, readings.array_rotation_xyzw, readings.ambient_T
    if position_m is not None and rotation_xyzw is not None:
        moved = np.any(position_m != position_m[0], axis=1) | np.any(rotation_xyzw != rotation_xyzw[0], axis=1)
        if moved.any():
            raise InputError(
                f"found the array moved between lines {readings.line_numbers[0]} and "
                f"{readings.line_numbers[moved.argmax()]}, "
                "expected one pose for all rows that are averaged."
            )
        position_m, rotation_xyzw = position_m[:1], rotation_xyzw[:1]
    if ambient_T is not None:
        changed = np.linalg.norm(ambient_T - ambient_T[0], axis=1) > _SAME_AMBIENT_RTOL * np.linalg.norm(ambient_T[0])
        if changed.any():
            raise InputError(
                f"found the ambient field changed between lines {readings.line_numbers[0]} and "
                f"{readings.line_numbers[changed.argmax()]}, expected one ambient field for all rows that are averaged."
            )
    complete = complete_rows(readings)
    if not complete.any():
        raise InputError("found no row with all channels, expected at least one for an average.")
    return Readings(
        time_s=readings.time_s[complete].mean(keepdims=True),
        values_T=readings.values_T[complete].mean(axis=0, keepdims=True),
        line_numbers=readings.line_numbers[complete][:1],
        array_position_m=position_m,
        array_rotation_xyzw=rotation_xyzw,
        ambient_T=None if ambient_T is None else ambient_T[complete].mean(axis=0, keepdims=True),
    )


def complete_rows(readings: Readings) -> NDArray[np.bool_]:
    """Rows with every channel that any row has."""
    present = np.isfinite(readings.values_T)
    return np.asarray((present == present.any(axis=0)).all(axis=1))


def averaging_array(array: SensorArray, readings: Readings) -> SensorArray:
    r"""The array with the noise of :func:`average`'s row in place of that of a single row.

    White noise, and the proportional noise with it, falls by :math:`\sqrt n` with n complete rows. Misalignments and
    errors of the gains stay as they are: they are the same in every row, and no average removes them.

    Parameters
    ----------
    array : SensorArray
    readings : Readings
        The rows that are averaged.

    Returns
    -------
    SensorArray
    """
    root = math.sqrt(max(1, int(complete_rows(readings).sum())))
    sensors = tuple(replace(sensor, noise_T=sensor.noise_T / root) for sensor in array.sensors)
    return replace(array, sensors=sensors, noise_fraction=array.noise_fraction / root)


def without_saturated(readings: Readings, array: SensorArray) -> Readings:
    """The readings without those that are no measurements because their channel saturates.

    Parameters
    ----------
    readings : Readings
    array : SensorArray
        With ``saturation_T`` of the sensors that have a limit.

    Returns
    -------
    Readings
        NaN where the modulus of a reading reaches the limit of its sensor: of a vector sensor only the axis that does.

    Raises
    ------
    ValueError
        The readings do not have the array's channels.
    """
    _check_channels(readings, array)
    # A limit and a reading that are written alike in two files may differ by their rounding.
    saturated = np.abs(readings.values_T) >= array.channel_saturation_T * (1.0 - _SATURATION_RTOL)
    return replace(readings, values_T=np.where(saturated, np.nan, readings.values_T))


def _check_channels(readings: Readings, array: SensorArray) -> None:
    if readings.values_T.shape[1] != array.n_channels:
        raise ValueError(
            f"Input readings must have the {array.n_channels} channels of the array; "
            f"instead received {readings.values_T.shape[1]}."
        )


def _check_sensor_columns(table: Table, array: SensorArray, channels: Sequence[str], *, ignore_others: bool) -> None:
    known = ("time_s", *channels, *POSITION_COLUMNS, *ROTATION_COLUMNS, *AMBIENT_COLUMNS)
    called = f"array {array.name!r}" if array.name else "the array"
    table.require("time_s", known)
    for sensor in array.sensors:
        for name in _columns_of_other_kind(sensor):
            if name in table.header and name not in known:
                own = ", ".join(f"{channel}_nT" for channel in sensor.channel_names)
                raise InputError(
                    f"{table.header_place(name)}: found a column of another kind of sensor, expected {own} "
                    f"because sensor {sensor.id} of {called} is a {sensor.kind} sensor."
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
            "<sensor>_x_nT and so on, and optionally array_x_m and so on (pose) or ambient_x_nT and so on."
        )


def _columns_of_other_kind(sensor: Sensor) -> list[str]:
    """Columns that a sensor would have if it were of the other kind."""
    return [f"{sensor.id}_nT"] if sensor.kind == "vector" else [f"{sensor.id}_{axis}_nT" for axis in "xyz"]


def _listed(ids: Sequence[str], most: int = 6) -> str:
    return ", ".join(ids) if len(ids) <= most else f"{', '.join(ids[: most - 1])} … {ids[-1]}"


def _unit_quaternions(table: Table) -> FloatArray:
    quaternion = table.complete(ROTATION_COLUMNS)
    norm = np.linalg.norm(quaternion, axis=1)
    wrong = np.abs(norm - 1.0) > _UNIT_QUATERNION_ATOL
    if wrong.any():
        row = int(wrong.argmax())
        raise InputError(
            f"{table.path}, line {table.line_numbers[row]}, columns array_qx to array_qw: "
            f"found a quaternion of norm {norm[row]:.6g}, expected norm 1."
        )
    unit: FloatArray = quaternion / norm[:, None]
    return unit


def saturated_channels(measured: Readings, rows: Readings, array: SensorArray) -> list[tuple[str, ...]]:
    """Names of the channels that saturate, for every row."""
    lost = np.isfinite(measured.values_T) & ~np.isfinite(rows.values_T)
    return [tuple(array.channel_names[channel] for channel in np.flatnonzero(row)) for row in lost]


# Of the truth's usual interval: over a longer one it is not interpolated.
_LONGEST_STEP = 2.0


def truth_of_rows(readings: Readings, truth: Truth, path: Path) -> tuple[FloatArray, FloatArray | None]:
    """True position, and moment if it is known, of every row (n, 3); NaN where the truth says nothing of that time.

    Between two rows of the truth, as the mean time of a window may be, it is interpolated, but not over a gap.
    """
    order = np.argsort(truth.time_s, kind="stable")
    times, wanted = truth.time_s[order], readings.time_s
    after = np.clip(np.searchsorted(times, wanted - SAME_TIME_S), 0, len(times) - 1)
    exact = np.abs(times[after] - wanted) <= SAME_TIME_S
    before = np.where(exact, after, np.maximum(after - 1, 0))
    length = times[after] - times[before]
    longest = _LONGEST_STEP * float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    known = exact | ((times[before] <= wanted) & (wanted <= times[after]) & (length <= longest))
    if not known.any():
        raise InputError(f"{path}: found none of the times of the readings, expected rows with the same time_s.")
    share = np.divide(wanted - times[before], length, out=np.zeros_like(wanted), where=length > 0.0)[:, None]

    def of_rows(values: FloatArray) -> FloatArray:
        values = values[order]
        between = values[before] + share * (values[after] - values[before])
        return np.asarray(np.where(known[:, None], between, np.nan))

    return of_rows(truth.position_m), None if truth.moment_Am2 is None else of_rows(truth.moment_Am2)
