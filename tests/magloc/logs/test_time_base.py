"""Interpolation to one time base against numpy, and the lag of a magnetometer of simulated flights."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from magloc.logs.time_base import magnetometer_lag, resample
from tests.robot_flights import Flight


def test_between_samples_it_is_numpys_interpolation() -> None:
    rng = np.random.default_rng(0)
    sample_s, wanted_s = np.arange(0.0, 5.0, 0.1), np.sort(rng.uniform(0.0, 4.9, 200))
    values = rng.normal(size=(50, 2))
    expected = np.column_stack([np.interp(wanted_s, sample_s, column) for column in values.T])
    np.testing.assert_array_equal(resample(wanted_s, sample_s, values), expected)


def test_gaps_and_ends_are_missing() -> None:
    sample_s = np.array([0.0, 0.1, 0.2, 0.3, 1.0, 1.1, 1.2])
    values = np.arange(7.0)[:, None]
    values[1] = np.nan
    found = resample(np.array([-0.1, 0.1, 0.25, 0.6, 1.05, 1.3]), sample_s, values)[:, 0]
    np.testing.assert_allclose(found, [np.nan, 1.0, 2.5, np.nan, 4.5, np.nan])


def test_a_slow_sensor_has_one_row_for_each_sample() -> None:
    rows_s, sample_s = np.arange(0.0, 2.0, 0.004), np.arange(0.0031, 1.9, 0.05)
    found = resample(rows_s, sample_s, 3.0 * sample_s[:, None], sparse=True)[:, 0]
    filled = np.isfinite(found)
    np.testing.assert_allclose(found[filled], 3.0 * rows_s[filled], rtol=1e-12)
    assert filled.sum() in (len(sample_s) - 1, len(sample_s))  # the first row may be before the first sample
    assert np.abs(rows_s[filled][:, None] - sample_s).min(axis=1).max() <= 0.002 + 1e-12


def lag_of(flight: Flight, bias_rad_s: object = (0.0, 0.0, 0.0)) -> tuple[float, float]:
    rate = flight.rate_rad_s(flight.time_s) + np.array(bias_rad_s)
    return magnetometer_lag(flight.time_s, rate, flight.field_s, flight.field_T(flight.field_s))


def test_the_lag_of_flights_is_found_within_its_deviation() -> None:
    """Twenty flights with offsets of 20 uT; the bounds of the NEES have a false-alarm rate of 1e-4."""
    flights = [Flight(seed, noise_T=100e-9, offset_T=(2e-5, -1e-5, 5e-6)) for seed in range(20)]
    found = np.array([lag_of(flight) for flight in flights])
    errors_s = found[:, 0] - 0.03
    low, high = stats.chi2.ppf([5e-5, 1.0 - 5e-5], len(found))
    assert low < np.sum((errors_s / found[:, 1]) ** 2) < high
    assert np.median(np.abs(errors_s)) < 1e-3


@pytest.mark.parametrize("lag_s", [-0.05, 0.0, 0.12])
def test_offset_and_bias_do_not_matter(lag_s: float) -> None:
    flight = Flight(3, lag_s=lag_s, noise_T=20e-9)
    plain = lag_of(flight)
    other = lag_of(replace(flight, offset_T=(5e-5, 2e-5, -3e-5)), (0.05, -0.02, 0.08))
    assert plain[0] == pytest.approx(lag_s, abs=5.0 * plain[1])
    assert other[0] == pytest.approx(plain[0], abs=0.5 * plain[1])


def test_a_sensor_that_does_not_turn_determines_no_lag() -> None:
    assert lag_of(Flight(4, swing_rad=0.0)) == (0.0, np.inf)
    assert lag_of(Flight(4, duration_s=0.6)) == (0.0, np.inf)
