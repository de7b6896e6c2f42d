"""Plot of lines over time as an SVG, with a cursor above it, for served and static pages."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from html import escape
from typing import NamedTuple

import numpy as np
from matplotlib.ticker import MaxNLocator

from arrays.typing import FloatArray

_LEFT, _RIGHT, _TOP, _BOTTOM = 46.0, 278.0, 12.0, 152.0  # of the axes [px]
_WIDTH, _HEIGHT = 288, 180
_UNITS_PER_PX = 10  # coordinates of paths are whole numbers
_MOST_NUMBERS = 36
_DIGITS = 4  # of the numbers at the cursor, relative to the span of the axis

# Functions for a press of the mouse on a plot, which selects a time by writing it into an input.
POINTER_SCRIPT = f"""
const plotX = (plot, event) => {{
  const box = plot.getBoundingClientRect();
  return (event.clientX - box.left) / box.width * {_WIDTH};
}};
const plotTime = (plot, event) => {{
  const share = (plotX(plot, event) - {_LEFT:g}) / {_RIGHT - _LEFT:g};
  const [begin, end] = [Number(plot.dataset.begin), Number(plot.dataset.end)];
  return begin + Math.min(Math.max(share, 0), 1) * (end - begin);
}};
const setInput = (input, value) => {{
  Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, 'value').set.call(input, value);
  input.dispatchEvent(new Event('input', {{bubbles: true}}));
}};
const onPlotPointer = (element, act) => ['pointerdown', 'pointermove'].forEach(name =>
  element.addEventListener(name, event => {{
    const plot = event.buttons && event.target.closest && event.target.closest('svg.lines');
    if (plot) act(plot, event);
  }}));
"""


class PlotLines(NamedTuple):
    """Lines of channels in the order of time.

    Attributes
    ----------
    since_first_s : ndarray, shape (k,)
        Times, thinned to the resolution of the plot.
    values : ndarray, shape (k, C)
        Values [nT], NaN where missing.
    ends_s, span : tuple of 2 floats
        Limits of the axis of time [s] and of that of the values [nT].
    labels, colours : tuple of str
        Labels and colours of the C channels.
    at : callable
        It returns the times (m,) [s] and values (m, C) [nT] of rows (m,) of the readings.
    """

    since_first_s: FloatArray
    values: FloatArray
    ends_s: tuple[float, float]
    span: tuple[float, float]
    labels: tuple[str, ...]
    colours: tuple[str, ...]
    at: Callable[[Sequence[int]], tuple[FloatArray, FloatArray]]


def lines_svg(lines: PlotLines, time_words: str) -> str:
    """Return the plot with its axes and a path for every channel."""
    x = across(lines, lines.since_first_s)
    paths = "".join(
        f'<path d="{path_of(_UNITS_PER_PX * x, _UNITS_PER_PX * channel)}" stroke="{colour}"/>'
        for channel, colour in zip(_scale(lines.values, lines.span, (_BOTTOM, _TOP)).T, lines.colours, strict=True)
    )
    levels, times = _axis_ticks(lines.span), _axis_ticks(lines.ends_s)
    axes = "".join(
        f'<text x="{_LEFT - 4:g}" y="{at + 3.5:.1f}" text-anchor="end">{text}</text>'
        f'<path d="M{_LEFT:g} {at:.1f}H{_RIGHT:g}" stroke="currentColor" opacity=".15"/>'
        for text, at in zip(tick_texts(levels), _scale(levels, lines.span, (_BOTTOM, _TOP)), strict=True)
    )
    axes += "".join(
        f'<text x="{at:.1f}" y="{_BOTTOM + 12:g}" text-anchor="middle">{text}</text>'
        for text, at in zip(tick_texts(times), across(lines, times), strict=True)
    )
    begin, end = lines.ends_s
    return (
        f'<svg class="lines" data-begin="{begin:.9g}" data-end="{end:.9g}" viewBox="0 0 {_WIDTH} {_HEIGHT}"'
        ' style="display:block;width:100%;overflow:visible;cursor:crosshair;touch-action:none;user-select:none;'
        f'will-change:transform" font-size="10" fill="currentColor">{axes}<text x="2" y="9">nT</text>'
        f'<text x="{_RIGHT:g}" y="{_HEIGHT - 3}" text-anchor="end">{escape(time_words)}</text>'
        f'<g fill="none" stroke-width="{1.2 * _UNITS_PER_PX:g}" stroke-linecap="round" stroke-linejoin="round"'
        f' transform="scale({1 / _UNITS_PER_PX:g})">{paths}</g></svg>'
    )


def cursor_svg(x: float | None) -> str:
    """Return a vertical line at a place in the plot before it; None hides the line.

    The line is in a separate layer, so that the browser does not redraw the plot when it moves.
    """
    line = "" if x is None else f'<path class="now" d="M0 {_TOP:g}V{_BOTTOM:g}" transform="translate({x:.2f})"/>'
    return (
        f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" stroke="#808080" stroke-width="1.5" style="display:block;width:100%;'
        f'margin-top:-{100 * _HEIGHT / _WIDTH:.4f}%;position:relative;pointer-events:none;will-change:transform">'
        f"{line}</svg>"
    )


def numbers_html(lines: PlotLines, values: Sequence[float] | None = None) -> str:
    """Return colour, name and value of every channel, or nothing for too many channels."""
    if len(lines.labels) > _MOST_NUMBERS:
        return ""
    texts = [""] * len(lines.labels) if values is None else number_texts(lines, values)
    cells = "".join(
        f'<span style="white-space:nowrap"><i style="display:inline-block;width:.8em;height:.25em;margin:.25em;'
        f'background:{colour}"></i>{escape(label)} <b class="of-channel">{text}</b></span>'
        for label, colour, text in zip(lines.labels, lines.colours, texts, strict=True)
    )
    return (
        '<div style="display:grid;grid-template-columns:repeat(auto-fill,minmax(5.4rem,1fr));font-size:.75rem">'
        f"{cells}</div>"
    )


def across(lines: PlotLines, time_s: FloatArray) -> FloatArray:
    """Return the positions of times along the axis [px]."""
    return _scale(time_s, lines.ends_s, (_LEFT, _RIGHT))


def path_of(x: FloatArray, y: FloatArray) -> str:
    """Return a path in whole numbers, with gaps at missing values and dots for single values."""
    known = np.isfinite(y)
    if not known.any():
        return ""
    points = np.column_stack([x, y])[known].round().astype(np.int64)
    runs = np.split(points, np.flatnonzero(np.diff(np.flatnonzero(known)) > 1) + 1)
    return "".join(f"M{' '.join(map(str, run.ravel().tolist()))}{'h0' * (len(run) == 1)}" for run in runs)


def number_texts(lines: PlotLines, values: Sequence[float]) -> list[str]:
    """Return the values with somewhat more decimals than the plot resolves."""
    decimals = max(0, _DIGITS - int(np.floor(np.log10(lines.span[1] - lines.span[0]))))
    return [_decimal_text(value, decimals) if np.isfinite(value) else "–" for value in values]


def tick_texts(ticks: FloatArray) -> list[str]:
    """Return numbers with as many decimals as distinguish them."""
    step = float(np.diff(ticks).min()) if len(ticks) > 1 else 1.0
    decimals = max(0, -int(np.floor(np.log10(step) + 1e-9)))
    return [_decimal_text(tick, decimals) for tick in ticks.tolist()]


def _decimal_text(value: float, decimals: int) -> str:
    return f"{round(value, decimals) + 0.0:.{decimals}f}".replace("-", "\N{MINUS SIGN}")


def _scale(values: FloatArray, span: tuple[float, float], to: tuple[float, float]) -> FloatArray:
    """Map values linearly from a span to another one; an empty span maps to the first end."""
    return to[0] + (values - span[0]) * ((to[1] - to[0]) / ((span[1] - span[0]) or 1.0))


def _axis_ticks(span: tuple[float, float]) -> FloatArray:
    """Return round numbers within a span."""
    ticks = np.asarray(MaxNLocator(5).tick_values(*span))
    return ticks[(ticks >= span[0]) & (ticks <= span[1])]
