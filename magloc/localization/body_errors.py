"""Errors of point fixes if the objects are in fact bodies of the default length.

χ² does not reveal a body that is farther away than two of its lengths: the difference from a dipole's field looks like
a shift and a rotation. If noise is small compared with the field, this error is far larger than the standard deviations
of a point fix.
"""

from __future__ import annotations

import numpy as np

from arrays.array import SensorArray
from arrays.typing import BoolArray, FloatArray, IntArray
from magloc.fields.multipole import DEFAULT_LENGTH
from magloc.localization.fit.columns import Solutions
from magloc.localization.fit.fixes import Fixes
from magloc.localization.fit.gauss_newton import scaled_jacobian
from magloc.localization.model_errors import ambient_errors, body_errors
from magloc.measurement.rows import whitened_rows
from magloc.measurement.whitened import WhitenedModel

# Sum of squared differences below which the effect of a default body is below the noise for any array: its field
# differs from a dipole's by one or two per cent.
_LEAST_ENERGY = 3e3
_AT_ONCE = 256


def body_covariances(
    array: SensorArray,
    fixes: Fixes,
    readings_T: FloatArray,
    ambient_T: FloatArray | None,
    *,
    known_place: bool,
) -> FloatArray:
    """Return the covariance (n, D, D) that bodies would add to the best solutions of point fixes.

    It is in the array's frame. The shape is (0, D, D) if no row has enough signal for it to matter.
    """
    solutions, best = fixes.solutions, fixes.best
    added = np.zeros((len(fixes), *solutions.covariance.shape[1:]))
    points: BoolArray = fixes.solved & (fixes.body_length_m == 0.0)
    if not points.any():
        return added[:0]
    readings_T = fixes.used_readings(array, readings_T)
    for rows in whitened_rows(array, readings_T, ambient_T, _AT_ONCE):
        loud = points[rows.index] & (rows.energy > _LEAST_ENERGY)
        for k in np.unique(solutions.n_sources[best[rows.index[loud]]]).tolist():
            of_k = np.flatnonzero(loud)[solutions.n_sources[best[rows.index[loud]]] == k]
            at = rows.index[of_k]
            model, sigma_T = rows.model.rows(of_k), array.row_ambient_uncertainty_T
            found = _covariances(model, solutions, best[at], k, sigma_T, known_place=known_place)
            added[at, : found.shape[1], : found.shape[1]] = found
    return added if added.any() else added[:0]


def _covariances(
    model: WhitenedModel,
    solutions: Solutions,
    at: IntArray,
    n_sources: int,
    ambient_sigma_T: float,
    *,
    known_place: bool,
) -> FloatArray:
    """Return the added covariances (b, n, n) of solutions of K sources each."""
    position, moment = solutions.position_m[at, :n_sources], solutions.moment_Am2[at, :n_sources]
    q = model.homogeneous(position)
    mu = model.scaled_moment(q, moment)
    distance = np.linalg.norm(position[:, :, None] - model.centroid - model.radius * model.sensors, axis=-1)
    errors = body_errors(model, q, mu, DEFAULT_LENGTH * distance.min(axis=-1))
    if ambient_sigma_T and model.sees_moduli:
        model = model.marginalise(ambient_errors(model, q, mu, ambient_sigma_T))
    jacobian, errors = scaled_jacobian(model, q, mu), model.whiten(errors)
    unit = model.state_unit(n_sources)
    if known_place:
        of_moments = np.tile(np.repeat([False, True], 3), n_sources)
        jacobian, unit = jacobian[..., of_moments], unit[of_moments]
    shift = unit[:, None] * (np.linalg.pinv(jacobian, rcond=1e-10)[..., : errors.shape[1]] @ errors)
    return np.asarray(shift @ np.swapaxes(shift, -1, -2))
