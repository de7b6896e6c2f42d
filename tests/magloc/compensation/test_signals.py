"""Signals: a smooth function and its rate in closed form, across dropouts, not across gaps."""

from __future__ import annotations

import numpy as np
import pytest

from arrays.typing import FloatArray
from magloc.compensation.signals import Signal, band_passed, smooth_in_stretches, white_noise

TIME = np.arange(0.0, 60.0, 0.05)


def wave(time_s: FloatArray) -> FloatArray:
    return np.stack([np.sin(1.5 * time_s), np.cos(0.7 * time_s)], axis=1)


def wave_rate(time_s: FloatArray) -> FloatArray:
    return np.stack([1.5 * np.cos(1.5 * time_s), -0.7 * np.sin(0.7 * time_s)], axis=1)


def test_values_and_rates_between_the_samples() -> None:
    signal = Signal.of(TIME, wave(TIME))
    at = np.linspace(5.0, 55.0, 333)  # the ends are those of a filter
    np.testing.assert_allclose(signal.at(at), wave(at), atol=1e-4)
    np.testing.assert_allclose(signal.at(at, rate=True), wave_rate(at), atol=1e-3)


def test_noise_above_the_band_is_filtered() -> None:
    noise = np.random.default_rng(2).standard_normal((len(TIME), 1))
    signal = Signal.of(TIME, noise)
    share = float(np.mean(signal.samples()[1] ** 2))
    # 300 independent samples: 5 deviations of their variance are 0.41 of it.
    assert share == pytest.approx(signal.noise_share(), rel=0.41)


def test_dropouts_are_bridged_and_their_samples_left_out() -> None:
    values = wave(TIME)
    values[400:405] = np.nan
    signal = Signal.of(TIME, values)
    assert len(signal.stretches) == 1
    np.testing.assert_allclose(signal.at(TIME[400:405]), wave(TIME[400:405]), atol=2e-3)
    times = signal.samples()[0]
    assert not ((times > TIME[396]) & (times < TIME[408])).any()


def test_gaps_are_not_bridged() -> None:
    values = wave(TIME)
    values[400:500] = np.nan
    signal = Signal.of(TIME, values)
    assert len(signal.stretches) == 2
    assert np.isnan(signal.at(TIME[410:490])).all()
    assert np.isfinite(signal.at(TIME[:400])).all()


@pytest.mark.parametrize(("more", "number"), [(20, 3), (10, 2)])
def test_short_stretches_are_left_out(more: int, number: int) -> None:
    """Between two gaps, by their rows beyond the reach of the filter."""
    values = wave(TIME)
    n = more + 4 * Signal.of(TIME, values).step
    values[400:500] = values[500 + n : 600 + n] = np.nan
    assert len(Signal.of(TIME, values).stretches) == number


def test_white_noise_of_a_smooth_signal() -> None:
    rng = np.random.default_rng(3)
    values = 1e4 * wave(TIME) + 0.3 * rng.standard_normal((len(TIME), 2))
    # The median of 1,200 correlated values: within 15 %.
    np.testing.assert_allclose(white_noise(TIME, values), 0.3, rtol=0.15)


def test_a_gaussian_filter_has_its_transfer_function() -> None:
    omega, width = 0.9, 1.3
    inside = slice(200, -200)
    expected = np.exp(-0.5 * (omega * width) ** 2) * np.sin(omega * TIME)
    np.testing.assert_allclose(
        smooth_in_stretches(TIME, np.sin(omega * TIME), width)[inside], expected[inside], atol=1e-3
    )
    left = band_passed(TIME, np.sin(omega * TIME), width)
    np.testing.assert_allclose(left[inside], (np.sin(omega * TIME) - expected)[inside], atol=1e-3)
