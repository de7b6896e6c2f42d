"""Readings as a live plot beside the scene, with the player's time marked.

Use, inside a tab or folder of the GUI::

    plot = ReadingsPlot(server, readings, array)      # magloc.readings.Readings, arrays.array.SensorArray
    plot.show_row(index)                              # marks the time of a row of the readings
    plot.when_pointed(player.show_row)                # called with the row that the user points at
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import viser

from arrays.array import SensorArray
from arrays.typing import FloatArray
from magloc.measurement.differences import predicted_channels
from magloc.readings import Readings
from magloc.truth import nearest_rows
from magloc.viewer.panels.inputs import SharedInput
from magloc.viewer.panels.latest import Latest
from magloc.viewer.panels.lines import PlotLines, across, cursor_svg, lines_svg, numbers_html
from magloc.viewer.scene.glyphs import round_length

RAW = "readings"
DIFFERENCES = "differences from the mean"
RESIDUALS = "residuals of the differences"
TICKED, ALL = "those ticked", "all"
AT = "At [s]"
"""Label of the input that takes a time, which the page types when the plot is pointed at."""
# Okabe and Ito, without yellow, which is not seen on white; all are seen on a dark page.
_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#666666")
# Opacities of the axes. Dashes of noise take a browser without a graphics card a second a picture, and cannot be told.
_SHADES = {"x": "", "y": "bf", "z": "80", "": ""}
_MOST_POINTS = 400
_MOST_CHANNELS_AT_FIRST = 12
_LEAST_ROWS = 20  # of the shortest span


class Channel(NamedTuple):
    """What one line of the plot shows.

    Attributes
    ----------
    label : str
    sensor : str
        Id of the sensor.
    axis : {"x", "y", "z", ""}
        Empty for a scalar sensor.
    """

    label: str
    sensor: str
    axis: str


class ReadingsPlot:
    """A plot of readings over time, and the panels that choose what it shows.

    Parameters
    ----------
    server : viser.ViserServer
        The panels are added where its GUI is at present.
    readings : Readings
    array : SensorArray
        Whose channels they have.
    residuals_T : ndarray, shape (n, C), optional
        Readings less what a source explains of them; without it they cannot be shown.
    window_s : float, optional
        The time axis shows so long before the last row [s]; by default all since the first row.

    Attributes
    ----------
    index : int
        Row whose time is marked.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        readings: Readings,
        array: SensorArray,
        residuals_T: FloatArray | None = None,
        window_s: float | None = None,
    ) -> None:
        self._server, self._array, self._window_s = server, array, window_s
        self._channels, self._ids = channels_of(array), array.ids
        self._hold(readings, residuals_T)
        self._follow = Latest(self._show)
        self._drawn: tuple[str, tuple[int, ...], float, int] | None = None
        self._wanted: Callable[[int], None] = lambda row: None
        self.index = 0
        gui = server.gui
        with gui.add_folder("Readings"):
            self.kind_dropdown = gui.add_dropdown(
                "Show",
                (RAW, DIFFERENCES) if residuals_T is None else (RAW, DIFFERENCES, RESIDUALS),
                hint="Differences are of the field in the array's axes, from the mean of the sensors with a reading.",
            )
            self.lines_panel = gui.add_html("")
            self.cursor_panel = gui.add_html("")
            if window_s is None:
                self._add_times(gui)
            self.sensors_dropdown = gui.add_dropdown("Sensors", (TICKED, ALL, *array.ids), hint="or those ticked below")
            with gui.add_folder("Channels", expand_by_default=False):
                axes = sorted({channel.axis for channel in self._channels if channel.axis})
                self.axis_checkboxes = {axis: gui.add_checkbox(f"axis {axis}", True) for axis in axes}
                at_first = _MOST_CHANNELS_AT_FIRST // max(len(axes), 1)
                self.sensor_checkboxes = {
                    sensor: gui.add_checkbox(sensor, i < at_first) for i, sensor in enumerate(array.ids)
                }
        self.kind_dropdown.on_update(self._follow)
        self.sensors_dropdown.on_update(self._follow)
        for checkbox in (*self.axis_checkboxes.values(), *self.sensor_checkboxes.values()):
            checkbox.on_update(self._follow)
        self._follow()

    def _add_times(self, gui: viser.GuiApi) -> None:
        """Inputs for the time that is marked, and for how much time is seen."""
        last_s, spans = float(self._time_s[-1]), ["all"]
        self.at_input = gui.add_number(AT, 0.0, step=1e-3, hint="Or press the mouse in the plot.")
        self._at = SharedInput(self.at_input, lambda: self._wanted(self._row_at(float(self.at_input.value))))
        while last_s > 0.0 and len(self._time_s) * 0.1 ** len(spans) >= _LEAST_ROWS:
            spans.append(f"{round_length(last_s * 0.1 ** len(spans)):g} s")
        self.span_dropdown = gui.add_dropdown("Span", spans, disabled=len(spans) == 1, hint="Of the axis of time.")
        self.span_dropdown.on_update(self._follow)

    def when_pointed(self, wanted: Callable[[int], None]) -> None:
        """Call something with the row whose time the user points at, or types."""
        self._wanted = wanted

    def take(self, readings: Readings, residuals_T: FloatArray | None = None) -> None:
        """Show other readings of the array in place of those so far, and mark the last row."""
        self._hold(readings, residuals_T)
        self._drawn = None
        self.show_row(len(readings) - 1)

    def _hold(self, readings: Readings, residuals_T: FloatArray | None) -> None:
        self._order = np.argsort(readings.time_s, kind="stable")
        self._time_s = readings.time_s[self._order] - readings.time_s[self._order[0 if self._window_s is None else -1]]
        self._rank = np.argsort(self._order)
        self._values_T = readings.values_T[self._order]
        self._residuals_T = None if residuals_T is None else residuals_T[self._order]
        # Long records are thinned once for every choice: the mark that moves is all that changes in between.
        self._values_nT = lru_cache(maxsize=2)(self._computed_nT)
        self._thinned = lru_cache(maxsize=4)(self._thinned_lines)

    def show_row(self, index: int) -> None:
        """Mark the time of a row.

        Parameters
        ----------
        index : int
            Of the readings.
        """
        self.index = index
        self._follow()

    @property
    def kinds(self) -> tuple[str, ...]:
        """What can be shown."""
        return tuple(self.kind_dropdown.options)

    @property
    def time_words(self) -> str:
        """What the axis of time is."""
        return f"time {'since the first' if self._window_s is None else 'before the last'} row [s]"

    def lines(self, kind: str) -> PlotLines:
        """What it shows of a kind at all times."""
        return self._thinned(kind, tuple(self._chosen()), 0.0, 0)

    def _row_at(self, time_s: float) -> int:
        """Row of the readings that is nearest to a time since the first."""
        return int(self._order[nearest_rows(np.array([time_s]), self._time_s)[0]])

    def _chosen(self) -> list[int]:
        return [
            i
            for i, channel in enumerate(self._channels)
            if self._is_chosen(channel.sensor) and (not channel.axis or self.axis_checkboxes[channel.axis].value)
        ]

    def _is_chosen(self, sensor: str) -> bool:
        chosen = self.sensors_dropdown.value
        return bool(self.sensor_checkboxes[sensor].value) if chosen == TICKED else chosen in (ALL, sensor)

    def _show(self) -> None:
        row, span_s = self.index, 0.0
        now_s = self._time_s[self._rank[row : row + 1]]
        if self._window_s is None and self.span_dropdown.value != "all":
            span_s = float(self.span_dropdown.value.split()[0])
        page = int(now_s[0] // span_s) if span_s else 0
        wanted = (self.kind_dropdown.value, tuple(self._chosen()), span_s, page)
        lines = self._thinned(*wanted)
        cursor = cursor_svg(float(across(lines, now_s)[0])) + numbers_html(lines, lines.at([row])[1][0].tolist())
        with self._server.atomic():
            if wanted != self._drawn:  # what is drawn anew takes a picture as long as the whole scene
                self.lines_panel.content, self._drawn = lines_svg(lines, self.time_words), wanted
            self.cursor_panel.content = cursor
            if self._window_s is None:
                self._at.show(round(float(now_s[0]), 6))

    def _computed_nT(self, kind: str) -> FloatArray:
        """Readings (n, C), their differences, or what a source leaves of these, in the order of time."""
        if kind == RAW:
            return 1e9 * self._values_T
        of = self._values_T if kind != RESIDUALS or self._residuals_T is None else self._residuals_T
        return 1e9 * differences_from_mean(self._array, of)

    def _thinned_lines(self, kind: str, chosen: tuple[int, ...], span_s: float, page: int) -> PlotLines:
        """Lines of no more points than can be seen; of one page, if it has a span."""
        values, time_s = self._values_nT(kind)[:, chosen], self._time_s
        ends = (float(time_s[0]), float(time_s[-1])) if self._window_s is None else (-self._window_s, 0.0)
        span = span_of(values)

        def at(rows: Sequence[int]) -> tuple[FloatArray, FloatArray]:
            places = self._rank[list(rows)]
            return self._time_s[places], values[places]

        shown = values
        if span_s:
            ends = (page * span_s, (page + 1) * span_s)
            first, last = np.searchsorted(time_s, ends)
            time_s, shown = time_s[first : last + 1], values[first : last + 1]
            span = span_of(shown)
        channels = [self._channels[i] for i in chosen]
        colours = tuple(
            _COLOURS[self._ids.index(channel.sensor) % len(_COLOURS)] + _SHADES[channel.axis] for channel in channels
        )
        labels = tuple(channel.label for channel in channels)
        return PlotLines(*thinned(time_s, shown, _MOST_POINTS), ends, span, labels, colours, at)


def residuals_of(array: SensorArray, rows: Readings, positions_m: FloatArray, moments_Am2: FloatArray) -> FloatArray:
    """Readings (n, C) less those of a source that is at (n, 3), in the world where the rows have poses [T]."""
    if rows.pose is not None:
        origins_m, back = rows.pose[0], rows.pose[1].inv()
        positions_m, moments_Am2 = back.apply(positions_m - origins_m), back.apply(moments_Am2)
    return rows.values_T - predicted_channels(array, positions_m, moments_Am2)


def channels_of(array: SensorArray) -> list[Channel]:
    """The channels of an array by sensor and axis."""
    return [
        Channel(name, sensor.id, axis)
        for sensor in array.sensors
        for name, axis in zip(sensor.channel_names, "xyz" if sensor.kind == "vector" else ("",), strict=True)
    ]


def differences_from_mean(array: SensorArray, readings_T: FloatArray) -> FloatArray:
    """What every channel sees beyond the mean of the sensors of its kind, calibration undone.

    ``readings_T`` (n, C): NaN where missing [T]. Returns (n, C): of vector sensors the components along the array's
    axes; NaN where a reading of the sensor is missing [T].
    """
    fields = array.calibrated_field(readings_T)
    result = np.full(readings_T.shape, np.nan)
    channels = array.sensor_channels
    vector = np.array([sensor.kind == "vector" for sensor in array.sensors])
    if vector.any():
        beyond = fields[:, vector] - _mean_of_known(fields[:, vector])
        result[:, channels[vector].ravel()] = beyond.reshape(len(result), -1)
    if not vector.all():
        scalar = channels[~vector, 0]
        moduli = (readings_T - array.channel_offset_T)[:, scalar] / array.channel_gain[scalar, 0]
        result[:, scalar] = moduli - _mean_of_known(moduli)
    return result


def thinned(time_s: FloatArray, values: FloatArray, most: int) -> tuple[FloatArray, FloatArray]:
    """No more points than a plot can show: the least and the greatest value of every stretch of time.

    ``time_s`` (n,): ascending [s]. ``values`` (n, C): NaN where missing. ``most``: points at most, of every
    channel. Returns times (k,) and values (k, C), all if there are no more than that. An extreme value is never lost.
    """
    if len(time_s) <= most:
        return time_s, values
    first = np.linspace(0, len(time_s), most // 2, endpoint=False).astype(np.intp)
    last = np.append(first[1:], len(time_s)) - 1
    extremes = np.stack([np.fmin.reduceat(values, first, axis=0), np.fmax.reduceat(values, first, axis=0)], axis=1)
    return np.stack([time_s[first], time_s[last]], axis=1).ravel(), extremes.reshape(-1, values.shape[1])


def span_of(values: FloatArray) -> tuple[float, float]:
    """From below the least to above the greatest finite value."""
    known = values[np.isfinite(values)]
    low, high = (float(known.min()), float(known.max())) if known.size else (-1.0, 1.0)
    margin = 0.05 * (high - low) or 0.05 * abs(high) or 1.0
    return low - margin, high + margin


def _mean_of_known(values: FloatArray) -> FloatArray:
    """Mean over the second axis of what is not NaN, that axis kept; NaN where nothing is known."""
    known = np.isfinite(values)
    with np.errstate(invalid="ignore"):
        mean: FloatArray = np.where(known, values, 0.0).sum(axis=1, keepdims=True) / known.sum(axis=1, keepdims=True)
    return mean
