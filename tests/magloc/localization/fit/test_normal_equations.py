"""Tests of magloc.localization.fit.normal_equations_compiled.

| what | who checks it |
|---|---|
| χ², moment and step at any place | the lanes that keep all digits, ended after one linearisation |
| search where it has not the digits | the truth of readings without noise |
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from arrays.array import SensorArray
from arrays.geometries import tetrahedron
from magloc.localization.fit.variable_projection_compiled import Refined, Rules, refine_starts
from magloc.localization.search.single_source import SingleSourceSearch
from magloc.measurement.differences import predicted_channels
from magloc.measurement.rows import whitened_rows
from tests.magloc.localization.search.test_candidates import CASES, random_problems
from tests.magloc.localization.search.test_single_source import noisy_readings

N_ROWS = 40  # more than lanes, and not a multiple


def after_one(few_digits, rows, q, free_range, *, ahead):
    """Ends of starts (b, 4) of a row each after one linearisation."""
    out = Refined.empty(len(q))
    rules = Rules(0.0, 1.0, np.full(len(q), math.inf), ahead, few_digits)
    refine_starts(rows.signal, np.arange(len(q)), q, rows.model.lanes, free_range, rules, out)
    return out


class TestOneLinearisation:
    @pytest.mark.parametrize("ahead", [False, True])
    @pytest.mark.parametrize("free_range", [0.0, 1.0])
    @pytest.mark.parametrize("case", [case for case in CASES if case != "line"])
    @pytest.mark.parametrize("noise_fraction", [0.0, 1e-3])
    def test_is_that_with_all_digits(self, case: str, noise_fraction: float, free_range: float, ahead: bool) -> None:
        rng = np.random.default_rng(3)
        array, places, moments = random_problems(case, N_ROWS, rng)
        array = replace(array, noise_fraction=noise_fraction)
        (rows,) = whitened_rows(array, noisy_readings(array, places, moments, rng), None, N_ROWS)
        q = rows.model.homogeneous(places * rng.uniform(0.5, 2.0, (N_ROWS, 1)) + 0.1)
        found, expected = (after_one(few, rows, q, free_range, ahead=ahead) for few in (True, False))
        assert_allclose(found.chi2, expected.chi2, rtol=1e-9, atol=1e-12 * rows.energy.max())
        assert_allclose(found.q, expected.q, atol=1e-7)
        assert_allclose(found.mu, expected.mu, rtol=1e-7, atol=1e-9 * np.abs(expected.mu).max())


class TestWithoutTheDigits:
    """The search takes all digits there: squares of such readings have none left."""

    @pytest.mark.parametrize("noise_T", [1e-15, 1e-17])
    def test_nearly_no_noise(self, noise_T: float) -> None:
        array = tetrahedron(1.5, noise_T=noise_T)
        self.check(array)

    def test_noise_with_a_direction(self) -> None:
        array = tetrahedron(1.5, noise_T=1e-9)
        sensors = tuple(replace(sensor, misalignment_rad=0.1, gain_uncertainty=0.1) for sensor in array.sensors)
        self.check(SensorArray(sensors))

    def check(self, array: SensorArray) -> None:
        rng = np.random.default_rng(4)
        u, m = rng.normal(size=(2, N_ROWS, 3))
        places = 4.0 * u / np.linalg.norm(u, axis=1, keepdims=True)
        readings = predicted_channels(array, places, 300.0 * m) + array.channel_offset_T
        (rows,) = whitened_rows(array, readings, None, N_ROWS)
        (optima,) = SingleSourceSearch(array).optima(rows)
        best = optima.fits.rows(np.searchsorted(optima.of_row, np.arange(N_ROWS)))
        assert_allclose(rows.model.position(best.q[:, 0]), places, rtol=0.0, atol=1e-4)
        assert np.all(best.chi2 < 1e-6)
