"""Tests of the readable step: the step against a grid, closed forms, and the table of the source paper's two steps.

Random problems are g in (0, 1), δ log-uniform in [1e-3, 2] and |μ| < 1 + δ, all strips that touch the ellipsoid.
"""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.adcs.ellipsoids import readable as strip_steps
from tests.adcs.ellipsoids.readable import (
    growth,
    is_informative,
    lemma_step,
    optimal_step,
    tightened_strip,
    trace_ratio,
)

shares = st.floats(1e-6, 1.0)
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


def paper_cubic(mu, delta, g):
    """Coefficients of the cubic in λ as the source paper prints them, highest power first."""
    return (
        2 * g * mu**2,
        -(g * (1 - delta**2) + mu**2 * (1 + 4 * g)),
        2 * (g * (1 + mu**2 - delta**2) + mu**2),
        delta**2 - mu**2 - g,
    )


class TestOptimalStep:
    def test_is_the_only_root_of_the_papers_cubic(self):
        for mu, delta, g in random_strips(1000, seed=2):
            roots = np.roots(paper_cubic(mu, delta, g))
            inside = roots[(np.abs(roots.imag) < 1e-7) & (roots.real > 0.0) & (roots.real < 1.0 - 1e-7)].real
            if is_informative(mu, delta, g):
                assert inside == pytest.approx([optimal_step(mu, delta, g)], abs=1e-6)
            else:
                assert inside.size == 0

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

    @settings(deadline=None)
    @given(shares, st.floats(1e-3, 0.999))
    def test_closed_form_of_a_strip_through_the_centre(self, g, relative_width):
        delta = relative_width * math.sqrt(g)
        if g == 1.0:
            return
        closed = 1.0 - math.sqrt(delta**2 * (1.0 - g) / (g * (1.0 - delta**2)))
        assert optimal_step(0.0, delta, g) == pytest.approx(min(closed, strip_steps.LARGEST_STEP), abs=1e-10)

    @settings(deadline=None)
    @given(shares, half_widths, fractions)
    def test_is_never_worse_than_the_lemma(self, g, delta, fraction):
        mu = (1.0 + delta) * fraction
        if is_informative(mu, delta, g):
            best = trace_ratio(mu, delta, g, optimal_step(mu, delta, g))
            assert best <= trace_ratio(mu, delta, g, lemma_step(mu, delta, g)) + 1e-12


class TestLemmaStep:
    @settings(deadline=None)
    @given(shares, half_widths, fractions)
    def test_trace_and_growth(self, g, delta, fraction):
        """β² = 1 + λ g and F = 1 - λ² g²."""
        mu = (1.0 + delta) * fraction
        if is_informative(mu, delta, g):
            step = lemma_step(mu, delta, g)
            if step < strip_steps.LARGEST_STEP:
                assert growth(mu, delta, step) == pytest.approx(1.0 + step * g, abs=1e-9)
                assert trace_ratio(mu, delta, g, step) == pytest.approx(1.0 - step**2 * g**2, abs=1e-9)

    @settings(deadline=None)
    @given(shares, half_widths, fractions)
    def test_is_a_step_forward_where_the_optimal_step_is(self, g, delta, fraction):
        """One test of informativeness serves both: λ > 0 and a root in (0, 1) where δ² < μ² + g, and only there."""
        mu = (1.0 + delta) * fraction
        slope_at_zero = delta**2 - mu**2 - g
        assert is_informative(mu, delta, g) == (mu * mu + g > delta * delta)
        if abs(slope_at_zero) > 1e-9:
            assert (1.0 - delta**2 / (g + mu**2) > 0.0) == (slope_at_zero < 0.0) == is_informative(mu, delta, g)


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
    @pytest.mark.parametrize("rule", strip_steps.STEP_RULES)
    @pytest.mark.parametrize("delta", [0.0, 1e-300, 1e-160, 1e-9, 1e-3])
    @pytest.mark.parametrize("mu", [0.0, 1e-300, 1e-12, 0.5, 1.0 - 1e-15, 1.0, 1.0 + 1e-12])
    @pytest.mark.parametrize("g", [1e-9, 0.5, 1.0 - 1e-15, 1.0])
    def test_step_and_growth_are_finite(self, rule, delta, mu, g):
        found = strip_steps.cut(mu, delta, g, rule)
        if found is not None:
            _, step, beta2 = found
            assert 0.0 < step <= 1.0 - 1e-9
            assert 1e-6 <= beta2 < math.inf

    @pytest.mark.parametrize("g", [0.1, 0.5, 0.9])
    def test_exact_reading_through_the_centre(self, g):
        """μ = 0 and δ → 0: λ → 1 and β² → 1."""
        for delta in (1e-4, 1e-6, 1e-8):
            step = optimal_step(0.0, delta, g)
            assert 1.0 - step == pytest.approx(delta * math.sqrt((1.0 - g) / g), rel=1e-3, abs=1e-9)
            assert growth(0.0, delta, step) == pytest.approx(1.0, abs=5.0 * delta)

    @pytest.mark.parametrize("g", [0.6, 0.75, 0.9])
    def test_exact_tangent(self, g):
        """|μ| → 1 and δ → 0: the cubic has the roots 1, 1 and (1 + g)/(2g)."""
        assert np.sort(np.roots(paper_cubic(1.0, 0.0, g)).real) == pytest.approx([1, 1, (1 + g) / (2 * g)], abs=1e-6)
        assert trace_ratio(1.0, 0.0, g, optimal_step(1.0, 0.0, g)) <= 1e-8

    def test_lemma_of_an_exact_reading(self):
        """Its β² is 1 + g, not the least possible 1 - μ²."""
        assert growth(0.7, 0.0, optimal_step(0.7, 0.0, 0.4)) == pytest.approx(1.0 - 0.7**2, abs=1e-8)
        assert growth(0.7, 1e-4, lemma_step(0.7, 1e-4, 0.4)) == pytest.approx(1.4, abs=1e-7)

    def test_one_dimension(self):
        """g = 1: λ → 1, and β² (1 - λ) → δ² while β² grows without limit."""
        step = optimal_step(0.0, 0.3, 1.0)
        assert step == 1.0 - 1e-9
        assert growth(0.0, 0.3, step) * (1.0 - step) == pytest.approx(0.09, abs=1e-8)
