"""The state of several sources: bookkeeping, and Cartesian second moments against draws from the charts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from magloc.tracking.multi_target.motion import FreeMotion
from magloc.tracking.multi_target.state import JointState

CENTROID_M, RADIUS_M = np.array([0.1, -0.2, 0.3]), 0.5


def state_of(k: int, seed: int = 0) -> JointState:
    """K sources some metres away, with correlated errors of about a percent."""
    rng = np.random.default_rng(seed)
    n = 12 * k + 3
    state = JointState(rng.normal(size=n), 0.003 * rng.normal(size=(n, n)), CENTROID_M, RADIUS_M)
    for source, rows in zip(state.sources, state.S[:-3].reshape(k, 12, n), strict=True):
        rows[3:6] *= np.linalg.norm(source[3:6])
    return state


def draw(state: JointState, n: int, seed: int = 1) -> np.ndarray:
    """Draw sources (n, K, 12) of a state."""
    errors = np.random.default_rng(seed).normal(size=(n, len(state.x))) @ state.S.T
    chart = state.chart
    everywhere = replace(chart, **{name: np.stack([getattr(chart, name)] * n) for name in ("x", "length", "u", "E")})
    firm = np.ones((n, state.n_sources), dtype=bool)
    return replace(everywhere, firm=firm).retract(errors[:, :-3].reshape(n, state.n_sources, 12))


class TestBookkeeping:
    def test_a_source_more_and_away_again(self):
        state, rng = state_of(2), np.random.default_rng(2)
        roots = 0.01 * rng.normal(size=(1, 12, 12))
        more = state.with_sources(np.ones((1, 3)), np.array([[0.0, 0.0, 2.0]]), roots)
        assert more.n_sources == 3
        np.testing.assert_allclose(more.covariances[:2], state.covariances, rtol=1e-10, atol=1e-14)
        expected = (roots @ np.swapaxes(roots, 1, 2))[0, :3, :3]
        np.testing.assert_allclose(more.covariances[2, :3, :3], expected, rtol=1e-10, atol=1e-14)
        P = more.S @ more.S.T
        assert not P[24:36, :24].any()
        assert not P[24:36, 36:].any()
        left = more.without(2)
        np.testing.assert_array_equal(left.x, state.x)
        np.testing.assert_allclose(left.S @ left.S.T, state.S @ state.S.T, rtol=1e-10, atol=1e-14)

    def test_which_is_left(self):
        """The covariance of the others stays what it was, and so does that of the common field."""
        state = state_of(3)
        left = state.without(1)
        np.testing.assert_allclose(left.covariances, state.covariances[[0, 2]], rtol=1e-10, atol=1e-14)
        np.testing.assert_array_equal(left.sources, state.sources[[0, 2]])
        common = state.without_sources
        assert common.n_sources == 0
        np.testing.assert_allclose(common.S @ common.S.T, (state.S @ state.S.T)[-3:, -3:], rtol=1e-10, atol=1e-14)

    def test_gap(self):
        """By draws, 50,000 of them: five deviations of a variance are 3 %."""
        state = state_of(2)
        distance, sigma = state.gap(0, 1)
        offset = state.position_m[0] - state.position_m[1]
        assert distance == pytest.approx(np.linalg.norm(offset))
        draws = draw(state, 50_000)[:, :, :3]
        along = (draws[:, 0] - draws[:, 1]) @ offset / distance
        assert np.std(along) == pytest.approx(sigma, rel=0.03)


def test_covariances_are_those_of_draws():
    """50,000 draws, within 5 σ."""
    state = state_of(2)
    draws = draw(state, 50_000)[:, :, :6]
    for k in range(2):
        scale = np.sqrt(np.diagonal(state.covariances[k]))
        found, expected = np.cov(draws[:, k].T), state.covariances[k]
        np.testing.assert_allclose(found / np.outer(scale, scale), expected / np.outer(scale, scale), atol=0.05)
    strengths = np.log(np.linalg.norm(draws[:, :, 3:], axis=2))
    for k in range(2):
        assert np.std(strengths[:, k]) == pytest.approx(state.log_strength_sigma(k), rel=0.05)


def test_second_moments_of_a_moment():
    """Against 200,000 draws, to the third order in turns of 0.1 rad."""
    moment = np.array([[0.03, -0.02, 0.05]])
    u = moment[0] / np.linalg.norm(moment)
    empty = JointState.empty(np.zeros(3), 1e-6, np.zeros(3), RADIUS_M)
    state = empty.with_sources(np.ones((1, 3)), moment, FreeMotion().start(moment, np.array([1e-4]), 0.1, 1e-3))
    error = draw(state, 200_000)[:, 0, 3:6] - moment
    expected = error.T @ error / len(error)
    found = state.covariances[0][3:, 3:]
    assert u @ found @ u == pytest.approx(u @ expected @ u, rel=0.15)
    np.testing.assert_allclose(found, expected, atol=0.1 * np.trace(expected))


def test_a_moved_state_has_the_same_draws():
    """Small errors about another state: their Cartesian covariance stays, to first order in a move of 1 %."""
    state = state_of(2)
    error = state.S @ np.random.default_rng(3).normal(size=len(state.x))
    moved = state.shift(error, state.S)
    scale = np.sqrt(np.diagonal(state.covariances[0]))
    difference = (moved.covariances[0] - state.covariances[0]) / np.outer(scale, scale)
    assert np.abs(difference).max() < 0.2
    assert np.abs(state.shift(1e-4 * error, state.S).covariances - state.covariances).max() < 1e-4 * scale.max() ** 2
