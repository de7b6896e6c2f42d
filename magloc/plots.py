"""Figures of results. Units on every axis, colours that survive colour blindness and grey printing."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure

from magloc.convergence import Status, summary

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes

_SLICES = (("x", "y", "z"), ("x", "z", "y"), ("y", "z", "x"))
_NOT_CONVERGED = {
    Status.OTHER_OPTIMUM: ("#c8c8c8", "stopped elsewhere"),
    Status.NOT_STOPPED: ("#8f8f8f", "did not stop"),
    Status.DIVERGED: ("#4a4a4a", "diverged"),
}


def convergence_figure(dataset: xr.Dataset) -> Figure:
    """Iterations to convergence on three slices through the source, as in the source paper.

    Parameters
    ----------
    dataset : xarray.Dataset
        A map made by :func:`magloc.convergence.convergence_map`.

    Returns
    -------
    matplotlib.figure.Figure
        Starts that did not converge are grey; the dashed line is the plane through the array, orthogonal to the
        direction of the source.
    """
    counts = summary(dataset)
    source = np.atleast_1d(dataset.attrs["position_m"])
    centroid = np.atleast_1d(dataset.attrs["centroid_m"])
    moment = np.atleast_1d(dataset.attrs["moment_Am2"])
    figure = Figure(figsize=(13.0, 5.0), layout="constrained")
    axes = figure.subplots(1, 3)
    converged = dataset["status"] == Status.CONVERGED
    shown = dataset["iterations"].where(converged)
    top = float(np.nanpercentile(shown, 99)) if converged.any() else 1.0
    for ax, (across, up, through) in zip(axes, _SLICES, strict=True):
        plane = {through: float(source["xyz".index(through)])}
        part = dataset.sel(plane, method="nearest")
        _slice(ax, part, shown.sel(plane, method="nearest"), across, up, top)
        _scene(ax, dataset, source, centroid, moment, "xyz".index(across), "xyz".index(up))
        ax.set_title(f"starts with {through} = {float(part[through]):g} m", fontsize=10)
    figure.colorbar(axes[-1].images[-1], ax=axes, label="passes over the readings until convergence", shrink=0.9)
    present = [s for s in _NOT_CONVERGED if bool((dataset["status"] == s).any())]
    handles = [
        figure.axes[0].scatter([], [], marker="s", color=_NOT_CONVERGED[s][0], label=_NOT_CONVERGED[s][1])
        for s in present
    ]
    handles += [h for h in axes[0].get_legend_handles_labels()[0] if h not in handles]
    figure.legend(handles=handles, loc="outside lower center", ncols=6, frameon=False, fontsize=9)
    figure.suptitle(
        f"Convergence of '{dataset.attrs['method']}', moment ({', '.join(f'{m:g}' for m in moment)}) A·m²: "
        f"front half {_percent(counts.front_fraction)}, back half {_percent(counts.back_fraction)}"
        + (f", median {counts.median_iterations:.0f} passes" if counts.converged else "")
    )
    return figure


def _percent(fraction: float) -> str:
    return f"{100.0 * fraction:.1f} %"


def _slice(ax: Axes, part: xr.Dataset, shown: xr.DataArray, across: str, up: str, top: float) -> None:
    axis = part[across].to_numpy()
    half_cell = 0.5 * float(axis[1] - axis[0])
    low, high = float(axis[0]) - half_cell, float(axis[-1]) + half_cell
    options: dict[str, Any] = {"origin": "lower", "extent": (low, high, low, high), "interpolation": "nearest"}
    colours = ListedColormap(["#ffffff", *(colour for colour, _ in _NOT_CONVERGED.values())])
    ax.imshow(part["status"].transpose(up, across), cmap=colours, vmin=-0.5, vmax=3.5, **options)
    ax.imshow(shown.transpose(up, across), cmap="viridis", vmin=0.0, vmax=top, **options)
    ax.set_xlabel(f"start {across} [m]")
    ax.set_ylabel(f"start {up} [m]")


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
