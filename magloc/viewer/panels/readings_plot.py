"""Readings as a live plot beside the scene, with the player's time marked.

Use, inside a tab or folder of the GUI::

    plot = ReadingsPlot(server, readings, array)      # magloc.readings.Readings, arrays.array.SensorArray
    plot.show_row(index)                              # marks the time of a row of the readings
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import viser
from viser import uplot

from arrays.array import SensorArray
from arrays.typing import FloatArray
from magloc.measurement.differences import predicted_channels
from magloc.readings import Readings
from magloc.viewer.panels.latest import Latest

RAW = "readings"
DIFFERENCES = "differences from the mean"
RESIDUALS = "residuals of the differences"
TICKED, ALL = "those ticked", "all"
# Okabe and Ito, without yellow, which is not seen on white; all are seen on a dark page.
_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#666666")
# Opacities of the axes. Dashes of noise take a browser without a graphics card a second a picture, and cannot be told.
_SHADES = {"x": "", "y": "bf", "z": "80", "": ""}
_MOST_POINTS = 400
_MOST_CHANNELS_AT_FIRST = 12


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


class PlotLines(NamedTuple):
    """Lines of the channels that are chosen, in the order of time.

    Attributes
    ----------
    since_first_s : ndarray, shape (k,)
        Thinned to what can be seen.
    values : ndarray, shape (k, C)
        NaN where missing [nT].
    span : tuple of 2 floats
        Of the axis [nT].
    labels, colours : tuple of str
        Of the C channels.
    at : callable
        Times (m,) [s] and values (m, C) [nT] of rows (m,) of the readings, not thinned.
    """

    since_first_s: FloatArray
    values: FloatArray
    span: tuple[float, float]
    labels: tuple[str, ...]
    colours: tuple[str, ...]
    at: Callable[[Sequence[int]], tuple[FloatArray, FloatArray]]


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
        self.index = 0
        gui = server.gui
        with gui.add_folder("Readings"):
            self.kind_dropdown = gui.add_dropdown(
                "Show",
                (RAW, DIFFERENCES) if residuals_T is None else (RAW, DIFFERENCES, RESIDUALS),
                hint="Differences are of the field in the array's axes, from the mean of the sensors with a reading.",
            )
            series, data, scales = self._lines([0])
            self.plot = gui.add_uplot(
                data,
                series,
                scales=scales,
                axes=(
                    uplot.Axis(label=f"time {'since the first' if window_s is None else 'before the last'} row [s]"),
                    uplot.Axis(label="field [nT]", size=76.0),
                ),
                aspect=1.2,
            )
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

    def take(self, readings: Readings, residuals_T: FloatArray | None = None) -> None:
        """Show other readings of the array in place of those so far, and mark the last row."""
        self._hold(readings, residuals_T)
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

    def lines(self, kind: str) -> PlotLines:
        """What it shows of a kind, to be drawn elsewhere."""
        chosen = self._chosen()
        (_, *series, _), time, values, span = self._thinned(kind, tuple(chosen))

        def at(rows: Sequence[int]) -> tuple[FloatArray, FloatArray]:
            places = self._rank[list(rows)]
            return self._time_s[places], self._values_nT(kind)[places][:, chosen]

        labels, colours = (tuple(str(one[key]) for one in series) for key in ("label", "stroke"))
        return PlotLines(time, values, span, labels, colours, at)

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
        series, data, scales = self._lines(self._chosen())
        # All change together, or the page would draw a line without data. New series or scales make a new chart, which
        # forgets how far the user has zoomed in.
        with self._server.atomic():
            if self.plot.series != series:
                self.plot.series = series
            if self.plot.scales != scales:
                self.plot.scales = scales
            self.plot.data = data

    def _lines(
        self, chosen: list[int]
    ) -> tuple[tuple[uplot.Series, ...], tuple[FloatArray, ...], dict[str, uplot.Scale]]:
        """What uPlot draws: the time, the channels, and the mark; and from where to where."""
        kind = self.kind_dropdown.value
        series, time, shown, span = self._thinned(kind, tuple(chosen))
        row = int(self._rank[self.index]) if len(self._rank) else 0
        time, shown, mark = with_mark(time, shown, float(self._time_s[row]), self._values_nT(kind)[row, chosen])
        # uPlot finds no range of its own where a number is missing.
        scales = {
            "x": uplot.Scale(time=False, **({} if self._window_s is None else {"range": (-self._window_s, 0.0)})),
            "y": uplot.Scale(range=span),
            "mark": uplot.Scale(range=(0.0, 1.0)),
        }
        return series, (time, *shown.T, mark), scales

    def _computed_nT(self, kind: str) -> FloatArray:
        """Readings (n, C), their differences, or what a source leaves of these, in the order of time."""
        if kind == RAW:
            return 1e9 * self._values_T
        of = self._values_T if kind != RESIDUALS or self._residuals_T is None else self._residuals_T
        return 1e9 * differences_from_mean(self._array, of)

    def _thinned_lines(
        self, kind: str, chosen: tuple[int, ...]
    ) -> tuple[tuple[uplot.Series, ...], FloatArray, FloatArray, tuple[float, float]]:
        """Series, times, values (k, chosen) and their span, of no more points than can be seen."""
        values = self._values_nT(kind)[:, chosen]
        series = [uplot.Series(label="time [s]")]
        for column, i in enumerate(chosen):
            channel = self._channels[i]
            colour = _COLOURS[self._ids.index(channel.sensor) % len(_COLOURS)] + _SHADES[channel.axis]
            broken = bool(np.isnan(values[:, column]).any())
            series.append(_series(channel, colour, broken=broken))
        series.append(uplot.Series(label="now", scale="mark", stroke="#808080", width=1.5, points={"show": False}))
        return tuple(series), *thinned(self._time_s, values, _MOST_POINTS), span_of(values)


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


def with_mark(
    time_s: FloatArray, values: FloatArray, at_s: float, values_there: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Lines, and a mark that is 1 at one time and 0 elsewhere: three points are put in there.

    ``time_s`` (k,). ``values`` (k, C). ``values_there`` (C,): values of the lines at that time. Returns times,
    values and the mark, of k + 3 rows each.
    """
    place = int(np.searchsorted(time_s, at_s, side="right"))
    mark = np.zeros(len(time_s) + 3)
    mark[place + 1] = 1.0
    return np.insert(time_s, place, [at_s] * 3), np.insert(values, place, [values_there] * 3, axis=0), mark


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


def _series(channel: Channel, colour: str, *, broken: bool) -> uplot.Series:
    """A line; only points where readings are missing, because the line would run across the gaps."""
    if broken:
        return uplot.Series(
            label=channel.label, stroke=colour, width=0.0, points={"show": True, "size": 3.0, "fill": colour}
        )
    return uplot.Series(label=channel.label, stroke=colour, width=1.2, points={"show": False})
