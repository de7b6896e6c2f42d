"""Posterior Cramér-Rao bounds of a filter and of a smoother along a true track."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from arrays.typing import FloatArray
from magloc.kalman import block_update, predict_square_root
from magloc.tracking.chart.start import prior_root
from magloc.tracking.results import Row
from magloc.tracking.smoother import smoother_gain
from magloc.tracking.tracker import Tracker


def posterior_bound(
    tracker: Tracker, rows: Sequence[Row], position_m: FloatArray, moment_Am2: FloatArray
) -> FloatArray:
    """Posterior Cramér-Rao bound of the distance from the truth, for every row, from this row and those before.

    It begins with the first row that shows a source; before it no more is known than what a tracker starts with
    (:func:`magloc.tracking.chart.start.prior_root`), and the standard deviations of the sensors' lasting errors, which
    count as unknowns of their own. Speed and turn rate are those of the truth. The root of the trace of the position's
    bound (n,) [m] is infinite before that row.
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
    bounds = np.full(len(rows), np.inf)
    later: _StepAtTruth | None = None
    P = np.empty((0, 0))
    for step in reversed(_steps_at_truth(tracker, rows, position_m, moment_Am2)):
        of_later, P = P, step.S @ step.S.T
        if later is not None:
            predicted = later.predicted_S @ later.predicted_S.T
            gain = smoother_gain(P, later.F, predicted)
            P = P + gain @ (of_later - predicted) @ gain.T
            P = 0.5 * (P + P.T)
        later = step
        bounds[step.row] = math.sqrt(float(np.trace(P[:3, :3])))
    return bounds


@dataclass(frozen=True, eq=False)
class _StepAtTruth:
    """Roots after and before a row's readings, and the transition that led there; all in Cartesian states."""

    row: int
    S: FloatArray
    predicted_S: FloatArray
    F: FloatArray


def _steps_at_truth(
    tracker: Tracker, rows: Sequence[Row], position_m: FloatArray, moment_Am2: FloatArray
) -> list[_StepAtTruth]:
    """What a filter that linearises at the truth knows at every row, from the first one that shows the source."""
    motion, errors = tracker.moved, tracker.errors
    n = motion.n_states
    N = n + errors.n_states
    truth = np.concatenate([position_m, moment_Am2], axis=1)
    velocity, rate = _velocities(np.array([row.time_s for row in rows]), truth)
    states = [motion.state_of(*of_row) for of_row in zip(truth, velocity, rate, strict=True)]
    steps: list[_StepAtTruth] = []
    for i, row in enumerate(rows):
        measurement = tracker.measurements.of(row)
        F, S_q = np.eye(N), np.zeros((N, 0))
        if steps:
            dt_s = row.time_s - rows[i - 1].time_s
            _, F[:n, :n], of_motion = motion.step(states[i - 1], dt_s)
            kept, added = errors.step(dt_s)
            F[np.arange(n, N), np.arange(n, N)] = kept
            S_q = np.zeros((N, of_motion.shape[1] + errors.n_states))
            S_q[:n, : of_motion.shape[1]], S_q[n:, of_motion.shape[1] :] = of_motion, np.diag(added)
            predicted_S = predict_square_root(steps[-1].S, F, S_q)
        elif measurement.is_detected(errors.sigma):
            predicted_S = np.diag(np.concatenate([np.zeros(n), errors.sigma]))
            chart = measurement.chart(states[i])
            predicted_S[:n, :n] = prior_root(chart, motion)
        else:
            continue
        state = np.concatenate([states[i], np.zeros(errors.n_states)])
        H = measurement.jacobian(state)
        _, S = block_update(state, predicted_S, H, np.zeros(len(H)), np.ones(len(H)))
        steps.append(_StepAtTruth(i, S, predicted_S, F))
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
