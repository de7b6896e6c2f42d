"""What an array measures: predictions and Jacobians of decorrelated differences.

| what | who checks it |
|---|---|
| predicted | magpylib's fields through the paper's formulas (16), (28) |
| a gradient of the ambient field | magpylib's field of a second, far dipole |
| jacobian | scipy.differentiate.jacobian |
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation
from scipy.stats import chi2 as chi2_distribution

from arrays.array import SensorArray
from arrays.differences import decorrelated_differences
from arrays.geometries import tetrahedron
from arrays.noise import reading_errors
from magloc.convergence.filters import DampedFilter, IekfFilter, RepeatedFilter
from magloc.convergence.over_sources import SourcesMap, SourcesScenario
from magloc.convergence.over_starts import StartsScenario, simulate_measurement
from magloc.grids.cube import Box
from magloc.measurement.differences import DifferenceMeasurement, channel_jacobian, predicted_channels
from tests import oracles
from tests.arrays.test_differences import random_array
from tests.magloc.convergence.readable_filters import run_one
from tests.plain_locator import plain_locator

SOURCE = np.array([5.0, 0.0, 0.306])
MOMENT = np.array([60.0, 50.0, 60.0])
AMBIENT = (2e-5, 1e-6, 4.5e-5)
GRADIENT = 1e-9 * np.array([[10.0, -20.0, 5.0], [-20.0, -15.0, 8.0], [5.0, 8.0, 5.0]])


def with_ambient(array):
    return SensorArray(array.sensors, ambient_T=AMBIENT)


def with_gradient(array):
    return replace(array, ambient_T=AMBIENT, ambient_gradient_T_m=GRADIENT)


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


class TestGradientOfTheAmbientField:
    """The field of something large and far away is uniform but for its gradient."""

    FAR = np.array([150.0, -200.0, 90.0])
    LARGE = np.array([3e9, 2e9, -4e9])

    @pytest.mark.parametrize("kinds", [("vector",), ("scalar",), ("vector", "scalar")])
    def test_far_dipole(self, kinds):
        """Second derivatives leave (1 m / 270 m) of the gradient's part: less than a hundredth of it."""

        def far_field(points):
            return oracles.magpylib_field(np.atleast_2d(points), self.FAR, self.LARGE)

        h = 0.01
        gradient = np.stack([(far_field(h * e) - far_field(-h * e))[0] / (2 * h) for e in np.eye(3)], axis=1)
        array = random_array(2, 6, kinds=kinds)
        uniform = replace(array, ambient_T=far_field(np.zeros(3))[0])
        known = replace(uniform, ambient_gradient_T_m=(gradient + gradient.T) / 2 - np.trace(gradient) / 3 * np.eye(3))
        fields = oracles.magpylib_field(array.positions, SOURCE, MOMENT) + far_field(array.positions)
        measured = DifferenceMeasurement.of(array).measured(array.readings_of(fields))
        missed = measured - DifferenceMeasurement.of(uniform).predicted(SOURCE, MOMENT)
        left = measured - DifferenceMeasurement.of(known).predicted(SOURCE, MOMENT)
        assert np.linalg.norm(missed) > 1e-7
        assert np.linalg.norm(left) < 0.03 * np.linalg.norm(missed)

    def test_fixes_are_those_without_it(self):
        array = tetrahedron(1.5)
        p, m = np.array([3.0, -2.0, 1.0]), np.array([100.0, 50.0, -80.0])
        noise = 1e-9 * np.random.default_rng(4).normal(size=12)
        quiet = plain_locator(array).fit(predicted_channels(array, p, m) + noise).solutions[0]
        graded = with_gradient(array)
        readings = predicted_channels(graded, p, m) + noise
        found = plain_locator(graded).fit(readings).solutions[0]
        assert_allclose(found.position_m, quiet.position_m, rtol=1e-6)
        assert found.chi2 == pytest.approx(quiet.chi2, rel=1e-6)
        assert np.linalg.norm(plain_locator(array).fit(readings).solutions[0].position_m - p) > 0.1

    def test_a_prior_of_the_common_field_is_about_the_ambient_field(self):
        array = replace(with_gradient(tetrahedron(1.5)), common_field_T=2e-9)
        p, m = np.array([3.0, -2.0, 1.0]), np.array([100.0, 50.0, -80.0])
        best = plain_locator(array).fit(predicted_channels(array, p, m)).solutions[0]
        assert_allclose(best.position_m, p, rtol=1e-6)

    @pytest.mark.parametrize("method", [RepeatedFilter(), IekfFilter(), DampedFilter()], ids=lambda m: m.name)
    def test_compiled_filters(self, method):
        scenario = StartsScenario(array=with_gradient(tetrahedron(1.5)), noise_seed=1)
        _, measurement, z = simulate_measurement(scenario)
        starts = np.array([[6.0, 1.0, 1.0, 0, 0, 0], [4.0, -1.0, 0.5, 0, 0, 0]])
        ends = method.run(measurement, z, starts)
        assert ends.stopped.all()
        for start, end in zip(starts, ends.states, strict=True):
            twin = run_one(method, measurement, z, start)
            assert_allclose(end[:3], twin.x[:3], atol=1e-6)

    def test_maps_of_sources(self):
        box = Box((0, 0, 0), (slice(0, 3),) * 3)
        maps = [SourcesMap(SourcesScenario(array=a), 6) for a in (tetrahedron(1.5), with_gradient(tetrahedron(1.5)))]
        quiet, graded = (cube.values(box) for cube in maps)
        np.testing.assert_array_equal(graded["status"], quiet["status"])
        for name in ("chi2", "chi2_from_truth"):
            assert_allclose(graded[name], quiet[name], rtol=1e-4, atol=1e-5)


class TestErrorsOfTheCalibration:
    """Correlated errors of the readings are part of the likelihood."""

    def test_chi_square_of_fits_of_misaligned_sensors(self):
        """Sum of 200 χ² of 9 degrees of freedom at high signal; two-sided false-alarm rate 1e-4.

        In a field of 50 µT misalignments of 0.3 mrad are 15 nT, fifteen times the noise: no fit may take them for it.
        """
        array = random_array(12, 6, equal=True)
        array = replace(
            array, sensors=tuple(replace(s, misalignment_rad=3e-4, gain_uncertainty=1e-4) for s in array.sensors)
        )
        rng = np.random.default_rng(12)
        direction = rng.normal(size=(200, 3))
        p = 6.0 * direction / np.linalg.norm(direction, axis=1, keepdims=True)
        m = 3e4 * Rotation.random(200, rng=rng).apply([1.0, 0.0, 0.0])
        in_field = replace(array, ambient_T=AMBIENT)
        exact = predicted_channels(in_field, p, m) + array.channel_offset_T
        readings = exact + reading_errors(array, exact, rng.normal(size=exact.shape))
        fixes = plain_locator(array).fit_rows(readings)
        assert {fix.solutions[0].dof for fix in fixes} == {9}
        low, high = chi2_distribution.ppf([0.5e-4, 1 - 0.5e-4], 9 * 200)
        assert low < sum(fix.solutions[0].chi2 for fix in fixes) < high
        white = [fix.solutions[0].chi2 for fix in plain_locator(random_array(12, 6, equal=True)).fit_rows(readings)]
        assert sum(white) > 10 * high


class TestJacobian:
    @given(st.integers(0, 2**32 - 1), st.sampled_from([("vector",), ("scalar",), ("vector", "scalar")]))
    @settings(max_examples=20, deadline=None)
    def test_finite_differences(self, seed, kinds):
        array = with_gradient(random_array(seed, 6, kinds=kinds))
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
        for name in ("predicted", "jacobian"):
            batch = getattr(measurement, name)(p, m)
            for i in range(2):
                for j in range(3):
                    assert_allclose(batch[i, j], getattr(measurement, name)(p[i, 0], m[j]), rtol=1e-9, atol=1e-22)
        assert channel_jacobian(array, p, m).shape == (2, 3, array.n_channels, 6)


class TestOnTheSource:
    def test_nan_not_an_exception(self):
        array = tetrahedron(1.5)
        values = DifferenceMeasurement.of(array).predicted(array.positions[0], MOMENT)
        assert np.isnan(values).any()
