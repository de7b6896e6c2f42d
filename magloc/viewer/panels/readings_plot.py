"""Plot of readings beside the scene, with a cursor at the time of the player.

Use, inside a tab or folder of the GUI::

    plot = ReadingsPlot(server, readings, array)      # magloc.readings.Readings, arrays.array.SensorArray
    plot.show_row(index)                              # moves the cursor to a row of the readings
    plot.on_select(player.show_row)                   # called with the row that the user selects
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
from magloc.viewer.panels.coalesced import CoalescedCall
from magloc.viewer.panels.inputs import SharedInput
from magloc.viewer.panels.lines import PlotLines, across, cursor_svg, lines_svg, numbers_html
from magloc.viewer.scene.glyphs import round_length

RAW = "readings"
DIFFERENCES = "differences from the mean"
RESIDUALS = "residuals of the differences"
TICKED, ALL = "those ticked", "all"
AT = "At [s]"
"""Label of the input of the time, which the page also fills in after a press on the plot."""
# Okabe and Ito without yellow, which is invisible on white; all are visible on a dark page.
_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#666666")
# Opacities of the axes; dashed lines of noise take a second a frame without a graphics card, and are not legible.
_SHADES = {"x": "", "y": "bf", "z": "80", "": ""}
_MOST_POINTS = 400
_MOST_CHANNELS_AT_FIRST = 12
_LEAST_ROWS = 20  # of the shortest span


class Channel(NamedTuple):
    """Channel of a line of the plot.

    Attributes
    ----------
    label : str
    sensor : str
        Id of the sensor.
    axis : {"x", "y", "z", ""}
        Axis of the sensor; empty for a scalar sensor.
    """

    label: str
    sensor: str
    axis: str


class ReadingsPlot:
    """Plot of readings over time, with panels to select its contents.

    Parameters
    ----------
    server : viser.ViserServer
        The panels are added to the present container of its GUI.
    readings : Readings
    array : SensorArray
        Array of the readings.
    residuals_T : ndarray, shape (n, C), optional
        Readings minus the predictions of a source; without them residuals cannot be shown.
    window_s : float, optional
        Length of the time axis before the last row [s]; by default it begins at the first row.

    Attributes
    ----------
    index : int
        Row at the cursor.
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
        self._channels, self._ids = plot_channels(array), array.ids
        self._set_readings(readings, residuals_T)
        self._follow = CoalescedCall(self._show)
        self._drawn_state: tuple[str, tuple[int, ...], float, int] | None = None
        self._select: Callable[[int], None] = lambda row: None
        self.index = 0
        gui = server.gui
        with gui.add_folder("Readings"):
            self.kind_dropdown = gui.add_dropdown(
                "Show",
                (RAW, DIFFERENCES) if residuals_T is None else (RAW, DIFFERENCES, RESIDUALS),
                hint="Differences of the field in the array's axes from the mean of the sensors with a reading.",
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
        """Add inputs for the time of the cursor and for the span of the time axis."""
        last_s, spans = float(self._time_s[-1]), ["all"]
        self.at_input = gui.add_number(AT, 0.0, step=1e-3, hint="Or press the mouse in the plot.")
        self._at = SharedInput(self.at_input, lambda: self._select(self._row_at(float(self.at_input.value))))
        while last_s > 0.0 and len(self._time_s) * 0.1 ** len(spans) >= _LEAST_ROWS:
            spans.append(f"{round_length(last_s * 0.1 ** len(spans)):g} s")
        self.span_dropdown = gui.add_dropdown("Span", spans, disabled=len(spans) == 1, hint="Of the axis of time.")
        self.span_dropdown.on_update(self._follow)

    def on_select(self, select: Callable[[int], None]) -> None:
        """Set the function that is called with the row whose time the user selects or types."""
        self._select = select

    def replace_readings(self, readings: Readings, residuals_T: FloatArray | None = None) -> None:
        """Show other readings of the array, with the cursor at the last row."""
        self._set_readings(readings, residuals_T)
        self._drawn_state = None
        self.show_row(len(readings) - 1)

    def _set_readings(self, readings: Readings, residuals_T: FloatArray | None) -> None:
        self._order = np.argsort(readings.time_s, kind="stable")
        origin = 0 if self._window_s is None else -1
        self._time_s = readings.time_s[self._order] - readings.time_s[self._order[origin]]
        self._rank = np.argsort(self._order)
        self._values_T = readings.values_T[self._order]
        self._residuals_T = None if residuals_T is None else residuals_T[self._order]
        # Long records are thinned once for every selection, because most updates only move the cursor.
        self._values_nT = lru_cache(maxsize=2)(self._compute_nT)
        self._lines = lru_cache(maxsize=4)(self._thin_lines)

    def show_row(self, index: int) -> None:
        """Move the cursor to a row.

        Parameters
        ----------
        index : int
            Row of the readings.
        """
        self.index = index
        self._follow()

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kinds of values that can be shown."""
        return tuple(self.kind_dropdown.options)

    @property
    def time_label(self) -> str:
        """Label of the time axis."""
        return f"time {'since the first' if self._window_s is None else 'before the last'} row [s]"

    def lines(self, kind: str) -> PlotLines:
        """Return the lines of a kind at all times."""
        return self._lines(kind, tuple(self._selected_channels()), 0.0, 0)

    def _row_at(self, time_s: float) -> int:
        """Return the row of the readings that is nearest to a time since the first."""
        return int(self._order[nearest_rows(np.array([time_s]), self._time_s)[0]])

    def _selected_channels(self) -> list[int]:
        return [
            i
            for i, channel in enumerate(self._channels)
            if self._is_selected(channel.sensor) and (not channel.axis or self.axis_checkboxes[channel.axis].value)
        ]

    def _is_selected(self, sensor: str) -> bool:
        selection = self.sensors_dropdown.value
        return bool(self.sensor_checkboxes[sensor].value) if selection == TICKED else selection in (ALL, sensor)

    def _show(self) -> None:
        row, span_s = self.index, 0.0
        now_s = self._time_s[self._rank[row : row + 1]]
        if self._window_s is None and self.span_dropdown.value != "all":
            span_s = float(self.span_dropdown.value.split()[0])
        page = int(now_s[0] // span_s) if span_s else 0
        state = (self.kind_dropdown.value, tuple(self._selected_channels()), span_s, page)
        lines = self._lines(*state)
        cursor = cursor_svg(float(across(lines, now_s)[0])) + numbers_html(lines, lines.at([row])[1][0].tolist())
        with self._server.atomic():
            if state != self._drawn_state:  # a new plot takes the browser as long as the whole scene
                self.lines_panel.content, self._drawn_state = lines_svg(lines, self.time_label), state
            self.cursor_panel.content = cursor
            if self._window_s is None:
                self._at.show(round(float(now_s[0]), 6))

    def _compute_nT(self, kind: str) -> FloatArray:
        """Return readings (n, C), their differences, or the residuals, in the order of time."""
        if kind == RAW:
            return 1e9 * self._values_T
        values_T = self._values_T if kind != RESIDUALS or self._residuals_T is None else self._residuals_T
        return 1e9 * differences_from_mean(self._array, values_T)

    def _thin_lines(self, kind: str, selection: tuple[int, ...], span_s: float, page: int) -> PlotLines:
        """Return lines in the resolution of the plot, for one page if there is a span."""
        values, time_s = self._values_nT(kind)[:, selection], self._time_s
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
        channels = [self._channels[i] for i in selection]
        colours = tuple(
            _COLOURS[self._ids.index(channel.sensor) % len(_COLOURS)] + _SHADES[channel.axis] for channel in channels
        )
        labels = tuple(channel.label for channel in channels)
        return PlotLines(*thin_extremes(time_s, shown, _MOST_POINTS), ends, span, labels, colours, at)


def residuals_of(array: SensorArray, rows: Readings, positions_m: FloatArray, moments_Am2: FloatArray) -> FloatArray:
    """Return the readings (n, C) minus the predictions of a source [T].

    ``positions_m``, ``moments_Am2`` (n, 3): source in the world if the rows have poses, otherwise in the array's frame.
    """
    if rows.pose is not None:
        origins_m, back = rows.pose[0], rows.pose[1].inv()
        positions_m, moments_Am2 = back.apply(positions_m - origins_m), back.apply(moments_Am2)
    return rows.values_T - predicted_channels(array, positions_m, moments_Am2)


def plot_channels(array: SensorArray) -> list[Channel]:
    """Return the channels of an array by sensor and axis."""
    return [
        Channel(name, sensor.id, axis)
        for sensor in array.sensors
        for name, axis in zip(sensor.channel_names, "xyz" if sensor.kind == "vector" else ("",), strict=True)
    ]


def differences_from_mean(array: SensorArray, readings_T: FloatArray) -> FloatArray:
    """Return the calibrated fields minus the mean of all sensors of the same kind (n, C) [T].

    ``readings_T`` (n, C): readings [T], NaN where missing. Vector sensors give components along the array's axes; NaN
    where a reading of the sensor is missing.
    """
    fields = array.calibrated_field(readings_T)
    result = np.full(readings_T.shape, np.nan)
    channels = array.sensor_channels
    vector = np.array([sensor.kind == "vector" for sensor in array.sensors])
    if vector.any():
        differences = fields[:, vector] - _finite_mean(fields[:, vector])
        result[:, channels[vector].ravel()] = differences.reshape(len(result), -1)
    if not vector.all():
        scalar = channels[~vector, 0]
        moduli = (readings_T - array.channel_offset_T)[:, scalar] / array.channel_gain[scalar, 0]
        result[:, scalar] = moduli - _finite_mean(moduli)
    return result


def thin_extremes(time_s: FloatArray, values: FloatArray, most: int) -> tuple[FloatArray, FloatArray]:
    """Reduce lines to the least and the greatest value of every interval of time.

    ``time_s`` (n,): ascending times [s]. ``values`` (n, C): NaN where missing. ``most``: largest number of points.
    Returns times (k,) and values (k, C); they contain all extreme values.
    """
    if len(time_s) <= most:
        return time_s, values
    first = np.linspace(0, len(time_s), most // 2, endpoint=False).astype(np.intp)
    last = np.append(first[1:], len(time_s)) - 1
    extremes = np.stack([np.fmin.reduceat(values, first, axis=0), np.fmax.reduceat(values, first, axis=0)], axis=1)
    return np.stack([time_s[first], time_s[last]], axis=1).ravel(), extremes.reshape(-1, values.shape[1])


def span_of(values: FloatArray) -> tuple[float, float]:
    """Return limits around the finite values, with a margin."""
    known = values[np.isfinite(values)]
    low, high = (float(known.min()), float(known.max())) if known.size else (-1.0, 1.0)
    margin = 0.05 * (high - low) or 0.05 * abs(high) or 1.0
    return low - margin, high + margin


def _finite_mean(values: FloatArray) -> FloatArray:
    """Return the mean of the finite values along the second axis, which has length 1 then."""
    known = np.isfinite(values)
    with np.errstate(invalid="ignore"):
        mean: FloatArray = np.where(known, values, 0.0).sum(axis=1, keepdims=True) / known.sum(axis=1, keepdims=True)
    return mean
