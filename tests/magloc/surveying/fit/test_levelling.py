"""Levels of lines that a simulation added to a smooth field and to targets."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest

from arrays.typing import FloatArray
from magloc.navigation.flight_lines import FlightLine
from magloc.surveying.fit.levelling import line_levels

NOISE = 0.1
LENGTH_m, N = 40.0, 201


class Flown(NamedTuple):
    """Lines, and the parts of their values [nT]."""

    place_m: FloatArray
    lines: list[FlightLine]
    smooth: FloatArray
    targets: FloatArray
    levels: FloatArray
    noise: FloatArray

    def levelled(self) -> FloatArray:
        """Values less their estimated levels, and less what else is in them than level and noise."""
        values = self.smooth + self.targets + self.levels + self.noise
        return values - line_levels(self.place_m, values, self.lines) - self.smooth - self.targets


def flown(seed: int, *, ties: int = 0, level: float = 5.0) -> Flown:
    """31 parallel lines a metre apart, to and fro, and lines across them."""
    rng = np.random.default_rng(seed)
    along = np.linspace(0.0, LENGTH_m, N)
    ways = [np.stack([along[:: (-1) ** k], np.full(N, float(k)), np.full(N, 1.0)], axis=1) for k in range(31)]
    ways += [
        np.stack([np.full(N, x), np.linspace(-1.0, 31.0, N), np.full(N, 1.0)], axis=1)
        for x in np.linspace(5.0, 35.0, ties)
    ]
    place = np.concatenate(ways)
    lines = [FlightLine(f"L{k + 1}", slice(k * N, (k + 1) * N), 1.0, 1.0) for k in range(len(ways))]
    x, y, _ = place.T
    smooth = 3.0 + 0.4 * x - 0.3 * y + 6.0 * np.sin(2.0 * np.pi * (x + 0.5 * y) / 30.0)
    targets = np.zeros(len(place))
    for at in rng.uniform([2.0, 2.0], [38.0, 28.0], size=(8, 2)):
        squared = (x - at[0]) ** 2 + (y - at[1]) ** 2 + 1.5**2
        targets += rng.normal(0.0, 60.0) * (x - at[0]) / squared**1.5
    sizes = rng.normal(0.0, level, size=(len(ways), 2)) * [1.0, 0.3]
    levels = np.concatenate([offset + drift * np.linspace(-1.0, 1.0, N) for offset, drift in sizes])
    return Flown(place, lines, smooth, targets, levels, rng.normal(0.0, NOISE, size=len(place)))


def stripes(values: FloatArray) -> float:
    """Root mean square of the second difference between the means of neighbouring parallel lines, over that of one."""
    means = values[: 31 * N].reshape(31, N).mean(axis=1)
    return float(np.std(np.diff(means, n=2))) / np.sqrt(6.0)


def without_bilinear(field: Flown, values: FloatArray) -> FloatArray:
    x, y, _ = field.place_m.T
    columns = np.stack([np.ones_like(x), x, y, x * y], axis=1)
    return values - columns @ np.linalg.lstsq(columns, values, rcond=None)[0]


class TestLineLevels:
    @pytest.mark.parametrize("seed", [11, 12, 13])
    def test_no_stripes_are_left(self, seed: int) -> None:
        """Neighbouring lines agree within a tenth of their levels, beside targets of hundreds of times the noise."""
        field = flown(seed)
        assert stripes(field.levels) > 3.0
        assert stripes(field.levelled()) < 0.5

    @pytest.mark.parametrize("seed", [14, 15])
    def test_crossings_determine_all_levels(self, seed: int) -> None:
        """Up to a bilinear surface, which offsets and drifts of lines and ties together imitate."""
        field = flown(seed, ties=4)
        assert np.std(without_bilinear(field, field.levels)) > 3.0
        assert np.std(without_bilinear(field, field.levelled() - field.noise)) < 0.3

    def test_a_smooth_field_stays(self) -> None:
        """Nothing is taken from it where lines have no levels."""
        field = flown(16, level=0.0)
        assert np.std(field.smooth) > 5.0
        assert np.std(field.levelled() - field.noise) < 2.0 * NOISE

    def test_few_lines_stay_as_they_are(self) -> None:
        field = flown(17)
        three = slice(0, 3 * N)
        assert not line_levels(field.place_m[three], field.levels[three], field.lines[:3]).any()
