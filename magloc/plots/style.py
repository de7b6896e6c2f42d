"""The house style of all figures: sizes for print, colours that survive colour blindness and grey printing.

A figure is as wide as the text of an A4 page, so that its letters are as large on paper as they are here. Colours are
those of Okabe and Ito ("Color Universal Design", 2008); of these, what has to be told apart in one panel differs by 20
or more in CIE lightness, and by its marker or line as well.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from numpy.typing import NDArray
from scipy.special import chdtri

from arrays.io.csv import Column, write_columns
from arrays.io.text import replace_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes
from arrays.typing import FloatArray
from magloc.chi_square import bounds99 as bounds99
from magloc.levels import INTERVAL
from magloc.levels import SIGMAS_95 as SIGMAS_95
from magloc.truth import STATE_COLUMNS

WIDTH_IN = 7.1
DPI = 200
_SCREEN_DPI = 120
LETTERS = 8.0
SMALL_LETTERS = 7.0
BLACK, BLUE, ORANGE = "#000000", "#0072b2", "#e69f00"
GREY, PALE_GREY, LIGHT_GREY = "#7f7f7f", "#adadad", "#d9d9d9"
ESTIMATE, TRUTH, BOUND = BLUE, BLACK, ORANGE
COMPONENTS = (("x", BLACK, "o", "-"), ("y", BLUE, "s", "--"), ("z", ORANGE, "^", ":"))
"""Name, colour, marker and line of the components of a vector."""
_MICROMETRES_BELOW_M, _MILLIMETRES_BELOW_M = 1e-3, 1.0
_MOST_ELLIPSES = 24
# Ratios of the limits below which some, many, or all numbers between the powers of ten are written.
_FEW_DECADES, _FEW_TIMES, _NO_TIMES = 30.0, 4.0, 2.5
_FEW_MARKS = 40
# What differs by no more than this share of itself is one number.
_ROUNDING = 1e-9
FEW_SENSORS, _MOST_NAMED_SENSORS = 10, 60
"""Columns of position and moment."""


class HouseFigure(Figure):
    """A figure that a notebook shows by itself: otherwise that takes pyplot, which nothing here imports."""

    def _repr_png_(self) -> bytes:
        return png(self, _SCREEN_DPI)


def png(figure: Figure, dpi: int) -> bytes:
    """Return the bytes of a figure as a PNG file."""
    picture = io.BytesIO()
    figure.canvas.print_figure(picture, format="png", dpi=dpi)
    return picture.getvalue()


def new_figure(height_in: float, *, layout: str | None = "constrained") -> HouseFigure:
    """An empty figure of the width of a page."""
    return HouseFigure(figsize=(WIDTH_IN, height_in), dpi=DPI, layout=layout)  # type: ignore[arg-type]


def save(figure: Figure, path: str | Path, dpi: int = DPI) -> None:
    """Write a figure as PNG, fine enough for print, whole or not at all.

    Parameters
    ----------
    figure : matplotlib.figure.Figure
    path : str or path-like
        Replaced if it exists.
    dpi : int

    Examples
    --------
    >>> import magloc
    >>> board = magloc.datasets.load("board")
    >>> fixes = magloc.locate(board.array, board.readings[:10])
    >>> magloc.plots.save(fixes.plot(), "fixes.png")
    """
    replace_file(path, lambda place: figure.savefig(place, format="png", dpi=dpi, pil_kwargs={"compress_level": 3}))


def write(figure: Figure, path: Path, columns: Mapping[str, Column] | None = None) -> None:
    """Write a figure as PNG, whole or not at all, and the data behind it beside it as CSV.

    Parameters
    ----------
    figure : matplotlib.figure.Figure
    path : Path
        Of the PNG.
    columns : mapping of str to array
        Of the CSV, by their headings.

    Examples
    --------
    >>> from pathlib import Path
    >>> import magloc
    >>> board = magloc.datasets.load("board")
    >>> fixes = magloc.locate(board.array, board.readings[:10])
    >>> columns = {"x_m": fixes.position_m[:, 0]}
    >>> magloc.plots.write(fixes.plot(), Path("fixes.png"), columns)
    """
    save(figure, path)
    if columns is not None:
        write_columns(columns, path.with_suffix(".csv"))


def dress(ax: Axes, across: str, up: str, title: str = "") -> None:
    """Give a panel its labels, which carry units, and the grid and the letters of the house."""
    ax.set_xlabel(across, fontsize=LETTERS)
    ax.set_ylabel(up, fontsize=LETTERS)
    ax.set_title(title, fontsize=LETTERS, loc="left")
    ax.tick_params(which="both", labelsize=SMALL_LETTERS, width=0.6, length=1.5)
    ax.tick_params(which="major", length=2.5)
    ax.grid(visible=True, color=LIGHT_GREY, linewidth=0.4)
    ax.set_axisbelow(True)
    for axis in (ax.xaxis, ax.yaxis):
        axis.get_offset_text().set_fontsize(SMALL_LETTERS)
    for spine in ax.spines.values():
        spine.set_linewidth(0.6)


def headline(figure: Figure, text: str) -> None:
    """Title of the whole figure, broken where it is wider than the page."""
    figure.suptitle(text, fontsize=LETTERS + 1.0, wrap=True)


def legend(where: Axes | Figure, **options: Any) -> None:
    """Legend in the letters of the house, if there is anything to name."""
    if "handles" not in options and not isinstance(where, Figure) and not where.get_legend_handles_labels()[0]:
        return
    house: dict[str, Any] = {"fontsize": SMALL_LETTERS, "frameon": False, "handlelength": 1.8, "borderaxespad": 0.2}
    if not isinstance(where, Figure):
        # Above the panel, at its right; the title is at its left.
        house |= {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "borderpad": 0.1, "ncols": 6}
    where.legend(**{**house, **options})


def name_sensors(ax: Axes, ids: Sequence[str]) -> None:
    """Sensors by their number across, with so many of their ids that they can be read."""
    shown = range(0, len(ids), -(-len(ids) // _MOST_NAMED_SENSORS))
    ax.set_xlabel("sensor", fontsize=LETTERS)
    ax.set_xlim(-0.7, len(ids) - 0.3)
    ax.set_xticks(list(shown), [ids[i] for i in shown], rotation=0.0 if len(ids) <= FEW_SENSORS else 90.0)


def length_unit(span_m: float) -> tuple[str, float]:
    """Unit that suits lengths up to a span [m], and how many of it make a metre: µm below a millimetre, mm, or m."""
    if span_m < _MICROMETRES_BELOW_M:
        return "µm", 1e6
    return ("mm", 1e3) if span_m < _MILLIMETRES_BELOW_M else ("m", 1.0)


def length_text(length_m: float) -> str:
    """A length with the unit that suits it, such as ``0.5 m`` or ``20 mm``."""
    unit, per_m = length_unit(10.0 * length_m)
    return f"{per_m * length_m:.3g} {unit}"


def logarithmic(ax: Axes, values: Sequence[FloatArray]) -> None:
    """Make the upright axis logarithmic over positive values, with plain numbers.

    Parameters
    ----------
    ax : Axes
    values : sequence of ndarray
        Finite and positive ones count. Where they span little, numbers between the powers of ten are written too.
    """

    def between(value: float, _: float) -> str:
        low, high = ax.get_ylim()
        leading = f"{value:e}"[0]
        if high < _NO_TIMES * low:
            return f"{value:.3g}"
        named = "23457" if high < _FEW_TIMES * low else "25"
        return f"{value:g}" if leading in named and high < _FEW_DECADES * low else ""

    ax.set_yscale("log")
    every = _finite(values)
    every = np.log10(every[every > 0.0])
    if every.size:
        margin = max(0.06 * float(np.ptp(every)), 0.15)
        ax.set_ylim(10.0 ** (every.min() - margin), 10.0 ** (every.max() + margin))
    ax.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    ax.yaxis.set_minor_formatter(between)


def draw_truth(ax: Axes, across: FloatArray, up: FloatArray) -> None:
    """The true path in a plane, or the true place of what stands still."""
    known = np.isfinite(across) & np.isfinite(up)
    if not known.any():
        return
    if np.ptp(across[known]) == np.ptp(up[known]) == 0.0:
        i = np.flatnonzero(known)[:1]
        ax.plot(across[i], up[i], "+", color=TRUTH, ms=7, mew=1.0, label="truth", zorder=2.5)
    else:
        ax.plot(across, up, color=TRUTH, lw=0.8, ls="--", label="truth", zorder=2.5)


def ellipse95(centre: FloatArray, covariance: FloatArray, **options: Any) -> Ellipse:
    """95 % ellipse of two numbers: where their χ² of two degrees of freedom is within its 0.95 quantile."""
    values, vectors = np.linalg.eigh(covariance)
    width, height = 2.0 * np.sqrt(np.clip(values, 0.0, None) * chdtri(2, 1.0 - INTERVAL))
    angle = float(np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0])))
    chosen = {"fill": False, "edgecolor": BOUND, "linewidth": 0.6, "alpha": 0.8, "zorder": 2.3, **options}
    return Ellipse((float(centre[0]), float(centre[1])), float(width), float(height), angle=angle, **chosen)


def some_of(rows: NDArray[np.intp]) -> NDArray[np.intp]:
    """So many of the rows, evenly chosen, that their ellipses do not hide each other."""
    return rows[:: max(1, -(-len(rows) // _MOST_ELLIPSES))]


def limits_of(
    values: Sequence[FloatArray], always: Sequence[FloatArray] = (), *, share: float = 0.98, margin: float = 0.08
) -> tuple[float, float]:
    """Limits of an axis that show this share of the values, and all of them if that takes no more than twice as much.

    ``values``, ``always``: finite ones count; of `always` all are shown. ``margin``: added on either side, of the
    width.
    """
    every, sure = (_finite(part) for part in (values, always))
    ends = [sure.min(), sure.max()] if sure.size else []
    if every.size:
        inner = np.quantile(every, [0.5 - 0.5 * share, 0.5 + 0.5 * share])
        ends += [every.min(), every.max()] if np.ptp(every) <= 2.0 * np.ptp(inner) else inner.tolist()
    if not ends:
        return 0.0, 1.0
    low, high = float(min(ends)), float(max(ends))
    width, size = high - low, max(abs(low), abs(high))
    if width <= _ROUNDING * size:
        width = max(size, 1e-3)
    return low - margin * width, high + margin * width


def _finite(values: Sequence[FloatArray]) -> FloatArray:
    every = np.concatenate([np.empty(0), *(np.ravel(value) for value in values)])
    return every[np.isfinite(every)]


def shade_gaps(ax: Axes, time_s: FloatArray, present: NDArray[np.bool_], label: str) -> None:
    """Hatch the times of successive rows where nothing is known."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], ~present, [False]]).astype(np.int8)))
    for begin, end in edges.reshape(-1, 2):
        ends = time_s[max(begin - 1, 0)], time_s[min(end, len(time_s) - 1)]
        ax.axvspan(*ends, facecolor="none", edgecolor=LIGHT_GREY, hatch="////", lw=0.0, label=label)
        label = "_"


def truth_columns(truth_m: FloatArray) -> dict[str, Column]:
    """Columns of true positions (n, 3)."""
    return dict(zip((f"true_{name}" for name in STATE_COLUMNS), truth_m.T, strict=False))


def dot_size(n: int) -> float:
    """Size of one of n marks: few are large."""
    return 3.0 if n > _FEW_MARKS else 5.0


def squares_panel(ax: Axes, time_s: FloatArray, squares: FloatArray, dof: NDArray[np.int64], name: str) -> None:
    """A normalised square of every row over its degrees of freedom, with the 99 % bounds of χ² and the share within.

    ``time_s``, ``squares``, ``dof`` (n,): naN, or no degrees of freedom, where there is none. ``name``: what is
    drawn.
    """
    low, high = bounds99(dof)
    ratio = np.where(dof > 0, squares / np.maximum(dof, 1), np.nan)
    known = np.isfinite(ratio)
    inside = known & (ratio >= low) & (ratio <= high)
    logarithmic(ax, [ratio, np.where(known, low, np.nan), np.where(known, high, np.nan)])
    # Bounds of a single row have a width too.
    times, lower, upper = (
        (time_s, low, high)
        if len(time_s) > 1
        else (time_s[0] + np.array([-0.5, 0.5]), np.repeat(low, 2), np.repeat(high, 2))
    )
    ax.fill_between(times, lower, upper, step="mid", color=LIGHT_GREY, lw=0.0, label="99 % bounds of χ²")
    for bound in (lower, upper):
        ax.plot(times, bound, color=GREY, lw=0.7, drawstyle="steps-mid")
    size = dot_size(len(time_s))
    outside = known & ~inside
    ax.plot(time_s[inside], ratio[inside], ".", color=ESTIMATE, ms=size, label="within")
    ax.plot(time_s[outside], ratio[outside], "x", color=BLACK, ms=size + 0.5, mew=0.8, label="outside")
    ax.axhline(1.0, color=GREY, lw=0.6)
    title = (
        f"{name}: {100.0 * inside.sum() / known.sum():.1f} % of {known.sum()} rows within the bounds"
        if known.any()
        else name
    )
    dress(ax, "time [s]", f"{name} / degrees\nof freedom [1]", title)
    legend(ax)
