"""Figure of the profiles of a survey: readings along the line nearest to each target, and the targets' fields."""

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
_REACH = 4.0  # length of a profile on each side, in heights of the sensors above the target
_SAME_COURSE = 0.5  # least cosine between the courses of the rows of a line
_LEAST_STEP_M = 1e-9
_PANEL_IN = 1.7


class _Profile(NamedTuple):
    """Distances from the point nearest to the target, readings, and fields of the targets."""

    distance_m: FloatArray
    measured_nT: FloatArray
    targets_nT: FloatArray


def survey_profiles(found: Survey) -> Figure:
    """Draw the anomaly along the line nearest to each target, and the fields of all targets.

    At most the 12 most significant targets have a panel. The fields of the targets are shifted by the median residual,
    which is due to the field of the ground and to slow changes of the Earth's field.

    Parameters
    ----------
    found : Survey
        A result of :func:`magloc.survey`.

    Returns
    -------
    matplotlib.figure.Figure
        Figure; :func:`save` writes it to a file.

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
        ax.plot(profile.distance_m, profile.measured_nT, ".", color=style.GREY, ms=2.5, label="measured")
        ax.plot(profile.distance_m, profile.targets_nT, "-", color=style.BLUE, lw=1.0, label="targets")
        title = f"{target.id}: {target.depth_m:.2f} m deep, {target.strength_Am2:.2g} A·m²"
        style.label_axes(ax, "along the line [m]", "anomaly [nT]", title)
    for ax in panels[len(shown) :]:
        ax.set_axis_off()
    if shown:
        panels[0].legend(fontsize=style.SMALL_FONT_SIZE, frameon=False)
    return figure


def _nearest_pass(found: Survey, target: Target) -> _Profile:
    """Return the profile of the line nearest to a target."""
    place_m = found.rows.place_m
    apart_m = np.linalg.norm(place_m[:, :2] - target.position_m[:2], axis=1)
    nearest = int(np.argmin(apart_m))
    course = np.gradient(place_m[:, :2], axis=0)
    course /= np.maximum(np.linalg.norm(course, axis=1, keepdims=True), _LEAST_STEP_M)
    far = apart_m > _REACH * (place_m[nearest, 2] - target.position_m[2])
    far |= course @ course[nearest] < _SAME_COURSE
    far[nearest] = False
    before, after = np.flatnonzero(far[:nearest]), np.flatnonzero(far[nearest:])
    first = int(before[-1]) + 1 if before.size else 0
    rows = slice(first, nearest + int(after[0]) if after.size else len(far))
    steps = np.linalg.norm(np.diff(place_m[rows, :2], axis=0), axis=1)
    distance_m = np.concatenate([[0.0], np.cumsum(steps)])
    measured, residual = 1e9 * found.rows.anomaly_T[rows], 1e9 * found.rows.residual_T[rows]
    targets = measured - residual + float(np.median(residual))
    return _Profile(distance_m - distance_m[nearest - first], measured, targets)
