"""Figure of the quality of a field log."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from magloc.plots import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from magloc.deliverables.quality_result import Quality

_MOST_POINTS = 20_000
_BLOCKS = 120  # of the noise in time
_COLOURS = (style.BLUE, style.ORANGE, style.BLACK, style.GREY)


def quality_figure(quality: Quality) -> Figure:
    """Draw the lines by their height, the strips between them, speed, and the noise of every sensor in time."""
    x, y, _ = quality.place_m.T
    height = style.WIDTH_IN * 0.5 * float(np.clip(np.ptp(y) / max(np.ptp(x), 1e-9), 0.12, 1.6)) + 1.0
    figure = style.new_figure(height + 2.2)
    (lines, strips), (speed, noise) = figure.subplots(2, 2, height_ratios=[height, 2.2])
    shown = slice(None, None, -(-len(x) // _MOST_POINTS))
    points = lines.scatter(x[shown], y[shown], c=quality.height_m[shown], s=1.5, lw=0.0, rasterized=True)
    _add_bar(figure, lines, points, "height above ground [m]")
    for start_s in quality.gaps.start_s:
        row = int(np.searchsorted(quality.time_s, start_s))
        lines.plot(x[row : row + 2], y[row : row + 2], "o-", color=style.ORANGE, ms=2.5, lw=0.8)
    style.label_axes(lines, "x, east [m]", "y, north [m]", "rows; gaps in orange")
    _draw_strips(figure, strips, quality)
    strips.set(xlim=lines.get_xlim(), ylim=lines.get_ylim())
    time_s = quality.time_s - quality.time_s[0]
    step_s = np.diff(time_s)
    speeds = np.linalg.norm(np.diff(quality.place_m[:, :2], axis=0), axis=1) / step_s
    speed.plot(time_s[1:][shown], speeds[shown], color=style.BLACK, lw=0.6)
    for start_s, duration_s in zip(quality.gaps.start_s - quality.time_s[0], quality.gaps.duration_s, strict=True):
        speed.axvspan(start_s, start_s + duration_s, color=style.ORANGE, alpha=0.3, lw=0.0)
    style.label_axes(speed, "time [s]", "speed [m/s]")
    _draw_noise(noise, quality)
    return figure


def _draw_strips(figure: Figure, ax: Axes, quality: Quality) -> None:
    """Draw twice the distance from the nearest line: the width of the strip between lines."""
    coverage = quality.coverage
    style.label_axes(ax, "x, east [m]", "", "width of the strips between lines")
    ax.set_aspect("equal")
    ax.grid(visible=False)
    if coverage is None:
        return
    ends = coverage.corner_m + coverage.cell_m * np.array(coverage.distance_m.shape)
    extent = (coverage.corner_m[0], ends[0], coverage.corner_m[1], ends[1])
    most = max(coverage.widest_m, 2.0 * coverage.spacing_m)
    image = ax.imshow(2.0 * coverage.distance_m.T, origin="lower", extent=extent, vmin=0.0, vmax=most, cmap="viridis")
    _add_bar(figure, ax, image, "m")


def _draw_noise(ax: Axes, quality: Quality) -> None:
    """Draw the noise of every sensor in blocks of rows."""
    n = len(quality.time_s)
    blocks = np.array_split(np.arange(n), min(_BLOCKS, max(n // 40, 1)))
    time_s = [float(quality.time_s[block].mean() - quality.time_s[0]) for block in blocks]
    values = np.array([quality.noise_in(block) for block in blocks]) * 1e9
    for i, sensor in enumerate(quality.array.sensors):
        ax.plot(time_s, values[:, i], color=_COLOURS[i % len(_COLOURS)], lw=0.8, label=sensor.id)
    style.set_log_scale(ax, [values])
    style.label_axes(ax, "time [s]", "noise [nT]")
    style.add_legend(ax)


def _add_bar(figure: Figure, ax: Axes, shown: object, label: str) -> None:
    ax.set_aspect("equal")
    bar = figure.colorbar(shown, ax=ax, orientation="horizontal", shrink=0.8, aspect=30)  # type: ignore[arg-type]
    bar.ax.tick_params(labelsize=style.SMALL_FONT_SIZE)
    bar.set_label(label, fontsize=style.FONT_SIZE)
