"""How a source moves while the pose of the array errs: the errors are states behind those of the motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from arrays.typing import FloatArray
from magloc.measurement.pose import PoseErrors
from magloc.tracking.motion import MotionModel


@dataclass(frozen=True, eq=False)
class PosedMotion:
    """A motion, and errors of the array's pose that last, or are new in every row."""

    motion: MotionModel
    errors: PoseErrors

    @classmethod
    def of(cls, motion: MotionModel, errors: PoseErrors) -> MotionModel:
        """The motion itself where no errors are stated."""
        return cls(motion, errors) if errors.n_states else motion

    @property
    def speed_m_s(self) -> float:
        """As :class:`MotionModel`."""
        return self.motion.speed_m_s

    @property
    def n_states(self) -> int:
        """As :class:`MotionModel`."""
        return self.motion.n_states + self.errors.n_states

    def start(self, source: FloatArray, S: FloatArray) -> tuple[FloatArray, FloatArray]:
        """As :class:`MotionModel`."""
        x, root = self.motion.start(source, S)
        n_pose = self.errors.n_states
        return np.concatenate([x, np.zeros(n_pose)]), _block(root, np.eye(n_pose))

    def state_of(self, source: FloatArray, velocity_m_s: FloatArray, rate_rad_s: FloatArray) -> FloatArray:
        """As :class:`MotionModel`."""
        return np.concatenate([self.motion.state_of(source, velocity_m_s, rate_rad_s), np.zeros(self.errors.n_states)])

    def step(self, x: FloatArray, dt_s: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """As :class:`MotionModel`."""
        n = self.motion.n_states
        moved, F, S_q = self.motion.step(x[:n], dt_s)
        kept, added = self.errors.step(dt_s)
        return np.concatenate([moved, kept * x[n:]]), _block(F, np.diag(kept)), _block(S_q, np.diag(added))


def _block(first: FloatArray, second: FloatArray) -> FloatArray:
    """Two matrices on one diagonal."""
    n = len(first)
    both = np.zeros((n + len(second), first.shape[1] + second.shape[1]))
    both[:n, : first.shape[1]], both[n:, first.shape[1] :] = first, second
    return both
