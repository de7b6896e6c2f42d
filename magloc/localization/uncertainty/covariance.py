"""What is known of the sources of joint fits: sets of ranges, weights of the solutions, and covariances that fit them.

Of a single source all solutions of a row are taken together (:mod:`magloc.localization.uncertainty.range_interval`).
Several sources have no common range: each has its own ranges in each solution, where the profile of χ² stays within
3.84 of that solution.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from arrays.typing import FloatArray
from magloc.localization.fit.gauss_newton import JointFits
from magloc.localization.fit.results import AnyFix
from magloc.localization.uncertainty.ambiguity import (
    CERTAIN_WEIGHT,
    LARGEST_GAUSSIAN_SIGMA,
    MISFIT,
    Rivals,
    log_evidence_volume,
    longest_axes,
    relative_sigma,
    weights,
    widened,
)
from magloc.localization.uncertainty.range_interval import (
    EVERYWHERE,
    Intervals,
    is_detected,
    is_observable_set,
    relative_range_sigma,
    span,
    union,
)
from magloc.localization.uncertainty.range_profile import profile_stretches, ranges_within
from magloc.measurement.whitened import WhitenedModel

# By how much the rise of χ² at one standard deviation may differ from one where errors are Gaussian.
_BEND = 0.5


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
    problem: WhitenedModel,
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
    problem : WhitenedModel
        Of f fits.
    y : ndarray, shape (f, C)
        Whitened readings.
    fits : JointFits
        Row after row, and of every row best first.
    covariance : ndarray, shape (f, 6 K, 6 K)
        Inverse information, as of :func:`magloc.localization.fit.gauss_newton.covariances`.
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
    return _of_several(problem, y, fits, covariance, of_row, is_detected(energy, n_differences), n_differences)


def covariance_is_valid(
    problem: WhitenedModel,
    y: FloatArray,
    position_m: FloatArray,
    moment_Am2: FloatArray,
    chi2: FloatArray,
    dof: int,
    covariance: FloatArray,
) -> NDArray[np.bool_]:
    """Whether covariances describe the errors of f fits of K sources, as far as the model near the fits tells.

    They do where χ² is one of noise, and rises by one, give or take a half, at one standard deviation along the longest
    axis, to either side: not where the errors follow a curve.

    Parameters
    ----------
    problem : WhitenedModel
        Of f fits.
    y : ndarray, shape (f, C)
        Whitened readings.
    position_m, moment_Am2 : ndarray, shape (f, K, 3)
    chi2 : ndarray, shape (f,)
    dof : int
        Zero where every χ² is as it must be.
    covariance : ndarray, shape (f, 6 K, 6 K)
        Inverse information.

    Returns
    -------
    ndarray of bool, shape (f,)
    """
    axis = longest_axes(covariance, position_m - problem.centroid, moment_Am2).reshape(*position_m.shape[:2], 2, 3)
    described = chdtrc(dof, chi2) >= MISFIT if dof > 0 else np.ones(len(y), dtype=bool)
    for side in (axis, -axis):
        q = problem.homogeneous(position_m + side[:, :, 0])
        mu = problem.scaled_moment(q, moment_Am2 + side[:, :, 1])
        residual = y - problem.predicted(problem.source_fields(q, mu))
        described &= np.abs(np.sum(residual**2, axis=1) - chi2 - 1.0) <= _BEND
    return np.asarray(described)


def _of_one(
    problem: WhitenedModel,
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
    gaussian = ranges.gaussian[at]
    gaussian[gaussian] = _described(problem, y, fits, covariance, n_differences, np.flatnonzero(gaussian))
    return FitUncertainty(
        [[ranges.sets[row]] for row in of_row], ranges.covariance[at], gaussian[:, None], rivals.weight[at]
    )


def _described(
    problem: WhitenedModel,
    y: FloatArray,
    fits: JointFits,
    covariance: FloatArray,
    n_differences: int,
    which: NDArray[np.intp],
) -> NDArray[np.bool_]:
    """:func:`covariance_is_valid` of some of the fits."""
    q, mu = fits.q[which], fits.mu[which]
    dof = n_differences - 6 * q.shape[1]
    return covariance_is_valid(
        problem.rows(which),
        y[which],
        problem.position(q),
        problem.moment(q, mu),
        fits.chi2[which],
        dof,
        covariance[which],
    )


def _of_several(
    problem: WhitenedModel,
    y: FloatArray,
    fits: JointFits,
    covariance: FloatArray,
    of_row: NDArray[np.intp],
    detected: NDArray[np.bool_],
    n_differences: int,
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
    volume, weight = log_evidence_volume(covariance, moment, offset), np.zeros(n_fits)
    for row in np.unique(of_row):
        weight[of_row == row] = weights(chi2[of_row == row], volume[of_row == row])
    gaussian &= (weight >= CERTAIN_WEIGHT)[:, None]
    claimed = np.flatnonzero(gaussian.any(axis=1))
    gaussian[claimed] &= _described(problem, y, fits, covariance, n_differences, claimed)[:, None]
    return FitUncertainty(sets, wide, gaussian, weight)


def is_misfit(fix: AnyFix) -> bool:
    """Whether χ² is far beyond noise: then neither the position nor its standard deviations are to be trusted."""
    if not fix.solutions or fix.solutions[0].dof <= 0:
        return False
    return bool(chdtrc(fix.solutions[0].dof, fix.solutions[0].chi2) < MISFIT)
