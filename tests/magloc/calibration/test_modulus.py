"""Calibration by the modulus alone: exact without noise, consistent with it, and refused where it is not determined.

| what | who checks it |
|---|---|
| scale, offset | the simulated sensor, for any scale and offset |
| covariance, χ² | their distributions over simulated sensors |
| accuracy | TWOSTEP's likelihood and a plain algebraic fit, both written out here |
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.linalg import expm
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from arrays.array import SensorArray
from arrays.geometries import tetrahedron
from arrays.sensor import Calibration, Sensor
from magloc.calibration.modulus import calibrate_in_modulus, ellipsoid_calibration

ROW, COLUMN = np.array([0, 1, 2, 0, 0, 1]), np.array([0, 1, 2, 1, 2, 2])
MODULUS = 5e-5


def symmetric(entries):
    matrix = np.zeros((3, 3))
    matrix[ROW, COLUMN] = matrix[COLUMN, ROW] = entries
    return matrix


def directions(rng, n):
    u = rng.normal(size=(n, 3))
    return u / np.linalg.norm(u, axis=1, keepdims=True)


def random_scale(rng, spread):
    """A symmetric positive matrix; the logarithm of its entries is spread evenly."""
    return expm(symmetric(spread * rng.uniform(-1.0, 1.0, 6)))


def readings_of(rng, scale, offset, modulus, n, noise):
    field = np.broadcast_to(modulus, n)[:, None] * directions(rng, n)
    return field @ np.asarray(scale).T + offset + noise * rng.normal(size=(n, 3))


def parameters(offset, scale):
    return np.concatenate([offset, np.asarray(scale)[ROW, COLUMN]])


def nees(result, offset, scale):
    error = parameters(result.offset_T, result.scale) - parameters(offset, scale)
    sigma = np.sqrt(np.diag(result.covariance))
    return (error / sigma) @ np.linalg.solve(result.covariance / np.outer(sigma, sigma), error / sigma)


def algebraic_fit(readings, modulus):
    """Least squares of ``rᵀ A r - 2 bᵀ r = 1`` about the readings' mean, scaled to a constant modulus afterwards."""
    centre = readings.mean(axis=0)
    r = (readings - centre) / modulus
    quadratic = r[:, ROW] * r[:, COLUMN] * np.where(ROW == COLUMN, 1.0, 2.0)
    x = np.linalg.lstsq(np.concatenate([quadratic, -2.0 * r], axis=1), np.ones(len(r)), rcond=None)[0]
    offset = np.linalg.solve(symmetric(x[:6]), x[6:])
    value, vector = np.linalg.eigh(symmetric(x[:6]) / (1.0 + offset @ x[6:]))
    return centre + modulus * offset, (vector / np.sqrt(value)) @ vector.T


def twostep_fit(readings, modulus, noise, start):
    """TWOSTEP's likelihood of |field|² with its mean and variance, the weights those of the previous pass."""
    unit = modulus

    def squares(x):
        inverse = np.linalg.inv(symmetric(x[3:]))
        covariance = (noise / unit) ** 2 * inverse @ inverse
        y = (readings / unit - x[:3]) @ inverse
        variance = 4.0 * np.einsum("ni,ij,nj->n", y, covariance, y) + 2.0 * np.trace(covariance @ covariance)
        return np.sum(y**2, axis=1) - 1.0 - np.trace(covariance), variance

    x = parameters(start[0] / unit, start[1])
    for _ in range(6):
        weight = squares(x)[1] ** -0.5
        x = least_squares(lambda q, weight=weight: squares(q)[0] * weight, x, x_scale=0.1, xtol=1e-12).x
    return unit * x[:3], symmetric(x[3:])


class TestWithoutNoise:
    @given(
        st.lists(st.floats(-0.4, 0.4), min_size=6, max_size=6),
        st.lists(st.floats(-1e-4, 1e-4), min_size=3, max_size=3),
        st.floats(-6.0, 6.0),
        st.integers(0, 2**32 - 1),
    )
    @settings(max_examples=60, deadline=None)
    def test_constant_modulus_gives_back_any_scale_and_offset(self, logarithm, offset, decades, seed):
        """Eigenvalues of the scale up to 3 apart, offsets of several moduli, gains from 1e-6 to 1e6."""
        gain = 10.0**decades
        scale, offset = gain * expm(symmetric(logarithm)), gain * np.array(offset)
        readings = readings_of(np.random.default_rng(seed), scale, offset, MODULUS, 60, 0.0)
        result = ellipsoid_calibration(readings, MODULUS, gain * 1e-14)
        assert result.converged, result.reason
        assert_allclose(result.scale, scale, rtol=0.0, atol=1e-8 * gain)
        assert_allclose(result.offset_T, offset, rtol=0.0, atol=1e-8 * gain * MODULUS)

    @given(st.integers(0, 2**32 - 1))
    @settings(max_examples=30, deadline=None)
    def test_varying_modulus(self, seed):
        rng = np.random.default_rng(seed)
        scale, offset = random_scale(rng, 0.3), 5e-5 * rng.normal(size=3)
        modulus = rng.uniform(2e-5, 5e-5, 40)
        result = ellipsoid_calibration(readings_of(rng, scale, offset, modulus, 40, 0.0), modulus, 1e-14)
        assert_allclose(result.scale, scale, atol=1e-8)
        assert_allclose(result.offset_T, offset, atol=1e-8 * MODULUS)

    def test_a_turn_of_the_axes_is_not_seen(self):
        """Sensors P Q with different rotations Q leave the same ellipsoid of readings."""
        rng = np.random.default_rng(4)
        scale, offset = random_scale(rng, 0.3), np.array([1e-5, -2e-5, 3e-6])
        turned = scale @ Rotation.random(random_state=4).as_matrix()
        result = ellipsoid_calibration(readings_of(rng, turned, offset, MODULUS, 50, 0.0), MODULUS, 1e-14)
        assert_allclose(result.scale, scale, atol=1e-9)
        assert_allclose(result.scale, result.scale.T, atol=1e-15)


class TestConsistency:
    """Two-sided bounds of a false-alarm rate of 1e-3 for each test and size; the seeds are the first ones."""

    @pytest.fixture(params=[40, pytest.param(200, marks=pytest.mark.slow)])
    def n_sensors(self, request):
        return request.param

    @pytest.mark.parametrize(
        ("noise", "n", "modulus"),
        [(1e-9, 30, (5e-5, 5e-5)), (5e-7, 60, (5e-5, 5e-5)), (1e-6, 200, (5e-5, 5e-5)), (2e-7, 100, (2e-5, 5e-5))],
    )
    def test_errors_and_residuals_are_as_large_as_stated(self, noise, n, modulus, n_sensors):
        rng = np.random.default_rng(0)
        errors, residuals, dof = [], [], 0
        for _ in range(n_sensors):
            scale, offset = random_scale(rng, 0.2), 3e-5 * rng.normal(size=3)
            moduli = rng.uniform(*modulus, n)
            result = ellipsoid_calibration(readings_of(rng, scale, offset, moduli, n, noise), moduli, noise)
            assert result.converged, result.reason
            errors.append(nees(result, offset, scale))
            residuals.append(result.chi2)
            dof += result.dof
        low, high = chi2.ppf([5e-4, 1 - 5e-4], 9 * len(errors))
        assert low < np.sum(errors) < high
        low, high = chi2.ppf([5e-4, 1 - 5e-4], dof)
        assert low < np.sum(residuals) < high

    @pytest.mark.slow_after(1)
    @pytest.mark.parametrize(
        ("noise", "n", "cap", "at_least"), [(1e-9, 9, np.pi, 0.75), (1e-9, 300, 0.5, 0.75), (1e-8, 300, 0.7, 0.5)]
    )
    def test_what_is_not_refused_of_a_poor_coverage_is_consistent(self, noise, n, cap, at_least, n_sensors):
        """Nine readings, or all of them within a cap about one direction: refused, or with a covariance that holds."""
        rng = np.random.default_rng(0)
        errors = []
        for _ in range(n_sensors):
            scale, offset = random_scale(rng, 0.2), 3e-5 * rng.normal(size=3)
            u = directions(rng, 30 * n)  # the smaller cap has 6 % of the sphere
            u = u[u[:, 2] > np.cos(cap)][:n]
            readings = MODULUS * u @ scale + offset + noise * rng.normal(size=u.shape)
            result = ellipsoid_calibration(readings, MODULUS, noise)
            if result.converged:
                errors.append(nees(result, offset, scale))
        assert len(errors) >= at_least * n_sensors
        low, high = chi2.ppf([5e-4, 1 - 5e-4], 9 * len(errors))
        assert low < np.sum(errors) < high

    @pytest.mark.parametrize("n_sets", [4, pytest.param(10, marks=pytest.mark.slow)])
    def test_no_bias_is_left_with_many_noisy_readings_of_an_uneven_sensor(self, n_sets):
        """At 2 % noise, gains 3 apart: left in, the bias of the distances would treble these squares."""
        rng = np.random.default_rng(0)
        noise, offset = 1e-6, np.array([2e-5, -1e-5, 5e-6])
        scale = np.diag([0.5, 1.0, 1.5])
        errors = [
            nees(
                ellipsoid_calibration(readings_of(rng, scale, offset, MODULUS, 20000, noise), MODULUS, noise),
                offset,
                scale,
            )
            for _ in range(n_sets)
        ]
        low, high = chi2.ppf([5e-4, 1 - 5e-4], 9 * n_sets)
        assert low < np.sum(errors) < high


class TestAgainstOtherFits:
    """Ratios of root mean square errors, offsets in moduli; they were 1.000 and 0.999, then 0.27 and 0.22."""

    def errors(self, scales, noise, n):
        """Of ours, TWOSTEP's and the algebraic fit."""
        rng = np.random.default_rng(0)
        found = []
        for scale in scales:
            offset = 3e-5 * rng.normal(size=3)
            readings = readings_of(rng, scale, offset, MODULUS, n, noise)
            ours = ellipsoid_calibration(readings, MODULUS, noise)
            plain = algebraic_fit(readings, MODULUS)
            fits = (ours.offset_T, ours.scale), twostep_fit(readings, MODULUS, noise, plain), plain
            found.append([parameters(*fit) - parameters(offset, scale) for fit in fits])
        return np.sqrt(np.mean((np.array(found) / np.repeat([MODULUS, 1.0], [3, 6])) ** 2, axis=(0, 2)))

    def test_nearly_even_sensors_as_accurate_as_twostep(self):
        rng = np.random.default_rng(1)
        ours, twostep, plain = self.errors([random_scale(rng, 0.05) for _ in range(40)], noise=1e-7, n=60)
        assert ours <= 1.01 * twostep
        assert ours <= plain

    @pytest.mark.slow_after(1)
    @pytest.mark.parametrize("n_sets", [3, pytest.param(6, marks=pytest.mark.slow)])
    def test_uneven_sensors_with_strong_noise_more_accurate_than_both(self, n_sets):
        """Many readings, so that the others' bias of the second order in noise over modulus is what remains."""
        ours, twostep, plain = self.errors([np.diag([0.5, 1.0, 1.5])] * n_sets, noise=1e-6, n=20000)
        assert ours < 0.5 * twostep
        assert ours < 0.5 * plain


class TestNotDetermined:
    def refused(self, readings, noise, modulus=MODULUS):
        result = ellipsoid_calibration(readings, modulus, noise)
        assert not result.converged
        assert result.reason
        assert np.isnan(result.scale).all()
        assert np.isnan(result.offset_T).all()
        assert np.isnan(result.covariance).all()
        return result

    @pytest.mark.parametrize("noise", [0.0, 1e-9, 1e-7, 1e-6])
    @pytest.mark.parametrize("varied", [False, True])
    @pytest.mark.parametrize("seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 5))])
    def test_readings_in_a_plane(self, noise, varied, seed):
        rng = np.random.default_rng(seed)
        turn = rng.uniform(0.0, 2.0 * np.pi, 500)
        modulus = rng.uniform(2e-5, 5e-5, 500) if varied else np.full(500, MODULUS)
        u = (
            np.stack([np.cos(turn), np.sin(turn), np.zeros(500)], axis=1)
            @ Rotation.random(random_state=seed).as_matrix()
        )
        readings = modulus[:, None] * u @ random_scale(rng, 0.2) + 1e-5 + noise * rng.normal(size=(500, 3))
        self.refused(readings, max(noise, 1e-12), modulus)

    @pytest.mark.slow_after(1)
    @pytest.mark.parametrize("noise", [1e-9, 1e-7, 1e-6])
    def test_many_readings_along_six_directions(self, noise):
        """Noise makes them 1,800 different directions, which tells nothing more."""
        rng = np.random.default_rng(0)
        u = np.tile(np.concatenate([np.eye(3), -np.eye(3)]), (300, 1))
        self.refused(MODULUS * u + noise * rng.normal(size=u.shape), noise)

    def test_a_small_cap(self):
        rng = np.random.default_rng(0)
        u = directions(rng, 4000)
        u = u[u[:, 2] > np.cos(0.2)]
        self.refused(MODULUS * u + 1e-7 * rng.normal(size=u.shape), 1e-7)

    def test_too_few_readings(self):
        rng = np.random.default_rng(0)
        readings = readings_of(rng, np.eye(3), 0.0, MODULUS, 12, 1e-9)
        readings[:4, 1] = np.nan
        result = self.refused(readings, 1e-9)
        assert result.reason == "8 complete readings are fewer than the nine unknowns"

    def test_a_sensor_that_does_not_turn(self):
        self.refused(np.tile([1e-5, 2e-5, 3e-5], (50, 1)), 1e-9)

    def test_noise_as_large_as_the_field(self):
        rng = np.random.default_rng(0)
        self.refused(readings_of(rng, np.eye(3), 0.0, MODULUS, 100, 3e-5), 3e-5)


class TestInputs:
    def test_incomplete_rows_are_left_out(self):
        rng = np.random.default_rng(0)
        modulus = rng.uniform(2e-5, 5e-5, 50)
        readings = readings_of(rng, np.eye(3), 1e-5, modulus, 50, 1e-9)
        without = ellipsoid_calibration(readings[3:], modulus[3:], 1e-9)
        readings[:3, 2] = np.nan
        result = ellipsoid_calibration(readings, modulus, 1e-9)
        assert_array_equal(result.scale, without.scale)
        assert result.dof == 47 - 9

    def test_a_reading_at_the_very_centre_counts_with_its_whole_distance(self):
        """There every direction is as near as another."""
        u = directions(np.random.default_rng(0), 40)
        result = ellipsoid_calibration(MODULUS * np.concatenate([u, -u, np.zeros((1, 3))]), MODULUS, 1e-9)
        assert not result.converged or result.chi2 > 0.5 * (MODULUS / 1e-9) ** 2

    @pytest.mark.parametrize(
        ("readings", "modulus", "noise", "sentence"),
        [
            (np.zeros((9, 2)), 5e-5, 1e-9, r"Input readings_T must have shape \(n, 3\); instead received \(9, 2\)\."),
            (np.zeros((9, 3)), np.ones(8), 1e-9, r"Input modulus_T must be a number or have shape \(9,\)"),
            (np.zeros((9, 3)), 0.0, 1e-9, r"Input modulus_T must be positive and finite; instead received 0\.0\."),
            (np.zeros((9, 3)), 5e-5, 0.0, r"Input noise_T must be positive and finite; instead received 0\.0\."),
        ],
    )
    def test_misuse(self, readings, modulus, noise, sentence):
        with pytest.raises(ValueError, match=sentence):
            ellipsoid_calibration(readings, modulus, noise)


class TestArray:
    def array(self, rng):
        """Three vector sensors that are not as they say, the third hardly turned, and a scalar one."""
        sensors = []
        for sensor in tetrahedron(1.0, noise_T=1e-9).sensors[:3]:
            turned = Rotation.from_rotvec(0.02 * rng.normal(size=3)).as_matrix()
            sensors.append(
                Sensor(
                    id=sensor.id,
                    kind="vector",
                    position_m=sensor.position_m,
                    noise_T=1e-9,
                    calibration=Calibration.of("vector", random_scale(rng, 0.1) @ turned, 1e-5 * rng.normal(size=3)),
                )
            )
        return SensorArray((*sensors, Sensor(id="s9", kind="scalar", position_m=(0.0, 0.0, 2.0), noise_T=1e-9)))

    def test_every_vector_sensor_with_enough_readings(self):
        rng = np.random.default_rng(0)
        nominal, true = self.array(rng), self.array(rng)
        fields = np.repeat((MODULUS * directions(rng, 80))[:, None], 4, axis=1)
        readings = true.readings_of(fields) + 1e-9 * rng.normal(size=(80, 10))
        readings[5:, 6:9] = np.nan
        calibrated, results = calibrate_in_modulus(nominal, readings, MODULUS)
        assert [name for name, result in results.items() if result.converged] == list(true.ids[:2])
        assert list(results) == list(true.ids[:3])
        assert calibrated.sensors[2:] == nominal.sensors[2:]
        # The moduli are those of the field to a noise of 1 nT over gains of 0.8 to 1.25.
        moduli = np.linalg.norm(calibrated.calibrated_field(readings)[:, :2], axis=-1)
        assert np.std(moduli - MODULUS) < 1.5e-9
        assert np.linalg.norm(nominal.calibrated_field(readings)[:, :2], axis=-1).std() > 1e-6

    def test_axes_stay_as_near_to_the_previous_ones_as_the_ellipsoid_allows(self):
        rng = np.random.default_rng(1)
        nominal, true = self.array(rng), self.array(rng)
        fields = np.repeat((MODULUS * directions(rng, 80))[:, None], 4, axis=1)
        calibrated, results = calibrate_in_modulus(nominal, true.readings_of(fields), MODULUS)
        for before, after in zip(nominal.sensors[:3], calibrated.sensors[:3], strict=True):
            old, new = np.array(before.calibration.scale), np.array(after.calibration.scale)
            assert_allclose(new @ new.T, results[after.id].scale @ results[after.id].scale, rtol=1e-9)
            nearest = np.linalg.norm(new - old)
            for turn in Rotation.from_rotvec(0.01 * rng.normal(size=(50, 3))).as_matrix():
                assert np.linalg.norm(new @ turn - old) > nearest

    def test_misuse(self):
        array = tetrahedron(1.0, kind="scalar")
        with pytest.raises(ValueError, match="Input array must have a vector sensor"):
            calibrate_in_modulus(array, np.ones((20, 4)), MODULUS)
        with pytest.raises(ValueError, match=r"Input readings_T must have shape \(n, 12\)"):
            calibrate_in_modulus(tetrahedron(1.0), np.ones((20, 4)), MODULUS)
