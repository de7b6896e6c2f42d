r"""Damped least squares: the Levenberg-Marquardt iteration, for problems solved one at a time.

This module has the iteration; the caller supplies the problem as an :class:`Iterate`, with its cost and its damped
step. So a problem may eliminate nuisances, have priors and bounds, and limit its steps.

Source: D. W. Marquardt, "An algorithm for least-squares estimation of nonlinear parameters", J. SIAM 11 (1963).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, Protocol, Self, TypeVar

import numpy as np

from arrays.typing import FloatArray

_LEAST_DAMPING, _LARGEST_DAMPING = 1e-9, 1e8
_FACTOR = 10.0
_ROUNDING = 1e-14  # relative rounding error of a cost


class Iterate(Protocol):
    """Values of all unknowns, with the problem that they belong to."""

    @property
    def cost(self) -> float:
        """Sum of squares of residuals and priors; not finite if the unknowns are invalid."""

    def step(self, damping: float) -> tuple[Self, float]:
        """Return the iterate after a damped step, and the decrease of the cost that the linearisation predicts."""


Point = TypeVar("Point", bound=Iterate)


@dataclass(frozen=True, eq=False)
class Optimum(Generic[Point]):
    """Result of :func:`minimise`.

    Attributes
    ----------
    point : Iterate
        Iterate with the lowest cost.
    iterations : int
        Number of linearisations.
    converged : bool
        True if the last decrease of the cost, actual or predicted, is within the tolerance.
    """

    point: Point
    iterations: int
    converged: bool


def minimise(
    start: Point,
    tolerance: Callable[[Point], float],
    *,
    damping: float = 1e-3,
    last_damping: float = math.inf,
    max_iterations: int = 100,
) -> Optimum[Point]:
    """
    Return the optimum reached by damped steps from a start; no step raises the cost.

    Parameters
    ----------
    start : Iterate
    tolerance : callable
        Function of an iterate. The iteration ends when a step from it lowers the cost, or is predicted to lower it, by
        no more than the returned value.
    damping : float
        Damping of the first step, relative to the information about each unknown.
    last_damping : float
        Largest damping at which the iteration may end. With more damping steps are short far from an optimum too.
    max_iterations : int
        Largest number of linearisations.
    """
    point = start
    for iteration in range(1, max_iterations + 1):
        least = max(tolerance(point), _ROUNDING * point.cost)
        trial, promised = point.step(damping)
        while not (trial.cost < point.cost or (damping <= last_damping and promised <= least)):
            if damping > _LARGEST_DAMPING:
                return Optimum(point, iteration, False)
            damping = max(_FACTOR * damping, _LEAST_DAMPING)
            trial, promised = point.step(damping)
        gained = point.cost - trial.cost
        point = trial if gained > 0.0 else point
        if damping <= last_damping and min(promised, gained) <= least:
            return Optimum(point, iteration, True)
        damping /= _FACTOR
    return Optimum(point, max_iterations, False)


def damped_step(information: FloatArray, gradient: FloatArray, damping: float) -> tuple[FloatArray, float]:
    """
    Return a damped step, and a lower bound of the decrease of the cost that it predicts.

    Parameters
    ----------
    information : ndarray, shape (n, n)
        ``JᵀJ`` with the Jacobian of the residuals, plus the information of priors.
    gradient : ndarray, shape (n,)
        ``Jᵀr``, half of the gradient of the cost.
    damping : float
        Multiple of the diagonal of the information that is added to it.
    """
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(information), np.finfo(np.float64).tiny))
    system = scale[:, None] * information * scale + damping * np.eye(len(scale))
    step = np.asarray(-scale * np.linalg.solve(system, scale * gradient))
    return step, float(-gradient @ step)
