"""Figure of the complementary filters: errors of roll, pitch and yaw over time."""

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
    """Data of the figure.

    ``errors_deg`` (n, 3): errors of roll, pitch and yaw, by the name of the filter: explicit, gauss-newton, adaptive.
    """

    title: str
    orbits: FloatArray  # (n,): times
    errors_deg: dict[str, FloatArray]
    step_orbits: float  # time of the step of the bias
    outage_orbits: float | None = None  # time of the failure of the Sun sensor


def complementary_figure(picture: ComplementaryPicture) -> Figure:
    """Draw the errors of the three axes, and the angle of every filter's error on a log scale."""
    figure = style.new_figure(5.8)
    axes = figure.subplots(4, 1, sharex=True)
    lengths = {name: np.linalg.norm(errors, axis=1) for name, errors in picture.errors_deg.items()}
    for axis, ax, label in zip(range(3), axes, ("roll", "pitch", "yaw"), strict=False):
        _draw_filters(ax, picture, {name: errors[:, axis] for name, errors in picture.errors_deg.items()})
        ax.set_ylim(*_limits(picture, axis))
        style.label_axes(ax, "", f"{label} error [°]")
    _draw_filters(axes[3], picture, lengths)
    axes[3].set_yscale("log")
    style.label_axes(axes[3], "orbits", "angle of error [°]")
    axes[3].set_xlim(picture.orbits[0], picture.orbits[-1])
    _label_events(axes[0], picture)
    style.add_legend(
        figure, handles=axes[0].get_lines()[: len(picture.errors_deg)], loc="outside lower center", ncols=3
    )
    style.add_title(figure, textwrap.fill(picture.title, 100))
    return figure


def _draw_filters(ax: Axes, picture: ComplementaryPicture, values: dict[str, FloatArray]) -> None:
    """Draw a curve of every filter, the step of the bias, and the outage of the Sun sensor."""
    every = slice(None, None, max(1, len(picture.orbits) // _MOST_POINTS))
    for name, errors in values.items():
        colour, line, label = _STYLES[name]
        ax.plot(picture.orbits[every], errors[every], color=colour, ls=line, lw=0.9, label=label)
    if picture.step_orbits < picture.orbits[-1]:
        ax.axvline(picture.step_orbits, color=style.GREY, lw=0.8)
    if picture.outage_orbits is not None:
        ax.axvspan(picture.outage_orbits, picture.orbits[-1], color=style.LIGHT_GREY, alpha=0.5, lw=0)


def _limits(picture: ComplementaryPicture, axis: int) -> tuple[float, float]:
    """Return limits for the errors after the first tenth of an orbit."""
    late = picture.orbits >= 0.1
    return style.axis_limits([errors[late, axis] for errors in picture.errors_deg.values()], share=1.0)


def _label_events(ax: Axes, picture: ComplementaryPicture) -> None:
    options: dict[str, Any] = {
        "transform": ax.get_xaxis_transform(),
        "fontsize": style.SMALL_FONT_SIZE,
        "ha": "center",
        "va": "bottom",
    }
    if picture.step_orbits < picture.orbits[-1]:
        ax.text(picture.step_orbits, 1.02, "bias steps by 0.02 °/s", **options)
    if picture.outage_orbits is not None:
        middle = 0.5 * (picture.outage_orbits + picture.orbits[-1])
        ax.text(middle, 1.02, "without Sun sensor", **options)
