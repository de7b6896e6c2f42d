"""Lines of text above a header are named, with the cure."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from arrays.io.csv import table_of_header, table_of_text
from arrays.io.errors import InputError
from arrays.io.values import plain_numbers

GOOD = "time_s,a_nT,b_nT\n0,1,2\n1,3,4\n"


class TestLinesAboveTheHeader:
    @pytest.mark.parametrize(
        ("above", "n"),
        [
            ("Magnetometer log\n", 1),
            ("Site, A\nRun, 7\n\n", 3),
            ("# made by a logger\n# on 2026-05-12, 09:14\n", 2),
            ("serial number,1234,5,6\n", 1),
            ("a,b,c\nd,e,f\n", 2),
        ],
    )
    def test_are_counted(self, above: str, n: int) -> None:
        lines = "1 line" if n == 1 else f"{n} lines"
        with pytest.raises(InputError, match=rf"^log\.csv: found {lines} of text before the header on line {n + 1},"):
            table_of_text(above + GOOD, "log.csv", "a header")

    @given(st.lists(st.text("abc xyz:-#", min_size=1).filter(str.strip), min_size=1, max_size=20))
    def test_are_never_taken_for_it(self, above: list[str]) -> None:
        with pytest.raises(InputError, match="of text before the header"):
            table_of_text("\n".join([*above, GOOD]), "log.csv", "a header")

    @given(st.lists(st.tuples(*[st.one_of(st.floats(-1e9, 1e9).map(str), st.just(""))] * 2), min_size=1, max_size=9))
    def test_a_good_file_has_none(self, cells: list[tuple[str, str]]) -> None:
        rows = "".join(f"{i},{a},{b}\n" for i, (a, b) in enumerate(cells))
        assert table_of_text("time_s,a,b\n" + rows, "log.csv", "a header").values.shape == (len(cells), 3)


class TestPlainNumbers:
    """The quick reader of texts of nothing but numbers, against the reader of single cells."""

    @given(st.data())
    def test_as_cell_by_cell(self, data: st.DataObject) -> None:
        separator, decimal = data.draw(st.sampled_from([(",", "."), (";", ","), ("\t", "."), (";", ".")]))
        whole = st.integers(-99999, 99999).map("{:+}".format)
        cell = (
            st.floats(allow_nan=False).map(repr)
            | whole
            | st.sampled_from(["", " ", "-", "1e", "1 2", "1_0", "1-2", "*"])
        )
        rows = data.draw(st.lists(st.lists(cell, min_size=3, max_size=3).map(separator.join) | st.just(""), max_size=5))
        text = "\n".join(rows).replace(".", decimal)
        head = table_of_header(separator.join("abc"), "log", "names", separator=separator)
        form: dict[str, Any] = {"first_line": 5, "head": head, "marks": (separator, decimal)}
        quick = plain_numbers(text, separator, decimal, 3)
        try:
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr("arrays.io.csv.plain_numbers", lambda *_: None)
                table = table_of_text(text, "log", "names", **form)
        except InputError:
            assert quick is None
            return
        if quick is not None:
            np.testing.assert_array_equal(quick[0], table.values)
            np.testing.assert_array_equal(quick[1] + 5, table.line_numbers)
        np.testing.assert_array_equal(table_of_text(text, "log", "names", **form).values, table.values)

    def test_reads_most_texts(self) -> None:
        found = plain_numbers("1,-2.5\n\n+3e-2,4\n", ",", ".", 2)
        assert found is not None
        assert (found[0].tolist(), found[1].tolist()) == ([[1.0, -2.5], [0.03, 4.0]], [0, 2])
