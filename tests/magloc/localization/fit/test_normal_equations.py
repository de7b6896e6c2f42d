"""Tests of magloc.localization.fit.normal_equations_compiled.

| what | who checks it |
|---|---|
| χ², moment and step at any place | the lanes that keep all digits, ended after one linearisation |
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from magloc.localization.fit.variable_projection_compiled import Refined, Rules, refine_starts
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
