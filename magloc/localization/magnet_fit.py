"""Fit of a magnet of known shape, from the dipoles that fit its readings.

If a dipole is fitted to a magnet nearer than a few of its lengths, its place is wrong by a few hundredths of the
distance. It serves as a start. From it a damped Gauss-Newton iteration has the exact field. The roll of a cuboid counts
as noise, linearised at the best fit as in :mod:`magloc.localization.model_errors`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from arrays.typing import BoolArray, FloatArray, IntArray
from magloc.fields.shapes import Shape
from magloc.localization.fit.gauss_newton import first_equal, refine
from magloc.localization.fit.optima import Optima
from magloc.localization.fit.prior import SourcePrior
from magloc.localization.fit.results import DISTINCT_WITHIN
from magloc.localization.search.single_source import NOT_ALLOWED
from magloc.measurement.magnet import MagnetModel

SENSOR_INSIDE = "the readings put a sensor inside the magnet: its stated size is too large, or its shape is another one"
DIVERGED = "the fit of the magnet did not converge from any dipole"
_ROUNDS, _SAME_ROLL_RAD = 5, 1e-4
# Factor on the distance from the sensors, and number of times, to move a start out of them.
_AWAY, _MOST_MOVES = 1.25, 12
# Differences of coordinates q, and of relative strength, below which optima are one.
_SAME_PLACE, _SAME_STRENGTH = 1e-4, 1e-3


def fit_magnet(optima: Optima, magnet: Shape, prior: SourcePrior) -> Optima:
    """Return the optima of a magnet, from those of dipoles, sorted by row and then by χ²."""
    model = MagnetModel.near(optima.rows.model, magnet)
    rows = exact = replace(optima.rows, model=model)
    of_row: IntArray = optima.of_row
    if not of_row.size:
        return replace(optima, rows=exact)
    first_of_row = np.minimum(np.searchsorted(of_row, np.arange(len(rows))), of_row.size - 1)
    q, mu = _outside(model.rows(of_row), optima.fits.q, optima.fits.mu)
    fits = refine(model.rows(of_row), exact.y[of_row], q, mu)
    for _ in range(_ROUNDS if magnet.kind == "cuboid" else 0):
        # The roll at the best fit of each row: from its harmonics at first, then marginalised about its last value.
        best = np.lexsort((fits.chi2, of_row))[first_of_row]
        q, mu = fits.q[best], fits.mu[best]
        turned = model.with_roll(q, mu, exact.y)
        if model.roll_rad is not None and turned.roll_rad is not None:
            step = np.abs(turned.roll_rad - model.roll_rad)
            if not (step > _SAME_ROLL_RAD).any():
                break
        model = turned
        columns = model.roll_errors(q, mu)
        rows, before = replace(exact, model=model).marginalise(np.where(np.isfinite(columns), columns, 0.0)), fits
        fits = refine(rows.model.rows(of_row), rows.y[of_row], before.q, before.mu)
        fits = replace(fits, iterations=fits.iterations + before.iterations)
    # A fit that had to leave a sensor inside the magnet, and is worse than the dipole there, explains nothing.
    fields = exact.model.rows(of_row).source_fields(optima.fits.q, optima.fits.mu)
    inside: BoolArray = np.asarray(np.isnan(fields).any(axis=(1, 2)))
    outside = ~inside | (fits.chi2 <= optima.fits.chi2)
    chi2 = np.where(outside & prior.allows(rows.model, fits.q, fits.mu).all(axis=-1), fits.chi2, np.inf)
    lowest = np.full(len(rows), np.inf)
    np.minimum.at(lowest, of_row, chi2)
    order = np.lexsort((chi2, of_row))
    kept = order[np.isfinite(chi2[order]) & (chi2[order] <= lowest[of_row[order]] + DISTINCT_WITHIN)]
    strength = np.linalg.norm(fits.mu[kept], axis=-1)
    first = first_equal(of_row[kept], fits.q[kept], strength, _SAME_PLACE, _SAME_STRENGTH)
    kept = kept[first == np.arange(len(kept))]
    reason, solved = list(optima.reason), np.asarray(fits.converged & outside)
    for row in np.flatnonzero(~np.isfinite(lowest)).tolist():
        of_fits = np.flatnonzero(of_row == row)
        unsolved = SENSOR_INSIDE if inside[of_fits].any() else DIVERGED
        reason[row] = reason[row] or (NOT_ALLOWED if solved[of_fits].any() else unsolved)
    return replace(optima, rows=rows, fits=fits.rows(kept), of_row=of_row[kept], reason=reason, merged=False)


def _outside(model: MagnetModel, q: FloatArray, mu: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return starts moved away from their nearest sensors until no sensor is inside a magnet."""
    sensors, position, moment = model.centroid + model.radius * model.sensors, model.position(q), model.moment(q, mu)
    distance = np.linalg.norm(position[:, :, None] - sensors, axis=-1)
    nearest = sensors[np.argmin(distance, axis=-1)]
    for _ in range(_MOST_MOVES):
        inside = np.isnan(model.source_fields(q, mu)).any(axis=(1, 2))
        if not inside.any():
            break
        grown = np.where(inside, _AWAY, 1.0)[:, None, None]
        position, moment = nearest + grown * (position - nearest), grown**3 * moment
        q = model.homogeneous(position)
        mu = model.scaled_moment(q, moment)
    return q, mu
