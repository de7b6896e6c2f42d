"""Motion of several sources: Ornstein-Uhlenbeck velocities and rates of turn."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from arrays.typing import FloatArray
from magloc import core
from magloc.tracking import row_filter
from magloc.tracking.motion import turning_step
from magloc.tracking.multi_target.measurement import JointRow
from magloc.tracking.multi_target.state import N_COMMON, N_OF_SOURCE, JointState

_N_TURNING = 12
"""Length of a step without its last number, the noise of the common field."""


@dataclass(frozen=True)
class FreeMotion:
    r"""Independent free motion of sources: Ornstein-Uhlenbeck velocity and rate of turn.

    :math:`\dot p = v`, :math:`\dot v = -v/τ_v + w_v`, :math:`\dot m = ω × m`, :math:`\dot ω = -ω/τ_ω + w_ω`; the
    logarithm of the strength and the common field are random walks.

    Attributes
    ----------
    speed_m_s, turn_rad_s : float
        Standard deviations of v and ω along each axis.
    correlation_s, turn_correlation_s : float
        Correlation times of velocity and rate of turn: τ_v and τ_ω.
    strength_change : float
        Noise of ln |m| [1/√s].
    common_walk_T : float
        Noise of the common field [T/√s].

    Raises
    ------
    ValueError
        A number is not positive and finite.

    Examples
    --------
    >>> import magloc
    >>> motion = magloc.FreeMotion(speed_m_s=0.1)
    >>> motion.correlation_s
    1.5
    """

    speed_m_s: float = 0.5
    turn_rad_s: float = 1.8
    correlation_s: float = 1.5
    turn_correlation_s: float = 0.4
    strength_change: float = 3e-4
    common_walk_T: float = 3e-7

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0.0 < value < math.inf:
                raise ValueError(f"Input {name} must be positive and finite; instead received {value}.")

    def numbers(self, dt_s: float, *, agility: float = 1.0) -> FloatArray:
        """Return the numbers (13,) of a step; `agility` multiplies the noise of velocity and turn."""
        velocity = self.correlation_s, agility * self.speed_m_s
        turning = turning_step(velocity, (self.turn_correlation_s, agility * self.turn_rad_s), dt_s)
        walks = self.strength_change * math.sqrt(dt_s), self.common_walk_T * math.sqrt(dt_s)
        return np.array([*turning, 0.0, *walks])

    def start(self, moment_Am2: FloatArray, position_m: FloatArray, turn_rad: float, log_strength: float) -> FloatArray:
        """Return Cartesian roots (j, 12, 12) of sources (j, 3) with given standard deviations."""
        one = np.eye(3)
        strength = np.sqrt(np.vecdot(moment_Am2, moment_Am2))[:, None, None]
        along = moment_Am2[:, :, None] * moment_Am2[:, None] / strength**2
        S = np.zeros((len(moment_Am2), N_OF_SOURCE, N_OF_SOURCE))
        S[:, :3, :3] = np.reshape(position_m, (-1, 1, 1)) * one
        S[:, 3:6, 3:6] = strength * (turn_rad * (one - along) + log_strength * along)
        S[:, 6:9, 6:9], S[:, 9:, 9:] = self.speed_m_s * one, self.turn_rad_s * one
        return S


def steps_problem(numbers: FloatArray) -> core.Problem:
    """Return the motion of sources in the steps (m, 13) to m rows, as an argument of kernels."""
    turning, walk = np.split(numbers, [_N_TURNING], axis=1)
    added = np.repeat(walk, N_COMMON, axis=1)
    every = np.arange(len(numbers))
    return row_filter.motion_problem(every, (np.ones_like(added), added), turning=np.ascontiguousarray(turning))


def predict_state(state: JointState, step: FloatArray, row: JointRow) -> JointState:
    """Return the predicted state after a step (13,) to a row."""
    found = row_filter.predict(state.gaussians, state.centroid_m, steps_problem(step[None]), row.kernel_rows)
    return state.after(found, row.centroid_m)
