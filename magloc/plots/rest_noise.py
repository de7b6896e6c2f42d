"""Figure of the Allan deviation of sensors at rest."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from magloc.logs.rest_noise import RestNoise
from magloc.plots import style

_SHOWN = {"T": (1e9, "nT"), "rad/s": (180.0 / np.pi, "°/s")}
_PANEL_IN = 2.2


def allan_figure(noises: Sequence[RestNoise], name: str) -> Figure:
    """Draw the Allan deviation of each axis over the averaging time, with the sum of the parts that are found."""
    figure = style.new_figure(_PANEL_IN * len(noises) + 0.4)
    panels = np.atleast_1d(np.asarray(figure.subplots(len(noises), 1, sharex=True)))
    for ax, noise in zip(panels, noises, strict=True):
        size, unit = _SHOWN.get(noise.unit, (1.0, noise.unit))
        for values, (word, colour, marker, line) in zip(noise.deviation.T, style.COMPONENTS, strict=False):
            ax.loglog(noise.tau_s, size * values, color=colour, marker=marker, ls=line, lw=0.9, ms=3.0, label=word)
        ax.loglog(noise.tau_s, size * noise.model(), color=style.BLACK, lw=2.5, alpha=0.3, label="white, flicker, walk")
        style.label_axes(ax, "", f"Allan deviation [{unit}]", noise.name)
        style.add_legend(ax, ncols=4)
    panels[-1].set_xlabel("averaging time [s]", fontsize=style.FONT_SIZE)
    style.add_title(figure, f"{name}: noise at rest")
    return figure
