"""One fix from one set of readings: where the dipole is, what its moment is, and how well both are known.

No start is needed. The moment is eliminated (:mod:`magloc.separable`), a grid of positions is scored by how much of the
readings' energy they explain, the best distinct ones are refined by a damped Gauss-Newton iteration that only accepts
steps which decrease χ², and every distinct optimum near the best one is returned with its uncertainty.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from arrays.differences import Whitening, proportional_noise, whitening
from arrays.sensor import SensorArray
from magloc.dipole import MU0_OVER_4PI
from magloc.kernels import separable as kernels
from magloc.separable import SeparableProblem, candidate_positions

FloatArray = NDArray[np.float64]

N_UNKNOWNS = 6
# Δχ² of a 95 % interval of one parameter, and within which another optimum is a solution too.
RISE_95 = 3.841458820694124
DISTINCT_WITHIN = 20.0
# Mean square of whitened differences below which they are rounding errors rather than noise.
SILENT = 1e-9
_ROWS_AT_ONCE = 256


@dataclass(frozen=True, eq=False)
class Solution:
    """One optimum of the likelihood.

    Attributes
    ----------
    position_m : ndarray, shape (3,)
        Source in the array's frame [m].
    moment_Am2 : ndarray, shape (3,)
        Its moment [A·m²].
    covariance : ndarray, shape (6, 6)
        Of (position, moment), the inverse information at the solution. Where the range is not observable it is no
        description of the uncertainty: use `range_interval95_m`.
    chi2 : float
        Sum of squared residuals of the decorrelated differences over their variances.
    dof : int
        Differences minus unknowns.
    iterations : int
        Linearisations that led here.
    converged : bool
        Whether the iteration ended at an optimum; no other solutions are listed.
    range_observable : bool
        Whether the 95 % interval of the range is closed and its ends differ by a factor of two at most.
    range_interval95_m : tuple of (low, high)
        Where the profile χ² over the distance from the sensors' centroid stays within 3.84 of this optimum [m];
        high is None where it never leaves it.
    """

    position_m: FloatArray
    moment_Am2: FloatArray
    covariance: FloatArray
    chi2: float
    dof: int
    iterations: int
    converged: bool
    range_observable: bool
    range_interval95_m: tuple[tuple[float, float | None], ...]


@dataclass(frozen=True, eq=False)
class Fix:
    """Every distinct solution of one set of readings, best χ² first.

    Attributes
    ----------
    solutions : tuple of Solution
        Empty if the readings cannot be solved.
    reason : str
        Why there is no solution; empty if there is one.
    failed_starts : int
        Starts of the search that ended without an optimum.
    """

    solutions: tuple[Solution, ...]
    reason: str = ""
    failed_starts: int = 0


@dataclass(frozen=True, eq=False)
class _Kernel:
    """A whitening in the layout of the compiled search, with the bases of all candidates."""

    whitening: Whitening
    problem: SeparableProblem
    bases: FloatArray


class Locator:
    """Start-free fixes with one array of vector sensors.

    Parameters
    ----------
    array : SensorArray
        Vector sensors only.
    n_starts : int
        Distinct candidates that are refined.
    apart_rad : float
        Least distance of two candidates, as an angle of their homogeneous coordinates.
    max_iterations : int
        Linearisations of one refinement at most; a refinement that needs more did not converge.

    Raises
    ------
    ValueError
        The array has scalar sensors.
    """

    def __init__(
        self, array: SensorArray, *, n_starts: int = 6, apart_rad: float = 0.3, max_iterations: int = 100
    ) -> None:
        if array.channel_is_scalar.any():
            raise ValueError("Input array must have vector sensors only; instead received one with scalar sensors.")
        self.array = array
        self.n_starts = n_starts
        self.apart_rad = apart_rad
        self.max_iterations = max_iterations
        self._candidates = candidate_positions(array)
        self._of_mask: dict[bytes, _Kernel] = {}

    def fit(self, readings_T: ArrayLike) -> Fix:
        """Fix from one set of readings.

        Parameters
        ----------
        readings_T : array_like, shape (C,)
            Raw readings in channel order [T]; NaN where missing.

        Returns
        -------
        Fix
        """
        return self.fit_rows(np.asarray(readings_T, dtype=np.float64)[None])[0]

    def fit_rows(self, readings_T: ArrayLike, progress: Callable[[int], None] | None = None) -> list[Fix]:
        """Fixes of many sets of readings, each on its own.

        Parameters
        ----------
        readings_T : array_like, shape (n, C)
            Raw readings in channel order [T]; NaN where missing.
        progress : callable, optional
            Called with the number of rows finished since the last call.

        Returns
        -------
        list of Fix
            In the order of the rows.
        """
        readings = np.asarray(readings_T, dtype=np.float64)
        if readings.ndim != 2 or readings.shape[1] != self.array.n_channels:
            raise ValueError(
                f"Input readings_T must have shape (n, {self.array.n_channels}); instead received {readings.shape}."
            )
        fixes: list[Fix] = [Fix(())] * len(readings)
        for mask, rows in _rows_of_equal_mask(np.isfinite(readings)):
            kernel = self._kernel(mask)
            k = kernel.whitening.n_differences
            for start in range(0, rows.size, _ROWS_AT_ONCE):
                block = rows[start : start + _ROWS_AT_ONCE]
                if k < N_UNKNOWNS:
                    reason = f"{int(mask.sum())} readings give {k} independent differences, {N_UNKNOWNS} are needed"
                    found = [Fix((), reason)] * block.size
                else:
                    found = self._fit_block(kernel, mask, readings[block])
                for row, fix in zip(block, found, strict=True):
                    fixes[row] = fix
                if progress is not None:
                    progress(block.size)
        return fixes

    def _kernel(self, mask: NDArray[np.bool_]) -> _Kernel:
        key = mask.tobytes()
        if key not in self._of_mask:
            self._of_mask.clear()  # bases are large, and rows come sorted by their mask
            white = whitening(self.array, mask)
            problem = SeparableProblem.of(self.array, white)
            bases = kernels.candidate_bases(
                problem.homogeneous(self._candidates),
                problem.sensors,
                problem.channel_sensor,
                problem.gain,
                np.ascontiguousarray(white.basis.T),
                white.shrinkage,
            )
            self._of_mask[key] = _Kernel(white, problem, bases)
        return self._of_mask[key]

    def _fit_block(self, kernel: _Kernel, mask: NDArray[np.bool_], readings: FloatArray) -> list[Fix]:
        problem = kernel.problem
        channels = np.where(mask, readings - self.array.channel_offset_T, 0.0)
        y = kernel.whitening.apply(channels)
        scores = self._scores(kernel.bases, y)
        whitenings = [kernel.whitening]
        set_of_row = np.zeros(len(readings), dtype=np.intp)
        if self.array.noise_fraction > 0.0:
            noise = proportional_noise(self.array, readings)
            whitenings = [whitening(self.array, mask, channel_noise_T=row) for row in noise]
            set_of_row = np.arange(len(readings), dtype=np.intp)
            y = np.stack([w.apply(row) for w, row in zip(whitenings, channels, strict=True)])
        shape = (len(readings), self.n_starts)
        q, mu, chi2 = np.full((*shape, 4), np.nan), np.full((*shape, 3), np.nan), np.full(shape, np.nan)
        iterations = np.zeros(shape, dtype=np.int64)
        covariance, ends = np.full((*shape, 6, 6), np.nan), np.full((*shape, 2), np.nan)
        counts = np.zeros((len(readings), 2), dtype=np.int64)
        kernels.fix_rows(
            y,
            scores,
            problem.homogeneous(self._candidates),
            np.cos(self.apart_rad),
            DISTINCT_WITHIN,
            RISE_95,
            self.max_iterations,
            problem.sensors,
            problem.channel_sensor,
            np.stack([self.array.channel_gain * w.inverse_noise[:, None] for w in whitenings]),
            np.ascontiguousarray(np.stack([w.basis.T for w in whitenings])),
            np.stack([w.shrinkage for w in whitenings]),
            set_of_row,
            q,
            mu,
            chi2,
            iterations,
            covariance,
            ends,
            counts,
        )
        kept, failed = counts.T
        position, moment = problem.position(q), problem.moment(q, mu)
        unit = np.repeat([problem.radius, problem.radius**3 / MU0_OVER_4PI], 3)
        covariance = covariance * np.outer(unit, unit)
        ends = ends * problem.radius
        dof = kernel.whitening.n_differences - N_UNKNOWNS
        silent = np.einsum("ic,ic->i", y, y) < SILENT * kernel.whitening.n_differences
        fixes = []
        for i in range(len(readings)):
            if silent[i]:
                fixes.append(Fix((), "the sensors' readings do not differ: no signal"))
                continue
            solutions = tuple(
                _solution(
                    position[i, j],
                    moment[i, j],
                    covariance[i, j],
                    float(chi2[i, j]),
                    dof,
                    int(iterations[i, j]),
                    ends[i, j],
                )
                for j in range(kept[i])
                if np.isfinite(covariance[i, j]).all()
            )
            fixes.append(Fix(solutions, "" if solutions else _why_unsolved(int(kept[i])), int(failed[i])))
        return fixes

    @staticmethod
    def _scores(bases: FloatArray, y: FloatArray) -> FloatArray:
        """Energy of whitened readings (n, C) that every candidate explains: (n, candidates)."""
        components = y @ bases.reshape(-1, y.shape[1]).T
        return np.square(components, out=components).reshape(len(y), -1, 3).sum(axis=-1)


def _rows_of_equal_mask(available: NDArray[np.bool_]) -> Iterator[tuple[NDArray[np.bool_], NDArray[np.intp]]]:
    masks, of_row = np.unique(available, axis=0, return_inverse=True)
    for i, mask in enumerate(masks):
        yield mask, np.flatnonzero(of_row.ravel() == i)


def _solution(
    position: FloatArray,
    moment: FloatArray,
    covariance: FloatArray,
    chi2: float,
    dof: int,
    iterations: int,
    ends: FloatArray,
) -> Solution:
    low, high = float(ends[0]), float(ends[1])
    return Solution(
        position_m=position,
        moment_Am2=moment,
        covariance=covariance,
        chi2=chi2,
        dof=dof,
        iterations=iterations,
        converged=True,
        range_observable=bool(low > 0.0 and high <= 2.0 * low),
        range_interval95_m=((low, high if np.isfinite(high) else None),),
    )


def _why_unsolved(n_optima: int) -> str:
    if n_optima:
        return "the differences between the sensors do not determine the source: no signal, or a degenerate array"
    return "the search did not converge from any of its starts"
