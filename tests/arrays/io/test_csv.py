"""Lines of text above a header are named, with the cure."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from arrays.io.csv import table_of_text
from arrays.io.errors import InputError

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
