"""Fixes by moduli in an ambient field that is not exactly known, in simulation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import magloc
from arrays.array import SensorArray
from arrays.sensor import Sensor
from magloc.bounds.crlb import cramer_rao_bounds
from magloc.bounds.over_moments import sigma_table

EARTH_T = np.array([2e-5, 1e-6, 4.5e-5])
PLACES = np.random.default_rng(4).uniform(-1.5, 1.5, (12, 3))


def cloud(noise_T: float, sigma_T: float) -> SensorArray:
    """Twelve scalar sensors."""
    sensors = tuple(Sensor(f"s{i}", "scalar", tuple(place), noise_T) for i, place in enumerate(PLACES))
    return SensorArray(sensors, ambient_T=tuple(EARTH_T), ambient_uncertainty_T=sigma_T)


def simulated(array: SensorArray, n: int, seed: int):
    """Sources of 300 A·m² at 2.5 to 5 m, and readings in the field that there is."""
    rng = np.random.default_rng(seed)
    position, moment = rng.normal(size=(2, n, 3))
    position *= (rng.uniform(2.5, 5.0, n) / np.linalg.norm(position, axis=1))[:, None]
    moment *= (300.0 / np.linalg.norm(moment, axis=1))[:, None]
    ambient = EARTH_T + array.ambient_uncertainty_T * rng.normal(size=(n, 3))
    fields = np.stack([magloc.dipole.field(array.positions, *source) for source in zip(position, moment, strict=True)])
    exact = np.linalg.norm(fields + ambient[:, None], axis=-1)
    return position, moment, exact + rng.normal(size=exact.shape) * array.channel_noise_T


def nees(fixes, position, moment):
    off = np.concatenate([fixes.position_m - position, fixes.moment_Am2 - moment], axis=1)
    return np.einsum("ni,nij,nj->n", off, np.linalg.inv(fixes.covariance), off) / 6.0


class TestStated:
    @pytest.mark.parametrize("n", [12, pytest.param(100, marks=pytest.mark.slow)])
    @pytest.mark.parametrize("noise_T", [1e-11, 1e-10])
    def test_errors_are_those_of_the_covariance(self, noise_T, n):
        """50 nT; the mean lies within 5 σ of that of χ²: 1 in 10⁶ fails by chance."""
        array = cloud(noise_T, 50e-9)
        position, moment, readings = simulated(array, n, 2)
        fixes = magloc.locate(array, readings)
        assert abs(nees(fixes, position, moment).mean() - 1.0) < 5.0 * np.sqrt(2.0 / (6.0 * n))
        assert not any(fixes.dropped_sensors)
        assert not fixes.misfit.any()

    @pytest.mark.slow
    @pytest.mark.parametrize("noise_T", [1e-11, 1e-10])
    def test_far_off_the_set_holds_and_no_covariance_is_called_gaussian(self, noise_T):
        """500 nT: of 100 sets that hold with 95 % less than 84 do so in one of 10⁵ runs."""
        array = cloud(noise_T, 500e-9)
        position, _, readings = simulated(array, 100, 3)
        fixes = magloc.locate(array, readings)
        assert not any(fix.best.source.gaussian for fix in fixes)
        distance = np.linalg.norm(position - array.centroid, axis=1)
        held = [
            any(low <= r <= (np.inf if high is None else high) for low, high in intervals)
            for r, intervals in zip(distance, fixes.range_interval_m, strict=True)
        ]
        assert sum(held) >= 84

    def test_half_or_double_is_not_silent(self):
        """Twice the σ is safe; half of it is at most four times as bad as claimed, on average."""
        array = cloud(1e-10, 50e-9)
        position, moment, readings = simulated(array, 12, 4)
        for share, largest in ((2.0, 1.6), (0.5, 4.0 * 1.6)):
            stated = replace(array, ambient_uncertainty_T=share * 50e-9)
            assert nees(magloc.locate(stated, readings), position, moment).mean() < largest


class TestNewInEveryRow:
    def test_counts_in_a_row_as_what_is_constant(self):
        array = cloud(1e-10, 50e-9)
        _, _, readings = simulated(array, 3, 5)
        parted = replace(array, ambient_uncertainty_T=30e-9, ambient_uncertainty_white_T=40e-9)
        whole, parts = magloc.locate(array, readings), magloc.locate(parted, readings)
        np.testing.assert_allclose(parts.covariance, whole.covariance, rtol=1e-9)
        source = ([3.0, 1.0, 2.0], [0.0, 0.0, 300.0])
        np.testing.assert_allclose(
            cramer_rao_bounds(parted, *source).covariance, cramer_rao_bounds(array, *source).covariance, rtol=1e-9
        )


class TestBounds:
    def test_the_statement_of_the_array_counts(self):
        array, source = cloud(1e-10, 50e-9), ([3.0, 1.0, 2.0], [0.0, 0.0, 300.0])
        exact = replace(array, ambient_uncertainty_T=0.0)
        of_array = cramer_rao_bounds(array, *source)
        np.testing.assert_array_equal(
            of_array.covariance, cramer_rao_bounds(exact, *source, ambient_uncertainty_T=50e-9).covariance
        )
        assert of_array.sigma_range_m > cramer_rao_bounds(exact, *source).sigma_range_m
        table = sigma_table(array, np.array([source[0]]), np.array([source[1]]))
        assert table.range_m[0, 0] == pytest.approx(float(of_array.sigma_range_m), rel=1e-6)
