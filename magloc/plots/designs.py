"""Figures of array designs: the array in its volume, and its gain over reference arrays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from scipy.spatial.distance import pdist

from arrays.io.values import accept_seed
from arrays.typing import FloatArray, Rng
from magloc.design.evaluation import EVEN, Judgement, range_spread
from magloc.design.optimise import BEST_START, Design, random_sample
from magloc.design.regions import Cap
from magloc.design.volumes import Ball, BoxVolume, Cylinder, MeshSurface, Volume
from magloc.plots import style

_N_SOURCES = 8000
_N_DISTANCES = 13
_DESIGN = "design"
_LINES = {
    _DESIGN: (style.BLUE, "o", "-"),
    "tetrahedron": (style.BLACK, "s", "--"),
    "cube": (style.ORANGE, "^", "-."),
    "cross": (style.GREY, "v", ":"),
    EVEN: (style.ORANGE, "P", (0, (1, 1))),
    BEST_START: (style.PALE_GREY, "D", (0, (4, 1))),
}
# The labels of more sensors would hide them.
_MOST_LABELLED = 12
_ELEVATION, _AZIMUTH = 22.0, -55.0
# Candidates for the turn of the view from the azimuth [°], best first.
_TURNS = (0.0, -15.0, 15.0, 90.0, -90.0, 180.0, 75.0, 105.0, -75.0, -105.0, 165.0, 195.0)
_REACH, _ARROW, _ARROW_LABEL, _FLAT = 1.25, 1.2, 1.42, 0.5


@accept_seed
def design(result: Design, rng: Rng = 0) -> Figure:
    """Draw the sensors in their volume, and the 95 % quantile of σ of the range.

    Parameters
    ----------
    result : Design
        Result of :func:`magloc.design_array`.
    rng : int or numpy.random.Generator
        Seed or generator of the sources of the curves.

    Returns
    -------
    matplotlib.figure.Figure
        Figure; :func:`save` writes it to a file.

    Examples
    --------
    >>> import magloc
    >>> task = magloc.DesignTask.read("half-space-2m")
    >>> found = magloc.design_array(task, starts=2)  # doctest: +SKIP
    >>> figure = magloc.plots.design(found)  # doctest: +SKIP
    """
    figure = style.new_figure(3.3, layout=None)
    scene = figure.add_axes((0.025, 0.06, 0.36, 0.84), projection="3d")
    _draw_scene(scene, result)
    ax = figure.add_axes((0.5, 0.15, 0.205, 0.68))
    relative = figure.add_axes((0.78, 0.15, 0.2, 0.68))
    sources = random_sample(result.task, _N_SOURCES, np.random.default_rng(rng))
    distances = _distances(result)
    arrays = _judgements(result)
    curves = [range_spread(result.task, judged.array, sources, distances).q95_m for judged in arrays]
    for judged, curve in zip(arrays, curves, strict=True):
        colour, marker, line = _LINES[_DESIGN if judged is result.judged[0] else judged.name]
        options: dict[str, Any] = {"color": colour, "marker": marker, "ls": line, "lw": 1.0, "ms": 3.0, "markevery": 3}
        shown = np.where(np.isfinite(curve), curve, np.nan)
        ax.plot(distances, shown, label=_label(result, judged), **options)
        with np.errstate(invalid="ignore"):
            relative.plot(distances, shown / np.where(np.isfinite(curves[0]), curves[0], np.nan), **options)
    for panel, up in ((ax, "q95 of the σ of the range [m]"), (relative, "relative to the design [1]")):
        panel.set_xscale("log")
        style.label_axes(panel, "distance of the source [m]", up)
        panel.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
        panel.xaxis.set_minor_formatter("")
        panel.set_xticks(style.log_ticks(distances[0], distances[-1], (1, 2, 5), (1, 1.5, 2, 3, 4, 5, 6, 8)))
    style.set_log_scale(ax, curves)
    relative.set_ylim(bottom=0.0)
    style.add_legend(
        figure,
        handles=ax.get_legend_handles_labels()[0],
        loc="upper right",
        bbox_to_anchor=(0.985, 0.92),
        ncols=5,
        columnspacing=0.8,
    )
    style.add_title(figure, _title_text(result))
    return figure


def design_counts(results: Sequence[Design]) -> Figure:
    """Draw the criterion over the number of sensors, for designs and for even grids.

    Parameters
    ----------
    results : sequence of Design
        Designs of one task with different numbers of sensors.

    Returns
    -------
    matplotlib.figure.Figure
        Figure; :func:`save` writes it to a file.

    Examples
    --------
    >>> import magloc
    >>> from dataclasses import replace
    >>> task = magloc.DesignTask.read("half-space-2m")
    >>> tasks = [replace(task, n_sensors=n) for n in (4, 6, 8)]
    >>> figure = magloc.plots.design_counts([magloc.design_array(task) for task in tasks])  # doctest: +SKIP
    """
    ordered = sorted(results, key=lambda result: result.task.n_sensors)
    numbers = np.array([result.task.n_sensors for result in ordered])
    grids = [next(judged for judged in result.judged if judged.name == EVEN) for result in ordered]
    curves = {
        _DESIGN: np.array([result.judged[0].criterion_m for result in ordered]),
        EVEN: np.array([judged.criterion_m for judged in grids]),
    }
    unit, per_m = style.axis_unit(max(float(np.max(curve)) for curve in curves.values()))
    figure = style.new_figure(2.7)
    ax, relative = figure.subplots(1, 2, width_ratios=[1.6, 1.0])
    for name, curve in curves.items():
        colour, marker, line = _LINES[name]
        ax.plot(numbers, per_m * curve, color=colour, marker=marker, ls=line, lw=1.0, ms=4.0, label=name)
    criterion = ordered[0].task.criterion
    style.set_log_scale(ax, [per_m * curve for curve in curves.values()])
    style.label_axes(ax, "sensors", f"{criterion} of the σ of the range [{unit}]", ordered[0].task.name)
    gain, error = (np.array([getattr(judged, name) for judged in grids]) for name in ("gain", "gain_error"))
    relative.errorbar(
        numbers, 100.0 * gain, 100.0 * style.SIGMAS_95 * error, color=style.BLUE, marker="o", lw=1.0, ms=4.0
    )
    relative.axhline(0.0, color=style.GREY, lw=0.6)
    style.label_axes(relative, "sensors", "gain over the even grid [%]", "with 95 % intervals")
    for panel in (ax, relative):
        panel.xaxis.set_major_locator(MaxNLocator(integer=True))
    style.add_legend(ax)
    return figure


def _judgements(result: Design) -> list[Judgement]:
    """Return the design and its references, the best start only where no reference fits."""
    some_fit = any(other.fits for other in result.judged[2:])
    every = [judged for judged in result.judged if not (some_fit and judged.name == BEST_START)]
    return [judged for judged in every if np.isfinite(judged.criterion_m)]


def _title_text(result: Design) -> str:
    own = result.judged[0]
    text = f"'{result.task.name}': {result.task.criterion} of the σ of the range {style.length_label(own.criterion_m)}"
    others = [other for other in _judgements(result)[1:] if other.fits]
    if not others:
        return text
    first = others[0]
    sign = "below" if first.gain >= 0.0 else "above"
    names = {BEST_START: f"that of its {first.name}", EVEN: f"an {EVEN} of the same volume"}
    reference = names.get(first.name, f"a {first.name} of the same span")
    return f"{text}, {100.0 * abs(first.gain):.0f} % {sign} {reference}"


def _label(result: Design, judged: Judgement) -> str:
    name = _DESIGN if judged is result.judged[0] else judged.name
    return f"{name} ({judged.array.n_sensors}{'' if judged.fits else ', outside'})"


def _distances(result: Design) -> FloatArray:
    stated = result.judged[0].distance_m
    return np.geomspace(stated[0], stated[-1], _N_DISTANCES)


def _draw_scene(ax: Any, result: Design) -> None:
    """Draw the volume as a wire frame, the sensors, and an arrow towards the sources."""
    volume, sensors = result.task.volume, result.array.positions
    for line in _outline(volume):
        ax.plot(*line.T, color=style.PALE_GREY, lw=0.6, zorder=1)
    if isinstance(volume, MeshSurface):
        ax.plot_trisurf(
            *volume.mesh.vertices.T,
            triangles=volume.mesh.faces,
            color=style.LIGHT_GREY,
            alpha=0.25,
            edgecolor=style.PALE_GREY,
            linewidth=0.1,
        )
    low = volume.centre[2] - volume.radius
    for place in sensors:
        ax.plot(*np.stack([place, [place[0], place[1], low]]).T, color=style.PALE_GREY, lw=0.6, ls=":")
        if len(sensors) <= _MOST_LABELLED:
            ax.plot(*np.stack([volume.centre, place]).T, color=style.BLUE, lw=0.8)
    ax.scatter(*sensors.T, color=style.BLUE, s=26, depthshade=False, edgecolor=style.BLACK, linewidth=0.5)
    for name, place in zip(result.array.ids, sensors, strict=True) if len(sensors) <= _MOST_LABELLED else ():
        ax.text(*place, f"  {name}", fontsize=style.SMALL_FONT_SIZE, ha="left", va="bottom", zorder=9)
    arrow_label = _draw_sources_arrow(ax, result)
    reach = _REACH * volume.radius
    for set_limits, centre in zip((ax.set_xlim, ax.set_ylim, ax.set_zlim), volume.centre, strict=True):
        set_limits(centre - reach, centre + reach)
    ax.set_box_aspect((1.0, 1.0, 1.0), zoom=0.92)
    labelled = np.vstack([sensors, arrow_label])
    ax.view_init(_ELEVATION, clearest_azimuth(labelled) if len(sensors) <= _MOST_LABELLED else _AZIMUTH)
    for label, axis in (("x [m]", ax.xaxis), ("y [m]", ax.yaxis), ("z [m]", ax.zaxis)):
        axis.set_label_text(label, fontsize=style.SMALL_FONT_SIZE)
        axis.labelpad = -6.0
        axis.set_tick_params(labelsize=style.SMALL_FONT_SIZE - 1.0, pad=-1.0 if axis is ax.zaxis else -3.0)
        # Ticks at the corners would overlap those of the next axis.
        axis.set_major_locator(MaxNLocator(5, prune="both"))


def clearest_azimuth(points: FloatArray) -> float:
    """Return the azimuth of the view [°] that best separates labelled points (n, 3)."""
    rise = np.radians(_ELEVATION)

    def least_distance(azimuth: float) -> float:
        a = np.radians(azimuth)
        right = [-np.sin(a), np.cos(a), 0.0]
        up = [-np.sin(rise) * np.cos(a), -np.sin(rise) * np.sin(a), np.cos(rise)]
        # Labels extend to the right, so that a vertical distance counts twice.
        return float(pdist(points @ np.array([right, up]).T * [0.5, 1.0]).min())

    return max((_AZIMUTH + turn for turn in _TURNS), key=least_distance)


def _draw_sources_arrow(ax: Any, result: Design) -> FloatArray:
    """Draw an arrow towards sources on one side, and return the place of its label (1 or 0, 3)."""
    volume, region = result.task.volume, result.task.region
    if isinstance(region, Cap):
        if region.half_angle_rad > 0.6 * np.pi:
            return np.empty((0, 3))
        towards = np.array(region.towards)
    else:
        middle = region.positions(np.full((1, 3), 0.5))[0]
        towards = middle - volume.centre
    length = float(np.linalg.norm(towards))
    if length == 0.0:
        return np.empty((0, 3))
    direction = towards / length
    ax.quiver(
        *volume.centre, *(_ARROW * volume.radius * direction), color=style.ORANGE, lw=1.4, arrow_length_ratio=0.12
    )
    # The label is below the head of a flat arrow, and beyond the head of a steep one.
    flat = abs(direction[2]) < _FLAT
    label = volume.centre + volume.radius * ((_ARROW if flat else _ARROW_LABEL) * direction - [0.0, 0.0, 0.25 * flat])
    ax.text(*label, "sources", fontsize=style.SMALL_FONT_SIZE, ha="center", va="center")
    return np.array([label])


def _outline(volume: Volume) -> list[FloatArray]:
    """Return lines (n, 3) along the edges of a solid."""
    angle = np.linspace(0.0, 2.0 * np.pi, 73)
    c, s, o = np.cos(angle), np.sin(angle), np.zeros_like(angle)
    if isinstance(volume, Ball):
        rings = [np.stack(ring, axis=1) for ring in ((c, s, o), (c, o, s), (o, c, s))]
        return [volume.centre + volume.radius_m * ring for ring in rings]
    if isinstance(volume, Cylinder):
        ring = volume.radius_m * np.stack([c, s, o], axis=1)
        half = np.array([0.0, 0.0, 0.5 * volume.height_m])
        sides = [np.stack([ring[i] - half, ring[i] + half]) for i in range(0, 72, 9)]
        return [volume.centre + line for line in (ring - half, ring + half, *sides)]
    if isinstance(volume, BoxVolume):
        corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
        corners = volume.centre + corners * np.array(volume.size_m)
        edges = [(i, i | bit) for i in range(8) for bit in (1, 2, 4) if not i & bit]
        return [corners[list(edge)] for edge in edges]
    return []
