"""Log of a platform as a file: readings with currents, and the same text with corrected columns."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path

import numpy as np

from arrays.array import SensorArray
from arrays.io.csv import Column
from arrays.io.errors import InputError
from arrays.io.text import read_text, replace_file
from arrays.logs.format import LogFormat
from arrays.typing import FloatArray, IntArray
from magloc.navigation.fixes import without_gaps
from magloc.readings import Readings, log_format, readings_of_table


@dataclass(frozen=True, eq=False)
class LogFile:
    """Text of a log, and its parsed contents.

    Attributes
    ----------
    readings : Readings
    currents : dict of str to ndarray of shape (n,)
    lines : tuple of str
    header_line : int
        Line of the names, from 1.
    row_lines : ndarray of int, shape (n,)
        Line of each row of the readings.
    form : LogFormat
    """

    readings: Readings
    currents: Mapping[str, FloatArray]
    lines: tuple[str, ...]
    header_line: int
    row_lines: IntArray
    form: LogFormat

    @classmethod
    def read(cls, path: str | PathLike[str], array: SensorArray, currents: Sequence[str] = ()) -> LogFile:
        """Read the log of an array, and some columns of currents."""
        form = log_format(array, None)
        for name in currents:
            if currents.count(name) > 1:
                raise InputError(f"Input currents: found {name} twice, expected every column once.")
            if name in form.others or name in {column for of in form.channels.values() for column in of}:
                raise InputError(f"Input currents: found {name}, which is a column of the readings, expected others.")
        form = replace(form, others=(*form.others, *currents))
        text = read_text(path, "a CSV file", form.encoding).replace("\r\n", "\n").replace("\r", "\n")
        table = without_gaps(form.table(text, str(path)))[0]
        for name in ("time_s", *currents):
            table.require(name, currents)
        table.refuse_back("time_s", ~(np.diff(table.times()) > 0.0), "time to increase from row to row", "{:.15g}")
        kept = [i for i, name in enumerate(table.header) if name not in currents]
        header = tuple(table.header[i] for i in kept)
        readings = readings_of_table(replace(table, header=header, values=table.values[:, kept]), array, None)
        if array.columns is not None and array.columns.pose_latency_s:
            readings = readings.posed_later(array.columns.pose_latency_s)
        flowing = dict(zip(currents, table.finite_or_missing(currents).T, strict=True))
        return cls(readings, flowing, tuple(text.split("\n")), table.header_line or 1, table.line_numbers, form)

    def write(self, path: Path, columns: Mapping[str, Column]) -> None:
        """Write the log with more columns at the end of its rows, completely or not at all.

        Rows that are not among the readings have empty cells there, and other lines stay as they are.
        """
        separator, stated = self.form.separator, self.form.columns
        decimal = "." if stated is None else stated.decimal
        empty = "nan" if separator == " " else ""
        cells = [[empty if np.isnan(x) else f"{x:.4f}".replace(".", decimal) for x in of] for of in columns.values()]
        added = {
            int(line): separator.join(row) for line, row in zip(self.row_lines, zip(*cells, strict=True), strict=True)
        }
        nothing = separator.join([empty] * len(columns))
        header = self.lines[self.header_line - 1]
        n = _count(header, separator)
        lines = []
        for number, line in enumerate(self.lines, start=1):
            if number == self.header_line:
                line = _fitted(line, n, separator) + separator + separator.join(columns)
            elif number > self.header_line and (number in added or (line.strip() and _count(line, separator) == n)):
                line = _fitted(line, n, separator) + separator + added.get(number, nothing)
            lines.append(line)
        content = "\n".join(lines).encode((stated and stated.encoding) or "utf-8")
        replace_file(path, lambda file: file.write_bytes(content))


def _count(line: str, separator: str) -> int:
    """Return the number of cells of a line up to the last one that is not empty."""
    cells = next(csv.reader([line.rstrip()], delimiter=separator, skipinitialspace=separator == " "), [])
    while cells and not cells[-1].strip():
        cells.pop()
    return len(cells)


def _fitted(line: str, n: int, separator: str) -> str:
    """Return a line with n cells: without empty ones at its end, or with more of them."""
    if separator == " ":
        return line.rstrip()
    bare = line.rstrip(f"{separator} \t")
    return bare + separator * (n - _count(bare, separator))
