"""Moments of a dipole at a known place.

| what | who checks it |
|---|---|
| all solutions without an ambient field | roots that scipy's Powell hybrid method finds from random moments |
| fixes with vector sensors | numpy's linear least squares |
| covariance | scipy's numerical second derivative of χ²; the figures of the specification; scatter of the moments |
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.differentiate
import scipy.optimize
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.stats import chi2 as chi2_distribution

import magloc
from arrays.array import SensorArray
from arrays.differences import decorrelated_differences
from arrays.geometries import cube, grid, tetrahedron
from magloc.fields import dipole
from magloc.localization.fit.prior import SourcePrior
from magloc.measurement.differences import DifferenceMeasurement, predicted_channels
from tests.arrays.test_differences import random_array
from tests.plain_locator import noisy_readings, plain_locator

SEEDS = st.integers(0, 2**32 - 1)
PLACE = np.array([5.0, 0.0, 0.306])
AMBIENT = 5e-5 * np.array([0.4, 0.0, 0.917]) / np.linalg.norm([0.4, 0.0, 0.917])


def scalar_tetrahedron(noise_T, ambient_T=None):
    ambient = None if ambient_T is None else tuple(np.asarray(ambient_T).tolist())
    return replace(tetrahedron(1.5, "scalar", noise_T), ambient_T=ambient)


def random_moments(rng, n, modulus=300.0):
    m = rng.normal(size=(n, 3))
    return m * modulus / np.linalg.norm(m, axis=1, keepdims=True)


def moments_of(fix):
    return np.array([solution.moment_Am2 for solution in fix.solutions]).reshape(-1, 3)


def best_moments(fixes):
    return np.array([fix.solutions[0].moment_Am2 for fix in fixes])


def chi2_of(array, readings, position, moment):
    """χ² of moments (..., 3) by the readable measurement model."""
    measurement = DifferenceMeasurement(array, decorrelated_differences(array, np.isfinite(readings)))
    residual = measurement.measured(readings) - measurement.predicted(position, moment)
    return np.sum(residual**2 / measurement.variance, axis=-1)


class TestSeveralSources:
    """Moments of several sources at known places."""

    PLACES = np.array([[0.0, 0.0, 0.1], [0.1, 0.05, 0.12]])

    def readings(self, array, rng, n):
        moments = random_moments(rng, 2, 0.3)
        fields = sum(dipole.field(array.positions, p, m) for p, m in zip(self.PLACES, moments, strict=True))
        clean = array.readings_of(fields + array.ambient_fields)
        return moments.ravel(), clean + rng.normal(size=(n, clean.size)) * array.channel_noise_T

    def test_vector_sensors_are_least_squares(self):
        array = grid(3, 3, 0.1, noise_T=1e-9)
        _, readings = self.readings(array, np.random.default_rng(1), 5)
        differences = decorrelated_differences(array)
        columns = [(dipole.field(array.positions, place, axis)).ravel() for place in self.PLACES for axis in np.eye(3)]
        A = differences.transform @ np.transpose(columns) / np.sqrt(differences.variance)[:, None]
        z = readings @ differences.transform.T / np.sqrt(differences.variance)
        fixes = magloc.locate(array, readings, position_m=self.PLACES)
        for fix, of_row in zip(fixes, z, strict=True):
            found = np.concatenate([source.moment_Am2 for source in fix.best.sources])
            assert_allclose(found, np.linalg.lstsq(A, of_row, rcond=None)[0], rtol=1e-8)
            assert_allclose(fix.best.covariance, np.linalg.inv(A.T @ A), rtol=1e-6)
            assert_allclose([source.position_m for source in fix.best.sources], self.PLACES)
            assert fix.best.dof == differences.n_differences - 6

    @pytest.mark.slow_after(1)
    @pytest.mark.parametrize("ambient_T", [None, tuple(AMBIENT.tolist())])
    def test_moduli_are_as_precise_as_they_say(self, ambient_T):
        """NEES of 6 × 60 within 99.9 %; without an ambient field both signs are listed, and the nearer one counts."""
        array = replace(grid(4, 3, 0.1, "scalar", 1e-10), ambient_T=ambient_T)
        true, readings = self.readings(array, np.random.default_rng(2), 60)
        total = 0.0
        for fix in magloc.locate(array, readings, position_m=self.PLACES):
            assert len(fix.solutions) == (2 if ambient_T is None else 1)
            errors = [
                (np.concatenate([source.moment_Am2 for source in solution.sources]) - true, solution.covariance)
                for solution in fix.solutions
            ]
            error, covariance = min(errors, key=lambda pair: np.linalg.norm(pair[0]))
            total += error @ np.linalg.solve(covariance, error)
        low, high = chi2_distribution.ppf([0.0005, 0.9995], 360)
        assert low < total < high

    @pytest.mark.parametrize(
        ("places", "text"),
        [
            ([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0]], "must be different places"),
            ([[0.0, 0.0, 1.0], [1.0, 0.0, np.nan]], "must be three finite numbers"),
            (np.zeros((2, 2)), r"must have shape \(3,\) or \(K, 3\)"),
        ],
    )
    def test_bad_places(self, places, text):
        with pytest.raises(ValueError, match=text):
            magloc.locate(tetrahedron(1.5), np.zeros((1, 12)), position_m=places)


class TestOneSensor:
    def test_in_a_common_field_with_a_prior(self):
        """Three readings, three unknowns; the prior of the common field counts as noise."""
        array = SensorArray((tetrahedron(1.5).sensors[0],), common_field_T=2e-9)
        place = array.positions[0] + np.array([1.0, 0.0, 0.0])
        readings = predicted_channels(array, place, [3.0, -1.0, 2.0])
        fix = magloc.locate(array, readings, position_m=place)[0]
        assert_allclose(fix.best.moment_Am2, [3.0, -1.0, 2.0], rtol=1e-9)
        noise_T = np.hypot(array.sensors[0].noise_T, 2e-9)
        A = np.transpose([dipole.field(array.positions[0], place, axis) for axis in np.eye(3)])
        assert_allclose(fix.best.covariance, noise_T**2 * np.linalg.inv(A.T @ A), rtol=1e-9, atol=1e-9)
        track = magloc.track_moment(array, readings[None], place)  # warnings are errors
        assert_allclose(track[0].range_interval_m, [(1.0, 1.0)])

    def test_no_place_is_found(self):
        array = SensorArray((tetrahedron(1.5).sensors[0],), common_field_T=2e-9)
        for estimate in (magloc.locate, magloc.track):
            with pytest.raises(ValueError, match="Input array must have at least two sensors if no position is known"):
                estimate(array, np.full((2, 3), 1e-6))


class TestMisfit:
    def test_deviations_are_enlarged(self):
        """As those of fixes without a place: by √(χ²/dof), also of several places."""
        array, place = tetrahedron(1.5, noise_T=1e-9), np.array([5.0, 0.0, 0.3])
        readings = predicted_channels(array, place, [0.0, 10.0, 300.0])
        readings = readings + 1e-7 * np.random.default_rng(3).normal(size=readings.size)
        for places in (place, [place, [-4.0, 2.0, 0.0]]):
            fix, quiet = (
                magloc.locate(replaced, readings, position_m=places)[0]
                for replaced in (array, tetrahedron(1.5, noise_T=1e-7))
            )
            assert fix.misfit
            assert not quiet.misfit
            chi2 = fix.best.chi2 / fix.best.dof
            assert_allclose(fix.best.covariance, quiet.best.covariance * 1e-4 * chi2, rtol=1e-6, atol=1e-9)


class TestKnownAmbientField:
    """The moment is unique, and as precise as its covariance says."""

    @pytest.mark.parametrize("n", [200, pytest.param(1000, marks=pytest.mark.slow)])
    def test_median_error_of_four_scalar_sensors(self, n):
        array, rng = scalar_tetrahedron(1e-10, AMBIENT), np.random.default_rng(0)
        moment = random_moments(rng, n)
        fixes = plain_locator(array, position_m=PLACE).fit_rows(noisy_readings(array, PLACE, moment, rng))
        assert all(len(fix.solutions) == 1 for fix in fixes)
        assert np.median(np.linalg.norm(best_moments(fixes) - moment, axis=1)) <= 1.5

    def test_covariance_of_a_small_moment_is_that_of_the_specification(self):
        array = scalar_tetrahedron(1e-9, AMBIENT)
        readings = predicted_channels(array, PLACE, [[0.01, 0.02, -0.01]])
        (fix,) = plain_locator(array, position_m=PLACE).fit_rows(readings)
        sigma = np.sqrt(np.diag(fix.solutions[0].covariance))
        assert_allclose(sigma, [1.3, 5.9, 2.8], atol=0.05)

    def test_errors_agree_with_the_covariance(self):
        """The sum over all rows is χ² distributed; a false alarm in a thousand seeds."""
        array, rng = scalar_tetrahedron(1e-10, AMBIENT), np.random.default_rng(1)
        moment = random_moments(rng, 400)
        fixes = plain_locator(array, position_m=PLACE).fit_rows(noisy_readings(array, PLACE, moment, rng))
        error = best_moments(fixes) - moment
        covariance = np.array([fix.solutions[0].covariance for fix in fixes])
        nees = np.einsum("ni,ni->", error, np.linalg.solve(covariance, error[..., None])[..., 0])
        low, high = chi2_distribution.ppf([0.0005, 0.9995], 3 * len(moment))
        assert low < nees < high

    def test_ambient_field_of_every_row(self):
        """Given with the readings it counts as that of the array does."""
        rng = np.random.default_rng(2)
        ambient = random_moments(rng, 5, 5e-5)
        moment = random_moments(rng, 5)
        arrays = [scalar_tetrahedron(1e-10, of_row) for of_row in ambient]
        readings = np.array([noisy_readings(a, PLACE, m, rng) for a, m in zip(arrays, moment, strict=True)])
        together = plain_locator(scalar_tetrahedron(1e-10, [1e-5, 2e-5, 3e-5]), position_m=PLACE).fit_rows(
            readings, ambient
        )
        for array, row, fix in zip(arrays, readings, together, strict=True):
            (alone,) = plain_locator(array, position_m=PLACE).fit_rows(row[None])
            assert_allclose(moments_of(fix), moments_of(alone), rtol=1e-9)
            assert_allclose(fix.solutions[0].covariance, alone.solutions[0].covariance, rtol=1e-6)

    def test_a_gradient_of_the_ambient_field_is_part_of_the_model(self):
        gradient = 1e-8 * np.array([[1.0, 0.3, 0.2], [0.3, -2.0, 0.1], [0.2, 0.1, 1.0]])
        array = replace(scalar_tetrahedron(1e-11, AMBIENT), ambient_gradient_T_m=tuple(map(tuple, gradient.tolist())))
        fields = AMBIENT + array.positions @ gradient + dipole.field(array.positions, PLACE, [100.0, -200.0, 50.0])
        (fix,) = plain_locator(array, position_m=PLACE).fit_rows(np.linalg.norm(fields, axis=1)[None])
        assert_allclose(moments_of(fix), [[100.0, -200.0, 50.0]], atol=1e-3)


class TestNoAmbientField:
    """Every solution is listed: those that there are, and no others."""

    @pytest.mark.parametrize("n", [300, pytest.param(1000, marks=pytest.mark.slow)])
    def test_both_signs_are_listed(self, n):
        array, rng = scalar_tetrahedron(1e-11), np.random.default_rng(3)
        moment = random_moments(rng, n)
        fixes = plain_locator(array, position_m=PLACE).fit_rows(noisy_readings(array, PLACE, moment, rng))
        found = [
            all(np.any(np.linalg.norm(moments_of(fix) - sign * m, axis=1) <= 3.0) for sign in (1.0, -1.0))
            for fix, m in zip(fixes, moment, strict=True)
        ]
        assert np.mean(found) >= 0.95

    @pytest.mark.parametrize("noise_T", [1e-12, 1e-11, 1e-9])
    def test_opposite_moments_come_in_pairs(self, noise_T):
        array, rng = scalar_tetrahedron(noise_T), np.random.default_rng(4)
        fixes = plain_locator(array, position_m=PLACE).fit_rows(
            noisy_readings(array, PLACE, random_moments(rng, 60), rng)
        )
        assert any(fix.solutions for fix in fixes)
        for fix in fixes:
            assert len(fix.solutions) % 2 == 0
            for one, other in zip(fix.solutions[::2], fix.solutions[1::2], strict=True):
                assert_allclose(other.moment_Am2, -one.moment_Am2, rtol=1e-12)
                assert other.chi2 == one.chi2
                assert_allclose(other.covariance, one.covariance, rtol=1e-6)

    @pytest.mark.slow
    def test_the_solutions_are_the_roots_of_the_differences(self):
        """Twenty random places and moments; usually there are four."""
        rng = np.random.default_rng(5)
        array = scalar_tetrahedron(1e-13)
        counts = []
        for _ in range(20):
            direction = random_moments(rng, 1, 1.0)[0]
            place, moment = rng.uniform(2.0, 6.0) * direction, random_moments(rng, 1)[0]
            readings = predicted_channels(array, place, moment)
            roots = roots_of_differences(array, readings, place, rng)
            (fix,) = plain_locator(array, position_m=place).fit_rows(readings[None])
            listed = moments_of(fix)
            apart = np.linalg.norm(listed[:, None] - roots, axis=-1)
            assert apart.shape[0] == apart.shape[1]
            assert np.all(apart.min(axis=0) < 1e-2)
            assert np.all(apart.min(axis=1) < 1e-2)
            counts.append(len(roots))
        assert np.mean(np.array(counts) == 4) > 0.5
        assert min(counts) >= 2

    def test_covariance_is_half_the_second_derivative_of_chi2_inverted(self):
        array, rng = cube(1.0, "scalar", 2e-9), np.random.default_rng(6)
        place = np.array([2.0, 1.0, 0.5])
        readings = noisy_readings(array, place, random_moments(rng, 5), rng)
        for row, fix in zip(readings, plain_locator(array, position_m=place).fit_rows(readings), strict=True):
            for solution in fix.solutions:
                assert_allclose(chi2_of(array, row, place, solution.moment_Am2), solution.chi2, rtol=1e-6)
                hessian = scipy.differentiate.hessian(
                    lambda x, row=row: chi2_of(array, row, place, np.moveaxis(x, 0, -1)),
                    solution.moment_Am2,
                    initial_step=1.0,
                ).ddf
                assert_allclose(np.linalg.inv(0.5 * hessian), solution.covariance, rtol=1e-3, atol=1e-6)


def roots_of_differences(array, readings, place, rng):
    """Moments whose differences of moduli are those of readings, from 300 random starts."""
    measured = np.diff(readings)
    matrix = dipole.field_matrix(array.positions, place)
    unit = np.linalg.norm(measured)

    def excess(x):
        return (np.diff(np.linalg.norm(matrix @ (300.0 * x), axis=1)) - measured) / unit

    roots: list = []
    for start in rng.normal(size=(300, 3)):
        found = scipy.optimize.root(excess, start, tol=1e-13)
        if np.linalg.norm(excess(found.x)) < 1e-9 and all(np.linalg.norm(found.x - x) > 1e-5 for x in roots):
            roots.append(found.x)
    return 300.0 * np.array(roots)


class TestVectorSensors:
    """The components are linear in the moment: the solution is that of linear least squares."""

    @given(SEEDS, st.integers(3, 6))
    @settings(max_examples=20, deadline=None)
    def test_any_array(self, seed, n_sensors):
        rng = np.random.default_rng(seed)
        array = random_array(seed, n_sensors)
        place = 4.0 * random_moments(rng, 1, 1.0)[0]
        readings = noisy_readings(array, place, random_moments(rng, 1, 1e4)[0], rng)
        (fix,) = plain_locator(array, position_m=place).fit_rows(readings[None])
        measurement = DifferenceMeasurement.of(array)
        root = np.sqrt(measurement.variance)
        design = measurement.jacobian(place, [1.0, 0.0, 0.0])[:, 3:] / root[:, None]
        offset = measurement.predicted(place, np.zeros(3)) / root
        expected, chi2, _, _ = np.linalg.lstsq(design, measurement.measured(readings) / root - offset, rcond=None)
        (solution,) = fix.solutions
        assert_allclose(solution.moment_Am2, expected, rtol=1e-6, atol=1e-6 * np.linalg.norm(expected))
        assert_allclose(solution.covariance, np.linalg.inv(design.T @ design), rtol=1e-5, atol=1e-9)
        assert solution.dof == len(root) - 3
        assert_allclose(solution.chi2, chi2.sum(), rtol=1e-6, atol=1e-6)


class TestMixedArray:
    def test_a_vector_sensor_and_moduli_tell_the_sign(self):
        """Components are not even in the moment."""
        vector = cube(1.0, "vector", 1e-11).sensors[:2]
        scalar = [replace(s, id=f"t{s.id}") for s in cube(1.0, "scalar", 1e-11).sensors[2:]]
        array, rng = SensorArray((*vector, *scalar)), np.random.default_rng(7)
        moment = random_moments(rng, 10)
        fixes = plain_locator(array, position_m=PLACE).fit_rows(noisy_readings(array, PLACE, moment, rng))
        for fix, m in zip(fixes, moment, strict=True):
            assert not np.any(np.linalg.norm(moments_of(fix) + m, axis=1) < 30.0)
            assert np.linalg.norm(fix.solutions[0].moment_Am2 - m) < 3.0

    def test_without_the_vector_sensors_readings_it_is_lost_again(self):
        vector = cube(1.0, "vector", 1e-11).sensors[:2]
        scalar = [replace(s, id=f"t{s.id}") for s in cube(1.0, "scalar", 1e-11).sensors[2:]]
        array = SensorArray((*vector, *scalar))
        readings = predicted_channels(array, PLACE, [[100.0, 200.0, -50.0]])
        readings[:, ~array.channel_is_scalar] = np.nan
        (fix,) = plain_locator(array, position_m=PLACE).fit_rows(readings)
        assert_allclose(fix.solutions[1].moment_Am2, -fix.solutions[0].moment_Am2)


class TestRows:
    """Every row is solved by itself."""

    def test_a_place_for_every_row(self):
        array, rng = scalar_tetrahedron(1e-10, AMBIENT), np.random.default_rng(8)
        places = PLACE + rng.normal(size=(6, 3))
        moment = random_moments(rng, 6)
        readings = noisy_readings(array, places, moment, rng)
        fixes = plain_locator(array, position_m=places).fit_rows(readings)
        for place, row, fix in zip(places, readings, fixes, strict=True):
            (alone,) = plain_locator(array, position_m=place).fit_rows(row[None])
            assert_allclose(moments_of(fix), moments_of(alone), rtol=1e-9)
            assert_allclose(fix.solutions[0].position_m, place)
            distance = np.linalg.norm(place - array.centroid)
            assert_allclose(fix.solutions[0].range_interval_m, [[distance, distance]])

    def test_missing_sensors(self):
        """A row without some readings is a row of the array without those sensors."""
        array, rng = replace(cube(1.0, "scalar", 1e-10), ambient_T=tuple(AMBIENT)), np.random.default_rng(9)
        readings = noisy_readings(array, PLACE, random_moments(rng, 3), rng)
        gone = readings.copy()
        gone[1, [0, 5]] = np.nan
        fixes = plain_locator(array, position_m=PLACE).fit_rows(gone)
        rest = array.subset([array.ids[i] for i in (1, 2, 3, 4, 6, 7)])
        (expected,) = plain_locator(rest, position_m=PLACE).fit_rows(readings[1:2, [1, 2, 3, 4, 6, 7]])
        assert_allclose(moments_of(fixes[1]), moments_of(expected), rtol=1e-6)
        assert fixes[1].solutions[0].dof == 2
        assert fixes[0].solutions[0].dof == 4

    def test_too_few_sensors_are_told(self):
        array = scalar_tetrahedron(1e-10, AMBIENT)
        readings = predicted_channels(array, PLACE, [[100.0, 0.0, 0.0]])
        readings[0, 2] = np.nan
        (fix,) = plain_locator(array, position_m=PLACE).fit_rows(readings)
        assert not fix.solutions
        assert fix.reason == "3 readings give 2 independent differences, 3 are needed"

    def test_readings_without_differences_are_no_signal(self):
        (fix,) = plain_locator(scalar_tetrahedron(1e-10), position_m=PLACE).fit_rows(np.full((1, 4), 5e-5))
        assert not fix.solutions
        assert "no signal" in fix.reason

    def test_progress_counts_all_rows(self):
        counts: list[int] = []
        readings = np.tile([1e-9, 2e-9, 3e-9, 5e-9], (70, 1))
        plain_locator(scalar_tetrahedron(1e-10, AMBIENT), position_m=PLACE).fit_rows(readings, progress=counts.append)
        assert sum(counts) == 70


class TestKnowledge:
    def test_solutions_beyond_the_largest_moment_are_left_out(self):
        array, rng = scalar_tetrahedron(1e-11), np.random.default_rng(10)
        readings = predicted_channels(array, PLACE, random_moments(rng, 30))
        free = plain_locator(array, position_m=PLACE).fit_rows(readings)
        bounded = plain_locator(array, position_m=PLACE, prior=SourcePrior(largest_moment_Am2=301.0)).fit_rows(readings)
        left_out = 0
        for every, fix in zip(free, bounded, strict=True):
            small = [m for m in moments_of(every) if np.linalg.norm(m) <= 301.0]
            left_out += len(every.solutions) - len(small)
            assert_allclose(moments_of(fix), small, rtol=1e-9)
        assert left_out > 0

    def test_none_that_is_small_enough(self):
        array = scalar_tetrahedron(1e-11, AMBIENT)
        locator = plain_locator(array, position_m=PLACE, prior=SourcePrior(largest_moment_Am2=10.0))
        (fix,) = locator.fit_rows(predicted_channels(array, PLACE, [[100.0, 0.0, 0.0]]))
        assert not fix.solutions
        assert "small enough" in fix.reason


class TestBadInput:
    @pytest.mark.parametrize("place", [[1.0, 2.0], [1.0, np.nan, 2.0], [[1.0, 2.0]], [[[[1.0, 2.0, 3.0]]]]])
    def test_place(self, place):
        with pytest.raises(ValueError, match="Input position_m must be three finite numbers"):
            plain_locator(scalar_tetrahedron(1e-10), position_m=place)

    def test_place_of_a_sensor(self):
        array = scalar_tetrahedron(1e-10)
        with pytest.raises(ValueError, match="Input position_m must not be that of a sensor"):
            plain_locator(array, position_m=array.positions[2])

    def test_shape_of_the_readings(self):
        with pytest.raises(ValueError, match=r"Input readings_T must have shape \(n, 4\); instead received \(4,\)"):
            plain_locator(scalar_tetrahedron(1e-10), position_m=PLACE).fit_rows(np.zeros(4))
