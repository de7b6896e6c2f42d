"""Attitude of vectors: SciPy's solution of Wahba's problem, the closed form of TRIAD, honest covariances."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import adcs
from adcs import quaternion
from adcs.satellite.wahba import VECTOR_METHODS
from tests.adcs.attitudes import random_attitudes

SIGMAS = (0.002, 0.01, 0.005)


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def readings(n, vectors, rng, sigmas=SIGMAS):
    """Attitudes, vectors in the frame and as measured, with noise across each."""
    q = random_attitudes(n, rng)
    frame = [unit(rng.standard_normal((n, 3))) for _ in range(vectors)]
    body = []
    for v, sigma in zip(frame, sigmas, strict=False):
        body.append(unit(quaternion.rotate_back(q, v) + sigma * rng.standard_normal((n, 3))))
    return q, body, frame


class TestQuest:
    @pytest.mark.parametrize("vectors", [2, 3])
    def test_against_scipy(self, vectors):
        _, body, frame = readings(50, vectors, np.random.default_rng(0))
        found = adcs.attitude_of_vectors(body, frame, SIGMAS[:vectors])
        weights = 1.0 / np.square(SIGMAS[:vectors])
        for i in range(50):
            expected, _ = Rotation.align_vectors([v[i] for v in frame], [v[i] for v in body], weights=weights)
            assert quaternion.angle_between(found.q[i], quaternion.from_rotation(expected)) < 1e-6

    def test_loss_is_chi_square(self):
        """Three vectors: 3 degrees of freedom; mean of 4,000 within 4 of its deviations, false alarm 1e-4."""
        _, body, frame = readings(4000, 3, np.random.default_rng(1))
        loss = adcs.attitude_of_vectors(body, frame, SIGMAS).loss
        assert loss.mean() == pytest.approx(3.0, abs=4.0 * np.sqrt(6.0 / 4000))


class TestTriad:
    def test_first_vector_is_exact(self):
        _, body, frame = readings(50, 2, np.random.default_rng(2))
        q = adcs.attitude_of_vectors(body, frame, SIGMAS[:2], method="triad").q
        np.testing.assert_allclose(quaternion.rotate(q, body[0]), frame[0], atol=1e-12)
        across = np.cross(quaternion.rotate(q, body[1]), frame[1])
        np.testing.assert_allclose(np.sum(across * frame[0], axis=1), 0.0, atol=0.05)


@pytest.mark.parametrize("method", VECTOR_METHODS)
class TestBoth:
    def test_covariance(self, method):
        """NEES of three numbers; vectors that are 20° apart at least; mean of some 9,000, false alarm 1e-4."""
        q, body, frame = readings(10_000, 2, np.random.default_rng(3))
        apart = np.linalg.norm(np.cross(frame[0], frame[1]), axis=1) > np.sin(np.radians(20.0))
        found = adcs.attitude_of_vectors(body, frame, SIGMAS[:2], method=method)
        error = 2.0 * quaternion.error_vector(found.q, q)
        nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.covariance), error)[apart]
        assert nees.mean() == pytest.approx(3.0, abs=4.0 * np.sqrt(6.0 / len(nees)))

    def test_what_tells_nothing(self, method):
        """One vector, and two along one line."""
        along, other = np.array([[1.0, 0.0, 0.0]] * 3), np.array([[0.0, 1.0, 0.0], [np.nan] * 3, [-2.0, 0.0, 0.0]])
        found = adcs.attitude_of_vectors([along, other], [along, other], SIGMAS[:2], method=method)
        assert np.isfinite(found.loss).tolist() == [True, False, False]
        assert np.isnan(found.q[1:]).all()

    def test_of_a_log(self, method):
        log = adcs.datasets.load("satellite")
        track = adcs.vector_attitude(log.telemetry, log.satellite, method=method)
        error = (track.rotation * log.truth.inv()).magnitude()
        sigma = np.linalg.norm(track.sigma["attitude"], axis=1)
        assert 0.7 < np.sqrt(np.mean((error / sigma) ** 2)) < 1.3


def test_refusals():
    one = np.ones((2, 3))
    with pytest.raises(ValueError, match="method must be one of quest, triad; instead received 'svd'"):
        adcs.attitude_of_vectors([one, one], [one, one], [1.0, 1.0], method="svd")
    with pytest.raises(ValueError, match="two or more; instead received 1, 2 and 2"):
        adcs.attitude_of_vectors([one], [one, one], [1.0, 1.0])
    with pytest.raises(ValueError, match="sigma_rad must be positive"):
        adcs.attitude_of_vectors([one, one], [one, one], [1.0, 0.0])
    with pytest.raises(ValueError, match="must have a length"):
        adcs.attitude_of_vectors([0.0 * one, one], [one, one], [1.0, 1.0])
    log = adcs.datasets.load("satellite")
    with pytest.raises(ValueError, match="both magnetometer and Sun sensor"):
        adcs.vector_attitude(adcs.Telemetry([36460.0], sun=[[1.0, 0.0, 0.0]]), log.satellite)
