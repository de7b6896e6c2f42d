"""Differences between sensors, their covariance, and the decorrelated form of both.

| what | who checks it |
|---|---|
| the paper's T, eigenvalues | the printed matrices (13)-(15) |
| χ² of Differences and of Whitening | generalised least squares with the full covariance, in extended form |
| reading_covariance | closed forms, and Monte Carlo of sensors with other calibrations |
| calibration_errors | differences of readings of sensors with other calibrations |
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from arrays.array import SensorArray
from arrays.differences import contrasts, decorrelated_differences, eigen_decorrelation, helmert_decorrelation
from arrays.geometries import tetrahedron
from arrays.noise import calibration_errors, covariance_blocks, proportional_noise, reading_covariance, reading_errors
from arrays.sensor import Calibration, Sensor
from arrays.whitening import whitening, whitenings

SEEDS = st.integers(0, 2**32 - 1)


def difference_covariance(noise):
    """``diag(noise_i²) + noise_base² 1 1ᵀ`` for the last as base, equation (13) for any noise."""
    return np.diag(noise[:-1] ** 2) + noise[-1] ** 2


def random_array(seed, n=5, *, kinds=("vector",), equal=False, common_field_T=None, uncertain=False):
    """Sensors anywhere, turned anyhow, of unequal noise and gain, and of a calibration that is uncertain or not."""
    rng = np.random.default_rng(seed)
    sensors = []
    for i in range(n):
        kind = kinds[i % len(kinds)]
        channels = 3 if kind == "vector" else 1
        rotation = rng.normal(size=4)
        scale = np.eye(channels) if equal else np.eye(channels) + 0.1 * rng.normal(size=(channels, channels))
        sensors.append(
            Sensor(
                id=f"s{i + 1}",
                kind=kind,
                position_m=rng.normal(size=3),
                noise_T=1e-9 if equal else 1e-9 * rng.uniform(0.3, 3.0),
                rotation_xyzw=rotation / np.linalg.norm(rotation),
                calibration=Calibration.of(kind, scale, 1e-7 * rng.normal(size=channels)),
                misalignment_rad=rng.uniform(1e-4, 1e-3) if uncertain and kind == "vector" else 0.0,
                gain_uncertainty=rng.uniform(1e-4, 1e-3) if uncertain else 0.0,
            )
        )
    return SensorArray(tuple(sensors), common_field_T=common_field_T)


def chi2_of_differences(differences, channels):
    return float(np.sum((differences.transform @ channels) ** 2 / differences.variance))


def chi2_by_generalised_least_squares(array, available, channels, covariance_T2=None):
    """χ² with the common field of each kind as an unknown (or with its prior), by the full normal equations."""
    total = 0.0
    everything = np.diag(array.channel_noise_T**2) if covariance_T2 is None else covariance_T2
    for is_scalar in (False, True):
        group = available & (array.channel_is_scalar == is_scalar)
        if not group.any():
            continue
        common = array.channel_gain[group, :1] if is_scalar else array.channel_gain[group]
        # nT keep the numbers of order one.
        y, noise = 1e9 * channels[group], 1e18 * everything[np.ix_(group, group)]
        if array.common_field_T is None:
            eigenvalues, vectors = np.linalg.eigh(noise)
            W = (vectors / np.sqrt(eigenvalues)).T
            residual = W @ y - W @ common @ np.linalg.lstsq(W @ common, W @ y, rcond=None)[0]
            total += residual @ residual
        else:
            covariance = noise + (1e9 * array.common_field_T) ** 2 * common @ common.T
            total += y @ np.linalg.solve(covariance, y)
    return total


def earth_field(rng):
    """50 µT in any direction."""
    direction = rng.normal(size=3)
    return 5e-5 * direction / np.linalg.norm(direction)


class TestThePapersMatrices:
    """Four sensors of equal noise, the last one the base."""

    sigma = 1.7e-9
    R = np.array([[2.0, 1, 1], [1, 2, 1], [1, 1, 2]])
    T = np.array(
        [
            [1 / np.sqrt(3), 1 / np.sqrt(3), 1 / np.sqrt(3)],
            [0, 1 / np.sqrt(2), -1 / np.sqrt(2)],
            [-2 / np.sqrt(6), 1 / np.sqrt(6), 1 / np.sqrt(6)],
        ]
    )

    def test_equation_5(self):
        assert_allclose(contrasts(4), [[1, 0, 0, -1], [0, 1, 0, -1], [0, 0, 1, -1]])

    def test_equation_14(self):
        assert_allclose(helmert_decorrelation(3), self.T, atol=1e-15)

    def test_equation_16(self):
        rng = np.random.default_rng(0)
        B1, B2, B3, B4 = B = rng.normal(size=(4, 3))
        d = decorrelated_differences(tetrahedron(1.5, noise_T=self.sigma))
        expected = [(B1 + B2 + B3 - 3 * B4) / np.sqrt(3), (B2 - B3) / np.sqrt(2), (B2 + B3 - 2 * B1) / np.sqrt(6)]
        assert_allclose(d.transform @ B.ravel(), np.ravel(expected), atol=1e-14)
        assert_allclose(d.variance, self.sigma**2 * np.repeat([4.0, 1.0, 1.0], 3), rtol=1e-12)

    def test_equation_28_for_moduli(self):
        d = decorrelated_differences(tetrahedron(1.5, kind="scalar", noise_T=self.sigma))
        assert_allclose(d.transform @ [1.0, 2.0, 4.0, 8.0], [(7 - 24) / np.sqrt(3), -2 / np.sqrt(2), 4 / np.sqrt(6)])
        assert_allclose(d.variance, self.sigma**2 * np.array([4.0, 1.0, 1.0]), rtol=1e-12)


class TestDecorrelation:
    @given(st.integers(2, 40))
    def test_helmert_diagonalises_any_number_of_sensors(self, n):
        T = helmert_decorrelation(n - 1)
        assert_allclose(T @ T.T, np.eye(n - 1), atol=1e-13)
        R = difference_covariance(np.ones(n))
        assert_allclose(T @ R @ T.T, np.diag([n] + [1] * (n - 2)), atol=1e-12)

    @given(SEEDS, st.integers(2, 20))
    @settings(deadline=None)
    def test_eigenvectors_diagonalise_unequal_noise(self, seed, n):
        noise = 1e-9 * np.random.default_rng(seed).uniform(0.1, 10, n)
        R = difference_covariance(noise)
        T, variance = eigen_decorrelation(contrasts(n) * noise)
        assert_allclose(T @ T.T, np.eye(n - 1), atol=1e-12)
        assert_allclose(T @ R @ T.T, np.diag(variance), rtol=1e-10, atol=1e-12 * variance[0])
        assert (np.diff(variance) <= 0).all()

    @pytest.mark.parametrize("kinds", [("vector",), ("scalar",), ("vector", "scalar")])
    def test_a_sensor_that_is_all_noise_counts_as_none(self, kinds):
        """With 1e12 times the noise of others, whose variances are lost in a covariance of both; a base or not."""
        good = random_array(0, 6, kinds=kinds)
        channels = 1e-9 * np.random.default_rng(1).normal(size=good.n_channels)
        for lost in (0, 1, 4, 5):
            sensors = [replace(s, noise_T=1e3) if i == lost else s for i, s in enumerate(good.sensors)]
            chi2 = chi2_of_differences(decorrelated_differences(replace(good, sensors=tuple(sensors))), channels)
            without = decorrelated_differences(good, good.channel_sensor != lost)
            assert chi2 == pytest.approx(chi2_of_differences(without, channels), rel=1e-3)

    def test_noise_beyond_double_precision_is_refused(self):
        array = random_array(0, 5)
        array = replace(array, sensors=(replace(array.sensors[0], noise_T=1e8), *array.sensors[1:]))
        with pytest.raises(ValueError, match="within a factor of 1e13 of each other"):
            decorrelated_differences(array)


class TestLikelihoodDoesNotDependOnItsForm:
    """Base sensor, closed or numerical form, projection, and the marginalised common field: one χ²."""

    @pytest.mark.parametrize("correlated", [False, True])
    @given(SEEDS, st.sampled_from([("vector",), ("scalar",), ("vector", "scalar")]), st.booleans(), st.booleans())
    @settings(max_examples=60, deadline=None)
    def test_differences_whitening_and_generalised_least_squares(self, correlated, seed, kinds, missing, prior):
        """Correlated in a field of 50 µT, where the errors of a calibration are up to 50 times the noise, or not."""
        array = random_array(seed, 6, kinds=kinds, common_field_T=3e-9 if prior else None, uncertain=correlated)
        rng = np.random.default_rng(seed)
        readings = array.readings_of(earth_field(rng) + 1e-7 * rng.normal(size=(6, 3)))
        available = rng.random(array.n_channels) > 0.3 if missing else np.ones(array.n_channels, dtype=bool)
        covariance = reading_covariance(array, np.where(available, readings, np.nan)) if correlated else None
        channels = 1e-8 * rng.normal(size=array.n_channels)
        d = decorrelated_differences(array, available, covariance_T2=covariance)
        w = whitening(array, available, covariance_T2=covariance)
        expected = chi2_by_generalised_least_squares(array, available, channels, covariance)
        assert chi2_of_differences(d, channels) == pytest.approx(expected, rel=1e-7 if correlated else 1e-8, abs=1e-9)
        assert float(np.sum(w.apply(channels) ** 2)) == pytest.approx(
            expected, rel=1e-7 if correlated else 1e-8, abs=1e-9
        )
        assert d.n_differences == w.n_differences

    @given(SEEDS, st.integers(0, 4))
    @settings(max_examples=40, deadline=None)
    def test_base_sensor_of_correlated_readings(self, seed, base):
        """Equal covariances along all axes take the closed form, others the numerical one: one χ² for any base."""
        array = random_array(seed, 5, equal=True)
        if seed % 2:  # errors of the gains in a field along the diagonal are alike for all axes
            array = replace(array, sensors=tuple(replace(s, gain_uncertainty=1e-3) for s in array.sensors))
            readings = np.tile(2e-5 * np.ones(3), 5) + array.channel_offset_T
        else:
            array = random_array(seed, 5, uncertain=True)
            readings = array.readings_of(np.tile(earth_field(np.random.default_rng(seed)), (5, 1)))
        covariance = reading_covariance(array, readings)
        channels = 1e-8 * np.random.default_rng(seed).normal(size=15)
        last = chi2_of_differences(decorrelated_differences(array, covariance_T2=covariance), channels)
        other = chi2_of_differences(decorrelated_differences(array, base=base, covariance_T2=covariance), channels)
        assert other == pytest.approx(last, rel=1e-7)

    @given(SEEDS, st.booleans())
    @settings(max_examples=20, deadline=None)
    def test_rows_at_once(self, seed, prior):
        array = random_array(
            seed, 6, kinds=("vector", "scalar"), common_field_T=3e-9 if prior else None, uncertain=True
        )
        rng = np.random.default_rng(seed)
        available = rng.random(array.n_channels) > 0.3
        readings = array.readings_of(5e-5 * rng.normal(size=(4, 6, 3)))
        together = whitenings(array, available, covariance_blocks(array, readings))
        for i, covariance in enumerate(reading_covariance(array, readings)):
            alone = whitening(array, available, covariance_T2=covariance)
            channels = 1e-8 * rng.normal(size=array.n_channels)
            of_row = replace(
                together, roots=together.roots[i], basis=together.basis[i], shrinkage=together.shrinkage[i]
            )
            assert_allclose(of_row.apply(channels), alone.apply(channels), atol=1e-9)
            assert_array_equal(of_row.root, alone.root)
            assert together.n_differences == alone.n_differences


class TestMissingReadings:
    def test_missing_channels_do_not_count(self):
        array = random_array(5)
        available = np.ones(15, dtype=bool)
        available[[2, 7]] = False
        d, w = decorrelated_differences(array, available), whitening(array, available)
        assert d.n_differences == 10
        assert not d.transform[:, ~available].any()
        assert not w.root[~available].any()
        assert not w.root[:, ~available].any()

    def test_nothing_left(self):
        array = random_array(5)
        assert decorrelated_differences(array, np.zeros(15, dtype=bool)).n_differences == 0
        assert whitening(array, np.zeros(15, dtype=bool)).n_differences == 0

    def test_wrong_shapes_are_named(self):
        with pytest.raises(ValueError, match=r"Input available must have shape \(12,\)"):
            decorrelated_differences(tetrahedron(1.0), np.ones(4, dtype=bool))
        with pytest.raises(ValueError, match=r"Input covariance_T2 must have shape \(12, 12\)"):
            whitening(tetrahedron(1.0), covariance_T2=np.ones(12))

    def test_covariances_that_are_none_are_refused(self):
        array, correlated = tetrahedron(1.0), np.eye(12)
        correlated[0, 3] = correlated[3, 0] = 0.1
        for make in (whitening, decorrelated_differences):
            with pytest.raises(ValueError, match="Input covariance_T2 must be block-diagonal by sensor; instead"):
                make(array, covariance_T2=correlated)
        with pytest.raises(ValueError, match="Input covariance_T2 must be positive definite; instead"):
            whitening(array, covariance_T2=-np.eye(12))

    def test_axes_that_no_sensor_has_cost_no_difference(self):
        """Of parallel axes alone one component of the common field is seen, not three."""
        array = tetrahedron(1.0)
        available = np.tile([True, False, False], 4)
        assert decorrelated_differences(array, available).n_differences == 3
        assert whitening(array, available).n_differences == 3
        assert whitening(array, available).basis.shape == (12, 1)

    def test_the_other_axes_of_a_sensor_keep_their_covariance(self):
        array = random_array(5, uncertain=True)
        covariance = reading_covariance(array, array.readings_of(np.full((5, 3), 3e-5)))
        available = np.ones(15, dtype=bool)
        available[4] = False
        root = whitening(array, available, covariance_T2=covariance).root[np.ix_([3, 5], [3, 5])]
        assert_allclose(root @ covariance[np.ix_([3, 5], [3, 5])] @ root.T, np.eye(2), atol=1e-12)


class TestProportionalNoise:
    def test_grows_with_the_field_above_the_mean(self):
        sensors = tetrahedron(1.0, noise_T=2e-9).sensors
        array = SensorArray(sensors, noise_fraction=0.03)
        fields = np.array([[4.0, 0, 0], [-4.0, 0, 0], [0, 0, 0], [0, 0, 0]]) * 1e-6
        noise = proportional_noise(array, fields.ravel())
        assert_allclose(noise.reshape(4, 3)[:2], np.hypot(2e-9, 0.03 * 4e-6), rtol=1e-12)
        assert_allclose(noise.reshape(4, 3)[2:], 2e-9, rtol=1e-9)

    def test_a_sensor_may_have_its_own(self):
        first, *others = tetrahedron(1.0, noise_T=2e-9).sensors
        array = SensorArray((replace(first, noise_fraction=0.1), *others), noise_fraction=0.03)
        fields = np.array([[4.0, 0, 0], [-4.0, 0, 0], [0, 0, 0], [0, 0, 0]]) * 1e-6
        noise = proportional_noise(array, fields.ravel()).reshape(4, 3)
        assert_allclose(noise[0], np.hypot(2e-9, 0.1 * 4e-6), rtol=1e-12)
        assert_allclose(noise[1], np.hypot(2e-9, 0.03 * 4e-6), rtol=1e-12)

    def test_the_whole_field_counts_of_a_sensor_alone(self):
        alone = SensorArray(tetrahedron(1.0, noise_T=2e-9).sensors[:1], noise_fraction=0.03, common_field_T=1e-9)
        assert_allclose(proportional_noise(alone, np.array([3e-6, 0.0, 4e-6])), np.hypot(2e-9, 0.03 * 5e-6), rtol=1e-12)

    def test_a_uniform_field_adds_none(self):
        array = SensorArray(tetrahedron(1.0, noise_T=2e-9).sensors, noise_fraction=0.03)
        readings = np.tile([1e-5, 2e-5, 3e-5], 4)
        readings[4] = np.nan
        assert_allclose(proportional_noise(array, readings), 2e-9, rtol=1e-6)

    def test_an_incomplete_sensor_is_no_better_than_a_complete_one(self):
        array = SensorArray(tetrahedron(1.0, noise_T=2e-9).sensors, noise_fraction=0.03)
        rng = np.random.default_rng(0)
        for _ in range(20):
            readings = 1e-6 * rng.normal(size=12)
            readings[4] = np.nan
            noise = proportional_noise(array, readings).reshape(4, 3)[:, 0]
            assert noise[1] >= noise[[0, 2, 3]].max() * (1 - 1e-12)

    def test_the_known_axes_of_an_incomplete_sensor_count(self):
        array = SensorArray(tetrahedron(1.0, noise_T=2e-9).sensors, noise_fraction=0.03)
        readings = np.zeros(12)
        readings[3], readings[4] = 9e-6, np.nan
        assert_allclose(proportional_noise(array, readings)[3:6], np.hypot(2e-9, 0.03 * np.sqrt(1.5) * 9e-6))


def with_errors(array, **errors):
    """The array with the same errors of calibration at every sensor."""
    return replace(array, sensors=tuple(replace(sensor, **errors) for sensor in array.sensors))


def assert_is_covariance_of(samples, covariance):
    """Within 5 standard errors of every entry, once the samples are decorrelated.

    The false-alarm rate is C(C+1)/2 · 6e-7: 1e-4 for 17 channels.
    """
    n, c = samples.shape
    scale = np.sqrt(np.diagonal(covariance))
    root = np.linalg.inv(np.linalg.cholesky(covariance / np.outer(scale, scale)))
    z = (samples - samples.mean(axis=0)) / scale @ root.T
    standard_error = np.where(np.eye(c, dtype=bool), np.sqrt(2.0 / n), np.sqrt(1.0 / n))
    assert np.max(np.abs(z.T @ z / n - np.eye(c)) / standard_error) < 5.0


class TestReadingCovariance:
    """Noise, and what the calibration does not know."""

    def test_a_tenth_of_a_milliradian_in_50_microtesla_is_5_nanotesla(self):
        array = with_errors(tetrahedron(1.0, noise_T=1e-9), misalignment_rad=1e-4)
        field = np.array([0.0, 0.0, 5e-5])
        covariance = reading_covariance(array, np.tile(field, 4))
        block = np.diag([5e-9**2, 5e-9**2, 0.0]) + 1e-9**2 * np.eye(3)
        assert_allclose(covariance, block_diag(*[block] * 4), rtol=1e-12, atol=1e-30)

    @given(SEEDS)
    @settings(max_examples=20, deadline=None)
    def test_without_errors_of_calibration_it_is_the_noise(self, seed):
        array = replace(random_array(seed, 6, kinds=("vector", "scalar")), noise_fraction=0.02)
        readings = 1e-6 * np.random.default_rng(seed).normal(size=(3, array.n_channels))
        readings[0, 1] = np.nan
        expected = np.eye(array.n_channels) * proportional_noise(array, readings)[:, :, None] ** 2
        assert_array_equal(reading_covariance(array, readings), expected)

    def test_of_what_the_field_induces(self):
        """20,000 matrices drawn for every sensor's carrier, of any calibration: closed forms of the readings."""
        rng = np.random.default_rng(10)
        array = random_array(10, 3, kinds=("vector", "vector", "scalar"))
        array = with_errors(array, induced_uncertainty=2e-4)
        fields = 5e-5 * rng.normal(size=(3, 3))
        induced = 2e-4 * np.einsum("...nij,nj->...ni", rng.normal(size=(20_000, 3, 3, 3)), fields)
        samples = array.readings_of(fields + induced)
        samples = samples + array.channel_noise_T * rng.normal(size=samples.shape)
        assert array.noise_depends_on_reading
        assert_is_covariance_of(samples, reading_covariance(array, array.readings_of(fields)))

    def test_batches(self):
        array = replace(random_array(4, 5, kinds=("vector", "scalar"), uncertain=True), noise_fraction=0.01)
        readings = array.readings_of(5e-5 * np.random.default_rng(4).normal(size=(2, 3, 5, 3)))
        readings[0, 1, 4] = np.nan
        covariance = reading_covariance(array, readings)
        assert covariance.shape == (2, 3, array.n_channels, array.n_channels)
        for index in np.ndindex(2, 3):
            assert_allclose(covariance[index], reading_covariance(array, readings[index]), rtol=1e-12, atol=1e-30)

    @pytest.mark.parametrize(
        "field", [(5e-5, 0, 0), (5e-5, 1e-12, 0), (1e-3, 1e-3, 1e-3), (3e-2, 4e-2, 1e-9), (0, 0, 0)]
    )
    def test_is_never_singular(self, field):
        """The error of a turn along the field is nil, and the noise may be far below the others."""
        array = with_errors(random_array(5, 4), misalignment_rad=1e-2)
        array = replace(array, sensors=tuple(replace(s, noise_T=1e-15) for s in array.sensors))
        covariance = reading_covariance(array, array.readings_of(np.tile(field, (4, 1))))
        w = whitening(array, covariance_T2=covariance)
        assert np.isfinite(w.root).all()
        assert w.n_differences == 9


class TestCalibrationErrors:
    """What turns and gains do to the readings of sensors with any calibration, in any attitude."""

    @given(SEEDS)
    @settings(max_examples=15, deadline=None)
    def test_are_the_differences_of_readings(self, seed):
        """Central differences of readings of sensors whose axes are turned, and whose gains are off, by a millionth."""
        array = random_array(seed, 4, kinds=("vector", "scalar"))
        fields = np.random.default_rng(seed + 1).normal(0.0, 3e-5, (4, 3))
        found = calibration_errors(array, array.readings_of(fields))
        assert found.shape == (4, 3, 6)
        step = 1e-6
        for i, sensor in enumerate(array.sensors):
            channels = array.channel_sensor == i
            for column in range(6) if sensor.kind == "vector" else [3]:
                readings = []
                for sign in (1.0, -1.0):
                    error = np.zeros(6)
                    error[column] = sign * step
                    matrix = np.diag(1.0 + error[3 : 3 + sensor.n_channels])
                    if sensor.kind == "vector":
                        matrix = matrix @ Rotation.from_rotvec(error[:3]).as_matrix()
                    scale = np.array(sensor.calibration.scale) @ matrix
                    calibration = Calibration.of(sensor.kind, scale, sensor.calibration.offset_T)
                    sensors = list(array.sensors)
                    sensors[i] = replace(sensor, calibration=calibration)
                    readings.append(replace(array, sensors=tuple(sensors)).readings_of(fields)[channels])
                expected = (readings[0] - readings[1]) / (2.0 * step)
                assert_allclose(found[i, : sensor.n_channels, column], expected, rtol=1e-7, atol=1e-13)

    @given(SEEDS)
    @settings(max_examples=15, deadline=None)
    def test_with_their_variances_are_the_covariance_of_readings(self, seed):
        array = random_array(seed, 4, kinds=("vector", "scalar"), uncertain=True)
        readings = array.readings_of(np.random.default_rng(seed + 1).normal(0.0, 3e-5, (4, 3)))
        blocks = []
        for sensor, derivative in zip(array.sensors, calibration_errors(array, readings), strict=True):
            used = derivative[: sensor.n_channels]
            variance = np.repeat([sensor.misalignment_rad, sensor.gain_uncertainty], 3) ** 2
            if sensor.kind == "scalar":
                variance = variance * (np.arange(6) == 3)
            blocks.append(used * variance @ used.T + sensor.noise_T**2 * np.eye(sensor.n_channels))
        assert_allclose(reading_covariance(array, readings), block_diag(*blocks), rtol=1e-9, atol=1e-28)


class TestCovarianceOfIncompleteReadings:
    """The field along a missing axis is taken from what else is known."""

    field = np.array([1e-5, -2e-5, 4e-5])

    @pytest.fixture
    def array(self):
        return with_errors(random_array(6, 4, equal=True), misalignment_rad=1e-3, gain_uncertainty=2e-3)

    def test_the_other_sensors(self, array):
        readings = array.readings_of(np.tile(self.field, (4, 1)))
        whole = reading_covariance(array, readings)
        readings[[4, 7]] = np.nan
        assert_allclose(reading_covariance(array, readings), whole, rtol=1e-9, atol=1e-26)

    def test_the_known_ambient_field_before_them(self, array):
        readings = array.readings_of(np.tile(self.field, (4, 1)))
        whole = reading_covariance(array, readings)
        other = array.readings_of(np.array([self.field, self.field, 2 * self.field, 2 * self.field]))
        other[[4, 6, 7, 8]] = np.nan
        known = replace(array, ambient_T=self.field)
        assert_allclose(reading_covariance(known, other)[:9, :9], whole[:9, :9], rtol=1e-9, atol=1e-26)

    def test_nothing(self):
        array = with_errors(tetrahedron(1.0), misalignment_rad=1e-3)
        readings = np.full(12, np.nan)
        readings[[0, 3, 6, 9]] = 5e-5
        expected = np.diag(np.tile([0.0, 5e-8**2, 5e-8**2], 4)) + 1e-18 * np.eye(12)
        assert_allclose(reading_covariance(array, readings), expected, rtol=1e-12, atol=1e-30)


class TestReadingErrors:
    def test_their_covariance(self):
        array = replace(random_array(9, 7, kinds=("vector", "scalar"), uncertain=True), noise_fraction=0.001)
        rng = np.random.default_rng(9)
        readings = array.readings_of(5e-5 * rng.normal(size=(7, 3)))
        errors = reading_errors(array, readings, rng.normal(size=(100_000, array.n_channels)))
        assert_is_covariance_of(errors, reading_covariance(array, readings))

    def test_of_constant_noise(self):
        array = random_array(10, 5, kinds=("vector", "scalar"))
        normal = np.random.default_rng(10).normal(size=(3, array.n_channels))
        assert_array_equal(reading_errors(array, np.zeros(array.n_channels), normal), array.channel_noise_T * normal)
