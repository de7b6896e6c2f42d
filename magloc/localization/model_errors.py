r"""Model errors of a fit: extended bodies and an inexact ambient field.

Their effect on the readings at the fit counts as noise, and the fit is refined with this noise fixed. A modulus reads
the component of an ambient field's error along the total field at its sensor. The source turns this direction, so the
error does not cancel in differences. A body's second and fourth moments of magnetisation are unknown, with standard
deviations that grow with its length L: :math:`0.025 L^2` and :math:`0.0015 L^4` for each of 5 and 9 orthonormal
components, as for bars, discs and cuboids. Their field has rank 14 for every source: docs/theory/extended-sources.md.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from arrays.typing import BoolArray, FloatArray, IntArray
from magloc.fields.multipole import NEAR, assumed_body_lengths, finite_body_errors
from magloc.localization.fit.gauss_newton import JointFits, refine
from magloc.localization.fit.optima import Optima
from magloc.measurement.magnet import MagnetModel
from magloc.measurement.whitened import WhitenedModel

# Value of |s| of unit q = (u, s) below which the source is farther than NEAR from every sensor.
_FAR_S = 1.0 / math.hypot(1.0, 1.0 + NEAR)
# Negligible variance of a body's deviation from a dipole, summed over the channels in units of the noise.
_NEGLIGIBLE = 0.1
_ROUNDS = 3
# Second-order effect of the ambient field's error, in σ of a reading, above which errors are not Gaussian.
_BENT = 0.3


def body_errors(model: WhitenedModel, q: FloatArray, mu: FloatArray, length_m: FloatArray) -> FloatArray:
    """Return errors (b, C, 14 K) of readings by bodies (b, K), in units of the noise.

    Each column is the effect of one σ.
    """
    sensors = model.centroid + model.radius * model.sensors
    separation = sensors - model.position(q)[:, :, None]
    moment = np.broadcast_to(model.moment(q, mu)[:, :, None], separation.shape)
    fields = finite_body_errors(separation, moment, length_m[..., None, None, None])
    # Three columns for each sensor.
    gain = np.zeros((len(q), 1, 3 * len(sensors), 3))
    owner = model.channel_sensor
    place = 3 * owner + np.arange(owner.size) - np.searchsorted(owner, owner)
    gain[:, 0, place] = model.linear_gain(model.source_fields(q, mu))
    columns = gain.reshape(len(q), 1, len(sensors), 3, 3) @ fields
    n_sources, n_errors = q.shape[1], columns.shape[-1]
    columns = columns.reshape(len(q), n_sources, 3 * len(sensors), n_errors)[:, :, place].transpose(0, 2, 1, 3)
    return columns.reshape(len(q), place.size, n_sources * n_errors)


def assumed_lengths(model: WhitenedModel, q: FloatArray, body_length_m: float | None) -> FloatArray:
    """Return the lengths (b, K) of bodies at q (b, K, 4): stated, or a share of the distance."""
    sensors = model.centroid + model.radius * model.sensors
    return assumed_body_lengths(sensors, model.position(q), model.radius, body_length_m)


def ambient_errors(model: WhitenedModel, q: FloatArray, mu: FloatArray, sigma_T: float) -> FloatArray:
    """Return errors (b, C, 3) of moduli by the ambient field, one σ per axis.

    In units of the noise.
    """
    gain = model.linear_gain(model.source_fields(q, mu))
    return sigma_T * np.where(model.channel_is_scalar[:, None], gain, 0.0)


def with_model_errors(
    optima: Optima, body_length_m: float | None, ambient_sigma_T: float = 0.0
) -> list[tuple[Optima, FloatArray]]:
    """Return optima refined with model errors, and body lengths (b,), 0 if the body does not matter."""
    rows, none = optima.rows, np.zeros(len(optima.rows))
    point = body_length_m == 0.0 or (body_length_m is None and _is_far(optima.fits.q))
    ambient_sigma_T = ambient_sigma_T if rows.model.sees_moduli else 0.0
    if (point and not ambient_sigma_T) or optima.position_m is not None or not len(optima.of_row):
        return [(optima, none)]
    first = np.searchsorted(optima.of_row, np.arange(len(rows)))
    solved = np.flatnonzero(np.bincount(optima.of_row, minlength=len(rows)))
    best, model = optima.fits.rows(first[solved]), rows.model.rows(solved)
    lengths = np.zeros((len(rows), optima.fits.n_sources))
    known: FloatArray | None = None
    if not point:
        lengths[solved] = assumed_lengths(rows.model, best.q, body_length_m)
        near = np.flatnonzero(lengths[solved].any(axis=1))
        errors = body_errors(model.rows(near), best.q[near], best.mu[near], lengths[solved[near]])
        negligible = np.sum(model.rows(near).whiten(errors) ** 2, axis=(1, 2)) <= _NEGLIGIBLE
        lengths[solved[near[negligible]]] = 0.0
        known = None if ambient_sigma_T else errors[~negligible]
    matters: BoolArray = np.asarray(lengths.any(axis=1))
    matters[solved] |= ambient_sigma_T > 0.0
    if not matters.any():
        return [(optima, none)]
    refined = _refine(optima.select(matters), lengths[matters], ambient_sigma_T, known)
    # If the refined fits of a row did not converge, the fits of a point in a known field remain.
    lost = np.bincount(refined.of_row, minlength=len(refined.rows)) == 0
    matters[np.flatnonzero(matters)[lost]] = False
    result = [(refined.select(~lost), lengths[matters].max(axis=1))] if matters.any() else []
    if not matters.all():
        result.append((optima.select(~matters), none[~matters]))
    return result


def _is_far(q: FloatArray) -> bool:
    """Return whether all sources are far from every sensor, by a cheap test of the centroid."""
    s = q[..., 3]
    return np.count_nonzero(np.abs(s) < _FAR_S) == s.size


def _refine(optima: Optima, lengths: FloatArray, ambient_sigma_T: float, errors: FloatArray | None) -> Optima:
    """Refine optima with errors linearised at the best fit of every row, twice.

    `errors` are those at the first best fits, if they are known already.
    """
    fits, rows = optima.fits, optima.rows
    merged = np.broadcast_to(optima.merged, fits.mu.shape[:2])
    for _ in range(_ROUNDS):
        if errors is None:
            best = fits.rows(np.searchsorted(optima.of_row, np.arange(len(rows))))
            errors = model_errors(optima.rows.model, best.q, best.mu, lengths, ambient_sigma_T)
        rows, errors = optima.rows.marginalise(errors), None
        start = fits
        fits = refine(rows.model.rows(optima.of_row), rows.y[optima.of_row], start.q, start.mu)
        fits = replace(fits, iterations=fits.iterations + start.iterations)
        order = np.lexsort((fits.chi2, optima.of_row))
        fits, merged = fits.rows(order), merged[order]
    kept = fits.converged
    return replace(
        optima,
        rows=rows,
        fits=fits.rows(kept),
        of_row=optima.of_row[kept],
        merged=merged[kept],
        bent=_is_nonlinear(rows.model, fits, optima.of_row, ambient_sigma_T)[kept],
    )


def model_errors(
    model: WhitenedModel, q: FloatArray, mu: FloatArray, length_m: FloatArray, ambient_sigma_T: float
) -> FloatArray:
    """Return errors by bodies or rolls and by the ambient field, (b, C, n) in units of the noise."""
    parts = [model.roll_errors(q, mu)] if isinstance(model, MagnetModel) else []
    if length_m.any():
        parts.append(body_errors(model, q, mu, length_m))
    if ambient_sigma_T:
        parts.append(ambient_errors(model, q, mu, ambient_sigma_T))
    return np.concatenate(parts, axis=-1)


def _is_nonlinear(model: WhitenedModel, fits: JointFits, of_row: IntArray, ambient_sigma_T: float) -> BoolArray:
    """Return in which fits (f,) the second-order effect of the ambient field's error on moduli exceeds noise."""
    if not ambient_sigma_T:
        return np.zeros(len(of_row), dtype=bool)
    at = model.rows(of_row)
    fields = at.source_fields(fits.q, fits.mu)
    share = np.linalg.norm(fields, axis=-1) / np.sum((fields + at.ambient) ** 2, axis=-1)
    return np.asarray(
        np.max(share[:, at.channel_sensor] * np.abs(at.gain[..., 0]), axis=1) * ambient_sigma_T**2 > _BENT
    )
