"""What a survey takes of readings before anything is fitted."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from arrays.typing import FloatArray
from magloc.readings import Readings
from magloc.surveying.preparation import clipped_readings, earlier_rows, leaping_rows, vary_with_base
from tests.hills import PAIR, plain, walk


class TestBaseStation:
    TIME_S = np.arange(0.0, 100.0)
    AMBIENT_T = np.tile([2e-5, 0.0, -4e-5], (100, 1))

    def varying(self, time_s: FloatArray) -> FloatArray:
        """With a base station that drifts by a nanotesla a second and reads at some times."""
        base = Readings(47e-6 + 1e-9 * time_s[:, None], time_s=time_s)
        return vary_with_base(self.AMBIENT_T, self.TIME_S, base)

    def test_the_modulus_varies_about_the_given(self) -> None:
        change = np.linalg.norm(self.varying(self.TIME_S), axis=1) - np.linalg.norm(self.AMBIENT_T, axis=1)
        np.testing.assert_allclose(change, 1e-9 * (self.TIME_S - 49.5), atol=1e-18)

    def test_what_it_reads_at_other_times_does_not_matter(self) -> None:
        """An hour after the survey, and at a third of its rate."""
        hour = np.arange(0.0, 3600.0, 3.0)
        np.testing.assert_allclose(self.varying(hour), self.varying(self.TIME_S), rtol=0.0, atol=1e-18)

    @pytest.mark.parametrize("rows", [[40], [40, 41], [40, 42], list(range(30, 42))])
    def test_wild_readings_are_left_out(self, rows: list[int], caplog: pytest.LogCaptureFixture) -> None:
        base_T = 47e-6 + 1e-9 * self.TIME_S
        base_T[rows] -= 3e-7
        found = vary_with_base(self.AMBIENT_T, self.TIME_S, Readings(base_T[:, None], time_s=self.TIME_S))
        np.testing.assert_allclose(found, self.varying(self.TIME_S), rtol=0.0, atol=2e-9)
        assert f"readings of the base station: {len(rows)};" in caplog.text

    def test_a_long_gap_is_named(self, caplog: pytest.LogCaptureFixture) -> None:
        gap = self.TIME_S[(self.TIME_S < 20.0) | (self.TIME_S > 70.0)]
        np.testing.assert_allclose(self.varying(gap), self.varying(self.TIME_S), rtol=0.0, atol=2e-9)
        assert "the base station reads nothing from 19 to 71 s" in caplog.text

    @pytest.mark.parametrize("unit", [1e-3, 1e3])
    def test_another_unit_is_refused(self, unit: float) -> None:
        base = Readings(unit * np.full((100, 1), 47e-6), time_s=self.TIME_S)
        with pytest.raises(ValueError, match="Input base must read the modulus of the Earth's field, about 44721 nT"):
            vary_with_base(self.AMBIENT_T, self.TIME_S, base)


class TestPlaces:
    """Of a walk of 1 m in every second."""

    @staticmethod
    def walked(shift_m: FloatArray) -> Readings:
        places = np.column_stack([np.arange(100.0) + shift_m, np.zeros(100), np.ones(100)])
        turns = Rotation.identity(100)
        return Readings(np.zeros((100, 1)), time_s=np.arange(100.0), array_position_m=places, array_rotation=turns)

    def test_single_ones_that_leap_are_left_out(self) -> None:
        shift = np.zeros(100)
        shift[[20, 57]] = 1e4, -1e6
        assert np.flatnonzero(leaping_rows(self.walked(shift))).tolist() == [20, 57]

    def test_two_frames_are_refused(self) -> None:
        with pytest.raises(
            ValueError, match=r"in one frame; instead received rows at 59 and 60 s that are 6\.91e\+05 m"
        ):
            leaping_rows(self.walked(np.where(np.arange(100) < 60, 0.0, 691e3)))

    def test_a_walk_to_another_field_is_none(self) -> None:
        """300 m/s are not exceeded by one who reads every second and turns up 200 m away."""
        assert not leaping_rows(self.walked(np.where(np.arange(100) < 60, 0.0, 200.0))).any()


class TestClippedReadings:
    """Of a walk over three targets.

    Of 60 simulated surveys, each rounded to 0.001, 0.01, 0.1, 1 and 10 nT, none had clipped readings. Cut at the 97 %
    quantile 54 or 55 had, 51 of those rounded to 1 nT, 10 of those rounded to 10 nT.
    """

    ROWS = walk(71, plain, 5.0, 3).readings

    @pytest.mark.parametrize("digit_T", [1e-12, 1e-10, 1e-9, 1e-8])
    def test_rounded_ones_are_none(self, digit_T: float) -> None:
        assert not clipped_readings(PAIR, digit_T * np.round(self.ROWS.values_T / digit_T)).any()

    def test_a_rest_at_the_largest_reading_is_none(self) -> None:
        values = 1e-10 * np.round(self.ROWS.values_T / 1e-10)
        k = int(values[:, 0].argmax())
        assert not clipped_readings(PAIR, np.insert(values, [k] * 8, values[k], axis=0)[: k + 9]).any()

    @pytest.mark.parametrize("sign", [1.0, -1.0])
    @pytest.mark.parametrize("digit_T", [1e-12, 1e-10])
    def test_each_beyond_the_limit(self, sign: float, digit_T: float) -> None:
        values = digit_T * np.round(self.ROWS.values_T / digit_T)
        limit_T = digit_T * np.round(np.quantile(values[:, 0], 0.97) / digit_T)
        cut = np.minimum(values, limit_T)
        cut[50, 0] = np.nan
        np.testing.assert_array_equal(clipped_readings(PAIR, sign * cut)[:, 0], cut[:, 0] == limit_T)


class TestRepeatedRows:
    ROWS = walk(71, plain, 5.0, 3).readings

    def test_a_block_that_stands_twice_in_a_file(self) -> None:
        twice = self.ROWS[np.r_[:400, 300 : len(self.ROWS)]]
        expected = np.full(len(twice), -1)
        expected[400:500] = np.arange(300, 400)
        np.testing.assert_array_equal(earlier_rows(twice), expected)

    def test_equal_rows_at_rest_are_none(self) -> None:
        assert (earlier_rows(self.ROWS[np.r_[:400, [400] * 50, 400:800]]) < 0).all()
