"""Masked arrays, dates, durations and frames become numbers."""

from __future__ import annotations

import datetime
from collections.abc import Iterator

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from arrays.io.csv import table_of_columns
from arrays.io.errors import InputError
from arrays.io.values import fields, numbers, seconds

NOON_S = 1_798_200_000.0  # 2026-12-25T12:00 UTC
NOON = np.datetime64("2026-12-25T12:00")


class Frame:
    """As a frame of polars: iterating it gives columns, their names are an attribute."""

    def __init__(self, columns: dict[str, object]) -> None:
        self._columns, self.columns = columns, list(columns)

    def __iter__(self) -> Iterator[object]:
        return iter(self._columns.values())

    def __getitem__(self, name: str) -> object:
        return self._columns[name]


class TestNumbers:
    """NaN is missing, and so is what is masked."""

    @given(st.lists(st.tuples(st.floats(-1e3, 1e3), st.booleans()), min_size=1))
    def test_masks(self, cells: list[tuple[float, bool]]) -> None:
        values, mask = map(np.array, zip(*cells, strict=True))
        np.testing.assert_array_equal(numbers(np.ma.MaskedArray(values, mask)), np.where(mask, np.nan, values))

    def test_no_mask(self) -> None:
        np.testing.assert_array_equal(numbers(np.ma.MaskedArray([1, 2])), [1.0, 2.0])

    def test_dates_are_none(self) -> None:
        with pytest.raises(TypeError, match="datetime64"):
            numbers([NOON])

    @given(st.floats())
    def test_fields(self, value: float) -> None:
        np.testing.assert_array_equal(fields([value]), [value if abs(value) <= 1e6 else np.nan])


class TestSeconds:
    """Durations are as long as they are, dates count from 1970."""

    @pytest.mark.parametrize("unit", ["ns", "us", "ms", "s"])
    def test_units(self, unit: str) -> None:
        steps = np.arange(3).astype("timedelta64[s]").astype(f"timedelta64[{unit}]")
        np.testing.assert_array_equal(seconds(steps), [0.0, 1.0, 2.0])
        np.testing.assert_array_equal(seconds(NOON.astype(f"datetime64[{unit}]") + steps), NOON_S + np.arange(3.0))

    @pytest.mark.parametrize(
        "times",
        [
            [datetime.datetime(2026, 12, 25, 12)],
            [datetime.datetime(2026, 12, 25, 13, tzinfo=datetime.timezone(datetime.timedelta(hours=1)))],
            pd.Series(pd.to_datetime(["2026-12-25 12:00"])),
            pd.Series(pd.to_datetime(["2026-12-25 12:00"]).tz_localize("UTC")),
            np.ma.MaskedArray([NOON]),
            [NOON_S],
        ],
    )
    def test_one_instant(self, times: object) -> None:
        np.testing.assert_array_equal(seconds(times), [NOON_S])

    def test_missing(self) -> None:
        missing = [np.datetime64("NaT"), NOON]
        np.testing.assert_array_equal(seconds(missing), [np.nan, NOON_S])
        np.testing.assert_array_equal(seconds(np.ma.MaskedArray([1.0, 2.0], [True, False])), [np.nan, 2.0])

    def test_dates_where_no_date_is_known(self) -> None:
        with pytest.raises(ValueError, match="must be seconds or durations from the start; instead received dates"):
            seconds([NOON], dates=False)


class TestFrames:
    """Frames of any library, and mappings, are one table."""

    @pytest.mark.parametrize("kind", [dict, pd.DataFrame, Frame])
    def test_columns(self, kind: type) -> None:
        table = table_of_columns(kind({"time_s": NOON + np.arange(2).astype("m8[s]"), "x": [1, 2]}), "the readings")
        assert table.header == ("time_s", "x")
        np.testing.assert_array_equal(table.values, [[NOON_S, 1.0], [NOON_S + 1.0, 2.0]])

    def test_masked_column(self) -> None:
        table = table_of_columns({"x": np.ma.MaskedArray([1.0, 2.0], [True, False])}, "the readings")
        np.testing.assert_array_equal(table.values, [[np.nan], [2.0]])

    def test_dates_in_place_of_numbers(self) -> None:
        with pytest.raises(InputError, match="the readings, column x: found what is not a number"):
            table_of_columns({"x": [NOON]}, "the readings")
