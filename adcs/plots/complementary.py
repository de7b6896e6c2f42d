"""Figures of the complementary filters: errors of roll, pitch and yaw through orbits."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from arrays.typing import FloatArray
from magloc.plots import style

_STYLES = {
    "explicit": (style.ORANGE, "--", "explicit"),
    "gauss-newton": (style.BLUE, "-", "with measured quaternion"),
    "adaptive": (style.BLACK, ":", "adaptive error-state"),
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
    figure = style.new_figure(5.8)
    axes = figure.subplots(4, 1, sharex=True)
    lengths = {name: np.linalg.norm(errors, axis=1) for name, errors in picture.errors_deg.items()}
    for axis, ax, label in zip(range(3), axes, ("roll", "pitch", "yaw"), strict=False):
        _draw(ax, picture, {name: errors[:, axis] for name, errors in picture.errors_deg.items()})
        ax.set_ylim(*_limits(picture, axis))
        style.dress(ax, "", f"{label} error [°]")
    _draw(axes[3], picture, lengths)
    axes[3].set_yscale("log")
    style.dress(axes[3], "orbits", "angle of error [°]")
    axes[3].set_xlim(picture.orbits[0], picture.orbits[-1])
    _mark(axes[0], picture)
    style.legend(figure, handles=axes[0].get_lines()[: len(picture.errors_deg)], loc="outside lower center", ncols=3)
    style.headline(figure, textwrap.fill(picture.title, 100))
    return figure


def _draw(ax: Axes, picture: ComplementaryPicture, values: dict[str, FloatArray]) -> None:
    """A curve of every filter, where the bias steps, and where the Sun sensor is out."""
    every = slice(None, None, max(1, len(picture.orbits) // _MOST_POINTS))
    for name, of_filter in values.items():
        colour, line, label = _STYLES[name]
        ax.plot(picture.orbits[every], of_filter[every], color=colour, ls=line, lw=0.9, label=label)
    if picture.step_orbits < picture.orbits[-1]:
        ax.axvline(picture.step_orbits, color=style.GREY, lw=0.8)
    if picture.outage_orbits is not None:
        ax.axvspan(picture.outage_orbits, picture.orbits[-1], color=style.LIGHT_GREY, alpha=0.5, lw=0)


def _limits(picture: ComplementaryPicture, axis: int) -> tuple[float, float]:
    """Of all errors after the first tenth of an orbit, when the start is over."""
    late = picture.orbits >= 0.1
    return style.limits_of([errors[late, axis] for errors in picture.errors_deg.values()], share=1.0)


def _mark(ax: Axes, picture: ComplementaryPicture) -> None:
    words: dict[str, Any] = {
        "transform": ax.get_xaxis_transform(),
        "fontsize": style.SMALL_LETTERS,
        "ha": "center",
        "va": "bottom",
    }
    if picture.step_orbits < picture.orbits[-1]:
        ax.text(picture.step_orbits, 1.02, "bias steps by 0.02 °/s", **words)
    if picture.outage_orbits is not None:
        middle = 0.5 * (picture.outage_orbits + picture.orbits[-1])
        ax.text(middle, 1.02, "without Sun sensor", **words)
