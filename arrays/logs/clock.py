"""Clocks of logs: instants, dates, times of day, and stamps of whole seconds."""

from __future__ import annotations

import datetime
import logging
import re
from functools import lru_cache

import numpy as np

from arrays.columns import SECONDS, LogColumns
from arrays.io.csv import Table
from arrays.io.errors import InputError
from arrays.io.values import unix_seconds
from arrays.typing import FloatArray

_LOG = logging.getLogger(__name__)
_TIME_OF_DAY = re.compile(r"(\d{1,2}):(\d{2})(?::(\d{2}(?:[.,]\d*)?))?")
_MINUTE = re.compile(r"(?:^|[T ])\d{1,2}:\d{2}$")
_SECONDS = re.compile(r"[0-5]\d(?:[.,]\d*)?")
_OTHER_DATE = re.compile(r"(\d{1,2})[./-](\d{1,2})[./-](\d{4}|\d{2})(?!\d)[T ]*")
_NAMED_MONTH = re.compile(r"(\d{1,2})[ ./-]*([A-Za-z]{3})[a-z]*[ ./-]*(\d{4}|\d{2})(?!\d)[T ]*")
_MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")
_FIRST_YEAR = 1970  # a year of two digits is in the hundred years from here
_DAY_S = 86400.0
_FIRST_DATE_S = 3e8  # before it, 1979, clocks count from their own start


def seconds_of_cell(place: str, cell: str, columns: LogColumns) -> str:
    """Return seconds since 1970 of an instant, or since midnight of a time of day, as text."""
    text = cell.strip()
    minute, _, within = text.rpartition(":")
    if _SECONDS.fullmatch(within) and _MINUTE.search(minute):
        minute_s = _seconds_of_minute(minute, columns.day_first)
        if minute_s is not None:
            return repr(minute_s + float(within.replace(",", ".")))
    return _seconds_of_instant(place, text, columns.day_first)


@lru_cache(maxsize=16)
def _seconds_of_minute(minute: str, day_first: bool | None) -> float | None:
    """Return the seconds of the begin of a minute, cached because many rows share it; None if the text is no minute."""
    try:
        return float(_seconds_of_instant("", f"{minute}:00", day_first))
    except InputError:
        return None


def _seconds_of_instant(place: str, text: str, day_first: bool | None) -> str:
    if found := _TIME_OF_DAY.fullmatch(text):
        hours, minutes, seconds = int(found[1]), int(found[2]), float((found[3] or "0").replace(",", "."))
        if hours < 24 and minutes < 60 and seconds < 61.0:
            return repr(3600.0 * hours + 60.0 * minutes + seconds)
    if (found := _NAMED_MONTH.match(text)) and found[2].lower() in _MONTHS:
        text = _iso(found[3], _MONTHS.index(found[2].lower()) + 1, found[1], text[found.end() :])
    elif found := _OTHER_DATE.match(text):
        if day_first is None:
            raise InputError(
                f"{place}: found {text!r}, which may begin with the day or the month, expected day_first = true or"
                " false in the table columns of the array file."
            )
        day, month = (found[1], found[2]) if day_first else (found[2], found[1])
        text = _iso(found[3], int(month), day, text[found.end() :])
    return unix_seconds(place, text)


def _iso(year: str, month: int, day: str, rest: str) -> str:
    """Return an instant as ISO 8601 has it."""
    whole = int(year) if len(year) == 4 else _FIRST_YEAR + (int(year) - _FIRST_YEAR) % 100
    return f"{whole}-{month:02d}-{int(day):02d}T{rest or '00:00'}"


def seconds_of_rows(table: Table, columns: LogColumns, *, is_file: bool) -> FloatArray:
    """Return the times (n,) [s] of the rows of a log, which may pass midnight or share seconds."""
    if not columns.clock:
        return np.arange(float(len(table.values)))
    name = columns.clock[0]
    stamps = table.complete([name])[:, 0]
    if columns.time_unit == "hhmmss":
        hours, minutes, seconds = stamps // 1e4, stamps // 1e2 % 1e2, stamps % 1e2
        bad = (stamps < 0.0) | (hours >= 24.0) | (minutes >= 60.0) | (seconds >= 61.0)
        table.refuse(bad[:, None], [name], "found no time of day, expected hours, minutes, seconds such as 091403.0")
        time_s = 3600.0 * hours + 60.0 * minutes + seconds
    else:
        time_s = SECONDS[columns.time_unit] * stamps
    of_day = bool(columns.time_unit in ("iso", "hhmmss") and (np.abs(time_s) < _DAY_S + 1.0).all())
    date_s = columns.time_offset_s
    if columns.date is not None:
        date_s += float(unix_seconds("", columns.date))
    if columns.date is not None and not of_day:
        if len(time_s) and not -_DAY_S < time_s[0] - date_s < 2.0 * _DAY_S:
            found = date_of(time_s[0]) if columns.time_unit == "iso" else "no times of day"
            raise InputError(f"{table.header_place(name)}: found {found}, expected the date {columns.date}.")
        date_s = columns.time_offset_s
    if not is_file:
        return time_s + date_s
    days = np.cumsum(np.diff(time_s, prepend=time_s[:1]) < -_DAY_S / 2.0) if of_day else np.zeros(len(time_s))
    if days.any():
        _LOG.info(f"{table.path}: the clock passes midnight")
    whole = _spread(time_s + _DAY_S * days)
    if whole is not None:
        _LOG.warning(f"{table.path}: times are whole seconds that rows share: these are spread over their second")
        return whole + date_s
    if not days.any():
        table.complete_and_distinct(name)
    return time_s + _DAY_S * days + date_s


def date_of(time_s: float) -> str | None:
    """Return the date of an instant (UTC), such as 2026-05-12; None for times with another origin."""
    if not time_s > _FIRST_DATE_S:
        return None
    return datetime.datetime.fromtimestamp(time_s, datetime.UTC).date().isoformat()


def _spread(time_s: FloatArray) -> FloatArray | None:
    """Return times at equal steps within each second; None unless most rows share whole seconds.

    The first and the last second may be incomplete: their rows have the usual step.
    """
    if len(time_s) < 2 or (time_s % 1.0).any() or (np.diff(time_s) < 0.0).any():
        return None
    first, counts = np.unique(time_s, return_index=True, return_counts=True)[1:]
    usual = int(np.median(counts[1:-1])) if len(counts) > 2 else 1
    if usual < 2:
        return None
    within = np.arange(len(time_s)) - np.repeat(first, counts)
    sizes = np.maximum(counts, np.where(np.isin(np.arange(len(counts)), (0, len(counts) - 1)), usual, 0))
    within[: counts[0]] += sizes[0] - counts[0]
    return np.asarray(time_s + within / np.repeat(sizes, counts))
