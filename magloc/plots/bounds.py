"""Figures of Cramér-Rao bounds: planes through the array, spheres around it, and its reach."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import LogNorm, to_rgb
from matplotlib.figure import Figure

from arrays.io.text import replace_file
from magloc.bounds.maps import CASES, PLANES, BoundScenario
from magloc.plots import style
from magloc.plots.bound_scale import (
    COLOURS,
    ON_DARK,
    add_colour_bar,
    contour_levels,
    draw_contours,
    fill_infinite,
    label_accuracy,
    log_norm,
    mark_levels,
    scenario_text,
    sigma_unit,
)

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes

    from magloc.bounds.crlb import Bounds
from arrays import typing

FloatArray = typing.FloatArray
# Names, colours, line styles and widths of the four values of every bound.
_CASES = {
    "": ("given moment", style.BLACK, "-", 1.4),
    "_median": ("median of moments", style.GREY, "-.", 1.0),
    "_q95": ("95 % of moments", style.BLUE, "-", 1.4),
    "_worst": ("worst of those sampled", style.ORANGE, "--", 1.0),
}
_LARGEST_SIGMA_DEG = 100.0
_LOWER_RIGHT = np.radians(-45.0)
_FRAME_MS, _LAST_FRAME_MS = 200, 1500
_FRAME_DPI = 110


def bounds_figure(found: Bounds) -> Figure:
    """Draw σ of range, bearing, position and moment over the distance from the array.

    Parameters
    ----------
    found : Bounds
        A result of :func:`magloc.cramer_rao_bounds`. Infinite bounds are not drawn.

    Returns
    -------
    matplotlib.figure.Figure
        Figure; :func:`save` writes it to a file.

    Examples
    --------
    >>> import arrays
    >>> import magloc
    >>> places = [[x, 0.0, 0.5] for x in (2.0, 3.0, 4.0, 6.0)]
    >>> bounds = magloc.cramer_rao_bounds(arrays.tetrahedron(1.5), places, [0.0, 0.0, 100.0])
    >>> figure = magloc.plots.cramer_rao_bounds(bounds)
    """
    distance = np.ravel(found.range_m)
    order = np.argsort(distance, kind="stable")
    across, per_across = style.axis_unit(float(distance.max()))
    figure = style.new_figure(2.9)
    axes = figure.subplots(1, 3)
    lengths = [np.ravel(found.sigma_range_m), np.ravel(found.sigma_position_m)]
    finite = np.concatenate(lengths)
    finite = finite[np.isfinite(finite)]
    unit, per_m = style.axis_unit(float(finite.max()) if finite.size else 1.0)
    panels = (
        (
            f"σ [{unit}]",
            (("position", per_m * lengths[1], style.BLACK, "s--"), ("range", per_m * lengths[0], style.BLUE, "o-")),
        ),
        ("σ [°]", (("bearing", np.degrees(np.ravel(found.sigma_bearing_rad)), style.BLUE, "o-"),)),
        ("σ [A·m²]", (("moment", np.ravel(found.sigma_moment_Am2), style.BLUE, "o-"),)),
    )
    for ax, (up, curves) in zip(axes, panels, strict=True):
        for name, values, colour, line in curves:
            ax.plot(per_across * distance[order], values[order], line, color=colour, lw=0.8, ms=3.0, label=name)
        style.set_log_scale(ax, [values for _, values, _, _ in curves])
        style.label_axes(ax, f"distance [{across}]", up)
        style.add_legend(ax)
    return figure


def bound_slices(dataset: xr.Dataset, scenario: BoundScenario) -> Figure:
    """Draw the bounds on three planes through the array, with labelled contours.

    The rows show σ of the range for the given moment, σ of the range for 95 % of the moments, and σ of the bearing for
    95 % of the moments. The thick line is the required accuracy.

    Parameters
    ----------
    dataset : xarray.Dataset
        A result of :func:`magloc.bounds.maps.bound_slices`.
    scenario : BoundScenario
        Scenario of the dataset.

    Returns
    -------
    matplotlib.figure.Figure
        Figure; :func:`save` writes it to a file.

    Examples
    --------
    >>> import magloc
    >>> from magloc.bounds import maps
    >>> scenario = maps.BoundScenario(moment_Am2=(60.0, 50.0, 60.0), n_moments=5)
    >>> bounds = maps.bound_slices(scenario, grid=11)
    >>> figure = magloc.plots.bound_slices(bounds, scenario)
    """
    # The panels have fixed places, because a layout engine draws everything twice.
    figure = style.new_figure(6.2, layout=None)
    places = {"left": 0.085, "right": 0.86, "bottom": 0.125, "top": 0.92, "wspace": 0.44, "hspace": 0.12}
    axes = figure.subplots(3, 3, gridspec_kw=places)
    unit, per_m = style.axis_unit(2.0 * scenario.half_width_m)
    degrees = float(np.degrees(1.0))
    rows = (
        ("sigma_range", "σ of the range [{}],\ngiven moment"),
        ("sigma_range_q95", "σ of the range [{}],\n95 % of moments"),
        ("sigma_bearing_q95", "σ of the bearing [°],\n95 % of moments"),
    )
    for row, (name, label) in zip(axes, rows, strict=True):
        bearing = "bearing" in name
        values_m = dataset[name].to_numpy()
        sigma_text, factor = ("°", degrees) if bearing else sigma_unit(values_m, 2.0 * scenario.half_width_m)
        values = factor * values_m
        norm = log_norm(values, _LARGEST_SIGMA_DEG if bearing else 2.0 * factor * scenario.half_width_m)
        accuracy = None if bearing else factor * scenario.accuracy_m
        for ax, plane, part in zip(row, PLANES, values, strict=True):
            _draw_slice(ax, dataset, part, norm, accuracy, per_m)
            _draw_sensors(ax, scenario, plane, per_m)
            if accuracy is not None:
                label_accuracy(ax, scenario, values_m)
            style.label_axes(
                ax, f"{plane[0]} [{unit}]", f"{plane[1]} [{unit}]", f"plane {plane}" if row is axes[0] else ""
            )
            ax.grid(visible=False)
        add_colour_bar(figure, row[-1], norm, label.format(sigma_text))
    _hide_inner_labels(axes)
    style.add_legend(figure, handles=axes[0, 0].get_legend_handles_labels()[0], loc="lower center", ncols=4)
    style.add_title(figure, f"Cramér-Rao bounds of {scenario_text(scenario)}")
    return figure


def bound_sphere(dataset: xr.Dataset, scenario: BoundScenario, range_m: float) -> Figure:
    """Draw the bounds on a sphere around the array, in Mollweide's equal-area projection.

    The panels show σ of the range and of the bearing, for the given moment and for 95 % of the moments.

    Parameters
    ----------
    dataset : xarray.Dataset
        A result of :func:`magloc.bounds.spheres.bound_spheres`.
    scenario : BoundScenario
        Scenario of the dataset.
    range_m : float
        Radius of the sphere; the nearest one of the dataset is drawn [m].

    Returns
    -------
    matplotlib.figure.Figure
        Figure; :func:`save` writes it to a file.

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
    cases = ("", "_q95")
    unit, per_m = sigma_unit(np.stack([sphere[f"sigma_range{case}"].to_numpy() for case in cases]), 2.0 * range_m)
    rows = (
        ("sigma_range", per_m, 2.0 * per_m * range_m, per_m * scenario.accuracy_m, f"σ of the range [{unit}]"),
        ("sigma_bearing", np.degrees(1.0), _LARGEST_SIGMA_DEG, None, "σ of the bearing [°]"),
    )
    for row, (name, factor, most, accuracy, label) in zip(axes, rows, strict=True):
        panels = [factor * sphere[f"{name}{case}"].to_numpy() for case in cases]
        norm = log_norm(np.stack(panels), most)
        levels = contour_levels(np.stack(panels), norm, accuracy)
        for ax, case, values in zip(row, cases, panels, strict=True):
            _draw_sphere(ax, sphere, values, norm, levels, accuracy, f"{label.split(' [')[0]}, {_CASES[case][0]}")
            if accuracy is not None:
                label_accuracy(ax, scenario, values / factor)
            if not case:
                _mark_moment(ax, scenario)
        mark_levels(add_colour_bar(figure, row[-1], norm, label), levels, accuracy, norm)
    style.add_legend(figure, handles=axes[0, 0].get_legend_handles_labels()[0], loc="lower center", ncols=3)
    distance = style.length_label(float(sphere["range"]))
    style.add_title(figure, f"Sources {distance} from {scenario_text(scenario)}: azimuth across, elevation up")
    return figure


def bound_reach(dataset: xr.Dataset, scenario: BoundScenario) -> Figure:
    """Draw the largest distances of the required accuracy and of detection, in three planes.

    The polar curves are for the given moment, and for the median, 95 % and the worst of the moments.

    Parameters
    ----------
    dataset : xarray.Dataset
        A result of :func:`magloc.bounds.spheres.bound_spheres`, with or without the detection ranges of
        :func:`magloc.bounds.spheres.with_detection_ranges`.
    scenario : BoundScenario
        Scenario of the dataset.

    Returns
    -------
    matplotlib.figure.Figure
        Figure; :func:`save` writes it to a file.

    Examples
    --------
    >>> import magloc
    >>> from magloc.bounds import maps, spheres
    >>> scenario = maps.BoundScenario(moment_Am2=(60.0, 50.0, 60.0), n_moments=5)
    >>> bounds = spheres.bound_spheres(scenario, [5.0, 10.0], step_deg=30.0)
    >>> figure = magloc.plots.bound_reach(bounds, scenario)
    """
    rows = {"accuracy_range": f"range known: σ ≤ {style.length_label(scenario.accuracy_m)}"}
    if "detection_range" in dataset:
        rows["detection_range"] = f"found: probability ≥ {100.0 * dataset.attrs['detection_probability']:g} %"
    height = 0.75 + 2.25 * len(rows)
    figure = style.new_figure(height, layout=None)
    places = {"left": 0.09, "right": 0.965, "bottom": 0.5 / height, "top": 1.0 - 0.6 / height, "wspace": 0.3}
    axes = figure.subplots(
        len(rows), 3, subplot_kw={"projection": "polar"}, gridspec_kw={**places, "hspace": 0.3}, squeeze=False
    )
    for row, (name, label) in zip(axes, rows.items(), strict=True):
        _draw_reach(row, dataset, name)
        middle = row[0].get_position()
        figure.text(0.022, 0.5 * (middle.y0 + middle.y1), label, rotation=90, va="center", fontsize=style.FONT_SIZE)
    for ax, plane in zip(axes[0], PLANES, strict=True):
        ax.set_title(f"plane {plane}", fontsize=style.FONT_SIZE, loc="left")
    style.add_legend(figure, handles=axes[0, 0].get_legend_handles_labels()[0], loc="lower center", ncols=4)
    style.add_title(figure, f"Largest distance in every direction: {scenario_text(scenario)}")
    return figure


def _draw_reach(axes: Sequence[Any], dataset: xr.Dataset, name: str) -> None:
    """Draw the polar curves of one reach in the three planes, on one scale."""
    step, n_circles = _circle_spacing(max(float(dataset[f"{name}{case}"].max()) for case in CASES))
    circles = step * np.arange(1, n_circles + 1)
    unit, per_m = style.axis_unit(float(circles[-1]))
    for ax, plane in zip(axes, PLANES, strict=True):
        curves = []
        for case, (label, colour, line, width) in _CASES.items():
            angle, reach = _reach_in_plane(dataset[f"{name}{case}"], plane)
            curves.append(reach)
            ax.plot(angle, reach, line, color=colour, lw=width, label=label)
        ax.set_ylim(0.0, circles[-1])
        ax.set_xticks(np.radians([0.0, 90.0, 180.0, 270.0]), [f"+{plane[0]}", f"+{plane[1]}", f"−{plane[0]}", ""])
        ax.text(
            np.radians(270.0), 1.05 * circles[-1], f"−{plane[1]}", ha="center", va="top", fontsize=style.SMALL_FONT_SIZE
        )
        ax.set_yticks(circles, [""] * len(circles))
        low, high = 0.85 * np.min(curves), 1.05 * np.max(curves)
        if not np.max(curves) > 0.0:
            ax.text(0.5, 0.5, "at no distance", transform=ax.transAxes, ha="center", fontsize=style.FONT_SIZE)
        for circle in circles:
            text = f"{per_m * circle:g} {unit}"
            if circle == circles[-1]:
                ax.text(_LOWER_RIGHT, 1.03 * circle, text, va="top", fontsize=style.SMALL_FONT_SIZE)
            elif not low < circle < high:  # a number under the curves would not be legible
                ax.text(
                    _LOWER_RIGHT, circle, text, ha="center", va="center", fontsize=style.SMALL_FONT_SIZE,
                    bbox={"facecolor": "#ffffff", "edgecolor": "none", "pad": 0.4},
                )  # fmt: skip
        ax.tick_params(labelsize=style.SMALL_FONT_SIZE, pad=0.5)
        ax.grid(visible=True, color=style.LIGHT_GREY, linewidth=0.4)
        for spine in ax.spines.values():
            spine.set_linewidth(0.6)


def write_bound_animation(
    dataset: xr.Dataset, scenario: BoundScenario, path: Path, progress: Callable[[int], None] | None = None
) -> None:
    """Write an animation (GIF) of σ of the range on spheres, from the nearest to the farthest.

    ``dataset``: a result of :func:`magloc.bounds.spheres.bound_spheres`. ``scenario``: scenario of the dataset.
    ``progress``: called with the number of pictures finished since the previous call.
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
    farthest_m = 2.0 * float(dataset["range"].max())
    unit, factor = sigma_unit(values, farthest_m)
    values, accuracy = factor * values, factor * scenario.accuracy_m
    norm = log_norm(values, factor * farthest_m)
    levels = contour_levels(values, norm, accuracy)
    mark_levels(add_colour_bar(figure, axes[-1], norm, f"σ of the range [{unit}]"), levels, accuracy, norm)
    palette = Image.new("P", (1, 1))
    palette.putpalette(_palette())
    frames: list[Image.Image] = []
    for i, distance in enumerate(dataset["range"].to_numpy()):
        sphere = dataset.isel(range=i)
        for ax, case, sigmas in zip(axes, cases, values, strict=True):
            ax.clear()
            _draw_sphere(ax, sphere, sigmas[i], norm, levels, accuracy, _CASES[case][0])
            if not case:
                _mark_moment(ax, scenario)
        style.add_title(figure, f"σ of the range at {style.length_label(distance)}: {scenario_text(scenario)}")
        canvas.draw()  # type: ignore[no-untyped-call]
        picture = Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3])  # type: ignore[no-untyped-call]
        frames.append(picture.quantize(palette=palette, dither=Image.Dither.NONE))
        if progress is not None:
            progress(1)
    durations = [_FRAME_MS] * (len(frames) - 1) + [_LAST_FRAME_MS]
    # The format is stated, because the file name may have any suffix.
    options: dict[str, Any] = {"duration": durations, "loop": 0, "optimize": False}
    replace_file(
        path, lambda place: frames[0].save(place, format="GIF", save_all=True, append_images=frames[1:], **options)
    )


def _palette() -> list[int]:
    """Return the colours of all frames, so that no colour changes from frame to frame."""
    greys = np.repeat(np.linspace(0.0, 1.0, 24)[:, None], 3, axis=1)
    accents = np.linspace(np.array(to_rgb(style.ORANGE)), 1.0, 8)
    colours = colormaps[COLOURS](np.linspace(0.0, 1.0, 224))[:, :3]
    return np.rint(255.0 * np.concatenate([greys, accents, colours])).astype(int).ravel().tolist()


def _draw_slice(
    ax: Axes, dataset: xr.Dataset, values: FloatArray, norm: LogNorm, accuracy: float | None, per_m: float
) -> None:
    across, up = per_m * dataset["across"].to_numpy(), per_m * dataset["up"].to_numpy()
    half = 0.5 * float(across[1] - across[0])
    extent = (across[0] - half, across[-1] + half, up[0] - half, up[-1] + half)
    ax.imshow(
        fill_infinite(ax, values, norm), origin="lower", extent=extent, norm=norm, cmap=COLOURS, interpolation="nearest"
    )
    lines = draw_contours(ax, across, up, values, norm, contour_levels(values, norm, accuracy), accuracy)
    if lines is not None:
        ax.clabel(lines, fontsize=style.SMALL_FONT_SIZE - 1.5, fmt=lambda value: f"{10.0**value:.3g}")


def _draw_sensors(ax: Axes, scenario: BoundScenario, plane: str, per_m: float) -> None:
    places = per_m * (scenario.array.positions - scenario.array.centroid)
    i, j = ("xyz".index(name) for name in plane)
    ax.plot(places[:, i], places[:, j], "o", color=ON_DARK, mec=style.BLACK, ms=2.5, mew=0.5, label="sensors")


def _draw_sphere(
    ax: Axes,
    sphere: xr.Dataset,
    values: FloatArray,
    norm: LogNorm,
    levels: Sequence[float],
    accuracy: float | None,
    title: str,
) -> None:
    azimuth, elevation = (np.radians(sphere[name].to_numpy()) for name in ("azimuth", "elevation"))
    colours = fill_infinite(ax, values, norm)
    ax.pcolormesh(azimuth, elevation, colours, norm=norm, cmap=COLOURS, shading="gouraud", rasterized=True)
    draw_contours(ax, azimuth, elevation, values, norm, levels, accuracy)
    ax.set_title(title, fontsize=style.FONT_SIZE, pad=8)
    ax.grid(visible=False)
    ax.set_xticks(np.radians([-90.0, 90.0]), ["−90°", "90°"], color=ON_DARK)
    ax.set_yticks(np.radians([-60.0, -30.0, 0.0, 30.0, 60.0]), ["−60°", "−30°", "0°", "30°", "60°"])
    ax.tick_params(labelsize=style.SMALL_FONT_SIZE - 1.0)
    for spine in ax.spines.values():
        spine.set_linewidth(0.6)


def _mark_moment(ax: Axes, scenario: BoundScenario) -> None:
    """Mark the directions along and against the given moment."""
    m = np.asarray(scenario.moment_Am2) / np.linalg.norm(scenario.moment_Am2)
    for sign, marker, label in ((1.0, "^", "moment points here"), (-1.0, "v", "and away from here")):
        x, y, z = sign * m
        ax.plot(
            np.arctan2(y, x), np.arcsin(np.clip(z, -1.0, 1.0)), marker, color=style.ORANGE, mec=style.BLACK, ms=6,
            mew=0.7, ls="none", label=label, clip_on=False,
        )  # fmt: skip


def _reach_in_plane(reach: xr.DataArray, plane: str) -> tuple[FloatArray, FloatArray]:
    """Return angles from the plane's first axis to its second, and the reach there."""
    if plane == "xy":
        return np.radians(reach["azimuth"].to_numpy()), reach.sel(elevation=0.0).to_numpy()
    front, back = (0.0, 180.0) if plane == "xz" else (90.0, -90.0)
    elevation = np.radians(reach["elevation"].to_numpy())
    ahead, behind = reach.sel(azimuth=front).to_numpy(), reach.sel(azimuth=back).to_numpy()[::-1]
    return np.concatenate([elevation, elevation + np.pi]), np.concatenate([ahead, behind])


def _circle_spacing(greatest: float) -> tuple[float, int]:
    """Return the round distance between circles, and the number of circles around a curve."""
    if not greatest > 0.0:
        return 1.0, 1
    power = 10.0 ** np.floor(np.log10(greatest / 2.0))
    step = float(power * next(s for s in (1.0, 2.0, 2.5, 5.0, 10.0) if 3.0 * s * power > 1.02 * greatest))
    return step, int(np.ceil(1.02 * greatest / step))


def _hide_inner_labels(axes: Any) -> None:
    for ax in axes[:-1].ravel():
        ax.set_xlabel("")
        ax.set_xticklabels([])
