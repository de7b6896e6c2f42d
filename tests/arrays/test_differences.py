"""Differences between sensors, their covariance, and the decorrelated form of both.

| what | who checks it |
|---|---|
| the paper's T, eigenvalues | the printed matrices (13)-(15) |
| decorrelated noise | Monte Carlo of the differences themselves |
| χ² of Differences and of Whitening | generalised least squares with the full covariance, in extended form |
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from arrays.differences import (
    contrasts,
    decorrelated_differences,
    difference_covariance,
    eigen_decorrelation,
    helmert_decorrelation,
    proportional_noise,
    whitening,
)
from arrays.geometries import tetrahedron
from arrays.sensor import Calibration, Sensor, SensorArray

SEEDS = st.integers(0, 2**32 - 1)


def random_array(seed, n=5, *, kinds=("vector",), equal=False, common_field_T=None):
    """Sensors anywhere, turned anyhow, of unequal noise and gain."""
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
            )
        )
    return SensorArray(tuple(sensors), common_field_T=common_field_T)


def chi2_of_differences(differences, channels):
    return float(np.sum((differences.transform @ channels) ** 2 / differences.variance))


def chi2_by_generalised_least_squares(array, available, channels):
    """χ² with the common field of each kind as an unknown (or with its prior), by the full normal equations."""
    total = 0.0
    for is_scalar in (False, True):
        group = available & (array.channel_is_scalar == is_scalar)
        if not group.any():
            continue
        common = array.channel_gain[group, :1] if is_scalar else array.channel_gain[group]
        # nT keep the numbers of order one.
        y, noise = 1e9 * channels[group], 1e9 * array.channel_noise_T[group]
        if array.common_field_T is None:
            W = np.diag(1 / noise)
            residual = W @ y - W @ common @ np.linalg.lstsq(W @ common, W @ y, rcond=None)[0]
            total += residual @ residual
        else:
            covariance = np.diag(noise**2) + (1e9 * array.common_field_T) ** 2 * common @ common.T
            total += y @ np.linalg.solve(covariance, y)
    return total


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

    def test_equation_13(self):
        assert_allclose(difference_covariance(np.full(4, self.sigma)), self.sigma**2 * self.R, rtol=1e-14)

    def test_equation_14(self):
        assert_allclose(helmert_decorrelation(3), self.T, atol=1e-15)

    def test_equation_15(self):
        T = helmert_decorrelation(3)
        assert_allclose(T @ self.R @ T.T, np.diag([4.0, 1.0, 1.0]), atol=1e-14)

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
        R = difference_covariance(1e-9 * np.random.default_rng(seed).uniform(0.1, 10, n))
        T, variance = eigen_decorrelation(R)
        assert_allclose(T @ T.T, np.eye(n - 1), atol=1e-12)
        assert_allclose(T @ R @ T.T, np.diag(variance), rtol=1e-10, atol=1e-12 * variance[0])
        assert (np.diff(variance) <= 0).all()

    @pytest.mark.parametrize("case", ["equal", "unequal", "mixed", "prior"])
    def test_noise_of_decorrelated_differences_by_monte_carlo(self, case):
        """10⁵ draws: correlations within 4 standard errors of zero, variances of the stated ones.

        With k differences the false-alarm rate is k(k+1)/2 · 6.3e-5: 0.6 % for 14.
        """
        array = {
            "equal": tetrahedron(1.5, noise_T=1e-9),
            "unequal": random_array(1),
            "mixed": random_array(2, 6, kinds=("vector", "scalar")),
            "prior": random_array(3, 4, common_field_T=1e-9),
        }[case]
        n = 100_000
        rng = np.random.default_rng(20)
        noise = rng.normal(size=(n, array.n_channels)) * array.channel_noise_T
        if array.common_field_T is not None:
            noise += (rng.normal(size=(n, 3)) * array.common_field_T) @ array.channel_gain.T
        d = decorrelated_differences(array)
        z = (noise @ d.transform.T) / np.sqrt(d.variance)
        correlation = np.corrcoef(z.T)
        k = d.n_differences
        assert np.abs(correlation[~np.eye(k, dtype=bool)]).max() < 4 / np.sqrt(n)
        assert_allclose(z.var(axis=0), 1.0, atol=4 * np.sqrt(2 / n))


class TestCommonFieldCancels:
    @given(SEEDS)
    @settings(max_examples=30, deadline=None)
    def test_uniform_field_leaves_no_difference(self, seed):
        array = random_array(seed, 5)
        field = np.random.default_rng(seed).normal(size=3)
        channels = array.channel_gain @ field
        scale = np.abs(channels).max()
        assert_allclose(decorrelated_differences(array).transform @ channels / scale, 0.0, atol=1e-12)
        assert_allclose(whitening(array).apply(channels) * array.channel_noise_T / scale, 0.0, atol=1e-12)


class TestLikelihoodDoesNotDependOnItsForm:
    """Base sensor, closed or numerical form, projection, and the marginalised common field: one χ²."""

    @given(SEEDS, st.integers(0, 4))
    @settings(max_examples=40, deadline=None)
    def test_base_sensor(self, seed, base):
        array = random_array(seed, 5, equal=bool(seed % 2))
        channels = 1e-9 * np.random.default_rng(seed).normal(size=15)
        last = chi2_of_differences(decorrelated_differences(array), channels)
        other = chi2_of_differences(decorrelated_differences(array, base=base), channels)
        assert other == pytest.approx(last, rel=1e-9)

    @given(SEEDS, st.sampled_from([("vector",), ("scalar",), ("vector", "scalar")]), st.booleans(), st.booleans())
    @settings(max_examples=60, deadline=None)
    def test_differences_whitening_and_generalised_least_squares(self, seed, kinds, missing, prior):
        array = random_array(seed, 6, kinds=kinds, common_field_T=3e-9 if prior else None)
        rng = np.random.default_rng(seed)
        channels = 1e-9 * rng.normal(size=array.n_channels)
        available = rng.random(array.n_channels) > 0.3 if missing else np.ones(array.n_channels, dtype=bool)
        d, w = decorrelated_differences(array, available), whitening(array, available)
        expected = chi2_by_generalised_least_squares(array, available, channels)
        assert chi2_of_differences(d, channels) == pytest.approx(expected, rel=1e-8, abs=1e-9)
        assert float(np.sum(w.apply(channels) ** 2)) == pytest.approx(expected, rel=1e-8, abs=1e-9)
        assert d.n_differences == w.n_differences

    def test_equal_noise_is_the_projector_free_of_the_mean(self):
        array = tetrahedron(1.5, noise_T=1e-9)
        y = np.random.default_rng(0).normal(size=(4, 3))
        centred = y - y.mean(axis=0)
        assert chi2_of_differences(decorrelated_differences(array), 1e-9 * y.ravel()) == pytest.approx(
            float(np.sum(centred**2)), rel=1e-12
        )

    def test_a_wide_prior_is_an_unknown_field_and_a_narrow_one_a_known_field(self):
        channels = 1e-9 * np.random.default_rng(0).normal(size=15)
        unknown = random_array(3, 5)
        wide = random_array(3, 5, common_field_T=1e-3)
        narrow = random_array(3, 5, common_field_T=1e-16)
        assert np.sum(whitening(wide).apply(channels) ** 2) == pytest.approx(
            np.sum(whitening(unknown).apply(channels) ** 2), rel=1e-6
        )
        assert np.sum(whitening(narrow).apply(channels) ** 2) == pytest.approx(
            np.sum((channels / narrow.channel_noise_T) ** 2), rel=1e-6
        )


class TestMissingReadings:
    def test_missing_channels_do_not_count(self):
        array = random_array(5)
        available = np.ones(15, dtype=bool)
        available[[2, 7]] = False
        d, w = decorrelated_differences(array, available), whitening(array, available)
        assert d.n_differences == 10
        assert not d.transform[:, ~available].any()
        assert not w.inverse_noise[~available].any()

    def test_nothing_left(self):
        array = random_array(5)
        assert decorrelated_differences(array, np.zeros(15, dtype=bool)).n_differences == 0
        assert whitening(array, np.zeros(15, dtype=bool)).n_differences == 0

    def test_wrong_shapes_are_named(self):
        with pytest.raises(ValueError, match=r"Input available must have shape \(12,\)"):
            decorrelated_differences(tetrahedron(1.0), np.ones(4, dtype=bool))
        with pytest.raises(ValueError, match=r"Input channel_noise_T must have shape \(12,\)"):
            whitening(tetrahedron(1.0), channel_noise_T=np.ones(4))


class TestProportionalNoise:
    def test_grows_with_the_field_above_the_mean(self):
        sensors = tetrahedron(1.0, noise_T=2e-9).sensors
        array = SensorArray(sensors, noise_fraction=0.03)
        fields = np.array([[4.0, 0, 0], [-4.0, 0, 0], [0, 0, 0], [0, 0, 0]]) * 1e-6
        noise = proportional_noise(array, fields.ravel())
        assert_allclose(noise.reshape(4, 3)[:2], np.hypot(2e-9, 0.03 * 4e-6), rtol=1e-12)
        assert_allclose(noise.reshape(4, 3)[2:], 2e-9, rtol=1e-9)

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
