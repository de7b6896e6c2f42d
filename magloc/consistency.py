r"""How true a track is: its errors against what it claims, and against what is possible.

The normalised estimation error squared, NEES, of an estimate of n numbers with covariance P is
:math:`e^T P^{-1} e`; over independent rows its mean times their number is a χ² of n numbers each. The posterior
Cramér-Rao bound is the least covariance that any estimator can reach with a motion model: of a filter by the recursion
of Tichavský, Muravchik and Nehorai (1998), for linear motion
:math:`J_{j+1} = (Q + F J_j^{-1} F^T)^{-1} + H^T R^{-1} H` at the truth, and of a smoother, which knows later rows too,
by the same information carried backwards.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from magloc.kalman import block_update
from magloc.motion import N_SOURCE
from magloc.row_measurement import RowMeasurement
from magloc.smoother import smoothed
from magloc.track import Tracker
from magloc.track_rows import Row, Step, TrackPoint

FloatArray = NDArray[np.float64]

_LEVEL = 0.99
# Rows determine a source if their Jacobian, columns scaled, is not nearer to singular.
_SINGULAR_RTOL = 1e-6


@dataclass(frozen=True)
class Consistency:
    """A track against the truth.

    Attributes
    ----------
    rows, tracked_rows : int
        Rows with truth, and those of them that are tracked.
    position_rms_m : float
        Root of the mean squared distance from the truth.
    position_bound_m : float
        The same of the posterior Cramér-Rao bound, over the same rows: that of a filter, or of a smoother if the track
        is smoothed. NaN where the true moment is not known.
    nees_per_dimension : float
        Mean NEES over the number of its dimensions: 1 if the covariance is right. It is counted in coordinates in
        which an uncertain one is Gaussian, see :func:`nees_of`.
    nees_bounds : tuple of 2 floats
        Two-sided 99 % bounds of it for independent rows. A track's rows are not independent: over one record it may
        well lie outside.
    nis_per_dimension : float
        Mean NIS over its degrees of freedom.
    nis_bounds : tuple of 2 floats
        Two-sided 99 % bounds of it; the innovations of a right filter are independent.
    """

    rows: int
    tracked_rows: int
    position_rms_m: float
    position_bound_m: float
    nees_per_dimension: float
    nees_bounds: tuple[float, float]
    nis_per_dimension: float
    nis_bounds: tuple[float, float]


def mean_bounds(degrees_of_freedom: int, level: float = _LEVEL) -> tuple[float, float]:
    """Two-sided bounds of a χ² over its degrees of freedom."""
    if degrees_of_freedom <= 0:
        return math.nan, math.nan
    tail = 0.5 * (1.0 - level)
    low, high = chdtri(degrees_of_freedom, 1.0 - tail), chdtri(degrees_of_freedom, tail)
    return float(low) / degrees_of_freedom, float(high) / degrees_of_freedom


def consistency(
    points: Sequence[TrackPoint],
    tracker: Tracker,
    rows: Sequence[Row],
    position_m: FloatArray,
    moment_Am2: FloatArray | None,
    bound_m: FloatArray | None = None,
) -> Consistency:
    """Errors of a track.

    Parameters
    ----------
    points : sequence of TrackPoint
    tracker : Tracker
        That made them.
    rows : sequence of Row
    position_m, moment_Am2 : ndarray, shape (n, 3)
        Truth of every row in the track's frame; NaN where a coordinate is not known.
        With the moment NEES is that of all six numbers, else that of the position.
    bound_m : ndarray, shape (n,), optional
        Posterior Cramér-Rao bound of every row: :func:`posterior_bound` of a filtered track, :func:`smoothing_bound`
        of a smoothed one.

    Returns
    -------
    Consistency
    """
    squares, bounds, nis, nis_dof = [], [], 0.0, 0
    for i, point in enumerate(points):
        if point.position_m is None:
            continue
        if math.isfinite(point.nis) and point.nis_dof and point.status == "tracked":
            nis, nis_dof = nis + point.nis, nis_dof + point.nis_dof
        known = np.isfinite(position_m[i])
        if known.any():
            error = point.position_m[known] - position_m[i][known]
            squares.append(float(error @ error))
            if bound_m is not None:
                bounds.append(float(bound_m[i]))
    of_rows, dof_of_rows = nees_of_rows(points, tracker, rows, position_m, moment_Am2)
    nees, nees_dof = float(np.nansum(of_rows)), int(dof_of_rows.sum())
    return Consistency(
        rows=int(np.isfinite(position_m).any(axis=1).sum()),
        tracked_rows=len(squares),
        position_rms_m=math.sqrt(float(np.mean(squares))) if squares else math.nan,
        position_bound_m=math.sqrt(float(np.mean(np.square(bounds)))) if bounds else math.nan,
        nees_per_dimension=nees / nees_dof if nees_dof else math.nan,
        nees_bounds=mean_bounds(nees_dof),
        nis_per_dimension=nis / nis_dof if nis_dof else math.nan,
        nis_bounds=mean_bounds(nis_dof),
    )


def nees_of_rows(
    points: Sequence[TrackPoint],
    tracker: Tracker,
    rows: Sequence[Row],
    position_m: FloatArray,
    moment_Am2: FloatArray | None,
) -> tuple[FloatArray, NDArray[np.int64]]:
    """Normalised estimation error squared of every row, see :func:`nees_of`.

    Parameters
    ----------
    points, tracker, rows, position_m, moment_Am2
        As of :func:`consistency`.

    Returns
    -------
    nees : ndarray, shape (n,)
        NaN where the source is not tracked, or nothing is known of the truth.
    dof : ndarray of int, shape (n,)
    """
    moments = np.full_like(position_m, np.nan) if moment_Am2 is None else moment_Am2
    truth = np.concatenate([position_m, moments], axis=1)
    nees, dof = np.full(len(points), np.nan), np.zeros(len(points), dtype=np.int64)
    for i, point in enumerate(points):
        if point.position_m is None or point.moment_Am2 is None or point.covariance is None:
            continue
        if np.isfinite(truth[i]).any():
            estimate = np.concatenate([point.position_m, point.moment_Am2])
            nees[i], dof[i] = nees_of(tracker.measurement(rows[i]), estimate, point.covariance, truth[i])
    return nees, dof


def nees_of(
    measurement: RowMeasurement, estimate: FloatArray, covariance: FloatArray, truth: FloatArray
) -> tuple[float, int]:
    """Normalised estimation error squared of one estimate, and how many numbers it is of.

    Parameters
    ----------
    measurement : RowMeasurement
        Of the row.
    estimate, covariance : ndarray, shapes (6,) and (6, 6)
        Of position and moment.
    truth : ndarray, shape (6,)
        NaN where a number is not known: NEES is then that of what is known. If all six are, the error is counted in the
        coordinates of :mod:`magloc.row_measurement`, in which it is Gaussian.

    Returns
    -------
    float, int
    """
    known = np.isfinite(truth)
    known[3:] &= known[3:].all()
    error = truth - estimate
    if known.all():
        error, _ = measurement.coordinates(estimate, np.sqrt(np.diagonal(covariance))).at(truth)
    error, covariance = error[known], covariance[np.ix_(known, known)]
    scale = np.sqrt(np.diagonal(covariance))
    normalised = error / scale
    return float(normalised @ np.linalg.solve(covariance / np.outer(scale, scale), normalised)), int(known.sum())


def posterior_bound(
    tracker: Tracker, rows: Sequence[Row], position_m: FloatArray, moment_Am2: FloatArray
) -> FloatArray:
    """Posterior Cramér-Rao bound of the distance from the truth, for every row, from this row and those before.

    Nothing is known before the first row but the standard deviations of the sensors' lasting errors, which count as
    unknowns of their own, and until the readings determine it the source counts as at rest. Speed and turn rate are
    those of the truth.

    Parameters
    ----------
    tracker : Tracker
        Whose array and motion model count.
    rows : sequence of Row
    position_m, moment_Am2 : ndarray, shape (n, 3)
        Truth in the track's frame.

    Returns
    -------
    ndarray, shape (n,)
        Root of the trace of the position's bound [m]; infinite as long as the readings do not determine it.
    """
    bounds = np.full(len(rows), np.inf)
    for step in _steps_at_truth(tracker, rows, position_m, moment_Am2):
        bounds[step.row] = float(np.linalg.norm(step.S[:3]))
    return bounds


def smoothing_bound(
    tracker: Tracker, rows: Sequence[Row], position_m: FloatArray, moment_Am2: FloatArray
) -> FloatArray:
    r"""Posterior Cramér-Rao bound of the distance from the truth, for every row, from all rows.

    The diagonal blocks of the inverse of the information of all states together (Šimandl, Královec and Tichavský 2001),
    by the recursion of Rauch, Tung and Striebel from the last row backwards:
    :math:`P_{j|n} = P_j + G (P_{j+1|n} - P_{j+1|j}) G^T` with :math:`G = P_j F^T P_{j+1|j}^{-1}`.

    Parameters
    ----------
    tracker, rows, position_m, moment_Am2
        As of :func:`posterior_bound`.

    Returns
    -------
    ndarray, shape (n,)
        As of :func:`posterior_bound`, and infinite at the same rows: a track that has not begun is not smoothed.
    """
    steps = _steps_at_truth(tracker, rows, position_m, moment_Am2)
    at_truth = [TrackPoint(row.time_s, place) for row, place in zip(rows, position_m, strict=True)]
    points = smoothed(at_truth, steps)
    bounds = np.full(len(rows), np.inf)
    for step in steps:
        covariance = points[step.row].covariance
        if covariance is not None:
            bounds[step.row] = math.sqrt(float(np.trace(covariance[:3, :3])))
    return bounds


def _steps_at_truth(
    tracker: Tracker, rows: Sequence[Row], position_m: FloatArray, moment_Am2: FloatArray
) -> list[Step]:
    """What a filter that linearises at the truth knows at every row, from the first one that determines the source."""
    motion, n_errors = tracker.motion, tracker.errors.n_states
    truth = np.concatenate([position_m, moment_Am2], axis=1)
    velocity, rate = _velocities(np.array([row.time_s for row in rows]), truth)
    steps: list[Step] = []
    S: FloatArray | None = None
    seen: list[FloatArray] = []
    measurements: list[RowMeasurement] = []
    for i, row in enumerate(rows):
        measurement = tracker.measurement(row)
        before = max(i - 1, 0)
        prediction = None
        if S is not None:
            state = np.concatenate([motion.state_of(truth[before], velocity[before], rate[before]), np.zeros(n_errors)])
            prediction = tracker.predicted(state, S, row.time_s - rows[before].time_s)
        state = np.concatenate([motion.state_of(truth[i], velocity[i], rate[i]), np.zeros(n_errors)])
        H = measurement.jacobian(state)
        if prediction is not None:
            _, S = block_update(state, prediction.S, H, np.zeros(len(H)), np.ones(len(H)))
        else:
            # Lasting errors of sensors as noise of the row: only to see whether the source is determined, and how well.
            lasting = H[:, motion.n_states :] * tracker.errors.sigma
            root = np.linalg.cholesky(np.eye(len(H)) + lasting @ lasting.T)
            seen.append(np.linalg.solve(root, H[:, :N_SOURCE]))
            measurements.append(measurement)
            covariance = _bound_at_rest(np.concatenate(seen))
            if covariance is None:
                continue
            S = tracker.filtered_start(truth[i], covariance, measurements).S
        steps.append(Step(i, prediction, state, S))
    return steps


def _bound_at_rest(H: FloatArray) -> FloatArray | None:
    """Covariance (6, 6) of a source at rest from a whitened Jacobian (k, 6), or None where it is not determined."""
    norm = np.linalg.norm(H, axis=0)
    scaled = H / np.where(norm > 0.0, norm, 1.0)
    singular = np.linalg.svd(scaled, compute_uv=False)
    if len(H) < N_SOURCE or singular[-1] < _SINGULAR_RTOL * singular[0]:
        return None
    covariance: FloatArray = np.linalg.inv(scaled.T @ scaled) / np.outer(norm, norm)
    return covariance


def _velocities(time_s: FloatArray, truth: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Velocities and turn rates (n, 3) of true positions and moments (n, 6), by differences of the rows."""
    if len(time_s) < 2:
        return np.zeros((len(time_s), 3)), np.zeros((len(time_s), 3))
    derivative = np.gradient(truth, time_s, axis=0)
    moment, change = truth[:, 3:], derivative[:, 3:]
    square = np.sum(moment * moment, axis=1, keepdims=True)
    rate = np.divide(np.cross(moment, change), square, out=np.zeros_like(moment), where=square > 0.0)
    return derivative[:, :3], rate
