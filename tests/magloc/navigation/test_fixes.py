"""Places that stand still between fixes, and carriers that rest."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from arrays.columns import POSITION_COLUMNS
from arrays.io.csv import Table
from arrays.typing import FloatArray
from magloc.navigation.fixes import Interpolated, between_fixes, interval_of_fixes, without_gaps


def way(time_s: FloatArray, bend: float = 0.0) -> FloatArray:
    return np.stack([1.3 * time_s, bend * np.sin(time_s), 0.4 + 0.0 * time_s], axis=1)


def found(time_s: FloatArray, place: FloatArray) -> Interpolated | None:
    return between_fixes(time_s, place, Rotation.identity(len(place)))


class TestStaircase:
    @given(period=st.integers(2, 20), rate_Hz=st.floats(2.0, 50.0), places=st.integers(4, 30))
    def test_a_straight_way_is_as_it_was(self, period: int, rate_Hz: float, places: int) -> None:
        rows = np.arange(places * period)
        time_s = rows / rate_Hz
        of_all = found(time_s, way(time_s)[rows // period * period])
        assert of_all is not None
        assert of_all.end == len(rows) - period + 1
        assert of_all.rate_Hz == pytest.approx(rate_Hz / period)
        np.testing.assert_allclose(of_all.position_m[: of_all.end], way(time_s)[: of_all.end], atol=1e-9)

    def test_a_way_that_bends_errs_as_much_as_is_said(self) -> None:
        """Within two standard deviations everywhere, at the last interval too, and by more than a tenth of one."""
        rows = np.arange(400)
        time_s = rows / 10.0
        of_all = found(time_s, way(time_s, 0.5)[rows // 10 * 10])
        assert of_all is not None
        error = np.abs(of_all.position_m - way(time_s, 0.5))[: of_all.end, 1]
        sigma = of_all.error_m[: of_all.end]
        assert (error <= 2.0 * sigma + 1e-9).all()
        assert error.max() > 0.1 * sigma.max()
        assert interval_of_fixes(time_s, of_all.error_m) == pytest.approx(1.0)

    def test_a_carrier_that_stands_between_fixes_stands(self) -> None:
        """10 s of rest in a staircase of 1 s: only the second that it goes on in is moved."""
        moving = np.concatenate([np.arange(100), np.full(100, 99), np.arange(100, 200)]) / 10.0
        rows = np.arange(300)
        of_all = found(rows / 10.0, way(moving)[rows // 10 * 10])
        assert of_all is not None
        np.testing.assert_allclose(of_all.position_m[110:180], way(moving)[110:180], atol=0.15)

    def test_an_attitude_that_changes_in_every_row_stays(self) -> None:
        rows = np.arange(100)
        turn = Rotation.from_rotvec(np.outer(0.01 * rows, [0.0, 0.0, 1.0]))
        of_all = between_fixes(rows / 10.0, way(rows / 10.0)[rows // 5 * 5], turn)
        assert of_all is not None
        assert of_all.rotation is turn


class TestLostFixes:
    def test_places_that_are_held_and_leap(self) -> None:
        time_s = np.arange(200) / 10.0
        place = way(time_s)
        place[80:120] = place[80]
        of_all = found(time_s, place)
        assert of_all is not None
        assert of_all.held == 39
        np.testing.assert_allclose(of_all.position_m, way(time_s), atol=1e-9)


class TestGaps:
    @pytest.mark.parametrize("time_s", [[0.0, 1.0, 2.0, np.inf, np.inf], [-np.inf, -1e300, 0.0, 1e300, np.inf]])
    def test_times_that_overflow_are_no_fault_here(self, time_s: list[float]) -> None:
        """The reader of the table refuses them afterwards."""
        places = np.array([[1.0, 2.0, 3.0], [np.nan] * 3, [2.0, 3.0, 3.0], [3.0, 3.0, 3.0], [4.0, 3.0, 3.0]])
        values = np.column_stack([time_s, places])
        table, error_m = without_gaps(Table("log.csv", ("time_s", *POSITION_COLUMNS), 1, values, np.arange(5) + 2))
        assert np.isfinite(table.values[:, 1:]).all()
        assert error_m is not None

    def test_without_times_nothing_is_interpolated(self) -> None:
        """The reader of the table asks for them."""
        table = Table("log.csv", POSITION_COLUMNS, 1, np.array([[0.0, 0.0, 0.0], [np.nan] * 3]), np.arange(2) + 2)
        assert without_gaps(table) == (table, None)


class TestIntervalOfFixes:
    def test_is_the_length_of_the_only_gap(self) -> None:
        time_s = np.arange(100) / 10.0
        assert interval_of_fixes(time_s, np.where((time_s > 3.05) & (time_s < 8.95), 0.1, 0.0)) == pytest.approx(6.0)

    def test_is_0_without_a_gap(self) -> None:
        assert interval_of_fixes(np.arange(9.0), np.zeros(9)) == 0.0
        assert interval_of_fixes(np.arange(9.0), None) == 0.0


class TestRest:
    @given(stands=st.lists(st.integers(2, 300), min_size=1, max_size=5), digits=st.integers(3, 9))
    def test_a_carrier_that_stands_is_not_held(self, stands: list[int], digits: int) -> None:
        """A person who stops, a boat at anchor, rests at line ends: it goes on as it came."""
        moving = np.concatenate(
            [np.append(np.arange(20) + 20 * k, np.full(n, 20 * k + 19)) for k, n in enumerate(stands)]
        )
        moving = np.append(moving, moving[-1] + 1 + np.arange(60)) / 10.0
        assert found(np.arange(len(moving)) / 10.0, way(moving).round(digits)) is None

    def test_a_carrier_at_rest(self) -> None:
        time_s = np.arange(100) / 10.0
        assert found(time_s, np.zeros((100, 3))) is None
