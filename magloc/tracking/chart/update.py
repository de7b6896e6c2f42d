r"""One step of the filter in the coordinates of :mod:`magloc.tracking.chart.coordinates`, of many states side by side.

The root of a covariance is block-triangular: the states of the source and its motion first, behind them the sensors'
lasting errors,

.. math:: S = \begin{pmatrix} A & B \\ 0 & D \end{pmatrix},

so that D alone is the root of what is known of the errors. A step of the motion leaves it as it is, and the iteration
of an update is one in the source's few coordinates, the errors being part of the readings' noise in it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from arrays.typing import BoolArray, FloatArray, IntArray
from magloc.tracking.chart.coordinates import Chart
from magloc.tracking.chart.known_moment import KnownInWorld
from magloc.tracking.chart.mixture import root_of
from magloc.tracking.chart.stack import Measured, Stack

TOLERANCE = 1e-3
"""Stop of the iteration: length of the next step in posterior standard deviations."""
LEAST_GAIN = 0.25
"""Of the decrease that a linear problem would show, below which a step is halved: it leads across a valley."""
MOST_ITERATIONS = 50
# Steps that make the fit worse by more than rounding are halved.
ROUNDING = 1e-9
LEAST_SHARE = 0.02
"""A prediction bends as a row's readings do along what the row tells, in standard deviations of the prediction, more
than this: of less the other rows told, which may bend otherwise."""


@dataclass(frozen=True, eq=False)
class Move:
    """A step in Cartesian states: transition (K, n, n), root of its noise (K, n, m), and both of the errors (N,)."""

    F: FloatArray
    S_q: FloatArray
    kept: FloatArray
    added: FloatArray


def predicted_root(before: Chart, after: Chart, S: FloatArray, move: Move) -> FloatArray:
    """Roots (K, N, N) after a move."""
    n = move.F.shape[-1]
    inverse = after.inverse_jacobian()
    transition = inverse @ move.F @ before.jacobian(np.zeros_like(before.x))
    columns = [transition @ S[..., :n, :n], inverse @ move.S_q]
    moved = np.zeros_like(S)
    if S.shape[-1] > n:
        B, D = transition @ S[..., :n, n:], move.kept[:, None] * S[..., n:, n:]
        noisy = np.flatnonzero(move.added)
        if noisy.size:
            noise = np.zeros((*D.shape[:-1], noisy.size))
            noise[..., noisy, np.arange(noisy.size)] = move.added[noisy]
            Q, R = np.linalg.qr(np.swapaxes(np.concatenate([D, noise], axis=-1), -1, -2))
            D = np.swapaxes(R, -1, -2)
            wide = np.concatenate([B, np.zeros((*B.shape[:-1], noisy.size))], axis=-1)
            B = wide @ Q
            columns.append(wide - B @ np.swapaxes(Q, -1, -2))
        moved[..., :n, n:], moved[..., n:, n:] = B, D
    moved[..., :n, :n] = root_of(np.concatenate(columns, axis=-1))
    return moved


@dataclass(frozen=True, eq=False)
class Updated:
    """States after a row's readings.

    Attributes
    ----------
    x, S : ndarray, shapes (K, N) and (K, N, N)
    nis : ndarray, shape (K,)
        Least sum of squares of residual and correction in units of their noise.
    chi2 : ndarray, shape (K,)
        The residual's part of it.
    log_evidence : ndarray, shape (K,)
        Logarithm of how likely the readings were, up to a constant: Laplace's method.
    iterations, converged : ndarray, shape (K,)
    residual, J : ndarray, shapes (K, k + n) and (K, k + n, n)
        Whitened misfits of the readings and of the prediction where the iteration ended, and minus their derivative.
    """

    x: FloatArray
    S: FloatArray
    nis: FloatArray
    chi2: FloatArray
    log_evidence: FloatArray
    iterations: IntArray
    converged: BoolArray
    residual: FloatArray
    J: FloatArray

    def whitened_innovation(self, index: int) -> FloatArray:
        """Innovation (k,) of a state freed of correlations, whose square is its NIS: ``L⁻¹ ν``, L lower triangular."""
        J, residual = self.J[index], self.residual[index]
        k = len(residual) - J.shape[1]
        G = np.linalg.solve(J[k:].T, J[:k].T).T
        # Not of 1 + G Gᵀ, in which a prediction that knows next to nothing leaves nothing of the 1.
        root = root_of(np.concatenate([np.eye(k), G], axis=1))
        root *= np.sign(np.diagonal(root))
        return np.asarray(np.linalg.solve(root, residual[:k] - G @ residual[k:]))


def updated(
    x: FloatArray,
    S: FloatArray,
    measurement: Measured,
    bends: BoolArray,
    lasting: Measured | None = None,
    known: KnownInWorld | None = None,
) -> Updated:
    r"""Iterated update of states (K, N) with roots (K, N, N), each on its own.

    Gauss-Newton's steps in the source's coordinates e, halved where they make the fit worse: with the prediction
    Gaussian in e and the errors' conditional mean and covariance C as part of the readings,

    .. math:: \min_e |C^{-1/2}(z - h(x \oplus e) - \ldots)|^2 + e^T P^{-1} e.

    Predictions bend as `lasting` does: the row, where of the pose's errors only those have an effect that the rows
    before had as well. What is `known` of the moment is measured with it, of a row without errors of sensors.
    """
    n = measurement.n_motion
    chart = measurement.chart(x[:, :n]).firmly(S)
    problem = replace(_Problem.of(chart, x, S, measurement).bent(bends, lasting or measurement), known=known)
    K, k = len(x), measurement.z.size + (0 if known is None else known.n_known)
    zeta = np.zeros((K, n))
    residual = problem.residual(zeta)
    cost = np.sum(residual * residual, axis=1)
    J, step = np.zeros((K, k + n, n)), np.zeros((K, n))
    length, gain, iterations = np.ones(K), np.zeros(K), np.zeros(K, dtype=np.intp)
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
        if not live.size or iterations.max() >= MOST_ITERATIONS:
            break
        iterations[live] += 1
        there = zeta[live] + length[live, None] * step[live]
        with np.errstate(all="ignore"):
            residual_there = problem.take(live).residual(there)
            cost_there = np.sum(residual_there**2, axis=1)
        better = cost_there <= cost[live] - LEAST_GAIN * length[live] * gain[live] + ROUNDING * (1.0 + cost[live])
        length[live[~better]] *= 0.5
        moved = live[better]
        zeta[moved], residual[moved], cost[moved] = there[better], residual_there[better], cost_there[better]
        stale[moved] = True
    R = np.asarray(np.linalg.qr(J, mode="r"))
    log_N = 2.0 * np.sum(np.log(np.abs(np.diagonal(R, axis1=-2, axis2=-1))), axis=1)
    x_after, S_after = problem.posterior(zeta, residual, R)
    # A start that leads nowhere may end where nothing is a number.
    with np.errstate(all="ignore"):
        converged &= np.isfinite(S_after).all(axis=(1, 2)) & (np.abs(np.linalg.det(S_after[:, :n, :n])) > 0.0)
    chi2 = np.sum(residual[:, :k] ** 2, axis=1)
    # The prediction's density is that of bent numbers: by ζ it is the greater, the more they bend.
    log_bent = np.linalg.slogdet(J[:, k:])[1]
    log_evidence = log_bent - 0.5 * (cost + log_N + problem.log_C)
    return Updated(x_after, S_after, cost, chi2, log_evidence, iterations, converged, residual, J)


def damped_inverse(J: FloatArray) -> FloatArray:
    """M (K, n, k) with M J = 1 along what J (K, k, n) measures well enough, and 0 where it measures next to nothing."""
    n = J.shape[2]
    Q, R = np.linalg.qr(np.concatenate([J, np.broadcast_to(LEAST_SHARE * np.eye(n), (len(J), n, n))], axis=1))
    return np.asarray(np.linalg.solve(R, _T(Q[:, : J.shape[1]])))


def _whole_step(J: FloatArray, residual: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Gauss and Newton's step (K, n) towards the least |residual - J step|², and by how much that is less (K,)."""
    R = np.asarray(np.linalg.qr(np.concatenate([J, residual[..., None]], axis=2), mode="r"))
    n = J.shape[-1]
    return np.asarray(np.linalg.solve(R[:, :n, :n], R[:, :n, n:])[..., 0]), np.sum(R[:, :n, n] ** 2, axis=1)


@dataclass(frozen=True, eq=False)
class _Problem:
    """A row in standard numbers ζ of the source alone, e = U ζ, whitened by ``C^{-1/2} = whiten``."""

    chart: Chart
    x: FloatArray
    S: FloatArray
    measurement: Measured
    lasting: Measured
    U: FloatArray
    z: FloatArray
    whiten: FloatArray | None
    of_errors: FloatArray
    log_C: FloatArray
    M: FloatArray
    J: FloatArray
    h: FloatArray
    known: KnownInWorld | None = None

    @classmethod
    def of(cls, chart: Chart, x: FloatArray, S: FloatArray, measurement: Measured) -> _Problem:
        n, k, K = measurement.n_motion, measurement.z.size, len(x)
        z = np.broadcast_to(measurement.z, (K, k))
        straight = np.zeros((K, n, k)), np.zeros((K, k, n)), np.zeros((K, k))
        if isinstance(measurement, Stack):
            root = np.linalg.cholesky(measurement.covariance(x))
            whiten = np.linalg.inv(root)
            log_C = 2.0 * np.sum(np.log(np.diagonal(root, axis1=-2, axis2=-1)), axis=1)
            z = (whiten @ z[..., None])[..., 0]
            return cls(chart, x, S, measurement, measurement, S, z, whiten, np.zeros((K, k, n)), log_C, *straight)
        if not measurement.effect.shape[1]:
            return cls(chart, x, S, measurement, measurement, S, z, None, np.zeros((K, k, 0)), np.zeros(K), *straight)
        U = root_of(S[:, :n])
        phi = measurement.effect @ S[:, n:, n:]
        psi = phi @ np.swapaxes(np.linalg.solve(U, S[:, :n, n:]), -1, -2)
        C = np.eye(k) + phi @ np.swapaxes(phi, -1, -2) - psi @ np.swapaxes(psi, -1, -2)
        root = np.linalg.cholesky(C)
        whiten = np.linalg.inv(root)
        log_C = 2.0 * np.sum(np.log(np.diagonal(root, axis1=-2, axis2=-1)), axis=1)
        z = (whiten @ (z - x[:, n:] @ measurement.effect.T)[..., None])[..., 0]
        return cls(chart, x, S, measurement, measurement, U, z, whiten, whiten @ psi, log_C, *straight)

    def take(self, index: IntArray) -> _Problem:
        """Some of the states."""
        if len(index) == len(self.x):
            return self
        whiten = None if self.whiten is None else self.whiten[index]
        return replace(
            self,
            chart=self.chart.take(index),
            x=self.x[index],
            S=self.S[index],
            U=self.U[index],
            z=self.z[index],
            whiten=whiten,
            of_errors=self.of_errors[index],
            log_C=self.log_C[index],
            M=self.M[index],
            J=self.J[index],
            h=self.h[index],
        )

    def e(self, zeta: FloatArray) -> FloatArray:
        """Coordinates (K, n)."""
        return (self.U @ zeta[..., None])[..., 0]

    def bent(self, bends: BoolArray, lasting: Measured) -> _Problem:
        """The same, the prediction being Gaussian in what the row measures where it bends so: see :func:`updated`."""
        if not bends.any():
            return self
        here = np.zeros_like(self.chart.x)
        J = self._derivative(lasting, here)
        M = damped_inverse(J)
        M[~bends] = 0.0
        return replace(self, lasting=lasting, M=M, J=J, h=self._predicted(lasting, here))

    def _whitened(self, values: FloatArray) -> FloatArray:
        return values if self.whiten is None else self.whiten @ values

    def _predicted(self, measurement: Measured, e: FloatArray) -> FloatArray:
        """Whitened predictions (K, k) without errors of sensors."""
        h = measurement.of_source(self.chart.retracted(e))
        return np.asarray(self._whitened(h[..., None])[..., 0])

    def _derivative(self, measurement: Measured, e: FloatArray) -> FloatArray:
        """Their derivative (K, k, n) by ζ."""
        return self._whitened(self._of_coordinates(measurement, e)) @ self.U

    def residual(self, zeta: FloatArray) -> FloatArray:
        """Whitened misfits of the readings and of the prediction (K, k + n)."""
        e = self.e(zeta)
        h = bent = self._predicted(self.measurement, e)
        if self.lasting is not self.measurement:
            bent = self._predicted(self.lasting, e)
        standard = zeta + (self.M @ ((bent - self.h)[..., None] - self.J @ zeta[..., None]))[..., 0]
        left = self.z - h
        if self.whiten is not None:
            left = left - (self.of_errors @ standard[..., None])[..., 0]
        if self.known is not None:
            left = np.concatenate([left, self.known.residual(self.chart.retracted(e))], axis=1)
        return np.concatenate([left, -standard], axis=1)

    def jacobian(self, zeta: FloatArray) -> FloatArray:
        """Minus its derivative (K, k + n, n) by ζ."""
        e = self.e(zeta)
        J = self._derivative(self.measurement, e)
        standard = self.bending(e, J)
        if self.whiten is not None:
            J = J + self.of_errors @ standard
        if self.known is not None:
            J = np.concatenate([J, self.known.along(*self.chart.linearised(e)) @ self.U], axis=1)
        return np.concatenate([J, standard], axis=1)

    def bending(self, e: FloatArray, J: FloatArray) -> FloatArray:
        """Derivative (K, n, n), by ζ, of the numbers in which the prediction is standard, from J of the readings."""
        if self.lasting is not self.measurement:
            J = self._derivative(self.lasting, e)
        return np.eye(J.shape[2]) + self.M @ (J - self.J)

    def _of_coordinates(self, measurement: Measured, e: FloatArray) -> FloatArray:
        """Derivative (K, k, n) of the source's differences, in units of their noise, by its coordinates."""
        return measurement.along(*self.chart.linearised(e))

    def posterior(self, zeta: FloatArray, residual: FloatArray, R: FloatArray) -> tuple[FloatArray, FloatArray]:
        """States and roots, by misfits (K, k + n) at ζ and the upper root R (K, n, n) of the information about it."""
        n, e = self.measurement.n_motion, self.e(zeta)
        x = self.x.copy()
        x[:, :n] = self.chart.retracted(e)
        after = self.measurement.chart(x[:, :n])
        turned = after.inverse_jacobian() @ self.chart.jacobian(e)
        if not self.measurement.effect.shape[1]:
            root = np.linalg.solve(np.swapaxes(R, -1, -2), np.swapaxes(self.U, -1, -2))
            return x, turned @ np.swapaxes(root, -1, -2)
        return self._posterior_of_errors(x, residual, e, turned)

    def _posterior_of_errors(
        self, x: FloatArray, residual: FloatArray, e: FloatArray, turned: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        n, k = self.measurement.n_motion, self.z.shape[1]
        assert self.whiten is not None
        D = self.S[:, n:, n:]
        phi = self.measurement.effect @ D
        share = np.asarray(np.linalg.solve(self.U, self.S[:, :n, n:]))
        left, standard = _T(self.whiten) @ residual[:, :k, None], -residual[:, k:, None]
        of_source = standard - share @ (_T(phi) @ left)
        x[:, n:] += (D @ (_T(share) @ of_source + _T(phi) @ left))[..., 0]
        H = self._of_coordinates(self.measurement, e)
        # The prediction's root, as it looks there.
        bending = self.U @ self.bending(e, self.whiten @ H @ self.U) @ np.linalg.inv(self.U)
        AB = np.asarray(np.linalg.solve(bending, self.S[:, :n]))
        A, B = AB[..., :n], AB[..., n:]
        HA, one = H @ A, np.eye(k)
        R = np.asarray(np.linalg.qr(np.concatenate([HA, np.broadcast_to(np.eye(n), A.shape)], axis=1), mode="r"))
        A_after = _T(np.asarray(np.linalg.solve(_T(R), _T(A))))
        seen = H @ B + phi
        # Where the source is not known by itself, its share of the readings is noise to the errors.
        axes, length, _ = np.linalg.svd(HA, full_matrices=False)
        theta = seen + axes @ ((1.0 / np.sqrt(1.0 + length**2) - 1.0)[..., None] * (_T(axes) @ seen))
        root = np.asarray(np.linalg.cholesky(one + theta @ _T(theta)))
        back = np.linalg.solve(_T(root), np.linalg.solve(root + one, theta))
        B = B - A_after @ (_T(A_after) @ (_T(H) @ seen))
        S = np.zeros_like(self.S)
        S[:, :n, :n] = turned @ A_after
        S[:, :n, n:] = turned @ (B - (B @ _T(theta)) @ back)
        S[:, n:, n:] = D - (D @ _T(theta)) @ back
        return x, S


def _T(matrices: FloatArray) -> FloatArray:
    return np.swapaxes(matrices, -1, -2)
