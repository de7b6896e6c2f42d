"""Lines that come in, as rows: CSV with its header first, or JSON objects; what is neither is counted and named."""

from __future__ import annotations

import logging
from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import msgspec
import numpy as np

from arrays.array import SensorArray
from arrays.io.csv import Table
from arrays.io.errors import InputError
from arrays.logs.format import without_dummies
from arrays.typing import FloatArray
from magloc.live.tally import Tally
from magloc.readings import EXPECTED_HEADER, Readings, log_format, readings_of_checked, readings_of_table

_LOG = logging.getLogger(__name__)
_LINES_WITHOUT_HEADER = 100
_RECENT = 100  # rows that tell whether a number is a dummy value
_MOST_HEADS = 64  # of senders whose header is not that of the first
_AROUND = "\ufeff \r\t"


class GarbledError(ValueError):
    """A line that is no row."""


@dataclass
class _Head:
    """A header, and the last rows below it."""

    text: str
    table: Table
    recent: FloatArray


class RowParser:
    """Reads the lines of one stream, strictly: the rows are those of a readings file with the same lines.

    What is no row, or no header of the array, is counted and named, and ends nothing. A sender's own header counts for
    its rows alone, the first one for those of senders without one.

    Parameters
    ----------
    array : SensorArray
        Whose sensors the rows must have, with a column for each channel.
    name : str
        Of the stream, in errors.
    tally : Tally
        Where garbled lines are counted.
    sensors : sequence of str, optional
        Ids of a subset of the array; columns of others are ignored.
    is_file : bool
        Refuse a first header that is not that of the array at once: no other one comes.

    Attributes
    ----------
    fault : str
        Why a header was not used, or the first line, before one was used; empty where there is none such.
    """

    def __init__(
        self,
        array: SensorArray,
        name: str,
        tally: Tally,
        sensors: Sequence[str] | None = None,
        *,
        is_file: bool = False,
    ) -> None:
        if array.columns is not None and array.columns.pose_latency_s:
            raise InputError(
                f"{name}: found columns.pose_latency_s in the array file, expected a stream whose poses are not late."
            )
        self._format = log_format(array, sensors)
        self._around = _AROUND.replace(self._format.separator, "")
        self._array, self._name, self._tally, self._sensors = array, name, tally, sensors
        self._used = array if sensors is None else array.subset(sensors)
        self._is_file = is_file
        self._first: _Head | None = None
        self._heads: dict[Hashable, _Head] = {}
        self._sender: Hashable = None
        self._n_lines = 0
        self._is_told = False
        self.fault = ""

    @property
    def has_header(self) -> bool:
        """Whether a header has come."""
        return self._first is not None

    def has_header_of(self, sender: Hashable) -> bool:
        """Whether a sender has sent a header of the array."""
        return sender in self._heads

    @property
    def _head(self) -> _Head | None:
        """Header of the sender's rows."""
        return self._heads.get(self._sender, self._first)

    def rows_of(self, lines: Sequence[bytes], sender: Hashable = None) -> Iterator[Readings]:
        """Rows of the next lines of a sender, in order, as many as possible in one piece."""
        self._sender = sender
        rows: list[str] = []
        for line in lines:
            self._n_lines += 1
            try:
                row = self._row_of(line)
            except GarbledError as error:
                self._garbled(f"{self._name}, line {self._n_lines}: {error}")
                row = None
            is_header = row is not None and self._format.begins(row)
            if row is None or is_header:
                yield from self._readings(rows, self._n_lines - len(rows))
                rows = []
            if row is not None and is_header:
                self._take_header(row)
            elif row is not None:
                rows.append(row)
        yield from self._readings(rows, self._n_lines - len(rows) + 1)

    def _row_of(self, line: bytes) -> str | None:
        """A line as one of CSV, None where it is empty."""
        try:
            text = line.decode(self._format.encoding or "utf-8").strip(self._around)
        except UnicodeDecodeError as error:
            raise GarbledError(f"the byte 0x{line[error.start]:02x} is not UTF-8") from None
        if text.startswith("{"):
            return self._row_of_object(text)
        if text.count('"') % 2:
            raise GarbledError("found a quotation mark without another, expected cells")
        if text and self._head is None and not self._format.begins(text):
            if self._n_lines == _LINES_WITHOUT_HEADER:
                _LOG.warning(f"{self._name}: found no header in {self._n_lines} lines, expected {EXPECTED_HEADER}")
            raise GarbledError(f"found no header yet, expected {EXPECTED_HEADER}")
        return text or None

    def _row_of_object(self, text: str) -> str | None:
        try:
            of_name: Any = msgspec.json.decode(text)
        except (msgspec.DecodeError, RecursionError) as error:
            raise GarbledError(f"found what is not JSON ({str(error).lower()})") from None
        time = "time_s" if self._array.columns is None else self._array.columns.clock[0]
        if time not in of_name:
            raise GarbledError(f"found an object without {time}")
        between = self._format.separator
        if self._sender not in self._heads:  # who leaves columns out has named them before
            self._take_header(between.join(of_name))
        if self._sender not in self._heads:
            return None
        columns = self._heads[self._sender].table.header
        unknown = [name for name in of_name if name not in columns]
        if unknown:
            raise GarbledError(f"found column {unknown[0]}, which the first row does not have")
        cells = (of_name.get(name) for name in columns)
        return between.join("" if cell is None else str(cell) for cell in cells)

    def _take_header(self, text: str) -> None:
        """Use a line that names columns from here on; one that is sent again changes nothing."""
        if self._sender in self._heads and text == self._heads[self._sender].text:
            return
        try:
            table = self._format.header(text, self._name, self._n_lines)
            readings_of_table(self._format.translate(table), self._array, self._sensors)
        except InputError as error:
            if self._first is None:
                if self._is_file:
                    raise
                if not self._is_told:
                    _LOG.warning(str(error))
                self._is_told, self.fault = True, str(error)
            self._garbled(str(error))
            return
        head = _Head(text, table, np.zeros((0, len(self._format.translate(table).header))))
        if self._first is None:
            self._first = head
        if len(self._heads) >= _MOST_HEADS:
            self._heads.pop(next(iter(self._heads)))
        self._heads[self._sender] = head

    def _garbled(self, why: str) -> None:
        """Count and name what is no row, and keep the first reason of those before a header."""
        if self._first is None:
            self.fault = self.fault or why
        self._tally.name("garbled", why)

    def _readings(self, rows: list[str], first_line: int) -> Iterator[Readings]:
        """Readings of successive lines; of halves of them where they are no table, until all garbled ones are found."""
        if not rows or self._head is None:
            return
        head = self._head.table
        try:
            table = self._format.table("\n".join(rows), head.path, first_line=first_line, head=head)
            usable = without_dummies(
                table, log_format(self._used, None), partial(self._tally.name, "dummies"), self._head.recent
            )
            self._head.recent = np.concatenate([self._head.recent, usable.values])[-_RECENT:]
            readings = readings_of_checked(usable, self._used)
            if len(readings) == len(rows):
                yield readings
                return
            why = f"{self._name}, line {first_line}: found {len(readings)} rows in {len(rows)} lines"
        except InputError as error:
            why = str(error)
        if len(rows) == 1:
            self._tally.name("garbled", why)
            return
        half = len(rows) // 2
        yield from self._readings(rows[:half], first_line)
        yield from self._readings(rows[half:], first_line + half)
