"""Values have the digits that their standard deviations leave."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from arrays.io.tables import align, by_sigma


class TestBySigma:
    @given(st.floats(-1e12, 1e12), st.floats(1e-15, 1e12))
    def test_rounds_by_less_than_a_tenth_of_it(self, value: float, sigma: float) -> None:
        shown, of_sigma = map(float, by_sigma(value, sigma))
        assert of_sigma == pytest.approx(sigma, rel=0.051)
        assert abs(shown - value) <= 0.0501 * sigma + 4.0 * math.ulp(value)

    @given(st.floats(-1e6, 1e6), st.floats(1e-8, 1e6))
    def test_both_end_at_the_same_place(self, value: float, sigma: float) -> None:
        shown, of_sigma = (text.partition(".")[2] for text in by_sigma(value, sigma))
        assert len(shown) == len(of_sigma)

    @pytest.mark.parametrize("sigma", [0.0, math.nan, math.inf])
    def test_six_digits_where_there_is_none(self, sigma: float) -> None:
        assert by_sigma(-2.0 / 3.0, sigma)[0] == "-0.666667"

    def test_no_zero_is_negative(self) -> None:
        assert by_sigma(-0.001, 0.2) == ("0.00", "0.20")


def test_cells_stand_below_each_other() -> None:
    assert align([["name", "x", "flags"], ["a", "12.5", ""]], left=1) == ["name     x  flags", "a     12.5"]
