"""True positions and moments of a source: truth files, and their values at the rows of readings.

A truth file is CSV with ``time_s, x_m, y_m[, z_m][, mx_Am2, my_Am2, mz_Am2][, sigma_m]``, one row per instant. For a
moment of unknown strength ``axis_x, axis_y, axis_z`` stand in place of the moment.
"""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike
from typing import Any

import numpy as np

from arrays.io.csv import Column, Table, read_table
from arrays.io.errors import InputError
from arrays.io.results import Quantity
from arrays.typing import FloatArray, IntArray
from magloc.readings import Readings

TRUE_POSITION_COLUMNS = ("x_m", "y_m", "z_m")
TRUE_MOMENT_COLUMNS = ("mx_Am2", "my_Am2", "mz_Am2")
TRUE_AXIS_COLUMNS = ("axis_x", "axis_y", "axis_z")
STATE_COLUMNS = TRUE_POSITION_COLUMNS + TRUE_MOMENT_COLUMNS
STATE_QUANTITIES = {
    "time_s": Quantity("s", "time"),
    "position_m": Quantity("m", "position of the source", ("axis",)),
    "moment_Am2": Quantity("A m2", "magnetic moment of the source", ("axis",)),
    "covariance": Quantity("m, A m2", "covariance of (position, moment)", ("component", "component_")),
}
"""Quantities that all results with a source in every row share."""
SAME_TIME_S = 1e-6
# Longest interval of the truth that is interpolated, in usual intervals.
_LONGEST_STEP = 2.0
# Rounding of a unit vector in a file.
_UNIT_WITHIN = 1e-2


@dataclass(frozen=True, eq=False)
class Truth:
    """True positions of the source at n instants, and its moments.

    Attributes
    ----------
    time_s : ndarray, shape (n,)
        Instants [s].
    position_m : ndarray, shape (n, 3)
        Position of the source [m]; z is NaN where the file does not give it.
    moment_Am2 : ndarray, shape (n, 3), optional
        Moment of the source [A·m²].
    name : str
        Name in error messages, usually the file's path.
    axis : ndarray, shape (n, 3), optional
        Direction of a moment of unknown strength, unit vectors.
    sigma_m : ndarray, shape (n,), optional
        Standard deviation of the truth's own position, per axis [m]; exact without it.

    Examples
    --------
    >>> import magloc
    >>> truth = magloc.datasets.load("board").truth
    >>> truth.position_m.shape, truth.moment_Am2.shape
    ((101, 3), (101, 3))
    """

    time_s: FloatArray
    position_m: FloatArray
    moment_Am2: FloatArray | None = None
    name: str = "truth"
    axis: FloatArray | None = None
    sigma_m: FloatArray | None = None


def read_truth(path: str | PathLike[str]) -> Truth:
    """Read true positions, and moments if they are known, from a CSV file.

    Parameters
    ----------
    path : str or path-like
        A truth file (CSV) with ``time_s``, ``x_m``, ``y_m`` and optionally the other columns.

    Returns
    -------
    Truth
        True positions [m] and, if the file has them, moments [A·m²].

    Raises
    ------
    InputError
        The file cannot be read, or is not a truth file.

    Examples
    --------
    >>> import magloc
    >>> board = magloc.datasets.load("board")
    >>> magloc.read_truth(board.path.with_name("board-truth.csv")).position_m.shape
    (101, 3)
    """
    table = read_table(path, "a header with time_s, x_m and y_m")
    known = ("time_s", *TRUE_POSITION_COLUMNS, *TRUE_MOMENT_COLUMNS, *TRUE_AXIS_COLUMNS, "sigma_m")
    for name in ("time_s", "x_m", "y_m"):
        table.require(name, known)
    table.refuse_unknown(known)
    time_s = table.times()
    position_m = np.full((len(time_s), 3), np.nan)
    columns = TRUE_POSITION_COLUMNS if "z_m" in table.header else TRUE_POSITION_COLUMNS[:2]
    position_m[:, : len(columns)] = table.complete(columns)
    moment_Am2 = table.complete(TRUE_MOMENT_COLUMNS) if table.has_group(TRUE_MOMENT_COLUMNS) else None
    return Truth(time_s, position_m, moment_Am2, str(path), _axes(table, moment_Am2 is not None), _sigmas(table))


def _axes(table: Table, moments: bool) -> FloatArray | None:
    """Return the axes of a moment of unknown strength, exactly of unit length."""
    if not table.has_group(TRUE_AXIS_COLUMNS):
        return None
    if moments:
        raise InputError(f"{table.path}: found moments and axes, expected mx_Am2 … mz_Am2 or axis_x … axis_z.")
    axis = table.complete(TRUE_AXIS_COLUMNS)
    length = np.linalg.norm(axis, axis=1)
    bad = np.flatnonzero(np.abs(length - 1.0) > _UNIT_WITHIN)
    if bad.size:
        place = table.place(int(bad[0]), "axis_x")
        raise InputError(f"{place}: found an axis of length {length[bad[0]]:.3g}, expected a unit vector.")
    return axis / length[:, None]


def _sigmas(table: Table) -> FloatArray | None:
    if "sigma_m" not in table.header:
        return None
    sigma_m = table.complete(("sigma_m",))[:, 0]
    table.refuse((sigma_m < 0.0)[:, None], ("sigma_m",), "found a negative number, expected a standard deviation")
    return sigma_m


def rows_of_same_time(readings: Readings, truth: Truth) -> tuple[IntArray, IntArray]:
    """Return rows (k,) of readings and of a truth with the same time to a microsecond, in the order of the readings."""
    order = np.argsort(truth.time_s, kind="stable")
    times = truth.time_s[order]
    nearest = nearest_rows(readings.time_s, times)
    same = np.abs(times[nearest] - readings.time_s) <= SAME_TIME_S
    return np.flatnonzero(same), order[nearest[same]]


def nearest_rows(wanted_s: FloatArray, time_s: FloatArray) -> IntArray:
    """Return the row (k,) of the ascending times (n,) nearest to each wanted time; of two, the earlier."""
    after = np.clip(np.searchsorted(time_s, wanted_s), 1, max(1, len(time_s) - 1))
    before, after = after - 1, np.minimum(after, len(time_s) - 1)
    return np.where(np.abs(wanted_s - time_s[before]) <= np.abs(time_s[after] - wanted_s), before, after)


def truth_of_rows(readings: Readings, truth: Truth) -> Truth:
    """Return the truth at the rows of readings, interpolated but not over gaps; NaN where there is none."""
    order = np.argsort(truth.time_s, kind="stable")
    times, wanted = truth.time_s[order], readings.time_s
    after = np.clip(np.searchsorted(times, wanted - SAME_TIME_S), 0, len(times) - 1)
    exact = np.abs(times[after] - wanted) <= SAME_TIME_S
    before = np.where(exact, after, np.maximum(after - 1, 0))
    length = times[after] - times[before]
    longest = _LONGEST_STEP * float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    known = exact | ((times[before] <= wanted) & (wanted <= times[after]) & (length <= longest))
    if not known.any():
        raise InputError(f"{truth.name}: found none of the times of the readings, expected rows with the same time_s.")
    share = np.divide(wanted - times[before], length, out=np.zeros_like(wanted), where=length > 0.0)

    def of_rows(values: FloatArray | None) -> Any:
        if values is None:
            return None
        first, last = values[order[before]].T, values[order[after]].T
        return np.where(known, first + share * (last - first), np.nan).T

    position_m, moment_Am2, sigma_m = map(of_rows, (truth.position_m, truth.moment_Am2, truth.sigma_m))
    return Truth(wanted, position_m, moment_Am2, truth.name, sigma_m=sigma_m)


def state_columns(position_m: FloatArray, moment_Am2: FloatArray, covariance: FloatArray) -> dict[str, Column]:
    """Return columns of positions, moments (n, 3) and their standard deviations."""
    sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    state = np.concatenate([position_m, moment_Am2], axis=1)
    columns: dict[str, Column] = dict(zip(STATE_COLUMNS, state.T, strict=True))
    return columns | dict(zip((f"s_{name}" for name in STATE_COLUMNS), sigma.T, strict=True))
