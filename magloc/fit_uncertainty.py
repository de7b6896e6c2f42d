"""What is known of the sources of joint fits: sets of ranges, weights of the solutions, and covariances that fit them.

Of a single source all solutions of a row are taken together (:mod:`magloc.range_set`). Several sources have no common
range: each has its own ranges in each solution, where the profile of χ² stays within 3.84 of that solution.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magloc.joint import JointFits, JointProblem
from magloc.range_profile import profile_stretches, ranges_within
from magloc.range_set import EVERYWHERE, Intervals, is_detected, is_observable_set, relative_range_sigma, span, union
from magloc.rivals import CERTAIN_WEIGHT, LARGEST_GAUSSIAN_SIGMA, Rivals, log_volume, relative_sigma, weights, widened

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class FitUncertainty:
    """What is known of f fits of K sources.

    Attributes
    ----------
    sets : list of list of tuple of (low, high)
        95 % sets of the ranges [m] of every source of every fit.
    covariance : ndarray, shape (f, 6 K, 6 K)
        Widened where ranges are not observable.
    gaussian : ndarray of bool, shape (f, K)
        Whether a source's part of it describes the uncertainty.
    weight : ndarray, shape (f,)
        How likely a fit is among those of its row.
    """

    sets: list[list[Intervals]]
    covariance: FloatArray
    gaussian: NDArray[np.bool_]
    weight: FloatArray


def fit_uncertainty(
    problem: JointProblem,
    y: FloatArray,
    fits: JointFits,
    covariance: FloatArray,
    of_row: NDArray[np.intp],
    energy: FloatArray,
    n_differences: int,
) -> FitUncertainty:
    """What is known of the sources of all solutions of b rows.

    Parameters
    ----------
    problem : JointProblem
        Of f fits.
    y : ndarray, shape (f, C)
        Whitened readings.
    fits : JointFits
        Row after row, and of every row best first.
    covariance : ndarray, shape (f, 6 K, 6 K)
        Inverse information, as of :func:`magloc.joint.covariances`.
    of_row : ndarray of int, shape (f,)
        Row of every fit.
    energy : ndarray, shape (b,)
        Sums of squared differences of the rows, as they are without a source.
    n_differences : int

    Returns
    -------
    FitUncertainty
    """
    if fits.q.shape[1] == 1:
        return _of_one(problem, y, fits, covariance, of_row, energy, n_differences)
    return _of_several(problem, y, fits, covariance, of_row, is_detected(energy, n_differences))


def _of_one(
    problem: JointProblem,
    y: FloatArray,
    fits: JointFits,
    covariance: FloatArray,
    of_row: NDArray[np.intp],
    energy: FloatArray,
    n_differences: int,
) -> FitUncertainty:
    place = np.arange(len(of_row)) - np.searchsorted(of_row, of_row)
    shape = len(energy), int(place.max(initial=0)) + 1
    at = of_row, place

    def table(values: FloatArray, empty: float) -> FloatArray:
        full = np.full((*shape, *values.shape[1:]), empty)
        full[at] = values
        return full

    offset = problem.position(fits.q)[:, 0] - problem.centroid
    moment, chi2 = problem.moment(fits.q, fits.mu)[:, 0], table(fits.chi2, np.inf)
    rivals = Rivals.of(
        chi2, table(covariance, np.nan), table(offset, np.nan), table(moment, np.nan), energy, n_differences
    )
    left = rivals.rise[of_row] - (fits.chi2 - chi2[of_row, 0])
    inside = np.flatnonzero((left > 0.0) & np.isfinite(left))
    alpha = np.full((len(left), 2), np.nan)
    sigma = relative_range_sigma(covariance, offset)
    alpha[inside] = profile_stretches(
        problem.rows(inside), y[inside], fits.rows(inside), 0, sigma[inside], left[inside]
    )
    ranges = rivals.ranges(table(alpha, np.nan), problem.radius)
    return FitUncertainty(
        [[ranges.sets[row]] for row in of_row], ranges.covariance[at], ranges.gaussian[at][:, None], rivals.weight[at]
    )


def _of_several(
    problem: JointProblem,
    y: FloatArray,
    fits: JointFits,
    covariance: FloatArray,
    of_row: NDArray[np.intp],
    detected: NDArray[np.bool_],
) -> FitUncertainty:
    offset, moment = problem.position(fits.q) - problem.centroid, problem.moment(fits.q, fits.mu)
    n_fits, n_sources = offset.shape[:2]
    wide = covariance.copy()
    sets: list[list[Intervals]] = [[] for _ in range(n_fits)]
    gaussian = np.zeros((n_fits, n_sources), dtype=bool)
    for k in range(n_sources):
        ends = ranges_within(problem, y, fits, k, covariance).tolist()
        of_source = [union([pair]) if seen else EVERYWHERE for pair, seen in zip(ends, detected[of_row], strict=True)]
        low, high = np.array([span(intervals) for intervals in of_source]).reshape(-1, 2).T
        observable = np.array([is_observable_set(intervals) for intervals in of_source], dtype=bool)
        sigma = relative_sigma(covariance[:, 6 * k :, 6 * k :], offset[:, k], moment[:, k])
        gaussian[:, k] = observable & (sigma <= LARGEST_GAUSSIAN_SIGMA)
        blurred = ~observable
        wide[blurred] = widened(wide[blurred], offset[blurred, k], low[blurred], high[blurred], k)
        for of_fit, intervals in zip(sets, of_source, strict=True):
            of_fit.append(intervals)
    chi2 = np.where(np.isfinite(covariance).all(axis=(1, 2)), fits.chi2, np.inf)
    volume, weight = log_volume(covariance, moment, offset), np.zeros(n_fits)
    for row in np.unique(of_row):
        weight[of_row == row] = weights(chi2[of_row == row], volume[of_row == row])
    return FitUncertainty(sets, wide, gaussian & (weight >= CERTAIN_WEIGHT)[:, None], weight)
