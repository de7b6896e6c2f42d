"""Free motion of several sources: one source at a time against its model's, two half steps for one, and refusals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import arrays
import magloc
from magloc.tracking.motion import OrnsteinUhlenbeck
from magloc.tracking.multi_target.measurement import JointRow
from magloc.tracking.multi_target.motion import predict_state
from magloc.tracking.multi_target.state import JointState
from magloc.tracking.rows import Row
from tests.magloc.tracking.multi_target.test_state import CENTROID_M, RADIUS_M, state_of

ARRAY = arrays.grid(2, 2, 0.1, noise_T=1e-9)
ROW = JointRow.of(ARRAY, Row(0.0, np.zeros(ARRAY.n_channels), CENTROID_M - ARRAY.centroid))
MOTION = magloc.FreeMotion(strength_change=0.02, common_walk_T=0.03)


def known(k: int) -> JointState:
    """K sources as the array sees them."""
    return replace(state_of(k), radius_m=ARRAY.circumradius)


def predict(state: JointState, dt_s: float, motion: magloc.FreeMotion = MOTION, agility: float = 1.0) -> JointState:
    """Return the state after a step."""
    return predict_state(state, motion.numbers(dt_s, agility=agility), ROW)


def covariance(state: JointState) -> np.ndarray:
    """Return the covariance in the chart."""
    return state.S @ state.S.T


@pytest.mark.usefixtures("instruction_set")
@pytest.mark.parametrize("k", [0, 1, 3])
def test_each_source_moves_as_one_alone(k):
    """As :class:`OrnsteinUhlenbeck` of one correlation time moves it; the common field walks."""
    state, dt_s = known(k), 0.3
    motion = magloc.FreeMotion(0.4, 0.7, correlation_s=2.0, turn_correlation_s=2.0, strength_change=1e-9)
    single = OrnsteinUhlenbeck(3.0 * 0.4, 3.0 * 0.7, 2.0, moment_change=0.0)
    found = predict(state, dt_s, motion, agility=3.0)
    P, before, after = covariance(state), state.chart, found.chart
    for j in range(k):
        moved, F, S_q = single.step(state.sources[j], dt_s)
        np.testing.assert_allclose(found.sources[j], moved, rtol=1e-10, atol=1e-12)
        at = slice(12 * j, 12 * (j + 1))
        A = after.inverse_jacobian()[j] @ F @ before.jacobian(np.zeros((k, 12)))[j]
        Q = after.inverse_jacobian()[j] @ S_q
        np.testing.assert_allclose(covariance(found)[at, at], A @ P[at, at] @ A.T + Q @ Q.T, rtol=1e-7, atol=1e-9)
    np.testing.assert_array_equal(found.common_T, state.common_T)
    walk = motion.common_walk_T**2 * dt_s * np.eye(3)
    np.testing.assert_allclose(covariance(found)[-3:, -3:], P[-3:, -3:] + walk, rtol=1e-9)


def test_strength_and_rate_of_turn():
    """The noise of a strength is along the moment, and speed and turn last for times of their own."""
    state, dt_s = known(1), 0.1
    weak, strong = (replace(MOTION, strength_change=change) for change in (1e-9, 0.2))
    after = predict(state, dt_s, weak)
    more = covariance(predict(state, dt_s, strong)) - covariance(after)
    change = 0.2 * np.sqrt(dt_s) * after.moment_Am2[0]
    np.testing.assert_allclose(more[3:6, 3:6], np.outer(change, change), rtol=1e-6, atol=1e-9 * change @ change)
    np.testing.assert_allclose(after.sources[0, 6:9], np.exp(-dt_s / 1.5) * state.sources[0, 6:9])
    np.testing.assert_allclose(after.sources[0, 9:], np.exp(-dt_s / 0.4) * state.sources[0, 9:])


def test_start_is_what_is_known():
    """Of position, direction, strength, speed and rate of turn, in Cartesian units."""
    moment = np.array([[0.0, 3.0, 0.0]])
    S = MOTION.start(moment, np.array([0.2]), 0.5, 0.1)[0]
    sigma = [0.2] * 3 + [1.5, 0.3, 1.5] + [MOTION.speed_m_s] * 3 + [MOTION.turn_rad_s] * 3
    np.testing.assert_allclose(S @ S.T, np.diag(sigma) ** 2, atol=1e-12)
    state = JointState.empty(np.zeros(3), 1.0, CENTROID_M, RADIUS_M).with_sources(np.ones((1, 3)), moment, S[None])
    assert state.log_strength_sigma(0) == pytest.approx(0.1)


def test_refuses():
    with pytest.raises(ValueError, match="Input speed_m_s must be positive and finite; instead received 0"):
        magloc.FreeMotion(speed_m_s=0.0)
