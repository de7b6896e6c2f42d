"""Figure of a compensation: the readings in the band of the manoeuvres, before and after."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from magloc.compensation.figure_of_merit import AXES
from magloc.plots import style

if TYPE_CHECKING:
    from magloc.compensation.results import Compensation

_SHADES = dict(zip(AXES, (style.SKY_BLUE, style.ORANGE, style.GREEN), strict=True))


def compensation(found: Compensation) -> Figure:
    """Draw the readings of the calibration in the band of the manoeuvres, without and with the correction.

    Parameters
    ----------
    found : Compensation
        A result of :func:`magloc.compensate`.

    Returns
    -------
    matplotlib.figure.Figure
        Two panels: before and after.

    Examples
    --------
    >>> import magloc
    >>> drone = magloc.datasets.load("drone")
    >>> figure = magloc.plots.compensation(magloc.compensate(drone.array, drone.readings))
    """
    shown = found.worst
    done, rows = shown.manoeuvres, shown.fit.rows
    figure = style.new_figure(3.6)
    panels = figure.subplots(2, 1, sharex=True)
    time_s = rows.time_s - rows.time_s[0]
    corrected = rows.modulus_T - shown.fit.effect_T
    for ax, read, merit, name in (
        (panels[0], rows.modulus_T, shown.before_T, "before"),
        (panels[1], corrected, shown.after_T, "after"),
    ):
        for axis, (label, colour) in enumerate(_SHADES.items()):
            inside = (done.cell >= 0) & (done.cell % len(AXES) == axis)
            if inside.any():
                ax.fill_between(
                    time_s, 0.0, 1.0, where=inside.tolist(), transform=ax.get_xaxis_transform(), color=colour,
                    alpha=0.3, lw=0.0, label=label,
                )  # fmt: skip
        ax.plot(time_s, 1e9 * done.fast(read), color=style.ESTIMATE, lw=0.8)
        title = f"{shown.sensor} {name}: figure of merit {1e9 * merit:.3g} nT"
        style.label_axes(ax, "time [s]" if ax is panels[1] else "", "field [nT]", title)
    style.add_legend(panels[0], ncols=len(AXES))
    panels[1].set_xlim(time_s[0], np.maximum(time_s[-1], 1.0))
    return figure
