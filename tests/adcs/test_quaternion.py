"""Tests of adcs.quaternion: one class per property. The oracle is scipy's Rotation."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from adcs import quaternion as quat
from magloc.navigation.rotations import cross_matrix
from tests.adcs.attitudes import random_attitudes

Array = NDArray[np.float64]
RNG = np.random.default_rng(7)
P, Q = random_attitudes(50, RNG), random_attitudes(50, RNG)
V = RNG.standard_normal((50, 3))
seeds = st.integers(0, 2**32 - 1)


def same_rotation(p: Array, q: Array) -> bool:
    return bool(np.allclose(np.abs(np.sum(p * q, axis=-1)), 1.0, rtol=0.0, atol=1e-14))


class TestAgainstScipy:
    def test_products_are_compositions(self) -> None:
        composed = quat.to_rotation(P) * quat.to_rotation(Q)
        assert same_rotation(quat.multiply(P, Q), quat.from_rotation(composed))

    def test_vectors_are_turned(self) -> None:
        np.testing.assert_allclose(quat.rotate(Q, V), quat.to_rotation(Q).apply(V), rtol=0, atol=1e-14)
        np.testing.assert_allclose(
            quat.rotate_back(Q, V), quat.to_rotation(Q).apply(V, inverse=True), rtol=0, atol=1e-14
        )

    def test_matrices(self) -> None:
        np.testing.assert_allclose(quat.matrix(Q), quat.to_rotation(Q).as_matrix(), rtol=0, atol=1e-14)

    def test_rotation_vectors(self) -> None:
        assert same_rotation(quat.exp(V), quat.from_rotation(Rotation.from_rotvec(V)))
        np.testing.assert_allclose(quat.log(Q), quat.to_rotation(Q).as_rotvec(), rtol=0, atol=1e-13)

    def test_angles_between(self) -> None:
        angle = (quat.to_rotation(P).inv() * quat.to_rotation(Q)).magnitude()
        np.testing.assert_allclose(quat.angle_between(P, Q), angle, rtol=0, atol=1e-13)

    def test_scalar_is_first(self) -> None:
        quarter_about_z = quat.from_rotation(Rotation.from_rotvec([0.0, 0.0, np.pi / 2]))
        np.testing.assert_allclose(quarter_about_z, [np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)], atol=1e-15)

    def test_there_and_back(self) -> None:
        assert same_rotation(quat.from_rotation(quat.to_rotation(Q)), Q)
        assert (quat.from_rotation(quat.to_rotation(Q))[:, 0] >= 0.0).all()


class TestAlgebra:
    @given(seeds)
    def test_product_is_associative_and_keeps_the_length(self, seed: int) -> None:
        a, b, c = np.random.default_rng(seed).standard_normal((3, 4))
        left, right = quat.multiply(quat.multiply(a, b), c), quat.multiply(a, quat.multiply(b, c))
        np.testing.assert_allclose(left, right, rtol=0, atol=1e-12)
        length = np.linalg.norm(a) * np.linalg.norm(b)
        assert np.linalg.norm(quat.multiply(a, b)) == pytest.approx(length, rel=1e-12)

    def test_hamilton(self) -> None:
        i, j, k = np.eye(4)[1:]
        np.testing.assert_array_equal(quat.multiply(i, j), k)
        np.testing.assert_array_equal(quat.multiply(j, k), i)
        np.testing.assert_array_equal(quat.multiply(i, i), -quat.IDENTITY)

    def test_conjugate_is_the_inverse(self) -> None:
        np.testing.assert_allclose(quat.multiply(quat.conjugate(Q), Q), np.tile(quat.IDENTITY, (50, 1)), atol=1e-15)

    def test_batches_broadcast(self) -> None:
        assert quat.multiply(P[:, None], Q).shape == (50, 50, 4)
        assert quat.rotate(P[:, None], V).shape == (50, 50, 3)
        assert quat.matrix(P.reshape(5, 10, 4)).shape == (5, 10, 3, 3)

    def test_no_length_is_no_attitude(self) -> None:
        normalised = quat.normalised([[0.0, 0.0, 0.0, 0.0], [0.0, 2.0, 0.0, 0.0]])
        assert np.isnan(normalised[0]).all()
        np.testing.assert_array_equal(normalised[1], [0.0, 1.0, 0.0, 0.0])


class TestExpAndLog:
    @given(seeds, st.floats(0.0, 3.14))
    def test_inverse_of_each_other(self, seed: int, angle: float) -> None:
        direction = np.random.default_rng(seed).standard_normal(3)
        vector = angle * direction / np.linalg.norm(direction)
        np.testing.assert_allclose(quat.log(quat.exp(vector)), vector, rtol=0, atol=1e-12)

    def test_zero(self) -> None:
        np.testing.assert_array_equal(quat.exp(np.zeros(3)), quat.IDENTITY)
        np.testing.assert_array_equal(quat.log(quat.IDENTITY), np.zeros(3))

    def test_both_signs_have_one_logarithm(self) -> None:
        np.testing.assert_array_equal(quat.log(-Q), quat.log(Q))


class TestErrorVector:
    def test_is_half_the_angle_in_body_axes(self) -> None:
        theta = 1e-4 * V
        error = quat.error_vector(Q, quat.multiply(Q, quat.exp(theta)))
        np.testing.assert_allclose(error, theta / 2, rtol=0, atol=1e-11)

    def test_sign_of_the_quaternions_does_not_matter(self) -> None:
        np.testing.assert_array_equal(quat.error_vector(-P, Q), quat.error_vector(P, Q))

    @given(seeds)
    def test_correction_by_the_error_is_the_truth(self, seed: int) -> None:
        p, q = random_attitudes(2, np.random.default_rng(seed))
        corrected = quat.multiply(p, quat.from_error_vector(quat.error_vector(p, q)))
        assert abs(float(corrected @ q)) == pytest.approx(1.0, abs=1e-12)

    def test_too_long_vectors_are_half_turns(self) -> None:
        np.testing.assert_allclose(quat.from_error_vector([0.0, 3.0, 4.0]), [0.0, 0.0, 0.6, 0.8], atol=1e-15)


class TestShortestTurn:
    @pytest.mark.parametrize("shape", [(), (5,)])
    def test_brings_the_direction_there_by_the_angle_between(self, shape: tuple[int, ...]) -> None:
        rng = np.random.default_rng(3)
        q = quat.normalised(rng.standard_normal((*shape, 4)))
        body, reference = rng.standard_normal((2, *shape, 3))
        found = quat.turned_onto(q, body, reference)
        units = [v / np.linalg.norm(v, axis=-1, keepdims=True) for v in (quat.rotate(found, body), reference)]
        np.testing.assert_allclose(*units, rtol=0, atol=1e-14)
        before = quat.rotate(q, body)
        cosine = np.sum(before * reference, axis=-1) / (
            np.linalg.norm(body, axis=-1) * np.linalg.norm(reference, axis=-1)
        )
        np.testing.assert_allclose(quat.angle_between(q, found), np.arccos(cosine), rtol=0, atol=1e-12)

    def test_half_a_turn(self) -> None:
        found = quat.turned_onto(Q, V, -2.0 * quat.rotate(Q, V))
        np.testing.assert_allclose(quat.rotate(found, V), -quat.rotate(Q, V), rtol=0, atol=1e-14)


class TestDerivative:
    def test_constant_rate_turns_as_the_matrix_exponential(self) -> None:
        w = np.array([0.1, -0.2, 0.3])
        step = 1e-4
        central = (quat.multiply(Q[0], quat.exp(step * w)) - quat.multiply(Q[0], quat.exp(-step * w))) / (2 * step)
        np.testing.assert_allclose(quat.derivative(Q[0], w), central, rtol=0, atol=1e-9)
        np.testing.assert_allclose(quat.matrix(quat.exp(w)), expm(cross_matrix(w)), rtol=0, atol=1e-14)
