"""Figures of results. Units on every axis, colours that survive colour blindness and grey printing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from magloc.convergence import Status, summary
from magloc.cubes import MapSummary
from magloc.source_map import SourceMapSummary, SourceStatus
from magloc.source_map import summary as source_summary

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes

    from magloc.track import TrackPoint

_TRACK_COLOURS = ("#0072b2", "#d55e00", "#009e73")
_SLICES = (("x", "y", "z"), ("x", "z", "y"), ("y", "z", "x"))
_NOT_CONVERGED = {
    Status.OTHER_OPTIMUM: ("#c8c8c8", "stopped elsewhere"),
    Status.NOT_STOPPED: ("#8f8f8f", "did not stop"),
    Status.DIVERGED: ("#4a4a4a", "diverged"),
}
_STARTS_COLOURS = ListedColormap(["#ffffff", *(colour for colour, _ in _NOT_CONVERGED.values())])
_SOURCE_ENDS = {
    SourceStatus.FOUND: ("#0072b2", "found"),
    SourceStatus.MISSED: ("#d55e00", "missed"),
    SourceStatus.UNSOLVED: ("#000000", "no solution"),
    SourceStatus.LEFT_OUT: ("#ffffff", "left out"),
}
_SOURCES_COLOURS = ListedColormap([colour for colour, _ in _SOURCE_ENDS.values()])


def convergence_figure(dataset: xr.Dataset, counts: MapSummary | None = None) -> Figure:
    """Iterations to convergence on three slices through the source, as in the source paper.

    Parameters
    ----------
    dataset : xarray.Dataset
        A map made by :func:`magloc.convergence.convergence_map`, or one opened by :func:`magloc.sweep.open_map`, of
        which only the slices are loaded.
    counts : MapSummary, optional
        Its summary, where that is known; without it the whole map is loaded to count.

    Returns
    -------
    matplotlib.figure.Figure
        Starts that did not converge are grey; the dashed line is the plane through the array, orthogonal to the
        direction of the source.
    """
    counts = summary(dataset) if counts is None else counts
    source = np.atleast_1d(dataset.attrs["position_m"])
    centroid = np.atleast_1d(dataset.attrs["centroid_m"])
    moment = np.atleast_1d(dataset.attrs["moment_Am2"])
    # Places by hand: a layout engine draws everything twice.
    figure = Figure(figsize=(13.0, 5.0))
    axes = figure.subplots(1, 3, gridspec_kw={"left": 0.05, "right": 0.9, "bottom": 0.18, "top": 0.86, "wspace": 0.24})
    parts = _slices(dataset[["status", "iterations"]], source)
    shown = [part["iterations"].where(part["status"] == Status.CONVERGED) for part in parts]
    converged = np.concatenate([values.to_numpy()[np.isfinite(values)] for values in shown])
    top = float(np.percentile(converged, 99)) if converged.size else 1.0
    for ax, part, values, (across, up, through) in zip(axes, parts, shown, _SLICES, strict=True):
        _slice(ax, part["status"], _STARTS_COLOURS, values, across, up, "start", (0.0, top))
        _scene(ax, dataset, source, centroid, moment, "xyz".index(across), "xyz".index(up))
        ax.set_title(f"starts with {through} = {float(part[through]):g} m", fontsize=10)
    bar = figure.add_axes((0.925, 0.18, 0.012, 0.68))
    figure.colorbar(axes[-1].images[-1], cax=bar, label="passes over the readings until convergence")
    handles = _handles(axes[0], parts, _NOT_CONVERGED)
    handles += [h for h in axes[0].get_legend_handles_labels()[0] if h not in handles]
    figure.legend(handles=handles, loc="lower center", ncols=6, frameon=False, fontsize=9)
    figure.suptitle(
        f"Convergence of '{dataset.attrs['method']}', moment ({', '.join(f'{m:g}' for m in moment)}) A·m²: "
        f"front half {_percent(counts.front_fraction)}, back half {_percent(counts.back_fraction)}"
        + (f", median {counts.median_iterations:.0f} passes" if counts.converged else "")
    )
    return figure


def source_figure(dataset: xr.Dataset, counts: SourceMapSummary | None = None) -> Figure:
    """How fixes ended, over the Cramér-Rao bound of the range, on three slices through the array.

    Parameters
    ----------
    dataset : xarray.Dataset
        A map made by :func:`magloc.source_map.source_map`, or one opened by :func:`magloc.sweep.open_map`, of which
        only the slices are loaded.
    counts : SourceMapSummary, optional
        Its summary, where that is known; without it the whole map is loaded to count.

    Returns
    -------
    matplotlib.figure.Figure
    """
    counts = source_summary(dataset) if counts is None else counts
    figure = Figure(figsize=(13.0, 8.6), layout="constrained")
    axes = figure.subplots(2, 3)
    parts = _slices(dataset[["status", "sigma_range"]], np.zeros(3))
    bounds = [part["sigma_range"].copy(data=np.log10(part["sigma_range"].to_numpy())) for part in parts]
    finite = np.concatenate([bound.to_numpy()[np.isfinite(bound)] for bound in bounds])
    low, high = np.percentile(finite, [1, 99]) if finite.size else (0.0, 1.0)
    white = ListedColormap(["#ffffff"])
    for column, part, bound, (across, up, through) in zip(axes.T, parts, bounds, _SLICES, strict=True):
        _slice(column[0], part["status"], _SOURCES_COLOURS, bound.where(False), across, up, "source")
        _slice(column[1], part["status"], white, bound, across, up, "source", (low, high))
        column[0].set_title(f"sources with {through} = {float(part[through]):g} m", fontsize=10)
        for ax in column:
            ax.plot(0.0, 0.0, "^", color="white", mec="black", ms=9)
    figure.colorbar(axes[1, 2].images[-1], ax=axes[1], label="log10 of the range's Cramér-Rao bound / m", shrink=0.9)
    handles = _handles(axes[0, 0], parts, _SOURCE_ENDS)
    figure.legend(handles=handles, loc="outside lower center", ncols=6, frameon=False, fontsize=9)
    figure.suptitle(
        f"One start-free fix each of {counts.starts} sources of {dataset.attrs['moment_magnitude_Am2']:g} A·m²: "
        f"{counts.fraction:.2%} found, truth listed {counts.truth_listed:.2%}"
    )
    return figure


def track_figure(points: Sequence[TrackPoint], truth_m: np.ndarray | None = None) -> Figure:
    """A track from above with 95 % ellipses, its coordinates and its strength through time, and the innovations.

    Parameters
    ----------
    points : sequence of TrackPoint
    truth_m : ndarray, shape (n, 3), optional
        True positions, NaN where they are not known.

    Returns
    -------
    matplotlib.figure.Figure
    """
    from magloc.consistency import mean_bounds

    figure = Figure(figsize=(13.0, 7.4), layout="constrained")
    grid = figure.add_gridspec(3, 2, width_ratios=[1.25, 1.0])
    plan, coordinates = figure.add_subplot(grid[:, 0]), figure.add_subplot(grid[0, 1])
    strength = figure.add_subplot(grid[1, 1], sharex=coordinates)
    innovations = figure.add_subplot(grid[2, 1], sharex=coordinates)
    time = np.array([point.time_s for point in points])
    position = np.array([np.full(3, np.nan) if p.position_m is None else p.position_m for p in points])
    moment = np.array([np.full(3, np.nan) if p.moment_Am2 is None else p.moment_Am2 for p in points])
    covariance = np.array([np.full((6, 6), np.nan) if p.covariance is None else p.covariance for p in points])
    sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    if truth_m is not None:
        plan.plot(truth_m[:, 0], truth_m[:, 1], color="black", lw=1.0, label="truth")
    plan.plot(position[:, 0], position[:, 1], color=_TRACK_COLOURS[0], lw=1.4, label="track")
    tracked = np.flatnonzero(np.isfinite(position[:, 0]))
    for i in tracked[:: max(1, len(tracked) // 40)]:
        plan.add_patch(_ellipse(position[i, :2], covariance[i, :2, :2]))
    plan.plot(0.0, 0.0, "^", color="white", mec="black", ms=9, label="origin of the frame")
    plan.set_aspect("equal", adjustable="datalim")
    plan.set_xlabel("x [m]")
    plan.set_ylabel("y [m]")
    plan.set_title("from above, 95 % ellipses", fontsize=10)
    plan.legend(frameon=False, fontsize=9)
    for i, (name, colour) in enumerate(zip("xyz", _TRACK_COLOURS, strict=True)):
        coordinates.plot(time, position[:, i], color=colour, lw=1.2, label=name)
        low, high = position[:, i] - 1.96 * sigma[:, i], position[:, i] + 1.96 * sigma[:, i]
        coordinates.fill_between(time, low, high, color=colour, alpha=0.25, lw=0.0)
        if truth_m is not None:
            coordinates.plot(time, truth_m[:, i], color="black", lw=0.7)
    coordinates.set_ylabel("position [m]")
    coordinates.legend(frameon=False, fontsize=9, ncols=3)
    strength.plot(time, np.linalg.norm(moment, axis=1), color=_TRACK_COLOURS[0], lw=1.2)
    strength.set_ylabel("moment [A·m²]")
    strength.set_ylim(bottom=0.0)
    dof = np.array([max(point.nis_dof, 1) for point in points])
    nis = np.array([point.nis for point in points]) / dof
    innovations.plot(time, nis, ".", color=_TRACK_COLOURS[0], ms=4)
    if np.isfinite(nis).any():
        low, high = mean_bounds(int(np.median(dof)), 0.99)
        innovations.axhspan(low, high, color="grey", alpha=0.2, label="99 % of a right filter's")
        innovations.legend(frameon=False, fontsize=9)
        innovations.set_ylim(0.0, max(1.5 * high, float(np.nanpercentile(nis, 99.0)) * 1.1))
    innovations.set_ylabel("NIS / degrees of freedom")
    innovations.set_xlabel("time [s]")
    return figure


def _ellipse(centre: np.ndarray, covariance: np.ndarray) -> Ellipse:
    """95 % ellipse of two coordinates."""
    values, vectors = np.linalg.eigh(covariance)
    width, height = 2.0 * np.sqrt(np.clip(values, 0.0, None) * 5.991464547107979)
    angle = float(np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0])))
    return Ellipse(
        (float(centre[0]), float(centre[1])), float(width), float(height), angle=angle, fill=False,
        edgecolor=_TRACK_COLOURS[1], lw=0.7,
    )  # fmt: skip


def _slices(dataset: xr.Dataset, through: np.ndarray) -> list[xr.Dataset]:
    """The three planes through a point, loaded."""
    planes = ({name: float(through["xyz".index(name)])} for _, _, name in _SLICES)
    return [dataset.sel(plane, method="nearest").load() for plane in planes]


def _handles(ax: Axes, parts: Sequence[xr.Dataset], colours: Mapping[Any, tuple[str, str]]) -> list[Any]:
    """Legend of the colours that occur."""
    present = [status for status in colours if any(bool((part["status"] == status).any()) for part in parts)]
    return [
        ax.scatter([], [], marker="s", color=colours[status][0], edgecolor="grey", label=colours[status][1])
        for status in present
    ]


def _percent(fraction: float) -> str:
    return f"{100.0 * fraction:.1f} %"


def _slice(
    ax: Axes,
    status: xr.DataArray,
    colours: ListedColormap,
    shown: xr.DataArray,
    across: str,
    up: str,
    point: str,
    limits: tuple[float, float] = (0.0, 1.0),
) -> None:
    """Colours of the status, and over them the values that are finite."""
    axis = status[across].to_numpy()
    half_cell = 0.5 * float(axis[1] - axis[0])
    low, high = float(axis[0]) - half_cell, float(axis[-1]) + half_cell
    options: dict[str, Any] = {"origin": "lower", "extent": (low, high, low, high), "interpolation": "nearest"}
    ax.imshow(status.transpose(up, across), cmap=colours, vmin=-0.5, vmax=colours.N - 0.5, **options)
    ax.imshow(shown.transpose(up, across), cmap="viridis", vmin=limits[0], vmax=limits[1], **options)
    ax.set_xlabel(f"{point} {across} [m]")
    ax.set_ylabel(f"{point} {up} [m]")


def _scene(
    ax: Axes, dataset: xr.Dataset, source: np.ndarray, centroid: np.ndarray, moment: np.ndarray, across: int, up: int
) -> None:
    """Array, source with its moment, and the line where the plane between the halves cuts the slice."""
    limits = ax.get_xlim()
    width = limits[1] - limits[0]
    ax.plot(centroid[across], centroid[up], "^", color="white", mec="black", ms=9, label="array")
    ax.plot(source[across], source[up], "*", color="#d55e00", mec="black", ms=13, label="source")
    arrow = 0.1 * width * moment / np.linalg.norm(moment)
    if np.hypot(arrow[across], arrow[up]) > 0.01 * width:
        ax.annotate(
            "",
            xy=(source[across] + arrow[across], source[up] + arrow[up]),
            xytext=(source[across], source[up]),
            arrowprops={"arrowstyle": "-|>", "color": "#d55e00", "lw": 2.0},
        )
    through = 3 - across - up
    normal = source - centroid
    depth = dataset["xyz"[through]].sel({"xyz"[through]: source[through]}, method="nearest")
    offset = normal @ centroid - normal[through] * float(depth)
    if np.hypot(normal[across], normal[up]) > 0.2 * np.linalg.norm(normal):
        foot = offset * np.array([normal[across], normal[up]]) / (normal[across] ** 2 + normal[up] ** 2)
        ax.axline(
            tuple(foot), (foot[0] - normal[up], foot[1] + normal[across]), color="black", ls="--", lw=1.2,
            label="plane between the halves",
        )  # fmt: skip
    ax.set_xlim(limits)
    ax.set_ylim(limits)
