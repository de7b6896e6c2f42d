"""The chart of a source: its derivatives by scipy, its inverse, and the sources that share a gradient tensor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from magloc.fields import dipole
from magloc.tracking.coordinates import Chart, mirror_images
from tests.oracles import derivative

FloatArray = NDArray[np.float64]
CENTROID = np.array([0.3, -0.2, 0.1])
STATE = np.array([3.0, 1.5, 0.8, 120.0, -150.0, 160.0, 0.4, -0.3, 0.2, 0.01, 0.02, -0.03])
E = np.array([0.1, -0.05, 0.08, 0.1, -0.2, 0.15, 0.01, 0.02, -0.01, 0.3, -0.2, 0.1])


@pytest.mark.parametrize("n", [6, 10, 12])
@pytest.mark.parametrize("radius_m", [1.0, 10.0], ids=["far", "within the array"])
class TestChart:
    def test_coordinates_are_the_inverse(self, n: int, radius_m: float) -> None:
        chart = Chart.at(STATE[None, :n], CENTROID, radius_m)
        np.testing.assert_allclose(chart.coordinates(chart.retract(E[None, :n])), E[None, :n], atol=1e-12)
        np.testing.assert_array_equal(chart.retract(np.zeros((1, n))), STATE[None, :n])

    @pytest.mark.parametrize("e", [np.zeros(12), E], ids=["at it", "beside it"])
    def test_derivative(self, n: int, radius_m: float, e: FloatArray) -> None:
        chart = Chart.at(STATE[:n], CENTROID, radius_m)
        expected = derivative(lambda y: np.apply_along_axis(chart.retract, -1, y), e[:n], 1e-2, atol=1e-7)
        found = chart.jacobian(e[:n])
        scale = np.maximum(np.abs(expected).max(axis=1, keepdims=True), 1e-9)
        np.testing.assert_allclose(found / scale, expected / scale, atol=1e-6)

    def test_inverse_derivative(self, n: int, radius_m: float) -> None:
        chart = Chart.at(STATE[None, :n], CENTROID, radius_m)
        product = chart.inverse_jacobian() @ chart.jacobian(np.zeros((1, n)))
        np.testing.assert_allclose(product[0], np.eye(n), atol=1e-9)


@pytest.mark.parametrize("power", [0, 4])
def test_firm_moments_keep_their_coordinates(power: int) -> None:
    """Strength and direction of the moment, whether or not it grows with the range."""
    chart = replace(Chart.at(STATE[None], CENTROID, 1.0), firm=np.ones(1, dtype=bool), power=power)
    e = E[None] * np.repeat([1.0, 200.0 / chart.length[0] ** power, 1.0], [3, 3, 6])
    moved, L = chart.linearise(e)
    np.testing.assert_allclose(chart.coordinates(moved), e, rtol=1e-9, atol=1e-12)
    slope = derivative(lambda y: np.apply_along_axis(lambda e: chart.retract(e[None])[0], -1, y), e[0], 1e-2, atol=1e-5)
    scale = np.abs(slope).max(axis=1, keepdims=True)
    np.testing.assert_allclose(L[0] / scale, slope / scale, atol=1e-6)


def test_a_step_along_the_range_keeps_what_differences_see() -> None:
    """Far away they fall with the fourth power of the range: the gradient tensor stays, to rounding."""
    chart = Chart.at(STATE[:6], CENTROID, 1.0)
    moved = chart.retract(np.array([0.7, 0.0, 0.0, 0.0, 0.0, 0.0]))
    np.testing.assert_allclose(gradient(moved), gradient(STATE[:6]), rtol=1e-9, atol=1e-20)


def test_a_source_at_the_centroid_has_a_chart() -> None:
    state = np.concatenate([CENTROID, STATE[3:6]])
    chart = Chart.at(state, CENTROID, 1.0)
    assert np.isfinite(chart.jacobian(np.zeros(6))).all()
    np.testing.assert_array_equal(chart.retract(np.zeros(6)), state)


def gradient(state: FloatArray) -> FloatArray:
    """Gradient tensor (3, 3) of a source at the centroid."""
    return dipole.field_jacobian(CENTROID, state[:3], state[3:6])[:, :3]


class TestMirrored:
    def test_have_the_same_gradient_tensor(self) -> None:
        states = np.random.default_rng(0).normal(size=(20, 6)) * np.repeat([5.0, 100.0], 3)
        for mirror in mirror_images(states, CENTROID):
            for state, image in zip(states, mirror, strict=True):
                tensor = gradient(state)
                np.testing.assert_allclose(gradient(image), tensor, atol=1e-9 * np.abs(tensor).max())

    def test_are_four(self) -> None:
        """Directions apart, at one range, of one strength."""
        images = mirror_images(STATE[None, :6], CENTROID)[:, 0]
        offset = images[:, :3] - CENTROID
        np.testing.assert_allclose(np.linalg.norm(offset, axis=1), np.linalg.norm(offset[0]))
        np.testing.assert_allclose(np.linalg.norm(images[:, 3:], axis=1), np.linalg.norm(STATE[3:6]))
        assert np.linalg.norm(offset[:, None] - offset[None] + 10.0 * np.eye(4)[..., None], axis=2).min() > 0.1
