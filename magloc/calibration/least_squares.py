"""Least squares for an array and what moves past it, with the unknowns of the rows eliminated.

The unknowns of a row touch no other row. They are eliminated by a QR factorisation of their own few columns, batched
over the rows (the Schur complement in its orthogonal form), so that a step solves one linear system in the unknowns of
the sensors and of the source or body alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Generic

import numpy as np

from arrays.typing import FloatArray
from magloc.calibration.sensors import PER_SENSOR, Linearisation, SensorProblem, State
from magloc.least_squares import Optimum, damped_step, minimise

# Enough to keep unknowns without information in place, too little to count as information.
_NO_DAMPING, _LAST_DAMPING = 1e-20, 1e-2
_LEAST_SHARE = 1e-10


@dataclass(frozen=True, eq=False)
class ReducedEquations:
    """Normal equations of sensors and source after elimination of the rows' unknowns.

    Attributes
    ----------
    information : ndarray, shape (P, P)
        Information of the readings alone. The P unknowns are the F free ones of the sensors, then those of the source.
    gradient : ndarray, shape (P,)
        Gradient of half of χ².
    by_row, row_gradient, row_factor : ndarray, shapes (T, n, P), (T, n), (T, n, n)
        Factors for :func:`row_step`.
    """

    information: FloatArray
    gradient: FloatArray
    by_row: FloatArray
    row_gradient: FloatArray
    row_factor: FloatArray


def eliminate_rows(
    problem: SensorProblem[State],
    linear: Linearisation,
    row_prior: tuple[FloatArray, FloatArray],
    damping: float = _NO_DAMPING,
) -> ReducedEquations:
    """Return the normal equations of sensors and source, with the rows' unknowns eliminated.

    The prior of the rows' unknowns is 1/σ and their deviation from it, (T, n) each. The damping of the rows' unknowns
    is relative to their information.

    With the rows' columns ``J = Q R`` (priors and damping appended as further rows) what remains of the other columns
    is their part orthogonal to Q.
    """
    n_rows, n_channels, n = linear.by_row.shape
    n_sensors = problem.array.n_sensors
    weight, deviation = row_prior
    size = np.sqrt(np.einsum("tcn,tcn->tn", linear.by_row, linear.by_row) + weight**2)
    # An unknown without information keeps a separate column, so that it does not change.
    damped = np.sqrt(damping) * np.where(size > 0.0, size, 1.0)[..., None] * np.eye(n)
    stacked = np.concatenate([linear.by_row, weight[..., None] * np.eye(n), damped], axis=1)
    q, r = np.linalg.qr(stacked)
    q_readings = q[:, :n_channels]
    row_gradient: FloatArray = np.einsum("tcn,tc->tn", q_readings, linear.residual)
    row_gradient += np.einsum("tan,ta->tn", q[:, n_channels : n_channels + n], weight * deviation)

    blocks = np.swapaxes(q_readings.reshape(n_rows, n_sensors, 3, n), -1, -2) @ linear.by_sensor
    by_row = np.concatenate(
        [
            blocks.transpose(0, 2, 1, 3).reshape(n_rows, n, -1),
            np.swapaxes(q_readings, -1, -2) @ linear.by_source,
        ],
        axis=-1,
    )[..., problem.estimated_indices]
    flat = by_row.reshape(n_rows * n, by_row.shape[-1])
    information, gradient = _normal_equations(linear)
    information = information[np.ix_(problem.estimated_indices, problem.estimated_indices)] - flat.T @ flat
    gradient = gradient[problem.estimated_indices] - flat.T @ row_gradient.ravel()
    return ReducedEquations(information, gradient, by_row, row_gradient, r)


def row_step(equations: ReducedEquations, step: FloatArray) -> FloatArray:
    """Return the step of the rows' unknowns (T, n) that goes with a step (P,) of the others."""
    right = equations.row_gradient + equations.by_row @ step
    return np.asarray(-np.linalg.solve(equations.row_factor, right[..., None])[..., 0], dtype=np.float64)


def information_of_sensors(problem: SensorProblem[State], state: State) -> FloatArray:
    """Return the information (p, p) of the readings on the shared unknowns that have a prior.

    All other unknowns are eliminated. The unit of an unknown is its prior standard deviation.
    """
    information = eliminate_rows(problem, problem.linearise(state), problem.row_priors(state)).information
    n = len(problem.shared_deviations(state))
    cross, own = information[:n, n:], information[n:, n:]
    # The pseudo-inverse allows constants of the source without information.
    return information[:n, :n] - cross @ np.linalg.pinv(own, hermitian=True) @ cross.T


def posterior_covariance(information: FloatArray) -> FloatArray:
    """Return the covariance (p, p) of unknowns with unit priors, to which readings add information."""
    values, vectors = np.linalg.eigh(information)
    return np.asarray((vectors / (1.0 + np.maximum(values, 0.0))) @ vectors.T)  # no rounding makes it negative


@dataclass(frozen=True, eq=False)
class CalibrationIterate(Generic[State]):
    """A state of a problem, as an iterate of :func:`magloc.least_squares.minimise`."""

    problem: SensorProblem[State]
    state: State

    @cached_property
    def cost(self) -> float:
        """χ² of the readings and of all priors."""
        with np.errstate(over="ignore", invalid="ignore"):
            return self.problem.cost(self.state)

    @cached_property
    def _linear(self) -> Linearisation:
        return self.problem.linearise(self.state)

    def step(self, damping: float) -> tuple[CalibrationIterate[State], float]:
        """Return the state after a damped step; the unknowns of the rows are damped too."""
        problem, state = self.problem, self.state
        equations = eliminate_rows(problem, self._linear, problem.row_priors(state), damping)
        # The unit of the unknowns with a prior is the prior's standard deviation.
        deviations = problem.shared_deviations(state)
        n = len(deviations)
        information, gradient = equations.information.copy(), equations.gradient.copy()
        information[range(n), range(n)] += 1.0
        gradient[:n] += deviations
        step, promised = damped_step(information, gradient, damping)
        # No step goes farther than the prior: the field is far from linear in the positions.
        step /= max(1.0, float(np.abs(step[:n]).max(initial=0.0)))
        trial = replace(self, state=problem.after_step(state, step, row_step(equations, step)))
        return trial, promised + float(np.sum(equations.row_gradient**2))


def fit_state(
    problem: SensorProblem[State], start: State, *, tolerance: float = 1e-3, max_iterations: int = 100
) -> Optimum[CalibrationIterate[State]]:
    """Minimise χ² by Levenberg-Marquardt steps.

    Stop when a step promises to lower χ² by less than the tolerance or a part in 10¹⁰.
    """

    def least(fit: CalibrationIterate[State]) -> float:
        return max(tolerance, _LEAST_SHARE * fit.cost)

    return minimise(
        CalibrationIterate(problem, start), least, last_damping=_LAST_DAMPING, max_iterations=max_iterations
    )


def _normal_equations(linear: Linearisation) -> tuple[FloatArray, FloatArray]:
    """Return information and gradient before the rows' unknowns are eliminated."""
    n_rows, n_sensors = linear.by_sensor.shape[:2]
    n, g = n_sensors * PER_SENSOR, linear.by_source.shape[-1]
    information, gradient = np.zeros((n + g, n + g)), np.zeros(n + g)
    by_source = linear.by_source.reshape(n_rows, n_sensors, 3, g)
    residual = linear.residual.reshape(n_rows, n_sensors, 3)
    for i in range(n_sensors):
        block = slice(i * PER_SENSOR, (i + 1) * PER_SENSOR)
        own = linear.by_sensor[:, i].reshape(-1, PER_SENSOR)
        information[block, block] = own.T @ own
        information[block, n:] = own.T @ by_source[:, i].reshape(3 * n_rows, g)
        gradient[block] = own.T @ residual[:, i].ravel()
    flat = by_source.reshape(3 * n_rows * n_sensors, g)
    information[n:, :n] = information[:n, n:].T
    information[n:, n:] = flat.T @ flat
    gradient[n:] = flat.T @ linear.residual.ravel()
    return information, gradient
