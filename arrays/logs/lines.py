"""Lines of a log: the header, and lines below it that are no rows."""

from __future__ import annotations

import csv
import itertools
import logging
import re
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from arrays.columns import LINE, SEPARATORS, LogColumns
from arrays.io.csv import Table, is_number_or_empty, table_of_header
from arrays.io.errors import InputError

_LOG = logging.getLogger(__name__)
_MOST_LINES_ABOVE = 1000
_NOT_WORDS = "(?!N/?A)"  # "#N/A" is a missing cell, not a comment


def cells_of(line: str, columns: LogColumns) -> list[str]:
    """Return the cells of a header line, without a comment mark and empty cells at the end."""
    separator = SEPARATORS[columns.separator]
    text = line.strip(" \r\n" if separator == "\t" else " \t\r\n").removeprefix("\ufeff")
    for mark in columns.comment:
        text = text.removeprefix(mark).lstrip(" ")
    if separator == " ":
        text = text.replace("\t", " ")
    try:
        cells = next(csv.reader([text], delimiter=separator, skipinitialspace=separator == " "), [])
    except csv.Error:
        return []
    return without_empty_end([cell.strip() for cell in cells])


def without_empty_end(cells: list[str]) -> list[str]:
    """Return the cells of a row up to the last one that is not empty."""
    while cells and not cells[-1]:
        cells = cells[:-1]
    return cells


class LogText(NamedTuple):
    """Header of a log, the text of its rows with the number of its first line, and named survey lines.

    ``labels`` has the line number and the name of each row that names a survey line.
    """

    head: Table
    rows: str
    first_line: int
    labels: list[tuple[int, str]]


def header_and_rows(
    text: str,
    name: str,
    columns: LogColumns,
    wanted: Sequence[str],
    is_time: Callable[[list[str]], bool],
    *,
    quiet: bool = False,
) -> LogText:
    """Return the header of a log and the text of the rows below it.

    The header is the first line with all wanted columns. Other lines than rows are emptied, so that rows keep their
    line numbers.
    """
    if columns.names:
        number, header, start = _first_row(text, name, columns, wanted, is_time)
        line, first = "", number
    else:
        number, header, start = _header(text, name, columns, wanted)
        line, first = text[:start].rstrip("\n").rpartition("\n")[2], number + 1
    rows = text[start:]
    found = [f"the header is on line {number}"] if number > 1 and line else []
    labels = list(_labels(rows, first, columns))
    begins = (*columns.comment, *columns.skip)
    marks = [re.escape(mark) + (_NOT_WORDS if mark == "#" else "") for mark in begins]
    headers = re.escape(line) + "$" if line else ""
    for called, pattern, words in (
        ("repeated headers", headers, (line,)),
        ("remarks and names", "|".join(marks), begins),
    ):
        if pattern and any(word in rows for word in words):  # the search for a text is far faster than for a pattern
            rows, n = re.subn(rf"^[ \t]*(?:{pattern}).*", "", rows, flags=re.MULTILINE)
            found += [f"{n} lines of {called} are left out"] * (n > 0)
    _refuse_another_header(rows, name, first, columns, wanted)
    below = re.search(r"^.*\S.*$", rows, flags=re.MULTILINE)
    if line and below is not None and _are_units(cells_of(below[0], columns), header, is_time):
        rows = rows[: below.start()] + rows[below.end() :]
        found.append("the row of units below it is left out")
    if not rows.strip():
        raise InputError(f"{name}, line {number}: found a header without rows, expected a row below it.")
    if found and not quiet:
        _LOG.info(f"{name}: {', '.join(found)}")
    return LogText(_empty(name, header, number), rows, first, labels)


def _refuse_another_header(rows: str, name: str, first: int, columns: LogColumns, wanted: Sequence[str]) -> None:
    """Refuse a second header with other columns, as a logger writes after a restart with another setting."""
    at = rows.find(max(wanted, key=len))
    if at < 0:
        return
    begin, end = rows.rfind("\n", 0, at) + 1, rows.find("\n", at)
    if set(wanted) <= set(cells_of(rows[begin : end if end > 0 else None], columns)):
        line = first + rows.count("\n", 0, begin)
        raise InputError(
            f"{name}, line {line}: found a second header with other columns, expected one header: cut the file above"
            " this line, and read both parts."
        )


def _empty(name: str, header: tuple[str, ...], number: int) -> Table:
    return Table(name, header, number, np.zeros((0, len(header))), np.zeros(0, dtype=np.int64))


def _labels(rows: str, first: int, columns: LogColumns) -> Iterator[tuple[int, str]]:
    """Yield line number and name of rows that name a survey line; "/Line 10" names line 10."""
    if not columns.skip:
        return
    pattern = rf"^[ \t]*({'|'.join(map(re.escape, columns.skip))})(.*)"
    line, at = first, 0
    for found in re.finditer(pattern, rows, flags=re.MULTILINE):
        line += rows.count("\n", at, found.start())
        at = found.start()
        word, rest = found[1].strip(" \t/#"), found[2].strip()
        yield line, rest if rest and word.lower() in ("line", "l") else f"{word}{found[2]}".strip()


def _first_row(
    text: str, name: str, columns: LogColumns, wanted: Sequence[str], is_time: Callable[[list[str]], bool]
) -> tuple[int, tuple[str, ...], int]:
    """Return line number of the first row that fits the stated names, these, and the begin of that line."""
    for column in wanted:
        if (n := columns.names.count(column)) != 1:
            raise InputError(f"{name}, key columns.names: found {column!r} {n} times, expected it once.")
    at = [columns.names.index(column) for column in wanted]
    timed = [columns.names.index(column) for column in columns.clock] if columns.time_unit == "iso" else []
    numbers = [i for i in at if i not in timed and columns.names[i] != columns.line]
    start = 0
    for number, line in enumerate(itertools.islice(_lines(text), _MOST_LINES_ABOVE), start=1):
        cells = [] if line.lstrip().startswith(columns.comment) else cells_of(line, columns)
        if len(cells) > max(at, default=0):
            are_numbers = all(is_number_or_empty(cells[i].replace(columns.decimal, ".")) for i in numbers)
            if are_numbers and (not timed or is_time(["T".join(cells[i] for i in timed)])):
                return number, columns.names, start
        start += len(line)
    expected = f"rows of the {len(columns.names)} columns that the key columns.names names"
    raise InputError(f"{name}: found no row with numbers in {', '.join(wanted)}, expected {expected}.")


def _header(text: str, name: str, columns: LogColumns, wanted: Sequence[str]) -> tuple[int, tuple[str, ...], int]:
    """Return line number and cells of the header, and the begin of the next line."""
    best: tuple[int, int, str] = (-1, 1, "")
    start = 0
    for number, line in enumerate(itertools.islice(_lines(text), _MOST_LINES_ABOVE), start=1):
        start += len(line)
        cells = cells_of(line, columns)
        named = len(set(wanted).intersection(cells))
        if named == len(set(wanted)):
            for column in wanted:
                if cells.count(column) > 1:
                    raise InputError(f"{name}, line {number}, column {column}: found a second time, expected once.")
            return number, tuple(cells), start
        is_comment = line.lstrip().startswith(columns.comment)
        if cells and named > best[0] and not (is_comment and not named):
            best = (named, number, line.rstrip("\n"))
    expected = f"a header with {', '.join(wanted)}"
    if not best[2]:
        raise InputError(f"{name} is empty, expected {expected}.")
    if best[0]:
        head = _empty(name, tuple(cells_of(best[2], columns)), best[1])
    else:
        head = table_of_header(best[2], name, expected, number=best[1], separator=SEPARATORS[columns.separator])
    for column in wanted:
        head.require(column, wanted)
    raise InputError(f"{name}, line {best[1]}: found no header in {_MOST_LINES_ABOVE} lines, expected {expected}.")


def _lines(text: str) -> Iterator[str]:
    start = 0
    while start < len(text):
        end = text.find("\n", start) + 1 or len(text)
        yield text[start:end]
        start = end


def _are_units(cells: list[str], header: Sequence[str], is_time: Callable[[list[str]], bool]) -> bool:
    """Return whether the first row below a header has no number and no time."""
    is_row = any(map(is_number_or_empty, filter(None, cells)))
    return len(cells) <= len(header) and not is_row and not is_time(cells)


def line_starts(table: Table) -> tuple[tuple[float, str], ...]:
    """Return the times at which survey lines begin, and their names; none if the table has no column for them."""
    if LINE not in table.header:
        return ()
    number, time_s = (table.values[:, table.header.index(name)] for name in (LINE, "time_s"))
    first = np.flatnonzero(np.concatenate([[True], np.diff(number) != 0.0]))
    names = [table.labels[int(k)] if table.labels else f"{k:g}" for k in number[first]]
    return tuple(zip(time_s[first].tolist(), names, strict=True))
