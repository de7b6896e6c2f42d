"""Texts of loggers: the rows are those of the same log without all that stands around them."""

from __future__ import annotations

import logging

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from arrays.columns import LogColumns
from arrays.io.csv import Table
from arrays.io.errors import InputError
from arrays.logs.format import LogFormat
from arrays.logs.lines import line_starts

ROWS = [[0.0, 48.5, 1.0], [1.0, 48.6, 2.0], [2.0, np.nan, 3.0]]


def read(text: str, **columns: object) -> Table:
    said = {"time": "t", "sensors": {"a": "Mag", "b": "B"}} | columns
    return LogFormat({"a": ["a_nT"], "b": ["b_nT"]}, LogColumns(**said), "a header", ()).table(text, "log.csv")  # type: ignore[arg-type]


def rows_of(table: Table) -> np.ndarray:
    return table.values[:, [table.header.index(name) for name in ("time_s", "a_nT", "b_nT")]]


LOGS = {
    "plain": ("t,Mag,B\n0,48.5,1\n1,48.6,2\n2,,3\n", {}),
    "preamble": ('Made by "us, 7\nserial,12\n\nt,Mag,B\n0,48.5,1\n1,48.6,2\n2,,3\n', {}),
    "mark before the header": ("# t,Mag,B\n#units below\n0,48.5,1\n  # pause\n1,48.6,2\n2,,3\n", {}),
    "several marks": ("! x\n/ t,Mag,B\n0,48.5,1\n!\n1,48.6,2\n2,,3", {"comment": ("!", "/")}),
    "names of lines": ("t,Mag,B\nLine 10\n0,48.5,1\n/L20\n1,48.6,2\n2,,3", {"skip": ("Line", "/L")}),
    "repeated header": ("t,Mag,B\n0,48.5,1\nt,Mag,B\n1,48.6,2\nt,Mag,B\n2,,3\n", {}),
    "joined files with marks": ("\ufefft,Mag,B\n0,48.5,1\n\ufefft,Mag,B\n1,48.6,2\n\ufeff2,,3\n", {}),
    "row of units": ("t,Mag,B\n[s],nT,\n0,48.5,1\n1,48.6,2\n2,,3\n", {}),
    "separators at the end": ("t;Mag;B;\r\n0;48.5;1;;\r\n1;48.6;2;\r\n2;;3;\r\n", {"separator": "semicolon"}),
    "short rows": ("t,Mag,B,Remark,More\n0,48.5,1,x,y\n1,48.6,2,x\n2,,3,\n", {}),
    "a second column of a name": ("x,t,Mag,B,x\n7,0,48.5,1,7\n7,1,48.6,2,7\n7,2,,3,7\n", {}),
    "runs of blanks": (
        " t   Mag\tB \n 0 48.5   1 \n1  48.6\t2\n 2  *  3\n",
        {"separator": "space", "dummy": ("*",)},
    ),
    "no header": ("/ me\n\n0,48.5,1\n1,48.6,2\n2,,3\n", {"names": ("t", "Mag", "B"), "comment": ("/",)}),
    "a header of fewer names": (
        "%  GPST  lat B\n"
        + "".join(f"2026/05/12 00:00:0{k}.0 {row}\n" for k, row in enumerate(("48.5 1", "48.6 2", "* 3"))),
        {
            "names": ("d", "t", "Mag", "B"),
            "separator": "space",
            "time": ("d", "t"),
            "time_unit": "iso",
            "comment": ("%",),
        },
    ),
    "decimal commas": ("t;Mag;B\n0;48,5;1\n1;48,6;2,0\n2;;3\n", {"separator": "semicolon", "decimal": ","}),
}


class TestRows:
    @pytest.mark.parametrize("name", LOGS)
    def test_are_those_of_the_log(self, name: str) -> None:
        text, columns = LOGS[name]
        found = rows_of(read(text, **columns))
        found[:, 0] -= 1778544000.0 if found[0, 0] else 0.0
        np.testing.assert_array_equal(np.where(found > 1e30, np.nan, found), ROWS)

    @given(st.lists(st.text('abc xyz,:-#"', max_size=20), max_size=20))
    def test_lines_above_change_nothing(self, above: list[str]) -> None:
        text = "".join(f"{line}\n" for line in above) + "t,Mag,B\n0,48.5,1\n1,48.6,2\n2,,3\n"
        table = read(text)
        np.testing.assert_array_equal(rows_of(table), ROWS)
        assert table.header_line == len(above) + 1
        assert table.line_numbers.tolist() == [len(above) + k for k in (2, 3, 4)]

    def test_what_is_left_out_is_named(self, caplog: pytest.LogCaptureFixture) -> None:
        caplog.set_level(logging.INFO)
        table = read("log\nt,Mag,B\ns,nT,nT\n#\nt,Mag,B\n0,48.5,1\n#\n1,48.6,2\n2,,3\n")
        assert table.line_numbers.tolist() == [6, 8, 9]
        for words in ("header is on line 2", "1 lines of repeated headers", "2 lines of remarks", "row of units"):
            assert words in caplog.text

    def test_another_header(self) -> None:
        """A logger that was started again with another setting."""
        with pytest.raises(InputError, match="line 5: found a second header with other columns, expected one header"):
            read("log\nt,Mag,B\n0,48.5,1\n1,48.6,2\nt,B,Mag\n2,3,48.6\n")

    def test_a_row_cut_at_the_end(self, caplog: pytest.LogCaptureFixture) -> None:
        """The battery was empty: the last number may be half of one."""
        assert rows_of(read("t,Mag,B\n0,48.5,1\n1,48.6,2\n2,48")).tolist() == ROWS[:2]
        assert "the last row is incomplete and is left out" in caplog.text


class TestBadLogs:
    @pytest.mark.parametrize(
        ("text", "words"),
        [
            ("t,Mag,B\n0,48.5,1\n1,48\n2,48.5,1\n", "line 3: found 2 cells, expected 3 as in the header"),
            ("t,Mag,B\n0,48.5,1,7\n1,48,1\n", "line 2: found 4 cells, expected 3"),
            ("t,Mag,B\n0,48.5,1\nL10\n1,48,1\n", "line 3: found 1 cells, expected 3"),
            ("log\n\nt,Mag,C\n0,48.5,1\n", "line 3, column B: found no such column"),
            ("t,Mag,B,B\n0,48.5,1,1\n", "line 1, column B: found a second time"),
            ("t,Mag,B\n# nothing\n", "line 1: found a header without rows"),
            ("t;Mag;B\n0;48.5;1\n", "separated by semicolons, expected commas"),
            ("", "is empty"),
        ],
    )
    def test_have_a_place(self, text: str, words: str) -> None:
        with pytest.raises(InputError, match=words):
            read(text)


class TestNames:
    def test_no_row_that_fits(self) -> None:
        with pytest.raises(InputError, match=r"no row with numbers in t, Mag, B, expected rows of the 4 columns"):
            read("a\n1,2,3\n", names=("x", "t", "Mag", "B"))

    def test_a_column_that_is_not_named(self) -> None:
        with pytest.raises(InputError, match=r"key columns\.names: found 'B' 0 times"):
            read("1,2,3\n", names=("t", "Mag"))


class TestLinesOfASurvey:
    @pytest.mark.parametrize(
        ("text", "columns", "expected"),
        [
            (
                "t,Mag,B\n0,1,1\nLine 10\n1,2,2\n2,2,2\n/line  007\n3,4,4\n",
                {"skip": ("Line", "/line")},
                [(0.0, ""), (1.0, "10"), (3.0, "007")],
            ),
            ("t,Mag,B\nL1:A\n0,1,1\n1,2,2\nT1\n2,2,2\n3,4,4\n", {"skip": ("L1", "T")}, [(0.0, "L1:A"), (2.0, "T1")]),
            ("t,Mag,B,n\n0,1,1,10\n1,2,2,10\n2,2,2,12.5\n3,4,4,12.5\n", {"line": "n"}, [(0.0, "10"), (2.0, "12.5")]),
            (
                "t,Mag,B,n\n0,1,1,A 1\n1,2,2,A 1\n2,2,2,B\n3,4,4,A 1\n",
                {"line": "n"},
                [(0.0, "A 1"), (2.0, "B"), (3.0, "A 1")],
            ),
            ("t,Mag,B\n0,1,1\n", {"skip": ("Line",)}, []),
        ],
    )
    def test_have_the_names_of_the_log(
        self, text: str, columns: dict[str, object], expected: list[tuple[float, str]]
    ) -> None:
        assert line_starts(read(text, **columns)) == tuple(expected)
