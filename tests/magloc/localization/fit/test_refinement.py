"""Kernels of fits and of the search, in all instruction sets of this machine.

| what | who checks it |
|---|---|
| optima of one to four sources, vector sensors | damped_gauss_newton, the readable reference |
| normal equations by sums of products | the search that keeps all digits; the truth of readings without noise |
| blocks, threads, lanes | each other: bit for bit |
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from arrays.array import SensorArray
from arrays.geometries import tetrahedron
from arrays.sensor import Sensor
from magloc.localization.fit import refinement
from magloc.localization.fit.gauss_newton import damped_gauss_newton, refine
from magloc.localization.search.single_source import SingleSourceSearch
from magloc.measurement import channels
from magloc.measurement.differences import predicted_channels
from magloc.measurement.rows import whitened_rows
from tests.magloc.localization.fit.test_gauss_newton import array_of, noisy_readings, problem_of, random_sources
from tests.magloc.localization.search.test_candidates import CASES, regime

N_ROWS = 13  # no multiple of a number of lanes


pytestmark = pytest.mark.usefixtures("instruction_set")


def equal_sensors() -> SensorArray:
    """Twenty vector sensors of 1 nT, not turned, within 1.5 m along every axis."""
    places = np.random.default_rng(30).uniform(-1.5, 1.5, (20, 3))
    return SensorArray(tuple(Sensor(f"s{i}", "vector", tuple(place), 1e-9) for i, place in enumerate(places)))


def array_and_readings(case: str, n_sources: int, rng: np.random.Generator):
    """An array, noisy readings (n, C) of it, and the sources' positions and moments."""
    array = {
        "isotropic": equal_sensors(),
        "turned and unequal": array_of("vector", 31, 20),
        "prior of the common field": replace(array_of("vector", 31, 20), common_field_T=5e-8),
        "noise of its own in each row": replace(equal_sensors(), noise_fraction=1e-3),
        "missing channels": array_of("vector", 31, 20),
    }[case]
    p, m = random_sources(rng, N_ROWS, n_sources)
    readings = noisy_readings(array, p, m, rng)
    if case == "missing channels":
        readings[:, [0, 4, 5, 6, 7, 8]] = np.nan
    return array, readings, p, m


@cache
def reference(n_sources: int, case: str, held: bool) -> tuple[Any, ...]:
    """A problem, a start, and where the readable refinement ends; the same for all instruction sets."""
    rng = np.random.default_rng(33)
    array, readings, p, m = array_and_readings(case, n_sources, rng)
    problem, y = problem_of(array, readings)
    q = problem.homogeneous(p + 0.02 * rng.normal(size=p.shape))
    mu, free = problem.scaled_moment(q, m), np.ones((p.shape[1], 3), dtype=bool)
    free[0, 2] = not held
    return problem, y, q, mu, free, damped_gauss_newton(problem, y, q, mu, free, 400)


class TestOptima:
    @pytest.mark.parametrize("held", [False, True])
    @pytest.mark.parametrize(
        "case",
        [
            "isotropic",
            "turned and unequal",
            "prior of the common field",
            "noise of its own in each row",
            "missing channels",
        ],
    )
    @pytest.mark.parametrize("n_sources", [1, 2, 3, 4])
    def test_vector_sensors(self, n_sources: int, case: str, held: bool) -> None:
        """From beside the truth, where each optimum is the reference's."""
        problem, y, q, mu, free, expected = reference(n_sources, case, held)
        found = refine(problem, y, q, mu, free=free)
        assert expected.converged.all()
        assert_allclose(found.chi2, expected.chi2, rtol=1e-9, atol=1e-7)
        assert_allclose(found.q, expected.q, atol=1e-5)
        held_s = problem.homogeneous(problem.position(q))[:, 0, 3]
        if held:
            assert_allclose(np.abs(found.q[:, 0, 3]), held_s, rtol=1e-12)

    def test_nothing_that_can_be_fitted(self) -> None:
        """NaN in readings, in a start, or no row at all."""
        rng = np.random.default_rng(35)
        array, readings, p, m = array_and_readings("isotropic", 1, rng)
        problem, y = problem_of(array, readings)
        q, mu = problem.homogeneous(p), problem.scaled_moment(problem.homogeneous(p), m)
        whole = refine(problem, y, q, mu)
        y[3, 5], q[7, 0, 1] = np.nan, np.nan
        found = refine(problem, y, q, mu)
        bad = np.isin(np.arange(N_ROWS), [3, 7])
        assert_array_equal(found.converged, ~bad)
        assert_array_equal(found.chi2[~bad], whole.chi2[~bad])
        none = np.arange(0)
        assert refine(problem.rows(none), y[:0], q[:0], mu[:0]).chi2.shape == (0,)

    def test_a_fit_that_stays_too_high_is_given_up(self) -> None:
        rng = np.random.default_rng(36)
        array, readings, p, m = array_and_readings("isotropic", 2, rng)
        problem, y = problem_of(array, readings)
        q = problem.homogeneous(p + 0.3 * rng.normal(size=p.shape))
        mu = problem.scaled_moment(q, m)
        whole = refine(problem, y, q, mu)
        limit = np.where(np.arange(N_ROWS) % 2 == 0, 0.5 * whole.chi2, 2.0 * whole.chi2)
        found = refine(problem, y, q, mu, too_high=limit)
        assert_array_equal(found.converged, np.arange(N_ROWS) % 2 == 1)
        assert_array_equal(found.chi2[1::2], whole.chi2[1::2])
        assert found.iterations[::2].sum() < whole.iterations[::2].sum()


class TestSumsOfProducts:
    """Normal equations of isotropic noise by sums of products serve near optima only, and only where they may."""

    @pytest.mark.parametrize("case", ["tetrahedron 1.5 m", "tetrahedron 0.5 m", "square 1 m", "board of thirty"])
    @pytest.mark.parametrize("name", ["near", "product", "far"])
    def test_optima_are_those_with_all_digits(self, case: str, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
        array, _, readings = regime(name, 200, np.random.default_rng(5), CASES[case][0])
        search = SingleSourceSearch(array)
        (rows,) = whitened_rows(array, readings, None, 200)
        starts, every = search.starts(rows), np.arange(200)
        fast = search.refine_starts(rows, every, starts, 20.0)
        assert rows.model.channels.struct.is_isotropic
        monkeypatch.setattr(channels, "_is_isotropic", lambda *_: False)
        (rows,) = whitened_rows(array, readings, None, 200)
        slow = search.refine_starts(rows, every, starts, 20.0)
        assert not rows.model.channels.struct.is_isotropic
        assert np.isfinite(slow.chi2[:, 0]).all()
        close = np.abs(fast.chi2[:, 0] - slow.chi2[:, 0]) <= 1e-9 * (1.0 + slow.chi2[:, 0])
        assert np.count_nonzero(~close) <= 1
        assert np.count_nonzero(fast.counts[:, 0] != slow.counts[:, 0]) <= 2

    @pytest.mark.parametrize("noise_T", [1e-15, 1e-17])
    def test_nearly_no_noise(self, noise_T: float) -> None:
        self.check(tetrahedron(1.5, noise_T=noise_T))

    def test_noise_with_a_direction(self) -> None:
        array = tetrahedron(1.5, noise_T=1e-9)
        sensors = tuple(replace(sensor, misalignment_rad=0.1, gain_uncertainty=0.1) for sensor in array.sensors)
        self.check(SensorArray(sensors))

    def check(self, array: SensorArray) -> None:
        rng = np.random.default_rng(4)
        u, m = rng.normal(size=(2, 40, 3))
        places = 4.0 * u / np.linalg.norm(u, axis=1, keepdims=True)
        readings = predicted_channels(array, places, 300.0 * m) + array.channel_offset_T
        (rows,) = whitened_rows(array, readings, None, 40)
        (optima,) = SingleSourceSearch(array).optima(rows)
        best = optima.fits.rows(np.searchsorted(optima.of_row, np.arange(40)))
        assert_allclose(rows.model.position(best.q[:, 0]), places, rtol=0.0, atol=1e-4)
        assert np.all(best.chi2 < 1e-6)


class TestIndependence:
    """A row ends where it does alone, whatever its block, its thread, and the lanes beside it."""

    def test_of_threads_and_blocks(self, threads: Callable[[int], None], monkeypatch: pytest.MonkeyPatch) -> None:
        array, _, readings = regime("product", 150, np.random.default_rng(6))
        search = SingleSourceSearch(array)
        (rows,) = whitened_rows(array, readings, None, 150)
        starts = search.starts(rows)
        results = []
        for n_threads, numbers in ((1, 10**9), (1, 0), (2, 0)):
            threads(n_threads)
            monkeypatch.setattr(refinement, "_CHANNELS_A_BLOCK", numbers)
            results.append(search.refine_starts(rows, np.arange(150), starts, 20.0))
        alone = search.refine_starts(rows.select(np.array([77])), np.zeros(1, dtype=np.int64), starts[[77]], 20.0)
        for result in results[1:]:
            for values, others in zip(result, results[0], strict=True):
                assert_array_equal(values, others)
        for values, others in zip(alone, results[0], strict=True):
            assert_array_equal(values[0], others[77])
