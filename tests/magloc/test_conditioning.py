"""Conditioning: filters against scipy's own frequency responses, exact lines and means, and refusals."""

from __future__ import annotations

import math
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import butter, detrend, freqz_sos

from arrays.io.errors import InputError
from magloc.readings import Readings

FloatArray = NDArray[np.float64]
RATE_HZ = 200.0
without_hum = Readings.without_hum


def detrended(readings: Readings) -> Readings:
    return taken_out(readings.detrended())


def high_passed(readings: Readings, hz: float) -> Readings:
    return taken_out(readings.high_passed(hz))


def taken_out(readings: Readings) -> Readings:
    """As a filter leaves them."""
    return replace(readings, values_T=readings.background.taken_out(readings.time_s, readings.values_T))


def readings_of(time_s: FloatArray, values_T: FloatArray) -> Readings:
    return Readings(values_T, time_s=time_s)


def sinusoid(frequency_Hz: float, n: int = 8000) -> Readings:
    """Two channels, a sine and a cosine of 1 µT."""
    t = np.arange(n) / RATE_HZ
    angle = 2.0 * math.pi * frequency_Hz * t
    return readings_of(t, 1e-6 * np.stack([np.sin(angle), np.cos(angle)], axis=1))


def gain(before: Readings, after: Readings) -> FloatArray:
    """Ratio of the amplitudes, in phase, away from the ends."""
    middle = slice(len(before) // 4, -len(before) // 4)
    x, y = before.values_T[middle], after.values_T[middle]
    ratio: FloatArray = np.sum(x * y, axis=0) / np.sum(x * x, axis=0)
    return ratio


class TestMainsHum:
    @pytest.mark.parametrize("harmonic", [1, 2, 3])
    @pytest.mark.parametrize("mains_Hz", [50.0 / 3.0, 30.0])
    def test_vanishes_with_its_harmonics(self, mains_Hz: float, harmonic: int) -> None:
        hum = sinusoid(harmonic * mains_Hz)
        middle = slice(2000, -2000)
        assert np.abs(without_hum(hum, mains_Hz).values_T[middle]).max() < 1e-3 * 1e-6

    def test_passes_what_is_slow(self) -> None:
        slow = sinusoid(0.5)
        filtered = without_hum(slow, 50.0)
        middle = slice(1000, -1000)
        np.testing.assert_allclose(filtered.values_T[middle], slow.values_T[middle], atol=1e-4 * 1e-6)

    def test_delays_nothing_and_keeps_the_sum_of_both(self) -> None:
        slow, hum = sinusoid(0.5), sinusoid(50.0)
        both = readings_of(slow.time_s, slow.values_T + 0.3 * hum.values_T)
        middle = slice(2000, -2000)
        np.testing.assert_allclose(without_hum(both, 50.0).values_T[middle], slow.values_T[middle], atol=1e-3 * 1e-6)

    def test_keeps_a_constant(self) -> None:
        constant = readings_of(np.arange(500) / RATE_HZ, np.full((500, 2), 5e-5))
        np.testing.assert_allclose(without_hum(constant, 50.0).values_T, 5e-5, rtol=1e-9)


class TestHighPass:
    @pytest.mark.parametrize("frequency_Hz", [0.3, 1.0, 2.0, 8.0, 40.0])
    def test_gain_is_butterworths_twice(self, frequency_Hz: float) -> None:
        """Forwards and backwards: the squared modulus of scipy's frequency response, and no phase."""
        sections = butter(2, 1.0, "highpass", fs=RATE_HZ, output="sos")
        _, response = freqz_sos(sections, worN=[frequency_Hz], fs=RATE_HZ)
        before = sinusoid(frequency_Hz)
        np.testing.assert_allclose(gain(before, high_passed(before, 1.0)), abs(response[0]) ** 2, atol=2e-3)

    def test_half_the_amplitude_at_the_corner(self) -> None:
        before = sinusoid(1.0)
        np.testing.assert_allclose(gain(before, high_passed(before, 1.0)), 0.5, atol=2e-3)

    def test_takes_out_a_constant(self) -> None:
        constant = readings_of(np.arange(500) / RATE_HZ, np.full((500, 2), 5e-5))
        np.testing.assert_allclose(high_passed(constant, 1.0).values_T, 0.0, atol=1e-14)


class TestFiltersRefuse:
    """One sentence each, of what was found and what was expected."""

    def test_unequal_intervals(self) -> None:
        before = sinusoid(1.0, 100)
        time_s = before.time_s.copy()
        time_s[60:] += 0.01
        uneven = readings_of(time_s, before.values_T)
        for condition in (high_passed, without_hum):
            with pytest.raises(InputError, match="found rows at unequal intervals, expected equal ones"):
                condition(uneven, 20.0)

    @pytest.mark.parametrize("relative", [0.0, 5e-4])
    def test_intervals_are_equal_to_a_thousandth(self, relative: float) -> None:
        before = sinusoid(1.0, 100)
        interval = before.time_s[1] - before.time_s[0]
        for late, refused in ((relative, False), (relative + 2e-3, True)):
            time_s = before.time_s.copy()
            time_s[60:] += late * interval
            with pytest.raises(InputError, match="unequal intervals") if refused else nullcontext():
                high_passed(readings_of(time_s, before.values_T), 20.0)

    def test_missing_readings(self) -> None:
        before = sinusoid(1.0, 100)
        before.values_T[3, 1] = np.nan
        with pytest.raises(InputError, match="found missing readings, expected none"):
            high_passed(before, 1.0)

    @pytest.mark.parametrize("frequency_Hz", [100.0, 150.0, 0.0, -1.0, math.nan])
    def test_a_frequency_that_the_rows_do_not_show(self, frequency_Hz: float) -> None:
        before = sinusoid(1.0, 100)
        for condition in (high_passed, without_hum):
            with pytest.raises(InputError, match="found rows at 200 Hz, expected more than twice"):
                condition(before, frequency_Hz)

    def test_a_record_that_is_too_short(self) -> None:
        with pytest.raises(InputError, match="found 9 rows, expected more than 9"):
            high_passed(sinusoid(1.0, 9), 1.0)
        assert len(high_passed(sinusoid(1.0, 10), 1.0)) == 10

    def test_one_row(self) -> None:
        with pytest.raises(InputError, match="expected equal ones"):
            high_passed(sinusoid(1.0, 1), 1.0)


class TestDetrending:
    def test_takes_out_a_line_and_keeps_its_mean(self) -> None:
        """Also at unequal times."""
        t = np.sort(np.random.default_rng(0).uniform(1e9, 1e9 + 100.0, 50))
        lines = np.array([2e-5, -4e-5]) + np.outer(t - 1e9, [1e-8, -3e-8])
        after = detrended(readings_of(t, lines)).values_T
        np.testing.assert_allclose(after, np.tile(lines.mean(axis=0), (50, 1)), rtol=1e-9)

    def test_is_scipys_but_for_the_mean(self) -> None:
        values = np.random.default_rng(1).normal(size=(100, 3))
        after = detrended(readings_of(np.arange(100.0), values)).values_T
        np.testing.assert_allclose(after - after.mean(axis=0), detrend(values, axis=0), atol=1e-12)
        np.testing.assert_allclose(after.mean(axis=0), values.mean(axis=0), atol=1e-12)

    def test_leaves_missing_readings_missing(self) -> None:
        t = np.arange(10.0)
        values = np.outer(t, [1e-8, 2e-8])
        values[[2, 7], [0, 0]] = np.nan
        before = readings_of(t, values)
        after = detrended(before).values_T
        assert np.isnan(after[[2, 7], 0]).all()
        np.testing.assert_allclose(np.delete(after[:, 0], [2, 7]), np.nanmean(values[:, 0]), rtol=1e-9)
        np.testing.assert_array_equal(before.values_T, values)

    def test_refuses_a_channel_of_one_reading(self) -> None:
        values = np.full((5, 2), np.nan)
        values[:, 0] = 1e-9
        values[3, 1] = 1e-9
        with pytest.raises(InputError, match="fewer than two readings"):
            detrended(readings_of(np.arange(5.0), values))
