"""Tables of docs/validation that commands of minutes make: repeated, and compared with the page.

``make validation``, or ``make validation ONLY=Kalman`` for the sections whose names have that word. The page's table is
the stored one. Fresh pages, with today's date, are written to build/validation.
"""

from __future__ import annotations

import datetime
import json
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from tempfile import TemporaryDirectory
from typing import NamedTuple

from tests.conftest import REPOSITORY

PAGES = REPOSITORY / "docs" / "validation"
FRESH = REPOSITORY / "build" / "validation"
NUMBER = re.compile(r"(?<![\w.])[-−]?\d(?:\d|,(?=\d{3}))*(?:\.\d+)?(?:e-?\d+)?")
DATE = re.compile(r"20\d\d-\d\d-\d\d")

Reader = Callable[[Sequence[str]], Sequence[float]]
"""Numbers of a cell, from what the commands print."""


@dataclass(frozen=True)
class Table:
    """A table of a section, the command lines that make it, and the cells that they tell: (row, column) to reader."""

    page: str
    section: str
    commands: tuple[str, ...]
    cells: dict[tuple[str, int], Reader]

    @property
    def name(self) -> str:
        return f"{self.page}: {self.section}"


class Compared(NamedTuple):
    """A cell of a table: as stored and as measured now."""

    place: str
    stored: str
    fresh: str
    agrees: bool


def key(*path: str | int, of: int = 0, scale: float = 1.0) -> Reader:
    """Reader of one number in the JSON of a command."""

    def read(outputs: Sequence[str]) -> list[float]:
        value = json.loads(outputs[of])
        for part in path:
            value = value[part]
        return [scale * value]

    return read


def found(pattern: str, of: int = 0) -> Reader:
    """Reader of the groups of a pattern in the text of a command."""

    def read(outputs: Sequence[str]) -> list[float]:
        match = re.search(pattern, outputs[of])
        if match is None:
            raise ValueError(f"expected {pattern} in what the command prints; instead found {outputs[of][-300:]!r}")
        return [float(group) for group in match.groups()]

    return read


def section_of(page: str, section: str) -> re.Match[str]:
    """Section of a page's text, from its heading to the next one."""
    match = re.search(rf"^## {re.escape(section)}\n.*?(?=^## |\Z)", page, re.DOTALL | re.MULTILINE)
    if match is None:
        raise ValueError(f"expected a section {section!r}")
    return match


def line_of(text: str, row: str) -> str:
    """Line of the one row with that first cell in the tables of a section."""
    lines = [line for line in text.splitlines() if line.startswith(f"| {row} |")]
    if len(lines) != 1:
        raise ValueError(f"expected one row {row!r}; instead found {len(lines)}")
    return lines[0]


def unit_of(number: str) -> float:
    """Size of the last digit of a number as it is written."""
    mantissa, _, exponent = number.partition("e")
    return 10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2]))


def value_of(number: str) -> float:
    return float(number.replace(",", "").replace("−", "-"))


def written_like(number: str, value: float) -> str:
    """Value with the digits of a number that is written already."""
    mantissa, _, exponent = number.partition("e")
    decimals = len(mantissa.partition(".")[2])
    if exponent:
        return f"{value / 10.0 ** int(exponent):.{decimals}f}e{exponent}"
    return f"{value:{',' if ',' in number else ''}.{decimals}f}"


def with_values(cell: str, values: Sequence[float]) -> tuple[str, bool]:
    """Cell with fresh numbers in place of its first ones, and whether all agree within one unit of the last digit."""
    stored = list(NUMBER.finditer(cell))[: len(values)]
    if len(stored) < len(values):
        raise ValueError(f"expected {len(values)} numbers in the cell {cell!r}")
    agrees = all(abs(value_of(m[0]) - value) <= 1.01 * unit_of(m[0]) for m, value in zip(stored, values, strict=True))
    for match, value in reversed(list(zip(stored, values, strict=True))):
        cell = cell[: match.start()] + written_like(match[0], value) + cell[match.end() :]
    return cell, agrees


def repeat(page: str, table: Table, outputs: Sequence[str], today: datetime.date) -> tuple[str, list[Compared]]:
    """Page with the fresh cells and date of a table, and the comparison of each cell."""
    match = section_of(page, table.section)
    text, compared = match[0], []
    for (row, column), read in table.cells.items():
        line = line_of(text, row)
        cells = line.split("|")
        stored = cells[column + 1]
        cells[column + 1], agrees = with_values(stored, read(outputs))
        compared.append(Compared(f"{row}, column {column}", stored.strip(), cells[column + 1].strip(), agrees))
        text = text.replace(line, "|".join(cells))
    text = DATE.sub(str(today), text, count=1)
    return page[: match.start()] + text + page[match.end() :], compared


def run(commands: Sequence[str]) -> list[str]:
    """Standard output of command lines, one after the other in an empty folder."""
    modules = {"magloc": ["-m", "magloc.cli"], "adcs": ["-m", "adcs.cli"], "python": []}
    path = os.pathsep.join([str(REPOSITORY), os.environ.get("PYTHONPATH", "")])
    outputs = []
    with TemporaryDirectory() as folder:
        for command in commands:
            name, *arguments = shlex.split(command)
            line = [sys.executable, *modules[name], *arguments]
            done = subprocess.run(line, cwd=folder, env={**os.environ, "PYTHONPATH": path}, stdout=subprocess.PIPE)
            if done.returncode:
                raise RuntimeError(f"{command} ended with status {done.returncode}")
            outputs.append(done.stdout.decode("utf-8"))
    return outputs


def main(only: str, tables: Sequence[Table]) -> int:
    """Repeat the tables whose names contain a word; 1 if a cell differs by more than rounding."""
    chosen = [table for table in tables if only.lower() in table.name.lower()]
    if not chosen:
        print(f"no table has {only!r} in its name: " + "; ".join(table.name for table in tables))
        return 2
    FRESH.mkdir(parents=True, exist_ok=True)
    differing = 0
    pages = {table.page: (PAGES / f"{table.page}.md").read_text("utf-8") for table in chosen}
    for table in chosen:
        fresh, compared = repeat(pages[table.page], table, run(table.commands), datetime.date.today())
        pages[table.page] = fresh
        (FRESH / f"{table.page}.md").write_text(fresh, "utf-8")
        print(f"\n{table.name}\n\n| row | stored | fresh | |\n|---|---|---|---|")
        for cell in compared:
            print(f"| {cell.place} | {cell.stored} | {cell.fresh} | {'' if cell.agrees else 'differs'} |", flush=True)
        differing += sum(not cell.agrees for cell in compared)
    print(f"\n{differing} cells differ by more than rounding; fresh pages are in {FRESH.relative_to(REPOSITORY)}")
    return int(differing > 0)
