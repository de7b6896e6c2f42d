"""Tables that are repeated stand on the pages; a cell that differs by more than rounding is found."""

from __future__ import annotations

import datetime
import shlex

import pytest
from cyclopts import MissingArgumentError

import adcs.cli.app
import magloc.cli.app
from tests.validation import PAGES, Table, found, key, line_of, repeat, section_of, with_values
from tests.validation.tables import TABLES

APPS = {"magloc": magloc.cli.app.app, "adcs": adcs.cli.app.app}
PAGE = """# Title

## Errors

Measured 2020-01-02: `magloc map`.

| what | error | of |
|---|---|---|
| a | 1,234 of 2,000, 6.7e-4° | |
| b | 2 m | 0.5 |
"""


@pytest.mark.parametrize(
    ("cell", "values", "fresh", "agrees"),
    [
        (" 4.5–5.8 m ", [4.47, 5.84], " 4.5–5.8 m ", True),
        (" 4.5–5.8 m ", [4.47, 5.94], " 4.5–5.9 m ", False),
        (" 6.7e-4° ", [6.73e-4], " 6.7e-4° ", True),
        (" 1,536, none false ", [1540.0], " 1,540, none false ", False),
    ],
)
def test_cell(cell: str, values: list[float], fresh: str, agrees: bool) -> None:
    assert with_values(cell, values) == (fresh, agrees)


def test_fresh_page() -> None:
    cells = {("a", 1): found(r"(\d+) of (\d+)", of=1), ("b", 2): key("rows", 0, "rms", scale=100.0)}
    table = Table("errors", "Errors", ("magloc map",), cells)
    text, compared = repeat(
        PAGE, table, ['{"rows": [{"rms": 0.007}]}', "found 1234 of 2000"], datetime.date(2026, 5, 6)
    )
    assert [cell.agrees for cell in compared] == [True, False]
    assert "Measured 2026-05-06" in text
    assert "| b | 2 m | 0.7 |" in text


@pytest.mark.parametrize("table", TABLES, ids=lambda table: table.name)
class TestTables:
    def test_stand_on_their_page(self, table: Table) -> None:
        text = section_of((PAGES / f"{table.page}.md").read_text("utf-8"), table.section)[0]
        for row, column in table.cells:
            with_values(line_of(text, row).split("|")[column + 1], [0.0])

    def test_commands_are_accepted(self, table: Table) -> None:
        for command in table.commands:
            name, *arguments = shlex.split(command)
            try:
                if name in APPS:
                    APPS[name].parse_args(arguments, exit_on_error=False, print_error=False)
            except MissingArgumentError:
                pytest.fail(command)
