"""One source at rest from several rows of an array that moves: all its readings as those of one large array.

A few scalar sensors do not locate a source in one row, but they do while they pass it. Every row keeps its own common
field, so that what changes from row to row in the ambient field does not matter.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from arrays.array import SensorArray
from arrays.typing import FloatArray
from magloc.directions import fibonacci_directions
from magloc.localization.fit.gauss_newton import covariances
from magloc.localization.fit.prior import NOTHING_KNOWN, SourcePrior
from magloc.localization.fit.results import DISTINCT_WITHIN, Fix, Solution
from magloc.localization.search.beam_search import Search
from magloc.localization.uncertainty.covariance import fit_uncertainty
from magloc.localization.uncertainty.range_interval import is_detected, is_observable_set
from magloc.measurement.rows import NO_SIGNAL, ambient_fields, whitenings_of
from magloc.measurement.whitened import WhitenedModel

N_UNKNOWNS = 6
_N_DIRECTIONS = 200
_N_RANGES = 10
_WIDTH = 8


def stacked_fix(
    array: SensorArray,
    readings_T: FloatArray,
    origins_m: FloatArray,
    R_world_from_array: FloatArray,
    ambient_T: FloatArray | None = None,
    *,
    knowledge: SourcePrior = NOTHING_KNOWN,
) -> Fix:
    """Fix of a source at rest, in the world frame, from rows of an array whose pose is known.

    Parameters
    ----------
    array : SensorArray
    readings_T : ndarray, shape (n, C)
        Raw readings [T], NaN where missing.
    origins_m, R_world_from_array : ndarray, shapes (n, 3) and (n, 3, 3)
        Pose of the array in every row.
    ambient_T : ndarray, shape (n, 3), optional
        Ambient field of every row in the array's frame [T], in place of the array's own.
    knowledge : SourcePrior
        Bounds of the position in the world frame, and of the moment.

    Returns
    -------
    Fix
        χ² and degrees of freedom are those of all rows together; the range is from the centroid of all places where a
        sensor was.
    """
    problem, y, n_differences = _problem(array, readings_T, origins_m, R_world_from_array, ambient_T)
    if n_differences < N_UNKNOWNS:
        reason = f"{len(readings_T)} rows give {n_differences} independent differences, {N_UNKNOWNS} are needed"
        return Fix((), reason, detected=False)
    if np.sum(y * y) < 1e-9 * n_differences:
        return Fix((), NO_SIGNAL, detected=False)

    def allowed(q: FloatArray, mu: FloatArray) -> NDArray[np.bool_]:
        with np.errstate(invalid="ignore"):
            kept = knowledge.allows_position(problem.position(q)) & knowledge.allows_moment(problem.moment(q, mu))
        return np.asarray(kept)

    beam = Search(problem.homogeneous(_candidates(problem)), allowed, width=_WIDTH).first(problem, y)
    fits = beam.flat()
    listed = np.flatnonzero(fits.chi2 <= fits.chi2[0] + DISTINCT_WITHIN)
    listed = listed[np.isfinite(fits.chi2[listed])]
    fits = fits.rows(listed)
    of_row = np.zeros(len(listed), dtype=np.intp)
    same = problem.rows(of_row)
    covariance = covariances(same, fits)
    position, moment = problem.position(fits.q)[:, 0], problem.moment(fits.q, fits.mu)[:, 0]
    energy = np.sum((y - problem.predicted(np.zeros_like(problem.ambient))) ** 2, axis=1)
    told = fit_uncertainty(same, y[of_row], fits, covariance, of_row, energy, n_differences)
    solutions = tuple(
        Solution(
            position_m=position[i],
            moment_Am2=moment[i],
            covariance=told.covariance[i],
            chi2=float(fits.chi2[i]),
            dof=n_differences - N_UNKNOWNS,
            iterations=int(fits.iterations[i]),
            converged=True,
            range_observable=is_observable_set(told.sets[i][0]),
            range_interval95_m=told.sets[i][0],
            weight=float(told.weight[i]),
            gaussian=bool(told.gaussian[i, 0]),
        )
        for i in np.flatnonzero(np.isfinite(covariance).all(axis=(1, 2)))
    )
    reason = "" if solutions else "the rows together do not determine the source"
    return Fix(solutions, reason, detected=bool(is_detected(energy, n_differences)[0]))


def _problem(
    array: SensorArray,
    readings: FloatArray,
    origins: FloatArray,
    rotations: FloatArray,
    ambient_T: FloatArray | None,
) -> tuple[WhitenedModel, FloatArray, int]:
    """All rows as one set in the world frame: the problem, whitened readings (1, n C), number of differences."""
    n = len(readings)
    whitenings = [whitenings_of(array, np.isfinite(row), row[None])[0] for row in readings]
    fields = ambient_fields(array, n, ambient_T)
    vector = ~array.channel_is_scalar
    ambient = np.einsum("ncj,cj->nc", fields[:, array.channel_sensor], array.channel_gain) * vector
    channels = np.nan_to_num(readings - array.channel_offset_T - ambient)
    raw = np.concatenate([w.root @ row for w, row in zip(whitenings, channels, strict=True)])
    # A vector channel reads a · Rᵀ B of the world's field B; a modulus does not see the turn.
    turned = np.where(
        array.channel_is_scalar[:, None], array.channel_gain, array.channel_gain @ np.swapaxes(rotations, 1, 2)
    )
    gain = np.concatenate([w.root @ row for w, row in zip(whitenings, turned, strict=True)])
    places = (origins[:, None] + np.einsum("nij,sj->nsi", rotations, array.positions)).reshape(-1, 3)
    centroid = places.mean(axis=0)
    radius = float(np.linalg.norm(places - centroid, axis=1).max())
    sensor = array.channel_sensor.astype(np.intp)
    problem = WhitenedModel(
        centroid=centroid,
        radius=radius,
        sensors=(places - centroid) / radius,
        channel_sensor=np.concatenate([sensor + i * array.n_sensors for i in range(n)]),
        channel_is_scalar=np.tile(array.channel_is_scalar, n),
        gain=gain[None],
        ambient=np.einsum("nij,nsj->nsi", rotations, fields).reshape(1, -1, 3),
        basis=block_diag(*(w.basis for w in whitenings))[None],
        shrinkage=np.concatenate([w.shrinkage for w in whitenings])[None],
    )
    return problem, problem.whitened(raw[None]), sum(w.n_differences for w in whitenings)


def _candidates(problem: WhitenedModel) -> FloatArray:
    """Positions around the track of the array: along directions from the centroid, and near every place of it."""
    ranges = problem.radius * np.geomspace(0.3, 20.0, _N_RANGES)
    outer = problem.centroid + (ranges[:, None, None] * fibonacci_directions(_N_DIRECTIONS)).reshape(-1, 3)
    places = problem.centroid + problem.radius * problem.sensors
    step = max(1, len(places) // 24)
    shells = problem.radius * np.array([0.1, 0.2, 0.4])
    near = (places[::step, None, None] + shells[:, None, None] * fibonacci_directions(12)).reshape(-1, 3)
    return np.concatenate([outer, near])
