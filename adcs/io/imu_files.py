"""Logs of an inertial unit, with a magnetometer or without: CSV files, and MAT files of the BROAD benchmark.

Columns of a CSV file without a layout: ``time_s``, ``gyro_x_rad_s`` or ``gyro_x_deg_s``, ``acceleration_x_m_s2`` and,
of a unit with a magnetometer, ``field_x_nT``, with y and z, and if known the truth ``qw, qx, qy, qz`` (east, north, up
from body) and ``moving``, 1 where errors count. An empty cell is a missing reading: sensors may have rates of their
own, and steps may jitter.
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
from adcs.io.telemetry_files import TIME, columns_of, read_named
from adcs.satellite.vector_record import GYRO_SAMPLES, GyroSamples
from arrays.io.csv import read_table
from arrays.io.errors import LARGEST, InputError, naming
from arrays.io.text import read_bytes
from arrays.io.toml import File, Table, one_of, read_toml, section_of
from arrays.typing import BoolArray, FloatArray

MOVING = "moving"
_BROAD = {"imu_gyr": 3, "imu_acc": 3, "imu_mag": 3, "opt_quat": 4, "opt_pos": 3, "movement": 1}


class AccelerometerColumns(MountedTable, kw_only=True):
    """Accelerations; ``at_rest`` says which way it reads then."""

    columns: Three = ("acceleration_x_m_s2", "acceleration_y_m_s2", "acceleration_z_m_s2")
    unit: Annotated[str, one_of(ACCELERATION_UNITS)] = "m/s2"
    at_rest: Annotated[str, one_of(("up", "down"))] = "up"

    def of(self, values: FloatArray) -> FloatArray:
        """[m/s²], body axes, upwards at rest, of cells (n, 3)."""
        return super().of(values if self.at_rest == "up" else -values)


class SampledGyroColumns(GyroColumns, kw_only=True):
    """Rates, and what a sample is."""

    samples: Annotated[str, one_of(GYRO_SAMPLES)] = "mean"


class TruthColumns(StarColumns, kw_only=True):
    """Quaternions, ``inertial`` for east, north, up."""

    columns: tuple[str, str, str, str] = ("qw", "qx", "qy", "qz")


class ImuTable(Table, kw_only=True):
    """Which columns are read, and as what; the others are not looked at."""

    gyro: SampledGyroColumns
    accelerometer: AccelerometerColumns
    magnetometer: MagnetometerColumns | None = None
    time: str = TIME
    time_format: Annotated[str, one_of(TIME_FORMATS)] = "seconds"
    truth: TruthColumns | None = None
    moving: str | None = None


class ImuFile(File, kw_only=True):
    """The whole file of a layout."""

    log: ImuTable


@dataclass(frozen=True, eq=False)
class ImuLog:
    """Readings of an inertial unit with a magnetometer, and what is known of the truth.

    Attributes
    ----------
    record : InertialMagneticRecord
        Times and readings, SI, body axes.
    q_true : ndarray, shape (n, 4), optional
        East, north, up from body, scalar first, NaN where unknown.
    moving : ndarray of bool, shape (n,)
        Where errors count: everywhere, unless the file says it.
    position_m : ndarray, shape (n, 3), optional
        East, north, up, NaN where unknown.

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


def read_imu(path: str | PathLike[str], layout: str | PathLike[str] | None = None) -> ImuLog:
    """Read a log of gyro and accelerometer, with a magnetometer or without.

    Parameters
    ----------
    path : str or path-like
        A CSV file, or a MAT file of the BROAD benchmark.
    layout : str or path-like, optional
        A TOML file whose table ``log`` names columns, units and mountings of a CSV file; see the file formats.
        Without a table of the magnetometer its columns are not read.

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
    described = None if layout is None or _is_matlab(path) else read_toml(layout, "a layout of a log")
    return imu_log(path, None if layout is None else (str(layout), described or {}))


def _is_matlab(path: str | PathLike[str]) -> bool:
    return Path(path).suffix.lower() == ".mat"


def imu_log(path: str | PathLike[str], layout: tuple[str, dict[str, Any]] | None) -> ImuLog:
    """Return the log of :func:`read_imu` with the path and the table of a layout that was read before."""
    if not _is_matlab(path):
        return _csv_log(path, None if layout is None else section_of(*layout, ImuFile).log)
    if layout is not None:
        raise InputError(f"{path}: found a MAT file with a layout, expected a CSV file, or none.")
    return _broad_log(path)


def _csv_log(path: str | PathLike[str], named: ImuTable | None) -> ImuLog:
    expected = "a header with a time, and columns of gyro, accelerometer and magnetometer"
    if named is None:
        table = read_table(path, expected)
        given = _standard(table.header)
        for group in _layout(given).columns.values():
            for name in group.columns:
                table.require(name, group.columns)
    else:
        given = named
        more = () if given.moving is None else (given.moving,)
        table = read_named(path, expected, _layout(given), more)
    time_s, values = columns_of(table, _layout(given))
    truth = values.pop("truth", None)
    values.setdefault("field_T", np.full((len(time_s), 3), np.nan))
    samples: GyroSamples = given.gyro.samples  # type: ignore[assignment]
    with naming(str(path)):
        record = InertialMagneticRecord(time_s, **values, gyro_samples=samples)
    return ImuLog(
        record,
        None if truth is None else np.roll(truth, 1, axis=1),
        np.ones(len(record), np.bool_) if given.moving is None else table.complete([given.moving])[:, 0] != 0.0,
    )


def _layout(given: ImuTable) -> LogLayout:
    columns: dict[str, Any] = {"rate_rad_s": given.gyro, "acceleration_m_s2": given.accelerometer}
    columns |= {"field_T": given.magnetometer} if given.magnetometer is not None else {}
    columns |= {"truth": given.truth} if given.truth is not None else {}
    return LogLayout(np.datetime64(0, "us"), given.time, given.time_format, columns)


def _standard(header: tuple[str, ...]) -> ImuTable:
    """Layout of a file without one, by its header."""
    per_rad = SampledGyroColumns(columns=("gyro_x_rad_s", "gyro_y_rad_s", "gyro_z_rad_s"), unit="rad/s")
    truth = TruthColumns()
    # A column of a similar name is a magnetometer's that is misspelt; without one there is no magnetometer.
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
        content = loadmat(BytesIO(data))  # type: ignore[arg-type]  # its stubs know paths alone
    except Exception:  # whatever SciPy makes of a file that is none
        raise InputError(
            f"{path}: found no MAT file that can be read, expected a trial of BROAD, of version 7 at most."
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
