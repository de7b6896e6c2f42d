"""Iterated update of a joint state by one row, and the residuals of its sensors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from arrays.typing import BoolArray, FloatArray
from magloc.tracking import row_filter
from magloc.tracking.multi_target.measurement import JointRow
from magloc.tracking.multi_target.state import N_COMMON, N_OF_SOURCE, JointState

MOST_TRIALS = 60
"""Largest number of steps of an update."""
_TOLERANCE = 0.1
"""Step, in standard deviations, below which an update ends: it would change χ² by at most 0.01."""


@dataclass(frozen=True, eq=False)
class JointUpdate:
    r"""Update of a prediction by a row's readings.

    Attributes
    ----------
    row : JointRow
    state : JointState
        State after the row.
    cost : float
        :math:`J = |r|^2 + e^T P^{-1} e`, χ² of the innovation with the number of readings as degrees of freedom.
    score : float
        -2 ln of the likelihood of the row, up to a constant: J plus the logarithm of :math:`|I + P H^T H|`.
    converged : bool
    innovation, residual : ndarray, shape (C,)
        Whitened readings minus predicted ones, before and after the update.
    projector_before, projector : ndarray, shape (d, C)
        Q before and after the update: :math:`I - Q^T Q` is the inverse of the covariance of the innovation.
    standardised : ndarray, shape (N, 3)
        Residuals of every sensor's channels, of unit covariance; zero for unused sensors.
    """

    row: JointRow
    state: JointState
    cost: float
    score: float
    converged: bool
    innovation: FloatArray
    residual: FloatArray
    projector_before: FloatArray
    projector: FloatArray
    standardised: FloatArray

    @property
    def sensor_chi2(self) -> FloatArray:
        """Decrease of χ² (N,) if each sensor is excluded, with three degrees of freedom."""
        return np.vecdot(self.standardised, self.standardised)

    @property
    def surprise(self) -> FloatArray:
        """Innovation (C,) minus the part explained by the prediction's uncertainty, to first order.

        The iterated update shifts known sources towards a strong new one, so that the residual shows little of it.
        """
        return self.innovation - (self.projector_before @ self.innovation) @ self.projector_before


def joint_update(prior: JointState, row: JointRow, most: int = MOST_TRIALS) -> JointUpdate:
    """Update a predicted state by a row's readings."""
    found = row_filter.update(prior.gaussians, row.kernel_rows, linearisations=True, most=most, tolerance=_TOLERANCE)
    assert found.misfits is not None
    assert found.projectors is not None
    assert found.standardised is not None
    return JointUpdate(
        row,
        prior.after(found.after, row.centroid_m),
        float(found.nis[0]),
        -2.0 * float(found.log_evidence[0]),
        bool(found.converged[0]),
        innovation=found.misfits[0, 0],
        residual=found.misfits[0, 1],
        projector_before=found.projectors[0, 0],
        projector=found.projectors[0, 1],
        standardised=found.standardised[0],
    )


def innovation_chi2(state: JointState, row: JointRow, sensors: BoolArray) -> FloatArray:
    """Return χ² (N,) of the sensors excluded from a state, of 3 dimensions; infinite for others."""
    chi2 = np.full(len(sensors), np.inf)
    available = sensors & row.used.reshape(-1, 3).all(axis=1)
    if not available.any():
        return chi2
    n = N_OF_SOURCE * state.n_sources
    by_source, h = row.linearise(state)
    L = state.chart.jacobian(np.zeros((state.n_sources, N_OF_SOURCE)))
    H = np.concatenate([*(by_source @ L[:, :6]), row.effect], axis=1) if n else row.effect
    root = H @ np.concatenate([state.S[:n], state.S[-N_COMMON:]])
    for sensor in np.flatnonzero(available):
        at = np.flatnonzero(row.array.channel_sensor == sensor)
        r = (row.z - h)[at]
        chi2[sensor] = float(r @ np.linalg.solve(np.eye(3) + root[at] @ root[at].T, r))
    return chi2
