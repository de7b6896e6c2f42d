"""The page of the same data: its tables are read back as they are written, and our rows are those of today.

Our rows are run anew where the recordings are there. No figure may be more than 10 % worse than the page's.
"""

from __future__ import annotations

import datetime
from pathlib import Path

import numpy as np
import pytest

from tests.proof import (
    COLUMNS,
    FIGURES,
    PAGE,
    Part,
    Row,
    Size,
    better_peers,
    block,
    is_ours,
    merge_rows,
    number_text,
    row_of_errors,
    row_of_offsets,
    rows_of,
    table,
    value_of,
    with_block,
)
from tests.proof.__main__ import QUICK, run
from tests.proof.parts import PARTS

MARGIN = 1.1
STATED = "Wrong: beyond 5 mm. Measured 2026-01-02."


def part_of(*rows: Row, peers: tuple[Row, ...] = ()) -> Part:
    return Part("made-up", "mm", "beyond 5 mm", lambda *_: iter(rows), {"scipy": lambda *_: iter(peers)})


def row(tool: str, median: float, case: str = "run 1") -> Row:
    return Row(case, tool, "file", np.array([median]), 0.0, 1e-3)


OURS, PEER = row("`magloc locate`", 0.2), row("scipy", 0.1)
EMPTY = "text\n\n<!-- proof: made-up -->\n<!-- end of proof -->\n\nmore\n"


class TestTables:
    def test_read_back(self) -> None:
        cells = [list(OURS.cells), list(PEER.cells)]
        page = with_block(EMPTY, "made-up", table(part_of(), cells, STATED))
        assert rows_of(block(page, "made-up")) == cells
        assert page.startswith("text\n")
        assert page.endswith("more\n")

    @pytest.mark.parametrize(
        ("value", "text"), [(0.0951, "0.0951"), (12345.6, "12,346"), (1.0, "1.00"), (np.inf, "none"), (0.0, "0")]
    )
    def test_numbers(self, value: float, text: str) -> None:
        assert number_text(value) == text
        assert value_of(text) == pytest.approx(value, rel=5e-3)

    def test_rows_of_others_stay(self) -> None:
        """A run without scipy replaces our row and keeps the other, beside the case that it is of."""
        stored = [["run 1", "`magloc locate`", "old"], ["run 1", "scipy", "old"], ["run 2", "scipy", "old"]]
        fresh = [["run 1", "`magloc locate`", "new"]]
        assert merge_rows(fresh, stored) == [fresh[0], *stored[1:]]

    def test_better_ones_come_first(self) -> None:
        page = with_block(EMPTY, "made-up", table(part_of(), [OURS.cells, PEER.cells], STATED))
        found = better_peers(page, [part_of()])
        assert found[0][:3] == ["made-up", "run 1", "scipy"]
        assert found[0][3].startswith("rms 0.100 mm (0.200), median 0.100 mm (0.200), p90")

    def test_none_is_better(self) -> None:
        page = with_block(EMPTY, "made-up", table(part_of(), [PEER.cells, row("`magloc locate`", 0.05).cells], STATED))
        assert better_peers(page, [part_of()]) == []

    def test_a_tool_that_is_missing_is_named(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        def missing(*_: object) -> None:
            raise ModuleNotFoundError("no module", name="vqf")

        part = Part("made-up", "mm", "beyond 5 mm", lambda *_: iter([OURS]), {"vqf": missing})
        page = with_block(EMPTY, "made-up", table(part, [PEER.cells], STATED))
        page = run(page, part, tmp_path, QUICK, peers=True)
        assert "skipped: vqf is not installed" in capsys.readouterr().err
        assert [line[1] for line in rows_of(block(page, "made-up"))] == ["`magloc locate`", "scipy"]
        assert str(datetime.date.today()) in page


class TestFigures:
    def test_errors_without_an_answer_are_wrong(self) -> None:
        found = row_of_errors("", "", "", 1.0, np.array([1.0, np.nan, 9.0, 2.0]), 5.0)
        assert found.wrong == 0.5
        assert found.cells[COLUMNS.index("worst")] == "none"

    def test_nees_of_true_sigmas(self) -> None:
        """The mean of 3·4000 squares is 1 with a standard deviation of √(2/12000): five of them, 1 false in 10⁶."""
        rng = np.random.default_rng(3)
        sqrt = np.array([[1.0, 0.0, 0.0], [0.5, 2.0, 0.0], [0.1, 0.3, 0.2]]) * 1e-3
        off = rng.normal(size=(4000, 3)) @ sqrt.T
        found = row_of_offsets("", "", "", 1.0, off, 1.0, np.tile(sqrt @ sqrt.T, (4000, 1, 1)))
        assert found.nees == pytest.approx(1.0, abs=5.0 * np.sqrt(2.0 / 12000))
        assert found.inside == pytest.approx(0.95, abs=5.0 * np.sqrt(0.95 * 0.05 / 4000))


@pytest.mark.parametrize("part", PARTS, ids=lambda part: part.name)
class TestPage:
    def test_has_the_part(self, part: Part) -> None:
        rows = rows_of(block(PAGE.read_text(encoding="utf-8"), part.name))
        assert any(is_ours(line) for line in rows)
        assert any(not is_ours(line) for line in rows)
        assert all(len(line) == len(COLUMNS) for line in rows)

    @pytest.mark.slow
    def test_our_figures_are_at_most_a_tenth_worse(self, part: Part, data_folder: Path) -> None:
        if not (data_folder / part.name).is_dir():
            pytest.skip(f"needs the recording {part.name}")
        stored = {tuple(line[:2]): line for line in rows_of(block(PAGE.read_text(encoding="utf-8"), part.name))}
        worse = []
        for fresh in part.ours(data_folder, Size()):
            line = stored[fresh.cells[:2]]
            for name in FIGURES:
                column = COLUMNS.index(name)
                now, then = value_of(fresh.cells[column]), value_of(line[column])
                if now is not None and then is not None and now > MARGIN * then:
                    worse.append((*fresh.cells[:2], name, line[column], fresh.cells[column]))
        assert worse == []


def test_summary_is_that_of_the_tables() -> None:
    page = PAGE.read_text(encoding="utf-8")
    assert rows_of(block(page, "better")) == better_peers(page, PARTS)
