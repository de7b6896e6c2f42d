"""The moment of a dipole whose place is known: the vector gradiometer of the source paper, by any sensors.

Differences of moduli without an ambient field are even in the moment: m and -m fit exactly alike, and three of them
usually have four exact solutions. All of them are returned. A known ambient field makes the differences nearly linear
in the moment, and the solution unique, equations (20) to (30).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from arrays.sensor import SensorArray
from magloc.fix import DISTINCT_WITHIN, NOTHING_KNOWN, SILENT, Fix, Knowledge, Solution
from magloc.joint import JointFits, JointProblem, fit_moments, moment_covariances, refine_moments
from magloc.rows import NO_SIGNAL, joint_problem, rows_of_equal_mask, whitenings_of
from magloc.search import Beam, best_distinct
from magloc.separable import fibonacci_directions

FloatArray = NDArray[np.float64]

N_UNKNOWNS = 3
_N_DIRECTIONS = 60
_MOST_SOLUTIONS = 16
_ROWS_AT_ONCE = 64


class MomentLocator:
    """Moments of a dipole at a known place.

    Parameters
    ----------
    array : SensorArray
    position_m : array_like, shape (3,)
        The source in the array's frame [m].
    knowledge : Knowledge
        Of which only the bound of the moment is used.

    Raises
    ------
    ValueError
        The position is not three finite numbers, or is that of a sensor.
    """

    def __init__(self, array: SensorArray, position_m: ArrayLike, *, knowledge: Knowledge = NOTHING_KNOWN) -> None:
        position = np.asarray(position_m, dtype=np.float64)
        if position.shape != (3,) or not np.isfinite(position).all():
            raise ValueError(f"Input position_m must be three finite numbers; instead received {position.tolist()}.")
        if np.min(np.linalg.norm(array.positions - position, axis=1)) <= 1e-9 * array.circumradius:
            raise ValueError(f"Input position_m must not be that of a sensor; instead received {position.tolist()}.")
        self.array = array
        self.position_m = position
        self.knowledge = knowledge

    def fit_rows(
        self,
        readings_T: ArrayLike,
        ambient_T: ArrayLike | None = None,
        progress: Callable[[int], None] | None = None,
        *,
        position_m: ArrayLike | None = None,
    ) -> list[Fix]:
        """Moments of many sets of readings, each on its own.

        Parameters
        ----------
        readings_T : array_like, shape (n, C)
            Raw readings in channel order [T]; NaN where missing.
        ambient_T : array_like, shape (n, 3), optional
            Ambient field of every row in the array's frame [T], in place of the array's own.
        progress : callable, optional
            Called with the number of rows finished since the last call.
        position_m : array_like, shape (n, 3), optional
            Place of the source in every row, in place of one for all: for an array that moves.

        Returns
        -------
        list of Fix
            Every distinct solution, with the covariance (3, 3) of the moment. The range is that of the known place.
        """
        readings = np.asarray(readings_T, dtype=np.float64)
        if readings.ndim != 2 or readings.shape[1] != self.array.n_channels:
            raise ValueError(
                f"Input readings_T must have shape (n, {self.array.n_channels}); instead received {readings.shape}."
            )
        positions = np.broadcast_to(
            self.position_m if position_m is None else np.asarray(position_m, dtype=np.float64), (len(readings), 3)
        )
        ambient = None if ambient_T is None else np.asarray(ambient_T, dtype=np.float64)
        fixes: list[Fix] = [Fix(())] * len(readings)
        for mask, rows in rows_of_equal_mask(np.isfinite(readings)):
            for start in range(0, rows.size, _ROWS_AT_ONCE):
                block = rows[start : start + _ROWS_AT_ONCE]
                found = self._fit_block(
                    mask, readings[block], None if ambient is None else ambient[block], positions[block]
                )
                for row, fix in zip(block, found, strict=True):
                    fixes[row] = fix
                if progress is not None:
                    progress(block.size)
        return fixes

    def _fit_block(
        self, mask: NDArray[np.bool_], readings: FloatArray, ambient: FloatArray | None, positions: FloatArray
    ) -> list[Fix]:
        whitenings = whitenings_of(self.array, mask, readings)
        n_differences = whitenings[0].n_differences
        if n_differences < N_UNKNOWNS:
            reason = f"{int(mask.sum())} readings give {n_differences} independent differences, {N_UNKNOWNS} are needed"
            return [Fix((), reason)] * len(readings)
        problem, raw = joint_problem(self.array, mask, readings, whitenings, ambient)
        y = problem.whitened(raw)
        q = problem.homogeneous(positions)[:, None]
        beam = _all_moments(problem, y, q)
        moment = problem.moment(beam.q[:, :, 0], beam.mu[:, :, 0])
        with np.errstate(invalid="ignore"):
            chi2 = np.where(self.knowledge.allows_moment(moment), beam.chi2, np.inf)
        listed = np.isfinite(chi2) & (chi2 <= chi2.min(axis=1, keepdims=True) + DISTINCT_WITHIN)
        of_row, of_fit = np.nonzero(listed)
        fits = JointFits(
            beam.q[of_row, of_fit], beam.mu[of_row, of_fit], chi2[of_row, of_fit], beam.iterations[of_row, of_fit]
        )
        covariance = moment_covariances(problem.rows(of_row), fits)
        distance = np.linalg.norm(positions - self.array.centroid, axis=-1)
        solutions: list[list[Solution]] = [[] for _ in readings]
        for i in np.flatnonzero(np.isfinite(covariance).all(axis=(1, 2))):
            row = int(of_row[i])
            solutions[row].append(
                Solution(
                    position_m=positions[row].copy(),
                    moment_Am2=moment[row, of_fit[i]],
                    covariance=covariance[i],
                    chi2=float(fits.chi2[i]),
                    dof=n_differences - N_UNKNOWNS,
                    iterations=int(fits.iterations[i]),
                    converged=True,
                    range_observable=True,
                    range_interval95_m=((float(distance[row]), float(distance[row])),),
                )
            )
        silent = np.sum(y * y, axis=1) < SILENT * n_differences
        return [
            Fix((), NO_SIGNAL) if silent[i] else Fix(tuple(found), "" if found else _why_unsolved(beam, i))
            for i, found in enumerate(solutions)
        ]


def _all_moments(problem: JointProblem, y: FloatArray, q: FloatArray) -> Beam:
    """Every distinct optimum of the moment at q (b, 1, 4), from the linear solution and from moments all around."""
    n = len(y)
    starts = [fit_moments(problem, y, q)]
    if problem.channel_is_scalar.any():
        directions = fibonacci_directions(_N_DIRECTIONS)
        row = np.repeat(np.arange(n), _N_DIRECTIONS)
        alone = problem.rows(row).without_ambient()
        around = np.tile(directions, (n, 1))[:, None]
        unit = alone.predicted(alone.source_fields(q[row], around))
        # As long as the readings ask for if there were no ambient field: the scale of the moduli.
        length = np.linalg.norm(y[row], axis=-1) / np.maximum(np.linalg.norm(unit, axis=-1), 1e-300)
        starts.append((length[:, None, None] * around).reshape(n, _N_DIRECTIONS, 3))
    mu = np.concatenate(starts, axis=1)
    row = np.repeat(np.arange(n), mu.shape[1])
    fits = refine_moments(problem.rows(row), y[row], q[row], mu.reshape(-1, 1, 3))
    return best_distinct(fits, n, _MOST_SOLUTIONS)


def _why_unsolved(beam: Beam, row: int) -> str:
    if not np.isfinite(beam.chi2[row]).any():
        return "the search did not converge from any of its starts"
    return "the differences between the sensors do not determine a moment that is small enough"
