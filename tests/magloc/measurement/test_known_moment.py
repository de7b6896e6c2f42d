"""Moments whose modulus is known.

| what | oracle |
|---|---|
| moments_of_modulus | SciPy's least_squares on the readings and the pseudo-measurement, from many starts |
| derivatives | scipy.differentiate |
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares

from arrays.geometries import tetrahedron
from arrays.whitening import whitening
from magloc.measurement.known_moment import KnownMoment, moments_of_modulus
from magloc.measurement.whitened import WhitenedModel
from tests.oracles import derivative


def cost(x, eigenvalue, along, modulus, sigma):
    """What the secular equation minimises."""
    return np.sum(eigenvalue * x * x - 2.0 * along * x, axis=-1) + ((np.linalg.norm(x, axis=-1) - modulus) / sigma) ** 2


def least_by_multistart(rng, eigenvalue, along, modulus, sigma):
    """The least cost that SciPy finds from eight starts of the known length."""
    root = np.sqrt(eigenvalue)

    def residual(x):
        return np.append(root * x - along / root, (np.linalg.norm(x) - modulus) / sigma)

    starts = rng.normal(size=(8, 3))
    starts *= modulus / np.linalg.norm(starts, axis=1, keepdims=True)
    fits = [least_squares(residual, start, xtol=1e-14, ftol=1e-14, gtol=1e-14) for start in starts]
    return 2.0 * min(fit.cost for fit in fits) - np.sum(along**2 / eigenvalue)


class TestMomentsOfModulus:
    @pytest.mark.slow_after(1)
    @pytest.mark.parametrize("spread", [0.5, 3.0])
    def test_no_multistart_is_better(self, spread):
        rng = np.random.default_rng(7)
        eigenvalue = np.sort(10.0 ** rng.uniform(-spread, spread, size=(25, 3)), axis=-1)
        truth = rng.normal(size=(25, 3))
        along = eigenvalue * truth + np.sqrt(eigenvalue) * rng.normal(size=(25, 3))
        modulus = np.linalg.norm(truth, axis=-1) * rng.uniform(0.3, 3.0, size=25)
        sigma = modulus * 10.0 ** rng.uniform(-3.0, 0.5, size=25)
        found = cost(moments_of_modulus(eigenvalue, along, modulus, sigma), eigenvalue, along, modulus, sigma)
        for i in range(25):
            least = least_by_multistart(rng, eigenvalue[i], along[i], modulus[i], sigma[i])
            assert found[i] <= least + 1e-7 * (1.0 + abs(least) + np.sum(along[i] ** 2 / eigenvalue[i]))

    def test_in_the_hard_case_both_signs_fit_alike(self):
        eigenvalue, along = np.array([1.0, 4.0, 9.0]), np.array([0.0, 2.0, 3.0])
        modulus, sigma = np.array(3.0), np.array(0.1)
        x = moments_of_modulus(eigenvalue, along, modulus, sigma)
        assert x[0] > 2.0
        mirrored = x * [-1.0, 1.0, 1.0]
        least = cost(x, eigenvalue, along, modulus, sigma)
        assert cost(mirrored, eigenvalue, along, modulus, sigma) == pytest.approx(float(least), rel=1e-12)
        nearby = x + 0.01 * np.random.default_rng(0).normal(size=(200, 3))
        assert (cost(nearby, eigenvalue, along, modulus, sigma) >= least).all()

    def test_without_readings_the_length_is_the_one_that_is_known(self):
        x = moments_of_modulus(np.array([1.0, 2.0, 3.0]), np.zeros(3), np.array(2.0), np.array(1e-3))
        assert np.linalg.norm(x) == pytest.approx(2.0, rel=1e-5)


class TestDerivatives:
    @pytest.mark.parametrize("value", [(2.0,), (1.0, -0.5, 2.0)])
    def test_by_place_and_moment(self, value):
        array = tetrahedron(1.0)
        model = WhitenedModel.of(array, whitening(array), array.ambient_fields[None])
        known = KnownMoment(value, 0.3)
        model = WhitenedModel(**{**vars(model), "known": known})
        q, mu = model.homogeneous([[1.0, 2.0, 3.0]])[None], np.array([[[1e-9, 2e-9, -1e-9]]])

        def residual(x):
            at = q[0, 0] + x[..., :4] / 10.0
            moment = model.moment(at, mu[0, 0] + 1e-9 * x[..., 4:])
            return -known.residual(moment[..., None, :])

        truth = derivative(residual, np.zeros(7), 1e-2, atol=1e-9)
        tangent = np.broadcast_to(np.eye(4)[:, 1:], (1, 1, 4, 3))
        np.testing.assert_allclose(model.known_jacobian(q, mu, tangent)[0], 10.0 * truth[:, 1:4], rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(model.known_jacobian(q, mu)[0] * 1e-9, truth[:, 4:], rtol=1e-6, atol=1e-9)

    @pytest.mark.parametrize("value", [(2.0,), (1.0, -0.5, 2.0)])
    def test_information_is_the_second_derivative(self, value):
        known, at = KnownMoment(value, 0.3), np.array([0.5, 1.0, -0.7])

        def slope(m):
            jacobian, residual = known.jacobian(m[..., None, :])[..., 0, :, :], known.residual(m[..., None, :])
            return -np.einsum("...ki,...k->...i", jacobian, residual)

        np.testing.assert_allclose(known.information(at), derivative(slope, at, 1e-2, atol=1e-9), rtol=1e-6, atol=1e-8)
