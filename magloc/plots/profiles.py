"""Readings along the lines that pass nearest to the targets of a survey, beside the targets' fields."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from arrays.typing import FloatArray
from magloc.plots import style

if TYPE_CHECKING:
    from magloc.surveying.results import Survey, Target

_MOST, _ACROSS = 12, 3
_BESIDE = 4.0  # distances from the sensors to the target
_SAME_WAY = 0.5  # cosine between the courses of rows of one line
_STANDS_M = 1e-9  # a row
_PANEL_IN = 1.7


class _Profile(NamedTuple):
    """Along a line: metres from where it passes the target, what was measured, and what targets add, in nT."""

    way_m: FloatArray
    measured_nT: FloatArray
    targets_nT: FloatArray


def survey_profiles(found: Survey) -> Figure:
    """Anomalies along the line that passes nearest to each target, and the fields of all targets there.

    Of the most significant targets, 12 at most. Fields of targets are shifted by what is left in the median: the
    ground's field, and slow changes of the Earth's.

    Parameters
    ----------
    found : Survey
        Of :func:`magloc.survey`.

    Returns
    -------
    matplotlib.figure.Figure

    Examples
    --------
    >>> import sims
    >>> import magloc
    >>> from dataclasses import replace
    >>> scenario = replace(sims.read_scenario("survey-drone"), duration_s=120.0)
    >>> field = sims.simulate(scenario, rng=1)
    >>> found = magloc.survey(field.array, field.readings)
    >>> figure = magloc.plots.survey_profiles(found)
    """
    shown = found[:_MOST]
    down = max(1, math.ceil(len(shown) / _ACROSS))
    figure = style.new_figure(_PANEL_IN * down + 0.6)
    panels = figure.subplots(down, _ACROSS, squeeze=False).ravel()
    for ax, target in zip(panels, shown, strict=False):
        profile = _nearest_pass(found, target)
        ax.plot(profile.way_m, profile.measured_nT, ".", color=style.GREY, ms=2.5, label="measured")
        ax.plot(profile.way_m, profile.targets_nT, "-", color=style.BLUE, lw=1.0, label="targets")
        title = f"{target.id}: {target.depth_m:.2f} m deep, {target.strength_Am2:.2g} A·m²"
        style.dress(ax, "along the line [m]", "anomaly [nT]", title)
    for ax in panels[len(shown) :]:
        ax.set_axis_off()
    if shown:
        panels[0].legend(fontsize=style.SMALL_LETTERS, frameon=False)
    return figure


def _nearest_pass(found: Survey, target: Target) -> _Profile:
    """The rows before and after the one nearest to a target, as far as they are near and on its line."""
    place_m = found.rows.place_m
    apart_m = np.linalg.norm(place_m[:, :2] - target.position_m[:2], axis=1)
    nearest = int(np.argmin(apart_m))
    course = np.gradient(place_m[:, :2], axis=0)
    course /= np.maximum(np.linalg.norm(course, axis=1, keepdims=True), _STANDS_M)
    far = apart_m > _BESIDE * (place_m[nearest, 2] - target.position_m[2])
    far |= course @ course[nearest] < _SAME_WAY
    far[nearest] = False
    before, after = np.flatnonzero(far[:nearest]), np.flatnonzero(far[nearest:])
    first = int(before[-1]) + 1 if before.size else 0
    rows = slice(first, nearest + int(after[0]) if after.size else len(far))
    steps = np.linalg.norm(np.diff(place_m[rows, :2], axis=0), axis=1)
    way_m = np.concatenate([[0.0], np.cumsum(steps)])
    measured, left = 1e9 * found.rows.anomaly_T[rows], 1e9 * found.rows.residual_T[rows]
    return _Profile(way_m - way_m[nearest - first], measured, measured - left + float(np.median(left)))
