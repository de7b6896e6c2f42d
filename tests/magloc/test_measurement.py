"""What an array measures: predictions and Jacobians of decorrelated differences.

| what | who checks it |
|---|---|
| predicted | magpylib's fields through the paper's formulas (16), (28) |
| jacobian | scipy.differentiate.jacobian |
| fisher_information | the printed Cramér-Rao figures, differentiation of the χ² itself |
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from arrays.differences import decorrelated_differences
from arrays.geometries import tetrahedron
from arrays.sensor import SensorArray
from magloc.measurement import DifferenceMeasurement, channel_jacobian, predicted_channels
from tests import oracles
from tests.arrays.test_differences import random_array

SOURCE = np.array([5.0, 0.0, 0.306])
MOMENT = np.array([60.0, 50.0, 60.0])
AMBIENT = (2e-5, 1e-6, 4.5e-5)


def with_ambient(array):
    return SensorArray(array.sensors, ambient_T=AMBIENT)


class TestPrediction:
    def test_vector_gradiometer_against_magpylib(self):
        array = tetrahedron(1.5)
        B1, B2, B3, B4 = oracles.magpylib_field(array.positions, SOURCE, MOMENT)
        expected = [(B1 + B2 + B3 - 3 * B4) / np.sqrt(3), (B2 - B3) / np.sqrt(2), (B2 + B3 - 2 * B1) / np.sqrt(6)]
        assert_allclose(DifferenceMeasurement.of(array).predicted(SOURCE, MOMENT), np.ravel(expected), rtol=1e-9)

    def test_scalar_gradiometer_against_magpylib(self):
        array = with_ambient(tetrahedron(1.5, kind="scalar"))
        b1, b2, b3, b4 = np.linalg.norm(oracles.magpylib_field(array.positions, SOURCE, MOMENT) + AMBIENT, axis=1)
        expected = [(b1 + b2 + b3 - 3 * b4) / np.sqrt(3), (b2 - b3) / np.sqrt(2), (b2 + b3 - 2 * b1) / np.sqrt(6)]
        assert_allclose(DifferenceMeasurement.of(array).predicted(SOURCE, MOMENT), expected, rtol=1e-6)

    def test_measured_inverts_simulated_readings_whatever_the_calibration(self):
        array = random_array(1, 5)
        measurement = DifferenceMeasurement.of(array)
        readings = predicted_channels(array, SOURCE, MOMENT) + array.channel_offset_T
        predicted = measurement.predicted(SOURCE, MOMENT)
        assert_allclose(measurement.measured(readings), predicted, rtol=1e-9, atol=1e-9 * np.abs(predicted).max())

    def test_an_ambient_field_does_not_reach_vector_differences(self):
        array = tetrahedron(1.5)
        quiet = DifferenceMeasurement.of(array).predicted(SOURCE, MOMENT)
        loud = DifferenceMeasurement.of(with_ambient(array)).predicted(SOURCE, MOMENT)
        assert_allclose(loud, quiet, atol=1e-19)

    def test_missing_readings_may_be_nan(self):
        array = tetrahedron(1.5)
        available = np.ones(12, dtype=bool)
        available[4] = False
        measurement = DifferenceMeasurement(array, decorrelated_differences(array, available))
        readings = predicted_channels(array, SOURCE, MOMENT)
        readings[4] = np.nan
        assert_allclose(measurement.measured(readings), measurement.predicted(SOURCE, MOMENT), rtol=1e-9)
        assert measurement.variance.size == 8


class TestJacobian:
    @given(st.integers(0, 2**32 - 1), st.sampled_from([("vector",), ("scalar",), ("vector", "scalar")]))
    @settings(max_examples=20, deadline=None)
    def test_finite_differences(self, seed, kinds):
        array = with_ambient(random_array(seed, 6, kinds=kinds))
        rng = np.random.default_rng(seed)
        p = 4.0 * Rotation.random(random_state=seed).as_matrix()[0] * rng.uniform(1, 3)
        m = 300.0 * rng.normal(size=3)
        measurement = DifferenceMeasurement.of(array)

        expected = np.concatenate(
            [
                oracles.derivative(lambda q: 1e9 * measurement.predicted(q, m), p, 0.1, 1e-8),
                oracles.derivative(lambda q: 1e9 * measurement.predicted(p, q), m, 10.0, 1e-8),
            ],
            axis=1,
        )
        # Moduli in an ambient field of 5e4 nT leave differences of 1e-16 · 5e4 / 0.1 nT/m to rounding.
        assert_allclose(1e9 * measurement.jacobian(p, m), expected, rtol=1e-6, atol=1e-7)

    def test_first_step_from_a_zero_moment_moves_the_moment_only(self):
        jacobian = DifferenceMeasurement.of(tetrahedron(1.5)).jacobian(SOURCE, np.zeros(3))
        assert not jacobian[:, :3].any()
        assert np.linalg.matrix_rank(1e9 * jacobian[:, 3:]) == 3


class TestBatchAxes:
    def test_equal_to_a_loop(self):
        array = with_ambient(random_array(4, 6, kinds=("vector", "scalar")))
        measurement = DifferenceMeasurement.of(array)
        rng = np.random.default_rng(0)
        p, m = rng.normal(size=(2, 1, 3)) * 5, rng.normal(size=(3, 3)) * 100
        for name in ("predicted", "jacobian", "fisher_information"):
            batch = getattr(measurement, name)(p, m)
            for i in range(2):
                for j in range(3):
                    assert_allclose(batch[i, j], getattr(measurement, name)(p[i, 0], m[j]), rtol=1e-9, atol=1e-22)
        assert channel_jacobian(array, p, m).shape == (2, 3, array.n_channels, 6)


class TestCramerRaoBound:
    """Figures of the specification, to the printed digits (its 4.2 for 4.1498 was rounded twice; 4.15 stands here)."""

    @pytest.mark.parametrize(
        ("edge", "moment", "sigma_p", "sigma_m"),
        [
            (1.5, (0, 0, 100), ("0.289", "0.082", "0.076"), ("4.15", "1.7", "23.6")),
            (1.5, (60, 50, 60), ("0.169", "0.097", "0.082"), ("9.5", "8.7", "9.6")),
            (1.5, (100, 0, 0), ("0.134", "0.230", "0.254"), None),
            (0.5, (0, 0, 100), ("2.74", "0.22", "0.21"), ("11.9", "4.5", "220")),
        ],
    )
    def test_printed_figures(self, edge, moment, sigma_p, sigma_m):
        information = DifferenceMeasurement.of(tetrahedron(edge, noise_T=1e-9)).fisher_information(SOURCE, moment)
        sigma = np.sqrt(np.diagonal(np.linalg.inv(information)))
        for value, printed in zip(sigma, sigma_p + (sigma_m or ()), strict=False):
            decimals = len(printed.partition(".")[2])
            assert f"{value:.{decimals}f}" == printed

    @given(st.integers(0, 3), st.integers(0, 2**32 - 1))
    @settings(max_examples=20, deadline=None)
    def test_base_sensor_and_rotation_of_the_frame_do_not_matter(self, base, seed):
        array = tetrahedron(1.5)
        R = Rotation.random(random_state=seed).as_matrix()
        bound = np.linalg.inv(DifferenceMeasurement.of(array).fisher_information(SOURCE, MOMENT))
        turned = SensorArray(
            tuple(type(s)(id=s.id, kind=s.kind, position_m=R @ s.position_m, noise_T=s.noise_T) for s in array.sensors)
        )
        other = DifferenceMeasurement(turned, decorrelated_differences(turned, base=base))
        R6 = np.kron(np.eye(2), R)
        rotated = np.linalg.inv(other.fisher_information(R @ SOURCE, R @ MOMENT))
        sigma = np.sqrt(np.diagonal(R6 @ bound @ R6.T))
        assert_allclose(rotated / np.outer(sigma, sigma), R6 @ bound @ R6.T / np.outer(sigma, sigma), atol=1e-7)


class TestOnTheSource:
    def test_nan_not_an_exception(self):
        array = tetrahedron(1.5)
        values = DifferenceMeasurement.of(array).predicted(array.positions[0], MOMENT)
        assert np.isnan(values).any()
