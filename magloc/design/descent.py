"""Descent of a design criterion over points, such as sensors within a volume or on a surface.

The criterion is evaluated on a fixed sample of sources or poses. Steps follow a spectral projected gradient. The
change of the gradient in the last step gives the length. The step is projected into the volume, and shortened until the
criterion is below the worst of the last few values.

Source: E. G. Birgin, J. M. Martínez, M. Raydan, "Nonmonotone spectral projected gradient methods on convex sets",
SIAM Journal on Optimization 10 (2000); on a surface, which is not convex, every trial is projected onto it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import numpy as np
from scipy.spatial.distance import pdist

from arrays.typing import FloatArray, IntArray
from magloc import core
from magloc.bounds.sources import array_model, source_bounds
from magloc.design.regions import Criterion
from magloc.design.task import DesignSearch, DesignTask
from magloc.design.volumes import Volume

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
_PARTING = np.array([0.48, 0.60, 0.64])  # a unit vector with a part along every rod and plate


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
        deviations = self.deviations(task, sensors)
        index, weights = order_weights(task.criterion, deviations)
        return float(weights @ deviations[index])

    def log_value_and_slope(self, task: DesignTask, sensors: FloatArray) -> tuple[float, FloatArray]:
        """Return the logarithm of :meth:`value`, and its derivative (N, 3) [1/m].

        The derivative is by the positions of the sensors.
        """
        deviations = self.deviations(task, sensors)
        index, weights = order_weights(task.criterion, deviations)
        part = Sample(self.positions[index], self.moments[index])
        share = weights * deviations[index]
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


def order_weights(criterion: Criterion, deviations: FloatArray) -> tuple[IntArray, FloatArray]:
    """Return the indices of the deviations that a criterion depends on, and their weights, of sum 1."""
    order = np.argsort(deviations, kind="stable")
    weights = criterion.weights(order.size)
    used = np.flatnonzero(weights > _NEGLIGIBLE * weights.max())
    return order[used], weights[used] / weights[used].sum()


@lru_cache(maxsize=8)
def _model(task: DesignTask, n_sensors: int) -> core.Problem:
    """Return the kernel's model of a number of sensors, for any positions."""
    return array_model(task.array(np.arange(3.0 * n_sensors).reshape(-1, 3)), lost=_SINGULAR)


class Placement(Protocol):
    """Volume of points, and their least distance."""

    @property
    def volume(self) -> Volume:
        """Allowed positions."""

    @property
    def least_spacing_m(self) -> float:
        """Least distance of two points [m]."""


class DesignProblem(Protocol):
    """Criterion of points (n, 3), and the points that are allowed."""

    @property
    def radius(self) -> float:
        """Size of the set of allowed points, in their unit."""

    def move_inside(self, points: FloatArray) -> FloatArray:
        """Return allowed points near others."""

    def is_spaced(self, points: FloatArray) -> bool:
        """Return True if no points are too close to each other."""

    def value(self, points: FloatArray) -> float:
        """Return the smoothed criterion; infinite if the points determine nothing."""

    def log_value_and_slope(self, points: FloatArray) -> tuple[float, FloatArray]:
        """Return the logarithm of the criterion, and its derivative (n, 3) by the points."""


@dataclass(frozen=True, eq=False)
class ArrayProblem:
    """The :class:`DesignProblem` of a task's sensors, for a sample of sources."""

    task: DesignTask
    sample: Sample

    @property
    def radius(self) -> float:
        """Radius of the volume [m]."""
        return self.task.volume.radius

    def move_inside(self, points: FloatArray) -> FloatArray:
        """Return sensors (N, 3) [m] within the volume and apart."""
        return move_into_volume(self.task, points)

    def is_spaced(self, points: FloatArray) -> bool:
        """Return True if all sensors have their least spacing."""
        return is_spaced(self.task, points)

    def value(self, points: FloatArray) -> float:
        """Return the criterion [m]."""
        return self.sample.value(self.task, points)

    def log_value_and_slope(self, points: FloatArray) -> tuple[float, FloatArray]:
        """Return the logarithm of the criterion, and its derivative (N, 3) [1/m]."""
        return self.sample.log_value_and_slope(self.task, points)


@dataclass(frozen=True, eq=False)
class Descent:
    """End of a descent.

    Attributes
    ----------
    points : ndarray, shape (n, 3)
        Best points.
    value : float
        Criterion of its sample at these points.
    converged : bool
        True if the criterion stopped falling; otherwise the iterations ran out.
    """

    points: FloatArray
    value: float
    iterations: int
    converged: bool


def move_into_volume(task: Placement, sensors: FloatArray) -> FloatArray:
    """Move points (n, 3) into a volume and apart from each other [m]."""
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
        # Points in one place have no direction of separation. One direction for all pairs: their pushes do not cancel.
        parting = np.where(distance > 1e-12, apart / np.maximum(distance, 1e-12), _PARTING)
        push = 0.5 * (1.0 + 1e-6) * np.maximum(0.0, task.least_spacing_m - distance) * parting
        moved = inside.copy()
        np.add.at(moved, i, push)
        np.add.at(moved, j, -push)
        inside = task.volume.nearest(moved)
    return inside


def is_spaced(task: Placement, sensors: FloatArray) -> bool:
    """Return True if all points are at least the least spacing apart, to a part in a million."""
    return bool(pdist(sensors).min() >= task.least_spacing_m * (1.0 - 1e-6))


def descend(
    problem: DesignProblem,
    start: FloatArray,
    *,
    max_iterations: int,
    step_done: Callable[[int], None] = lambda _: None,
) -> Descent:
    """Descend from points (n, 3), moved inside, until the criterion stops falling."""
    x = problem.move_inside(start)
    value, slope = problem.log_value_and_slope(x)
    best, best_x = value, x
    history, bests = [value], [value]
    steepest = float(np.abs(slope).max())
    length = _FIRST_STEP * problem.radius / steepest if steepest > 0.0 else 0.0
    longest = problem.radius**2 * 10.0
    iteration, converged = 0, steepest == 0.0 and np.isfinite(value)
    while iteration < max_iterations and not converged and np.isfinite(value):
        iteration += 1
        new = _step(problem, x, slope, length, max(history[-_MEMORY:]))
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
    problem: DesignProblem, x: FloatArray, slope: FloatArray, length: float, bar: float
) -> tuple[FloatArray, float, FloatArray] | None:
    """Return the next points with value and slope; None if no step is short enough."""
    direction = problem.move_inside(x - length * slope) - x
    steepness = float(np.sum(slope * direction))
    share = 1.0
    while share > _SHORTEST:
        trial = problem.move_inside(x + share * direction)
        if problem.is_spaced(trial):
            value, new_slope = problem.log_value_and_slope(trial)
            if value <= bar + _SUFFICIENT * share * min(steepness, 0.0):
                return trial, value, new_slope
        share *= 0.4
    return None


@dataclass(frozen=True, eq=False)
class Descents:
    """Best result of descents from many starts.

    Attributes
    ----------
    best : Descent
        Best points, with their criterion on the large sample.
    first : ndarray, shape (n, 3)
        Best start.
    first_value : float
        Its criterion on the large sample.
    n_converged, n_refined : int
        Numbers of converged and of all descents on the large sample.
    """

    best: Descent
    first: FloatArray
    first_value: float
    n_converged: int
    n_refined: int


def descend_from_starts(
    small: DesignProblem,
    large: DesignProblem,
    starts: Sequence[FloatArray],
    search: DesignSearch,
    step_done: Callable[[int], None],
    better: Callable[[FloatArray], None],
) -> Descents | None:
    """Descend from many starts on a small sample, and from the best ends on a large one.

    `better` is called with all points that are better than those before. Return None if no start is allowed and has a
    finite criterion.
    """
    places = [small.move_inside(start) for start in starts]
    places = [start for start in places if small.is_spaced(start) and np.isfinite(small.value(start))]
    if not places:
        return None
    values = [large.value(start) for start in places]
    first = int(np.argmin(values))
    best = Descent(places[first], values[first], 0, False)
    better(best.points)

    def run_descent(problem: DesignProblem, start: FloatArray, max_iterations: int) -> Descent:
        """Run a descent, and keep its end if it is the best so far on the large sample."""
        nonlocal best
        end = descend(problem, start, max_iterations=max_iterations, step_done=step_done)
        value = large.value(end.points)
        if value <= best.value:
            best = Descent(end.points, value, end.iterations, end.converged and problem is large)
            better(best.points)
        return end

    rough = [run_descent(small, start, search.small_iterations) for start in places]
    step_done((search.n_starts - len(places)) * search.small_iterations)
    chosen = sorted(rough, key=lambda end: end.value)[: search.n_refined]
    fine = [run_descent(large, end.points, search.large_iterations) for end in chosen]
    return Descents(best, places[first], values[first], sum(end.converged for end in fine), len(fine))
