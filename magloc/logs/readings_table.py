"""Rows of a readings file from a binary log, by the table ``columns`` of an array file."""

from __future__ import annotations

import logging
from dataclasses import replace
from os import PathLike
from pathlib import Path

import numpy as np

from arrays.columns import LogColumns
from arrays.io.csv import Table
from arrays.io.errors import InputError
from arrays.io.text import read_text
from arrays.logs.clock import date_of
from arrays.logs.format import LogFormat, log_date, log_origin
from arrays.typing import FloatArray, Vector
from magloc.logs.channels import Log, LogChannel
from magloc.logs.read import log_reader, read_log
from magloc.logs.time_base import resample

_LOG = logging.getLogger(__name__)
_UNIT_RTOL = 1e-6


def table_of_file(path: str | PathLike[str], form: LogFormat) -> Table:
    """Return the table of a readings file, of a log in text, or of a binary log."""
    if log_reader(path) is None:
        return form.table(read_text(path, "a CSV file", form.encoding), str(path))
    logged, n_left_out = _table_of_log(read_log(path), form)
    if n_left_out:
        _LOG.warning(f"{path}: {n_left_out} rows lie outside the attitude's times or in its gaps, and are ignored")
    return form.translate(logged)


def _table_of_log(log: Log, form: LogFormat) -> tuple[Table, int]:
    """Return the columns of a log that a format names, in the units of the log, and the number of rows ignored.

    The rows follow the first sensor, as far as there is an attitude, if one is named. Other channels are
    interpolated to its times; they are missing in gaps.
    """
    if form.columns is None:  # a table with the columns of a readings file
        names = list(log.topics[0].channel_names())
        sensors = [name for of in form.channels.values() for name in of]
        for name in sensors:
            log.require(name)
    else:
        sensors = list(form.columns.of_sensors(form.channels).values())
        _check_units(log, sensors, form.columns)
        wanted = (*sensors, *form.wanted)
        names = list(dict.fromkeys(name for name in wanted if name != "time_s" or name in log))
        names += [name for name in form.others if name in log and name not in names]
    time_s = log.require((sensors or names)[0]).time_s
    values = {name: _in_rows(time_s, log, log.require(name), form.columns) for name in names}
    if "time_s" not in values:
        values = {"time_s": time_s, **values}
    table = np.stack(list(values.values()), axis=1)
    attitude = [list(values).index(name) for name in (form.columns.attitude if form.columns is not None else ())]
    is_known = np.isfinite(table[:, attitude]).all(axis=1)
    rows = np.flatnonzero(is_known)
    return Table(log.path, tuple(values), 1, table[rows], 1 + rows), len(table) - len(rows)


def origin_of_log(path: str | PathLike[str], columns: LogColumns) -> Vector:
    """Return latitude, longitude [deg] and height [m] of the first position of a log, also of a binary one."""
    reader = log_reader(path)
    if columns.track is not None or reader is None:
        return log_origin(path, columns)
    form = LogFormat({}, replace(columns, quaternion=None, angles=None), "", ())
    return log_origin(path, columns, _table_of_log(reader(Path(path)), form)[0])


def date_of_log(path: str | PathLike[str], columns: LogColumns) -> str | None:
    """Return the date of the begin of a log, such as 2026-05-12; None if it states none."""
    reader = log_reader(path)
    if reader is None:
        return log_date(path, columns)
    log = reader(Path(path))
    return None if log.unix_zero_s is None else date_of(log.unix_zero_s + float(log.topics[0].time_s[:1].sum()))


def _check_units(log: Log, names: list[str], columns: LogColumns) -> None:
    """Refuse a unit that contradicts the one that the log states."""
    for name in names:
        channel = log.require(name)
        if channel.unit == "T" and abs(1e9 * channel.si_per_unit / columns.unit_nT - 1.0) > _UNIT_RTOL:
            expected = f"unit = {1e9 * channel.si_per_unit:g} (nT)"
            raise InputError(
                f"{log.path}, key columns.unit: found {columns.unit} for {name} in {channel.logged_unit}, expected"
                f" {expected}."
            )


def _in_rows(time_s: FloatArray, log: Log, channel: LogChannel, columns: LogColumns | None) -> FloatArray:
    """Return the numbers of a channel at times (n,): m and degrees, other quantities in their unit in the log."""
    values = channel.values if channel.unit in ("deg", "m") else channel.values / channel.si_per_unit
    if channel.unit == "rad":
        values = np.degrees(channel.values)
    if np.array_equal(channel.time_s, time_s):
        return values
    if not len(values):
        raise InputError(f"{log.path}: found no value of {channel.name}, expected some.")
    log.check_clock(channel)
    flags = () if columns is None else [of.column for of in (columns.valid, columns.fix) if of is not None]
    if channel.name in flags or (columns is not None and channel.name in (columns.quaternion or ())):
        after = np.clip(np.searchsorted(channel.time_s, time_s), 1, max(len(values) - 1, 1))
        is_before = time_s - channel.time_s[after - 1] < channel.time_s[np.minimum(after, len(values) - 1)] - time_s
        return np.asarray(values[np.minimum(after, len(values) - 1) - (is_before & (len(values) > 1))])
    sample_s = channel.time_s
    if columns is not None and channel.name in (columns.angles or ()):
        known = np.isfinite(values)  # a missing angle would make all later ones missing
        sample_s, values = sample_s[known], np.unwrap(values[known], period=360.0)
    return resample(time_s, sample_s, values[:, None])[:, 0]
