"""CSV file with readings of a satellite's magnetometers and gyro, and the states of its loads."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from adcs.io.telemetry_files import GYRO, TIME
from arrays.array import SensorArray
from arrays.io.csv import read_table
from arrays.io.errors import InputError
from arrays.typing import FloatArray

_OTHER_UNITS = ("_nT", "_deg_s", "_Nms", "_Am2")


@dataclass(frozen=True, eq=False)
class LoadLog:
    """Log of magnetometers, gyro and loads.

    Attributes
    ----------
    columns : dict of str to ndarray, shape (n,)
        Columns as in the file.
    readings_T : ndarray, shape (n, C)
        Readings of the array's channels.
    states : dict of str to ndarray, shape (n,)
        State of each load by its name.
    """

    columns: dict[str, FloatArray]
    readings_T: FloatArray
    states: dict[str, FloatArray]

    @property
    def time_s(self) -> FloatArray:
        """Times of the rows, shape (n,)."""
        return self.columns[TIME]

    @property
    def gyro_rad_s(self) -> FloatArray:
        """Rates of the gyro, shape (n, 3)."""
        return np.radians(np.stack([self.columns[name] for name in GYRO], axis=1))


def channel_columns(array: SensorArray) -> list[str]:
    """Return the names of the columns of an array's readings."""
    return [f"{name}_nT" for name in array.channel_names]


def read_load_log(path: Path, array: SensorArray, loads: list[str]) -> LoadLog:
    """Read a log; without names of ``loads`` each column without a unit is a load."""
    table = read_table(path, f"a header with {TIME}, readings of magnetometers and gyro, and loads")
    channels = channel_columns(array)
    known = [TIME, *GYRO, *channels]
    for name in (*known, *loads):
        table.require(name, known)
    names = loads or [name for name in table.header if name not in known and not name.endswith(_OTHER_UNITS)]
    if not names:
        raise InputError(f"{path}, line {table.header_line}: found no column of a load, expected one, such as heater.")
    times = table.complete([TIME])[:, 0]
    table.refuse_late(TIME, times)
    table.refuse_back(TIME, np.diff(times) <= 0.0, "times that ascend", "{:.15g} s")
    values = table.finite_or_missing(table.header)
    states = table.complete(names)
    return LoadLog(
        dict(zip(table.header, values.T, strict=True)),
        1e-9 * table.finite_or_missing(channels),
        dict(zip(names, states.T, strict=True)),
    )
