"""True positions and moments of a source: truth files, and their values at the rows of readings.

A truth file is CSV with ``time_s, x_m, y_m[, z_m][, mx_Am2, my_Am2, mz_Am2][, sigma_m]``, one row per instant. For a
moment of unknown strength ``axis_x, axis_y, axis_z`` stand instead of the moment. Of a body the file has the attitude
``qx, qy, qz, qw`` (scalar last, from the body's frame), and optionally its error ``sigma_deg``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import chain
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np

from arrays.io.csv import Column, Table, read_table
from arrays.io.errors import InputError
from arrays.io.results import Quantity
from arrays.typing import FloatArray, IntArray
from magloc.navigation.poses import unit_rotation
from magloc.readings import Readings

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

TRUE_POSITION_COLUMNS = ("x_m", "y_m", "z_m")
TRUE_MOMENT_COLUMNS = ("mx_Am2", "my_Am2", "mz_Am2")
TRUE_AXIS_COLUMNS = ("axis_x", "axis_y", "axis_z")
TRUE_ROTATION_COLUMNS = ("qx", "qy", "qz", "qw")
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
# Fewest rows that tell a wrong frame from errors; largest share of the error that a cause may leave; least error over
# the extent of the path that needs a cause; largest lag of a clock over the duration; share of rows that are fitted.
_FEWEST, _EXPLAINED, _LARGE, _LONGEST_LAG, _TRIMMED = 12, 0.2, 0.05, 0.5, 0.8
_LENGTHS = {1e3: "millimetres", 1e2: "centimetres", 1e-3: "kilometres", 1.0 / 0.3048: "feet"}


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
    rotation : Rotation of n, optional
        Attitude of a body: rotation from its frame.
    sigma_rad : ndarray, shape (n,), optional
        Standard deviation of the truth's own attitude, about each axis [rad]; exact without it.

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
    rotation: Rotation | None = None
    sigma_rad: FloatArray | None = None


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
    groups = (TRUE_POSITION_COLUMNS, TRUE_MOMENT_COLUMNS, TRUE_AXIS_COLUMNS, TRUE_ROTATION_COLUMNS)
    known = ("time_s", *chain(*groups), "sigma_m", "sigma_deg")
    for name in ("time_s", "x_m", "y_m"):
        table.require(name, known)
    table.refuse_unknown(known)
    time_s = table.times()
    position_m = np.full((len(time_s), 3), np.nan)
    columns = TRUE_POSITION_COLUMNS if "z_m" in table.header else TRUE_POSITION_COLUMNS[:2]
    position_m[:, : len(columns)] = table.complete(columns)
    moment_Am2 = table.complete(TRUE_MOMENT_COLUMNS) if table.has_group(TRUE_MOMENT_COLUMNS) else None
    axis, sigma_deg = _axes(table, moment_Am2 is not None), _sigmas(table, "sigma_deg")
    return Truth(
        time_s,
        position_m,
        moment_Am2,
        str(path),
        axis,
        _sigmas(table, "sigma_m"),
        unit_rotation(table, TRUE_ROTATION_COLUMNS) if table.has_group(TRUE_ROTATION_COLUMNS) else None,
        None if sigma_deg is None else np.radians(sigma_deg),
    )


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


def _sigmas(table: Table, name: str) -> FloatArray | None:
    if name not in table.header:
        return None
    sigma = table.complete((name,))[:, 0]
    table.refuse((sigma < 0.0)[:, None], (name,), "found a negative number, expected a standard deviation")
    return sigma


def rows_of_same_time(readings: Readings, truth: Truth) -> tuple[IntArray, IntArray]:
    """Return rows (k,) of readings and of a truth with the same time to a microsecond, in the order of the readings."""
    order = np.argsort(truth.time_s, kind="stable")
    times = truth.time_s[order]
    nearest = nearest_rows(readings.time_s, times)
    same = np.abs(times[nearest] - readings.time_s) <= SAME_TIME_S
    return np.flatnonzero(same), order[nearest[same]]


def nearest_rows(wanted_s: FloatArray, time_s: FloatArray) -> IntArray:
    """Return the row (k,) of the ascending times (n,) nearest to each wanted time; of equally near ones the earlier."""
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
        raise InputError(
            f"{truth.name}: found none of the times of the readings: {times[0]:.15g} s to {times[-1]:.15g} s, expected "
            f"rows within {wanted.min():.15g} s to {wanted.max():.15g} s, by the same clock."
        )
    share = np.divide(wanted - times[before], length, out=np.zeros_like(wanted), where=length > 0.0)

    def of_rows(values: FloatArray | None) -> Any:
        if values is None:
            return None
        first, last = values[order[before]].T, values[order[after]].T
        return np.where(known, first + share * (last - first), np.nan).T

    position_m, moment_Am2, sigma_m = map(of_rows, (truth.position_m, truth.moment_Am2, truth.sigma_m))
    return Truth(wanted, position_m, moment_Am2, truth.name, sigma_m=sigma_m)


def cause_of_disagreement(truth: Truth, time_s: FloatArray, position_m: FloatArray) -> str:
    """Return a sentence on the clock or the frame of a truth that does not fit the positions (n, 3) found; else "".

    The error must be a twentieth of the path's extent, and one cause must explain four fifths of it.
    """
    order = np.argsort(truth.time_s, kind="stable")
    times, path = truth.time_s[order], truth.position_m[order]
    known = np.isfinite(position_m).all(axis=1) & (time_s >= times[0]) & (time_s <= times[-1])
    found, wanted = position_m[known], time_s[known]
    if len(found) < _FEWEST or not np.isfinite(path).all():
        return ""

    def of_times(at_s: FloatArray) -> FloatArray:
        return np.stack([np.interp(at_s, times, axis) for axis in path.T], axis=1)

    true = of_times(wanted)
    plain = float(np.median(np.linalg.norm(found - true, axis=1)))
    extent = float(np.linalg.norm(np.std(true, axis=0)))
    if plain < _LARGE * extent:
        return ""
    causes = [_by_length(found, true), _by_clock(found, wanted, times, of_times), *_by_frame(found, true)]
    left = min(error for error, _ in causes)
    if left > _EXPLAINED * plain:
        return ""
    # Of causes that explain nearly as much the first, which is the simplest.
    error, cause = next(each for each in causes if each[0] <= 1.5 * left)
    return (
        f"{truth.name}: found positions {plain:.3g} m from the results in the median, {error:.3g} m after {cause}; "
        "expected the frame and the clock of the readings."
    )


def _by_length(found: FloatArray, true: FloatArray) -> tuple[float, str]:
    """Return the error that remains with the best unit of length, and its sentence."""
    errors = {factor: float(np.median(np.linalg.norm(found - true / factor, axis=1))) for factor in _LENGTHS}
    factor = min(errors, key=lambda each: errors[each])
    return errors[factor], f"they are taken for {_LENGTHS[factor]}: state them in metres"


def _by_clock(
    found: FloatArray, wanted_s: FloatArray, times_s: FloatArray, path: Callable[[FloatArray], FloatArray]
) -> tuple[float, str]:
    """Return the error that remains with the best lag of the clock, and its sentence."""
    longest = _LONGEST_LAG * (times_s[-1] - times_s[0])

    def error(lag_s: float) -> float:
        at_s = wanted_s + lag_s
        inside = (at_s >= times_s[0]) & (at_s <= times_s[-1])
        return float(np.median(np.linalg.norm(found - path(at_s), axis=1)[inside])) if inside.any() else np.inf

    lags = np.linspace(-longest, longest, 401)
    best = lags[int(np.argmin([error(lag) for lag in lags]))]
    fine = best + np.linspace(-1.0, 1.0, 101) * (lags[1] - lags[0])
    lag_s = float(fine[int(np.argmin([error(lag) for lag in fine]))])
    return error(lag_s), f"{lag_s:.3g} s is subtracted from its time_s: its clock is another"


def _by_frame(found: FloatArray, true: FloatArray) -> Iterator[tuple[float, str]]:
    """Yield the errors that remain with a shift, a turn and a mirror image, each with its sentence."""
    shift = np.median(found - true, axis=0)
    moved = float(np.median(np.linalg.norm(found - true - shift, axis=1)))
    yield moved, f"they are shifted by ({shift[0]:.3g}, {shift[1]:.3g}, {shift[2]:.3g}) m: its origin is another"
    for handed, what in (
        (1.0, "turned by"),
        (-1.0, "mirrored (an axis has the wrong sign, or two are exchanged) and turned by"),
    ):
        kept = np.ones(len(found), dtype=bool)
        for _ in range(4):
            a, b = found[kept].mean(axis=0), true[kept].mean(axis=0)
            U, _, Vt = np.linalg.svd((found[kept] - a).T @ (true[kept] - b))
            R = U @ np.diag([1.0, 1.0, handed * np.linalg.det(U @ Vt)]) @ Vt
            left = np.linalg.norm(found - a - (true - b) @ R.T, axis=1)
            kept = left <= np.quantile(left, _TRIMMED)
        angle_deg = float(np.degrees(np.arccos(np.clip(0.5 * (np.trace(handed * R) - 1.0), -1.0, 1.0))))
        yield float(np.median(left)), f"they are {what} {angle_deg:.0f}° and shifted: its frame is another"


def state_columns(position_m: FloatArray, moment_Am2: FloatArray, covariance: FloatArray) -> dict[str, Column]:
    """Return columns of positions, moments (n, 3) and their standard deviations."""
    sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    state = np.concatenate([position_m, moment_Am2], axis=1)
    columns: dict[str, Column] = dict(zip(STATE_COLUMNS, state.T, strict=True))
    return columns | dict(zip((f"s_{name}" for name in STATE_COLUMNS), sigma.T, strict=True))
