"""Logs of an inertial unit with or without a magnetometer: CSV files, MAT files of BROAD, logs of autopilots.

A CSV file without a layout has the columns ``time_s``, ``gyro_x_rad_s`` or ``gyro_x_deg_s``, ``acceleration_x_m_s2``
and, with a magnetometer, ``field_x_nT``, each also for y and z. Optional columns are the truth ``qw, qx, qy, qz``
(east, north, up from body) and ``moving``, which is 1 where errors count. An empty cell is a missing reading. Sensors
may have different rates, and steps may vary.
"""

from __future__ import annotations

from dataclasses import dataclass
from io import BytesIO
from os import PathLike
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from adcs.complementary.inertial_magnetic import InertialMagneticRecord
from adcs.io.log_layout import (
    ACCELERATION_UNITS,
    TIME_FORMATS,
    GyroColumns,
    LogLayout,
    MagnetometerColumns,
    MountedTable,
    StarColumns,
    Three,
)
from adcs.io.robot_logs import robot_record
from adcs.io.telemetry_files import TIME, columns_of, named_table
from adcs.satellite.vector_record import GYRO_SAMPLES, GyroSamples
from arrays.io.csv import table_of_text
from arrays.io.errors import LARGEST, InputError, naming
from arrays.io.text import read_bytes, read_text
from arrays.io.toml import File, Table, one_of, read_toml, section_of
from arrays.typing import BoolArray, FloatArray
from magloc.logs.read import log_reader, read_log

MOVING = "moving"
_BROAD = {"imu_gyr": 3, "imu_acc": 3, "imu_mag": 3, "opt_quat": 4, "opt_pos": 3, "movement": 1}


class AccelerometerColumns(MountedTable, kw_only=True):
    """Columns of the accelerometer; ``at_rest`` is the direction of its reading at rest."""

    columns: Three = ("acceleration_x_m_s2", "acceleration_y_m_s2", "acceleration_z_m_s2")
    unit: Annotated[str, one_of(ACCELERATION_UNITS)] = "m/s2"
    at_rest: Annotated[str, one_of(("up", "down"))] = "up"

    def of(self, values: FloatArray) -> FloatArray:
        """Return accelerations of cells (n, 3), body axes, upwards at rest [m/s²]."""
        return super().of(values if self.at_rest == "up" else -values)


class SampledGyroColumns(GyroColumns, kw_only=True):
    """Columns of the gyro, and the kind of its samples."""

    samples: Annotated[str, one_of(GYRO_SAMPLES)] = "mean"


class TruthColumns(StarColumns, kw_only=True):
    """Columns of the true quaternions; ``inertial`` means east, north, up."""

    columns: tuple[str, str, str, str] = ("qw", "qx", "qy", "qz")


class ImuTable(Table, kw_only=True):
    """Table of the columns that are read, with their units; other columns are ignored."""

    gyro: SampledGyroColumns
    accelerometer: AccelerometerColumns
    magnetometer: MagnetometerColumns | None = None
    time: str = TIME
    time_format: Annotated[str, one_of(TIME_FORMATS)] = "seconds"
    truth: TruthColumns | None = None
    moving: str | None = None


class ImuFile(File, kw_only=True):
    """Layout file."""

    log: ImuTable


@dataclass(frozen=True, eq=False)
class ImuLog:
    """Readings of an inertial unit, and the truth if it is known.

    Attributes
    ----------
    record : InertialMagneticRecord
        Times and readings, SI, body axes.
    q_true : ndarray, shape (n, 4), optional
        True attitude, east, north, up from body, scalar first, NaN where unknown.
    moving : ndarray of bool, shape (n,)
        Rows in which errors count; all rows unless the file states them.
    position_m : ndarray, shape (n, 3), optional
        True position, east, north, up, NaN where unknown.
    q_autopilot : ndarray, shape (n, 4), optional
        Attitude that the autopilot itself estimated, as `q_true`.
    magnetometer_lag_s : tuple of 2 floats, optional
        Lag of the magnetometer behind the gyro and its standard deviation, of the log of an autopilot.

    Examples
    --------
    >>> import adcs
    >>> log = adcs.read_imu(adcs.datasets.load("imu").path)
    >>> log.record.field_T.shape, log.q_true is None
    ((1500, 3), True)
    """

    record: InertialMagneticRecord
    q_true: FloatArray | None
    moving: BoolArray
    position_m: FloatArray | None = None
    q_autopilot: FloatArray | None = None
    magnetometer_lag_s: tuple[float, float] | None = None


def read_imu(path: str | PathLike[str], layout: str | PathLike[str] | None = None) -> ImuLog:
    """Read a log of gyro and accelerometer, with or without a magnetometer.

    Parameters
    ----------
    path : str or path-like
        CSV file, MAT file of the BROAD benchmark, or log of PX4 (.ulg), ArduPilot (.BIN) or ROS.
    layout : str or path-like, optional
        TOML file whose table ``log`` names columns, units and mountings of a CSV file; see the file formats. Without a
        table of the magnetometer its columns are ignored.

    Returns
    -------
    ImuLog
        Readings in SI and body axes, with the truth if the file has one.

    Raises
    ------
    InputError
        A file cannot be read, a column is missing, the times do not ascend, or a sensor has no reading at the start.

    Examples
    --------
    >>> import adcs
    >>> log = adcs.read_imu(adcs.datasets.load("imu").path)
    >>> len(log.record)
    1500
    """
    has_columns = not _is_matlab(path) and log_reader(path) is None
    described = None if layout is None or not has_columns else read_toml(layout, "a layout of a log")
    return imu_log(path, None if layout is None else (str(layout), described or {}))


def _is_matlab(path: str | PathLike[str]) -> bool:
    return Path(path).suffix.lower() == ".mat"


def imu_log(path: str | PathLike[str], layout: tuple[str, dict[str, Any]] | None) -> ImuLog:
    """Return the log of :func:`read_imu`; ``layout`` is the path and the table of a layout that is already read."""
    is_binary = log_reader(path) is not None
    if not _is_matlab(path) and not is_binary:
        named = None if layout is None else section_of(*layout, ImuFile).log
        return csv_log(read_text(path, "a CSV file"), str(path), named)
    if layout is not None:
        kind = "the log of an autopilot" if is_binary else "a MAT file"
        raise InputError(f"{path}: found {kind} with a layout, expected a CSV file, or none.")
    return _autopilot_log(path) if is_binary else _broad_log(path)


def _autopilot_log(path: str | PathLike[str]) -> ImuLog:
    found = robot_record(read_log(path))
    every = np.ones(len(found.record), np.bool_)
    return ImuLog(found.record, None, every, None, found.own_attitude, found.lag_s)


def csv_log(text: str, name: str, named: ImuTable | None) -> ImuLog:
    """Return the log of a CSV file's text, by a layout or with the standard columns; `name` is for errors."""
    expected = "a header with a time, and columns of gyro, accelerometer and magnetometer"
    if named is None:
        table = table_of_text(text, name, expected)
        given = standard_table(table.header)
        try:
            for group in layout_of_table(given).columns.values():
                for column in group.columns:
                    table.require(column, group.columns)
        except InputError as error:
            raise InputError(f"{str(error).removesuffix('.')}; a layout (--config) names other columns.") from None
    else:
        given = named
        more = () if given.moving is None else (given.moving,)
        table = named_table(text, name, expected, layout_of_table(given), more)
    time_s, values = columns_of(table, layout_of_table(given))
    truth = values.pop("truth", None)
    values.setdefault("field_T", np.full((len(time_s), 3), np.nan))
    samples: GyroSamples = given.gyro.samples  # type: ignore[assignment]
    with naming(name):
        record = InertialMagneticRecord(time_s, **values, gyro_samples=samples)
    return ImuLog(
        record,
        None if truth is None else np.roll(truth, 1, axis=1),
        np.ones(len(record), np.bool_) if given.moving is None else table.complete([given.moving])[:, 0] != 0.0,
    )


def layout_of_table(given: ImuTable) -> LogLayout:
    """Return the columns and conventions of a table."""
    columns: dict[str, Any] = {"rate_rad_s": given.gyro, "acceleration_m_s2": given.accelerometer}
    columns |= {"field_T": given.magnetometer} if given.magnetometer is not None else {}
    columns |= {"truth": given.truth} if given.truth is not None else {}
    return LogLayout(np.datetime64(0, "us"), given.time, given.time_format, columns)


def standard_table(header: tuple[str, ...]) -> ImuTable:
    """Return the standard table for a header."""
    per_rad = SampledGyroColumns(columns=("gyro_x_rad_s", "gyro_y_rad_s", "gyro_z_rad_s"), unit="rad/s")
    truth = TruthColumns()
    # A column with a similar name is a misspelt one of the magnetometer, which must be reported.
    magnetic = any("field" in name.lower() or "mag" in name.lower() for name in header)
    return ImuTable(
        gyro=per_rad if per_rad.columns[0] in header else SampledGyroColumns(),
        accelerometer=AccelerometerColumns(),
        magnetometer=MagnetometerColumns() if magnetic else None,
        truth=truth if set(truth.columns) <= set(header) else None,
        moving=MOVING if MOVING in header else None,
    )


def _broad_log(path: str | PathLike[str]) -> ImuLog:
    from scipy.io import loadmat

    data = read_bytes(path, "a MAT file of the BROAD benchmark")
    try:
        content = loadmat(BytesIO(data))  # type: ignore[arg-type]  # its stubs accept paths only
    except Exception:  # SciPy raises many kinds of errors for other files
        raise InputError(
            f"{path}: found no MAT file that can be read, expected a trial of BROAD, version 7 at most."
        ) from None
    if absent := [name for name in (*_BROAD, "sampling_rate") if name not in content]:
        raise InputError(f"{path}: found no variable {absent[0]}, expected those of a trial of the BROAD benchmark.")
    try:
        n = len(content["imu_gyr"])
        values = {name: np.asarray(content[name], np.float64).reshape(n, k) for name, k in _BROAD.items()}
        rate_Hz = float(content["sampling_rate"].item())
    except (AttributeError, TypeError, ValueError):
        raise InputError(f"{path}: found variables of other shapes, expected those of a trial of BROAD.") from None
    if not 0.0 < rate_Hz <= LARGEST:
        raise InputError(f"{path}: found the sampling rate {rate_Hz:g}, expected a positive number.")
    with naming(str(path)):
        readings = values["imu_gyr"], values["imu_acc"], 1e-6 * values["imu_mag"]
        record = InertialMagneticRecord(np.arange(n) / rate_Hz, *readings)
    return ImuLog(record, values["opt_quat"], values["movement"][:, 0] != 0.0, values["opt_pos"])
