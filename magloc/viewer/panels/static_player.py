"""Panel of a static page with a player: text of the present row, and plot of the readings with a cursor."""

from __future__ import annotations

import json
from collections.abc import Sequence
from html import escape

from magloc.viewer.panels.lines import POINTER_SCRIPT, across, cursor_svg, lines_svg, number_texts, numbers_html
from magloc.viewer.panels.readings_plot import ReadingsPlot
from magloc.viewer.scene.legend import NARROW_PX

_LOW_PX = 640  # height of a page below which the plot is folded at first

# viser's player shows its time in a slider, and rounded in an input, which also sets it. It plays from the start, and
# shows no scene before; a time in the input stops it.
_SCRIPT = """<script>
(() => {
  const {begin, step, texts, x, values} = %s;
  %s
  const box = document.getElementById('row'), kind = box.querySelector('select');
  const text = box.querySelector('.row-text'), numbers = [...box.querySelectorAll('b.of-channel')];
  const plots = [...box.querySelectorAll('svg.lines')], cursor = box.querySelector('.now');
  const input = () => document.querySelector('input[inputmode=decimal]');
  let at = 0;
  const show = () => {
    text.innerHTML = texts[at];
    if (!kind) return;
    plots.forEach((plot, i) => { plot.style.display = i === kind.selectedIndex ? 'block' : 'none'; });
    cursor.setAttribute('transform', `translate(${x[at]})`);
    numbers.forEach((number, i) => { number.textContent = values[kind.selectedIndex][at][i]; });
  };
  const follow = () => {
    const slider = document.querySelector('[role=slider]');
    const now = slider ? Math.floor((Number(slider.ariaValueNow) - begin) / step + 1e-3) + 1 : 0;
    const row = Math.min(Math.max(now, 0), texts.length - 1);
    if (row !== at) { at = row; show(); }
  };
  onPlotPointer(box, (plot, event) => {
    const place = plotX(plot, event);
    let row = 1;
    x.forEach((each, i) => { if (i && Math.abs(each - place) < Math.abs(x[row] - place)) row = i; });
    if (input() && row !== at) setInput(input(), begin + (row - 0.5) * step);
  });
  if (kind) kind.addEventListener('change', show);
  const options = {subtree: true, attributes: true, attributeFilter: ['aria-valuenow']};
  new MutationObserver(follow).observe(document.body, options);
  const timer = setInterval(() => {
    if (!input() || !(Number(input().value) > 0)) return;
    clearInterval(timer);
    setInput(input(), 0.05);
  }, 20);
  box.open = innerWidth > %d;
  const plot = innerHeight < %d && box.querySelector('.plot');  // in a notebook it would hide the scene
  if (plot) plot.open = false;
  show();
})();
</script>"""


def static_player(
    texts: Sequence[str], begin_s: float, step_s: float, plot: ReadingsPlot | None = None, rows: Sequence[int] = ()
) -> str:
    """Return the panel with its script.

    ``texts``: HTML of the initial row, and of every row that is played. ``begin_s``, ``step_s``: begin of the playback,
    and time between its rows. ``rows``: the rows in the plot's readings.
    """
    content: dict[str, object] = {"begin": begin_s, "step": step_s, "texts": list(texts)}
    plot_html = ""
    if plot is not None:
        kinds = [plot.lines(kind) for kind in plot.kinds]
        content["x"] = across(kinds[0], kinds[0].at(rows)[0]).round(2).tolist()
        content["values"] = [[number_texts(lines, row) for row in lines.at(rows)[1].tolist()] for lines in kinds]
        options = "".join(f"<option>{escape(kind)}</option>" for kind in plot.kinds)
        plot_html = (
            '<details class="plot" open><summary style="font-size:.8rem;cursor:pointer">Readings</summary>'
            f'<select aria-label="Show" style="font:inherit;font-size:.75rem;margin:.3em 0">{options}</select>'
            f"{''.join(lines_svg(lines, plot.time_label) for lines in kinds)}"
            f"{cursor_svg(0.0)}{numbers_html(kinds[0])}</details>"
        )
    data = json.dumps(content).replace("</", "<\\/")
    return (
        '<details id="row" class="box" open style="top:.8em;right:.8em">'
        '<summary style="font-weight:600;padding:.5em .6em .2em;cursor:pointer">At this time</summary>'
        '<div style="padding:0 .6em .5em;width:18rem"><div class="row-text" style="margin:0 -.6em"></div>'
        f"{plot_html}</div></details>{_SCRIPT % (data, POINTER_SCRIPT, NARROW_PX, _LOW_PX)}"
    )
