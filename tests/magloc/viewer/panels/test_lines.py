"""Lines over time as an SVG: paths, numbers of the axes."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from magloc.viewer.panels.lines import PlotLines, across, lines_svg, number_texts, path_of, tick_texts


class TestPath:
    def test_is_broken_where_a_value_is_missing(self) -> None:
        x = np.array([0.0, 1.0, 2.0, 3.0, 4.0, 5.0])
        assert path_of(x, np.array([7.0, 8.2, np.nan, 9.0, np.nan, np.nan])) == "M0 7 1 8M3 9h0"
        assert path_of(x, np.full(6, np.nan)) == ""


class TestTicks:
    @given(st.floats(-1e6, 1e6), st.sampled_from([1e-3, 0.02, 0.5, 1.0, 2.0, 50.0]))
    def test_texts_tell_them_apart(self, first: float, step: float) -> None:
        ticks = np.round(first / step) * step + step * np.arange(5)
        texts = tick_texts(ticks)
        assert len(set(texts)) == 5
        np.testing.assert_allclose([float(t.replace("\N{MINUS SIGN}", "-")) for t in texts], ticks, atol=1e-3 * step)

    def test_a_small_signal_in_a_large_field_has_numbers(self) -> None:
        time_s, values = np.arange(3.0), np.array([[48_000.01], [48_000.02], [48_000.03]])
        lines = PlotLines(time_s, values, (0.0, 2.0), (48_000.005, 48_000.035), ("s1",), ("#000000",), lambda rows: ...)
        svg = lines_svg(lines, "time <s>")
        numbers = [float(text) for text in re.findall(r'text-anchor="end">([0-9.]+)<', svg)]
        assert len(set(numbers)) == len(numbers) >= 3
        assert 48_000.005 <= min(numbers) < max(numbers) <= 48_000.035
        assert number_texts(lines, [48_000.012]) == ["48000.012000"]
        assert "time &lt;s&gt;" in svg


def test_times_stand_evenly_along_the_axis() -> None:
    lines = PlotLines(np.zeros(0), np.zeros((0, 1)), (5.0, 9.0), (0.0, 1.0), ("a",), ("#000000",), lambda rows: ...)
    begin, middle, end = across(lines, np.array([5.0, 7.0, 9.0]))
    assert middle == pytest.approx(0.5 * (begin + end))
    assert begin < end
