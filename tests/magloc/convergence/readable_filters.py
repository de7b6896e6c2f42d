"""The filters of a convergence map for one start, written to be read: the reference of the kernels."""

from __future__ import annotations

import numpy as np

from arrays.typing import FloatArray
from magloc.convergence.filters import DampedFilter, IekfFilter, RepeatedFilter
from magloc.measurement.differences import DifferenceMeasurement
from magloc.state_space import IteratedUpdate, iterated_update, predict, update

# A step that lowers the cost divides the damping, any other multiplies it.
DAMPING_DECREASE, DAMPING_INCREASE = 5.0, 4.0


def run_one(
    method: RepeatedFilter | IekfFilter | DampedFilter,
    measurement: DifferenceMeasurement,
    z: FloatArray,
    start: FloatArray,
) -> IteratedUpdate:
    """End of one start (6,)."""
    if isinstance(method, RepeatedFilter):
        return _repeated(method, measurement, z, start)
    if isinstance(method, DampedFilter):
        return _damped(method, measurement, z, start)
    return iterated_update(
        start,
        np.diag(method.s_0),
        z,
        measurement.variance,
        lambda x: measurement.predicted(x[:3], x[3:]),
        lambda x: measurement.jacobian(x[:3], x[3:]),
        tolerance=method.tolerance_T,
        max_iterations=method.max_iterations,
    )


def _repeated(
    method: RepeatedFilter, measurement: DifferenceMeasurement, z: FloatArray, start: FloatArray
) -> IteratedUpdate:
    """By the square-root filter of :mod:`magloc.state_space`."""
    sigma = np.sqrt(method.noise_inflation * measurement.variance)
    x, S, S_q = start, np.diag(method.s_q), np.diag(method.s_q)
    predicted = measurement.predicted(x[:3], x[3:])
    innovation = z - predicted
    for iteration in range(1, method.max_iterations + 1):
        S = predict(S, np.eye(6), S_q)
        if method.relinearise_every_scalar:
            for j in range(z.size):
                nu = z[j] - measurement.predicted(x[:3], x[3:])[j]
                h = measurement.jacobian(x[:3], x[3:])[j]
                x, S, _ = update(x, S, h[None] / sigma[j], nu[None] / sigma[j])
        else:
            H = measurement.jacobian(x[:3], x[3:])
            x, S, _ = update(x, S, H / sigma[:, None], (z - predicted) / sigma)
        predicted, before = measurement.predicted(x[:3], x[3:]), predicted
        change = float(np.linalg.norm(predicted - before))
        if not np.isfinite(change) or change < method.tolerance_T:
            return IteratedUpdate(x, S, iteration, change < method.tolerance_T, innovation, np.nan)
    return IteratedUpdate(x, S, method.max_iterations, False, innovation, np.nan)


def _damped(
    method: DampedFilter, measurement: DifferenceMeasurement, z: FloatArray, start: FloatArray
) -> IteratedUpdate:
    """In units of the standard deviations of readings and prior."""
    sigma = np.sqrt(measurement.variance)

    def linearised(x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Predicted differences; residuals of readings and prior, and minus their Jacobian."""
        predicted = measurement.predicted(x[:3], x[3:])
        residual = np.concatenate([(z - predicted) / sigma, (start - x) / method.s_0])
        jacobian = measurement.jacobian(x[:3], x[3:]) * method.s_0 / sigma[:, None]
        return predicted, residual, np.concatenate([jacobian, np.eye(6)])

    x, damping, kept = start, method.first_damping, method.first_damping
    predicted, residual, J = linearised(x)
    innovation = z - predicted
    iteration, ended = 0, False
    while not ended:
        iteration += 1
        # The normal equations of M + λ diag M, without M: its diagonal is the columns' square norm.
        Q, R = np.linalg.qr(np.concatenate([J, np.diag(np.sqrt(damping) * np.linalg.norm(J, axis=0))]))
        trial = x + method.s_0 * np.linalg.solve(R, Q[: residual.size].T @ residual)
        at_trial = linearised(trial)
        change = float(np.linalg.norm(at_trial[0] - predicted))
        small = change < method.tolerance_T
        stopped = small and damping == 0.0
        if at_trial[1] @ at_trial[1] < residual @ residual:
            x, kept = trial, kept / DAMPING_DECREASE
            predicted, residual, J = at_trial
        else:
            kept *= DAMPING_INCREASE
        # Damping alone can make a step small: the stop rule is left to the step without it.
        damping = 0.0 if small else kept
        ended = stopped or iteration >= method.max_iterations or not np.all(np.isfinite(residual))
    S: FloatArray = method.s_0[:, None] * np.linalg.inv(np.linalg.qr(J, mode="r"))
    return IteratedUpdate(x, S, iteration, stopped, innovation, np.nan)
