r"""One row's readings put into a joint state: an iterated update, and what of the row contradicts it.

With the prediction's covariance :math:`P_{oo} = L L^T` of what a row sees, N = HᵀH of whitened readings and the error
e = L y, every iteration solves :math:`(I + L^T N L) y = L^T H^T (r + H e)`, which is
:math:`e = P_{oo} (I + N P_{oo})^{-1} (H^T r + N e)` in a form that is symmetric and free of units. It ends when
:math:`δe^T N δe` is small, in units of the noise: no rule in millimetres holds at every strength of signal.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from arrays.typing import BoolArray, FloatArray
from magloc import core
from magloc.tracking.multi_target.measurement import JointRow
from magloc.tracking.multi_target.state import N_COMMON, N_SEEN, JointState


@dataclass(frozen=True, eq=False)
class JointUpdate:
    r"""What a row's readings make of a prediction.

    Attributes
    ----------
    prior : JointState
        The prediction.
    row : JointRow
    L, R : ndarray, shape (6 K + 3, 6 K + 3)
        Lower roots of :math:`P_{oo}`, and of I + Lᵀ N L at the end.
    y : ndarray, shape (6 K + 3,)
        The error e = L y that was found.
    residual : ndarray, shape (C,)
        Of whitened readings there.
    HL : ndarray, shape (C, 6 K + 3)
        A root of what the prediction's uncertainty makes of the predicted readings, there.
    innovation : ndarray, shape (C,)
        The residual at the prediction.
    linear : ndarray, shape (C, 6 K + 3)
        The root at the prediction.
    standardised : ndarray, shape (N, 3)
        Post-fit residuals of every sensor's channels with unit covariance; zero for those not used.
    cost : float
        :math:`J = |r|^2 + e^T P^{-1} e`, χ² of the innovation with the number of readings as degrees of freedom.
    converged : bool
    """

    prior: JointState
    row: JointRow
    L: FloatArray
    R: FloatArray
    y: FloatArray
    residual: FloatArray
    HL: FloatArray
    innovation: FloatArray
    linear: FloatArray
    standardised: FloatArray
    cost: float
    converged: bool

    @cached_property
    def log_volume(self) -> float:
        """Logarithm of the determinant of I + N P_oo."""
        return 2.0 * float(np.sum(np.log(np.diagonal(self.R))))

    @cached_property
    def found(self) -> JointState:
        """The state after the row as far as the row sees it: motion and covariance are those of the prediction."""
        return self.prior.moved(self.L @ self.y)

    @cached_property
    def state(self) -> JointState:
        """The state after the row, with its covariance in its own chart."""
        after = JointState.unfilled(self.prior.n_sources)
        work = core.problem("joint_posterior", prior=self.prior.problem, R=self.R, y=self.y, after=after.problem)
        core.run("joint_state_after", work, 1, block=1)
        return after

    @property
    def sensor_chi2(self) -> FloatArray:
        """χ² (N,) with three degrees of freedom of every sensor's residual: tᵀ (I - A P⁺ Aᵀ)⁻¹ t."""
        return np.vecdot(self.standardised, self.standardised)

    @cached_property
    def surprise(self) -> FloatArray:
        """Innovation (C,) less what the prediction's uncertainty explains, to first order.

        Where something new is strong, the iterated update moves what is known onto it, and the residual tells little.
        """
        A = np.eye(self.linear.shape[1]) + self.linear.T @ self.linear
        surprise: FloatArray = self.innovation - self.linear @ np.linalg.solve(A, self.linear.T @ self.innovation)
        return surprise


_FOLLOWED = 1e-3
"""Variance of residuals beside what the fit leaves: a sensor that it follows wholly says nothing of itself."""
MOST_TRIALS = 60
"""Steps of an update that are tried."""


def joint_update(prior: JointState, row: JointRow, most: int = MOST_TRIALS) -> JointUpdate:
    """A predicted state after a row's readings, by damped Gauss-Newton in the chart of the prediction."""
    d, n = prior.n_seen, len(row.z)
    L, R, y, residuals, HL = np.empty((d, d)), np.empty((d, d)), np.empty(d), np.empty((2, n)), np.empty((2, n, d))
    # Channels of vector sensors stand three by three.
    standardised, outcome = np.empty((n // 3, 3)), np.empty(2)
    work = core.problem(
        "joint_update",
        prior=prior.problem,
        row=row.problem,
        most_trials=most,
        followed=_FOLLOWED,
        L=L,
        R=R,
        y=y,
        residuals=residuals,
        HL=HL,
        standardised=standardised,
        outcome=outcome,
    )
    core.run("joint_update_row", work, 1, block=1)
    cost, converged = float(outcome[0]), bool(outcome[1])
    return JointUpdate(prior, row, L, R, y, residuals[1], HL[1], residuals[0], HL[0], standardised, cost, converged)


def innovation_chi2(state: JointState, row: JointRow, sensors: BoolArray) -> FloatArray:
    """χ² (N,) with three degrees of freedom of sensors that a state does not know of; infinite for all others."""
    chi2 = np.full(len(sensors), np.inf)
    asked = sensors & row.used.reshape(-1, 3).all(axis=1)
    if not asked.any():
        return chi2
    h, H = row.predicted(state)
    scale = np.ones(state.n_seen)
    of_sources = scale[:-N_COMMON].reshape(-1, N_SEEN)
    of_sources[:, 3:] = np.linalg.norm(state.moment_Am2, axis=1)[:, None]
    seen = (H * scale) @ np.linalg.cholesky(state.P[: state.n_seen, : state.n_seen])
    for sensor in np.flatnonzero(asked):
        at = np.flatnonzero(row.channel_sensor == sensor)
        r = (row.z - h)[at]
        chi2[sensor] = float(r @ np.linalg.solve(np.eye(3) + seen[at] @ seen[at].T, r))
    return chi2
