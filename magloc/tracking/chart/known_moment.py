"""A moment that is known before the first row: what is measured with it, and a motion that keeps the modulus."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from arrays.typing import FloatArray
from magloc.localization.fit.prior import SourcePrior
from magloc.measurement.known_moment import KnownMoment
from magloc.tracking.motion import MotionModel

UNIFORM_IN_SPACE = 3.0
"""Power of the range by which places count that are uniform in space: a moment that is known gives a scale."""


@dataclass(frozen=True, eq=False)
class KnownInWorld:
    """What is known of the moment (3,) of a state in the world frame, the array's axes being turned by R (3, 3)."""

    moment: KnownMoment
    R_world_from_array: FloatArray

    @classmethod
    def of(cls, prior: SourcePrior, R_world_from_array: FloatArray) -> KnownInWorld | None:
        """None where nothing is known."""
        return None if prior.known_moment is None else cls(prior.known_moment, R_world_from_array)

    @property
    def n_known(self) -> int:
        """Numbers that are known."""
        return self.moment.n_known

    def residual(self, state: FloatArray) -> FloatArray:
        """What is known less what states (K, n) have, in standard deviations: (K, n_known)."""
        return self.moment.residual((state[:, 3:6] @ self.R_world_from_array)[:, None])

    def directional_derivative(self, state: FloatArray, directions: FloatArray) -> FloatArray:
        """Derivative (K, n_known, m) of what they have along directions (K, n, m)."""
        by_moment = self.moment.jacobian((state[:, 3:6] @ self.R_world_from_array)[:, None])[:, 0]
        return np.asarray(by_moment @ self.R_world_from_array.T @ directions[:, 3:6])


@dataclass(frozen=True, eq=False)
class ConstantModulus:
    """A motion of which the noise turns the moment, and does not change its modulus: that is known."""

    motion: MotionModel

    @classmethod
    def of(cls, motion: MotionModel, prior: SourcePrior) -> MotionModel:
        """The motion itself where no moment is known."""
        return motion if prior.known_moment is None else cls(motion)

    @property
    def speed_m_s(self) -> float:
        """As :class:`MotionModel`."""
        return self.motion.speed_m_s

    @property
    def n_states(self) -> int:
        """As :class:`MotionModel`."""
        return self.motion.n_states

    def start(self, source: FloatArray, S: FloatArray) -> tuple[FloatArray, FloatArray]:
        """As :class:`MotionModel`."""
        return self.motion.start(source, S)

    def state_of(self, source: FloatArray, velocity_m_s: FloatArray, rate_rad_s: FloatArray) -> FloatArray:
        """As :class:`MotionModel`."""
        return self.motion.state_of(source, velocity_m_s, rate_rad_s)

    def step(self, x: FloatArray, dt_s: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """As :class:`MotionModel`."""
        moved, F, S_q = self.motion.step(x, dt_s)
        unit = moved[3:6] / max(float(np.linalg.norm(moved[3:6])), 1e-300)
        S_q = S_q.copy()
        S_q[3:6] -= np.outer(unit, unit @ S_q[3:6])
        return moved, F, S_q
