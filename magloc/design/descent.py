"""Descent of a design criterion over sensor positions, within a volume or on a surface.

The criterion is that of a fixed sample of sources, with an exact gradient. Steps are those of a spectral projected
gradient. The change of the gradient in the last step gives the length. The step is projected into the volume, and
shortened until the criterion is below the worst of the last few values.

Source: E. G. Birgin, J. M. Martínez, M. Raydan, "Nonmonotone spectral projected gradient methods on convex sets",
SIAM Journal on Optimization 10 (2000); on a surface, which is not convex, every trial is projected onto it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.spatial.distance import pdist

from arrays.typing import FloatArray
from magloc import core
from magloc.bounds.sources import array_model, source_bounds
from magloc.design.task import DesignTask

# Share of the largest weight below which order statistics do not affect the gradient.
_NEGLIGIBLE = 1e-6
# Part of the information about a parameter below which the range has no bound.
_SINGULAR = 1e-14
_MEMORY = 8
_SUFFICIENT = 1e-4
_SHORTEST = 1e-8
_FIRST_STEP = 0.05
# A descent has converged if a number of steps gained less than a share of the criterion.
_PATIENCE, _LEAST_GAIN = 30, 2e-4
_MOST_SPACING_ROUNDS = 300


@dataclass(frozen=True, eq=False)
class Sample:
    """A fixed sample of a task's sources.

    Attributes
    ----------
    positions, moments : ndarray, shape (n, 3)
        Positions [m] and moments [A·m²] of the sources.
    """

    positions: FloatArray
    moments: FloatArray

    def deviations(self, task: DesignTask, sensors: FloatArray) -> FloatArray:
        """Return Cramér-Rao bounds of the range (n,) [m] for sensors (N, 3).

        They are infinite if there is no bound.
        """
        return self._deviations_and_slopes(task, sensors, with_slopes=False)[0]

    def value(self, task: DesignTask, sensors: FloatArray) -> float:
        """Return the criterion [m], smoothed as in the descent."""
        deviations = np.sort(self.deviations(task, sensors))
        weights = task.criterion.weights(deviations.size)
        used = weights > _NEGLIGIBLE * weights.max()
        return float(weights[used] @ deviations[used] / weights[used].sum())

    def log_value_and_slope(self, task: DesignTask, sensors: FloatArray) -> tuple[float, FloatArray]:
        """Return the logarithm of :meth:`value`, and its derivative (N, 3) [1/m].

        The derivative is by the positions of the sensors.
        """
        deviations = self.deviations(task, sensors)
        order = np.argsort(deviations, kind="stable")
        weights = task.criterion.weights(order.size)
        used = np.flatnonzero(weights > _NEGLIGIBLE * weights.max())
        part = Sample(self.positions[order[used]], self.moments[order[used]])
        share = weights[used] / weights[used].sum() * deviations[order[used]]
        value = float(share.sum())
        if not np.isfinite(value):
            return np.inf, np.zeros_like(sensors)
        _, slopes = part._deviations_and_slopes(task, sensors, with_slopes=True)
        return float(np.log(value)), np.einsum("n,njk->jk", share / value, slopes)

    def _deviations_and_slopes(
        self, task: DesignTask, sensors: FloatArray, *, with_slopes: bool
    ) -> tuple[FloatArray, FloatArray]:
        slopes = np.empty((len(self.positions), *sensors.shape))
        range_m, _, _ = source_bounds(
            _model(task, len(sensors)),
            sensors,
            self.positions,
            self.moments[:, None],
            slopes=slopes if with_slopes else None,
        )
        return range_m[:, 0], slopes


@lru_cache(maxsize=8)
def _model(task: DesignTask, n_sensors: int) -> core.Problem:
    """Return the kernel's model of a number of sensors, for any positions."""
    return array_model(task.array(np.arange(3.0 * n_sensors).reshape(-1, 3)), lost=_SINGULAR)


@dataclass(frozen=True, eq=False)
class Descent:
    """End of a descent.

    Attributes
    ----------
    sensors : ndarray, shape (N, 3)
        Best positions [m].
    value : float
        Criterion of its sample at these positions [m].
    converged : bool
        True if the criterion stopped falling; otherwise the iterations ran out.
    """

    sensors: FloatArray
    value: float
    iterations: int
    converged: bool


def move_into_volume(task: DesignTask, sensors: FloatArray) -> FloatArray:
    """Move sensors (N, 3) into the task's volume and apart from each other [m]."""
    inside = task.volume.nearest(sensors)
    if not task.least_spacing_m:
        return inside
    i, j = np.triu_indices(len(inside), 1)
    for _ in range(_MOST_SPACING_ROUNDS):
        apart = inside[i] - inside[j]
        distance = np.linalg.norm(apart, axis=1, keepdims=True)
        close = distance[:, 0] < task.least_spacing_m * (1.0 - 1e-9)
        if not close.any():
            break
        # Sensors in one place have no direction of separation; use an axis by their numbers.
        parting = np.where(distance > 1e-12, apart / np.maximum(distance, 1e-12), np.eye(3)[(i + j) % 3])
        push = 0.5 * (1.0 + 1e-6) * np.maximum(0.0, task.least_spacing_m - distance) * parting
        moved = inside.copy()
        np.add.at(moved, i, push)
        np.add.at(moved, j, -push)
        inside = task.volume.nearest(moved)
    return inside


def is_spaced(task: DesignTask, sensors: FloatArray) -> bool:
    """Return True if all sensors are at least the least spacing apart, to a part in a million."""
    return bool(pdist(sensors).min() >= task.least_spacing_m * (1.0 - 1e-6))


def descend(
    task: DesignTask,
    sample: Sample,
    start: FloatArray,
    *,
    max_iterations: int,
    step_done: Callable[[int], None] = lambda _: None,
) -> Descent:
    """Descend from sensors (N, 3) [m], moved into the volume, until the criterion stops falling."""
    x = move_into_volume(task, start)
    value, slope = sample.log_value_and_slope(task, x)
    best, best_x = value, x
    history, bests = [value], [value]
    steepest = float(np.abs(slope).max())
    length = _FIRST_STEP * task.volume.radius / steepest if steepest > 0.0 else 0.0
    longest = task.volume.radius**2 * 10.0
    iteration, converged = 0, steepest == 0.0 and np.isfinite(value)
    while iteration < max_iterations and not converged and np.isfinite(value):
        iteration += 1
        new = _step(task, sample, x, slope, length, max(history[-_MEMORY:]))
        step_done(1)
        if new is None:
            converged = True
            break
        new_x, new_value, new_slope = new
        change, bend = new_x - x, np.sum((new_x - x) * (new_slope - slope))
        length = float(np.clip(np.sum(change * change) / bend, 1e-6 * longest, longest)) if bend > 0.0 else longest
        x, value, slope = new_x, new_value, new_slope
        history.append(value)
        if value < best:
            best, best_x = value, x
        bests.append(best)
        converged = iteration > _PATIENCE and bests[-1 - _PATIENCE] - best < _LEAST_GAIN
    step_done(max_iterations - iteration)
    return Descent(best_x, float(np.exp(best)), iteration, bool(converged))


def _step(
    task: DesignTask, sample: Sample, x: FloatArray, slope: FloatArray, length: float, bar: float
) -> tuple[FloatArray, float, FloatArray] | None:
    """Return the next positions with value and slope; None if no step is short enough."""
    direction = move_into_volume(task, x - length * slope) - x
    steepness = float(np.sum(slope * direction))
    share = 1.0
    while share > _SHORTEST:
        trial = move_into_volume(task, x + share * direction)
        value, new_slope = sample.log_value_and_slope(task, trial)
        if value <= bar + _SUFFICIENT * share * min(steepness, 0.0) and is_spaced(task, trial):
            return trial, value, new_slope
        share *= 0.4
    return None
