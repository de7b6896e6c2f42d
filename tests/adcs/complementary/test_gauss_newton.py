"""Tests of the measured quaternion."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from adcs import quaternion
from adcs.complementary.explicit import Gains
from sims.attitude.complementary import SatelliteScenario, satellite_runs
from tests.adcs.attitudes import random_attitudes
from tests.adcs.complementary.readable import (
    MeasuredQuaternion,
    explicit_error,
    gauss_newton_step,
    gauss_newton_track,
    homogeneous_rotation,
    rotation_derivative,
)


def pair(rng, q):
    body = rng.standard_normal((2, 3))
    body /= np.linalg.norm(body, axis=1, keepdims=True)
    return [(v, quaternion.rotate(q, v)) for v in body]


class TestHomogeneousForm:
    @given(st.lists(st.floats(-2.0, 2.0), min_size=7, max_size=7))
    def test_is_the_rotation_times_the_squared_length(self, numbers):
        q, v = np.array(numbers[:4]), np.array(numbers[4:])
        product = quaternion.multiply(quaternion.multiply(q, [0.0, *v]), quaternion.conjugate(q))
        np.testing.assert_allclose(homogeneous_rotation(q, v), product[1:], atol=1e-12)

    def test_derivative(self):
        """Central differences, exact for a quadratic form."""
        rng = np.random.default_rng(0)
        q, v = rng.standard_normal(4), rng.standard_normal(3)
        columns = [
            (homogeneous_rotation(q + 0.5 * step, v) - homogeneous_rotation(q - 0.5 * step, v)) for step in np.eye(4)
        ]
        np.testing.assert_allclose(rotation_derivative(q, v), np.column_stack(columns), atol=1e-12)


class TestStep:
    def test_from_eight_degrees(self):
        """Noise-free: what is left of an angle θ about axes that are not across the vectors is θ²/4, 0.1° of 5°."""
        runs = satellite_runs(SatelliteScenario(sigma_T=0.0, duration_s=2.0), range(20))
        track = gauss_newton_track(runs.record, Gains(0.02))
        angle = quaternion.angle_between(track.q_measured, runs.q)
        start = quaternion.angle_between(quaternion.IDENTITY, runs.q[:, 0])
        assert (angle[:, 0] <= 1.01 * start**2 / 4.0).all()
        assert np.degrees(np.median(angle[:, 0])) <= 0.11
        assert np.degrees(angle[:, 1]).max() <= 1e-4
        assert np.degrees(angle[:, 2]).max() <= 1e-6

    @pytest.mark.parametrize("seed", range(5))
    def test_against_scipy(self, seed):
        """Repeated with noisy vectors, it ends at Wahba's solution."""
        rng = np.random.default_rng(seed)
        q_true = random_attitudes(1, rng)[0]
        vectors = [(v + 0.01 * rng.standard_normal(3), w) for v, w in pair(rng, q_true)]
        vectors = [(v / np.linalg.norm(v), w) for v, w in vectors]
        q = quaternion.multiply(q_true, quaternion.exp([0.1, -0.05, 0.08]))
        for _ in range(30):
            q = gauss_newton_step(q, vectors, mu=0.0)
        wahba, _ = Rotation.align_vectors([w for _, w in vectors], [v for v, _ in vectors])
        assert quaternion.angle_between(q, quaternion.from_rotation(wahba)) < 1e-7

    @pytest.mark.parametrize("seed", range(5))
    def test_is_the_explicit_error_with_equal_gains(self, seed):
        """To first order e = M⁻¹ e_explicit, M = Σ(E - vvᵀ)."""
        rng = np.random.default_rng(seed)
        q_true = random_attitudes(1, rng)[0]
        vectors = pair(rng, q_true)
        q = quaternion.multiply(q_true, quaternion.exp(1e-5 * rng.standard_normal(3)))
        M = sum(np.eye(3) - np.outer(v, v) for v, _ in vectors)
        e = MeasuredQuaternion()(q, vectors)
        np.testing.assert_allclose(e, np.linalg.solve(M, explicit_error(q, vectors)), rtol=1e-3, atol=1e-10)

    def test_one_vector_leaves_the_turn_around_it(self):
        rng = np.random.default_rng(1)
        q = random_attitudes(1, rng)[0]
        v = np.array([0.6, 0.0, 0.8])
        missing = np.full(3, np.nan)
        q_true = quaternion.multiply(q, quaternion.exp(0.05 * np.array([0.8, 0.0, -0.6]) + 0.05 * v))
        found = gauss_newton_step(q, [(v, quaternion.rotate(q_true, v)), (missing, missing)])
        turned = quaternion.log(quaternion.multiply(quaternion.conjugate(q), found))
        assert abs(turned @ v) < 1e-10
        np.testing.assert_allclose(quaternion.rotate(found, v), quaternion.rotate(q_true, v), atol=2e-3)
        np.testing.assert_array_equal(gauss_newton_step(q, [(missing, missing)] * 2), q)

    def test_nearly_collinear_vectors(self):
        """μ keeps the step finite."""
        v = np.array([1.0, 0.0, 0.0])
        w = np.array([1.0, 1e-9, 0.0])
        q = quaternion.exp([0.3, 0.01, 0.0])
        assert np.isfinite(gauss_newton_step(q, [(v, v), (w, w)])).all()
