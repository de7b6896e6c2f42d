"""Lines over time as an SVG that is drawn once, and a cursor that moves over it; in a served page and in a file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from html import escape
from typing import NamedTuple

import numpy as np
from matplotlib.ticker import MaxNLocator

from arrays.typing import FloatArray

_LEFT, _RIGHT, _TOP, _BOTTOM = 46.0, 278.0, 12.0, 152.0  # of the axes [px]
_WIDTH, _HEIGHT = 288, 180
_FINE = 10  # to a pixel: coordinates are whole numbers
_MOST_NUMBERS = 36
_FIGURES = 4  # of the numbers at the cursor: of the axis of values

# A mouse that is pressed over the plot wants a time; who follows it is told by a number that is typed.
POINTED = f"""
const placeOf = (plot, event) => {{
  const box = plot.getBoundingClientRect();
  return (event.clientX - box.left) / box.width * {_WIDTH};
}};
const timeOf = (plot, event) => {{
  const share = (placeOf(plot, event) - {_LEFT:g}) / {_RIGHT - _LEFT:g};
  const [begin, end] = [Number(plot.dataset.begin), Number(plot.dataset.end)];
  return begin + Math.min(Math.max(share, 0), 1) * (end - begin);
}};
const typeInto = (input, value) => {{
  Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, 'value').set.call(input, value);
  input.dispatchEvent(new Event('input', {{bubbles: true}}));
}};
const whenPointed = (element, act) => ['pointerdown', 'pointermove'].forEach(name =>
  element.addEventListener(name, event => {{
    const plot = event.buttons && event.target.closest && event.target.closest('svg.lines');
    if (plot) act(plot, event);
  }}));
"""


class PlotLines(NamedTuple):
    """Lines of some channels, in the order of time.

    Attributes
    ----------
    since_first_s : ndarray, shape (k,)
        Thinned to what can be seen.
    values : ndarray, shape (k, C)
        NaN where missing [nT].
    ends_s, span : tuple of 2 floats
        Of the axis of time [s], and of that of the values [nT].
    labels, colours : tuple of str
        Of the C channels.
    at : callable
        Times (m,) [s] and values (m, C) [nT] of rows (m,) of the readings, not thinned.
    """

    since_first_s: FloatArray
    values: FloatArray
    ends_s: tuple[float, float]
    span: tuple[float, float]
    labels: tuple[str, ...]
    colours: tuple[str, ...]
    at: Callable[[Sequence[int]], tuple[FloatArray, FloatArray]]


def lines_svg(lines: PlotLines, time_words: str) -> str:
    """Axes, and a path for every channel."""
    x = across(lines, lines.since_first_s)
    paths = "".join(
        f'<path d="{path_of(_FINE * x, _FINE * channel)}" stroke="{colour}"/>'
        for channel, colour in zip(_scaled(lines.values, lines.span, (_BOTTOM, _TOP)).T, lines.colours, strict=True)
    )
    levels, times = _ticks(lines.span), _ticks(lines.ends_s)
    axes = "".join(
        f'<text x="{_LEFT - 4:g}" y="{at + 3.5:.1f}" text-anchor="end">{text}</text>'
        f'<path d="M{_LEFT:g} {at:.1f}H{_RIGHT:g}" stroke="currentColor" opacity=".15"/>'
        for text, at in zip(tick_texts(levels), _scaled(levels, lines.span, (_BOTTOM, _TOP)), strict=True)
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
        f'<g fill="none" stroke-width="{1.2 * _FINE:g}" stroke-linecap="round" stroke-linejoin="round"'
        f' transform="scale({1 / _FINE:g})">{paths}</g></svg>'
    )


def cursor_svg(x: float | None) -> str:
    """A line across the plot that stands right before it, at a place; None: it is not seen.

    It lies over the plot in a layer of its own, so that nothing else is drawn anew when it moves.
    """
    line = "" if x is None else f'<path class="now" d="M0 {_TOP:g}V{_BOTTOM:g}" transform="translate({x:.2f})"/>'
    return (
        f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" stroke="#808080" stroke-width="1.5" style="display:block;width:100%;'
        f'margin-top:-{100 * _HEIGHT / _WIDTH:.4f}%;position:relative;pointer-events:none;will-change:transform">'
        f"{line}</svg>"
    )


def numbers_html(lines: PlotLines, values: Sequence[float] | None = None) -> str:
    """Colour, name and number of every channel, in columns; of many channels nothing, for none would be found."""
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
    """Places of times along the axis [px]."""
    return _scaled(time_s, lines.ends_s, (_LEFT, _RIGHT))


def path_of(x: FloatArray, y: FloatArray) -> str:
    """A path in whole numbers that is broken where a value is missing; a value alone is a dot."""
    known = np.isfinite(y)
    if not known.any():
        return ""
    points = np.column_stack([x, y])[known].round().astype(np.int64)
    runs = np.split(points, np.flatnonzero(np.diff(np.flatnonzero(known)) > 1) + 1)
    return "".join(f"M{' '.join(map(str, run.ravel().tolist()))}{'h0' * (len(run) == 1)}" for run in runs)


def number_texts(lines: PlotLines, values: Sequence[float]) -> list[str]:
    """Values of the channels with as many decimals as tell apart what the plot does, and a little more."""
    decimals = max(0, _FIGURES - int(np.floor(np.log10(lines.span[1] - lines.span[0]))))
    return [_written(value, decimals) if np.isfinite(value) else "–" for value in values]


def tick_texts(ticks: FloatArray) -> list[str]:
    """Numbers with as many decimals as tell them apart."""
    step = float(np.diff(ticks).min()) if len(ticks) > 1 else 1.0
    decimals = max(0, -int(np.floor(np.log10(step) + 1e-9)))
    return [_written(tick, decimals) for tick in ticks.tolist()]


def _written(value: float, decimals: int) -> str:
    return f"{round(value, decimals) + 0.0:.{decimals}f}".replace("-", "\N{MINUS SIGN}")


def _scaled(values: FloatArray, span: tuple[float, float], to: tuple[float, float]) -> FloatArray:
    """Values of a span as places between two others; all are at the first where the span is empty."""
    return to[0] + (values - span[0]) * ((to[1] - to[0]) / ((span[1] - span[0]) or 1.0))


def _ticks(span: tuple[float, float]) -> FloatArray:
    """Round numbers from one to another."""
    ticks = np.asarray(MaxNLocator(5).tick_values(*span))
    return ticks[(ticks >= span[0]) & (ticks <= span[1])]
