"""How sources move that are followed together: speeds and rates of turn that are forgotten."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from arrays.typing import FloatArray
from magloc.navigation.rotations import cross_matrix, rotation_matrix, turn_of_change
from magloc.tracking.motion import wandering_step
from magloc.tracking.multi_target.state import N_COMMON, N_OF_SOURCE, N_SEEN, JointState

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

    def predicted(self, state: JointState, dt_s: float, *, agility: float = 1.0) -> JointState:
        """State after a step without readings; `agility` times the noise of velocity and turn."""
        K = state.n_sources
        lasts_s, kept, root_v = wandering_step(self.correlation_s, dt_s)
        turn_lasts_s, turn_kept, root_w = wandering_step(self.turn_correlation_s, dt_s)
        root_v, root_w = agility * self.speed_m_s * root_v, agility * self.turn_rad_s * root_w
        F, Q = np.zeros((K, N_OF_SOURCE, N_OF_SOURCE)), np.zeros((K, N_OF_SOURCE, N_OF_SOURCE))
        one = np.eye(3)
        F[:, P_, P_], F[:, P_, V_], F[:, V_, V_], F[:, W_, W_] = one, lasts_s * one, kept * one, turn_kept * one
        of_p_v, of_c_w = root_v @ root_v.T, root_w @ root_w.T
        Q[:, P_, P_], Q[:, V_, V_] = of_p_v[0, 0] * one, of_p_v[1, 1] * one
        Q[:, P_, V_] = Q[:, V_, P_] = of_p_v[0, 1] * one
        Q[:, W_, W_] = of_c_w[1, 1] * one
        angle = turn_lasts_s * state.rate_rad_s
        R = rotation_matrix(angle)
        moments = (R @ state.moment_Am2[..., None])[..., 0]
        u = moments / np.sqrt(np.vecdot(moments, moments))[:, None]
        along, turned = u[..., None] * u[:, None], -cross_matrix(u)  # what a small turn changes of u
        F[:, C_, C_], F[:, C_, W_] = R, turn_lasts_s * turned @ turn_of_change(angle)
        Q[:, C_, C_] = of_c_w[0, 0] * (one - along) + self.strength_change**2 * dt_s * along
        Q[:, C_, W_] = of_c_w[0, 1] * turned
        Q[:, W_, C_] = -Q[:, C_, W_]
        at = state.of_source
        whole_F, whole_Q = np.eye(len(state.P)), np.zeros_like(state.P)
        whole_F[at[:, :, None], at[:, None, :]] = F
        whole_Q[at[:, :, None], at[:, None, :]] = Q
        common = N_SEEN * K + np.arange(N_COMMON)
        whole_Q[common, common] = self.common_walk_T**2 * dt_s
        return replace(
            state,
            position_m=state.position_m + lasts_s * state.velocity_m_s,
            moment_Am2=moments,
            velocity_m_s=kept * state.velocity_m_s,
            rate_rad_s=turn_kept * state.rate_rad_s,
            P=whole_F @ state.P @ whole_F.T + whole_Q,
        )

    def start(self, direction: FloatArray, position_m: float, turn_rad: float, log_strength: float) -> FloatArray:
        """Covariance (12, 12) of a source of which so much is known, whose moment points along a unit vector."""
        P = np.zeros((N_OF_SOURCE, N_OF_SOURCE))
        along, one = np.outer(direction, direction), np.eye(3)
        P[P_, P_], P[V_, V_], P[W_, W_] = position_m**2 * one, self.speed_m_s**2 * one, self.turn_rad_s**2 * one
        P[C_, C_] = turn_rad**2 * (one - along) + log_strength**2 * along
        return P
