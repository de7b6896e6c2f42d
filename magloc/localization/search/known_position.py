"""The moment of a dipole whose place is known: the vector gradiometer of the source paper, by any sensors.

Differences of moduli without an ambient field are even in the moment: m and -m fit exactly alike, and three of them
usually have four exact solutions. All of them are returned. A known ambient field makes the differences nearly linear
in the moment, and the solution unique, equations (20) to (30).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from arrays.array import SensorArray
from arrays.typing import FloatArray
from magloc.directions import fibonacci_directions
from magloc.localization.fit.gauss_newton import JointFits, fit_moments, refine_moments
from magloc.localization.fit.prior import NOTHING_KNOWN, SourcePrior
from magloc.localization.fit.results import DISTINCT_WITHIN, SILENT, Fix, Solution
from magloc.localization.search.beam_search import Beam
from magloc.localization.uncertainty.ambiguity import LARGEST_GAUSSIAN_SIGMA, log_evidence_volume, weights
from magloc.localization.uncertainty.range_interval import is_detected
from magloc.measurement.rows import NO_SIGNAL, checked_rows, rows_of_equal_mask, whitened_model, whitenings_of
from magloc.measurement.whitened import WhitenedModel

N_UNKNOWNS = 3
_N_DIRECTIONS = 60
# Up to the sign.
_MOST_SOLUTIONS = 8
# By how much χ² must rise halfway between two optima for them to count as two.
_BARRIER = 0.01
_LEAST_EIGENVALUE = 1e-13
_ROWS_AT_ONCE = 64


class MomentLocator:
    """Moments of a dipole at a known place.

    Parameters
    ----------
    array : SensorArray
    position_m : array_like, shape (3,)
        The source in the array's frame [m].
    knowledge : SourcePrior
        Of which only the bound of the moment is used.

    Raises
    ------
    ValueError
        The position is not three finite numbers, or is that of a sensor.
    """

    def __init__(self, array: SensorArray, position_m: ArrayLike, *, knowledge: SourcePrior = NOTHING_KNOWN) -> None:
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
        readings = checked_rows(self.array, readings_T)
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
            return [Fix((), reason, detected=False)] * len(readings)
        problem, raw = whitened_model(self.array, mask, readings, whitenings, ambient)
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
        covariance = _covariances(problem.rows(of_row), y[of_row], fits)
        determined = np.isfinite(covariance).all(axis=(1, 2))
        energy = np.sum((y - problem.predicted(np.zeros_like(problem.ambient))) ** 2, axis=1)
        told, volume = np.full(chi2.shape, np.inf), np.zeros(chi2.shape)
        told[of_row, of_fit] = np.where(determined, fits.chi2, np.inf)
        volume[of_row, of_fit] = log_evidence_volume(covariance, moment[of_row, of_fit][:, None])
        weight, detected = weights(told, volume), is_detected(energy, n_differences).tolist()
        # The readings of vector sensors are linear in the moment, those of moduli only over a small part of it.
        with np.errstate(invalid="ignore", divide="ignore"):
            sigma = np.sqrt(np.trace(covariance, axis1=1, axis2=2)) / np.linalg.norm(moment[of_row, of_fit], axis=1)
        gaussian = (sigma <= LARGEST_GAUSSIAN_SIGMA) | (not self.array.channel_is_scalar.any())
        distance = np.linalg.norm(positions - self.array.centroid, axis=-1)
        solutions: list[list[Solution]] = [[] for _ in readings]
        for i in np.flatnonzero(determined):
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
                    weight=float(weight[row, of_fit[i]]),
                    gaussian=bool(gaussian[i]),
                )
            )
        silent = np.sum(y * y, axis=1) < SILENT * n_differences
        return [
            Fix((), NO_SIGNAL, detected=False)
            if silent[i]
            else Fix(tuple(found), "" if found else _why_unsolved(beam, i), detected=detected[i])
            for i, found in enumerate(solutions)
        ]


def _all_moments(problem: WhitenedModel, y: FloatArray, q: FloatArray) -> Beam:
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
    return _distinct(problem, y, q, fits)


def _distinct(problem: WhitenedModel, y: FloatArray, q: FloatArray, fits: JointFits) -> Beam:
    """The best optima of every row that χ² rises between, and their opposites where χ² is even in the moment."""
    n = len(y)
    mu, chi2 = fits.mu.reshape(n, -1, 3), fits.chi2.reshape(n, -1).copy()
    iterations = fits.iterations.reshape(n, -1)
    row, rows = np.repeat(np.arange(n), mu.shape[1]), np.arange(n)
    each = problem.rows(row)
    even = _is_even(problem)
    kept_mu = np.full((n, _MOST_SOLUTIONS, 3), np.nan)
    kept_chi2 = np.full((n, _MOST_SOLUTIONS), np.inf)
    kept_iterations = np.zeros((n, _MOST_SOLUTIONS), dtype=np.int64)
    for k in range(_MOST_SOLUTIONS):
        best = np.argmin(chi2, axis=1)
        value = chi2[rows, best]
        if not np.isfinite(value).any():
            break
        kept_mu[:, k], kept_chi2[:, k] = mu[rows, best], value
        kept_iterations[:, k] = iterations[rows, best]
        opposite = even[:, None] & (np.sum(mu * kept_mu[:, k, None], axis=-1) < 0.0)
        halfway = 0.5 * (np.where(opposite[..., None], -mu, mu) + kept_mu[:, k, None])
        residual = y[row] - each.predicted(each.source_fields(q[row], halfway.reshape(-1, 1, 3)))
        between = np.sum(residual**2, axis=-1).reshape(n, -1)
        chi2[between < np.where(np.isfinite(chi2), chi2, 0.0) + _BARRIER] = np.inf
        chi2[rows, best] = np.inf
    both_mu = np.stack([kept_mu, -kept_mu], axis=2).reshape(n, -1, 1, 3)
    both_chi2 = np.stack([kept_chi2, np.where(even[:, None], kept_chi2, np.inf)], axis=2).reshape(n, -1)
    return Beam(
        np.repeat(q[:, None], both_chi2.shape[1], axis=1), both_mu, both_chi2, np.repeat(kept_iterations, 2, axis=1)
    )


def _is_even(problem: WhitenedModel) -> NDArray[np.bool_]:
    """Whether the readings (b,) stay as they are if the moment is reversed: moduli alone, without an ambient field."""
    silent = ~np.any(problem.gain, axis=-1)
    lone = problem.channel_is_scalar & ~np.any(problem.ambient, axis=-1)[:, problem.channel_sensor]
    even: NDArray[np.bool_] = np.all(silent | lone, axis=-1)
    return even


def _covariances(problem: WhitenedModel, y: FloatArray, fits: JointFits) -> FloatArray:
    """Inverse of half the second derivative of χ² (b, 3, 3) [A·m²], NaN where it is not positive.

    Where two exact solutions are about to meet, the first derivative of the readings alone would say nothing.
    """
    if not len(problem):
        return np.empty((0, N_UNKNOWNS, N_UNKNOWNS))
    fields = problem.source_fields(fits.q, fits.mu)
    jacobian = problem.moment_jacobian(fits.q, problem.linear_gain(fields))
    information = jacobian.transpose(0, 2, 1) @ jacobian
    scalar = problem.channel_is_scalar
    if scalar.any():
        owner = problem.channel_sensor[scalar]
        residual = problem.whitened(y - problem.predicted(fields))[:, scalar]
        total = (fields + problem.ambient)[:, owner]
        modulus = np.linalg.norm(total, axis=-1, keepdims=True)
        matrix = np.stack(
            [problem.source_fields(fits.q, np.broadcast_to(axis, fits.mu.shape)) for axis in np.eye(3)], axis=-1
        )[:, owner]
        with np.errstate(divide="ignore", invalid="ignore"):
            direction = total / modulus
            across = matrix - direction[..., None] * (direction[..., None, :] @ matrix)
            weight = residual * problem.gain[:, scalar, 0] / modulus[..., 0]
            information = information - np.einsum("bc,bcji,bcjk->bik", weight, across, across)
    length = np.sqrt(np.abs(np.diagonal(information, axis1=1, axis2=2)))
    scale = length[:, :, None] * length[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        unit = information / scale
    positive = np.isfinite(unit).all(axis=(1, 2))
    values, vectors = np.linalg.eigh(np.where(positive[:, None, None], unit, np.eye(3)))
    positive &= values[:, 0] > _LEAST_EIGENVALUE
    safe = np.where(positive[:, None], values, 1.0)
    inverse = (vectors / safe[:, None]) @ vectors.transpose(0, 2, 1)
    size = problem.moment(fits.q[:, 0], np.ones((len(y), 3)))
    with np.errstate(divide="ignore", invalid="ignore"):
        covariance: FloatArray = inverse / scale * size[:, :, None] * size[:, None]
    covariance[~positive] = np.nan
    return covariance


def _why_unsolved(beam: Beam, row: int) -> str:
    if not np.isfinite(beam.chi2[row]).any():
        return "the search did not converge from any of its starts"
    return "the differences between the sensors do not determine a moment that is small enough"
