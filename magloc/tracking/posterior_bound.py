"""Posterior Cramér-Rao bounds of a filter and of a smoother along a true track."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from arrays.typing import FloatArray
from magloc.kalman import block_update
from magloc.localization.fit.gauss_newton import inverse_information
from magloc.tracking.measurement import RowMeasurement
from magloc.tracking.motion import N_SOURCE
from magloc.tracking.results import Row, Step, TrackPoint
from magloc.tracking.tracker import Tracker
from magloc.tracking.whole_records.background import steps_at
from magloc.tracking.whole_records.smoother import smoothed

# Rows determine a source if their Jacobian, columns scaled, is not nearer to singular.
_SINGULAR_RTOL = 1e-6


def posterior_bound(
    tracker: Tracker, rows: Sequence[Row], position_m: FloatArray, moment_Am2: FloatArray
) -> FloatArray:
    """Posterior Cramér-Rao bound of the distance from the truth, for every row, from this row and those before.

    Nothing is known before the first row but the standard deviations of the sensors' lasting errors, which count as
    unknowns of their own, and until the readings determine it the source counts as at rest. Speed and turn rate are
    those of the truth. The root of the trace of the position's bound (n,) [m] is infinite as long as the readings do
    not determine it.
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
    :math:`P_{j|n} = P_j + G (P_{j+1|n} - P_{j+1|j}) G^T` with :math:`G = P_j F^T P_{j+1|j}^{-1}`. It is infinite at the
    same rows as :func:`posterior_bound`: a track that has not begun is not smoothed.
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
    motion, n_errors = tracker.motion, tracker.n_errors
    truth = np.concatenate([position_m, moment_Am2], axis=1)
    velocity, rate = _velocities(np.array([row.time_s for row in rows]), truth)
    if tracker.background is not None:
        states = [
            np.concatenate([motion.state_of(truth[i], velocity[i], rate[i]), np.zeros(n_errors)])
            for i in range(len(rows))
        ]
        return steps_at(tracker, rows, states)
    steps: list[Step] = []
    S: FloatArray | None = None
    seen: list[FloatArray] = []
    measurements: list[RowMeasurement] = []
    for i, row in enumerate(rows):
        measurement = tracker.measurements.of(row)
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
            # Errors of sensors and pose as noise of the row: only to see whether the source is determined, how well.
            lasting = H[:, motion.n_states :] * tracker.error_sigma
            root = np.linalg.cholesky(np.eye(len(H)) + lasting @ lasting.T)
            seen.append(np.linalg.solve(root, H[:, :N_SOURCE]))
            measurements.append(measurement)
            covariance = inverse_information(np.concatenate(seen)[None], _SINGULAR_RTOL)[0]
            if np.isnan(covariance).any():
                continue
            S = tracker.filtered_start([state] * len(measurements), covariance, measurements).S
        steps.append(Step(i, prediction, state, S))
    return steps


def _velocities(time_s: FloatArray, truth: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Velocities and turn rates (n, 3) of true positions and moments (n, 6), by differences of the rows."""
    if len(time_s) < 2:
        return np.zeros((len(time_s), 3)), np.zeros((len(time_s), 3))
    derivative = np.gradient(truth, time_s, axis=0)
    moment, change = truth[:, 3:], derivative[:, 3:]
    square = np.sum(moment * moment, axis=1, keepdims=True)
    rate = np.divide(np.cross(moment, change), square, out=np.zeros_like(moment), where=square > 0.0)
    return derivative[:, :3], rate
