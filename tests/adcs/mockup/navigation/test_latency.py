"""The camera's latency, from the headings of gyro and camera: against simulated latencies."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from adcs.mockup.navigation.delayed_ekf import DelayedFilter
from adcs.mockup.navigation.fixes import FixRecord, fuse
from adcs.mockup.navigation.latency import camera_latency
from adcs.mockup.navigation.strapdown import ImuRecord, PlanarState, strapdown

START = PlanarState(np.zeros(2), np.zeros(2), 2.5)
GYRO_RAD_S, HEADING_RAD, GYRO_ZERO_RAD_S = math.radians(0.1), math.radians(0.05), math.radians(0.3)
FALSE_ALARM = 1e-4


def world(rate_of, latency_s, rng, duration_s=60.0, noise=1.0, n_false=0):
    """Samples and fixes of a satellite that turns at ``rate_of(t)``."""
    t = 0.01 * np.arange(1.0, 100.0 * duration_s + 1.0)
    rate = rate_of(t - 0.005)
    track = strapdown(ImuRecord(0.0, t, np.zeros((t.size, 2)), rate), START)
    imu = ImuRecord(
        0.0, t, np.zeros((t.size, 2)), rate + GYRO_ZERO_RAD_S + noise * GYRO_RAD_S * rng.standard_normal(t.size)
    )
    exposure_s = np.arange(rng.uniform(0.0, 0.6), t[-1], 0.6)
    exposure_s = exposure_s[rng.random(exposure_s.size) > 0.12]
    heading = np.interp(exposure_s, t, track.heading_rad) + noise * HEADING_RAD * rng.standard_normal(exposure_s.size)
    false = rng.choice(exposure_s.size, n_false, replace=False)
    heading[false] = rng.uniform(-math.pi, math.pi, n_false)
    stamp_s = exposure_s + latency_s
    position = np.zeros((stamp_s.size, 2))
    return imu, FixRecord(stamp_s, np.maximum(stamp_s, exposure_s + 1.0), position, np.angle(np.exp(1j * heading)))


def weaving(t):
    return math.radians(30.0) * np.sin(0.5 * t)


class TestLatency:
    @pytest.mark.parametrize("latency_s", [0.0, 0.007, 0.1, 0.6, 1.0])
    def test_without_noise_it_is_exact(self, latency_s: float) -> None:
        imu, fixes = world(weaving, latency_s, np.random.default_rng(1), noise=0.0)
        found = camera_latency(imu, fixes, lowest_s=-0.2)
        assert found.observable
        # The rate changes within a sample, by which it is interpolated.
        assert found.latency_s == pytest.approx(latency_s, abs=1e-5)
        assert found.gyro_zero_rad_s == pytest.approx(GYRO_ZERO_RAD_S, abs=1e-6)

    def test_errors_are_as_large_as_stated(self) -> None:
        # χ² of one number for each of 100 seeds: false alarm 1e-4.
        total = 0.0
        for seed in range(100):
            rng = np.random.default_rng([2, seed])
            latency_s = rng.uniform(0.0, 1.0)
            imu, fixes = world(weaving, latency_s, rng)
            found = camera_latency(imu, fixes, lowest_s=-0.2)
            assert found.sigma_s < 0.001
            total += ((found.latency_s - latency_s) / found.sigma_s) ** 2
        low, high = stats.chi2.ppf([FALSE_ALARM / 2, 1 - FALSE_ALARM / 2], 100)
        assert low < total < high

    @pytest.mark.parametrize("seed", range(5))
    def test_false_fixes_do_not_matter(self, seed: int) -> None:
        imu, fixes = world(weaving, 0.45, np.random.default_rng([3, seed]), n_false=6)
        found = camera_latency(imu, fixes)
        assert abs(found.latency_s - 0.45) < 5.0 * found.sigma_s
        assert found.used >= len(fixes) - 2 * 6 - 6  # two differences each, and those that are not within the samples

    def test_two_firings_are_enough(self) -> None:
        def rate_of(t):
            return np.radians(np.interp(t, [2.0, 2.6, 4.5, 5.2], [0.0, 100.0, 100.0, -10.0]))

        imu, fixes = world(rate_of, 0.33, np.random.default_rng(4), duration_s=15.0)
        found = camera_latency(imu, fixes)
        assert abs(found.latency_s - 0.33) < 5.0 * found.sigma_s
        assert found.sigma_s < 0.002

    def test_a_filter_is_better_off_with_it(self) -> None:
        imu, fixes = world(weaving, 0.4, np.random.default_rng(5))
        late, right = DelayedFilter(START, 0.0), DelayedFilter(START, 0.0)
        fuse(late, imu, fixes)
        fuse(right, imu, fixes.earlier(camera_latency(imu, fixes).latency_s))
        assert np.mean(late.nis) > 100.0
        assert np.mean(right.nis) < 3.0


class TestNotObservable:
    @pytest.mark.parametrize("rate_deg_s", [0.0, 5.0, 40.0])
    def test_at_a_constant_rate(self, rate_deg_s: float) -> None:
        # Each of 60 passes for a rate that changes once in 1e6.
        for seed in range(20):
            rng = np.random.default_rng([6, seed])
            imu, fixes = world(lambda t: np.full(t.size, math.radians(rate_deg_s)), 0.5, rng)
            found = camera_latency(imu, fixes)
            assert not found.observable
            assert math.isnan(found.latency_s)
            assert math.isinf(found.sigma_s)
            assert found.reason == "the rate changes by no more than its noise"

    def test_at_a_constant_rate_without_noise(self) -> None:
        imu, fixes = world(lambda t: np.full(t.size, 0.5), 0.5, np.random.default_rng(7), noise=0.0)
        assert not camera_latency(imu, fixes).observable

    def test_while_it_turns_a_little(self) -> None:
        # Its rate changes visibly, but not by enough to tell half a second.
        found = camera_latency(*world(lambda t: math.radians(0.02) * np.sin(0.5 * t), 0.5, np.random.default_rng(8)))
        assert not found.observable

    def test_with_too_few_fixes(self) -> None:
        imu, fixes = world(weaving, 0.5, np.random.default_rng(9))
        found = camera_latency(imu, fixes.rows(slice(3)))
        assert not found.observable
        assert "4 are needed" in found.reason


class TestRefusals:
    def test_settings(self) -> None:
        imu, fixes = world(weaving, 0.5, np.random.default_rng(10))
        with pytest.raises(ValueError, match="lowest_s must be below highest_s"):
            camera_latency(imu, fixes, lowest_s=2.0)
        with pytest.raises(ValueError, match="must be positive; instead received 0"):
            camera_latency(imu, fixes, gyro_sigma_rad_s=0.0)
        with pytest.raises(ValueError, match="must have all rates"):
            camera_latency(imu.subtract_zeros(0.0, math.nan), fixes)
