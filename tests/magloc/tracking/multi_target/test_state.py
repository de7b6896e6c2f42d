"""The chart of several sources' errors: numerical derivatives, lengths, angles and bookkeeping."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from magloc.tracking.multi_target.motion import FreeMotion
from magloc.tracking.multi_target.state import JointState, moment_derivative, moved_moment, places_of
from tests.oracles import derivative

MOMENT = np.array([0.03, -0.05, 0.02])


def state_of(k: int, seed: int = 0) -> JointState:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(12 * k + 3, 12 * k + 3))
    return JointState(*rng.normal(size=(4, k, 3)), rng.normal(size=3), root @ root.T)


class TestChart:
    @pytest.mark.parametrize("size", [0.0, 1e-6, 1e-3, 0.3, 1.5])
    def test_derivative(self, size):
        c = size * np.array([0.6, 0.64, 0.48])
        found = derivative(lambda x: moved_moment(MOMENT, x), c, 1e-2, atol=1e-11)
        np.testing.assert_allclose(moment_derivative(MOMENT, c), found, atol=1e-10)

    def test_is_scaled_identity_at_the_state(self):
        np.testing.assert_allclose(moment_derivative(MOMENT, np.zeros(3)), np.linalg.norm(MOMENT) * np.eye(3))

    def test_turn_and_strength(self):
        """At right angles c is an arc on the sphere, along the moment it is the logarithm of the strength."""
        u = MOMENT / np.linalg.norm(MOMENT)
        across = np.cross(u, [0.0, 0.0, 1.0])
        across *= 0.7 / np.linalg.norm(across)
        moved = moved_moment(MOMENT, 0.2 * u + across)
        turned = Rotation.from_rotvec(np.cross(u, across)).apply(MOMENT)
        np.testing.assert_allclose(moved, np.exp(0.2) * turned, rtol=1e-12)

    def test_beyond_all_numbers(self):
        """Nothing is warned of: what is not finite explains nothing."""
        assert not np.isfinite(moved_moment(MOMENT, np.array([1e4, 0.0, 0.0]))).any()


class TestBookkeeping:
    def test_a_source_more_and_away_again(self):
        state = state_of(2)
        more = state.with_sources(np.ones((1, 3)), np.array([[0.0, 0.0, 2.0]]), np.diag(np.arange(1.0, 13.0)))
        assert more.n_sources == 3
        np.testing.assert_array_equal(more.P[np.ix_(places_of(3)[2], places_of(3)[2])], np.diag(np.arange(1.0, 13.0)))
        assert not more.P[np.ix_(places_of(3)[2], places_of(3)[:2].ravel())].any()
        np.testing.assert_array_equal(more.without(2).P, state.P)
        np.testing.assert_array_equal(more.without(2).moment_Am2, state.moment_Am2)

    def test_which_is_left(self):
        """The covariance of the others stays what it was."""
        state = state_of(3)
        left = state.without(1)
        for new, old in ((0, 0), (1, 2)):
            np.testing.assert_array_equal(left.covariances[new], state.covariances[old])
            np.testing.assert_array_equal(left.rate_rad_s[new], state.rate_rad_s[old])

    def test_covariance_is_cartesian(self):
        """By draws of the error, 50,000 of them: their covariance is that of the small errors, within 5 σ."""
        state = state_of(1)
        small = JointState(*(getattr(state, name) for name in list(vars(state))[:5]), 1e-8 * state.P)
        errors = np.random.default_rng(1).multivariate_normal(np.zeros(15), small.P, 50_000)
        moved = moved_moment(np.tile(state.moment_Am2, (len(errors), 1)), errors[:, 3:6])
        drawn = np.cov(np.hstack([state.position_m[0] + errors[:, :3], moved]).T)
        scale = np.sqrt(np.diagonal(small.covariances[0]))
        np.testing.assert_allclose(
            drawn / np.outer(scale, scale), small.covariances[0] / np.outer(scale, scale), atol=0.04
        )

    def test_gap(self):
        state = state_of(2)
        distance, sigma = state.gap(0, 1)
        offset = state.position_m[0] - state.position_m[1]
        assert distance == pytest.approx(np.linalg.norm(offset))
        of_both = np.hstack([np.eye(3), -np.eye(3)])
        at = places_of(2)[:, :3].ravel()
        n = offset / distance
        assert sigma**2 == pytest.approx(n @ of_both @ state.P[np.ix_(at, at)] @ of_both.T @ n)


def test_second_moments_of_a_moment():
    """Against 200,000 draws, to the third order in turns of 0.2 rad."""
    rng = np.random.default_rng(5)
    moment = np.array([0.03, -0.02, 0.05])
    u = moment / np.linalg.norm(moment)
    P = FreeMotion().start(u, 0.01, 0.2, 1e-3)
    state = JointState.empty(np.zeros(3), 1e-6).with_sources(np.zeros((1, 3)), moment[None], P)
    drawn = moved_moment(moment, rng.multivariate_normal(np.zeros(3), P[3:6, 3:6], 200_000)) - moment
    expected = drawn.T @ drawn / len(drawn)
    found = state.covariances[0][3:, 3:]
    assert u @ found @ u == pytest.approx(u @ expected @ u, rel=0.1)
    np.testing.assert_allclose(found, expected, atol=0.08 * np.trace(expected))
