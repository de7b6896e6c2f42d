"""Solutions of many rows as columns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from arrays.typing import BoolArray, FloatArray, IntArray
from magloc.localization.fit.results import EVERYWHERE, Intervals, Solution, Source, intervals_of


@dataclass(frozen=True, eq=False)
class Solutions:
    """Solutions of many rows as columns, sorted by row and then by χ².

    Attributes
    ----------
    of_row, n_sources, dof, iterations, n_known : ndarray of int, shape (f,)
    position_m, moment_Am2 : ndarray, shape (f, K, 3)
        Positions and moments; NaN beyond the sources of a solution.
    covariance : ndarray, shape (f, 6 K, 6 K), or (f, 3 K, 3 K) of moments alone
    chi2, weight, known_chi2 : ndarray, shape (f,)
    ranges : ndarray, shape (f, K, i, 2)
        95 % sets of the range of every source, intervals in ascending order [m]; NaN where there are fewer.
    gaussian, merged : ndarray of bool, shape (f, K)
    """

    of_row: IntArray
    n_sources: IntArray
    position_m: FloatArray
    moment_Am2: FloatArray
    covariance: FloatArray
    chi2: FloatArray
    dof: IntArray
    weight: FloatArray
    iterations: IntArray
    ranges: FloatArray
    gaussian: BoolArray
    merged: BoolArray
    known_chi2: FloatArray
    n_known: IntArray

    def __len__(self) -> int:
        return len(self.of_row)

    @classmethod
    def none(cls) -> Solutions:
        """Return an empty set of solutions."""
        one = Solution((Source(np.zeros(3), np.zeros(3), np.eye(6), EVERYWHERE),), np.eye(6), 0.0, 0)
        return cls._from_solution(0, one).select(np.zeros(0, dtype=np.intp))

    @classmethod
    def of(cls, solutions: Sequence[tuple[int, Solution]]) -> Solutions:
        """Return the columns of solutions and their rows."""
        return cls.concatenate([cls._from_solution(row, solution) for row, solution in solutions])

    @classmethod
    def _from_solution(cls, row: int, solution: Solution) -> Solutions:
        sources = solution.sources
        return cls(
            of_row=np.array([row]),
            n_sources=np.array([len(sources)]),
            position_m=np.array([[source.position_m for source in sources]]),
            moment_Am2=np.array([[source.moment_Am2 for source in sources]]),
            covariance=solution.covariance[None],
            chi2=np.array([solution.chi2]),
            dof=np.array([solution.dof]),
            weight=np.array([solution.weight]),
            iterations=np.array([solution.iterations]),
            ranges=_range_sets([source.range_interval_m for source in sources])[None],
            gaussian=np.array([[source.gaussian for source in sources]]),
            merged=np.array([[source.merged for source in sources]]),
            known_chi2=np.array([solution.known_chi2]),
            n_known=np.array([solution.n_known]),
        )

    @classmethod
    def concatenate(cls, parts: Sequence[Solutions]) -> Solutions:
        """Concatenate solutions of different rows, sorted by row."""
        filled = [part for part in parts if len(part)]
        if len(filled) <= 1:
            return filled[0] if filled else cls.none()
        of_row = np.concatenate([part.of_row for part in filled])
        order = None if (of_row[1:] >= of_row[:-1]).all() else np.argsort(of_row, kind="stable")

        def concatenate_column(name: str) -> Any:
            """Concatenate one column, padded to the largest number of sources and intervals."""
            values = [getattr(part, name) for part in filled]
            shape = np.max([value.shape[1:] for value in values], axis=0).astype(int)
            empty = np.nan if values[0].dtype.kind == "f" else 0
            result = np.full((len(of_row), *shape), empty, dtype=values[0].dtype)
            begin = 0
            for value in values:
                result[(slice(begin, begin + len(value)), *map(slice, value.shape[1:]))] = value
                begin += len(value)
            return result if order is None else result[order]

        return cls(**{name: concatenate_column(name) for name in vars(filled[0])})

    def select(self, index: IntArray | BoolArray, of_row: IntArray | None = None) -> Solutions:
        """Return some of the solutions, with other row numbers if given."""
        at = np.arange(len(self))[index]
        chosen = Solutions(**{name: value[at] for name, value in vars(self).items()})
        return chosen if of_row is None else chosen.of_rows(of_row)

    def of_rows(self, of_row: IntArray) -> Solutions:
        """Return the same solutions with other row numbers."""
        return Solutions(**(vars(self) | {"of_row": of_row}))

    @property
    def covariance_of_source(self) -> FloatArray:
        """Marginal covariances (f, K, n, n) of every source."""
        n_sources = self.position_m.shape[1]
        n = self.covariance.shape[1] // n_sources
        blocks = self.covariance.reshape(len(self), n_sources, n, n_sources, n)
        return np.einsum("fkikj->fkij", blocks)

    def solution(self, i: int) -> Solution:
        """Return one solution as an object."""
        n, covariance = int(self.n_sources[i]), self.covariance[i]
        size = len(covariance) // self.position_m.shape[1]
        sources = tuple(
            Source(
                self.position_m[i, k],
                self.moment_Am2[i, k],
                covariance[k * size : (k + 1) * size, k * size : (k + 1) * size],
                intervals_of(self.ranges[i, k]),
                bool(self.gaussian[i, k]),
                bool(self.merged[i, k]),
            )
            for k in range(n)
        )
        return Solution(
            sources,
            covariance[: n * size, : n * size],
            float(self.chi2[i]),
            int(self.dof[i]),
            float(self.weight[i]),
            int(self.iterations[i]),
            float(self.known_chi2[i]),
            int(self.n_known[i]),
        )


def _range_sets(intervals: Sequence[Intervals]) -> FloatArray:
    """Return range sets of several sources as an array (K, i, 2)."""
    sets = np.full((len(intervals), max(1, *map(len, intervals)), 2), np.nan)
    for k, of_source in enumerate(intervals):
        for i, (low, high) in enumerate(of_source):
            sets[k, i] = low, np.inf if high is None else high
    return sets


def in_stable_order(solutions: Solutions) -> Solutions:
    """Return solutions whose sources keep their number from row to row.

    In the first row the strongest source comes first.
    """
    order = np.tile(np.arange(solutions.position_m.shape[1]), (len(solutions), 1))
    before: FloatArray | None = None
    last = -1
    for i, n in enumerate(solutions.n_sources.tolist()):
        position, moment = solutions.position_m[i, :n], solutions.moment_Am2[i, :n]
        if solutions.of_row[i] != last:
            known = before
        order[i, :n] = _order(position, moment, known)
        if solutions.of_row[i] != last:
            last, before = int(solutions.of_row[i]), position[order[i, :n]]
    of_state = (6 * order[:, :, None] + np.arange(6)).reshape(len(order), -1)
    every = np.arange(len(order))[:, None]
    return replace(
        solutions,
        **{
            name: np.take_along_axis(values, order.reshape(*order.shape, *[1] * (values.ndim - 2)), axis=1)
            for name in ("position_m", "moment_Am2", "gaussian", "merged", "ranges")
            for values in (getattr(solutions, name),)
        },
        covariance=solutions.covariance[every[..., None], of_state[:, :, None], of_state[:, None]],
    )


def _order(position: FloatArray, moment: FloatArray, before: FloatArray | None) -> list[int]:
    strongest = np.argsort(-np.linalg.norm(moment, axis=-1), kind="stable").tolist()
    if before is None:
        return strongest
    from scipy.optimize import linear_sum_assignment  # it costs as much as a fix

    known, found = linear_sum_assignment(np.linalg.norm(before[:, None] - position, axis=-1))
    followed = [int(k) for _, k in sorted(zip(known.tolist(), found.tolist(), strict=True))]
    return followed + [k for k in strongest if k not in followed]
