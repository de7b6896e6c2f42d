"""Parser of the lines of a stream: CSV below a header, or JSON objects; other lines are counted and logged."""

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
from magloc.live.transports import Stream
from magloc.readings import EXPECTED_HEADER, Readings, log_format, readings_of_checked, readings_of_table

_LOG = logging.getLogger(__name__)
_LINES_WITHOUT_HEADER = 100
_RECENT = 100  # rows that decide whether a number is a dummy value
_MOST_HEADERS = 64
_WHITESPACE = "\ufeff \r\t"


def rows_of_stream(stream: Stream, parser: RowParser, tally: Tally) -> Iterator[tuple[Readings, float]]:
    """Yield the rows of a stream and the time of their arrival [s]; at its end, refuse a stream without rows."""
    for batch in stream.batches:
        tally.drop(batch.dropped, stream.name)
        for readings in parser.parse(batch.lines, batch.sender):
            stream.accept(batch.sender)
            yield readings, batch.arrival_s
        if parser.has_header_of(batch.sender):
            stream.accept(batch.sender)
    parser.check_not_empty()


class GarbledError(ValueError):
    """Error: a line is no row."""


@dataclass
class _Header:
    """Header of a sender, with its last rows."""

    text: str
    table: Table
    recent: FloatArray


class RowParser:
    """Parser of the lines of one stream, as strict as for a readings file.

    Lines that are neither a row nor a header of the array are counted and logged; they never end the stream. The header
    of a sender applies to its own rows. The first header of the stream applies to senders without one.

    Parameters
    ----------
    array : SensorArray
        The rows must have a column for each of its channels.
    name : str
        Name of the stream in errors.
    tally : Tally
        It counts garbled lines.
    sensors : sequence of str, optional
        Ids of a subset of the sensors; other columns are ignored.
    is_file : bool
        Raise an error for a wrong first header, because a file has no other one.

    Attributes
    ----------
    fault : str
        Reason why no header has been accepted so far, or why the first line is garbled; empty if there is none.
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
        self._whitespace = _WHITESPACE.replace(self._format.separator, "")
        self._array, self._name, self._tally, self._sensors = array, name, tally, sensors
        self._used = array if sensors is None else array.subset(sensors)
        self._is_file = is_file
        self._first: _Header | None = None
        self._headers: dict[Hashable, _Header] = {}
        self._sender: Hashable = None
        self._n_lines = 0
        self._has_warned = False
        self.fault = ""

    @property
    def has_header(self) -> bool:
        """Return whether a header of the array has come."""
        return self._first is not None

    def has_header_of(self, sender: Hashable) -> bool:
        """Return whether a sender has sent a header of the array."""
        return sender in self._headers

    @property
    def _header(self) -> _Header | None:
        """Header that applies to the rows of the present sender."""
        return self._headers.get(self._sender, self._first)

    def check_not_empty(self) -> None:
        """Raise InputError if the stream has ended without a row."""
        if self._tally.rows:
            return
        if self._tally.garbled:
            fault = self.fault.rstrip(".")
            raise InputError(
                f"{self._name}: found only garbled lines ({self._tally.garbled}), expected rows ({fault})."
            )
        if self.has_header:
            raise InputError(f"{self._name}, line 1: found a header without rows, expected a row below it.")
        raise InputError(f"{self._name}: found nothing, expected {EXPECTED_HEADER}.")

    def parse(self, lines: Sequence[bytes], sender: Hashable = None) -> Iterator[Readings]:
        """Yield the rows of the next lines of a sender, in order, as many as possible at once."""
        self._sender = sender
        rows: list[str] = []
        for line in lines:
            self._n_lines += 1
            try:
                row = self._csv_row(line)
            except GarbledError as error:
                self._count_garbled(f"{self._name}, line {self._n_lines}: {error}")
                row = None
            is_header = row is not None and self._format.begins(row)
            if row is None or is_header:
                yield from self._readings(rows, self._n_lines - len(rows))
                rows = []
            if row is not None and is_header:
                self._accept_header(row)
            elif row is not None:
                rows.append(row)
        yield from self._readings(rows, self._n_lines - len(rows) + 1)

    def _csv_row(self, line: bytes) -> str | None:
        """Return a line as a row of CSV; None for an empty one."""
        try:
            text = line.decode(self._format.encoding or "utf-8").strip(self._whitespace)
        except UnicodeDecodeError as error:
            raise GarbledError(f"the byte 0x{line[error.start]:02x} is not UTF-8") from None
        if text.startswith("{"):
            return self._csv_row_of_object(text)
        if text.count('"') % 2:
            raise GarbledError("found an odd number of quotation marks, expected cells")
        if text and self._header is None and not self._format.begins(text):
            if self._n_lines == _LINES_WITHOUT_HEADER:
                _LOG.warning(f"{self._name}: found no header in {self._n_lines} lines, expected {EXPECTED_HEADER}")
            raise GarbledError(f"found no header yet, expected {EXPECTED_HEADER}")
        return text or None

    def _csv_row_of_object(self, text: str) -> str | None:
        try:
            values: Any = msgspec.json.decode(text)
        except (msgspec.DecodeError, RecursionError) as error:
            raise GarbledError(f"found no valid JSON ({str(error).lower()}), expected an object") from None
        time = "time_s" if self._array.columns is None else self._array.columns.clock[0]
        if time not in values:
            raise GarbledError(f"found an object without {time}")
        separator = self._format.separator
        if self._sender not in self._headers:  # the first object names all columns, later ones may omit some
            self._accept_header(separator.join(values))
        if self._sender not in self._headers:
            return None
        columns = self._headers[self._sender].table.header
        unknown = [name for name in values if name not in columns]
        if unknown:
            raise GarbledError(f"found column {unknown[0]}, which the first row does not have")
        cells = (values.get(name) for name in columns)
        return separator.join("" if cell is None else str(cell) for cell in cells)

    def _accept_header(self, text: str) -> None:
        """Use a header for the following rows of the sender, unless it is the present one or wrong."""
        if self._sender in self._headers and text == self._headers[self._sender].text:
            return
        try:
            table = self._format.header(text, self._name, self._n_lines)
            readings_of_table(self._format.translate(table), self._array, self._sensors)
        except InputError as error:
            if self._first is None:
                if self._is_file:
                    raise
                if not self._has_warned:
                    _LOG.warning(str(error))
                self._has_warned, self.fault = True, str(error)
            self._count_garbled(str(error))
            return
        header = _Header(text, table, np.zeros((0, len(self._format.translate(table).header))))
        if self._first is None:
            self._first = header
        if len(self._headers) >= _MOST_HEADERS:
            self._headers.pop(next(iter(self._headers)))
        self._headers[self._sender] = header

    def _count_garbled(self, reason: str) -> None:
        """Count a line that is no row; before a header, keep the first reason as the fault."""
        if self._first is None:
            self.fault = self.fault or reason
        self._tally.name("garbled", reason)

    def _readings(self, rows: list[str], first_line: int) -> Iterator[Readings]:
        """Yield the readings of successive lines; a bisection finds the garbled ones."""
        header = self._header
        if not rows or header is None:
            return
        try:
            table = self._format.table("\n".join(rows), header.table.path, first_line=first_line, head=header.table)
            usable = without_dummies(
                table, log_format(self._used, None), partial(self._tally.name, "dummies"), header.recent
            )
            header.recent = np.concatenate([header.recent, usable.values])[-_RECENT:]
            readings = readings_of_checked(usable, self._used)
            if len(readings) == len(rows):
                yield readings
                return
            reason = f"{self._name}, line {first_line}: found {len(readings)} rows in {len(rows)} lines"
        except InputError as error:
            reason = str(error)
        if len(rows) == 1:
            self._tally.name("garbled", reason)
            return
        half = len(rows) // 2
        yield from self._readings(rows[:half], first_line)
        yield from self._readings(rows[half:], first_line + half)
