"""Uncertainty of sources: covariances, sets of ranges, and weights of the solutions.

The set of ranges of a single source covers all solutions of a row
(:mod:`magloc.localization.uncertainty.range_interval`). Several sources have no common range. Each has its own set in
each solution, in which the profile of χ² is within 3.84 of that solution.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.special import chdtrc

from arrays.typing import BoolArray, FloatArray, IntArray
from magloc import core
from magloc.chi_square import energy_threshold, quantile
from magloc.levels import CERTAIN_WEIGHT, DELTA_CHI2_95, MISFIT
from magloc.localization.fit.columns import Solutions
from magloc.localization.fit.gauss_newton import covariances
from magloc.localization.fit.optima import Optima
from magloc.localization.fit.refinement import rows_a_block
from magloc.localization.fit.results import is_misfit, is_observable, spans
from magloc.localization.uncertainty.ambiguity import (
    LARGEST_GAUSSIAN_SIGMA,
    LARGEST_RISE_ERROR,
    log_evidence_volume,
    longest_axes,
    relative_sigma,
    weights,
    widen,
)
from magloc.localization.uncertainty.moment_covariance import moment_covariances
from magloc.localization.uncertainty.range_interval import (
    OUTSIDE,
    detection_statistic,
    levels,
    ranges_of,
    relative_range_sigma,
    rise,
    union,
)
from magloc.localization.uncertainty.range_profile import profile_stretches, ranges_within

# Approximate number of linearisations for the profile of a fit.
_LINEARISATIONS = 20


class _FitColumns(NamedTuple):
    """Columns of :class:`Solutions` for f fits of K sources."""

    position_m: FloatArray
    moment_Am2: FloatArray
    ranges: FloatArray
    covariance: FloatArray
    gaussian: BoolArray
    weight: FloatArray


def solutions_of(optima: Optima, detected: BoolArray) -> Solutions:
    """Return the solutions of optima with a finite covariance."""
    model, fits = optima.rows.model, optima.fits
    n_fits, n_sources = fits.q.shape[:2]
    if optima.position_m is not None:
        known = _known_position_columns(optima, optima.position_m)
    elif n_sources > 1 or model.sees_moduli or model.known is not None or not model.has_kernels:
        known = fit_columns(optima, detected)
    else:
        known = single_source_columns(optima)
    of_moments, n_known = np.zeros(n_fits), np.zeros(n_fits, dtype=np.intp)
    if model.known is not None:
        moments = model.known.residual(known.moment_Am2)
        of_moments, n_known = np.sum(moments**2, axis=1), n_known + moments.shape[1]
    every = Solutions(
        of_row=optima.rows.index[optima.of_row],
        n_sources=np.full(n_fits, n_sources),
        position_m=known.position_m,
        moment_Am2=known.moment_Am2,
        covariance=known.covariance,
        chi2=fits.chi2 - of_moments,
        dof=np.full(n_fits, optima.dof),
        weight=known.weight,
        iterations=fits.iterations,
        ranges=known.ranges,
        gaussian=known.gaussian if optima.bent is False else known.gaussian & ~np.asarray(optima.bent)[..., None],
        merged=np.zeros((n_fits, n_sources), dtype=bool) | optima.merged,
        known_chi2=of_moments,
        n_known=n_known,
    )
    finite = np.isfinite(known.covariance)
    return every if np.count_nonzero(finite) == finite.size else every.select(np.asarray(finite.all(axis=(1, 2))))


def covariance_is_valid(optima: Optima, covariance: FloatArray, which: IntArray) -> BoolArray:
    """Return whether covariances (f, 6 K, 6 K) describe the errors of some fits.

    They do if χ² agrees with noise and rises by about one (0.5 to 1.5) at one standard deviation along the longest
    axis, on both sides. The second condition fails for strongly nonlinear readings. Without degrees of freedom χ² is
    not tested.
    """
    fits, of_row = optima.fits.rows(which), optima.of_row[which]
    problem, y = optima.rows.model.rows(of_row), optima.rows.y[of_row]
    dof = optima.dof + (0 if problem.known is None else fits.n_sources * problem.known.n_known)
    position, moment = problem.position(fits.q), problem.moment(fits.q, fits.mu)
    axis = longest_axes(covariance, position - problem.centroid, moment).reshape(*position.shape[:2], 2, 3)
    described = chdtrc(dof, fits.chi2) >= MISFIT if dof > 0 else np.ones(len(y), dtype=bool)
    for side in (axis, -axis):
        q = problem.homogeneous(position + side[:, :, 0])
        mu = problem.scaled_moment(q, moment + side[:, :, 1])
        residual = problem.residual(y, q, mu, problem.source_fields(q, mu))
        described &= np.abs(np.sum(residual**2, axis=1) - fits.chi2 - 1.0) <= LARGEST_RISE_ERROR
    return np.asarray(described)


def fit_columns(optima: Optima, detected: BoolArray) -> _FitColumns:
    """Return the columns of fits at unknown positions.

    The set of ranges of a single source follows from all solutions of its row together.
    """
    rows, fits, of_row = optima.rows, optima.fits, optima.of_row
    model = rows.model.rows(of_row)
    understated = _noise_factor(optima)[of_row]
    covariance = covariances(model, fits) * understated[:, None, None]
    position, moment = model.position(fits.q), model.moment(fits.q, fits.mu)
    offset = position - model.centroid
    # A known moment gives a length in whose units positions are uniform.
    volume = log_evidence_volume(covariance, moment, offset, scale_m=None if model.known is None else rows.model.radius)
    told = np.where(np.isfinite(covariance).all(axis=(1, 2)), fits.chi2 / understated, np.inf)
    weight = _weights_of_rows(of_row, told, volume)
    if fits.n_sources == 1:
        sets = _range_sets(optima, covariance, told, weight)[of_row, None]
    else:
        ends = [
            ranges_within(model, rows.y[of_row], fits, k, covariance, DELTA_CHI2_95 * understated)
            for k in range(fits.n_sources)
        ]
        sets = np.where(detected[of_row, None, None, None], np.stack(ends, axis=1)[:, :, None], [0.0, np.inf])
    low, high = np.moveaxis(spans(sets), -1, 0)
    observable = is_observable(low, high)
    gaussian = observable & (np.isfinite(sets[..., 0]).sum(axis=-1) == 1) & (weight >= CERTAIN_WEIGHT)[:, None]
    wide = covariance.copy()
    for k in range(fits.n_sources):
        sigma = relative_sigma(covariance[:, 6 * k :, 6 * k :], offset[:, k], moment[:, k])
        gaussian[:, k] &= sigma <= LARGEST_GAUSSIAN_SIGMA
        blurred = ~observable[:, k]
        wide[blurred] = widen(wide[blurred], offset[blurred, k], low[blurred, k], high[blurred, k], k)
    claimed = np.flatnonzero(gaussian.any(axis=1))
    if claimed.size:
        gaussian[claimed] &= covariance_is_valid(optima, covariance[claimed], claimed)[:, None]
    return _FitColumns(position, moment, sets, wide, gaussian, weight)


def _range_sets(optima: Optima, covariance: FloatArray, told: FloatArray, weight: FloatArray) -> FloatArray:
    """Return the 95 % range sets (b, i, 2) of single sources, over all solutions of a row."""
    rows, fits, of_row = optima.rows, optima.fits, optima.of_row
    shape, at = _places(of_row, len(rows))
    of_table, shares = np.full(shape, np.inf), np.zeros(shape)
    of_table[at], shares[at] = told, weight
    understated, best = _noise_factor(optima), _best_chi2(optima)
    raised = rise(rows.energy / understated, best / understated, rows.n_differences, levels(of_table, shares))
    left = (raised * understated)[of_row] - (fits.chi2 - best[of_row])
    inside = np.flatnonzero((left > 0.0) & np.isfinite(left))
    model, some = rows.model.rows(of_row[inside]), fits.rows(inside)
    sigma = relative_range_sigma(covariance[inside], model.position(some.q)[:, 0] - model.centroid)
    alpha = np.full((*shape, 2), np.nan)
    alpha[at[0][inside], at[1][inside]] = profile_stretches(model, rows.y[of_row[inside]], some, 0, sigma, left[inside])
    return union(np.where(np.isfinite(raised)[:, None, None], ranges_of(alpha, model.radius), [0.0, np.inf]))


def single_source_columns(optima: Optima) -> _FitColumns:
    """Return :func:`fit_columns` of single sources, by the kernel of vector sensors."""
    rows, fits, model = optima.rows, optima.fits, optima.rows.model
    n_fits = len(optima.of_row)
    first_fit = optima.of_row.searchsorted(np.arange(len(rows) + 1))
    most = max(1, int(np.maximum.reduce(first_fit[1:] - first_fit[:-1])))
    covariance, weight = np.empty((n_fits, 6, 6)), np.empty(n_fits)
    ranges, gaussian = np.empty((n_fits, 1, most, 2)), np.empty((n_fits, 1), dtype=bool)
    misfit, strengths, gained = _detection(rows.n_differences, optima.dof)
    work = core.problem(
        "source_uncertainty",
        channels=model.channels,
        most_fits=most,
        signals=rows.signals,
        energy=np.ascontiguousarray(rows.energy),
        first_fit=first_fit,
        row=np.ascontiguousarray(optima.of_row),
        q=np.ascontiguousarray(fits.q),
        mu=np.ascontiguousarray(fits.mu),
        chi2=np.ascontiguousarray(fits.chi2),
        detected=energy_threshold(rows.n_differences),
        misfit=misfit,
        dof=optima.dof,
        level=DELTA_CHI2_95,
        outside=OUTSIDE,
        certain_weight=CERTAIN_WEIGHT,
        largest_sigma=LARGEST_GAUSSIAN_SIGMA,
        largest_bend=LARGEST_RISE_ERROR,
        n_strengths=strengths.size,
        strengths=strengths,
        gained=gained,
        covariance=covariance,
        weight=weight,
        ranges=ranges,
        gaussian=gaussian.view(np.uint8),
    )
    block = rows_a_block(_LINEARISATIONS * rows.signals.shape[1])
    core.run("source_uncertainties", work, len(rows), block=block)
    unit = model.state_unit()
    covariance *= unit
    covariance *= unit[:, None]
    ranges *= model.radius
    position, moment = model.position(fits.q), model.moment(fits.q, fits.mu)
    return _FitColumns(position, moment, ranges, covariance, gaussian, weight)


@lru_cache(maxsize=64)
def _detection(n_differences: int, dof: int) -> tuple[float, FloatArray, FloatArray]:
    """Return χ² of a misfit, and the detection statistic over strengths, both ascending."""
    strength, left = detection_statistic(n_differences)
    return quantile(dof, MISFIT), strength, np.ascontiguousarray(-left)


def _best_chi2(optima: Optima) -> FloatArray:
    """Return χ² (b,) of the best fit of every row; infinite if there is none."""
    best = np.full(len(optima.rows), np.inf)
    rows, first = np.unique(optima.of_row, return_index=True)
    best[rows] = optima.fits.chi2[first]
    return best


def _noise_factor(optima: Optima) -> FloatArray:
    """Return the factor (b,) on the noise variance: χ²/dof for misfits, otherwise 1.

    Residuals of a wrong model are not noise, but σ from the stated noise alone would be worse.
    """
    chi2 = _best_chi2(optima)
    return np.where(np.isfinite(chi2) & is_misfit(chi2, optima.dof), chi2 / max(optima.dof, 1), 1.0)


def _known_position_columns(optima: Optima, position_m: FloatArray) -> _FitColumns:
    """Return the columns of moments at known positions (b, K, 3).

    The range is the length of the position.
    """
    rows, fits, of_row = optima.rows, optima.fits, optima.of_row
    model, position, moment = rows.model, position_m[of_row], rows.model.moment(fits.q, fits.mu)
    understated = _noise_factor(optima)[of_row]
    covariance = moment_covariances(model.rows(of_row), rows.y[of_row], fits) * understated[:, None, None]
    told = np.where(np.isfinite(covariance).all(axis=(1, 2)), fits.chi2 / understated, np.inf)
    weight = _weights_of_rows(of_row, told, log_evidence_volume(covariance, moment))
    # Readings of vector sensors are linear in the moment, moduli only over small changes of it.
    with np.errstate(invalid="ignore", divide="ignore"):
        variance = np.diagonal(covariance, axis1=1, axis2=2).reshape(moment.shape).sum(axis=2)
        sigma = np.sqrt(variance) / np.linalg.norm(moment, axis=2)
    gaussian = (sigma <= LARGEST_GAUSSIAN_SIGMA) | (not model.channel_is_scalar.any())
    distances = np.linalg.norm(position - model.centroid, axis=-1)
    return _FitColumns(position, moment, np.tile(distances[:, :, None, None], 2), covariance, gaussian, weight)


def _places(of_row: IntArray, n_rows: int) -> tuple[tuple[int, int], tuple[IntArray, IntArray]]:
    """Return the shape of a table of the fits of every row, and the indices of fits in it."""
    place = np.arange(len(of_row)) - np.searchsorted(of_row, of_row)
    return (n_rows, int(place.max(initial=0)) + 1), (of_row, place)


def _weights_of_rows(of_row: IntArray, chi2: FloatArray, volume: FloatArray) -> FloatArray:
    """Return :func:`weights` (f,) among the fits of every row."""
    shape, at = _places(of_row, int(of_row.max(initial=-1)) + 1)
    of_table, volumes = np.full(shape, np.inf), np.zeros(shape)
    of_table[at], volumes[at] = chi2, volume
    return weights(of_table, volumes)[at]
