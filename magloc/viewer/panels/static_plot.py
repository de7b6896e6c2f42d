"""The readings in a page without a server: drawn once, with a cursor that moves with the page's player and moves it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from html import escape

import numpy as np
from matplotlib.ticker import MaxNLocator

from arrays.typing import FloatArray
from magloc.viewer.panels.readings_plot import PlotLines, ReadingsPlot
from magloc.viewer.scene.legend import NARROW_PX

_LEFT, _RIGHT, _TOP, _BOTTOM = 52.0, 352.0, 8.0, 172.0  # of the axes [px]
_SIZE = (360, 200)
# viser's player says its time in a slider, and takes one from its input, in which it stands rounded.
_CURSOR = """
(() => {
  const {begin, step, x, values} = %s;
  const box = document.getElementById('readings'), kind = box.querySelector('select');
  const plots = [...box.querySelectorAll('svg')], numbers = [...box.querySelectorAll('b')];
  let at = 0;
  const show = () => {
    plots.forEach((plot, i) => {
      plot.style.display = i === kind.selectedIndex ? 'block' : 'none';
      plot.querySelector('.now').setAttribute('transform', `translate(${x[at]})`);
    });
    numbers.forEach((number, i) => { number.textContent = values[kind.selectedIndex][at][i]; });
  };
  const follow = () => {
    const slider = document.querySelector('[role=slider]');
    const now = slider ? Math.floor((Number(slider.ariaValueNow) - begin) / step + 1e-3) + 1 : 0;
    const row = Math.min(Math.max(now, 0), x.length - 1);
    if (row !== at) { at = row; show(); }
  };
  const seek = event => {
    if (!event.buttons) return;
    const plot = event.currentTarget, wanted = event.offsetX * plot.viewBox.baseVal.width / plot.clientWidth;
    let row = 1;
    x.forEach((place, i) => { if (i && Math.abs(place - wanted) < Math.abs(x[row] - wanted)) row = i; });
    const time = document.querySelector('input[inputmode=decimal]');
    if (!time || row === at) return;
    Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, 'value').set.call(time, begin + (row - 0.5) * step);
    time.dispatchEvent(new Event('input', {bubbles: true}));
  };
  plots.forEach(plot => ['pointerdown', 'pointermove'].forEach(name => plot.addEventListener(name, seek)));
  kind.addEventListener('change', show);
  const changed = {subtree: true, attributes: true, attributeFilter: ['aria-valuenow']};
  new MutationObserver(follow).observe(document.body, changed);
  box.open = innerWidth > %d;
  show();
})();
"""


def static_plot(plot: ReadingsPlot, rows: Sequence[int], begin_s: float, step_s: float) -> str:
    """The plot as HTML and a script; `rows` are those that the player shows: at first, and from a time on at steps."""
    kinds = [plot.lines(kind) for kind in plot.kinds]
    time = kinds[0].since_first_s
    across = _scaled(kinds[0].at(rows)[0], (time[0], time[-1]), (_LEFT, _RIGHT))
    cursor = {
        "begin": begin_s,
        "step": step_s,
        "x": across.round(2).tolist(),
        "values": [[[_number(value) for value in row] for row in lines.at(rows)[1]] for lines in kinds],
    }
    options = "".join(f"<option>{escape(kind)}</option>" for kind in plot.kinds)
    channels = "".join(
        f'<span><i style="display:inline-block;width:.8em;height:.25em;margin:.25em;background:{colour}"></i>'
        f"{escape(label)} <b></b></span>"
        for label, colour in zip(kinds[0].labels, kinds[0].colours, strict=True)
    )
    return (
        '<details id="readings" class="box" open style="top:.8em;right:.8em">'
        '<summary style="font-weight:600;padding:.5em .6em .2em;cursor:pointer">Readings [nT]</summary>'
        '<div style="padding:0 .6em .5em;font-size:.75rem;width:18rem">'
        f'<select aria-label="Show" style="font:inherit">{options}'
        f"</select>{''.join(map(_svg, kinds))}"
        '<div style="display:grid;grid-template-columns:repeat(auto-fill,minmax(5.4rem,1fr))">'
        f"{channels}</div></div></details><script>{_CURSOR % (json.dumps(cursor), NARROW_PX)}</script>"
    )


def _svg(lines: PlotLines) -> str:
    """One kind of readings over time: axes, a path for every channel, and the cursor at x = 0."""
    time, (low, high) = lines.since_first_s, lines.span
    x = _scaled(time, (time[0], time[-1]), (_LEFT, _RIGHT)).round(1)
    y = _scaled(lines.values, (low, high), (_BOTTOM, _TOP)).round(1)
    paths = "".join(
        f'<path d="{_path(x, channel)}" stroke="{colour}"/>' for channel, colour in zip(y.T, lines.colours, strict=True)
    )
    levels = _ticks(low, high)
    axes = "".join(
        f'<text x="{_LEFT - 5}" y="{at + 3:.1f}" text-anchor="end">{level:g}</text>'
        f'<path d="M{_LEFT} {at:.1f}H{_RIGHT}" stroke="currentColor" opacity=".15"/>'
        for level, at in zip(levels, _scaled(levels, (low, high), (_BOTTOM, _TOP)), strict=True)
    )
    times = _ticks(float(time[0]), float(time[-1]))
    axes += "".join(
        f'<text x="{at:.1f}" y="{_BOTTOM + 13}" text-anchor="middle">{level:g}</text>'
        for level, at in zip(times, _scaled(times, (time[0], time[-1]), (_LEFT, _RIGHT)), strict=True)
    )
    width, height = _SIZE
    return (
        f'<svg viewBox="0 0 {width} {height}" style="width:100%;cursor:crosshair;touch-action:none;user-select:none"'
        f' font-size="11" fill="currentColor">{axes}'
        f'<text x="{_RIGHT}" y="{height - 3}" text-anchor="end">time since the first row [s]</text>'
        f'<g fill="none" stroke-linecap="round" stroke-linejoin="round">{paths}</g>'
        f'<path class="now" d="M0 {_TOP}V{_BOTTOM}" stroke="#808080" stroke-width="1.5"/></svg>'
    )


def _path(x: FloatArray, y: FloatArray) -> str:
    """A path that is broken where a value is missing; a value alone is a dot."""
    known = np.isfinite(y)
    begins = known & ~np.concatenate([[False], known[:-1]])
    return "".join(
        f"{'M' if begins[i] else 'L'}{x[i]:g} {y[i]:g}{'h0' * bool(begins[i])}" for i in np.flatnonzero(known)
    )


def _scaled(values: FloatArray, span: tuple[float, float], to: tuple[float, float]) -> FloatArray:
    """Values of a span as places between two others; all are at the first where the span is empty."""
    return to[0] + (values - span[0]) * ((to[1] - to[0]) / ((span[1] - span[0]) or 1.0))


def _ticks(low: float, high: float) -> FloatArray:
    """Round numbers from one to another."""
    ticks = np.asarray(MaxNLocator(5).tick_values(low, high))
    return ticks[(ticks >= low) & (ticks <= high)]


def _number(value: float) -> str:
    return f"{value:.5g}" if np.isfinite(value) else "–"
