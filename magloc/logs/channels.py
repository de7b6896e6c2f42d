"""Channels of a log: numbers with a unit and a clock."""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

from arrays.io.errors import InputError
from arrays.io.results import MOST_SHOWN
from arrays.io.tables import align
from arrays.typing import FloatArray
from magloc.logs.units import NO_UNIT, LoggedUnit

ROWS = "rows"
"""Clock of a channel without times: the numbers of its rows."""


@dataclass(frozen=True, eq=False)
class LogChannel:
    """Channel of a log.

    Attributes
    ----------
    name : str
        Its path in the log, such as ``vehicle_magnetometer.magnetometer_ga[0]``.
    unit : str
        Unit of the values: SI, "deg" of a latitude or longitude, or that of the log if it is none of these; empty where
        the log states none.
    time_s : ndarray, shape (n,)
        Times of the values by the clock [s].
    values : ndarray, shape (n,)
    clock : str
        Clock of the times: "boot": since the start of the autopilot, "unix": since 1970 (UTC), "rows": numbers of rows.
    logged_unit : str
        Unit in the log.
    si_per_unit : float
        Factor from the number in the log to the value.

    Examples
    --------
    >>> import numpy as np
    >>> import magloc
    >>> magloc.LogChannel("mag.x", "T", np.arange(5) / 50.0, np.zeros(5), "boot").rate_Hz
    50.0
    """

    name: str
    unit: str
    time_s: FloatArray
    values: FloatArray
    clock: str
    logged_unit: str = ""
    si_per_unit: float = 1.0

    @property
    def rate_Hz(self) -> float:
        """Inverse of the median step; NaN for a channel without a clock, or with one that stands."""
        step_s = float(np.median(np.diff(self.time_s))) if len(self.time_s) > 1 else 0.0
        return 1.0 / step_s if step_s > 0.0 and self.clock != ROWS else float("nan")

    def __len__(self) -> int:
        return len(self.values)


@dataclass(frozen=True, eq=False)
class Topic:
    """Fields of a log with the same times.

    Attributes
    ----------
    name : str
        Prefix of the channels' names; empty if there is none.
    time_s : ndarray, shape (n,)
    fields : dict
        Numbers (n,) of the log by the names of the fields.
    units : dict
        Units of the fields that have one.
    clock : str
        See :class:`LogChannel`.
    separator : str
        Text between the names of topic and field.
    """

    name: str
    time_s: FloatArray
    fields: Mapping[str, NDArray[Any]]
    units: Mapping[str, LoggedUnit]
    clock: str
    separator: str = "."

    def channel_names(self) -> dict[str, str]:
        """Return the fields by the names of their channels."""
        prefix = f"{self.name}{self.separator}" if self.name else ""
        return {f"{prefix}{name}": name for name in self.fields}


@dataclass(frozen=True, eq=False)
class Log(Mapping[str, LogChannel]):
    """Channels of a log by their names.

    Attributes
    ----------
    path : str
    kind : str
        Format, such as "PX4 ULog".
    topics : tuple of Topic
        Fields that share their times. Two topics of one name are parts of a message whose sensors have separate clocks.
    parameters : dict
        Settings of the autopilot by their names, such as ``CAL_MAG0_ROT``; empty for other logs.
    unix_zero_s : float, optional
        Time since 1970 (UTC) at the zero of the clock [s]; None if the log does not state it.
    warnings : tuple of str
        Sentences about parts that cannot be read.

    Examples
    --------
    >>> import magloc
    >>> log = magloc.read_log("flight.ulg")  # doctest: +SKIP
    >>> time_s, field_T = log.vectors(["sensor_mag.x", "sensor_mag.y", "sensor_mag.z"])  # doctest: +SKIP
    """

    path: str
    kind: str
    topics: tuple[Topic, ...]
    parameters: Mapping[str, float] = field(default_factory=dict)
    unix_zero_s: float | None = None
    warnings: tuple[str, ...] = ()

    @cached_property
    def _places(self) -> dict[str, tuple[Topic, str]]:
        return {name: (topic, of) for topic in self.topics for name, of in topic.channel_names().items()}

    def __getitem__(self, name: str) -> LogChannel:
        topic, of = self._places[name]
        unit = topic.units.get(of, NO_UNIT)
        values = np.asarray(topic.fields[of], dtype=np.float64) * unit.si_per_unit
        return LogChannel(name, unit.si, topic.time_s, values, topic.clock, unit.logged, unit.si_per_unit)

    def __iter__(self) -> Iterator[str]:
        return iter(self._places)

    def __len__(self) -> int:
        return len(self._places)

    def require(self, name: str) -> LogChannel:
        """Return a channel; the error for a missing one has the nearest name.

        Raises
        ------
        InputError
            The log has no such channel.
        """
        if name not in self:
            near = difflib.get_close_matches(name, list(self), n=1, cutoff=0.5)
            hint = f" (the nearest is {near[0]})" if near else ""
            raise InputError(f"{self.path}: found no channel {name}{hint}, expected one that magloc columns lists.")
        return self[name]

    def vectors(self, names: Sequence[str]) -> tuple[FloatArray, FloatArray]:
        """Return the common times (n,) [s] and the values (n, k) of channels, without rows that repeat a time.

        Raises
        ------
        InputError
            A channel is missing, they have other times, or their clock goes back.
        """
        channels = [self.require(name) for name in names]
        time_s = channels[0].time_s
        if any(not np.array_equal(each.time_s, time_s) for each in channels[1:]):
            raise InputError(f"{self.path}: found other times in {', '.join(names)}, expected channels of one message.")
        self.check_clock(channels[0])
        is_new = np.concatenate([[True], np.diff(time_s) > 0.0])[: len(time_s)]
        return time_s[is_new], np.stack([each.values for each in channels], axis=1)[is_new]

    def check_clock(self, channel: LogChannel) -> None:
        """Refuse a channel whose times do not ascend."""
        time_s = channel.time_s
        back = np.flatnonzero(~(np.diff(time_s) >= 0.0))
        if len(back):
            row = int(back[0])
            found = f"found {time_s[row + 1]:.6f} s after {time_s[row]:.6f} s in row {row + 2} of {channel.name}"
            raise InputError(f"{self.path}: {found}, expected a clock that advances: cut the log there.")

    def lines(self, most: int | None = None) -> list[str]:
        """Return the lines of a table of at most `most` channels."""
        rows = [("channel", "unit", "rows", "rate [Hz]", "clock", "first")]
        for name in list(self)[:most]:
            channel = self[name]
            first = f"{channel.values[0]:.6g}" if len(channel) else ""
            rate = "" if np.isnan(channel.rate_Hz) else f"{channel.rate_Hz:.4g}"
            rows.append((name, channel.unit or "-", str(len(channel)), rate, channel.clock, first))
        rest = [] if most is None or len(self) <= most else [f"… and {len(self) - most} more"]
        return [f"{self.kind}: {len(self)} channels of {len(self.topics)} topics", *align(rows, left=1), *rest]

    def table(self) -> str:
        """Return a table of all channels."""
        return "\n".join(self.lines())

    def __repr__(self) -> str:
        return "\n".join(self.lines(MOST_SHOWN))

    def _repr_html_(self) -> str:
        return f"<pre>{escape(repr(self))}</pre>"
