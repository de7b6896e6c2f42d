"""How well the sources of optima are known: covariances, sets of ranges, and weights of the solutions.

Of a single source all solutions of a row are taken together (:mod:`magloc.localization.uncertainty.range_interval`).
Several sources have no common range: each has its own ranges in each solution, where the profile of χ² stays within
3.84 of that solution.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.special import chdtrc, chdtri

from arrays.typing import BoolArray, FloatArray, IntArray
from magloc import core
from magloc.chi_square import energy_threshold
from magloc.fields.dipole import MU0_OVER_4PI
from magloc.levels import CERTAIN_WEIGHT, DELTA_CHI2_95, MISFIT
from magloc.localization.fit.columns import Solutions
from magloc.localization.fit.gauss_newton import covariances
from magloc.localization.fit.optima import Optima
from magloc.localization.fit.refinement import rows_a_block
from magloc.localization.fit.results import is_misfit, is_observable
from magloc.localization.uncertainty.ambiguity import (
    LARGEST_BEND,
    LARGEST_GAUSSIAN_SIGMA,
    Rivals,
    log_evidence_volume,
    longest_axes,
    relative_sigma,
    weights,
    widened,
)
from magloc.localization.uncertainty.moment_covariance import moment_covariances
from magloc.localization.uncertainty.range_interval import OUTSIDE, left_of_detected, relative_range_sigma
from magloc.localization.uncertainty.range_profile import profile_stretches, ranges_within
from magloc.measurement.whitened import WhitenedModel

# Linearisations that the profile of a fit takes, roughly.
_LINEARISATIONS = 20


class _Known(NamedTuple):
    """What is known of f fits of K sources: the columns of :class:`Solutions` of these names."""

    position_m: FloatArray
    moment_Am2: FloatArray
    ranges: FloatArray
    covariance: FloatArray
    gaussian: BoolArray
    weight: FloatArray


def solutions_of(optima: Optima, detected: BoolArray) -> Solutions:
    """Solutions of the rows of optima: those whose covariance is finite, with what is known of them."""
    model, fits = optima.rows.model, optima.fits
    n_fits, n_sources = fits.q.shape[:2]
    if optima.position_m is not None:
        known = _of_known_position(optima, optima.position_m)
    elif n_sources > 1:
        known = _of_several(optima, detected)
    else:
        kernel = not model.sees_moduli and model.known is None
        known = known_of_one_compiled(optima) if kernel else known_of_one(optima)
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
    return every if np.count_nonzero(finite) == finite.size else every.chosen(np.asarray(finite.all(axis=(1, 2))))


def covariance_is_valid(optima: Optima, covariance: FloatArray, which: IntArray) -> BoolArray:
    """Whether covariances (f, 6 K, 6 K) of some fits describe their errors, as far as the model tells.

    They do where χ² is one of noise, and rises by one, give or take a half, at one standard deviation along the longest
    axis, to either side: not where the errors follow a curve. With no degrees of freedom every χ² is as it must be.
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
        described &= np.abs(np.sum(residual**2, axis=1) - fits.chi2 - 1.0) <= LARGEST_BEND
    return np.asarray(described)


def known_of_one(optima: Optima) -> _Known:
    """What is known of single sources, all solutions of a row together."""
    rows, fits, of_row = optima.rows, optima.fits, optima.of_row
    model, shape, at = rows.model, *_places(of_row, len(rows))

    def table(values: FloatArray, empty: float) -> FloatArray:
        full = np.full((*shape, *values.shape[1:]), empty)
        full[at] = values
        return full

    q, mu, chi2 = table(fits.q[:, 0], np.nan), table(fits.mu[:, 0], np.nan), table(fits.chi2, np.inf)
    position, moment = model.position(q), model.moment(q, mu)
    offset = position - model.centroid
    understated = _understated(chi2[:, 0], optima)
    covariance = table(covariances(model.rows(of_row), fits), np.nan) * understated[:, None, None, None]
    rivals = Rivals.of(
        chi2 / understated[:, None],
        covariance,
        offset,
        moment,
        rows.energy / understated,
        rows.n_differences,
        _scale_m(model),
    )
    alpha = np.full((*shape, 2), np.nan)
    left = (rivals.rise * understated)[of_row] - (fits.chi2 - chi2[of_row, 0])
    inside = np.flatnonzero((left > 0.0) & np.isfinite(left))
    sigma = relative_range_sigma(covariance[at], offset[at])
    alpha[of_row[inside], at[1][inside]] = profile_stretches(
        model.rows(of_row[inside]), rows.y[of_row[inside]], fits.rows(inside), 0, sigma[inside], left[inside]
    )
    ranges = rivals.ranges(alpha, model.radius)
    gaussian = ranges.gaussian[at]
    claimed = np.flatnonzero(gaussian)
    if claimed.size:
        gaussian[claimed] = covariance_is_valid(optima, covariance[at][claimed], claimed)
    places = position[at][:, None], moment[at][:, None]
    return _Known(*places, ranges.sets[of_row, None], ranges.covariance[at], gaussian[:, None], rivals.weight[at])


def known_of_one_compiled(optima: Optima) -> _Known:
    """Return :func:`known_of_one` of vector sensors, by the kernel."""
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
        largest_bend=LARGEST_BEND,
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
    unit = np.array(3 * [model.radius] + 3 * [model.radius**3 / MU0_OVER_4PI])
    covariance *= unit
    covariance *= unit[:, None]
    ranges *= model.radius
    position, moment = model.position(fits.q), model.moment(fits.q, fits.mu)
    return _Known(position, moment, ranges, covariance, gaussian, weight)


@lru_cache(maxsize=64)
def _detection(n_differences: int, dof: int) -> tuple[float, FloatArray, FloatArray]:
    """Return χ² of a misfit, and what the detection of a signal tells of its strength: both columns ascending."""
    strength, left = left_of_detected(n_differences)
    return float(chdtri(dof, MISFIT)) if dof > 0 else math.inf, strength, np.ascontiguousarray(-left)


def _understated(chi2: FloatArray, optima: Optima) -> FloatArray:
    """By how much the variance of noise is understated (b,): χ² per degree of freedom of rows that are misfits, else 1.

    What a wrong model leaves is no noise, but σ that knew only the noise would be worse.
    """
    return np.where(np.isfinite(chi2) & is_misfit(chi2, optima.dof), chi2 / max(optima.dof, 1), 1.0)


def _scale_m(model: WhitenedModel) -> float | None:
    """A length in whose units positions are uniform, where the moment is known and gives one."""
    return model.radius if model.known is not None else None


def _of_several(optima: Optima, detected: BoolArray) -> _Known:
    """What is known of several sources: every one has a range of its own in every solution."""
    rows, fits, of_row = optima.rows, optima.fits, optima.of_row
    model, y = rows.model.rows(of_row), rows.y[of_row]
    understated = _understated(fits.chi2[np.searchsorted(of_row, of_row)], optima)
    covariance = covariances(model, fits) * understated[:, None, None]
    position, moment = model.position(fits.q), model.moment(fits.q, fits.mu)
    offset = position - model.centroid
    n_fits, n_sources = offset.shape[:2]
    wide = covariance.copy()
    sets = np.empty((n_fits, n_sources, 1, 2))
    gaussian = np.zeros((n_fits, n_sources), dtype=bool)
    for k in range(n_sources):
        ends = ranges_within(model, y, fits, k, covariance, DELTA_CHI2_95 * understated)
        sets[:, k, 0] = np.where(detected[of_row, None], ends, [0.0, np.inf])
        low, high = sets[:, k, 0].T
        observable = is_observable(low, high)
        sigma = relative_sigma(covariance[:, 6 * k :, 6 * k :], offset[:, k], moment[:, k])
        gaussian[:, k] = observable & (sigma <= LARGEST_GAUSSIAN_SIGMA)
        blurred = ~observable
        wide[blurred] = widened(wide[blurred], offset[blurred, k], low[blurred], high[blurred], k)
    chi2 = np.where(np.isfinite(covariance).all(axis=(1, 2)), fits.chi2 / understated, np.inf)
    weight = _weights_of_rows(of_row, chi2, log_evidence_volume(covariance, moment, offset, scale_m=_scale_m(model)))
    gaussian &= (weight >= CERTAIN_WEIGHT)[:, None]
    claimed = np.flatnonzero(gaussian.any(axis=1))
    gaussian[claimed] &= covariance_is_valid(optima, covariance[claimed], claimed)[:, None]
    return _Known(position, moment, sets, wide, gaussian, weight)


def _of_known_position(optima: Optima, position_m: FloatArray) -> _Known:
    """What is known of moments at known places (b, K, 3); the range is that of the place."""
    rows, fits, of_row = optima.rows, optima.fits, optima.of_row
    model, position, moment = rows.model, position_m[of_row], rows.model.moment(fits.q, fits.mu)
    understated = _understated(fits.chi2[np.searchsorted(of_row, of_row)], optima)
    covariance = moment_covariances(model.rows(of_row), rows.y[of_row], fits) * understated[:, None, None]
    told = np.where(np.isfinite(covariance).all(axis=(1, 2)), fits.chi2 / understated, np.inf)
    weight = _weights_of_rows(of_row, told, log_evidence_volume(covariance, moment))
    # The readings of vector sensors are linear in the moment, those of moduli only over a small part of it.
    with np.errstate(invalid="ignore", divide="ignore"):
        variance = np.diagonal(covariance, axis1=1, axis2=2).reshape(moment.shape).sum(axis=2)
        sigma = np.sqrt(variance) / np.linalg.norm(moment, axis=2)
    gaussian = (sigma <= LARGEST_GAUSSIAN_SIGMA) | (not model.channel_is_scalar.any())
    distances = np.linalg.norm(position - model.centroid, axis=-1)
    return _Known(position, moment, np.tile(distances[:, :, None, None], 2), covariance, gaussian, weight)


def _places(of_row: IntArray, n_rows: int) -> tuple[tuple[int, int], tuple[IntArray, IntArray]]:
    """Shape of a table of the fits of every row, and the places of the fits in it."""
    place = np.arange(len(of_row)) - np.searchsorted(of_row, of_row)
    return (n_rows, int(place.max(initial=0)) + 1), (of_row, place)


def _weights_of_rows(of_row: IntArray, chi2: FloatArray, volume: FloatArray) -> FloatArray:
    """:func:`weights` (f,) among the fits of every row."""
    shape, at = _places(of_row, int(of_row.max(initial=-1)) + 1)
    of_table, volumes = np.full(shape, np.inf), np.zeros(shape)
    of_table[at], volumes[at] = chi2, volume
    return weights(of_table, volumes)[at]
