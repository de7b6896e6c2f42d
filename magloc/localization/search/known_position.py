"""Moments of dipoles at known positions, by any sensors (the paper's vector gradiometer).

Differences of moduli without an ambient field are even in the moment: m and -m fit equally well, and three differences
usually have four exact solutions. The search returns all of them. With a known ambient field the differences are nearly
linear in the moment, and the solution is unique, equations (20) to (30).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from arrays.array import SensorArray
from arrays.typing import FloatArray, IntArray
from magloc.directions import fibonacci_directions
from magloc.localization.fit.gauss_newton import JointFits, fit_moments, refine_moments
from magloc.localization.fit.optima import Optima
from magloc.localization.fit.prior import NOTHING_KNOWN, SourcePrior
from magloc.localization.fit.results import DISTINCT_WITHIN
from magloc.measurement.rows import WhitenedRows
from magloc.measurement.whitened import WhitenedModel

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

N_UNKNOWNS = 3
_N_DIRECTIONS = 60
# Number of distinct solutions up to the sign.
_MOST_SOLUTIONS = 8
# Rise of χ² halfway between two optima above which they are distinct.
_BARRIER = 0.01
_TOO_LARGE = "the differences between the sensors do not determine a moment that is small enough"


class MomentSearch:
    """Search for the moments of K sources at known positions.

    Parameters
    ----------
    position_m : array_like, shape (3,), (n, 3) or (n, K, 3)
        Position of the source in the array's frame [m], for all rows or for each row of a moving array; or positions of
        several sources. n is 1 for all rows.
    prior : SourcePrior
        Prior; only its parts about the moment are used.

    Raises
    ------
    ValueError
        The position is not three finite numbers, or coincides with a sensor or another source.
    """

    def __init__(self, array: SensorArray, position_m: ArrayLike, *, prior: SourcePrior = NOTHING_KNOWN) -> None:
        position = np.asarray(position_m, dtype=np.float64)
        if position.ndim not in (1, 2, 3) or position.shape[-1] != 3 or not np.isfinite(position).all():
            raise ValueError(f"Input position_m must be three finite numbers; instead received {position.tolist()}.")
        offsets = np.linalg.norm(array.positions - position.reshape(-1, 1, 3), axis=-1)
        if np.min(offsets, initial=np.inf) <= 1e-9 * array.circumradius:
            raise ValueError(f"Input position_m must not be that of a sensor; instead received {position.tolist()}.")
        if position.ndim < 3:
            position = position.reshape(-1, 1, 3)
        if any(len(set(map(tuple, of_row))) < len(of_row) for of_row in position.tolist()):
            raise ValueError(f"Input position_m must be different places; instead received {position[0].tolist()}.")
        self.array = array
        self.position_m = position
        self.prior = prior

    def select(self, index: IntArray) -> MomentSearch:
        """Return the search for some of the rows."""
        if len(self.position_m) == 1:
            return self
        if len(self.position_m) <= index.max(initial=-1):
            raise ValueError(
                f"Input position_m must have a place for every row; instead received {len(self.position_m)}."
            )
        return MomentSearch(self.array, self.position_m[index], prior=self.prior)

    def optima(self, rows: WhitenedRows) -> list[Optima]:
        """Return all distinct optima of every row."""
        rows = rows.with_known_moment(self.prior.known_moment)
        model, place = rows.model, self.position_m if len(self.position_m) == 1 else self.position_m[rows.index]
        position = np.broadcast_to(place, (len(rows), *place.shape[1:]))
        beam = _all_moments(model, rows.y, model.homogeneous(position))
        moment = model.moment(beam.q, beam.mu)
        with np.errstate(invalid="ignore"):
            chi2 = np.where(self.prior.allows_moment(moment).all(axis=-1), beam.chi2, np.inf)
        of_row, of_fit = np.nonzero(np.isfinite(chi2) & (chi2 <= chi2.min(axis=1, keepdims=True) + DISTINCT_WITHIN))
        fits, converged = beam.rows((of_row, of_fit)), np.asarray(beam.converged.any(axis=1))
        reason = ["" if found else "the search did not converge from any of its starts" for found in converged]
        return [Optima(rows, fits, of_row, reason, position_m=position, undetermined=_TOO_LARGE)]


def _all_moments(problem: WhitenedModel, y: FloatArray, q: FloatArray) -> JointFits:
    """Return all distinct optima of the moments at q (b, K, 4).

    They start from the linear solution and from moments all around.
    """
    n, n_sources = q.shape[:2]
    starts = [fit_moments(problem, y, q)[:, None]]
    if problem.channel_is_scalar.any():
        # With several sources each start combines other directions.
        directions = np.stack([np.roll(fibonacci_directions(_N_DIRECTIONS), 17 * k, 0) for k in range(n_sources)], 1)
        row = np.repeat(np.arange(n), _N_DIRECTIONS)
        alone = problem.rows(row).without_ambient()
        around = np.tile(directions, (n, 1, 1))
        unit = alone.predict(alone.source_fields(q[row], around))
        # Length that the readings require without an ambient field: the scale of the moduli.
        length = np.linalg.norm(y[row], axis=-1) / np.maximum(np.linalg.norm(unit, axis=-1), 1e-300)
        starts.append((length[:, None, None] * around).reshape(n, _N_DIRECTIONS, n_sources, 3))
    mu = np.concatenate(starts, axis=1)
    row = np.repeat(np.arange(n), mu.shape[1])
    fits = refine_moments(problem.rows(row), y[row], q[row], mu.reshape(-1, n_sources, 3))
    return _distinct_optima(problem, y, q, fits)


def _distinct_optima(problem: WhitenedModel, y: FloatArray, q: FloatArray, fits: JointFits) -> JointFits:
    """Return the best optima of every row that a rise of χ² separates.

    Opposite moments are added where χ² is even.
    """
    n = len(y)
    every = fits.reshape(n, -1)
    row = np.repeat(np.arange(n), every.mu.shape[1])
    each, even = problem.rows(row), _is_even(problem)

    def is_same(one: JointFits) -> NDArray[np.bool_]:
        mu, best_mu = every.mu, one.mu[:, None]
        opposite = even[:, None] & (np.sum(mu * best_mu, axis=(-2, -1)) < 0.0)
        halfway = 0.5 * (np.where(opposite[..., None, None], -mu, mu) + best_mu)
        halfway = halfway.reshape(-1, *q.shape[1:2], 3)
        residual = each.residual(y[row], q[row], halfway, each.source_fields(q[row], halfway))
        between = np.sum(residual**2, axis=-1).reshape(n, -1)
        return np.asarray(between < every.chi2 + _BARRIER)

    both = every.distinct(_MOST_SOLUTIONS, is_same).reshape(-1).with_opposite_moments(n).reshape(n, -1)
    both.chi2[~even, 1::2] = np.inf
    return both


def _is_even(problem: WhitenedModel) -> NDArray[np.bool_]:
    """Return which readings (b,) do not change with the sign of the moment: moduli alone without an ambient field."""
    silent = ~np.any(problem.gain, axis=-1)
    lone = problem.channel_is_scalar & ~np.any(problem.ambient, axis=-1)[:, problem.channel_sensor]
    return np.all(silent | lone, axis=-1)


def places_in_array(position_m: ArrayLike, pose: tuple[FloatArray, Rotation] | None) -> FloatArray:
    """Return known positions (n, K, 3) in the array's axes of every row; n is 1 at rest.

    `position_m` (3,) or (K, 3) is in the frame of the results.
    """
    place = np.asarray(position_m, dtype=np.float64)
    if place.shape != (3,) and (place.ndim != 2 or place.shape[1] != 3 or not len(place)):
        raise ValueError(f"Input position_m must have shape (3,) or (K, 3); instead received {place.shape}.")
    place = place.reshape(1, -1, 3)
    return place if pose is None else np.einsum("nji,nkj->nki", pose[1].as_matrix(), place - pose[0][:, None])
