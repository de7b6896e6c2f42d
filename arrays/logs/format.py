"""Format of a readings file or a log: conversion to a table, and dummy values."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from os import PathLike

import numpy as np

from arrays.columns import LINE, POSITION_COLUMNS, ROTATION_COLUMNS, SECONDS, SEPARATORS, LogColumns, Track
from arrays.io.csv import DUMMY, Table, table_of_header, table_of_text
from arrays.io.dummies import dummy_cells, may_be_dummies
from arrays.io.errors import InputError
from arrays.io.text import read_text
from arrays.logs.clock import date_of, seconds_of_cell, seconds_of_rows
from arrays.logs.lines import cells_of, header_and_rows
from arrays.logs.places import array_origins, geodetic_places, positions, quaternions
from arrays.typing import FloatArray, Vector

_LOG = logging.getLogger(__name__)
_BEGIN_CHARACTERS = 2**20  # of a log that are read for its origin
_LEAST_BEYOND = 0.01  # share of rows without a position that is said
_FEW_ROWS = 20  # whose cells are screened before columns are


@dataclass(frozen=True)
class LogFormat:
    """Conversion of the text of a readings file, or of a log, to a table of a readings file.

    Attributes
    ----------
    channels : dict
        Columns of a readings file for every sensor, by its id.
    columns : LogColumns, optional
        Columns of a log; None for a readings file.
    expected : str
        Description of the header, for errors.
    others : collection of str
        Other columns of a readings file, which are not converted.
    """

    channels: Mapping[str, Sequence[str]]
    columns: LogColumns | None
    expected: str
    others: Collection[str]

    @property
    def separator(self) -> str:
        """Separator of the cells in a row."""
        return "," if self.columns is None else SEPARATORS[self.columns.separator]

    @property
    def encoding(self) -> str | None:
        """Stated encoding of the text."""
        return None if self.columns is None else self.columns.encoding

    def begins(self, line: str) -> bool:
        """Return whether a line names columns, including the time."""
        if self.columns is None:
            return "time_s" in line
        return set(self.columns.clock[:1]) <= set(cells_of(line, self.columns))

    def clock(self, header: str) -> Callable[[str], float]:
        """Return a function of the time [s] of a row; ValueError or IndexError for a row without one."""
        columns = self.columns
        if columns is None:
            names = [cell.strip().strip('"') for cell in header.split(",")]
            at = names.index("time_s") if "time_s" in names else 0
            return lambda row: float(row.split(",")[at])
        names = cells_of(header, columns)
        ats = [names.index(name) for name in columns.clock if name in names] or [0]

        def seconds(row: str) -> float:
            cells = cells_of(row, columns)
            told = "T".join(cells[i].strip() for i in ats)
            if columns.time_unit == "iso":
                return float(seconds_of_cell("", told, columns))
            return SECONDS[columns.time_unit] * float(told.replace(columns.decimal, "."))

        return seconds

    def header(self, line: str, name: str, number: int) -> Table:
        """Return a table without rows, with the names of the log, from its first line."""
        if self.columns is None:
            return table_of_header(line, name, self.expected, number=number)
        text = self.separator.join(cells_of(line, self.columns))
        return table_of_header(text, name, self.expected, number=number, separator=self.separator)

    def table(self, text: str, name: str, *, first_line: int | None = None, head: Table | None = None) -> Table:
        """Return the table of a text; with `head` the text itself has no header."""
        if self.columns is None:
            return table_of_text(text, name, self.expected, first_line=first_line, head=head)
        return self.translate(self.table_of_log(text, name, self.columns, first_line=first_line, head=head))

    def table_of_log(
        self,
        text: str,
        name: str,
        columns: LogColumns,
        *,
        first_line: int | None = None,
        head: Table | None = None,
        quiet: bool = False,
    ) -> Table:
        """Return the table of a log's text, with the names and units of the log."""
        if columns.separator == "space":
            text = text.replace("\t", " ")
        line, labels = 0, list[tuple[int, str]]()
        if head is None:
            text = text.replace("\r\n", "\n").replace("\r", "\n").replace("\ufeff", "")  # also those of joined files
            head, text, first_line, labels = header_and_rows(
                text, name, columns, self._theirs(columns), self._is_time, quiet=quiet
            )
            line = head.header_line or 0
        table = table_of_text(
            text,
            name,
            self.expected,
            first_line=first_line,
            only={*self._theirs(columns), *self._own, *self.others},
            instant=columns.clock if columns.time_unit == "iso" else (),
            seconds_of=partial(seconds_of_cell, columns=columns),
            marks=(self.separator, columns.decimal),
            head=head,
            dummy=[each for each in columns.dummy if isinstance(each, str)],
            ragged=True,
            label=columns.line,
        )
        if labels and columns.line is None:
            lines, names = zip(*labels, strict=True)
            of_row = np.searchsorted(lines, table.line_numbers).astype(np.float64)  # 0 before the first name
            values = np.column_stack([table.values, of_row])
            table = replace(table, header=(*table.header, LINE), values=values, labels=("", *names))
        return replace(table, header_line=line)

    def _is_time(self, cells: list[str]) -> bool:
        """Return whether one of a row's cells may be an instant."""
        assert self.columns is not None
        for cell in cells:
            try:
                seconds_of_cell("", cell, self.columns)
            except InputError:
                continue
            return True
        return False

    def translate(self, logged: Table) -> Table:
        """Return the table with the names and units of a readings file."""
        columns = self.columns
        if columns is None:
            return logged
        theirs, own = self._theirs(columns), self._own
        for name in theirs:
            logged.require(name, theirs)
        is_file = bool(logged.header_line)  # and no stream
        index = {name: i for i, name in enumerate(logged.header)}
        found = {name: logged.values[:, i] for name, i in index.items() if name in own or name in self.others}
        named = columns.of_sensors(self.channels)
        found |= {ours: logged.values[:, index[in_log]] for ours, in_log in named.items()}
        unusable = np.zeros(len(logged.values), np.bool_)
        if columns.valid is not None:
            unusable = ~np.isin(logged.values[:, index[columns.valid.column]], columns.valid.equals)
            if unusable.any() and is_file:
                fault = f"{columns.valid.column} that is not {' or '.join(map('{:g}'.format, columns.valid.equals))}"
                _LOG.warning(f"{logged.path}: the readings of {unusable.sum()} rows have {fault} and are left out")
        readings = {name: np.where(unusable, np.nan, columns.unit_nT * found[name]) for name in own & found.keys()}
        found |= {name: np.where(found[name] == DUMMY, DUMMY, of) for name, of in readings.items()}
        label = columns.line or LINE
        if label in index and (columns.line or logged.labels):
            found[LINE] = logged.values[:, index[label]]
        found["time_s"] = seconds_of_rows(logged, columns, is_file=is_file)
        if columns.place:
            found |= zip(POSITION_COLUMNS, positions(logged, columns, is_file=is_file).T, strict=True)
        elif columns.track is not None:
            found |= zip(POSITION_COLUMNS, _positions_of_track(found["time_s"], columns, columns.track).T, strict=True)
        if columns.attitude or (columns.is_placed and not set(ROTATION_COLUMNS) & found.keys()):
            found |= zip(ROTATION_COLUMNS, quaternions(logged, columns).T, strict=True)
        if columns.antenna_m is not None and not (columns.course and is_file):
            if np.any(columns.antenna_m[:2]) and not (columns.attitude or set(ROTATION_COLUMNS) <= index.keys()):
                raise InputError(
                    f"{logged.path}: found no attitude, expected one, or course = true, for an antenna off to a side."
                )
            place, turn = (np.stack([found[name] for name in of], 1) for of in (POSITION_COLUMNS, ROTATION_COLUMNS))
            found |= zip(POSITION_COLUMNS, array_origins(place, turn, columns).T, strict=True)
        values = np.stack([*found.values()], axis=1)
        return Table(logged.path, tuple(found), logged.header_line, values, logged.line_numbers, logged.labels)

    @property
    def wanted(self) -> tuple[str, ...]:
        """Columns of the log that are read; none for a readings file."""
        return () if self.columns is None else self._theirs(self.columns)

    @property
    def _own(self) -> set[str]:
        return {name for of_sensor in self.channels.values() for name in of_sensor}

    def _theirs(self, columns: LogColumns) -> tuple[str, ...]:
        flags = [rows.column for rows in (columns.valid, columns.fix) if rows is not None]
        named = columns.of_sensors(self.channels).values()
        flags += [columns.line] if columns.line is not None else []
        return tuple(dict.fromkeys((*columns.clock, *named, *columns.place, *columns.attitude, *flags)))


def log_origin(path: str | PathLike[str], columns: LogColumns, table: Table | None = None) -> Vector:
    """Return latitude, longitude [deg] and height [m] of the first position of a log.

    The height is 0 if the log has heights above ground. ``table``: the table of a log that is not text.

    Raises
    ------
    InputError
        The log cannot be read, or has no place.
    """
    if columns.track is not None:
        return log_origin(columns.track.path, columns.track.columns)
    for part in _begins(path, columns) if table is None else (table,):
        place = geodetic_places(part, columns, is_file=True)
        known = place[np.isfinite(place).all(axis=1)]
        if len(known):
            latitude, longitude, height = known[0].tolist()
            return latitude, longitude, 0.0 if columns.above_ground else height
    raise InputError(f"{path}: found no row with a place, expected one.")


def log_date(path: str | PathLike[str], columns: LogColumns) -> str | None:
    """Return the date of the first row of a log, such as 2026-05-12; None if its times have no date."""
    table = next(_begins(path, columns))
    return date_of(float(seconds_of_rows(table, columns, is_file=False)[0]))


def _positions_of_track(time_s: FloatArray, columns: LogColumns, track: Track) -> FloatArray:
    """Return positions (n, 3) [m] in the rows nearest to the positions of another file, and NaN in the others."""
    form = LogFormat({}, replace(track.columns, origin=columns.origin), "a header", ())
    table = form.table(read_text(track.path, "a log of positions", track.columns.encoding), track.path)
    at = [table.header.index(name) for name in ("time_s", *POSITION_COLUMNS)]
    fixes = table.values[:, at][np.isfinite(table.values[:, at]).all(axis=1)]
    fixes = fixes[np.argsort(fixes[:, 0], kind="stable")]
    place = np.full((len(time_s), 3), np.nan)
    inside = np.flatnonzero((time_s >= fixes[:1, 0].sum()) & (time_s <= fixes[-1:, 0].sum()))
    if not len(fixes) or not len(inside):
        span = f"{fixes[0, 0]:.0f} to {fixes[-1, 0]:.0f} s" if len(fixes) else "no position"
        raise InputError(
            f"{track.path}: found {span}, expected positions from {time_s[0]:.0f} to {time_s[-1]:.0f} s, the times of"
            " the log: state its date (--date), or time_offset_s between both clocks."
        )
    if (beyond := np.isfinite(time_s).sum() - len(inside)) > _LEAST_BEYOND * len(time_s):
        early_s, late_s = fixes[0, 0] - np.nanmin(time_s), np.nanmax(time_s) - fixes[-1, 0]
        _LOG.warning(
            f"{track.path}: {beyond} of {len(time_s)} rows of the log have no position: they begin"
            f" {max(early_s, 0.0):.0f} s before the positions and end {max(late_s, 0.0):.0f} s after them. If both were"
            " recorded together, their clocks differ: local time by whole hours, GPS time by 18 s ahead of UTC; state"
            " time_offset_s"
        )
    inside = inside[np.argsort(time_s[inside], kind="stable")]
    after = np.clip(np.searchsorted(time_s[inside], fixes[:, 0]), 1, max(len(inside) - 1, 1))
    rows = np.clip(np.concatenate([after - 1, after]), 0, len(inside) - 1)  # before and after each position
    rows = inside[np.unique(rows)]
    place[rows] = np.column_stack([np.interp(time_s[rows], fixes[:, 0], axis) for axis in fixes[:, 1:].T])
    return place


def _begins(path: str | PathLike[str], columns: LogColumns) -> Iterator[Table]:
    """Yield the table of the begin of a log, and then of all of it."""
    text = read_text(path, "a CSV file", columns.encoding)
    begin = text[: text.rfind("\n", 0, _BEGIN_CHARACTERS) + 1]  # long enough for a fix
    for part in (begin, text) if len(begin) < len(text) and begin else (text,):
        form = LogFormat({}, columns, "the columns that the array file names", ())
        yield form.table_of_log(part, str(path), columns, quiet=True)


READINGS_FILE = LogFormat({}, None, "", ())
"""Format of a readings file of any sensors."""


def without_dummies(
    table: Table, form: LogFormat, name: Callable[[str, int], None] | None = None, before: FloatArray | None = None
) -> Table:
    """Return a table of readings with NaN instead of dummy values, and report their numbers.

    Parameters
    ----------
    table : Table
        Table with the columns of a readings file.
    form : LogFormat
        Sensors, and declared dummies.
    name : callable, optional
        Called with a sentence and the number of dummies; by default the sentence is logged as a warning.
    before : ndarray, shape (m, columns), optional
        Earlier rows.
    """
    columns = form.columns or LogColumns()
    declared = [columns.unit_nT * each for each in columns.dummy if not isinstance(each, str)]
    values = table.values.copy()
    earlier = values[:0] if before is None else before
    all_rows, units = np.concatenate([earlier, values]), sorted({1.0, columns.unit_nT})
    is_quick = 0 < len(values) <= _FEW_ROWS
    suspected = may_be_dummies(all_rows, len(values), declared, units).tolist() if is_quick else None
    found: dict[str, int] = {}
    index = {name: i for i, name in enumerate(table.header)}
    for sensor, channels in form.channels.items():
        own = [index[channel] for channel in channels]
        if suspected is not None and not any(suspected[i] for i in own):
            continue
        cells = dummy_cells(all_rows[:, own], declared, units)[len(earlier) :]
        if cells.any():
            numbers = ", ".join("*" if n == DUMMY else f"{n:.10g}" for n in np.unique(values[:, own][cells]))
            found[f"of sensor {sensor} ({numbers})"] = int(cells.any(axis=1).sum())
            values[:, own] = np.where(cells, np.nan, values[:, own])
    if found:
        total = sum(found.values())
        each = ", ".join(f"{count} {where}" for where, count in found.items())
        words = f"{table.path}: dummy values are left out: {total} in all, {each}"
        if name is None:
            _LOG.warning(words)
        else:
            name(words, total)
    return replace(table, values=values)
