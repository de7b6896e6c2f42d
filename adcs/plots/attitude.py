"""Figures of attitude filters: errors or estimates over time with ±3σ, and their consistency."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from adcs import quaternion
from adcs.kalman.results import STATE_UNITS, state_table
from adcs.satellite.attitude_track import AttitudeTrack
from adcs.satellite.sensors import NIS_SIZES, SENSOR_WORDS, SENSORS
from arrays.typing import BoolArray, FloatArray
from magloc.plots import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MILLIONTHS = "disturbance"
"""State that is drawn in millionths of its unit."""
_TRANSIENT = 0.25
"""Part of the time that does not count for limits and shares."""
_SENSOR_STYLES = ((style.BLACK, "-"), (style.BLUE, "--"), (style.ORANGE, "-."), ("#009e73", ":"))


def sensor_gaps(
    seen: Mapping[str, BoolArray], used: Iterable[str], degraded: Mapping[str, BoolArray]
) -> list[tuple[str, BoolArray]]:
    """Return labels of missing sensors and other degradations, with the unaffected rows (n,)."""
    gaps = [(f"no {SENSOR_WORDS.get(name, name)}", seen[name]) for name in used]
    gaps += [(text, ~rows) for text, rows in degraded.items()]
    return [(text, is_good) for text, is_good in gaps if not is_good.all()]


def attitude_figure(track: AttitudeTrack, name: str = "") -> Figure:
    """Draw the states of a track.

    The attitude is a rotation vector from the orbital frame, or from the frame of the track's vectors.
    """
    attitude = quaternion.log(track.q if track.q_orbital is None else track.q_orbital)
    values = state_table({"attitude": attitude} | dict(track.states))
    sigma = state_table(track.sigma) if track.sigma else np.full_like(values, np.nan)
    gaps = sensor_gaps(track.seen, track.used, track.degraded)
    title = f"{name}: {track.title}" if name else track.title
    return states_figure(
        title, track.time_s, values, sigma, are_errors=False, tuned_disturbance_s2=track.tuned_disturbance_s2, gaps=gaps
    )


def states_figure(
    title: str,
    time_s: FloatArray,
    values: FloatArray,
    sigma: FloatArray,
    *,
    are_errors: bool,
    tuned_disturbance_s2: FloatArray | None = None,
    gaps: Sequence[tuple[str, BoolArray]] = (),
) -> Figure:
    """Draw the three axes of every state side by side, with ±3σ of the filter.

    ``values``, ``sigma`` (n, 30): estimates or errors in the units of the files of ``adcs``; NaN for a state that the
    filter does not have. The band of errors is around zero. ``tuned_disturbance_s2`` (n,): standard deviation that a
    bank of filters expects. ``gaps``: labels, and whether the data were there (n,).
    """
    # A state of nine numbers takes three rows.
    states = [state for state, shown in STATE_UNITS.items() for _ in range(len(shown.axes) // 3)]
    rows = [row for row in range(len(states)) if not np.isnan(values[:, 3 * row]).all()]
    figure = style.new_figure(1.25 * len(rows) + 0.75)
    axes = figure.subplots(len(rows), 3, sharex=True, sharey="row", squeeze=False)
    settled = time_s >= time_s[0] + _TRANSIENT * np.ptp(time_s)
    for across, row in zip(axes, rows, strict=True):
        state, shown = states[row], STATE_UNITS[states[row]]
        scale, unit = (1e6, f"1e-6{shown.unit.removeprefix('1')}") if state == _MILLIONTHS else (1.0, shown.unit)
        part = f" {'xyz'[row - states.index(state)]}" if states.count(state) > 1 else ""
        label = f"{state.replace('-', ' ')}{part} [{unit}]"
        columns = slice(3 * row, 3 * row + 3)
        drawn, wide = scale * values[:, columns], 3.0 * scale * sigma[:, columns]
        middle = np.zeros_like(drawn) if are_errors else drawn
        for axis, ax in enumerate(across):
            ax.fill_between(
                time_s,
                (middle - wide)[:, axis],
                (middle + wide)[:, axis],
                color=style.LIGHT_GREY,
                lw=0.0,
                label="±3σ of the filter" if np.isfinite(wide).any() else "_",
            )
            ax.plot(time_s, drawn[:, axis], color=style.BLUE, lw=0.8, label="error" if are_errors else "estimate")
            if state == "disturbance" and not are_errors and tuned_disturbance_s2 is not None:
                for factor in (-scale, scale):
                    ax.plot(
                        time_s,
                        factor * tuned_disturbance_s2,
                        color=style.ORANGE,
                        lw=0.8,
                        ls="--",
                        label="±1σ that the bank found" if factor > 0.0 else "_",
                    )
            for gap, there in gaps:
                style.shade_gaps(ax, time_s, there, gap)
            outside = float(np.mean(np.abs(drawn[settled, axis]) > wide[settled, axis]))
            style.label_axes(ax, "", label if axis == 0 else "", "xyz"[axis] if row == rows[0] else "")
            if are_errors and outside > 0.0:
                ax.text(
                    0.98,
                    0.95,
                    f"{_percentage(outside)} beyond 3σ",
                    transform=ax.transAxes,
                    ha="right",
                    va="top",
                    fontsize=style.SMALL_FONT_SIZE,
                )
            ax.axhline(0.0, color=style.GREY, lw=0.5, zorder=1.5)
        # The settled band fills half of the panel. Initial errors and bands may leave it, but no estimate does.
        inside = [(middle - wide)[settled], (middle + wide)[settled], drawn[settled] if are_errors else drawn]
        low, high = style.axis_limits(inside, share=1.0, margin=0.25 if are_errors else 0.05)
        across[0].set_ylim(low, high)
    for ax in axes[-1]:
        ax.set_xlabel("time [s]", fontsize=style.FONT_SIZE)
        if len(time_s) > 1:
            ax.set_xlim(time_s[0], time_s[-1])
        ax.xaxis.set_major_locator(MaxNLocator(4))
    labelled = {
        label: handle for ax in axes[:, 0] for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)
    }
    style.add_legend(figure, handles=labelled.values(), labels=labelled.keys(), loc="outside lower center", ncols=6)
    style.add_title(figure, title)
    return figure


def _percentage(part: float) -> str:
    return f"{100.0 * part:.0f} %" if part >= 0.01 else f"{100.0 * part:.1g} %"


def attitude_consistency_figure(
    title: str,
    time_s: FloatArray,
    error_deg: FloatArray,
    sigma_deg: FloatArray,
    nees: FloatArray,
    size: int,
    nis: FloatArray,
) -> Figure:
    """Draw the errors of all runs, and NEES and NIS with their bounds.

    ``error_deg`` (runs, n): angle between truth and estimate. ``sigma_deg`` (n,): its standard deviation by the filter
    in the first run, the root of the sum of squares of the axes. ``nees`` (runs, n): NEES over its degrees of freedom,
    ``size``. ``nis`` (runs, n, 4): NIS of every sensor.
    """
    return _stack_panels(
        title,
        time_s,
        lambda ax: _draw_errors(ax, time_s, error_deg, sigma_deg),
        lambda ax: _draw_nees(ax, time_s, nees, size),
        lambda ax: _draw_nis(ax, time_s, nis),
    )


def nis_figure(track: AttitudeTrack, name: str) -> Figure:
    """Draw the NIS of every sensor of a track."""
    nis = np.stack(list(track.nis.values()), axis=-1)[None]
    return _stack_panels(f"{name}: {track.title}", track.time_s, lambda ax: _draw_nis(ax, track.time_s, nis))


def _stack_panels(title: str, time_s: FloatArray, *panels: Callable[[Axes], None]) -> Figure:
    """Draw panels over time, one below the other."""
    figure = style.new_figure(1.75 * len(panels) + 0.5)
    axes = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    for ax, draw in zip(axes, panels, strict=True):
        draw(ax)
        if len(time_s) > 1:
            ax.set_xlim(time_s[0], time_s[-1])
        if ax is not axes[-1]:
            ax.set_xlabel("")
    style.add_title(figure, title)
    return figure


def _draw_errors(ax: Axes, time_s: FloatArray, error_deg: FloatArray, sigma_deg: FloatArray) -> None:
    for i, run in enumerate(error_deg):
        ax.plot(time_s, run, color=style.PALE_GREY, lw=0.4, label="each run" if i == 0 else "_", zorder=2.0)
    ax.plot(time_s, np.median(error_deg, axis=0), color=style.BLUE, lw=1.2, label="median")
    ax.plot(time_s, sigma_deg, color=style.ORANGE, lw=1.0, ls="--", label="σ of the filter, first run")
    style.set_log_scale(ax, [error_deg[:, 1:], np.empty(0)])
    n = len(error_deg)
    style.label_axes(ax, "time [s]", "attitude error [°]", f"{n} runs" if n > 1 else "one run")
    style.add_legend(ax)


def _draw_nees(ax: Axes, time_s: FloatArray, nees: FloatArray, size: int) -> None:
    low, high = style.bounds99(np.full(len(time_s), float(size * len(nees))))
    mean = nees.mean(axis=0)
    ax.fill_between(time_s, low, high, color=style.LIGHT_GREY, lw=0.0, label="99 % bounds of χ²")
    ax.plot(time_s, mean, color=style.BLUE, lw=0.9, label="mean of the runs")
    ax.axhline(1.0, color=style.GREY, lw=0.5)
    inside = float(np.mean((mean >= low) & (mean <= high)))
    style.set_log_scale(ax, [mean, low, high])
    style.label_axes(ax, "time [s]", "NEES / numbers [1]", f"NEES: {100.0 * inside:.0f} % of the instants within")
    style.add_legend(ax)


def _draw_nis(ax: Axes, time_s: FloatArray, nis: FloatArray) -> None:
    """Draw the NIS of every sensor as means over the runs and over up to 100 intervals of time."""
    width = max(1, len(time_s) // 100)
    n = len(time_s) // width * width
    times = time_s[:n].reshape(-1, width).mean(axis=1)
    drawn: list[FloatArray] = []
    for i, (sensor, (colour, line)) in enumerate(zip(SENSORS, _SENSOR_STYLES, strict=True)):
        values = nis[:, :n, i].reshape(len(nis), -1, width)
        count = np.isfinite(values).sum(axis=(0, 2)).astype(np.float64)
        if not count.any():
            continue
        numbers = NIS_SIZES[sensor]
        mean = np.where(count > 0.0, np.nansum(values, axis=(0, 2)) / np.maximum(count, 1.0), np.nan) / numbers
        if not drawn:
            low, high = style.bounds99(numbers * count)
            ax.fill_between(times, low, high, color=style.LIGHT_GREY, lw=0.0, label="99 % bounds of χ²")
            drawn += [low, high]
        ax.plot(times, mean, color=colour, ls=line, lw=0.9, label=SENSOR_WORDS[sensor])
        drawn.append(mean)
    ax.axhline(1.0, color=style.GREY, lw=0.5)
    style.set_log_scale(ax, drawn)
    title = f"NIS, mean of {width} instants" if width > 1 else "NIS"
    style.label_axes(ax, "time [s]", "NIS / numbers [1]", title)
    style.add_legend(ax)


_COMPARE_COLOURS = (style.BLACK, style.BLUE, style.ORANGE, "#009e73", "#cc79a7", "#56b4e9")
_COMPARE_LINES = ("-", "--", "-.", ":")


def compare_figure(lines: Sequence[tuple[str, FloatArray, FloatArray]]) -> Figure:
    """Draw the attitude errors of several filters over time."""
    figure = style.new_figure(3.4 + 0.15 * len(lines))
    ax = figure.add_subplot()
    for i, (name, time_s, error_deg) in enumerate(lines):
        colour = _COMPARE_COLOURS[i % len(_COMPARE_COLOURS)]
        dashes = _COMPARE_LINES[i // len(_COMPARE_COLOURS) % len(_COMPARE_LINES)]
        ax.plot(time_s, error_deg, color=colour, ls=dashes, lw=1.0, label=name)
    style.set_log_scale(ax, [error_deg[1:] for _, _, error_deg in lines])
    ax.set_xlim(0.0, max(float(time_s[-1]) for _, time_s, _ in lines))
    style.label_axes(ax, "time [s]", "attitude error [°]", "median of the runs")
    handles, labels = ax.get_legend_handles_labels()
    style.add_legend(figure, handles=handles, labels=labels, loc="outside lower center", ncols=2)
    return figure
