"""Clocks of loggers against the calendar of Python."""

from __future__ import annotations

import datetime

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from arrays.columns import LogColumns
from arrays.io.errors import InputError
from arrays.logs.format import LogFormat
from arrays.typing import FloatArray


def times(*cells: str, **columns: object) -> FloatArray:
    said = LogColumns(time="t", **({"time_unit": "iso"} | columns))  # type: ignore[arg-type]
    text = "\n".join(["t,a_nT", *(f"{cell},1" for cell in cells)])
    return LogFormat({"a": ["a_nT"]}, said, "a header", ()).table(text, "log.csv").values[:, 1]


class TestTimesOfDay:
    @given(st.times())
    def test_count_from_midnight(self, of_day: datetime.time) -> None:
        midnight = datetime.datetime(2026, 5, 12, tzinfo=datetime.UTC)
        instant = datetime.datetime.combine(midnight, of_day, datetime.UTC)
        expected = (instant - midnight).total_seconds()
        number = of_day.strftime("%H%M%S.%f")
        for cell, unit in ((of_day.isoformat(), "iso"), (number, "hhmmss")):
            assert times(cell, time_unit=unit) == pytest.approx(expected, abs=1e-6)
            assert times(cell, time_unit=unit, date="2026-05-12") == pytest.approx(instant.timestamp(), abs=1e-6)

    @pytest.mark.parametrize("cells", [("23:59:59.5", "0:00:00.5", "00:00:01"), ("235959.5", "000000.5", "1")])
    def test_midnight_passes(self, cells: tuple[str, ...]) -> None:
        found = times(*cells, time_unit="iso" if ":" in cells[0] else "hhmmss")
        np.testing.assert_allclose(found, [86399.5, 86400.5, 86401.0])

    @pytest.mark.parametrize("cell", ["096000", "250000", "-1"])
    def test_no_time_of_day(self, cell: str) -> None:
        with pytest.raises(InputError, match="line 2, column t: found no time of day"):
            times(cell, time_unit="hhmmss")

    def test_a_date_beside_dates(self) -> None:
        """The date of the log itself is accepted, another one is not."""
        assert times("2026-05-12T09:14:03", date="2026-05-12") == times("2026-05-12T09:14:03")
        with pytest.raises(InputError, match="column t: found 2026-05-12, expected the date 2026-06-12"):
            times("2026-05-12T09:14:03", date="2026-06-12")

    def test_of_a_log_without_times(self) -> None:
        columns = LogColumns(time_unit="rows", sensors={"a": "F"})
        table = LogFormat({"a": ["a_nT"]}, columns, "a header", ()).table("F\n1\n2\n3", "log.csv")
        assert table.values[:, table.header.index("time_s")].tolist() == [0.0, 1.0, 2.0]


class TestDates:
    @pytest.mark.parametrize("cell", ["12/05/2026 09:14:03", "12.5.2026T09:14:03", "12-05-2026 9:14:03"])
    def test_day_or_month_first(self, cell: str) -> None:
        for day_first, (month, day) in ((True, (5, 12)), (False, (12, 5))):
            instant = datetime.datetime(2026, month, day, 9, 14, 3, tzinfo=datetime.UTC)
            assert times(cell, day_first=day_first).tolist() == [instant.timestamp()]

    @pytest.mark.parametrize("cell", ["5-Dec-2026 09:14:03", "05DEC26T9:14:03", "05 December 2026 09:14:03"])
    def test_named_month(self, cell: str) -> None:
        assert times(cell).tolist() == [datetime.datetime(2026, 12, 5, 9, 14, 3, tzinfo=datetime.UTC).timestamp()]

    @pytest.mark.parametrize(("year", "whole"), [("70", 1970), ("99", 1999), ("26", 2026), ("69", 2069)])
    def test_year_of_two_digits(self, year: str, whole: int) -> None:
        expected = datetime.datetime(whole, 5, 12, 9, 14, tzinfo=datetime.UTC).timestamp()
        assert times(f"05/12/{year} 09:14", day_first=False).tolist() == [expected]

    def test_none_is_guessed(self) -> None:
        with pytest.raises(InputError, match="line 2, column t: found '13/05/2026 09:14:03', which may begin"):
            times("13/05/2026 09:14:03")


class TestWholeSeconds:
    @pytest.mark.parametrize("first", [0, 3])
    def test_are_spread(self, first: int, caplog: pytest.LogCaptureFixture) -> None:
        """Five rows a second, of which the first ones and the last one are not there."""
        true_s = 0.2 * np.arange(first, 24)
        found = times(*(str(int(t + 1e-9)) for t in true_s), time_unit="s")
        np.testing.assert_allclose(found, true_s, atol=1e-9)
        assert "whole seconds that rows share" in caplog.text

    @pytest.mark.parametrize("cells", [("0", "0"), ("0", "1", "1", "2", "3"), ("0.5", "0.5", "1.5", "1.5")])
    def test_a_time_twice_is_none(self, cells: tuple[str, ...]) -> None:
        with pytest.raises(InputError, match="expected every value once"):
            times(*cells, time_unit="s")
