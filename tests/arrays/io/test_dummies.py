"""Numbers that stand where there is no reading."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from arrays.io.dummies import dummy_cells, may_be_dummies
from arrays.typing import FloatArray

RNG = np.random.default_rng(0)
MODULI = 48_000.0 + RNG.normal(size=(300, 1))
AXES = np.array([20_000.0, -300.0, 43_000.0]) + 5.0 * RNG.normal(size=(300, 3))


class TestKnownNumbers:
    @pytest.mark.parametrize("number", [-99999.0, 99999.99, -999999.0, 1e32, -1e30, 1.70141e38, 0.0])
    @given(st.sets(st.integers(0, 299), min_size=1, max_size=100))
    def test_exactly_they_are_found(self, number: float, rows: set[int]) -> None:
        values = MODULI.copy()
        values[list(rows)] = number
        assert set(np.flatnonzero(dummy_cells(values)[:, 0]).tolist()) == rows

    def test_one_row_is_enough(self) -> None:
        assert dummy_cells(np.array([[-99999.0, 1e32, 12.0]])).tolist() == [[True, True, False]]

    def test_of_a_log_in_another_unit(self) -> None:
        values = np.where(np.arange(300)[:, None] == 7, -99999e3, MODULI)
        assert np.flatnonzero(dummy_cells(values, units=(1.0, 1e3))).tolist() == [7]

    def test_zero_of_a_vector_sensor_is_one_of_all_axes(self) -> None:
        values = AXES.copy()
        values[4] = 0.0
        assert np.argwhere(dummy_cells(values)).tolist() == [[4, 0], [4, 1], [4, 2]]

    def test_numbers_that_are_repeated_far_away(self) -> None:
        values = AXES.copy()
        values[[4, 9], 1] = -8.5e6
        assert np.argwhere(dummy_cells(values)).tolist() == [[4, 1], [9, 1]]

    def test_what_is_declared(self) -> None:
        values = MODULI.copy()
        values[5] = 47_111.0
        assert np.flatnonzero(dummy_cells(values, declared=[47_111.0])).tolist() == [5]


class TestReadings:
    @pytest.mark.parametrize(
        "values",
        [
            MODULI,
            AXES,
            np.round(1e5 * RNG.normal(size=(300, 3)), -3),  # coarse, through zero and beyond -99,999
            np.zeros((300, 1)),
            48_000.0 + np.where(np.abs(np.arange(300.0) - 150.0) < 2.0, 900.0, 0.0)[:, None],
        ],
    )
    def test_none_is_a_dummy(self, values: FloatArray) -> None:
        assert not dummy_cells(values).any()


def test_numbers_whose_squares_overflow_are_no_fault() -> None:
    readings = np.full((12, 3), 4e4)
    readings[3:6] = 1e155, -1.7e308, 2.0
    assert dummy_cells(readings)[3:6, 0].all()


CELLS = st.sampled_from([0.0, -0.0, 1.0, -3.0, 20.0, 250.0, -99999.0, 1e-170, 99.9, 1e22, 7.0, np.nan])


@given(st.lists(st.tuples(CELLS, CELLS), min_size=1, max_size=40), st.integers(1, 5))
def test_a_quick_bound_misses_no_dummy(cells: list[tuple[float, float]], n_new: int) -> None:
    readings, n_new = np.array(cells), min(n_new, len(cells))
    found = dummy_cells(readings, (7.0,), (1.0, 10.0))[-n_new:].any(axis=0)
    assert not (found & ~may_be_dummies(readings, n_new, (7.0,), (1.0, 10.0))).any()


def test_the_quick_bound_rules_out_usual_readings() -> None:
    assert not may_be_dummies(AXES, 3).any()
