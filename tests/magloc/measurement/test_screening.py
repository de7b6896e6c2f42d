"""Wild readings of walks and flights over buried dipoles."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from arrays.typing import FloatArray
from magloc.fields import dipole
from magloc.measurement.screening import wild_readings

NOISE_T = 1e-10
AMBIENT_T = np.array([1.3e-6, 2.04e-5, -4.39e-5])


def surveyed(seed: int, rate_Hz: float, speed_m_s: float, height_m: float) -> tuple[FloatArray, FloatArray]:
    """Moduli and places of three lines over three dipoles, 5 cm to 1 m deep and of 0.1 to 10 A·m²."""
    rng = np.random.default_rng(seed)
    way = np.arange(0.0, 12.0 * max(speed_m_s, 1.0), speed_m_s / rate_Hz)
    lines = [np.column_stack([way[:: (-1) ** k], np.full(len(way), float(k))]) for k in range(3)]
    place = np.column_stack([np.vstack(lines), np.full(3 * len(way), height_m)])
    fields = np.tile(AMBIENT_T, (len(place), 1))
    for _ in range(3):
        source = np.array([rng.uniform(1.0, way[-1] - 1.0), rng.uniform(0.0, 2.0), -rng.choice([0.05, 0.3, 0.5, 1.0])])
        moment = rng.normal(size=3)
        moment *= 10.0 ** rng.uniform(-1.0, 1.0) / np.linalg.norm(moment)
        fields += dipole.field(place, source, moment)
    return np.linalg.norm(fields, axis=1) + NOISE_T * rng.normal(size=len(place)), place


def screened(values: FloatArray, place: FloatArray, height_m: float) -> list[int]:
    return np.flatnonzero(wild_readings(values, place, height_m + 0.05, NOISE_T, 0.01)).tolist()


class TestGoodReadings:
    @given(
        seed=st.integers(0, 2**31),
        rate_Hz=st.sampled_from([2.0, 5.0, 10.0, 20.0, 100.0]),
        speed_m_s=st.sampled_from([1.0, 3.0, 6.0]),
        height_m=st.sampled_from([0.3, 0.5, 1.0, 2.0]),
    )
    def test_hardly_any_is_lost(self, seed: int, rate_Hz: float, speed_m_s: float, height_m: float) -> None:
        """Peaks of one to three rows among them; the middle of such a peak is lost in about one log of a thousand."""
        if rate_Hz < 50.0 * speed_m_s:
            assert len(screened(*surveyed(seed, rate_Hz, speed_m_s, height_m), height_m)) <= 1

    def test_another_level_is_none(self) -> None:
        values, place = surveyed(1, 10.0, 1.0, 0.5)
        assert screened(values + 5e-8 * (np.arange(len(values)) >= 170), place, 0.5) == []

    def test_few_rows(self) -> None:
        assert screened(np.array([5e-5, 6e-5, 5e-5]), np.zeros((3, 3)), 0.5) == []


class TestGroups:
    """10 rows a second at walking pace over a quiet field: exactly the wild ones are found, wherever they stand."""

    @staticmethod
    def quiet() -> tuple[FloatArray, FloatArray]:
        place = np.column_stack([0.1 * np.arange(400.0), np.zeros(400), np.full(400, 0.45)])
        fields = AMBIENT_T + dipole.field(place, np.array([20.0, 0.3, -0.5]), np.array([0.6, -0.1, -0.7]))
        return np.linalg.norm(fields, axis=1) + NOISE_T * np.random.default_rng(3).normal(size=400), place

    @given(
        rows=st.tuples(st.integers(25, 330), st.integers(1, 40)).map(lambda run: list(range(run[0], sum(run)))),
        size=st.floats(2e-7, 5e-5),
        sign=st.sampled_from([-1, 1]),
    )
    def test_a_run_of_one_size(self, rows: list[int], size: float, sign: int) -> None:
        values, place = self.quiet()
        values[rows] += sign * size
        assert screened(values, place, 0.45) == rows

    @given(st.sets(st.integers(0, 399), max_size=40), st.integers(0, 2**31))
    def test_any_tenth_of_the_rows(self, rows: set[int], seed: int) -> None:
        values, place = self.quiet()
        wild, rng = np.array(sorted(rows), dtype=int), np.random.default_rng(seed)
        values[wild] += rng.choice([-1.0, 1.0], len(wild)) * rng.uniform(5e-7, 5e-5, len(wild))
        found = set(screened(values, place, 0.45))
        assert set(wild.tolist()) <= found
        assert len(found - rows) <= 2  # good ones that wild ones surround

    @pytest.mark.parametrize("rows", [[200], [200, 201], [200, 202], [199, 200, 202, 203], [0], [0, 1], [399]])
    @pytest.mark.parametrize("size", [2e-7, 2e-6, -1e-4])
    def test_on_a_target(self, rows: list[int], size: float) -> None:
        values, place = self.quiet()
        values[rows] += size
        assert screened(values, place, 0.45) == rows

    def test_missing_readings_are_not_wild(self) -> None:
        values, place = self.quiet()
        values[[100, 101, 205]] = np.nan
        values[[102, 206]] += 1e-6
        assert screened(values, place, 0.45) == [102, 206]
