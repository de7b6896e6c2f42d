"""How sources move that are followed together: speeds and rates of turn that are forgotten."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from arrays.typing import FloatArray
from magloc import core
from magloc.tracking.motion import wandering_step
from magloc.tracking.multi_target.state import N_OF_SOURCE, JointState

P_, C_, V_, W_ = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)


@dataclass(frozen=True)
class FreeMotion:
    r"""Sources that move and turn freely and independently of each other: Ornstein-Uhlenbeck velocity and rate of turn.

    :math:`\dot p = v`, :math:`\dot v = -v/τ_v + w_v`, :math:`\dot m = ω × m`, :math:`\dot ω = -ω/τ_ω + w_ω`; the
    logarithm of the strength and the common field are random walks.

    Attributes
    ----------
    speed_m_s, turn_rad_s : float
        Standard deviations of v and ω along each axis.
    correlation_s, turn_correlation_s : float
        How long a velocity and a rate of turn last: τ_v and τ_ω.
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
        """Return the numbers (12,) of a step for its kernel; `agility` multiplies the noise of velocity and turn."""
        lasts_s, kept, root_v = wandering_step(self.correlation_s, dt_s)
        turn_lasts_s, turn_kept, root_w = wandering_step(self.turn_correlation_s, dt_s)
        of_p_v = (agility * self.speed_m_s) ** 2 * (root_v @ root_v.T)
        of_c_w = (agility * self.turn_rad_s) ** 2 * (root_w @ root_w.T)
        upper = np.array([0, 0, 1]), np.array([0, 1, 1])
        walks = self.strength_change**2 * dt_s, self.common_walk_T**2 * dt_s
        return np.array([lasts_s, kept, turn_lasts_s, turn_kept, *of_p_v[upper], *of_c_w[upper], *walks])

    def predicted(self, state: JointState, dt_s: float, *, agility: float = 1.0) -> JointState:
        """State after a step without readings; `agility` times the noise of velocity and turn."""
        return stepped(state, self.numbers(dt_s, agility=agility))

    def start(
        self, direction: FloatArray, position_m: FloatArray | float, turn_rad: float, log_strength: float
    ) -> FloatArray:
        """Covariance (..., 12, 12) of sources of which so much is known, whose moments point along unit vectors."""
        P = np.zeros((*direction.shape[:-1], N_OF_SOURCE, N_OF_SOURCE))
        along, one = direction[..., :, None] * direction[..., None, :], np.eye(3)
        P[..., P_, P_] = np.square(position_m)[..., None, None] * one
        P[..., V_, V_], P[..., W_, W_] = self.speed_m_s**2 * one, self.turn_rad_s**2 * one
        P[..., C_, C_] = turn_rad**2 * (one - along) + log_strength**2 * along
        return P


def stepped(state: JointState, step: FloatArray) -> JointState:
    """State after a step of the motion, whose numbers (12,) are known."""
    after = JointState.unfilled(state.n_sources)
    work = core.problem("joint_motion", before=state.problem, step=step, after=after.problem)
    core.run("joint_step", work, 1, block=1)
    return after
