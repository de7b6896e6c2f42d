"""Pictures of Cramér-Rao bounds: planes through the array, spheres about it, and how far it reaches."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, to_rgb
from matplotlib.figure import Figure

from arrays.io.text import replace_file
from magloc.bounds.maps import CASES, PLANES, BoundScenario
from magloc.plots import style

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes
from arrays import typing

FloatArray = typing.FloatArray
_COLOURS = "viridis"
_ON_DARK, _ON_LIGHT = "#ffffff", "#000000"
_DECADES = 10.0 ** np.arange(-9, 10)
# Names, colours, lines and widths of the four values of every bound.
_CASES = {
    "": ("given moment", style.BLACK, "-", 1.4),
    "_median": ("median of moments", style.GREY, "-.", 1.0),
    "_q95": ("95 % of moments", style.BLUE, "-", 1.4),
    "_worst": ("worst of those sampled", style.ORANGE, "--", 1.0),
}
_LIGHT_FROM = 0.65  # share of the colours from which on a line has to be black to be seen
_KNOWN_NOTHING_DEG = 100.0
_LOWER_RIGHT = np.radians(-45.0)
_FRAME_MS, _LAST_FRAME_MS = 200, 1500
_FRAME_DPI = 110


def bound_slices(dataset: xr.Dataset, scenario: BoundScenario) -> Figure:
    """Bounds on three planes through the array, on logarithmic colours with labelled contours.

    Rows: σ of the range for the given moment and for 95 % of the moments, σ of the bearing for 95 % of them. The thick
    line is the required accuracy.

    Parameters
    ----------
    dataset : xarray.Dataset
        Made by :func:`magloc.bounds.maps.bound_slices`.
    scenario : BoundScenario
        That it was made for.

    Examples
    --------
    >>> import magloc
    >>> from magloc.bounds import maps
    >>> scenario = maps.BoundScenario(moment_Am2=(60.0, 50.0, 60.0), n_moments=5)
    >>> bounds = maps.bound_slices(scenario, grid=11)
    >>> figure = magloc.plots.bound_slices(bounds, scenario)
    """
    # Places by hand: a layout engine draws everything twice.
    figure = style.new_figure(6.2, layout=None)
    places = {"left": 0.075, "right": 0.87, "bottom": 0.125, "top": 0.92, "wspace": 0.34, "hspace": 0.12}
    axes = figure.subplots(3, 3, gridspec_kw=places)
    degrees = np.degrees(1.0)
    rows = (
        ("sigma_range", 1.0, "σ of the range [m],\ngiven moment"),
        ("sigma_range_q95", 1.0, "σ of the range [m],\n95 % of moments"),
        ("sigma_bearing_q95", degrees, "σ of the bearing [°],\n95 % of moments"),
    )
    for row, (name, factor, label) in zip(axes, rows, strict=True):
        values = factor * dataset[name].to_numpy()
        norm = _norm(values, _KNOWN_NOTHING_DEG if "bearing" in name else 2.0 * scenario.half_width_m)
        for ax, plane, part in zip(row, PLANES, values, strict=True):
            _slice(ax, dataset, part, norm, None if "bearing" in name else scenario.accuracy_m)
            _sensors(ax, scenario, plane)
            style.dress(ax, f"{plane[0]} [m]", f"{plane[1]} [m]", f"plane {plane}" if row is axes[0] else "")
            ax.grid(visible=False)
        _bar(figure, row[-1], norm, label)
    _label_inner(axes)
    style.legend(figure, handles=axes[0, 0].get_legend_handles_labels()[0], loc="lower center", ncols=4)
    style.headline(figure, f"Cramér-Rao bounds of {_in_words(scenario)}")
    return figure


def bound_sphere(dataset: xr.Dataset, scenario: BoundScenario, range_m: float) -> Figure:
    """Bounds on a sphere about the array, in Mollweide's equal-area projection.

    σ of the range and of the bearing, for the given moment and for 95 % of the moments.

    Parameters
    ----------
    dataset : xarray.Dataset
        Made by :func:`magloc.bounds.spheres.bound_spheres`.
    scenario : BoundScenario
        That it was made for.
    range_m : float
        Which one of its spheres; the nearest.

    Examples
    --------
    >>> import magloc
    >>> from magloc.bounds import maps, spheres
    >>> scenario = maps.BoundScenario(moment_Am2=(60.0, 50.0, 60.0), n_moments=5)
    >>> bounds = spheres.bound_spheres(scenario, [5.0, 10.0], step_deg=30.0)
    >>> figure = magloc.plots.bound_sphere(bounds, scenario, 5.0)
    """
    sphere = dataset.sel(range=range_m, method="nearest")
    figure = style.new_figure(4.3, layout=None)
    places = {"left": 0.045, "right": 0.875, "bottom": 0.095, "top": 0.88, "wspace": 0.1, "hspace": 0.22}
    axes = figure.subplots(2, 2, subplot_kw={"projection": "mollweide"}, gridspec_kw=places)
    for row, (name, factor, label) in zip(
        axes,
        (("sigma_range", 1.0, "σ of the range [m]"), ("sigma_bearing", np.degrees(1.0), "σ of the bearing [°]")),
        strict=True,
    ):
        panels = [factor * sphere[f"{name}{case}"].to_numpy() for case in ("", "_q95")]
        accuracy, most = (scenario.accuracy_m, 2.0 * range_m) if name == "sigma_range" else (None, _KNOWN_NOTHING_DEG)
        norm = _norm(np.stack(panels), most)
        levels = _levels(np.stack(panels), norm, accuracy)
        for ax, case, values in zip(row, ("", "_q95"), panels, strict=True):
            _sphere(ax, sphere, values, norm, levels, accuracy, f"{label[:-4]}, {_CASES[case][0]}")
            if not case:
                _moment_marks(ax, scenario)
        _mark_lines(_bar(figure, row[-1], norm, label), levels, accuracy, norm)
    style.legend(figure, handles=axes[0, 0].get_legend_handles_labels()[0], loc="lower center", ncols=3)
    style.headline(
        figure, f"Sources {float(sphere['range']):.3g} m from {_in_words(scenario)}: azimuth across, elevation up"
    )
    return figure


def bound_reach(dataset: xr.Dataset, scenario: BoundScenario) -> Figure:
    """How far away the range is known as well as required, and how far a source is found, in three planes.

    Polar curves for the given moment, and for the median, 95 % and the worst of the moments.

    Parameters
    ----------
    dataset : xarray.Dataset
        Made by :func:`magloc.bounds.spheres.bound_spheres`; with the detection ranges of
        :func:`magloc.bounds.spheres.with_detection_ranges`, or without.
    scenario : BoundScenario
        That it was made for.

    Examples
    --------
    >>> import magloc
    >>> from magloc.bounds import maps, spheres
    >>> scenario = maps.BoundScenario(moment_Am2=(60.0, 50.0, 60.0), n_moments=5)
    >>> bounds = spheres.bound_spheres(scenario, [5.0, 10.0], step_deg=30.0)
    >>> figure = magloc.plots.bound_reach(bounds, scenario)
    """
    rows = {"accuracy_range": f"range known: σ ≤ {scenario.accuracy_m:g} m"}
    if "detection_range" in dataset:
        rows["detection_range"] = f"found: probability ≥ {100.0 * dataset.attrs['detection_probability']:g} %"
    height = 0.75 + 2.25 * len(rows)
    figure = style.new_figure(height, layout=None)
    places = {"left": 0.09, "right": 0.965, "bottom": 0.5 / height, "top": 1.0 - 0.6 / height, "wspace": 0.3}
    axes = figure.subplots(
        len(rows), 3, subplot_kw={"projection": "polar"}, gridspec_kw={**places, "hspace": 0.3}, squeeze=False
    )
    for row, (name, label) in zip(axes, rows.items(), strict=True):
        _reach_row(row, dataset, name)
        middle = row[0].get_position()
        figure.text(0.022, 0.5 * (middle.y0 + middle.y1), label, rotation=90, va="center", fontsize=style.LETTERS)
    for ax, plane in zip(axes[0], PLANES, strict=True):
        ax.set_title(f"plane {plane}", fontsize=style.LETTERS, loc="left")
    style.legend(figure, handles=axes[0, 0].get_legend_handles_labels()[0], loc="lower center", ncols=4)
    style.headline(figure, f"Largest distance in every direction: {_in_words(scenario)}")
    return figure


def _reach_row(axes: Sequence[Any], dataset: xr.Dataset, name: str) -> None:
    """Polar curves of one reach in the three planes, on one scale."""
    step, n_circles = _circles(max(float(dataset[f"{name}{case}"].max()) for case in CASES))
    circles = step * np.arange(1, n_circles + 1)
    for ax, plane in zip(axes, PLANES, strict=True):
        curves = []
        for case, (label, colour, line, width) in _CASES.items():
            angle, reach = _around(dataset[f"{name}{case}"], plane)
            curves.append(reach)
            ax.plot(angle, reach, line, color=colour, lw=width, label=label)
        ax.set_ylim(0.0, circles[-1])
        ax.set_xticks(np.radians([0.0, 90.0, 180.0, 270.0]), [f"+{plane[0]}", f"+{plane[1]}", f"−{plane[0]}", ""])
        ax.text(
            np.radians(270.0), 1.05 * circles[-1], f"−{plane[1]}", ha="center", va="top", fontsize=style.SMALL_LETTERS
        )
        ax.set_yticks(circles, [""] * len(circles))
        low, high = 0.85 * np.min(curves), 1.05 * np.max(curves)
        if not np.max(curves) > 0.0:
            ax.text(0.5, 0.5, "at no distance", transform=ax.transAxes, ha="center", fontsize=style.LETTERS)
        for circle in circles:
            if circle == circles[-1]:
                ax.text(_LOWER_RIGHT, 1.03 * circle, f"{circle:g} m", va="top", fontsize=style.SMALL_LETTERS)
            elif not low < circle < high:  # a number where curves pass could not be read
                ax.text(
                    _LOWER_RIGHT, circle, f"{circle:g} m", ha="center", va="center", fontsize=style.SMALL_LETTERS,
                    bbox={"facecolor": "#ffffff", "edgecolor": "none", "pad": 0.4},
                )  # fmt: skip
        ax.tick_params(labelsize=style.SMALL_LETTERS, pad=0.5)
        ax.grid(visible=True, color=style.LIGHT_GREY, linewidth=0.4)
        for spine in ax.spines.values():
            spine.set_linewidth(0.6)


def write_bound_animation(
    dataset: xr.Dataset, scenario: BoundScenario, path: Path, progress: Callable[[int], None] | None = None
) -> None:
    """Animation (GIF) of σ of the range on spheres, from the nearest to the farthest.

    ``dataset``: made by :func:`magloc.bounds.spheres.bound_spheres`. ``scenario``: that it was made for.
    ``progress``: called with the number of pictures finished since the last call.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from PIL import Image

    cases = ("", "_q95")
    figure = style.new_figure(2.4, layout=None)
    figure.set_dpi(_FRAME_DPI)
    canvas = FigureCanvasAgg(figure)
    places = {"left": 0.045, "right": 0.875, "bottom": 0.04, "top": 0.84, "wspace": 0.1}
    axes = figure.subplots(1, 2, subplot_kw={"projection": "mollweide"}, gridspec_kw=places)
    values = np.stack([dataset[f"sigma_range{case}"].to_numpy() for case in cases])
    norm = _norm(values, 2.0 * float(dataset["range"].max()))
    levels = _levels(values, norm, scenario.accuracy_m)
    _mark_lines(_bar(figure, axes[-1], norm, "σ of the range [m]"), levels, scenario.accuracy_m, norm)
    palette = Image.new("P", (1, 1))
    palette.putpalette(_palette())
    frames: list[Image.Image] = []
    for i, distance in enumerate(dataset["range"].to_numpy()):
        sphere = dataset.isel(range=i)
        for ax, case, of_case in zip(axes, cases, values, strict=True):
            ax.clear()
            _sphere(ax, sphere, of_case[i], norm, levels, scenario.accuracy_m, _CASES[case][0])
            if not case:
                _moment_marks(ax, scenario)
        style.headline(figure, f"σ of the range at {distance:.3g} m: {_in_words(scenario)}")
        canvas.draw()  # type: ignore[no-untyped-call]
        picture = Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3])  # type: ignore[no-untyped-call]
        frames.append(picture.quantize(palette=palette, dither=Image.Dither.NONE))
        if progress is not None:
            progress(1)
    durations = [_FRAME_MS] * (len(frames) - 1) + [_LAST_FRAME_MS]
    # The name may end in anything: the format is not taken from it.
    options: dict[str, Any] = {"duration": durations, "loop": 0, "optimize": False}
    replace_file(
        path, lambda place: frames[0].save(place, format="GIF", save_all=True, append_images=frames[1:], **options)
    )


def _palette() -> list[int]:
    """Colours of all frames: one that changed from frame to frame would seem to mean something."""
    greys = np.repeat(np.linspace(0.0, 1.0, 24)[:, None], 3, axis=1)
    accents = np.linspace(np.array(to_rgb(style.ORANGE)), 1.0, 8)
    colours = colormaps[_COLOURS](np.linspace(0.0, 1.0, 224))[:, :3]
    return np.rint(255.0 * np.concatenate([greys, accents, colours])).astype(int).ravel().tolist()


def _norm(values: FloatArray, most: float) -> LogNorm:
    """Whole decades that most of the values lie in, up to one that is as good as knowing nothing; five at most."""
    positive = values[np.isfinite(values) & (values > 0.0)]
    low, high = np.log10(np.percentile(positive, [2.0, 98.0])) if positive.size else (0.0, 1.0)
    top = min(np.ceil(high - 0.1), np.ceil(np.log10(most) - 0.1))
    bottom = max(min(np.floor(low + 0.1), top - 1.0), top - 5.0)
    return LogNorm(10.0**bottom, 10.0**top)


def _levels(values: FloatArray, norm: LogNorm, accuracy: float | None) -> list[float]:
    """Contours that are worth a label: powers of ten; where they would be few, 2 and 5 between them."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return []
    lowest, highest = _limits(norm)
    low, high = max(float(finite.min()), 0.999 * lowest), min(float(finite.max()), 1.001 * highest)
    steps = (1.0, 2.0, 5.0) if high < 300.0 * low else (1.0,)
    every = np.sort(np.outer(_DECADES, steps).ravel())
    # So near to the thick line the labels of both would meet.
    return [
        float(f"{level:.3g}")
        for level in every
        if low < level < high and (accuracy is None or abs(np.log(level / accuracy)) > 0.25)
    ]


def _limits(norm: LogNorm) -> tuple[float, float]:
    return float(norm.vmin or 0.0), float(norm.vmax or 0.0)


def _shown(ax: Axes, values: FloatArray, norm: LogNorm) -> FloatArray:
    """Values to colour: what is infinite has the last colour, and a word where that is all; what is undefined none."""
    infinite = np.isinf(values)
    if infinite.any() and not np.isfinite(values).any():
        ax.text(
            0.5, 0.3, "infinite: not to be known", transform=ax.transAxes, ha="center", va="center",
            fontsize=style.LETTERS,
        )  # fmt: skip
    return np.where(infinite, 10.0 * _limits(norm)[1], values)


def _contours(
    ax: Axes,
    across: FloatArray,
    up: FloatArray,
    values: FloatArray,
    norm: LogNorm,
    levels: Sequence[float],
    accuracy: float | None,
) -> Any:
    """Thin lines at the levels, a thick one at the accuracy; returns the thin ones, if there are any."""
    if accuracy is not None:
        ax.plot([], [], color=style.ORANGE, lw=1.8, label=f"required: {accuracy:g} m")
    finite = np.where(np.isfinite(values), values, np.nan)
    if np.isnan(finite).all():
        return None
    log = np.log10(finite)
    options: dict[str, Any] = {"linestyles": "solid", "zorder": 1.5}
    low, high = np.nanmin(finite), np.nanmax(finite)
    lines = None
    inside = [level for level in levels if low < level < high]
    if inside:
        lines = ax.contour(
            across, up, log, levels=np.log10(inside), colors=_line_colours(inside, norm), linewidths=0.6, **options
        )
    if accuracy is not None and low < accuracy < high:
        ax.contour(across, up, log, levels=[np.log10(accuracy)], colors=[style.ORANGE], linewidths=1.8, **options)
    return lines


def _line_colours(levels: Sequence[float], norm: LogNorm) -> list[str]:
    return [_ON_DARK if norm(level) < _LIGHT_FROM else _ON_LIGHT for level in levels]


def _slice(ax: Axes, dataset: xr.Dataset, values: FloatArray, norm: LogNorm, accuracy: float | None) -> None:
    across, up = dataset["across"].to_numpy(), dataset["up"].to_numpy()
    half = 0.5 * float(across[1] - across[0])
    extent = (across[0] - half, across[-1] + half, up[0] - half, up[-1] + half)
    ax.imshow(
        _shown(ax, values, norm), origin="lower", extent=extent, norm=norm, cmap=_COLOURS, interpolation="nearest"
    )
    lines = _contours(ax, across, up, values, norm, _levels(values, norm, accuracy), accuracy)
    if lines is not None:
        ax.clabel(lines, fontsize=style.SMALL_LETTERS - 1.5, fmt=lambda value: f"{10.0**value:.3g}")


def _sensors(ax: Axes, scenario: BoundScenario, plane: str) -> None:
    places = scenario.array.positions - scenario.array.centroid
    i, j = ("xyz".index(name) for name in plane)
    ax.plot(places[:, i], places[:, j], "o", color=_ON_DARK, mec=style.BLACK, ms=2.5, mew=0.5, label="sensors")


def _sphere(
    ax: Axes,
    sphere: xr.Dataset,
    values: FloatArray,
    norm: LogNorm,
    levels: Sequence[float],
    accuracy: float | None,
    title: str,
) -> None:
    azimuth, elevation = (np.radians(sphere[name].to_numpy()) for name in ("azimuth", "elevation"))
    colours = _shown(ax, values, norm)
    ax.pcolormesh(azimuth, elevation, colours, norm=norm, cmap=_COLOURS, shading="gouraud", rasterized=True)
    _contours(ax, azimuth, elevation, values, norm, levels, accuracy)
    ax.set_title(title, fontsize=style.LETTERS, pad=8)
    ax.grid(visible=False)
    ax.set_xticks(np.radians([-90.0, 90.0]), ["−90°", "90°"], color=_ON_DARK)
    ax.set_yticks(np.radians([-60.0, -30.0, 0.0, 30.0, 60.0]), ["−60°", "−30°", "0°", "30°", "60°"])
    ax.tick_params(labelsize=style.SMALL_LETTERS - 1.0)
    for spine in ax.spines.values():
        spine.set_linewidth(0.6)


def _moment_marks(ax: Axes, scenario: BoundScenario) -> None:
    """Where the given moment points to, and from."""
    m = np.asarray(scenario.moment_Am2) / np.linalg.norm(scenario.moment_Am2)
    for sign, marker, label in ((1.0, "^", "moment points here"), (-1.0, "v", "and away from here")):
        x, y, z = sign * m
        ax.plot(
            np.arctan2(y, x), np.arcsin(np.clip(z, -1.0, 1.0)), marker, color=style.ORANGE, mec=style.BLACK, ms=6,
            mew=0.7, ls="none", label=label, clip_on=False,
        )  # fmt: skip


def _around(reach: xr.DataArray, plane: str) -> tuple[FloatArray, FloatArray]:
    """Angle from the plane's first axis to its second, and the reach, all the way round."""
    if plane == "xy":
        return np.radians(reach["azimuth"].to_numpy()), reach.sel(elevation=0.0).to_numpy()
    front, back = (0.0, 180.0) if plane == "xz" else (90.0, -90.0)
    elevation = np.radians(reach["elevation"].to_numpy())
    there = reach.sel(azimuth=front).to_numpy()
    round_the_back = reach.sel(azimuth=back).to_numpy()[::-1]
    return np.concatenate([elevation, elevation + np.pi]), np.concatenate([there, round_the_back])


def _circles(greatest: float) -> tuple[float, int]:
    """Distance between circles of round numbers, and how many of them hold a curve."""
    if not greatest > 0.0:
        return 1.0, 1
    power = 10.0 ** np.floor(np.log10(greatest / 2.0))
    step = float(power * next(s for s in (1.0, 2.0, 2.5, 5.0, 10.0) if 3.0 * s * power > 1.02 * greatest))
    return step, int(np.ceil(1.02 * greatest / step))


def _bar(figure: Figure, beside: Axes, norm: LogNorm, label: str) -> Any:
    """Colour bar at the right of a panel, as high as the panel."""
    place = beside.get_position()
    bar = figure.colorbar(
        ScalarMappable(norm, _COLOURS), cax=figure.add_axes((0.89, place.y0, 0.014, place.height)), extend="both"
    )
    bar.set_label(label, fontsize=style.LETTERS)
    bar.ax.tick_params(labelsize=style.SMALL_LETTERS, which="major", length=2.0)
    bar.ax.tick_params(which="minor", length=0.0)
    bar.ax.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    bar.ax.yaxis.set_minor_formatter("")
    return bar


def _mark_lines(bar: Any, levels: Sequence[float], accuracy: float | None, norm: LogNorm) -> None:
    """The contour lines, on the bar: lines on a map of the sphere have no room for labels."""
    low, high = _limits(norm)
    for level, colour in zip(levels, _line_colours(levels, norm), strict=True):
        bar.ax.axhline(level, color=colour, lw=0.6)
    if accuracy is not None and low < accuracy < high:
        bar.ax.axhline(accuracy, color=style.ORANGE, lw=1.8)
    bar.set_ticks([level for level in levels if low <= level <= high])


def _label_inner(axes: Any) -> None:
    for ax in axes[:-1].ravel():
        ax.set_xlabel("")
        ax.set_xticklabels([])


def _in_words(scenario: BoundScenario) -> str:
    size = float(np.linalg.norm(scenario.moment_Am2))
    return f"{_name(scenario)}, {size:.4g} A·m²"


def _name(scenario: BoundScenario) -> str:
    array = scenario.array
    kinds: Sequence[str] = sorted({sensor.kind for sensor in array.sensors})
    return array.name or f"an array of {array.n_sensors} {' and '.join(kinds)} sensors"
