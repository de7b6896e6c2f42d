"""Figures of slices through convergence maps and source maps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from magloc.convergence.over_sources import SourceStatus
from magloc.convergence.over_sources import summary as source_summary
from magloc.convergence.over_starts import StartStatus, summary
from magloc.plots import style

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes


_SLICES = (("x", "y", "z"), ("x", "z", "y"), ("y", "z", "x"))
_WHITE = "#ffffff"
# Colour, hatching and name; the hatching distinguishes them from the values in a grey print.
_NOT_CONVERGED = {
    StartStatus.OTHER_OPTIMUM: (_WHITE, "", "stopped elsewhere"),
    StartStatus.NOT_STOPPED: (_WHITE, "////", "did not stop"),
    StartStatus.DIVERGED: (_WHITE, "xxxx", "diverged"),
}
_STARTS_COLOURS = ListedColormap([_WHITE, *(colour for colour, _, _ in _NOT_CONVERGED.values())])
_SOURCE_ENDS = {
    SourceStatus.FOUND: (style.BLUE, "", "found"),
    SourceStatus.MISSED: (style.ORANGE, "", "missed"),
    SourceStatus.UNSOLVED: (style.BLACK, "", "no solution"),
    SourceStatus.LEFT_OUT: (_WHITE, "", "excluded"),
}
_SOURCES_COLOURS = ListedColormap([colour for colour, _, _ in _SOURCE_ENDS.values()])


def convergence(dataset: xr.Dataset) -> Figure:
    """Draw the iterations to convergence on three slices through the source.

    Starts that did not converge are white and hatched. The dashed line is the plane through the array that is
    orthogonal to the direction of the source.

    Parameters
    ----------
    dataset : xarray.Dataset
        A map of :func:`magloc.convergence.over_starts.convergence_map`, or one opened by
        :func:`magloc.grids.store.open_map`. Only its slices are loaded.

    Returns
    -------
    matplotlib.figure.Figure
        Figure; :func:`save` writes it to a file.

    Examples
    --------
    >>> import arrays
    >>> import magloc
    >>> source = magloc.Source([5.0, 0.0, 0.3], [100.0, 0.0, 0.0])
    >>> ends = magloc.convergence_map(arrays.tetrahedron(0.45), source, edge_m=20.0, n=5)
    >>> figure = magloc.plots.convergence(ends)
    """
    counts = summary(dataset)
    source = np.atleast_1d(dataset.attrs["position_m"])
    centroid = np.atleast_1d(dataset.attrs["centroid_m"])
    moment = np.atleast_1d(dataset.attrs["moment_Am2"])
    # The panels have fixed places, because a layout engine draws everything twice.
    figure = style.new_figure(3.0, layout=None)
    places = {"left": 0.07, "right": 0.895, "bottom": 0.25, "top": 0.8, "wspace": 0.34}
    axes = figure.subplots(1, 3, gridspec_kw=places)
    parts = _load_slices(dataset[["status", "iterations"]], source)
    shown = [part["iterations"].where(part["status"] == StartStatus.CONVERGED) for part in parts]
    converged = np.concatenate([values.to_numpy()[np.isfinite(values)] for values in shown])
    top = float(np.percentile(converged, 99)) if converged.size else 1.0
    for ax, part, values, (across, up, through) in zip(axes, parts, shown, _SLICES, strict=True):
        _draw_slice(ax, part["status"], _STARTS_COLOURS, values, across, up, "start", (0.0, top))
        _hatch_failures(ax, part["status"], across, up)
        _draw_markers(ax, dataset, source, centroid, moment, "xyz".index(across), "xyz".index(up))
        ax.set_title(f"starts with {through} = {float(part[through]):g} m", fontsize=style.FONT_SIZE)
    bar = figure.colorbar(axes[-1].images[-1], cax=figure.add_axes((0.915, 0.25, 0.014, 0.55)), extend="max")
    bar.set_label("passes until convergence [1]", fontsize=style.FONT_SIZE)
    bar.ax.tick_params(labelsize=style.SMALL_FONT_SIZE)
    handles = _legend_handles(parts, _NOT_CONVERGED) + axes[0].get_legend_handles_labels()[0]
    style.add_legend(figure, handles=handles, loc="lower center", ncols=6)
    halves = {"front": counts.front_fraction, "back": counts.back_fraction}
    style.add_title(
        figure,
        f"Convergence of '{dataset.attrs['method']}', moment ({', '.join(f'{m:g}' for m in moment)}) A·m²: "
        + ", ".join(f"{half} half {100.0 * part:.1f} %" for half, part in halves.items() if not np.isnan(part))
        + (f", median {counts.median_iterations:.0f} passes" if counts.converged else ""),
    )
    return figure


def sources(dataset: xr.Dataset) -> Figure:
    """Draw outcomes of fixes and the Cramér-Rao bound of the range on three slices.

    Parameters
    ----------
    dataset : xarray.Dataset
        A map of :func:`magloc.convergence.over_sources.source_map`, or one opened by
        :func:`magloc.grids.store.open_map`. Only its slices are loaded.

    Returns
    -------
    matplotlib.figure.Figure
        Figure; :func:`save` writes it to a file.

    Examples
    --------
    >>> import arrays
    >>> import magloc
    >>> found = magloc.source_map(arrays.tetrahedron(1.5), n=3)
    >>> figure = magloc.plots.sources(found)
    """
    counts = source_summary(dataset)
    figure = style.new_figure(4.9, layout="compressed")
    axes = figure.subplots(2, 3)
    parts = _load_slices(dataset[["status", "sigma_range"]], np.zeros(3))
    bounds = [part["sigma_range"].copy(data=np.log10(part["sigma_range"].to_numpy())) for part in parts]
    finite = np.concatenate([bound.to_numpy()[np.isfinite(bound)] for bound in bounds])
    low, high = np.percentile(finite, [1, 99]) if finite.size else (0.0, 1.0)
    white = ListedColormap([_WHITE])
    for column, part, bound, (across, up, through) in zip(axes.T, parts, bounds, _SLICES, strict=True):
        _draw_slice(column[0], part["status"], _SOURCES_COLOURS, bound.where(False), across, up, "source")
        _draw_slice(column[1], part["status"], white, bound, across, up, "source", (low, high))
        column[0].set_title(f"sources with {through} = {float(part[through]):g} m", fontsize=style.FONT_SIZE)
        for ax in column:
            ax.plot(0.0, 0.0, "^", color=_WHITE, mec=style.BLACK, ms=6, label="array")
    bar = figure.colorbar(axes[1, 2].images[-1], ax=axes[1], shrink=0.9, extend="both")
    bar.set_label("log10 of the range's\nCramér-Rao bound / m [1]", fontsize=style.FONT_SIZE)
    bar.ax.tick_params(labelsize=style.SMALL_FONT_SIZE)
    handles = _legend_handles(parts, _SOURCE_ENDS) + axes[0, 0].get_legend_handles_labels()[0]
    style.add_legend(figure, handles=handles, loc="outside lower center", ncols=6)
    style.add_title(
        figure,
        f"One start-free fix each of {counts.starts} sources of {dataset.attrs['moment_magnitude_Am2']:g} A·m²: "
        f"{counts.fraction:.2%} found, truth listed {counts.truth_listed:.2%}",
    )
    return figure


def _load_slices(dataset: xr.Dataset, through: np.ndarray) -> list[xr.Dataset]:
    """Load the three planes through a point."""
    planes = ({name: float(through["xyz".index(name)])} for _, _, name in _SLICES)
    return [dataset.sel(plane, method="nearest").load() for plane in planes]


def _legend_handles(parts: Sequence[xr.Dataset], colours: Mapping[Any, tuple[str, str, str]]) -> list[Any]:
    """Return the handles of the legend for the colours that occur."""
    present = [status for status in colours if any(bool((part["status"] == status).any()) for part in parts)]
    entries = (colours[status] for status in present)
    return [
        Patch(facecolor=colour, hatch=hatch, edgecolor=style.PALE_GREY, linewidth=0.5, label=name)
        for colour, hatch, name in entries
    ]


def _draw_slice(
    ax: Axes,
    status: xr.DataArray,
    colours: ListedColormap,
    shown: xr.DataArray,
    across: str,
    up: str,
    point: str,
    limits: tuple[float, float] = (0.0, 1.0),
) -> None:
    """Draw the colours of the status, and the finite values above them."""
    axis = status[across].to_numpy()
    half_cell = 0.5 * float(axis[1] - axis[0])
    low, high = float(axis[0]) - half_cell, float(axis[-1]) + half_cell
    options: dict[str, Any] = {"origin": "lower", "extent": (low, high, low, high), "interpolation": "nearest"}
    ax.imshow(status.transpose(up, across), cmap=colours, vmin=-0.5, vmax=colours.N - 0.5, **options)
    ax.imshow(shown.transpose(up, across), cmap="viridis", vmin=limits[0], vmax=limits[1], **options)
    style.label_axes(ax, f"{point} {across} [m]", f"{point} {up} [m]")
    ax.grid(visible=False)


def _hatch_failures(ax: Axes, status: xr.DataArray, across: str, up: str) -> None:
    """Hatch the cells that did not converge."""
    axis = status[across].to_numpy()
    half_cell = 0.5 * float(axis[1] - axis[0])
    edges = np.append(axis - half_cell, axis[-1] + half_cell)
    values = status.transpose(up, across).to_numpy()
    for kind, (_, hatch, _) in _NOT_CONVERGED.items():
        if not hatch or not (values == kind).any():
            continue
        # Contours between the corners of the cells end exactly at the cells.
        fine = np.repeat(np.repeat(values == kind, 2, axis=0), 2, axis=1).astype(np.float64)
        inner = 1e-3 * half_cell
        corners = np.column_stack([edges[:-1] + inner, edges[1:] - inner]).ravel()
        filled = ax.contourf(corners, corners, fine, levels=[0.5, 1.5], colors="none", hatches=[hatch])
        filled.set_edgecolor(style.PALE_GREY)
        filled.set_linewidth(0.0)


def _draw_markers(
    ax: Axes, dataset: xr.Dataset, source: np.ndarray, centroid: np.ndarray, moment: np.ndarray, across: int, up: int
) -> None:
    """Draw the array, the source with its moment, and the plane between the halves."""
    limits = ax.get_xlim()
    width = limits[1] - limits[0]
    ax.plot(centroid[across], centroid[up], "^", color=_WHITE, mec=style.BLACK, ms=6, ls="none", label="array")
    ax.plot(source[across], source[up], "*", color=style.ORANGE, mec=style.BLACK, ms=9, ls="none", label="source")
    arrow = 0.14 * width * moment / np.linalg.norm(moment)
    if np.hypot(arrow[across], arrow[up]) > 0.01 * width:
        ax.annotate(
            "",
            xy=(source[across] + arrow[across], source[up] + arrow[up]),
            xytext=(source[across], source[up]),
            arrowprops={"arrowstyle": "-|>", "facecolor": style.ORANGE, "edgecolor": style.BLACK, "lw": 1.0},
        )
    through = 3 - across - up
    normal = source - centroid
    depth = dataset["xyz"[through]].sel({"xyz"[through]: source[through]}, method="nearest")
    offset = normal @ centroid - normal[through] * float(depth)
    if np.hypot(normal[across], normal[up]) > 0.2 * np.linalg.norm(normal):
        foot = offset * np.array([normal[across], normal[up]]) / (normal[across] ** 2 + normal[up] ** 2)
        ax.axline(
            tuple(foot), (foot[0] - normal[up], foot[1] + normal[across]), color=style.BLACK, ls="--", lw=0.9,
            label="plane between the halves",
        )  # fmt: skip
    ax.set_xlim(limits)
    ax.set_ylim(limits)
