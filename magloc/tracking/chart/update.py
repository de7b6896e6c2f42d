r"""Iterated update of many states with nearly flat priors, for the start of a track.

Errors are in the coordinates of :mod:`magloc.tracking.coordinates`; lasting errors of sensors are noise. Updates by
later rows are in :mod:`magloc.tracking.row_filter`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from arrays.typing import BoolArray, FloatArray, IntArray
from magloc.tracking.chart.known_moment import KnownInWorld
from magloc.tracking.chart.stack import RowOrStack, Stack
from magloc.tracking.coordinates import Chart
from magloc.tracking.row_filter import LEAST_GAIN, MOST_ITERATIONS, ROUNDING, TOLERANCE


@dataclass(frozen=True, eq=False)
class StateUpdates:
    """States after a row's readings.

    Attributes
    ----------
    x, S : ndarray, shapes (K, n) and (K, n, n)
    nis : ndarray, shape (K,)
        Least sum of squares of whitened residual and correction.
    chi2 : ndarray, shape (K,)
        Part of `nis` by the residual.
    log_evidence : ndarray, shape (K,)
        Log-likelihood of the readings up to a constant, by Laplace's method.
    converged : ndarray, shape (K,)
    """

    x: FloatArray
    S: FloatArray
    nis: FloatArray
    chi2: FloatArray
    log_evidence: FloatArray
    converged: BoolArray


def update_states(
    x: FloatArray, S: FloatArray, measurement: RowOrStack, known: KnownInWorld | None = None
) -> StateUpdates:
    r"""Update states (K, n) with roots (K, n, n), each by its own Gauss-Newton iteration.

    Steps in the coordinates e are halved if they do not improve the fit. With the covariance C of the readings,

    .. math:: \min_e |C^{-1/2}(z - h(x \oplus e))|^2 + e^T P^{-1} e.

    A `known` moment is a further measurement.
    """
    problem = _UpdateProblem.of(measurement.chart(x).with_firm_moments(S), S, measurement, known)
    (K, n), k = x.shape, measurement.z.size + (0 if known is None else known.n_known)
    zeta = np.zeros((K, n))
    residual = problem.residual(zeta)
    cost = np.sum(residual * residual, axis=1)
    J, step = np.zeros((K, k + n, n)), np.zeros((K, n))
    length, gain, iterations = np.ones(K), np.zeros(K), 0
    converged, stale = np.zeros(K, dtype=bool), np.ones(K, dtype=bool)
    live = np.arange(K)
    while True:
        fresh = live[stale[live]]
        if fresh.size:
            J[fresh] = problem.take(fresh).jacobian(zeta[fresh])
            step[fresh], gain[fresh] = _whole_step(J[fresh], residual[fresh])
            length[fresh], stale[fresh] = 1.0, False
            converged[fresh] = gain[fresh] < TOLERANCE**2
        live = live[~converged[live]]
        if not live.size or iterations >= MOST_ITERATIONS:
            break
        iterations += 1
        zeta_trial = zeta[live] + length[live, None] * step[live]
        with np.errstate(all="ignore"):
            residual_trial = problem.take(live).residual(zeta_trial)
            cost_trial = np.sum(residual_trial**2, axis=1)
        better = cost_trial <= cost[live] - LEAST_GAIN * length[live] * gain[live] + ROUNDING * (1.0 + cost[live])
        length[live[~better]] *= 0.5
        at = live[better]
        zeta[at], residual[at], cost[at] = zeta_trial[better], residual_trial[better], cost_trial[better]
        stale[at] = True
    R = np.asarray(np.linalg.qr(J, mode="r"))
    log_N = 2.0 * np.sum(np.log(np.abs(np.diagonal(R, axis1=-2, axis2=-1))), axis=1)
    x_after, S_after = problem.posterior(zeta, R)
    converged &= is_regular(S_after)
    chi2 = np.sum(residual[:, :k] ** 2, axis=1)
    return StateUpdates(x_after, S_after, cost, chi2, -0.5 * (cost + log_N + problem.log_C), converged)


def is_regular(S: FloatArray) -> BoolArray:
    """Return whether roots (K, n, n) are finite and of full rank: a start that leads nowhere may end anywhere."""
    with np.errstate(all="ignore"):
        return np.asarray(np.isfinite(S).all(axis=(1, 2)) & (np.abs(np.linalg.det(S)) > 0.0))


def _whole_step(J: FloatArray, residual: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the step (K, n) that minimises |residual - J step|², and the decrease (K,)."""
    R = np.asarray(np.linalg.qr(np.concatenate([J, residual[..., None]], axis=2), mode="r"))
    n = J.shape[-1]
    return np.asarray(np.linalg.solve(R[:, :n, :n], R[:, :n, n:])[..., 0]), np.sum(R[:, :n, n] ** 2, axis=1)


@dataclass(frozen=True, eq=False)
class _UpdateProblem:
    """Least-squares problem of a row in standardised coordinates ζ, e = S ζ."""

    chart: Chart
    S: FloatArray
    measurement: RowOrStack
    whiten: FloatArray
    log_C: FloatArray
    known: KnownInWorld | None

    @classmethod
    def of(cls, chart: Chart, S: FloatArray, measurement: RowOrStack, known: KnownInWorld | None) -> _UpdateProblem:
        K, k = len(S), measurement.z.size
        if not isinstance(measurement, Stack):
            return cls(chart, S, measurement, np.broadcast_to(np.eye(k), (K, k, k)), np.zeros(K), known)
        root = np.linalg.cholesky(measurement.covariance(chart.x))
        log_C = 2.0 * np.sum(np.log(np.diagonal(root, axis1=-2, axis2=-1)), axis=1)
        return cls(chart, S, measurement, np.linalg.inv(root), log_C, known)

    def take(self, index: IntArray) -> _UpdateProblem:
        """Return the problem of some of the states."""
        if len(index) == len(self.S):
            return self
        chart, whiten = self.chart.take(index), self.whiten[index]
        return replace(self, chart=chart, S=self.S[index], whiten=whiten, log_C=self.log_C[index])

    def e(self, zeta: FloatArray) -> FloatArray:
        """Return the coordinates (K, n) e = S ζ."""
        return (self.S @ zeta[..., None])[..., 0]

    def residual(self, zeta: FloatArray) -> FloatArray:
        """Return whitened misfits (K, k + n) of the readings and of the prediction."""
        state = self.chart.retract(self.e(zeta))
        left = (self.whiten @ (self.measurement.z - self.measurement.predict_source(state))[..., None])[..., 0]
        if self.known is not None:
            left = np.concatenate([left, self.known.residual(state)], axis=1)
        return np.concatenate([left, -zeta], axis=1)

    def jacobian(self, zeta: FloatArray) -> FloatArray:
        """Return minus the derivative (K, k + n, n) of :meth:`residual` by ζ."""
        state, L = self.chart.linearise(self.e(zeta))
        J = self.whiten @ self.measurement.directional_derivative(state, L)
        if self.known is not None:
            J = np.concatenate([J, self.known.directional_derivative(state, L)], axis=1)
        return np.concatenate([J @ self.S, np.broadcast_to(np.eye(zeta.shape[1]), self.S.shape)], axis=1)

    def posterior(self, zeta: FloatArray, R: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return states and roots, from the upper root R (K, n, n) of the information about ζ."""
        x, L = self.chart.linearise(self.e(zeta))
        root = np.linalg.solve(np.swapaxes(R, -1, -2), np.swapaxes(self.S, -1, -2))
        return x, self.measurement.chart(x).inverse_jacobian() @ L @ np.swapaxes(root, -1, -2)
