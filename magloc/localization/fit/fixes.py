"""Fixes of many rows, stored as columns."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, Literal, TypeVar, overload

import numpy as np

from arrays.array import SensorArray
from arrays.io.csv import Column
from arrays.io.results import Result
from arrays.typing import BoolArray, FloatArray, IntArray
from magloc.chi_square import error_factor
from magloc.localization.fit.columns import Solutions
from magloc.localization.fit.export import QUANTITIES, columns_of_fixes, dataset_of_fixes, geojson_of_fixes
from magloc.localization.fit.results import EVERYWHERE, Fix, Intervals, intervals_of, is_misfit
from magloc.localization.fit.table import lines_of_fixes

if TYPE_CHECKING:
    import xarray as xr
    from scipy.spatial.transform import Rotation

_Column = TypeVar("_Column")
BODY_MATTERS = 1.5
"""Factor on standard deviations, if a point were a body, above which a fix has a caution."""


@dataclass(frozen=True, eq=False, repr=False)
class Fixes(Result, Sequence[Fix]):
    """Fixes of many rows, stored as columns; indexing returns a :class:`Fix`.

    Attributes
    ----------
    solutions : Solutions
        Solutions of all rows.
    time_s : ndarray, shape (n,)
    frame : {"array", "world"}
        Frame of positions, moments and covariances.
    detected, too_near : ndarray of bool, shape (n,)
    reason : list of str
    dropped_sensors, saturated_channels : list of tuple of str
    failed_starts : ndarray of int, shape (n,)
    body_length_m : ndarray, shape (n,)
        Stated or assumed length of the object [m]; 0 for a point.
    bodies : callable, optional
        Function that computes `body_covariance` when it is needed.

    Examples
    --------
    >>> import magloc
    >>> board = magloc.datasets.load("board")
    >>> fixes = magloc.locate(board.array, board.readings[:5])
    >>> fixes.position_m.shape, fixes.covariance.shape, fixes.frame
    ((5, 3), (5, 6, 6), 'array')
    """

    figure = "magloc.plots.localization:fixes"
    command = "locate"
    quantities = QUANTITIES

    solutions: Solutions
    time_s: FloatArray
    detected: BoolArray
    reason: list[str]
    failed_starts: IntArray
    dropped_sensors: list[tuple[str, ...]]
    saturated_channels: list[tuple[str, ...]] = field(default_factory=list)
    too_near: BoolArray = field(default_factory=lambda: np.zeros(0, dtype=bool))
    frame: Literal["array", "world"] = "array"
    body_length_m: FloatArray = field(default_factory=lambda: np.zeros(0))
    bodies: Callable[[], FloatArray] | None = None

    def __post_init__(self) -> None:
        if not len(self.too_near):
            object.__setattr__(self, "too_near", np.zeros(len(self), dtype=bool))
        if not len(self.body_length_m):
            object.__setattr__(self, "body_length_m", np.zeros(len(self)))
        if not self.saturated_channels:
            object.__setattr__(self, "saturated_channels", [()] * len(self))

    def __len__(self) -> int:
        return len(self.time_s)

    @overload
    def __getitem__(self, row: int) -> Fix: ...
    @overload
    def __getitem__(self, row: slice) -> list[Fix]: ...
    def __getitem__(self, row: int | slice) -> Fix | list[Fix]:
        if isinstance(row, slice):
            return [self[i] for i in range(*row.indices(len(self)))]
        i = range(len(self))[row]
        return Fix(
            tuple(self.solutions.solution(j) for j in self.of_row(i)),
            self.reason[i],
            bool(self.detected[i]),
            self.dropped_sensors[i],
            self.saturated_channels[i],
            bool(self.too_near[i]),
            int(self.failed_starts[i]),
            float(self.time_s[i]),
            float(self.body_length_m[i]),
            (self, i),
        )

    def of_row(self, row: int) -> range:
        """Return the indices in `solutions` of the solutions of a row."""
        return range(int(self._edges[row]), int(self._edges[row + 1]))

    @cached_property
    def _edges(self) -> IntArray:
        """Index of the first solution of every row (n + 1,)."""
        return self.solutions.of_row.searchsorted(np.arange(len(self) + 1))

    @cached_property
    def best(self) -> IntArray:
        """Index (n,) in `solutions` of the solution with the largest weight; -1 for none."""
        result = np.full(len(self), -1, dtype=np.intp)
        order = np.lexsort((-np.arange(len(self.solutions)), self.solutions.weight, self.solutions.of_row))
        result[self.solutions.of_row[order]] = order
        return result

    def _column(self, values: _Column, empty: float) -> _Column:
        """Return values of the best solutions (n, ...), `empty` if there is none."""
        every: Any = values
        if not len(self.solutions):
            every = np.full((1, *every.shape[1:]), empty)
        column: Any = every[self.best]
        column[~self.solved] = empty
        return column

    def _require_one_source(self, values: _Column) -> _Column:
        if (self.solutions.n_sources[self.best[self.solved]] > 1).any():
            raise ValueError("Some rows have several sources: see fixes[row].best.sources, or to_xarray().")
        return values

    @cached_property
    def solved(self) -> BoolArray:
        """Rows with a solution (n,)."""
        return self._edges[1:] > self._edges[:-1]

    @property
    def position_m(self) -> FloatArray:
        """Positions (n, 3) [m] of the best solutions with one source; NaN for none."""
        return self._column(self._require_one_source(self.solutions.position_m[:, 0]), np.nan)

    @property
    def moment_Am2(self) -> FloatArray:
        """Moments (n, 3) [A·m²] of the best solutions with one source; NaN for none."""
        return self._column(self._require_one_source(self.solutions.moment_Am2[:, 0]), np.nan)

    @property
    def covariance(self) -> FloatArray:
        """Covariances (n, 6, 6) of the best solutions with one source.

        The shape is (n, 3, 3), of moments alone, if the position is known.
        """
        return self._column(self._require_one_source(self.solutions.covariance[:, :6, :6]), np.nan)

    @property
    def chi2(self) -> FloatArray:
        """χ² (n,) of the best solutions."""
        return self._column(self.solutions.chi2, np.nan)

    @property
    def dof(self) -> IntArray:
        """Degrees of freedom (n,) of the best solutions."""
        return self._column(self.solutions.dof, 0)

    @property
    def weight(self) -> FloatArray:
        """Weights (n,) of the best solutions."""
        return self._column(self.solutions.weight, np.nan)

    @property
    def range_interval_m(self) -> list[Intervals]:
        """95 % sets of the range [m] of every row with one source."""
        self._require_one_source(None)
        return [intervals_of(self.solutions.ranges[i, 0]) if i >= 0 else EVERYWHERE for i in self.best]

    @property
    def misfit(self) -> BoolArray:
        """Rows whose χ² is far beyond noise (n,)."""
        result = np.zeros(len(self), dtype=bool)
        begin = self._edges[:-1][self.solved]
        every = self.solutions
        chi2, dof = every.chi2 + every.known_chi2, every.dof + every.n_known
        result[self.solved] = is_misfit(chi2[begin], dof[begin])
        return result

    def used_readings(self, array: SensorArray, readings_T: FloatArray) -> FloatArray:
        """Return readings (n, C) with NaN for the sensors that each row excludes."""
        rows = [row for row, names in enumerate(self.dropped_sensors) if names]
        if not rows:
            return readings_T
        used = readings_T.copy()
        for row in rows:
            used[row, np.isin(array.ids, self.dropped_sensors[row])[array.channel_sensor]] = np.nan
        return used

    @cached_property
    def body_covariance(self) -> FloatArray:
        """Covariance (n, D, D) that an object as long as a quarter of its distance would add to the best solution.

        It is zero if the object is stated to be a point, or if its signal is weak. The shape is (0, D, D) if this holds
        for all rows.
        """
        return np.zeros((0, 6, 6)) if self.bodies is None else self.bodies()

    @cached_property
    def body_factor(self) -> FloatArray:
        """Ratio (n,) of the rms error to the stated σ for an extended object with `body_covariance`."""
        factor, added, columns = np.ones(len(self)), self.body_covariance, self.solutions
        matter = np.flatnonzero(added.any(axis=(1, 2)))
        size = columns.covariance.shape[1] // columns.position_m.shape[1]  # unknowns of one source
        n_unknowns = size * columns.n_sources[self.best[matter]]
        for n in np.unique(n_unknowns).tolist():
            rows = matter[n_unknowns == n]
            factor[rows] = error_factor(columns.covariance[self.best[rows], :n, :n], added[rows, :n, :n])
        return factor

    @property
    def caution(self) -> str:
        """Warning of errors that the fixes cannot show; empty if they would not matter."""
        matters = self.body_factor > BODY_MATTERS
        if not matters.any():
            return ""
        middle = float(np.median(self.body_factor[matters]))
        return (
            f"in {matters.sum()} of {len(self)} rows the source counts as a point: for a body as long as a quarter of"
            f" its distance, errors would be about {middle:.2g} times their standard deviations; state its length"
        )

    @classmethod
    def unsolved(cls, time_s: FloatArray, reason: str) -> Fixes:
        """Return fixes of rows without a solution, all for one reason."""
        n = len(time_s)
        nothing = np.zeros(n, dtype=bool)
        return cls(Solutions.none(), time_s, nothing, [reason] * n, np.zeros(n, dtype=np.intp), [()] * n)

    @classmethod
    def joined(cls, parts: Sequence[Fixes]) -> Fixes:
        """Concatenate fixes, row after row."""
        if len(parts) == 1:
            return parts[0]
        begins = np.cumsum([0, *map(len, parts)])
        solutions = [
            part.solutions.of_rows(begin + part.solutions.of_row) for begin, part in zip(begins, parts, strict=False)
        ]
        return cls(
            Solutions.concatenate(solutions),
            np.concatenate([np.zeros(0), *(part.time_s for part in parts)]),
            np.concatenate([np.zeros(0, dtype=bool), *(part.detected for part in parts)]),
            [reason for part in parts for reason in part.reason],
            np.concatenate([np.zeros(0, dtype=np.intp), *(part.failed_starts for part in parts)]),
            [names for part in parts for names in part.dropped_sensors],
            body_length_m=np.concatenate([np.zeros(0), *(part.body_length_m for part in parts)]),
        )

    def moved(
        self,
        position_m: FloatArray,
        rotation: Rotation,
        *,
        frame: Literal["array", "world"],
        added_covariance: FloatArray | float = 0.0,
    ) -> Fixes:
        """Return the fixes in another frame, by the pose (n, 3) of every row."""
        row, columns = self.solutions.of_row, self.solutions
        R = rotation.as_matrix()[row]
        moved = replace(
            columns,
            position_m=position_m[row][:, None] + np.einsum("fab,fkb->fka", R, columns.position_m),
            moment_Am2=np.einsum("fab,fkb->fka", R, columns.moment_Am2),
            covariance=_rotate_covariances(columns.covariance, R) + added_covariance,
        )
        bodies = None if self.bodies is None else partial(_rotate_body_covariances, self, rotation)
        return replace(self, solutions=moved, frame=frame, bodies=bodies)

    @property
    def first(self) -> IntArray:
        """Index (n,) in `solutions` of the smallest χ² of every row that has a solution."""
        return self._edges[:-1]

    def replaced(self, rows: IntArray, fixes: Sequence[Fix]) -> Fixes:
        """Return the fixes with some rows replaced."""
        kept = self.solutions.select(~np.isin(self.solutions.of_row, rows))
        come = Solutions.of(
            [(int(row), solution) for row, fix in zip(rows, fixes, strict=True) for solution in fix.solutions]
        )
        columns: dict[str, Any] = {}
        for name in ("detected", "failed_starts", "reason", "dropped_sensors", "body_length_m"):
            columns[name] = getattr(self, name).copy()
            for row, fix in zip(rows, fixes, strict=True):
                columns[name][row] = getattr(fix, name)
        return replace(self, solutions=Solutions.concatenate([kept, come]), **columns)

    def lines(self, most: int | None = None) -> list[str]:
        """Return the lines of the table, of at most `most` rows."""
        return lines_of_fixes(self, most=most)

    def columns(self) -> dict[str, Column]:
        """Return the columns of fixes.csv, one row for each source of the best solutions.

        A row without a solution has one line.
        """
        return columns_of_fixes(self)

    def table(self) -> str:
        """Return the table that ``magloc locate`` prints, with its warnings."""
        return "\n".join([super().table(), *filter(None, [self.caution])])

    def to_xarray(self, which: Literal["best", "all"] = "best") -> xr.Dataset:
        """Return a dataset of columns with units along `row`, `source` and, for "all", `solution`.

        Parameters
        ----------
        which : {"best", "all"}
            Solution with the largest weight of every row, or all solutions, padded with NaN.
        """
        return dataset_of_fixes(self, which)

    def to_geojson(self) -> dict[str, Any]:
        """Return the best solutions as a FeatureCollection of points x, y, z [m].

        They are in the frame of the fixes.
        """
        return geojson_of_fixes(self)


def _rotate_covariances(covariance: FloatArray, R: FloatArray) -> FloatArray:
    """Rotate covariances (f, 3 n, 3 n) of 3-vectors by rotations (f, 3, 3)."""
    n = covariance.shape[1] // 3
    turned = np.einsum("fab,fibjc,fdc->fiajd", R, covariance.reshape(-1, n, 3, n, 3), R, optimize=True)
    return np.asarray(turned.reshape(covariance.shape))


def _rotate_body_covariances(fixes: Fixes, rotation: Rotation) -> FloatArray:
    """Return `body_covariance` of fixes, rotated in every row."""
    of_rows = fixes.body_covariance
    return _rotate_covariances(of_rows, rotation.as_matrix()) if len(of_rows) else of_rows
