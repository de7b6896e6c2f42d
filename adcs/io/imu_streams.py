"""Attitude of an inertial unit while its rows come in from a pipe, a socket, a serial port or a replayed file."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from os import PathLike
from typing import Any

import numpy as np

from adcs.complementary.attitude_filter import AttitudeConfig, AttitudeEstimate, AttitudeFilter
from adcs.complementary.names import Magnet
from adcs.io.imu_files import ImuFile, ImuTable, layout_of_table, standard_table
from adcs.io.log_layout import LogLayout
from arrays.io.csv import Table, table_of_header, table_of_text
from arrays.io.errors import InputError
from arrays.io.toml import read_toml, section_of
from arrays.typing import FloatArray
from magloc.live.tally import Clock, Tally
from magloc.live.transports import open_stream

_EXPECTED = "a header with a time, and columns of gyro, accelerometer and magnetometer"


class ImuStream:
    """Filter of the rows of a stream: CSV below a header, or JSON objects with these names.

    A line that is no row, a row whose time jumps, and a row that the filter refuses, is counted and named; it never
    ends the stream. After ten rows of a clock that was set back, the filter starts anew.

    Parameters
    ----------
    layout : path-like, optional
        TOML file whose table ``log`` names columns, units and mountings, as of :func:`adcs.read_imu`.
    magnet : str
        Treatment of a field that contradicts, as of :class:`adcs.AttitudeConfig`.
    lag_s : float
        Lag of the magnetometer behind the gyro.
    """

    def __init__(
        self, layout: str | PathLike[str] | None = None, *, magnet: Magnet = "auto", lag_s: float = 0.0
    ) -> None:
        given = None if layout is None else section_of(str(layout), read_toml(layout, "a layout of a log"), ImuFile).log
        self.tally = Tally()
        self._clock = Clock(self.tally, self._start)
        self._given, self._config = given, AttitudeConfig(magnet, lag_s=lag_s)
        self._head: Table | None = None
        self._layout: LogLayout | None = None if given is None else layout_of_table(given)
        self._filter: AttitudeFilter | None = None
        self._n_lines, self._fault = 0, ""

    def follow(self, source: str, *, replay_speed: float = 1.0) -> Iterator[AttitudeEstimate]:
        """Yield an estimate for every row of a source, an address as of :func:`magloc.live.track`.

        Raises
        ------
        InputError
            The source cannot be opened, or it ends without a row.
        """
        with open_stream(source, replay_speed=replay_speed) as stream:
            for batch in stream.batches:
                self.tally.drop(batch.dropped, stream.name)
                for estimate in self.parse(batch.lines, stream.name):
                    stream.accept(batch.sender)
                    yield estimate
            if not self.tally.rows:
                found = f"only garbled lines ({self.tally.garbled}; {self._fault})" if self._n_lines else "nothing"
                raise InputError(f"{stream.name}: found {found}, expected {_EXPECTED}.")

    def parse(self, lines: Sequence[bytes], name: str) -> Iterator[AttitudeEstimate]:
        """Yield the estimates of the next lines; ``name`` names the stream in errors."""
        for line in lines:
            self._n_lines += 1
            try:
                row = self._row(line, name)
                estimate = None if row is None else self._update(*row)
            except ValueError as error:
                self._fault = self._fault or str(error).rstrip(".").partition(", expected")[0]
                self.tally.name("garbled", str(error))
                continue
            if estimate is not None:
                yield estimate

    def _row(self, line: bytes, name: str) -> tuple[float, dict[str, FloatArray]] | None:
        """Return time and readings of a line; None for a header and an empty line."""
        place = f"{name}, line {self._n_lines}"
        try:
            text = line.decode().strip("\ufeff \r\t")
        except UnicodeDecodeError as error:
            raise InputError(f"{place}: found the byte 0x{line[error.start]:02x}, expected UTF-8.") from None
        if not text:
            return None
        if text.startswith("{"):
            values = _object_of(text, place)
            if self._head is None:
                self._accept_header(",".join(values), name)
            assert self._head is not None
            text = ",".join("" if (one := values.get(key)) is None else str(one) for key in self._head.header)
        elif self._head is None or text.split(",")[0] == self._head.header[0]:
            self._accept_header(text, name)
            return None
        layout = self._layout
        assert layout is not None
        instant = [layout.time] if layout.time_format == "utc" else []
        table = table_of_text(text, name, _EXPECTED, first_line=self._n_lines, head=self._head, instant=instant)
        time_s = float(layout.seconds(table.complete([layout.time])[:, 0])[0])
        sensors = {key: group for key, group in layout.columns.items() if key != "truth"}
        return time_s, {key: group.of(table.finite_or_missing(group.columns))[0] for key, group in sensors.items()}

    def _accept_header(self, text: str, name: str) -> None:
        """Use a header for the rows below it; raise InputError if a column is missing."""
        head = table_of_header(text, name, _EXPECTED, number=self._n_lines)
        table: ImuTable = standard_table(head.header) if self._given is None else self._given
        layout = layout_of_table(table)
        names = [layout.time, *(one for group in layout.columns.values() for one in group.columns)]
        for column in names:
            head.require(column, names)
        self._head, self._layout = head, layout
        if self._filter is None:
            samples: Any = table.gyro.samples
            self._config = replace(self._config, gyro_samples=samples)
            self._start()

    def _start(self) -> None:
        """Start a filter."""
        self._filter = AttitudeFilter(self._config)

    def _update(self, time_s: float, readings: dict[str, FloatArray]) -> AttitudeEstimate | None:
        """Return the estimate of a row; None if the clock does not accept its time."""
        if not self._clock.accepts(time_s):
            return None
        assert self._filter is not None
        names = ("rate_rad_s", "acceleration_m_s2", "field_T")
        try:
            return self._filter.update(time_s, *(readings.get(name) for name in names))
        except ValueError:
            self.tally.rows -= 1  # the clock counted it
            raise


def _object_of(text: str, place: str) -> dict[str, float | None]:
    """Return the numbers of a JSON object."""
    try:
        found = json.loads(text)
    except (ValueError, RecursionError):
        raise InputError(f"{place}: found no valid JSON, expected an object.") from None
    if not all(value is None or isinstance(value, int | float) for value in found.values()):
        raise InputError(f"{place}: found values of other types, expected numbers or null.")
    return dict(found)


def entry_of(estimate: AttitudeEstimate) -> dict[str, object]:
    """Return the JSON entry of an estimate: the columns of ``adcs imu`` and the flags."""
    q = dict(zip(("qw", "qx", "qy", "qz"), estimate.q.tolist(), strict=True))
    tilt, heading = np.degrees([estimate.sigma_tilt_rad, estimate.sigma_heading_rad]).tolist()
    sigmas = {"sigma_tilt_deg": tilt, "sigma_heading_deg": heading}
    return {"time_s": estimate.time_s, **q, **sigmas, "disturbed": estimate.disturbed, "flags": estimate.flags}
