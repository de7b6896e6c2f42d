"""House style of all figures: sizes for print, and colours for colour-blind readers and grey printing.

A figure is as wide as the text of an A4 page, so that font sizes hold on paper. The colours are by Okabe and Ito
("Color Universal Design", 2008). Colours in one panel differ by at least 20 in CIE lightness; markers or lines differ
too.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.collections import PolyCollection
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
FONT_SIZE = 8.0
SMALL_FONT_SIZE = 7.0
BLACK, BLUE, ORANGE = "#000000", "#0072b2", "#e69f00"
GREEN, VERMILION, PURPLE, SKY_BLUE = "#009e73", "#d55e00", "#cc79a7", "#56b4e9"
GREY, PALE_GREY, LIGHT_GREY = "#7f7f7f", "#adadad", "#d9d9d9"
ESTIMATE, TRUTH, BOUND = BLUE, BLACK, ORANGE
COMPONENTS = (("x", BLACK, "o", "-"), ("y", BLUE, "s", "--"), ("z", ORANGE, "^", ":"))
"""Name, colour, marker and line style of the components of a vector."""
_MICROMETRES_BELOW_M, _MILLIMETRES_BELOW_M = 1e-3, 1.0
_MOST_ELLIPSES = 24
# Ratios of the limits of an axis below which some, many, or all numbers between the powers of ten are labelled.
_FEW_DECADES, _FEW_TIMES, _NO_TIMES = 30.0, 4.0, 2.5
_FEW_MARKERS = 40
_FEWEST_TICKS = 3
# Numbers within this relative difference are equal.
_PIXELS = 2000  # more than a figure has across
_ROUNDING = 1e-9
FEW_SENSORS, _MOST_LABELLED_SENSORS = 10, 60


class NotebookFigure(Figure):
    """Figure that a notebook shows without pyplot."""

    def _repr_png_(self) -> bytes:
        return png(self, _SCREEN_DPI)


def png(figure: Figure, dpi: int) -> bytes:
    """Return the bytes of a figure as a PNG file."""
    picture = io.BytesIO()
    figure.canvas.print_figure(picture, format="png", dpi=dpi)
    return picture.getvalue()


def new_figure(height_in: float, *, layout: str | None = "constrained") -> NotebookFigure:
    """Return an empty figure as wide as a page."""
    return NotebookFigure(figsize=(WIDTH_IN, height_in), dpi=DPI, layout=layout)  # type: ignore[arg-type]


def save(figure: Figure, path: str | Path, dpi: int = DPI) -> None:
    """Write a figure as PNG in the resolution of print, completely or not at all.

    Parameters
    ----------
    figure : matplotlib.figure.Figure
        Figure to write.
    path : str or path-like
        An existing file is replaced.
    dpi : int
        Dots per inch.

    Examples
    --------
    >>> import magloc
    >>> board = magloc.datasets.load("board")
    >>> fixes = magloc.locate(board.array, board.readings[:10])
    >>> magloc.plots.save(fixes.plot(), "fixes.png")
    """
    replace_file(path, lambda place: figure.savefig(place, format="png", dpi=dpi, pil_kwargs={"compress_level": 3}))


def write(figure: Figure, path: Path, columns: Mapping[str, Column] | None = None) -> None:
    """Write a figure as PNG, and its data as a CSV file of the same name.

    Parameters
    ----------
    figure : matplotlib.figure.Figure
        Figure to write.
    path : Path
        Path of the PNG file.
    columns : mapping of str to array
        Columns of the CSV file by their headings.

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


def label_axes(ax: Axes, across: str, up: str, title: str = "") -> None:
    """Add axis labels with units, title and grid to a panel, in the house style."""
    ax.set_xlabel(across, fontsize=FONT_SIZE)
    ax.set_ylabel(up, fontsize=FONT_SIZE)
    ax.set_title(title, fontsize=FONT_SIZE, loc="left")
    ax.tick_params(which="both", labelsize=SMALL_FONT_SIZE, width=0.6, length=1.5)
    ax.tick_params(which="major", length=2.5)
    ax.grid(visible=True, color=LIGHT_GREY, linewidth=0.4)
    ax.set_axisbelow(True)
    for axis in (ax.xaxis, ax.yaxis):
        axis.get_offset_text().set_fontsize(SMALL_FONT_SIZE)
    for spine in ax.spines.values():
        spine.set_linewidth(0.6)


def add_title(figure: Figure, text: str) -> None:
    """Add a title to the whole figure, with line breaks where it is wider than the page."""
    figure.suptitle(text, fontsize=FONT_SIZE + 1.0, wrap=True)


def add_legend(where: Axes | Figure, **options: Any) -> None:
    """Add a legend in the house style, if there are labels."""
    if "handles" not in options and not isinstance(where, Figure) and not where.get_legend_handles_labels()[0]:
        return
    house: dict[str, Any] = {"fontsize": SMALL_FONT_SIZE, "frameon": False, "handlelength": 1.8, "borderaxespad": 0.2}
    if not isinstance(where, Figure):
        # Above the panel at the right; the title is at the left.
        house |= {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "borderpad": 0.1, "ncols": 6}
    where.legend(**{**house, **options})


def label_sensors(ax: Axes, ids: Sequence[str]) -> None:
    """Label a horizontal axis of sensor numbers with as many ids as are legible."""
    labelled = range(0, len(ids), -(-len(ids) // _MOST_LABELLED_SENSORS))
    ax.set_xlabel("sensor", fontsize=FONT_SIZE)
    ax.set_xlim(-0.7, len(ids) - 0.3)
    ax.set_xticks(list(labelled), [ids[i] for i in labelled], rotation=0.0 if len(ids) <= FEW_SENSORS else 90.0)


def axis_unit(span_m: float) -> tuple[str, float]:
    """Return the unit (µm, mm or m) for lengths up to a span [m], and the units in a metre."""
    if span_m < _MICROMETRES_BELOW_M:
        return "µm", 1e6
    return ("mm", 1e3) if span_m < _MILLIMETRES_BELOW_M else ("m", 1.0)


def length_label(length_m: float) -> str:
    """Return a length with a suitable unit, such as ``0.5 m`` or ``20 mm``."""
    unit, per_m = axis_unit(10.0 * length_m)
    return f"{per_m * length_m:.3g} {unit}"


def log_ticks(least: float, most: float, *steps: Sequence[float]) -> list[float]:
    """Return ticks between two numbers by the first steps that give at least three.

    ``steps``: multiples in a decade, coarse ones first.
    """
    ticks: list[float] = []
    for in_decade in steps:
        every = [step * 10.0**decade for decade in range(-12, 13) for step in in_decade]
        ticks = [tick for tick in every if least * (1.0 - _ROUNDING) <= tick <= most * (1.0 + _ROUNDING)]
        if len(ticks) >= _FEWEST_TICKS:
            break
    return ticks


def set_log_scale(ax: Axes, values: Sequence[FloatArray]) -> None:
    """Make the vertical axis logarithmic over the positive values, with plain numbers.

    Parameters
    ----------
    ax : Axes
    values : sequence of ndarray
        Values to show; those that are not finite and positive are ignored. For a short range, numbers between the
        powers of ten are labelled too.
    """

    def minor_label(value: float, _: float) -> str:
        low, high = ax.get_ylim()
        first_digit = f"{value:e}"[0]
        if high < _NO_TIMES * low:
            return f"{value:.3g}"
        labelled = "23457" if high < _FEW_TIMES * low else "25"
        return f"{value:g}" if first_digit in labelled and high < _FEW_DECADES * low else ""

    ax.set_yscale("log")
    every = _finite_values(values)
    every = np.log10(every[every > 0.0])
    if every.size:
        margin = max(0.06 * float(np.ptp(every)), 0.15)
        ax.set_ylim(10.0 ** (every.min() - margin), 10.0 ** (every.max() + margin))
    ax.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    ax.yaxis.set_minor_formatter(minor_label)


def draw_truth(ax: Axes, across: FloatArray, up: FloatArray) -> None:
    """Draw the true path in a plane, or a cross for a source at rest."""
    known = np.isfinite(across) & np.isfinite(up)
    if not known.any():
        return
    if np.ptp(across[known]) == np.ptp(up[known]) == 0.0:
        i = np.flatnonzero(known)[:1]
        ax.plot(across[i], up[i], "+", color=TRUTH, ms=7, mew=1.0, label="truth", zorder=2.5)
    else:
        ax.plot(across, up, color=TRUTH, lw=0.8, ls="--", label="truth", zorder=2.5)


def ellipse95(centre: FloatArray, covariance: FloatArray, **options: Any) -> Ellipse:
    """Return the 95 % ellipse of two numbers (χ² with two degrees of freedom)."""
    values, vectors = np.linalg.eigh(covariance)
    width, height = 2.0 * np.sqrt(np.clip(values, 0.0, None) * chdtri(2, 1.0 - INTERVAL))
    angle = float(np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0])))
    chosen = {"fill": False, "edgecolor": BOUND, "linewidth": 0.6, "alpha": 0.8, "zorder": 2.3, **options}
    return Ellipse((float(centre[0]), float(centre[1])), float(width), float(height), angle=angle, **chosen)


def thin(rows: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return evenly spaced rows, so few that their ellipses do not hide each other."""
    return rows[:: max(1, -(-len(rows) // _MOST_ELLIPSES))]


def axis_limits(
    values: Sequence[FloatArray], always: Sequence[FloatArray] = (), *, share: float = 0.98, margin: float = 0.08
) -> tuple[float, float]:
    """Return limits that show a share of the values, or all if that at most doubles the width.

    ``values``: values of which the share is shown. ``always``: values that are all shown. Values that are not finite
    are ignored. ``margin``: part of the width that is added at each end.
    """
    every, sure = (_finite_values(part) for part in (values, always))
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


def _finite_values(values: Sequence[FloatArray]) -> FloatArray:
    every = np.concatenate([np.empty(0), *(np.ravel(value) for value in values)])
    return every[np.isfinite(every)]


def shade_gaps(ax: Axes, time_s: FloatArray, present: NDArray[np.bool_], label: str) -> None:
    """Hatch the times of successive rows without data."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], ~present, [False]]).astype(np.int8))).reshape(-1, 2)
    begin_s, end_s = time_s[np.maximum(edges[:, 0] - 1, 0)], time_s[np.minimum(edges[:, 1], len(time_s) - 1)]
    # One patch for each of thousands of gaps takes minutes: gaps below a pixel are omitted, the rest is one patch.
    seen = end_s - begin_s > np.ptp(time_s) / _PIXELS
    if seen.any():
        left, right, zero = begin_s[seen], end_s[seen], np.zeros(seen.sum())
        boxes = np.stack([[left, zero], [right, zero], [right, zero + 1.0], [left, zero + 1.0]]).transpose(2, 0, 1)
        style: dict[str, Any] = {"facecolor": "none", "edgecolor": LIGHT_GREY, "hatch": "////", "lw": 0.0}
        patches = PolyCollection(list(boxes), transform=ax.get_xaxis_transform(), label=label, **style)
        ax.add_collection(patches, autolim=False)  # the limits of the values stay
        ax.update_datalim(boxes.reshape(-1, 2), updatey=False)


def truth_columns(truth_m: FloatArray) -> dict[str, Column]:
    """Return columns of true positions (n, 3)."""
    return dict(zip((f"true_{name}" for name in STATE_COLUMNS), truth_m.T, strict=False))


def marker_size(n: int) -> float:
    """Return the size of n markers, larger if they are few."""
    return 3.0 if n > _FEW_MARKERS else 5.0


def draw_chi_square(ax: Axes, time_s: FloatArray, squares: FloatArray, dof: NDArray[np.int64], name: str) -> None:
    """Draw χ² over its degrees of freedom for every row, with the 99 % bounds.

    ``time_s``, ``squares``, ``dof`` (n,): NaN, or no degrees of freedom, where there is no χ². ``name``: name of the
    χ².
    """
    low, high = bounds99(dof)
    ratio = np.where(dof > 0, squares / np.maximum(dof, 1), np.nan)
    known = np.isfinite(ratio)
    inside = known & (ratio >= low) & (ratio <= high)
    set_log_scale(ax, [ratio, np.where(known, low, np.nan), np.where(known, high, np.nan)])
    # The bounds of a single row need a width.
    times, lower, upper = (
        (time_s, low, high)
        if len(time_s) > 1
        else (time_s[0] + np.array([-0.5, 0.5]), np.repeat(low, 2), np.repeat(high, 2))
    )
    ax.fill_between(times, lower, upper, step="mid", color=LIGHT_GREY, lw=0.0, label="99 % bounds of χ²")
    for bound in (lower, upper):
        ax.plot(times, bound, color=GREY, lw=0.7, drawstyle="steps-mid")
    size = marker_size(len(time_s))
    outside = known & ~inside
    ax.plot(time_s[inside], ratio[inside], ".", color=ESTIMATE, ms=size, label="within")
    ax.plot(time_s[outside], ratio[outside], "x", color=BLACK, ms=size + 0.5, mew=0.8, label="outside")
    ax.axhline(1.0, color=GREY, lw=0.6)
    title = (
        f"{name}: {100.0 * inside.sum() / known.sum():.1f} % of {known.sum()} rows within the bounds"
        if known.any()
        else name
    )
    label_axes(ax, "time [s]", f"{name} / degrees\nof freedom [1]", title)
    add_legend(ax)
