"""Random processes of a simulation: their spectra and variances.

Statistical tests have fixed seeds, not chosen, and state the probability with which a right program fails them.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import integrate, signal, stats

from sims.noise import coloured_noise, flicker_sigma, low_passed, random_walk, stream, white_sigma

FloatArray = NDArray[np.float64]
RATE_HZ = 50.0
FALSE_ALARM = 1e-4


def band_power(values: FloatArray, expected: FloatArray, low: int, high: int) -> tuple[float, float, float]:
    """Measured over expected power from bin low to high, and the interval that holds it but for FALSE_ALARM.

    Segments of 1024 samples, Hann window, no overlap: bins that are four apart are independent, and each is expected
    power · χ²(2)/2.
    """
    _, density = signal.welch(
        values, RATE_HZ, window="hann", nperseg=1024, noverlap=0, detrend=False, axis=0, scaling="density"
    )
    bins = np.arange(low, high, 4)
    ratio = (density[bins] / expected[bins, None]).mean()
    dof = 2 * len(bins) * (len(values) // 1024) * values.shape[1]
    bounds = stats.chi2.ppf([FALSE_ALARM / 2, 1 - FALSE_ALARM / 2], dof) / dof
    return float(ratio), float(bounds[0]), float(bounds[1])


class TestSpectrum:
    FREQUENCY = np.fft.rfftfreq(1024, 1 / RATE_HZ)

    @pytest.mark.parametrize(("low", "high"), [(16, 48), (48, 128), (128, 256), (256, 500)])
    @pytest.mark.parametrize(("corner_Hz", "bandwidth_Hz"), [(0.0, math.inf), (2.0, math.inf), (0.0, 5.0), (1.0, 8.0)])
    def test_the_density_is_the_stated_one(self, low: int, high: int, corner_Hz: float, bandwidth_Hz: float) -> None:
        density = 3e-12
        noise = coloured_noise(65_536, 3, RATE_HZ, density, corner_Hz, bandwidth_Hz, np.random.default_rng(1))
        with np.errstate(divide="ignore", invalid="ignore"):
            expected = density**2 * (1 + corner_Hz / self.FREQUENCY) / (1 + (self.FREQUENCY / bandwidth_Hz) ** 2)
        ratio, lowest, highest = band_power(noise, expected, low, high)
        assert lowest < ratio < highest

    def test_another_density_is_noticed(self) -> None:
        # The interval is narrow enough to tell a density that is 5 % off.
        noise = coloured_noise(65_536, 3, RATE_HZ, 1.05, 0.0, math.inf, np.random.default_rng(1))
        ratio, _, highest = band_power(noise, np.ones(513), 16, 500)
        assert ratio > highest

    def test_at_the_corner_both_parts_are_equal(self) -> None:
        corner = float(self.FREQUENCY[64])
        noise = coloured_noise(262_144, 4, RATE_HZ, 1.0, corner, math.inf, np.random.default_rng(2))
        ratio, lowest, highest = band_power(noise, np.full(513, 2.0), 56, 73)
        # Within an eighth of the corner the density is 2 to 0.3 % on average.
        assert 0.997 * lowest < ratio < 1.003 * highest

    def test_channels_are_independent(self) -> None:
        noise = coloured_noise(20_000, 2, RATE_HZ, 1.0, 0.0, math.inf, np.random.default_rng(3))
        correlation = np.corrcoef(noise.T)[0, 1]
        assert abs(correlation) < stats.norm.ppf(1 - FALSE_ALARM / 2) / math.sqrt(20_000)

    @pytest.mark.parametrize("bandwidth_Hz", [1.0, 25.0, 1000.0, math.inf])
    def test_standard_deviation_is_the_integral_of_the_density(self, bandwidth_Hz: float) -> None:
        variance, _ = integrate.quad(lambda f: 4.0 / (1 + (f / bandwidth_Hz) ** 2), 0, RATE_HZ / 2)
        assert white_sigma(RATE_HZ, 2.0, bandwidth_Hz) == pytest.approx(math.sqrt(variance), rel=1e-9)

    @pytest.mark.parametrize("bandwidth_Hz", [1.0, 25.0, 1000.0, math.inf])
    def test_so_is_that_of_the_fast_part_of_flicker_noise(self, bandwidth_Hz: float) -> None:
        variance, _ = integrate.quad(lambda f: 4.0 * 0.5 / f / (1 + (f / bandwidth_Hz) ** 2), 3.0, RATE_HZ / 2)
        assert flicker_sigma(RATE_HZ, 2.0, 0.5, bandwidth_Hz, 3.0) == pytest.approx(math.sqrt(variance), rel=1e-9)
        assert flicker_sigma(RATE_HZ, 2.0, 0.5, bandwidth_Hz, RATE_HZ / 2) == 0.0

    def test_the_record_has_that_standard_deviation(self) -> None:
        noise = coloured_noise(50_000, 1, RATE_HZ, 2.0, 0.0, math.inf, np.random.default_rng(4))
        sigma = white_sigma(RATE_HZ, 2.0, math.inf)
        bounds = stats.chi2.ppf([FALSE_ALARM / 2, 1 - FALSE_ALARM / 2], 50_000)
        assert bounds[0] < (noise**2).sum() / sigma**2 < bounds[1]

    def test_its_end_does_not_know_its_beginning(self) -> None:
        # A periodic record would end one step from where it began: jump and step would have the same deviation.
        many = coloured_noise(256, 2000, RATE_HZ, 1.0, 500.0, math.inf, np.random.default_rng(5))
        step, jump = np.std(many[1] - many[0]), np.std(many[-1] - many[0])
        assert jump > 1.5 * step


class TestDrift:
    def test_variance_grows_with_time(self) -> None:
        walk = random_walk(901, 4000, 0.25, 5.0, np.random.default_rng(6))
        assert not walk[0].any()
        for seconds in (36, 900, 3600):
            bounds = stats.chi2.ppf([FALSE_ALARM / 2, 1 - FALSE_ALARM / 2], 4000)
            assert bounds[0] < (walk[seconds // 4] ** 2).sum() / (25.0 * seconds / 3600) < bounds[1]

    def test_it_does_not_depend_on_the_rate(self) -> None:
        walk = random_walk(1801, 4000, 20.0, 5.0, np.random.default_rng(7))
        bounds = stats.chi2.ppf([FALSE_ALARM / 2, 1 - FALSE_ALARM / 2], 4000)
        assert bounds[0] < (walk[-1] ** 2).sum() / (25.0 * 90 / 3600) < bounds[1]


class TestLowPass:
    @pytest.mark.parametrize("bandwidth_Hz", [0.3, 4.0, 60.0])
    def test_it_is_that_of_scipy(self, bandwidth_Hz: float) -> None:
        time = np.arange(400) / RATE_HZ
        values = np.random.default_rng(8).normal(size=(400, 2)) + 30.0
        omega = 2 * math.pi * bandwidth_Hz
        for channel in range(2):
            start = values[0, channel] / omega  # the state of the filter that has always seen the first value
            _, expected, _ = signal.lsim(([omega], [1.0, omega]), values[:, channel], time, X0=[start])
            found = low_passed(values, RATE_HZ, bandwidth_Hz)[:, channel]
            np.testing.assert_allclose(found, expected, rtol=1e-9)

    def test_without_a_bandwidth_nothing_changes(self) -> None:
        values = np.random.default_rng(9).normal(size=(10, 2))
        np.testing.assert_array_equal(low_passed(values, RATE_HZ, math.inf), values)


class TestStreams:
    def test_every_name_has_its_own(self) -> None:
        names = [("noise", "s1"), ("noise", "s2"), ("drift", "s1"), ("noise", ""), ("pulsation", "1")]
        first = {float(stream(7, *name).random()) for name in names} | {float(stream(8, "noise", "s1").random())}
        assert len(first) == len(names) + 1

    def test_the_same_name_gives_the_same_numbers(self) -> None:
        np.testing.assert_array_equal(stream(7, "noise", "s1").random(5), stream(7, "noise", "s1").random(5))
