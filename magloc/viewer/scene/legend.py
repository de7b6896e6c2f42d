"""Legend of the colours of a scene, as HTML for the panel of a served page and for a static page."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from arrays.typing import ByteArray, FloatArray
from magloc.viewer.scene.framing import FIELD_OF_VIEW_RAD, PHONE_WIDTH

Colour = tuple[int, int, int]
BOTTOM_WITH_PLAYER = "4em"
"""Distance of the legend from the bottom of a page with a player."""
NARROW_PX = 600
"""Width of a page below which legend and panel are folded at first, because they would hide the scene."""
_SHADES = 9
_TO_ONE_SIDE = PHONE_WIDTH * np.tan(0.5 * FIELD_OF_VIEW_RAD)
SCHEME_SCRIPT = """<script>
if (matchMedia('(prefers-color-scheme: dark)').matches) {
  const original = URLSearchParams.prototype.get;
  URLSearchParams.prototype.get = function (name) { return name === 'darkMode' ? '' : original.call(this, name); };
}
</script>"""
"""Script for the head of viser's page: its query ``darkMode`` follows the scheme of the browser."""
_BOX = """<style>
.box { background: rgba(255,255,255,.9); color: #222; position: fixed; z-index: 1000; border-radius: .4em;
  box-shadow: 0 1px 4px rgba(0,0,0,.25); font-family: sans-serif }
@media (prefers-color-scheme: dark) { .box { background: rgba(30,32,36,.9); color: #ddd } }
</style>"""
# viser's page reads its first camera from its address, which a file cannot change.
_PHONE_CAMERA_SCRIPT = f"""<script>
if (innerWidth < {NARROW_PX}) {{
  const original = URLSearchParams.prototype.get;
  const vertical = 2 * Math.atan({_TO_ONE_SIDE:.4f} * Math.max(innerHeight / innerWidth, 1));
  URLSearchParams.prototype.get = function (name) {{
    return name === 'initialCameraFov' ? vertical : original.call(this, name);
  }};
}}
</script>"""


@dataclass(frozen=True)
class Swatch:
    """Colour with its meaning.

    Attributes
    ----------
    colour : tuple of 3 ints
    text : str
        Meaning with its unit.
    """

    colour: Colour
    text: str


@dataclass(frozen=True)
class ColourScale:
    """Scale of colours.

    Attributes
    ----------
    text : str
        Quantity with its unit.
    low, high : str
        Values of the first and the last colour.
    colours : tuple of tuples of 3 ints
        Colours, evenly along the scale.
    """

    text: str
    low: str
    high: str
    colours: tuple[Colour, ...]

    @classmethod
    def sample(cls, text: str, low: str, high: str, colours_at: Callable[[FloatArray], ByteArray]) -> ColourScale:
        """Return a scale with the colours (n, 3) at n places from 0 to 1."""
        colours = colours_at(np.linspace(0.0, 1.0, _SHADES)).tolist()
        return cls(text, low, high, tuple((red, green, blue) for red, green, blue in colours))


Entry = Swatch | ColourScale


def legend_html(entries: Sequence[Entry], notes: Sequence[str] = ()) -> str:
    """Return the legend as one ``div`` with escaped texts; ``notes`` are sentences below it."""
    rows = [_entry_html(entry) for entry in entries]
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
    """Add a foldable legend and other HTML to a static page of viser.

    A page as narrow as a phone sees as much to the sides as a wider one, and more above and below.
    """
    box = (
        f'<details id="legend" class="box" open'
        f' style="bottom:{bottom};left:.8em;max-width:19rem;pointer-events:none">'
        '<summary style="font-weight:600;padding:.5em .6em .2em;pointer-events:auto;cursor:pointer">'
        f"{escape(title)}</summary>{legend_html(entries, notes)}</details>"
        f"<script>document.getElementById('legend').open = innerWidth > {NARROW_PX}</script>"
    )
    head = f"<head>{SCHEME_SCRIPT}{_PHONE_CAMERA_SCRIPT}{_BOX}"
    before, end, after = page.replace("<head>", head, 1).rpartition("</body>")
    return f"{before}{box}{beside}{end}{after}"


def _entry_html(entry: Entry) -> str:
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
    """Return a colour in the notation of CSS."""
    return f"rgb({colour[0]},{colour[1]},{colour[2]})"
