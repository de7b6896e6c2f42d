"""Figures of the complementary filters: errors of roll, pitch and yaw through orbits."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from arrays.typing import FloatArray
from magloc.plots import style

_STYLES = {
    "explicit": ("#d55e00", "--", "explicit"),
    "gauss-newton": ("#0072b2", "-", "with measured quaternion"),
    "adaptive": ("#009e73", "-", "adaptive error-state"),
}
_MOST_POINTS = 3000


@dataclass(frozen=True, eq=False)
class ComplementaryPicture:
    """What a figure shows.

    ``errors_deg`` (n, 3): errors of roll, pitch and yaw, by the name of the filter: explicit, gauss-newton, adaptive.
    """

    title: str
    orbits: FloatArray  # (n,): instants
    errors_deg: dict[str, FloatArray]
    step_orbits: float  # when the bias steps
    outage_orbits: float | None = None  # when the Sun sensor fails


def complementary_figure(picture: ComplementaryPicture) -> Figure:
    """Errors of the three axes, one below the other, and the length of the error of every filter on a log scale."""
    figure = Figure(figsize=(11.0, 9.0), layout="constrained")
    axes = figure.subplots(4, 1, sharex=True)
    for axis, ax, label in zip(range(3), axes, ("roll", "pitch", "yaw"), strict=False):
        for name, errors in picture.errors_deg.items():
            _draw(ax, picture.orbits, errors[:, axis], name)
        ax.axhline(0.0, color="grey", lw=0.5)
        ax.set(ylabel=f"{label} error [°]")
        ax.set_ylim(*_limits(picture, axis))
    for name, errors in picture.errors_deg.items():
        _draw(axes[3], picture.orbits, np.linalg.norm(errors, axis=1), name)
    axes[3].set(ylabel="angle of error [°]", xlabel="orbits", yscale="log")
    for ax in axes:
        ax.grid(alpha=0.3)
        ax.set_xlim(picture.orbits[0], picture.orbits[-1])
        if picture.step_orbits < picture.orbits[-1]:
            ax.axvline(picture.step_orbits, color="black", lw=1.0, ls=":")
        if picture.outage_orbits is not None:
            ax.axvspan(picture.outage_orbits, picture.orbits[-1], color="grey", alpha=0.12, lw=0)
    _mark(axes[0], picture)
    handles = axes[0].get_lines()[: len(picture.errors_deg)]
    figure.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False)
    figure.suptitle(textwrap.fill(picture.title, 110), fontsize=11)
    return figure


def _draw(ax: Axes, orbits: FloatArray, values: FloatArray, name: str) -> None:
    colour, line, label = _STYLES[name]
    keep = slice(None, None, max(1, len(orbits) // _MOST_POINTS))
    ax.plot(orbits[keep], values[keep], color=colour, ls=line, lw=1.0, label=label, alpha=0.85)


def _limits(picture: ComplementaryPicture, axis: int) -> tuple[float, float]:
    """Of all errors after the first tenth of an orbit, when the start is over."""
    late = picture.orbits >= 0.1
    return style.limits_of([errors[late, axis] for errors in picture.errors_deg.values()], share=1.0)


def _mark(ax: Axes, picture: ComplementaryPicture) -> None:
    top = ax.get_xaxis_transform()
    if picture.step_orbits < picture.orbits[-1]:
        ax.text(
            picture.step_orbits, 1.02, "bias steps by 0.02 °/s", transform=top, fontsize=9, ha="center", va="bottom"
        )
    if picture.outage_orbits is not None:
        middle = 0.5 * (picture.outage_orbits + picture.orbits[-1])
        ax.text(middle, 1.02, "without Sun sensor", transform=top, fontsize=9, ha="center", va="bottom")
