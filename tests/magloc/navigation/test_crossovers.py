"""Shift of the clock of places, from lines over a field of known bumps."""

from __future__ import annotations

import numpy as np
import pytest

from arrays.typing import FloatArray
from magloc.navigation.crossovers import clock_shift
from magloc.navigation.flight_lines import flight_lines

LINES, LENGTH_M, SPACING_M, SPEED_M_S, RATE_Hz = 41, 97.0, 1.0, 1.0, 4.0
RNG = np.random.default_rng([561, 3])
BUMPS_M = RNG.uniform(0.0, [LENGTH_M, LINES * SPACING_M], (150, 2))
SIZES = RNG.standard_normal(150)


def way(time_s: FloatArray) -> FloatArray:
    """Return places (n, 3) on lines to and fro that need 97 s each."""
    line, along = np.divmod(SPEED_M_S * time_s, LENGTH_M)
    x = np.where(line % 2 == 0, along, LENGTH_M - along)
    return np.stack([x, SPACING_M * line, 0.0 * x], axis=-1)


def field(place_m: FloatArray) -> FloatArray:
    """Return the sum of Gaussian bumps of 1 m, with a little noise."""
    apart = np.linalg.norm(place_m[:, None, :2] - BUMPS_M, axis=-1)
    return np.asarray(np.exp(-0.5 * apart**2) @ SIZES + 0.01 * RNG.standard_normal(len(place_m)))


TIME_S = np.arange(0.0, LINES * LENGTH_M, 1.0 / RATE_Hz)


@pytest.mark.parametrize("shift_s", [0.0, 0.8, -1.2, 18.0, -18.0, 3600.0])
def test_shift_of_bumps(shift_s: float) -> None:
    """Readings of the places that the log has a time later; the result is right to the step of 0.1 s."""
    inside = TIME_S + shift_s < LINES * LENGTH_M
    time_s = TIME_S[inside]
    values, place_m = 1e-9 * field(way(time_s + shift_s)), way(time_s)
    found = clock_shift(time_s, place_m, values, flight_lines(time_s, place_m, place_m[:, 2]))
    if shift_s < 3600.0:
        assert found is not None
        assert found.s == pytest.approx(shift_s, abs=0.1)
        assert found.agreement > 0.5
        assert found.is_leap == (abs(shift_s) > 2.0)
    else:  # 377 s of 3,977 s have readings of places that the log knows, fewer than a third
        assert found is not None
        assert found.s == 0.0


def test_one_hour_of_a_long_survey() -> None:
    """The area is walked twice, in 8,000 s: rows that are an hour apart are elsewhere."""
    time_s = np.arange(0.0, 2 * LINES * LENGTH_M, 1.0 / RATE_Hz)
    period_s = LINES * LENGTH_M
    place_m, true_m = way(time_s % period_s), way((time_s + 3600.0) % period_s)
    values = 1e-9 * field(true_m)
    found = clock_shift(time_s, place_m, values, flight_lines(time_s, place_m, place_m[:, 2]))
    assert found is not None
    assert found.s == 3600.0
    assert "local time?" in found.warning


@pytest.mark.parametrize("rows", [slice(0, 300), slice(0, None, 1)])
def test_no_opposite_lines(rows: slice) -> None:
    """A single line, and lines of one direction."""
    time_s = TIME_S[rows]
    place_m = way(time_s)
    if rows.stop is None:
        place_m = place_m[(time_s // LENGTH_M) % 2 == 0]
        time_s = time_s[(time_s // LENGTH_M) % 2 == 0]
    values = 1e-9 * field(place_m)
    assert clock_shift(time_s, place_m, values, flight_lines(time_s, place_m, place_m[:, 2])) is None


def test_noise_alone() -> None:
    place_m = way(TIME_S)
    values = 1e-9 * np.random.default_rng(7).standard_normal(len(TIME_S))
    found = clock_shift(TIME_S, place_m, values, flight_lines(TIME_S, place_m, place_m[:, 2]))
    assert found is not None
    assert found.s == 0.0
