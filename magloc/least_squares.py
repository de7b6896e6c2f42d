r"""Damped least squares: the Levenberg-Marquardt iteration, for problems solved one at a time.

The iteration is here, the problem is its user's: an iterate knows its cost, and what a damped step from it leads to.
So a problem may eliminate nuisances, have priors and bounds, and limit its steps.

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
_ROUNDING = 1e-14  # of a cost


class Iterate(Protocol):
    """Values of all unknowns, and the problem about them."""

    @property
    def cost(self) -> float:
        """Sum of squares of residuals and priors; not finite where the unknowns have no meaning."""

    def step(self, damping: float) -> tuple[Self, float]:
        """Return the iterate after a damped step, and by how much the linearised problem promises to lower the cost."""


Point = TypeVar("Point", bound=Iterate)


@dataclass(frozen=True, eq=False)
class Optimum(Generic[Point]):
    """Where an iteration ended.

    Attributes
    ----------
    point : Iterate
        The best one.
    iterations : int
        Linearisations.
    converged : bool
        Whether the last step lowered the cost by no more than the tolerance, or promised to.
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
    Return the optimum that damped steps from a start lead to: none of them raises the cost.

    Parameters
    ----------
    start : Iterate
    tolerance : callable
        Of an iterate: by how much a step from it lowers the cost, or promises to, where the iteration ends.
    damping : float
        Of the first step, relative to the information about each unknown.
    last_damping : float
        Largest damping of a step that may be the last one: more shortens steps, far from an optimum too.
    max_iterations : int
        Linearisations at most.
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
    Return a step that lowers a cost, and by how much it promises to at least.

    Parameters
    ----------
    information : ndarray, shape (n, n)
        ``JᵀJ`` of the residuals' derivatives, and that of priors.
    gradient : ndarray, shape (n,)
        ``Jᵀr``, half of that of the cost.
    damping : float
        Share of its diagonal that is added to the information.
    """
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(information), np.finfo(np.float64).tiny))
    system = scale[:, None] * information * scale + damping * np.eye(len(scale))
    step = np.asarray(-scale * np.linalg.solve(system, scale * gradient))
    return step, float(-gradient @ step)
