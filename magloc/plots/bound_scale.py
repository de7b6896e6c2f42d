"""Colour scale, contours and texts of all figures of Cramér-Rao bounds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from arrays.typing import FloatArray
from magloc.plots import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from magloc.bounds.maps import BoundScenario

COLOURS = "viridis"
ON_DARK, _ON_LIGHT = "#ffffff", "#000000"
_DECADES = 10.0 ** np.arange(-9, 10)
_LIGHT_FROM = 0.65  # part of the colour scale above which lines are black


def label_accuracy(ax: Axes, scenario: BoundScenario, values_m: FloatArray) -> None:
    """Add the required accuracy to the legend; state if it is met everywhere or nowhere."""
    known = values_m[np.isfinite(values_m)]
    met, text = known <= scenario.accuracy_m, f"required: {style.length_label(scenario.accuracy_m)}"
    if met.all() or not met.any():
        text += f", met {'everywhere' if met.all() else 'nowhere'}"
    ax.plot([], [], color=style.ORANGE, lw=1.8, label=text)


def sigma_unit(values_m: FloatArray, most_m: float) -> tuple[str, float]:
    """Return the unit of a σ for short numbers on its colour bar, and the units in a metre."""
    return style.axis_unit(0.999 * _limits(log_norm(values_m, most_m))[1])


def log_norm(values: FloatArray, most: float) -> LogNorm:
    """Return a logarithmic scale over the decades of most values, at most five."""
    positive = values[np.isfinite(values) & (values > 0.0)]
    low, high = np.log10(np.percentile(positive, [2.0, 98.0])) if positive.size else (0.0, 1.0)
    top = min(np.ceil(high - 0.1), np.ceil(np.log10(most) - 0.1))
    bottom = max(min(np.floor(low + 0.1), top - 1.0), top - 5.0)
    return LogNorm(10.0**bottom, 10.0**top)


def contour_levels(values: FloatArray, norm: LogNorm, accuracy: float | None) -> list[float]:
    """Return contour levels: powers of ten, with 2 and 5 between them where they are few."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return []
    lowest, highest = _limits(norm)
    low, high = max(float(finite.min()), 0.999 * lowest), min(float(finite.max()), 1.001 * highest)
    steps = (1.0, 2.0, 5.0) if high < 300.0 * low else (1.0,)
    every = np.sort(np.outer(_DECADES, steps).ravel())
    # Labels of levels near the required accuracy would overlap its line.
    return [
        float(f"{level:.3g}")
        for level in every
        if low < level < high and (accuracy is None or abs(np.log(level / accuracy)) > 0.25)
    ]


def _limits(norm: LogNorm) -> tuple[float, float]:
    return float(norm.vmin or 0.0), float(norm.vmax or 0.0)


def fill_infinite(ax: Axes, values: FloatArray, norm: LogNorm) -> FloatArray:
    """Replace infinite values by the last colour, with a text if no value is finite."""
    infinite = np.isinf(values)
    if infinite.any() and not np.isfinite(values).any():
        ax.text(
            0.5, 0.3, "infinite: not to be known", transform=ax.transAxes, ha="center", va="center",
            fontsize=style.FONT_SIZE,
        )  # fmt: skip
    return np.where(infinite, 10.0 * _limits(norm)[1], values)


def draw_contours(
    ax: Axes,
    across: FloatArray,
    up: FloatArray,
    values: FloatArray,
    norm: LogNorm,
    levels: Sequence[float],
    accuracy: float | None,
) -> Any:
    """Draw thin contours at the levels, which are returned, and a thick one at the accuracy."""
    finite = np.where(np.isfinite(values), values, np.nan)
    if np.isnan(finite).all():
        return None
    log = np.log10(finite)
    options: dict[str, Any] = {"linestyles": "solid", "zorder": 1.5}
    low, high = np.nanmin(finite), np.nanmax(finite)
    lines = None
    inside = [level for level in levels if low < level < high]
    if inside:
        lines = ax.contour(
            across, up, log, levels=np.log10(inside), colors=_line_colours(inside, norm), linewidths=0.6, **options
        )
    if accuracy is not None and low < accuracy < high:
        ax.contour(across, up, log, levels=[np.log10(accuracy)], colors=[style.ORANGE], linewidths=1.8, **options)
    return lines


def _line_colours(levels: Sequence[float], norm: LogNorm) -> list[str]:
    return [ON_DARK if norm(level) < _LIGHT_FROM else _ON_LIGHT for level in levels]


def add_colour_bar(figure: Figure, beside: Axes, norm: LogNorm, label: str) -> Any:
    """Add a colour bar to the right of a panel, as high as the panel."""
    place = beside.get_position()
    bar = figure.colorbar(
        ScalarMappable(norm, COLOURS),
        cax=figure.add_axes((place.x1 + 0.016, place.y0, 0.014, place.height)),
        extend="both",
    )
    bar.set_label(label, fontsize=style.FONT_SIZE)
    bar.ax.tick_params(labelsize=style.SMALL_FONT_SIZE, which="major", length=2.0)
    bar.ax.tick_params(which="minor", length=0.0)
    bar.ax.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    bar.ax.yaxis.set_minor_formatter("")
    return bar


def mark_levels(bar: Any, levels: Sequence[float], accuracy: float | None, norm: LogNorm) -> None:
    """Draw the contour levels on the colour bar, because contours on a sphere have no labels."""
    low, high = _limits(norm)
    for level, colour in zip(levels, _line_colours(levels, norm), strict=True):
        bar.ax.axhline(level, color=colour, lw=0.6)
    if accuracy is not None and low < accuracy < high:
        bar.ax.axhline(accuracy, color=style.ORANGE, lw=1.8)
    bar.set_ticks([level for level in levels if low <= level <= high])


def scenario_text(scenario: BoundScenario) -> str:
    """Return the name of the array and the size of the moment."""
    size = float(np.linalg.norm(scenario.moment_Am2))
    return f"{_array_text(scenario)}, {size:.4g} A·m²"


def _array_text(scenario: BoundScenario) -> str:
    array = scenario.array
    kinds: Sequence[str] = sorted({sensor.kind for sensor in array.sensors})
    return array.name or f"an array of {array.n_sensors} {' and '.join(kinds)} sensors"
