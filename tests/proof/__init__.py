"""Our commands and other tools on the same recordings: ``make proof``, or ``make proof ONLY="broad curibio"``.

Tables and picture of ``docs/validation/same-data.md`` are written anew, its text stays. A part without its recording,
a tool that is not installed and a part that was not asked for keep the rows of the last run.
"""

from __future__ import annotations

import contextlib
import io
import re
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

import adcs.cli.app
import magloc.cli.app
from arrays.typing import FloatArray
from magloc import core
from tests.conftest import REPOSITORY

PAGE = REPOSITORY / "docs" / "validation" / "same-data.md"
COLUMNS = ("data", "tool", "rms", "median", "p90", "worst", "wrong", "NEES", "in 95 %", "CPU time", "what it needs")
FIGURES = ("rms", "median", "p90", "worst", "wrong", "NEES")
"""Columns that are the better the smaller they are."""
NOTHING = "–"
BEGINNING, END = "<!-- proof: {name} -->", "<!-- end of proof -->"
APPS = {"magloc": magloc.cli.app.main, "adcs": adcs.cli.app.main}
NUMBER = re.compile(r"\d[\d,]*(?:\.\d+)?")


class Size(NamedTuple):
    """How much of the long recordings is used."""

    every: int = 1
    """Of the rows that a full run takes, each n-th."""
    starts: int = 20
    """Random starts of scipy's least squares."""


@dataclass(frozen=True, eq=False)
class Row:
    """How one tool did on a part of the data; errors in the part's unit, infinite where the tool has no answer."""

    case: str
    tool: str
    needs: str
    error: FloatArray
    wrong: float
    seconds: float
    nees: float | None = None
    inside: float | None = None
    rms: float | None = None
    """Of all errors, unless another mean is meant."""

    @property
    def cells(self) -> tuple[str, ...]:
        """Texts of all columns."""
        rms = float(np.sqrt(np.mean(np.square(self.error)))) if self.rms is None else self.rms
        quantiles = np.quantile(self.error, (0.5, 0.9, 1.0), method="higher") if len(self.error) else (np.nan,) * 3
        return (
            self.case,
            self.tool,
            *map(number_text, (rms, *quantiles)),
            f"{100.0 * self.wrong:.1f} %",
            NOTHING if self.nees is None else number_text(self.nees),
            NOTHING if self.inside is None else f"{100.0 * self.inside:.0f} %",
            duration(self.seconds),
            self.needs,
        )


Rows = Callable[[Path, Size], Iterator[Row]]


@dataclass(frozen=True)
class Part:
    """A recording: its folder, the unit of its errors, our rows, and those of others by the package that they need."""

    name: str
    unit: str
    wrong: str
    ours: Rows
    peers: Mapping[str, Rows]


def number_text(value: float) -> str:
    """Return a number with three significant digits, or none where there is no answer."""
    if not np.isfinite(value):
        return "none"
    if value == 0.0:
        return "0"
    digits = max(0, 2 - int(np.floor(np.log10(abs(value)))))
    return f"{value:,.{digits}f}"


def duration(seconds: float) -> str:
    """Return a time with its unit, for example ``12.3 ms``."""
    if not np.isfinite(seconds):
        return NOTHING
    unit, factor = next((u, f) for u, f in (("s", 1.0), ("ms", 1e3), ("µs", 1e6)) if seconds * f >= 1.0 or u == "µs")
    return f"{number_text(seconds * factor)} {unit}"


def value_of(cell: str) -> float | None:
    """Return the first number of a cell; infinite for no answer, None where nothing is stated."""
    if cell == "none":
        return np.inf
    found = NUMBER.search(cell)
    return float(found[0].replace(",", "")) if found else None


def row_of_errors(
    case: str, tool: str, needs: str, seconds: float, error: FloatArray, wrong: float, sigma: FloatArray | None = None
) -> Row:
    """Return the row of errors (n,), of which those beyond a limit are wrong, with their claimed σ (n,) if any."""
    error = np.where(np.isfinite(error), np.abs(error), np.inf)
    share = float(np.mean(error > wrong))
    row = Row(case, tool, needs, error, share, seconds)
    known = np.isfinite(error)
    return row if sigma is None else with_nees(row, np.square(error[known] / sigma[known]))


def with_nees(row: Row, squares: FloatArray, d: int = 1) -> Row:
    """Return a row with the consistency of its squared errors (n,) over their covariance of d dimensions."""
    return replace(row, nees=float(np.mean(squares)) / d, inside=float(np.mean(squares < chdtri(d, 0.05))))


def row_of_offsets(
    case: str,
    tool: str,
    needs: str,
    seconds: float,
    off: FloatArray,
    wrong: float,
    covariance: FloatArray | None = None,
    truth_sigma: float = 0.0,
    scale: float = 1e3,
) -> Row:
    """Return the row of offsets (n, d) with their covariance (n, d, d), to which the truth's own error is added."""
    row = row_of_errors(case, tool, needs, seconds, scale * np.linalg.norm(off, axis=1), scale * wrong)
    if covariance is None:
        return row
    known, d = np.isfinite(off).all(axis=1), off.shape[1]
    both = covariance[known] + truth_sigma**2 * np.eye(d)
    squares = np.vecdot(off[known], np.linalg.solve(both, off[known][..., None])[..., 0])
    return with_nees(row, squares, d)


def run_command(*arguments: str | Path, runs: int = 2) -> tuple[str, float]:
    """Return what a command line prints and its processor time with one thread, the shorter of two short runs.

    It runs in this process. The time has no import; it has the files that are read and the text that is printed.
    """
    name, *rest = map(str, arguments)
    before = core.threads()
    core.set_threads(1)
    try:
        shortest = np.inf
        for _ in range(runs):
            out = io.StringIO()
            began = time.process_time()
            with contextlib.redirect_stdout(out), contextlib.redirect_stderr(io.StringIO()) as err:
                status = APPS[name]([*rest, "--quiet"])
            took = time.process_time() - began
            if status:
                raise RuntimeError(f"{' '.join(map(str, arguments))} ended with status {status}: {err.getvalue()}")
            shortest = min(shortest, took)
            if took > 5.0:
                break
    finally:
        core.set_threads(before)
    return out.getvalue(), shortest


def table(part: Part, rows: Iterable[Sequence[str]], stated: str) -> str:
    """Return the table of a part in Markdown, with what is stated below it."""
    heading = [f"{name} [{part.unit}]" if name in FIGURES[:4] else name for name in COLUMNS]
    return "\n".join([*table_lines(heading, rows), "", stated])


def table_lines(heading: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Return the lines of a table in Markdown."""
    first, *others = ("| " + " | ".join(line) + " |" for line in [heading, *rows])
    return [first, "|" + "---|" * len(heading), *others]


def rows_of(text: str) -> list[list[str]]:
    """Return the cells of all rows of a table in Markdown, without its heading."""
    lines = [line for line in text.splitlines() if line.startswith("| ")]
    return [[cell.strip() for cell in line.strip("| ").split(" | ")] for line in lines[1:]]


def block(page: str, name: str) -> str:
    """Return the text that is generated for a name on the page."""
    _, found, after = page.partition(BEGINNING.format(name=name))
    if not found:
        raise ValueError(f"expected {BEGINNING.format(name=name)} on {PAGE.name}")
    return after.partition(END)[0]


def with_block(page: str, name: str, text: str) -> str:
    """Return the page with another generated text."""
    mark = BEGINNING.format(name=name)
    return page.replace(f"{mark}{block(page, name)}{END}", f"{mark}\n\n{text}\n\n{END}")


def merge_rows(fresh: Sequence[Sequence[str]], stored: Sequence[Sequence[str]]) -> list[list[str]]:
    """Return the fresh rows, each case with the stored rows of tools that were not run."""
    cases = list(dict.fromkeys(row[0] for row in [*fresh, *stored]))
    done = {tuple(row[:2]) for row in fresh}
    rows = [*fresh, *(row for row in stored if tuple(row[:2]) not in done)]
    return [list(row) for case in cases for row in rows if row[0] == case]


def is_ours(row: Sequence[str]) -> bool:
    """Return whether a row is of a command or function of ours."""
    return row[1].startswith(("`magloc", "`adcs"))


def better_peers(page: str, parts: Iterable[Part]) -> list[list[str]]:
    """Return part, data, the best other tool and its figures (ours), where they are better than our first row."""
    found: dict[tuple[str, str, str], list[str]] = {}
    for part in parts:
        rows = rows_of(block(page, part.name))
        for case in dict.fromkeys(row[0] for row in rows):
            ours = next((row for row in rows if row[0] == case and is_ours(row)), None)
            peers = [row for row in rows if row[0] == case and not is_ours(row)]
            for name in FIGURES[:5] if ours else ():
                column = COLUMNS.index(name)
                values = [(value_of(row[column]), row) for row in peers]
                known = [(value, row) for value, row in values if value is not None]
                best, row = min(known, key=lambda each: each[0], default=(np.inf, []))
                own = value_of(ours[column]) if ours else None
                if ours and own is not None and best < own:
                    unit = "" if name == "wrong" else f"{'' if part.unit in '°″' else ' '}{part.unit}"
                    text = f"{name} {row[column]}{unit} ({ours[column]})"
                    found.setdefault((part.name, case, row[1]), []).append(text)
    return [[*key, ", ".join(figures)] for key, figures in found.items()]
