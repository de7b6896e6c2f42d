"""What a page without a server says of the row that its player shows, and readings with a cursor that moves it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from html import escape

from magloc.viewer.panels.lines import POINTED, across, cursor_svg, lines_svg, number_texts, numbers_html
from magloc.viewer.panels.readings_plot import ReadingsPlot
from magloc.viewer.scene.legend import NARROW_PX

_LOW_PX = 640  # of a page

# viser's player says its time in a slider, and takes one from its input, in which it stands rounded. It begins by
# itself, and has nothing to show until it has begun; a time that is typed stops it.
_SCRIPT = """<script>
(() => {
  const {begin, step, words, x, values} = %s;
  %s
  const box = document.getElementById('row'), kind = box.querySelector('select');
  const said = box.querySelector('.said'), numbers = [...box.querySelectorAll('b.of-channel')];
  const plots = [...box.querySelectorAll('svg.lines')], cursor = box.querySelector('.now');
  const input = () => document.querySelector('input[inputmode=decimal]');
  let at = 0;
  const show = () => {
    said.innerHTML = words[at];
    if (!kind) return;
    plots.forEach((plot, i) => { plot.style.display = i === kind.selectedIndex ? 'block' : 'none'; });
    cursor.setAttribute('transform', `translate(${x[at]})`);
    numbers.forEach((number, i) => { number.textContent = values[kind.selectedIndex][at][i]; });
  };
  const follow = () => {
    const slider = document.querySelector('[role=slider]');
    const now = slider ? Math.floor((Number(slider.ariaValueNow) - begin) / step + 1e-3) + 1 : 0;
    const row = Math.min(Math.max(now, 0), words.length - 1);
    if (row !== at) { at = row; show(); }
  };
  whenPointed(box, (plot, event) => {
    const place = placeOf(plot, event);
    let row = 1;
    x.forEach((one, i) => { if (i && Math.abs(one - place) < Math.abs(x[row] - place)) row = i; });
    if (input() && row !== at) typeInto(input(), begin + (row - 0.5) * step);
  });
  if (kind) kind.addEventListener('change', show);
  const changed = {subtree: true, attributes: true, attributeFilter: ['aria-valuenow']};
  new MutationObserver(follow).observe(document.body, changed);
  const begun = setInterval(() => {
    if (!input() || !(Number(input().value) > 0)) return;
    clearInterval(begun);
    typeInto(input(), 0.05);
  }, 20);
  box.open = innerWidth > %d;
  const folded = innerHeight < %d && box.querySelector('.plot');  // as in a notebook, where it would hide the scene
  if (folded) folded.open = false;
  show();
})();
</script>"""


def static_player(
    words: Sequence[str], begin_s: float, step_s: float, plot: ReadingsPlot | None = None, rows: Sequence[int] = ()
) -> str:
    """HTML and a script of what is said of every row that is played: at first, and from a time on at steps.

    ``words``: HTML. ``rows``: those of the plot's readings.
    """
    held: dict[str, object] = {"begin": begin_s, "step": step_s, "words": list(words)}
    drawn = ""
    if plot is not None:
        kinds = [plot.lines(kind) for kind in plot.kinds]
        held["x"] = across(kinds[0], kinds[0].at(rows)[0]).round(2).tolist()
        held["values"] = [[number_texts(lines, row) for row in lines.at(rows)[1].tolist()] for lines in kinds]
        options = "".join(f"<option>{escape(kind)}</option>" for kind in plot.kinds)
        drawn = (
            '<details class="plot" open><summary style="font-size:.8rem;cursor:pointer">Readings</summary>'
            f'<select aria-label="Show" style="font:inherit;font-size:.75rem;margin:.3em 0">{options}</select>'
            f"{''.join(lines_svg(lines, plot.time_words) for lines in kinds)}"
            f"{cursor_svg(0.0)}{numbers_html(kinds[0])}</details>"
        )
    data = json.dumps(held).replace("</", "<\\/")
    return (
        '<details id="row" class="box" open style="top:.8em;right:.8em">'
        '<summary style="font-weight:600;padding:.5em .6em .2em;cursor:pointer">At this time</summary>'
        f'<div style="padding:0 .6em .5em;width:18rem"><div class="said" style="margin:0 -.6em"></div>{drawn}</div>'
        f"</details>{_SCRIPT % (data, POINTED, NARROW_PX, _LOW_PX)}"
    )
