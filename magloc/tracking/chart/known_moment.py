"""A known moment as a measurement, and a motion with constant modulus."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from arrays.typing import FloatArray
from magloc.localization.fit.prior import SourcePrior
from magloc.measurement.known_moment import KnownMoment
from magloc.tracking.motion import MotionModel

UNIFORM_IN_SPACE = 3.0
"""Power of the range in the density of sources uniform in space; a known moment gives the scale of the range."""


@dataclass(frozen=True, eq=False)
class KnownInWorld:
    """A known moment in the array's axes as a measurement of states in the world frame."""

    moment: KnownMoment
    R_world_from_array: FloatArray

    @classmethod
    def of(cls, prior: SourcePrior, R_world_from_array: FloatArray) -> KnownInWorld | None:
        """Return the known moment, or None without one."""
        return None if prior.known_moment is None else cls(prior.known_moment, R_world_from_array)

    @property
    def n_known(self) -> int:
        """Number of known components."""
        return self.moment.n_known

    def residual(self, state: FloatArray) -> FloatArray:
        """Return the known minus the states' (K, n) values, in standard deviations: (K, n_known)."""
        return self.moment.residual((state[:, 3:6] @ self.R_world_from_array)[:, None])

    def directional_derivative(self, state: FloatArray, directions: FloatArray) -> FloatArray:
        """Return the derivative (K, n_known, m) of the states' values along directions (K, n, m)."""
        by_moment = self.moment.jacobian((state[:, 3:6] @ self.R_world_from_array)[:, None])[:, 0]
        return np.asarray(by_moment @ self.R_world_from_array.T @ directions[:, 3:6])


@dataclass(frozen=True, eq=False)
class ConstantModulus:
    """Motion whose noise turns the moment and keeps its known modulus constant."""

    motion: MotionModel

    @classmethod
    def of(cls, motion: MotionModel, prior: SourcePrior) -> MotionModel:
        """Return the motion, unchanged if no moment is known."""
        return motion if prior.known_moment is None else cls(motion)

    @property
    def speed_m_s(self) -> float:
        """Characteristic speed, see :class:`MotionModel`."""
        return self.motion.speed_m_s

    @property
    def n_states(self) -> int:
        """Length of the state, see :class:`MotionModel`."""
        return self.motion.n_states

    def start(self, source: FloatArray, S: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the state and the square root of its covariance, see :class:`MotionModel`."""
        return self.motion.start(source, S)

    def state_of(self, source: FloatArray, velocity_m_s: FloatArray, rate_rad_s: FloatArray) -> FloatArray:
        """Return the state of a source of known motion, see :class:`MotionModel`."""
        return self.motion.state_of(source, velocity_m_s, rate_rad_s)

    def step(self, x: FloatArray, dt_s: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the prediction, see :class:`MotionModel`."""
        x_next, F, S_q = self.motion.step(x, dt_s)
        unit = x_next[3:6] / max(float(np.linalg.norm(x_next[3:6])), 1e-300)
        S_q = S_q.copy()
        S_q[3:6] -= np.outer(unit, unit @ S_q[3:6])
        return x_next, F, S_q
