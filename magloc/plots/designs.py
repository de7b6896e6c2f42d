"""What a design looks like, and what it gains."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from scipy.spatial.distance import pdist

from arrays.rng import Rng, accept_seed
from arrays.typing import FloatArray
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
# More sensors than this would hide behind their names.
_MOST_NAMED = 12
_FEWEST_TICKS = 3
_ELEVATION, _AZIMUTH = 22.0, -55.0
# About the azimuth, and behind the array [°]: the first of them that is clearest.
_TURNS = (0.0, -15.0, 15.0, 90.0, -90.0, 180.0, 75.0, 105.0, -75.0, -105.0, 165.0, 195.0)
_REACH, _ARROW, _ARROW_LABEL, _FLAT = 1.25, 1.2, 1.42, 0.5


@accept_seed
def design(result: Design, rng: Rng = 0) -> Figure:
    """Sensors in their volume, and the 95 % quantile of the range's σ over the distance, against the references.

    Parameters
    ----------
    result : Design
    rng : int or numpy.random.Generator
        Seed or generator of the sources of the curves.

    Examples
    --------
    >>> import magloc
    >>> task = magloc.DesignTask.read("half-space-2m")
    >>> found = magloc.design_array(task, starts=2)  # doctest: +SKIP
    >>> figure = magloc.plots.design(found)  # doctest: +SKIP
    """
    figure = style.new_figure(3.3, layout=None)
    scene = figure.add_axes((0.025, 0.06, 0.36, 0.84), projection="3d")
    _scene(scene, result)
    ax = figure.add_axes((0.5, 0.15, 0.205, 0.68))
    relative = figure.add_axes((0.78, 0.15, 0.2, 0.68))
    sources = random_sample(result.task, _N_SOURCES, np.random.default_rng(rng))
    distances = _distances(result)
    arrays = _shown(result)
    curves = [range_spread(result.task, judged.array, sources, distances).q95_m for judged in arrays]
    for judged, curve in zip(arrays, curves, strict=True):
        colour, marker, line = _LINES[_DESIGN if judged is result.judged[0] else judged.name]
        options: dict[str, Any] = {"color": colour, "marker": marker, "ls": line, "lw": 1.0, "ms": 3.0, "markevery": 3}
        shown = np.where(np.isfinite(curve), curve, np.nan)
        ax.plot(distances, shown, label=_name(result, judged), **options)
        with np.errstate(invalid="ignore"):
            relative.plot(distances, shown / np.where(np.isfinite(curves[0]), curves[0], np.nan), **options)
    for panel, up in ((ax, "q95 of the σ of the range [m]"), (relative, "relative to the design [1]")):
        panel.set_xscale("log")
        style.dress(panel, "distance of the source [m]", up)
        panel.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
        panel.xaxis.set_minor_formatter("")
        panel.set_xticks(_ticks(distances[0], distances[-1]))
    style.logarithmic(ax, curves)
    relative.set_ylim(bottom=0.0)
    style.legend(
        figure,
        handles=ax.get_legend_handles_labels()[0],
        loc="upper right",
        bbox_to_anchor=(0.985, 0.92),
        ncols=5,
        columnspacing=0.8,
    )
    style.headline(figure, _headline(result))
    return figure


def design_counts(results: Sequence[Design]) -> Figure:
    """What more sensors gain: the criterion over their number, of designs and of even grids in the same volume.

    Parameters
    ----------
    results : sequence of Design
        Of one task with several numbers of sensors.

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
    unit, per_m = style.length_unit(max(float(np.max(curve)) for curve in curves.values()))
    figure = style.new_figure(2.7)
    ax, relative = figure.subplots(1, 2, width_ratios=[1.6, 1.0])
    for name, curve in curves.items():
        colour, marker, line = _LINES[name]
        ax.plot(numbers, per_m * curve, color=colour, marker=marker, ls=line, lw=1.0, ms=4.0, label=name)
    criterion = ordered[0].task.criterion
    style.logarithmic(ax, [per_m * curve for curve in curves.values()])
    style.dress(ax, "sensors", f"{criterion} of the σ of the range [{unit}]", ordered[0].task.name)
    gain, error = (np.array([getattr(judged, name) for judged in grids]) for name in ("gain", "gain_error"))
    relative.errorbar(
        numbers, 100.0 * gain, 100.0 * style.SIGMAS_95 * error, color=style.BLUE, marker="o", lw=1.0, ms=4.0
    )
    relative.axhline(0.0, color=style.GREY, lw=0.6)
    style.dress(relative, "sensors", "gain over the even grid [%]", "with 95 % intervals")
    for panel in (ax, relative):
        panel.xaxis.set_major_locator(MaxNLocator(integer=True))
    style.legend(ax)
    return figure


def _shown(result: Design) -> list[Judgement]:
    """The design and the references; the best start too where no reference could be built."""
    some_fit = any(other.fits for other in result.judged[2:])
    every = [judged for judged in result.judged if not (some_fit and judged.name == BEST_START)]
    return [judged for judged in every if np.isfinite(judged.criterion_m)]


def _headline(result: Design) -> str:
    own = result.judged[0]
    text = f"'{result.task.name}': {result.task.criterion} of the σ of the range {style.length_text(own.criterion_m)}"
    others = [other for other in _shown(result)[1:] if other.fits]
    if not others:
        return text
    first = others[0]
    sign = "below" if first.gain >= 0.0 else "above"
    whose = {BEST_START: f"that of its {first.name}", EVEN: f"an {EVEN} of the same volume"}
    what = whose.get(first.name, f"a {first.name} of the same span")
    return f"{text}, {100.0 * abs(first.gain):.0f} % {sign} {what}"


def _ticks(first_m: float, last_m: float) -> list[float]:
    """Round distances between two, with more to a decade where they would be few."""
    for steps in ((1, 2, 5), (1, 1.5, 2, 3, 4, 5, 6, 8)):
        every = [step * 10.0**decade for decade in range(-4, 5) for step in steps]
        ticks = [tick for tick in every if first_m * (1.0 - 1e-9) <= tick <= last_m * (1.0 + 1e-9)]
        if len(ticks) >= _FEWEST_TICKS:
            break
    return ticks


def _name(result: Design, judged: Judgement) -> str:
    name = _DESIGN if judged is result.judged[0] else judged.name
    return f"{name} ({judged.array.n_sensors}{'' if judged.fits else ', outside'})"


def _distances(result: Design) -> FloatArray:
    stated = result.judged[0].distance_m
    return np.geomspace(stated[0], stated[-1], _N_DISTANCES)


def _scene(ax: Any, result: Design) -> None:
    """The volume as a wire frame, the sensors, and where the sources are."""
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
        if len(sensors) <= _MOST_NAMED:
            ax.plot(*np.stack([volume.centre, place]).T, color=style.BLUE, lw=0.8)
    ax.scatter(*sensors.T, color=style.BLUE, s=26, depthshade=False, edgecolor=style.BLACK, linewidth=0.5)
    for name, place in zip(result.array.ids, sensors, strict=True) if len(sensors) <= _MOST_NAMED else ():
        ax.text(*place, f"  {name}", fontsize=style.SMALL_LETTERS, ha="left", va="bottom", zorder=9)
    arrow_name = _sources_arrow(ax, result)
    reach = _REACH * volume.radius
    for set_limits, centre in zip((ax.set_xlim, ax.set_ylim, ax.set_zlim), volume.centre, strict=True):
        set_limits(centre - reach, centre + reach)
    ax.set_box_aspect((1.0, 1.0, 1.0), zoom=0.92)
    named = np.vstack([sensors, arrow_name])
    ax.view_init(_ELEVATION, clear_azimuth(named) if len(sensors) <= _MOST_NAMED else _AZIMUTH)
    for label, axis in (("x [m]", ax.xaxis), ("y [m]", ax.yaxis), ("z [m]", ax.zaxis)):
        axis.set_label_text(label, fontsize=style.SMALL_LETTERS)
        axis.labelpad = -6.0
        axis.set_tick_params(labelsize=style.SMALL_LETTERS - 1.0, pad=-1.0 if axis is ax.zaxis else -3.0)
        # Ticks at the corners would run into those of the next axis.
        axis.set_major_locator(MaxNLocator(5, prune="both"))


def clear_azimuth(points: FloatArray) -> float:
    """Direction to look from [°] in which points (n, 3) that have a name are farthest apart in the picture."""
    rise = np.radians(_ELEVATION)

    def least_distance(azimuth: float) -> float:
        a = np.radians(azimuth)
        right = [-np.sin(a), np.cos(a), 0.0]
        up = [-np.sin(rise) * np.cos(a), -np.sin(rise) * np.sin(a), np.cos(rise)]
        # Names are written to the right: above one another they are clear sooner.
        return float(pdist(points @ np.array([right, up]).T * [0.5, 1.0]).min())

    return max((_AZIMUTH + turn for turn in _TURNS), key=least_distance)


def _sources_arrow(ax: Any, result: Design) -> FloatArray:
    """An arrow towards the middle of the sources, where they have one side; the places of its name, none or one."""
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
    # Below the head of an arrow that lies flat, beyond that of one that does not.
    flat = abs(direction[2]) < _FLAT
    label = volume.centre + volume.radius * ((_ARROW if flat else _ARROW_LABEL) * direction - [0.0, 0.0, 0.25 * flat])
    ax.text(*label, "sources", fontsize=style.SMALL_LETTERS, ha="center", va="center")
    return np.array([label])


def _outline(volume: Volume) -> list[FloatArray]:
    """Lines (n, 3) that show a solid."""
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
