"""Fit of a magnet of known shape, from the dipoles that fit its readings.

A dipole in place of a magnet that is nearer than a few of its lengths is off by a few hundredths of its distance, which
serves as a start. From it a damped Gauss-Newton iteration has the exact field. The roll of a cuboid counts as noise,
linearised at the best fit as in :mod:`magloc.localization.model_errors`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from arrays.typing import FloatArray
from magloc.fields.shapes import Shape
from magloc.localization.fit.gauss_newton import first_equal, refine
from magloc.localization.fit.optima import Optima
from magloc.localization.fit.prior import SourcePrior
from magloc.localization.fit.results import DISTINCT_WITHIN
from magloc.measurement.magnet import MagnetModel

SENSOR_INSIDE = "the readings put a sensor inside the magnet: its stated size is too large, or its shape is another one"
_ROUNDS = 5
# Factor on the distance from the sensors, and number of times, to move a start out of them.
_AWAY, _MOST_MOVES = 1.25, 12
# Distances of the starts of every row, relative to those of its dipoles.
_RANGES = (1.0, 1.15)
# Differences of coordinates q, and of relative strength, below which optima are one.
_SAME_PLACE, _SAME_STRENGTH = 1e-4, 1e-3


def fit_magnet(optima: Optima, magnet: Shape, prior: SourcePrior) -> Optima:
    """Return the optima of a magnet, from those of dipoles, sorted by row and then by χ²."""
    model = MagnetModel.near(optima.rows.model, magnet)
    rows = exact = replace(optima.rows, model=model)
    ranges = _RANGES if optima.fits.n_sources == 1 else _RANGES[:1]
    of_row = np.repeat(optima.of_row, len(ranges))
    q, mu = (np.repeat(values, len(ranges), axis=0) for values in (optima.fits.q, optima.fits.mu))
    q, mu = _outside(model.rows(of_row), q, mu, np.tile(ranges, len(optima.of_row)))
    fits = refine(model.rows(of_row), exact.y[of_row], q, mu)
    for _ in range(_ROUNDS if magnet.kind == "cuboid" else 0):
        # The roll at the best fit of each row: from its harmonics at first, then marginalised about its last value.
        best = np.lexsort((fits.chi2, of_row))[np.searchsorted(of_row, np.arange(len(rows)))]
        q, mu = fits.q[best], fits.mu[best]
        model = model.with_roll(q, mu, exact.y)
        columns = model.roll_errors(q, mu)
        rows, before = replace(exact, model=model).marginalise(np.where(np.isfinite(columns), columns, 0.0)), fits
        fits = refine(rows.model.rows(of_row), rows.y[of_row], before.q, before.mu)
        fits = replace(fits, iterations=fits.iterations + before.iterations)
    # A fit that had to leave a sensor inside the magnet, and is worse than the dipole there, explains nothing.
    inside = np.isnan(exact.model.rows(optima.of_row).source_fields(optima.fits.q, optima.fits.mu)).any(axis=(1, 2))
    allowed = prior.allows(rows.model, fits.q, fits.mu).all(axis=-1)
    allowed &= ~np.repeat(inside, len(ranges)) | (fits.chi2 <= np.repeat(optima.fits.chi2, len(ranges)))
    chi2 = np.where(allowed, fits.chi2, np.inf)
    lowest = np.full(len(rows), np.inf)
    np.minimum.at(lowest, of_row, chi2)
    order = np.lexsort((chi2, of_row))
    kept = order[np.isfinite(chi2[order]) & (chi2[order] <= lowest[of_row[order]] + DISTINCT_WITHIN)]
    strength = np.linalg.norm(fits.mu[kept], axis=-1)
    first = first_equal(of_row[kept], fits.q[kept], strength, _SAME_PLACE, _SAME_STRENGTH)
    kept = kept[first == np.arange(len(kept))]
    reason = [
        reason or ("" if np.isfinite(best) else SENSOR_INSIDE)
        for reason, best in zip(optima.reason, lowest, strict=True)
    ]
    return replace(optima, rows=rows, fits=fits.rows(kept), of_row=of_row[kept], reason=reason, merged=False)


def _outside(model: MagnetModel, q: FloatArray, mu: FloatArray, factor: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return starts at so many times their distance from the nearest sensor, and farther until all are outside."""
    sensors, position, moment = model.centroid + model.radius * model.sensors, model.position(q), model.moment(q, mu)
    distance = np.linalg.norm(position[:, :, None] - sensors, axis=-1)
    nearest = sensors[np.argmin(distance, axis=-1)]
    grown = factor[:, None]
    for _ in range(_MOST_MOVES):
        position, moment = nearest + grown[..., None] * (position - nearest), grown[..., None] ** 3 * moment
        q = model.homogeneous(position)
        mu = model.scaled_moment(q, moment)
        inside = np.isnan(model.source_fields(q, mu)).any(axis=(1, 2))
        if not inside.any():
            break
        grown = np.where(inside, _AWAY, 1.0)[:, None]
    return q, mu
