"""Tests of the readable step: the step against a grid, and the table of the source paper's two steps.

Random problems are g in (0, 1), δ log-uniform in [1e-3, 2] and |μ| < 1 + δ, all strips that touch the ellipsoid.
"""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adcs.ellipsoids.names import STEP_RULES
from tests.adcs.ellipsoids import readable as strip_steps
from tests.adcs.ellipsoids.readable import (
    is_informative,
    lemma_step,
    optimal_step,
    tightened_strip,
    trace_ratio,
)

half_widths = st.floats(1e-3, 3.0)
fractions = st.floats(-1.0, 1.0)


def random_strips(n, seed):
    rng = np.random.default_rng(seed)
    delta = np.exp(rng.uniform(np.log(1e-3), np.log(2.0), n))
    return zip((1.0 + delta) * rng.uniform(-1.0, 1.0, n), delta, rng.uniform(0.0, 1.0, n), strict=True)


def ratios_on_grid(mu, delta, g, n):
    """F on a grid that is fine near 1, where δ²/(1 - λ) is steep."""
    step = np.concatenate([np.linspace(0.0, 1.0, n)[:-1], 1.0 - np.geomspace(1e-9, 1.0, n)])
    return (1.0 + step * (delta**2 / (1.0 - step) - mu**2)) * (1.0 - step * g)


class TestOptimalStep:
    def test_no_point_of_a_grid_is_better(self):
        """The root's F is at most 1e-7 above the best of 40,000 points."""
        informative = 0
        for mu, delta, g in random_strips(1000, seed=1):
            best = ratios_on_grid(mu, delta, g, 20_000).min()
            if is_informative(mu, delta, g):
                informative += 1
                assert trace_ratio(mu, delta, g, optimal_step(mu, delta, g)) <= best + 1e-7
            else:
                assert best >= 1.0 - 1e-12
        assert informative > 300


@pytest.mark.parametrize(
    ("g", "delta", "mu", "optimal", "lemma"),
    [
        (0.1, 0.01, 0.0, 0.906, 0.990),
        (0.1, 0.01, 0.5, 0.685, 0.990),
        (0.1, 0.10, 0.0, 0.952, 0.992),
        (0.1, 0.30, 0.0, 1.000, 1.000),
        (0.1, 0.30, 0.5, 0.917, 0.994),
        (0.5, 0.01, 0.0, 0.510, 0.750),
        (0.5, 0.01, 0.5, 0.385, 0.750),
        (0.5, 0.10, 0.0, 0.599, 0.760),
        (0.5, 0.30, 0.0, 0.786, 0.832),
        (0.5, 0.30, 0.5, 0.673, 0.806),
        (0.9, 0.01, 0.0, 0.106, 0.190),
        (0.9, 0.01, 0.5, 0.080, 0.190),
        (0.9, 0.10, 0.0, 0.168, 0.208),
        (0.9, 0.30, 0.0, 0.344, 0.344),
        (0.9, 0.30, 0.5, 0.299, 0.312),
    ],
)
def test_what_the_lemma_costs(g, delta, mu, optimal, lemma):
    assert trace_ratio(mu, delta, g, optimal_step(mu, delta, g)) == pytest.approx(optimal, abs=1e-3)
    assert trace_ratio(mu, delta, g, lemma_step(mu, delta, g)) == pytest.approx(lemma, abs=1e-3)


class TestTightenedStrip:
    @settings(deadline=None)
    @given(half_widths, fractions)
    def test_is_the_part_that_touches_the_ellipsoid(self, delta, fraction):
        mu = (1.0 + delta) * fraction
        middle, half = tightened_strip(mu, delta)
        low, high = max(-1.0, mu - delta), min(1.0, mu + delta)
        assert middle - half <= low + 1e-15
        assert middle + half >= high - 1e-15
        assert half == pytest.approx(max(0.5 * (high - low), 1e-3), abs=1e-15)

    def test_nothing_is_left_to_cut_where_the_strip_contains_the_ellipsoid(self):
        assert tightened_strip(0.5, 1.6) == (0.0, 1.0)
        assert strip_steps.cut(0.5, 1.6, 1.0, "tightened") is None


class TestLimits:
    @pytest.mark.parametrize("rule", STEP_RULES)
    @pytest.mark.parametrize("delta", [0.0, 1e-300, 1e-160, 1e-9, 1e-3])
    @pytest.mark.parametrize("mu", [0.0, 1e-300, 1e-12, 0.5, 1.0 - 1e-15, 1.0, 1.0 + 1e-12])
    @pytest.mark.parametrize("g", [1e-9, 0.5, 1.0 - 1e-15, 1.0])
    def test_step_and_growth_are_finite(self, rule, delta, mu, g):
        found = strip_steps.cut(mu, delta, g, rule)
        if found is not None:
            _, step, beta2 = found
            assert 0.0 < step <= 1.0 - 1e-9
            assert 1e-6 <= beta2 < math.inf
