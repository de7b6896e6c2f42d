"""Tables of numbers from CSV files, with errors that name line and column.

The first line names the columns; every other line has a number or an empty cell for each of them. A byte order mark,
any line ends, blank lines and spaces around cells are tolerated.
"""

from __future__ import annotations

import csv
import difflib
import io
import itertools
import logging
import math
from array import array as packed
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from arrays.io.errors import LARGEST, InputError
from arrays.io.text import read_text, write_text
from arrays.io.values import SHOWN_CHARACTERS, numbers, plain_numbers, seconds, unix_seconds
from arrays.typing import FloatArray, IntArray

_LOG = logging.getLogger(__name__)
LATEST_S = 1e11
"""Largest modulus of a time; microseconds since 1970 would be beyond it."""
_HEAD_CHARACTERS = 2**16
_MOST_LINES_ABOVE = 100
_SEPARATORS = {",": "commas", ";": "semicolons", "\t": "tabs", " ": "blanks"}
DUMMY = math.nextafter(1e32, math.inf)
"""Number that marks a word for a missing value; no reading has it."""
_DUMMY_WORDS = frozenset({"*"})
_MISSING_WORDS = frozenset(
    ("#N/A", "#N/A N/A", "#NA", "-1.#IND", "-1.#QNAN", "1.#IND", "1.#QNAN", "<NA>", "N/A", "NA", "NULL", "None", "n/a")
) | {"null"}
"""Words that pandas accepts as missing, without those of float()."""


@dataclass(frozen=True, eq=False)
class Table:
    """Table of numbers, from a CSV file or from columns in memory.

    Attributes
    ----------
    header : tuple of str
        Names of the columns, without repetition.
    header_line : int, optional
        Line of the names in a file.
    values : ndarray, shape (n, columns)
        Values; NaN for an empty cell.
    line_numbers : ndarray of int, shape (n,)
        Line of every row in an editor; for columns in memory the row, from 1.
    labels : tuple of str
        Names of survey lines by the numbers in a column for them; empty if the numbers are the names.
    """

    path: str
    header: tuple[str, ...]
    header_line: int | None
    values: FloatArray
    line_numbers: IntArray
    labels: tuple[str, ...] = ()

    def row_place(self, row: int) -> str:
        """Return the place of a row, counted from 0, for an error."""
        return f"{self.path}, {'row' if self.header_line is None else 'line'} {self.line_numbers[row]}"

    def place(self, row: int, column: str) -> str:
        """Return the place of a cell, for an error."""
        return f"{self.row_place(row)}, column {_short_name(column)}"

    @cached_property
    def _index(self) -> dict[str, int]:
        return {name: i for i, name in enumerate(self.header)}

    def header_place(self, column: str) -> str:
        """Return the place of a column's name, for an error."""
        line = "" if self.header_line is None else f", line {self.header_line}"
        return f"{self.path}{line}, column {_short_name(column)}"

    def require(self, column: str, known: Sequence[str]) -> None:
        """Refuse a missing column; the error has the nearest unknown name in the file."""
        if column in self.header:
            return
        nearest = difflib.get_close_matches(column, [name for name in self.header if name not in known], n=1)
        hint = f" (the nearest is {_short_name(nearest[0])})" if nearest else ""
        names = self.header if len(self.header) < 9 else [*self.header[:6], "…", self.header[-1]]
        there = ", ".join(_short_name(name) for name in names)
        raise InputError(f"{self.header_place(column)}: found no such column{hint}, expected it beside {there}.")

    def refuse_unknown(self, known: Sequence[str]) -> None:
        """Refuse unknown columns."""
        for name in self.header:
            if name not in known:
                raise InputError(
                    f"{self.header_place(name)}: found an unknown column, expected one of {', '.join(known)}."
                )

    def has_group(self, columns: Sequence[str]) -> bool:
        """Return whether the file has these columns; refuse a part of them."""
        present = [name for name in columns if name in self.header]
        missing = [name for name in columns if name not in self.header]
        if present and missing:
            raise InputError(
                f"{self.header_place(missing[0])}: found {', '.join(present)} without it, expected all or none of them."
            )
        return bool(present)

    def finite_or_missing(self, columns: Sequence[str], largest: float = LARGEST) -> FloatArray:
        """Return the values of columns (n, k); refuse infinite values and values above the largest."""
        values = self.values[:, [self._index[name] for name in columns]]
        self.refuse(np.isinf(values), columns, "found an infinite number, expected a finite number or an empty cell")
        self._refuse_larger(values, columns, largest)
        return values

    def complete(self, columns: Sequence[str], largest: float = LARGEST) -> FloatArray:
        """Return the values of columns (n, k); refuse missing values and values above the largest."""
        values = self.values[:, [self._index[name] for name in columns]]
        self.refuse(np.isnan(values) | (values == DUMMY), columns, "found no value, expected a number")
        self.refuse(np.isinf(values), columns, "found an infinite number, expected a finite number")
        self._refuse_larger(values, columns, largest)
        return values

    def complete_and_distinct(self, column: str) -> FloatArray:
        """Return the values of a column (n,); refuse missing, infinite and repeated values."""
        values = self.complete([column])[:, 0]
        order = np.argsort(values, kind="stable")
        repeated = order[1:][np.diff(values[order]) == 0.0]
        if repeated.size:
            second = repeated.min()
            first = np.flatnonzero(values == values[second])[0]
            raise InputError(
                f"{self.place(second, column)}: found {values[second]:.15g} "
                f"as on {self.row_place(first).removeprefix(self.path + ', ')}, expected every value once."
            )
        return values

    def refuse_late(self, column: str, time_s: FloatArray) -> None:
        """Refuse times (n,) [s] that no clock shows."""
        late = np.abs(time_s) > LATEST_S
        found = f"found the time {time_s[np.argmax(late)]:.6g} s" if late.any() else ""
        self.refuse(late[:, None], [column], f"{found}, beyond 3,000 years, expected seconds")

    def times(self, column: str = "time_s") -> FloatArray:
        """Return the times (n,) [s] of a column; refuse missing, repeated and absurd times."""
        time_s = self.complete_and_distinct(column)
        self.refuse_late(column, time_s)
        return time_s

    def _refuse_larger(self, values: FloatArray, columns: Sequence[str], largest: float) -> None:
        self.refuse(np.abs(values) > largest, columns, f"found a number above {largest:g}, expected a smaller one")

    def refuse(self, bad: NDArray[np.bool_], columns: Sequence[str], fault: str) -> None:
        """Refuse bad cells (n, k) of columns; the error has the first place and the fault."""
        if bad.any():
            row, column = np.argwhere(bad)[0]
            raise InputError(f"{self.place(row, columns[column])}: {fault}.")

    def refuse_back(self, column: str, bad: NDArray[np.bool_], expected: str, shown: str = "{:.6g} s") -> None:
        """Refuse bad pairs (n − 1) of successive rows; the error has the first place."""
        if bad.any():
            row = int(np.argmax(bad)) + 1
            before, found = self.values[row - 1 : row + 1, self.header.index(column)]
            pair = f"found {shown.format(found)} after {shown.format(before)}"
            raise InputError(f"{self.place(row, column)}: {pair}, expected {expected}.")


def read_table(
    path: str | PathLike[str], expected_header: str, *, only: Collection[str] | None = None, instant: Sequence[str] = ()
) -> Table:
    """Read a table of at least one row from a CSV file; `expected_header` is for errors.

    ``only``: columns to read; others may hold anything. ``instant``: a column of ISO 8601 times, UTC by default, or two
    columns of dates and of times; the first one becomes seconds since 1970.
    """
    return table_of_text(read_text(path, "a CSV file"), str(path), expected_header, only=only, instant=instant)


class Columns(Protocol):
    """Mapping from names to columns, or a data frame."""

    def __iter__(self) -> Iterator[Any]:
        """Iterate over the names of the columns."""

    def __getitem__(self, name: Any, /) -> Any:
        """Return a column."""


def table_of_columns(columns: Columns, name: str) -> Table:
    """Return a table as :func:`read_table` does, from columns in memory; `name` is for errors."""
    # Iteration over a frame of polars gives columns, not names.
    names = list(getattr(columns, "columns", columns))
    header = tuple(map(str, names))
    values = []
    for column in names:
        try:
            values.append((seconds if str(column).startswith("time") else numbers)(columns[column]))
        except (TypeError, ValueError):
            raise InputError(
                f"{name}, column {_short_name(column)}: found what is not a number, expected numbers."
            ) from None
    shapes = {column.shape for column in values}
    if len(shapes) != 1 or len(*shapes) != 1 or shapes == {(0,)}:
        raise InputError(f"{name}: found columns of the shapes {sorted(shapes)}, expected one length, 1 or more.")
    return Table(name, header, None, np.stack(values, axis=1), np.arange(1, len(values[0]) + 1))


def table_of_text(
    text: str,
    name: str,
    expected_header: str,
    *,
    first_line: int | None = None,
    only: Collection[str] | None = None,
    instant: Sequence[str] = (),
    marks: tuple[str, str] = (",", "."),
    head: Table | None = None,
    dummy: Collection[str] = (),
    ragged: bool = False,
    seconds_of: Callable[[str, str], str] = unix_seconds,
    label: str | None = None,
) -> Table:
    """Return a table as :func:`read_table` does, from text; `name` is for errors.

    ``first_line``: line of the first row in a longer text. ``marks``: separator and decimal mark. ``head``: table with
    the header of the rows, for a text without one. ``dummy``: words that become `DUMMY`, as ``*`` does. ``ragged``:
    rows may have more empty cells than the header has columns, or end behind the last column that is read; the last row
    may be cut. ``seconds_of``: function that reads an instant, as :func:`unix_seconds` does. ``label``: column of
    names, whose cells become their numbers in ``labels``.
    """
    separator, decimal = marks
    text = text.replace("\r\n", "\n").replace("\r", "\n")
    if "\0" in text:
        line = text.count("\n", 0, text.index("\0")) + 1
        raise InputError(f"{name}, line {line}: found a NUL byte, expected UTF-8 text.")
    rows = _csv_rows(name, text, separator)
    if head is not None:
        header, header_line = head.header, 0
    else:
        _refuse_preamble(name, text[:_HEAD_CHARACTERS], separator)
        header_line, cells = next(rows, (1, []))
        if not cells:
            raise InputError(f"{name} is empty, expected {expected_header}.")
        header = _check_header(f"{name}, line {header_line}", cells, expected_header, separator)
    kept = [i for i, column in enumerate(header) if only is None or column in only]
    chosen = tuple(header[i] for i in kept)
    shift = 0 if first_line is None else first_line - header_line - 1
    begin = _begin_of_line(text, header_line)
    if label not in chosen and (plain := plain_numbers(text[begin:], separator, decimal, len(header))) is not None:
        every, lines = plain
        return Table(name, chosen, header_line, every[:, kept], lines + (header_line + 1 + shift))
    # float() would also take 1_000 and digits of other scripts: only text without them may go through it directly.
    read = float if text.isascii() and "_" not in text[begin:] else _number
    timed = [chosen.index(column) for column in instant if column in chosen]
    named, names = chosen.index(label) if label in chosen else -1, dict[str, str]()
    values, line_numbers = packed("d"), packed("q")
    last, wrong = max(kept, default=-1), ""
    for row_line, cells in rows:
        line = row_line + shift
        if wrong:
            raise InputError(wrong)
        if ragged and len(cells) != len(header):
            cells = _fit_row(cells, len(header), last)
        if len(cells) != len(header):
            wrong = f"{name}, line {line}: found {len(cells)} cells, expected {len(header)} as in the header."
            if not ragged:
                raise InputError(wrong)
            continue
        if only is not None:
            cells = [cells[i] for i in kept]
        if decimal != ".":
            cells = [cell if i in timed else cell.replace(decimal, ".") for i, cell in enumerate(cells)]
        if timed:
            place = f"{name}, line {line}, column {', '.join(instant)}"
            cells[timed[0]] = seconds_of(place, "T".join(cells[i].strip() for i in timed))
            cells[timed[-1]] = cells[timed[0]]
        if named >= 0:
            cells[named] = names.setdefault(cells[named].strip(), str(len(names)))
        try:
            found = [read(cell or "nan") for cell in cells]
        except ValueError:
            found = _careful_numbers(f"{name}, line {line}", chosen, cells, dummy)
        values.extend(found)
        line_numbers.append(line)
    if wrong and (not line_numbers or len(cells) > len(header)):
        raise InputError(wrong)
    if wrong:
        _LOG.warning(f"{name}: the last row is incomplete and is left out")
    if not line_numbers:
        raise InputError(f"{name}, line {header_line}: found a header without rows, expected a row below it.")
    table = np.array(values).reshape(len(line_numbers), len(chosen))
    return Table(name, chosen, header_line, table, np.array(line_numbers, dtype=np.int64), tuple(names))


def _begin_of_line(text: str, number: int) -> int:
    """Return the begin of the line behind a number of lines."""
    begin = 0
    for _ in range(number):
        begin = text.find("\n", begin) + 1 or len(text)
    return begin


def _fit_row(cells: list[str], n: int, last: int) -> list[str]:
    """Return a row of the right length: without excess empty cells, or with the missing ones."""
    while len(cells) > n and not cells[-1].strip():
        cells = cells[:-1]
    return cells + [""] * (n - len(cells)) if len(cells) > last + 1 else cells


def table_of_header(line: str, name: str, expected_header: str, *, number: int = 1, separator: str = ",") -> Table:
    """Return a table without rows from its header; `name` and `number` are for errors."""
    _, cells = next(_csv_rows(name, line, separator), (1, [""]))
    header = _check_header(f"{name}, line {number}", cells, expected_header, separator)
    return Table(name, header, number, np.zeros((0, len(header))), np.zeros(0, dtype=np.int64))


def _csv_rows(path: str, text: str, separator: str = ",") -> Iterator[tuple[int, list[str]]]:
    """Yield line number and cells of every row that is not blank."""
    rows = csv.reader(io.StringIO(text), delimiter=separator, skipinitialspace=separator == " ")
    line = 1
    try:
        for cells in rows:
            if len(cells) > 1 or (cells and cells[0].strip()):
                yield line, cells
            line = rows.line_num + 1
    except csv.Error as error:
        raise InputError(f"{path}, line {line}: found what is not CSV ({error}), expected a row of cells.") from None


def _refuse_preamble(name: str, head: str, separator: str) -> None:
    """Refuse lines of text above the header, the first row of names above a row of numbers."""
    rows = itertools.islice(_csv_rows(name, head, separator), _MOST_LINES_ABOVE)
    for k, ((line, names), (_, below)) in enumerate(itertools.pairwise(rows)):
        numbers = sum(map(is_number_or_empty, below))
        if len(names) == len(below) < 2 * numbers and len(names) > 1 and not any(map(is_number_or_empty, names)):
            if k:
                raise InputError(
                    f"{name}: found {line - 1} line{'s' * (line > 2)} of text before the header on line {line},"
                    " expected the header first: delete what stands above it."
                )
            return


def _check_header(place: str, cells: Sequence[str], expected: str, separator: str) -> tuple[str, ...]:
    header = tuple(cell.strip() for cell in cells)
    for other, called in _SEPARATORS.items():
        is_one = len(header) == 1 or (separator == "," and other in ";\t")
        if other != separator and is_one and other in header[0]:
            wanted = f"{_SEPARATORS[separator]} as the separator" if separator != "," else "commas"
            raise InputError(f"{place}: found columns separated by {called}, expected {wanted}.")
    seen: set[str] = set()
    for position, name in enumerate(header, start=1):
        if is_number_or_empty(name):
            found = f"{name!r} instead of a name" if name else "no name"
            raise InputError(f"{place}, column {position}: found {found}, expected {expected}.")
        if name in seen:
            raise InputError(f"{place}, column {_short_name(name)}: found a second time, expected once.")
        seen.add(name)
    return header


def _careful_numbers(place: str, header: Sequence[str], cells: Sequence[str], dummy: Collection[str]) -> list[float]:
    """Return the numbers of a row, NaN for empty cells; the error names the column of a bad cell."""
    found_numbers = []
    for name, cell in zip(header, cells, strict=True):
        word = cell.strip()
        try:
            if word in _MISSING_WORDS:
                found_numbers.append(math.nan)
            else:
                found_numbers.append(DUMMY if word in _DUMMY_WORDS or word in dummy else _number(cell))
        except ValueError:
            found = repr(cell.strip()[:SHOWN_CHARACTERS])
            raise InputError(
                f"{place}, column {_short_name(name)}: found {found}, expected a number or an empty cell."
            ) from None
    return found_numbers


def _number(cell: str) -> float:
    cell = cell.strip()
    if "_" in cell or not cell.isascii():
        raise ValueError(cell)
    return float(cell) if cell else math.nan


def is_number_or_empty(cell: str) -> bool:
    """Return whether a cell is a number or empty."""
    try:
        _number(cell)
    except ValueError:
        return False
    return True


Column = NDArray[np.float64] | NDArray[np.int64] | NDArray[np.bool_] | Sequence[str]


def write_columns(columns: Mapping[str, Column], path: Path) -> None:
    """Write columns of equal length as CSV, numbers in full; NaN and infinity are empty cells."""
    write_text("\n".join([*csv_lines(columns), ""]), path)


def csv_lines(columns: Mapping[str, Column]) -> list[str]:
    """Return the header and the rows of columns, as :func:`write_columns` writes them."""
    cells = [[_cell(value) for value in column] for column in columns.values()]
    return [",".join(columns), *(",".join(row) for row in zip(*cells, strict=True))]


def _short_name(name: str) -> str:
    """Return a name short enough for a sentence; with a wrong separator a header is one long name."""
    return name if len(name) <= SHOWN_CHARACTERS else f"{name[: SHOWN_CHARACTERS - 1]}…"


def _cell(value: object) -> str:
    if isinstance(value, str):
        return '"' + value.replace('"', '""') + '"'
    if isinstance(value, (bool, np.bool_, int, np.integer)):
        return str(int(value))
    number = float(value)  # type: ignore[arg-type]
    return repr(number) if np.isfinite(number) else ""
