"""Figure of a magnetic signature: the parts of the moment, and the moment over the heading."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from magloc.plots import style

if TYPE_CHECKING:
    from magloc.signature.signature import Signature

_HEADINGS_DEG = np.linspace(0.0, 360.0, 145)


def signature_figure(found: Signature) -> Figure:
    """Draw the parts of the moment with 95 % intervals, and the moment over the heading.

    Parameters
    ----------
    found : Signature
        A result of :func:`magloc.fit_signature`.

    Returns
    -------
    matplotlib.figure.Figure
        Figure; :func:`save` writes it to a file.

    Examples
    --------
    >>> import magloc
    >>> ship = magloc.datasets.load("ship")
    >>> path = magloc.ObjectPath(ship.truth.time_s, ship.truth.position_m)
    >>> figure = magloc.plots.signature(magloc.fit_signature(ship.array, ship.readings, path))
    """
    figure = style.new_figure(2.9)
    parts, turns = figure.subplots(1, 2)
    values, place = found.determined, np.arange(len(found.names))
    known = np.isfinite(values)
    parts.errorbar(
        values[known], place[known], xerr=style.SIGMAS_95 * found.sigma_Am2[known], fmt="o", ms=4.0,
        color=style.ESTIMATE, ecolor=style.BOUND, elinewidth=1.6, label="with 95 % intervals",
    )  # fmt: skip
    parts.plot(np.zeros(np.sum(~known)), place[~known], "x", color=style.GREY, ms=5.0, label="not determined")
    parts.axvline(0.0, color=style.GREY, lw=0.6)
    style.label_axes(parts, "moment [A·m²]", "")
    parts.set_yticks(place, found.names)
    parts.xaxis.set_major_locator(MaxNLocator(4))
    parts.set_ylim(len(place) - 0.5, -0.5)
    style.add_legend(parts)
    moment, covariance = found.moment(_HEADINGS_DEG)
    sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    axes = zip(("east", "north", "up"), style.COMPONENTS, strict=True)
    for i, (name, (_, colour, _, line)) in enumerate(axes):
        turns.plot(_HEADINGS_DEG, moment[:, i], color=colour, ls=line, lw=1.2, label=name)
        ends = (moment[:, i] + sign * style.SIGMAS_95 * sigma[:, i] for sign in (-1.0, 1.0))
        turns.fill_between(_HEADINGS_DEG, *ends, color=colour, alpha=0.15, lw=0.0)
    style.label_axes(turns, "heading [°]", "moment [A·m²]", "on a level keel")
    turns.set_xticks(range(0, 361, 90))
    turns.set_xlim(0.0, 360.0)
    style.add_legend(turns)
    return figure
