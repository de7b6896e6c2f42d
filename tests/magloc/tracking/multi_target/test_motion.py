"""Free motion of several sources: numerical derivatives in the chart, and two half steps for one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import magloc
from magloc.tracking.motion import OrnsteinUhlenbeck
from magloc.tracking.multi_target.motion import FreeMotion
from magloc.tracking.multi_target.state import JointState, places_of
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
