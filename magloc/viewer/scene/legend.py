"""The legend: what the colours mean, with units. The same HTML in the panel of the live page and in a static file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from magloc.viewer.scene.framing import FIELD_OF_VIEW_RAD, SIDES_OF_A_PHONE

Colour = tuple[int, int, int]
ABOVE_THE_PLAYER = "4em"
"""Where the legend stands on a page that plays."""
NARROW_PX = 600
"""Of a page whose legend or panel is folded at first, for it would hide the scene."""
_TO_ONE_SIDE = SIDES_OF_A_PHONE * np.tan(0.5 * FIELD_OF_VIEW_RAD)
FOLLOWS_THE_SCHEME = """<script>
if (matchMedia('(prefers-color-scheme: dark)').matches) {
  const asked = URLSearchParams.prototype.get;
  URLSearchParams.prototype.get = function (name) { return name === 'darkMode' ? '' : asked.call(this, name); };
}
</script>"""
"""Of the head of viser's page, which asks its address whether it is to be dark: as the browser is, light or dark."""
_BOX = """<style>
.box { background: rgba(255,255,255,.9); color: #222; position: fixed; z-index: 1000; border-radius: .4em;
  box-shadow: 0 1px 4px rgba(0,0,0,.25); font-family: sans-serif }
@media (prefers-color-scheme: dark) { .box { background: rgba(30,32,36,.9); color: #ddd } }
</style>"""
# viser's page takes its first camera from its address, which a page of a file must not change.
_SEES_AS_WIDE = f"""<script>
if (innerWidth < {NARROW_PX}) {{
  const inAddress = URLSearchParams.prototype.get;
  const upright = 2 * Math.atan({_TO_ONE_SIDE:.4f} * Math.max(innerHeight / innerWidth, 1));
  URLSearchParams.prototype.get = function (name) {{
    return name === 'initialCameraFov' ? upright : inAddress.call(this, name);
  }};
}}
</script>"""


@dataclass(frozen=True)
class Swatch:
    """A colour and what it stands for.

    Attributes
    ----------
    colour : tuple of 3 ints
    text : str
        With its unit.
    """

    colour: Colour
    text: str


@dataclass(frozen=True)
class ColourScale:
    """A scale of colours.

    Attributes
    ----------
    text : str
        What is coloured, with its unit.
    low, high : str
        What the first and the last colour stand for.
    colours : tuple of tuples of 3 ints
        Evenly along the scale.
    """

    text: str
    low: str
    high: str
    colours: tuple[Colour, ...]


Entry = Swatch | ColourScale


def legend_html(entries: Sequence[Entry], notes: Sequence[str] = ()) -> str:
    """Legend as HTML.

    ``notes``: sentences below. Returns: one ``div``; all texts are escaped.
    """
    rows = [_row(entry) for entry in entries]
    rows += [f'<div style="margin-top:.35em;opacity:.8">{escape(note)}</div>' for note in notes]
    return f'<div style="font-size:.8rem;line-height:1.35;padding:.2em .6em .5em">{"".join(rows)}</div>'


def with_legend(
    page: str,
    title: str,
    entries: Sequence[Entry],
    notes: Sequence[str] = (),
    *,
    bottom: str = ".8em",
    beside: str = "",
) -> str:
    """A static page as viser makes it, without a panel, with a legend that folds in its corner, and HTML beside it.

    A page as narrow as a phone sees as far to the sides as a wider one, and more above and below.
    """
    box = (
        f'<details id="legend" class="box" open'
        f' style="bottom:{bottom};left:.8em;max-width:19rem;pointer-events:none">'
        '<summary style="font-weight:600;padding:.5em .6em .2em;pointer-events:auto;cursor:pointer">'
        f"{escape(title)}</summary>{legend_html(entries, notes)}</details>"
        f"<script>document.getElementById('legend').open = innerWidth > {NARROW_PX}</script>"
    )
    before, end, after = page.replace("<head>", f"<head>{FOLLOWS_THE_SCHEME}{_SEES_AS_WIDE}{_BOX}", 1).rpartition(
        "</body>"
    )
    return f"{before}{box}{beside}{end}{after}"


def _row(entry: Entry) -> str:
    if isinstance(entry, Swatch):
        swatch = f"background:{css(entry.colour)};width:.9em;height:.9em;border-radius:.15em;flex:none;margin-top:.2em"
        return f'<div style="display:flex;gap:.55em"><span style="{swatch}"></span>{escape(entry.text)}</div>'
    gradient = ",".join(css(colour) for colour in entry.colours)
    bar = f"background:linear-gradient(to right,{gradient});height:.7em;border-radius:.15em"
    ends = f"<span>{escape(entry.low)}</span><span>{escape(entry.high)}</span>"
    return (
        f'<div style="margin:.2em 0 .3em">{escape(entry.text)}<div style="{bar}"></div>'
        f'<div style="display:flex;justify-content:space-between">{ends}</div></div>'
    )


def css(colour: Colour) -> str:
    """A colour as a page writes it."""
    return f"rgb({colour[0]},{colour[1]},{colour[2]})"
