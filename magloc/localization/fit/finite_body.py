r"""Fits of bodies that are not small against their distance: what a dipole leaves out of their field counts as noise.

A body's second and fourth moments of magnetisation are unknown, with standard deviations that grow with its length L:
:math:`0.025 L^2` and :math:`0.0015 L^4` for each of 5 and 9 orthonormal components, those of bars, discs and cuboids.
Their field at the fit, of rank 14 for every source, is held while the fit is refined: docs/theory/extended-sources.md.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from arrays.typing import FloatArray
from magloc.fields.multipole import finite_body_fields
from magloc.localization.fit.gauss_newton import refine
from magloc.localization.fit.optima import Optima
from magloc.measurement.whitened import WhitenedModel

DEFAULT_LENGTH = 0.25
"""Length over the distance from the nearest sensor that is assumed of a body of which nothing is said."""
# Standard deviations of a component of the moments of rank 2 and 4, over L² and L⁴.
_SIGMA = {2: 0.025, 4: 0.0015}
# Sensors that are nearer than this, in circumradii of the array, where a body of default length is assumed. A source
# that a single sensor is near to may be a fault of it.
_NEAR, _N_NEAR = 0.6, 4
# Variance of what a dipole leaves out, summed over the channels in units of the noise, that does not matter.
_NEGLIGIBLE = 0.1
_ROUNDS = 3


def body_errors(model: WhitenedModel, q: FloatArray, mu: FloatArray, length_m: FloatArray) -> FloatArray:
    """What bodies (b, K) of some lengths add to the readings, of one σ: (b, C, 14 K) in units of the noise."""
    sensors = model.centroid + model.radius * model.sensors
    separation = sensors - model.position(q)[:, :, None]
    moment = np.broadcast_to(model.moment(q, mu)[:, :, None], separation.shape)
    length = length_m[..., None, None, None]
    fields = np.concatenate(
        [sigma * length**rank * finite_body_fields(separation, moment, rank) for rank, sigma in _SIGMA.items()], axis=-1
    )
    gain = model.linear_gain(model.source_fields(q, mu))
    columns = np.einsum("bcj,bkcjn->bckn", gain, fields[:, :, model.channel_sensor], optimize=True)
    return columns.reshape(*gain.shape[:2], -1)


def assumed_lengths(model: WhitenedModel, q: FloatArray, body_length_m: float | None) -> FloatArray:
    """Lengths (b, K) of the bodies at q (b, K, 4): what is said, else a share of the distance near the array."""
    if body_length_m is not None:
        return np.full(q.shape[:2], body_length_m)
    sensors = model.centroid + model.radius * model.sensors
    distance = np.linalg.norm(model.position(q)[:, :, None] - sensors, axis=-1)
    last = min(_N_NEAR, len(sensors)) - 1
    ordered = np.partition(distance, [0, last], axis=-1)
    return np.where(ordered[..., last] < _NEAR * model.radius, DEFAULT_LENGTH * ordered[..., 0], 0.0)


def as_finite_bodies(optima: Optima, body_length_m: float | None) -> list[tuple[Optima, FloatArray]]:
    """Optima refined as those of bodies, with the lengths (b,) that matter in their rows, 0 where none does."""
    rows, none = optima.rows, np.zeros(len(optima.rows))
    if body_length_m == 0.0 or optima.position_m is not None or (body_length_m is None and _all_far(optima.fits.q)):
        return [(optima, none)]
    first = np.searchsorted(optima.of_row, np.arange(len(rows)))
    solved = np.flatnonzero(np.bincount(optima.of_row, minlength=len(rows)))
    if not solved.size:
        return [(optima, none)]
    best = optima.fits.rows(first[solved])
    lengths = assumed_lengths(rows.model, best.q, body_length_m)
    near = np.flatnonzero(lengths.any(axis=1))
    at = solved[near]
    matters = np.zeros(len(rows), dtype=bool)
    if near.size:
        errors = body_errors(rows.model.rows(at), best.q[near], best.mu[near], lengths[near])
        matters[at] = np.sum(rows.model.rows(at).whitened(errors) ** 2, axis=(1, 2)) > _NEGLIGIBLE
    if not matters.any():
        return [(optima, none)]
    of_row = np.zeros((len(rows), lengths.shape[1]))
    of_row[solved] = lengths
    finite = _refined(optima.chosen(matters), of_row[matters])
    # A row of which no fit converged again stays that of a point.
    lost = np.bincount(finite.of_row, minlength=len(finite.rows)) == 0
    matters[np.flatnonzero(matters)[lost]] = False
    result = [(finite.chosen(~lost), of_row[matters].max(axis=1))] if matters.any() else []
    if not matters.all():
        result.append((optima.chosen(~matters), none[~matters]))
    return result


def _all_far(q: FloatArray) -> bool:
    """Whether all sources are so far from the centroid that they are near to no sensor: most of them, cheaply."""
    u = q[..., :3]
    return bool(np.all(np.sum(u * u, axis=-1) > ((1.0 + _NEAR) * q[..., 3]) ** 2))


def _refined(optima: Optima, lengths: FloatArray) -> Optima:
    """Optima of rows with bodies (b, K), linearised at the best fit of every row, refined, linearised there again."""
    fits, rows = optima.fits, optima.rows
    merged = np.broadcast_to(optima.merged, fits.mu.shape[:2])
    for _ in range(_ROUNDS):
        best = fits.rows(np.searchsorted(optima.of_row, np.arange(len(rows))))
        rows = optima.rows.marginalised(body_errors(optima.rows.model, best.q, best.mu, lengths))
        start = fits
        fits = refine(rows.model.rows(optima.of_row), rows.y[optima.of_row], start.q, start.mu)
        fits = replace(fits, iterations=fits.iterations + start.iterations)
        order = np.lexsort((fits.chi2, optima.of_row))
        fits, merged = fits.rows(order), merged[order]
    kept = fits.converged
    return replace(optima, rows=rows, fits=fits.rows(kept), of_row=optima.of_row[kept], merged=merged[kept])
