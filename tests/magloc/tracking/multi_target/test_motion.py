"""Free motion of several sources: numerical derivatives in the chart, two half steps for one, and the reference."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

import magloc
from magloc.navigation.rotations import cross_matrix, rotation_matrix, turn_of_change
from magloc.tracking.motion import OrnsteinUhlenbeck, wandering_step
from magloc.tracking.multi_target.motion import FreeMotion
from magloc.tracking.multi_target.state import N_COMMON, N_OF_SOURCE, N_SEEN, JointState, places_of
from tests.magloc.tracking.multi_target.test_state import state_of
from tests.oracles import derivative

MOTION = FreeMotion(strength_change=0.2, common_walk_T=0.3)


def difference(after: JointState, before: JointState) -> np.ndarray:
    """Error in the chart of `before` that leads to `after`, for a single source and small turns."""
    u = before.moment_Am2[0] / np.linalg.norm(before.moment_Am2[0])
    w = after.moment_Am2[0] / np.linalg.norm(after.moment_Am2[0])
    across = w - (u @ w) * u
    length = np.linalg.norm(across)
    turn = across * (np.arctan2(length, u @ w) / length if length else 1.0)
    strength = np.log(np.linalg.norm(after.moment_Am2[0]) / np.linalg.norm(before.moment_Am2[0]))
    parts = [after.position_m[0] - before.position_m[0], strength * u + turn, after.common_T - before.common_T]
    return np.concatenate(
        [*parts, after.velocity_m_s[0] - before.velocity_m_s[0], after.rate_rad_s[0] - before.rate_rad_s[0]]
    )


def readably_predicted(motion: FreeMotion, state: JointState, dt_s: float, agility: float) -> JointState:
    """The reference of the kernel: transition and noise of every source as matrices."""
    K, one = state.n_sources, np.eye(3)
    P_, C_, V_, W_ = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)
    lasts_s, kept, root_v = wandering_step(motion.correlation_s, dt_s)
    turn_lasts_s, turn_kept, root_w = wandering_step(motion.turn_correlation_s, dt_s)
    root_v, root_w = agility * motion.speed_m_s * root_v, agility * motion.turn_rad_s * root_w
    F, Q = np.zeros((K, N_OF_SOURCE, N_OF_SOURCE)), np.zeros((K, N_OF_SOURCE, N_OF_SOURCE))
    F[:, P_, P_], F[:, P_, V_], F[:, V_, V_], F[:, W_, W_] = one, lasts_s * one, kept * one, turn_kept * one
    of_p_v, of_c_w = root_v @ root_v.T, root_w @ root_w.T
    Q[:, P_, P_], Q[:, V_, V_] = of_p_v[0, 0] * one, of_p_v[1, 1] * one
    Q[:, P_, V_] = Q[:, V_, P_] = of_p_v[0, 1] * one
    Q[:, W_, W_] = of_c_w[1, 1] * one
    angle = turn_lasts_s * state.rate_rad_s
    R = rotation_matrix(angle)
    moments = (R @ state.moment_Am2[..., None])[..., 0]
    u = moments / np.linalg.norm(moments, axis=-1, keepdims=True)
    along, turned = u[..., None] * u[:, None], -cross_matrix(u)  # what a small turn changes of u
    F[:, C_, C_], F[:, C_, W_] = R, turn_lasts_s * turned @ turn_of_change(angle)
    Q[:, C_, C_] = of_c_w[0, 0] * (one - along) + motion.strength_change**2 * dt_s * along
    Q[:, C_, W_] = of_c_w[0, 1] * turned
    Q[:, W_, C_] = -Q[:, C_, W_]
    at = state.of_source
    whole_F, whole_Q = np.eye(len(state.P)), np.zeros_like(state.P)
    whole_F[at[:, :, None], at[:, None, :]] = F
    whole_Q[at[:, :, None], at[:, None, :]] = Q
    common = N_SEEN * K + np.arange(N_COMMON)
    whole_Q[common, common] = motion.common_walk_T**2 * dt_s
    return replace(
        state,
        position_m=state.position_m + lasts_s * state.velocity_m_s,
        moment_Am2=moments,
        velocity_m_s=kept * state.velocity_m_s,
        rate_rad_s=turn_kept * state.rate_rad_s,
        P=whole_F @ state.P @ whole_F.T + whole_Q,
    )


@pytest.mark.usefixtures("instruction_set")
@pytest.mark.parametrize("turns", [0.0, 1e-4, 1.0, 30.0])
@pytest.mark.parametrize("k", [0, 1, 3])
def test_step_is_the_readable_one(k, turns):
    state = state_of(k, seed=k)
    state = replace(state, rate_rad_s=turns * state.rate_rad_s)
    found, expected = (
        step(state, 0.3, agility=3.0) for step in (MOTION.predicted, partial(readably_predicted, MOTION))
    )
    for name in vars(expected):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=1e-10, atol=1e-11)


@pytest.mark.parametrize("dt_s", [1e-3, 0.01, 0.3, 3.0])
def test_transition(dt_s):
    """Without noise the covariance goes with the derivative of the step."""
    state = state_of(1)
    state = replace(state, rate_rad_s=0.3 * state.rate_rad_s)
    still = FreeMotion(1e-9, 1e-9, strength_change=1e-9, common_walk_T=1e-9)
    after = still.predicted(state, dt_s)

    def moved(errors: np.ndarray) -> np.ndarray:
        return np.apply_along_axis(lambda e: difference(still.predicted(state.moved(e), dt_s), after), -1, errors)

    F = derivative(moved, np.zeros(15), 1e-2, atol=1e-7)
    np.testing.assert_allclose(after.P, F @ state.P @ F.T, atol=1e-6 * np.abs(state.P).max())


@pytest.mark.parametrize("dt_s", [0.01, 0.2])
def test_two_half_steps_are_one(dt_s):
    """Of a source that does not turn: the noise of a step is that of two halves."""
    state = replace(state_of(2), rate_rad_s=np.zeros((2, 3)))
    halves = MOTION.predicted(MOTION.predicted(state, 0.5 * dt_s), 0.5 * dt_s)
    whole = MOTION.predicted(state, dt_s)
    np.testing.assert_allclose(halves.P, whole.P, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(halves.position_m, whole.position_m)


def test_position_and_velocity_are_those_of_one_source():
    """As :class:`OrnsteinUhlenbeck` has them."""
    state = state_of(1)
    single = OrnsteinUhlenbeck(MOTION.speed_m_s, MOTION.turn_rad_s, MOTION.correlation_s)
    x = np.concatenate([state.position_m[0], state.moment_Am2[0], state.velocity_m_s[0], state.rate_rad_s[0]])
    at = places_of(1)[0, [0, 1, 2, 6, 7, 8]]
    moved, F, S_q = single.step(x, 0.1)
    linear = np.ix_([0, 1, 2, 6, 7, 8], [0, 1, 2, 6, 7, 8])
    after = MOTION.predicted(state, 0.1)
    expected = F[linear] @ state.P[np.ix_(at, at)] @ F[linear].T + (S_q @ S_q.T)[linear]
    np.testing.assert_allclose(after.P[np.ix_(at, at)], expected, rtol=1e-10)
    np.testing.assert_allclose(after.position_m[0], moved[:3])


def test_refuses():
    with pytest.raises(ValueError, match="Input speed_m_s must be positive and finite; instead received 0"):
        magloc.FreeMotion(speed_m_s=0.0)
