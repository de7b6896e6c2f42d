"""Posterior Cramér-Rao bounds of a filter and of a smoother along a true track."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from arrays.typing import FloatArray
from magloc.tracking.chart.start import prior_root
from magloc.tracking.results import Step
from magloc.tracking.rows import Row
from magloc.tracking.tracker import Tracker
from magloc.tracking.whole_records.background import steps_of
from magloc.tracking.whole_records.smoother import states_of


def posterior_bound(
    tracker: Tracker, rows: Sequence[Row], position_m: FloatArray, moment_Am2: FloatArray, *, smooth: bool = False
) -> FloatArray:
    r"""Return the posterior Cramér-Rao bound of each row's position, by rows up to it, or by all rows if `smooth`.

    The bound (n,) [m] is the root of the trace for the position. It begins with the first row that shows a source, and
    is infinite before. The prior is a tracker's (:func:`magloc.tracking.chart.start.prior_root`). Lasting errors
    of the sensors are unknowns with their standard deviations. Speed and turn rate are from the truth.

    By all rows it is the diagonal block of the inverse information of all states together (Šimandl, Královec and
    Tichavský 2001), by the recursion of Rauch, Tung and Striebel from the last row backwards:
    :math:`P_{j|n} = P_j + G (P_{j+1|n} - P_{j+1|j}) G^T` with :math:`G = P_j F^T P_{j+1|j}^{-1}`.
    """
    bounds = np.full(len(rows), np.inf)
    steps = _steps_at_truth(tracker, rows, position_m, moment_Am2)
    for step, (_, S) in zip(steps, states_of(steps, smooth=smooth), strict=True):
        bounds[step.row] = float(np.linalg.norm(S[:3]))
    return bounds


def _steps_at_truth(
    tracker: Tracker, rows: Sequence[Row], position_m: FloatArray, moment_Am2: FloatArray
) -> list[Step]:
    """Return filter steps linearised at the truth, from the first row that shows the source."""
    motion, n_errors = tracker.motion, tracker.n_errors
    truth = np.concatenate([position_m, moment_Am2], axis=1)
    velocity, rate = _velocities(np.array([row.time_s for row in rows]), truth)
    states = [
        np.concatenate([motion.state_of(truth[i], velocity[i], rate[i]), np.zeros(n_errors)]) for i in range(len(rows))
    ]
    measurements = [tracker.measurements.of(row) for row in rows]
    if tracker.background is not None:
        return steps_of(tracker, measurements, states)
    seen = (i for i, row in enumerate(measurements) if row.is_detected(tracker.errors.sigma))
    first = next(seen, None)
    if first is None:
        return []
    root = prior_root(measurements[first].chart(truth[first]))
    start = tracker.initial_state(states[first], root, rows[first].R_world_from_array)
    steps = steps_of(tracker, measurements[first:], states[first:], start)
    return [replace(step, row=first + step.row) for step in steps]


def _velocities(time_s: FloatArray, truth: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return velocities and turn rates (n, 3) by differences of true states (n, 6)."""
    if len(time_s) < 2:
        return np.zeros((len(time_s), 3)), np.zeros((len(time_s), 3))
    derivative = np.gradient(truth, time_s, axis=0)
    moment, change = truth[:, 3:], derivative[:, 3:]
    square = np.sum(moment * moment, axis=1, keepdims=True)
    rate = np.divide(np.cross(moment, change), square, out=np.zeros_like(moment), where=square > 0.0)
    return derivative[:, :3], rate
