"""Figure of a survey from above: anomaly, residual, targets, and the least moments that are found."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.colors import SymLogNorm
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.tri import Triangulation

from arrays.typing import FloatArray
from magloc.plots import style
from magloc.surveying.results import linear_and_most, neighbour_triangles

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import Collection

    from magloc.surveying.results import Survey, Target

_ACROSS, _UP = "x, east [m]", "y, north [m]"


def survey_figure(found: Survey) -> Figure:
    """Draw maps of the anomaly, of its residual, and of the smallest detectable moments; lines are levelled.

    Parameters
    ----------
    found : Survey
        A result of :func:`magloc.survey`.

    Returns
    -------
    matplotlib.figure.Figure
        Figure; :func:`save` writes it to a file.

    Examples
    --------
    >>> import sims
    >>> import magloc
    >>> from dataclasses import replace
    >>> scenario = replace(sims.read_scenario("survey-drone"), duration_s=120.0)
    >>> field = sims.simulate(scenario, rng=1)
    >>> figure = magloc.plots.survey(magloc.survey(field.array, field.readings))
    """
    x, y, _ = found.rows.place_m.T
    height = style.WIDTH_IN * 0.5 * float(np.clip(np.ptp(y) / max(np.ptp(x), 1e-9), 0.12, 1.6)) + 1.0
    figure = style.new_figure(2.0 * height)
    rows = found.levelled_rows.decimate()
    both, reach = figure.subplots(2, 2, sharex=True, sharey=True)
    for ax, values_T, title in zip(
        both, (rows.anomaly_T, rows.residual_T), ("anomaly", "less the targets' fields"), strict=True
    ):
        _draw_values(figure, ax, rows.place_m, values_T * 1e9)
        style.label_axes(ax, _ACROSS, _UP, title)
        ax.tick_params(labelbottom=True)
        ax.set_aspect("equal")
    for target in found:
        _draw_target(both[0], target, has_label=False)
        _draw_target(both[1], target, has_label=True)
    depths = found.terrain.depth_of(found.reach.place_m)
    for ax, depth in zip(reach, (depths.min(initial=np.inf), depths.max(initial=0.0)), strict=True):
        at = np.isclose(depths, depth)
        _draw_reach(figure, ax, found.reach.place_m[at], found.reach.moment_Am2[at])
        style.label_axes(ax, _ACROSS, _UP, f"least moment seen, {depth:.2g} m deep" if at.any() else "")
        ax.set_aspect("equal")
    note = f"Upper maps: every row a point; {found.levelling}. Lower maps: linear between places."
    figure.supxlabel(note, fontsize=style.SMALL_FONT_SIZE)
    return figure


def _draw_reach(figure: Figure, ax: Axes, places_m: FloatArray, moments_Am2: FloatArray) -> None:
    """Draw the least moments, interpolated between neighbouring places, on a logarithmic scale."""
    xy = places_m[:, :2]
    corners = neighbour_triangles(xy)
    if not len(corners):
        return  # a single line of places has no map
    between = Triangulation(xy[:, 0], xy[:, 1], corners)
    surface = ax.tripcolor(between, moments_Am2, norm="log", cmap="viridis", shading="gouraud", rasterized=True)
    least, most = float(moments_Am2.min()), float(moments_Am2.max())
    _draw_bar(figure, ax, surface, style.log_ticks(least, most, (1.0,), (1.0, 2.0, 5.0)) or [least, most], "A·m²")


def _draw_values(figure: Figure, ax: Axes, places_m: FloatArray, values_nT: FloatArray) -> None:
    """Draw rows as coloured points."""
    linear, most = linear_and_most(values_nT)
    norm = SymLogNorm(linear, vmin=-most, vmax=most)
    points = ax.scatter(
        places_m[:, 0], places_m[:, 1], c=values_nT, s=1.5, lw=0.0, cmap="RdBu_r", norm=norm, rasterized=True
    )
    _draw_bar(figure, ax, points, [-most, -linear, 0.0, linear, most], "nT")


def _draw_bar(figure: Figure, ax: Axes, shown: Collection, ticks: Sequence[float], unit: str) -> None:
    bar = figure.colorbar(shown, ax=ax, orientation="horizontal", shrink=0.8, aspect=30)
    bar.set_ticks(ticks, labels=[f"{float(f'{tick:.2g}'):g}".replace("-", "\N{MINUS SIGN}") for tick in ticks])
    bar.minorticks_off()
    bar.ax.tick_params(labelsize=style.SMALL_FONT_SIZE)
    bar.set_label(unit, fontsize=style.FONT_SIZE)


def _draw_target(ax: Axes, target: Target, *, has_label: bool) -> None:
    place = (float(target.position_m[0]), float(target.position_m[1]))
    ax.plot(*place, "+", color=style.BLACK, ms=5, mew=0.8, zorder=3)
    ax.add_patch(style.ellipse95(target.position_m[:2], target.covariance[:2, :2], edgecolor=style.BLACK))
    if has_label:
        text = f"{target.id}: {target.depth_m:.1f} m"
        low, high = ax.get_xlim()
        offset, side = (-3.0, "right") if place[0] > high - 0.15 * (high - low) else (3.0, "left")
        note = ax.annotate(text, place, (offset, 3.0), textcoords="offset points", ha=side, fontsize=5.5, zorder=4)
        note.set_path_effects([withStroke(linewidth=1.5, foreground="white")])
