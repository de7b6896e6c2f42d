"""Pose errors of a survey, estimated from its own rows as variance components."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np

from arrays.pose import PoseUncertainty
from magloc.measurement.pose import PoseErrors
from magloc.surveying.fit.joint_fit import Sources
from magloc.surveying.rounds import SurveyModel

UNSTATED = PoseUncertainty(position_m=0.02, attitude_rad=math.radians(0.5))
"""Assumed errors until targets give an estimate."""
_POSITIONS_M = (0.0, 0.005, 0.01, 0.02, 0.04, 0.08, 0.16)
_CORRELATIONS_S = (2.0, 10.0, 40.0)
_FINER = (2.0**-0.5, 2.0**0.5, 2.0**-0.25, 2.0**0.25)
_BOTH = 10.0  # gain that a second kind of error must exceed: 1 % of χ² of two


def with_likeliest_pose(model: SurveyModel, sources: Sources) -> SurveyModel:
    """Return the model with the likeliest pose errors for given sources.

    The errors are correlated in time, white, or both; estimates are the size of each kind and the correlation time.
    """
    every = np.arange(len(model.record))

    @cache
    def cost(lasting_m: float, lasts_s: float, white_m: float) -> float:
        both = _BOTH if lasting_m and white_m else 0.0
        return with_pose(model, pose_of(lasting_m, lasts_s, white_m)).misfit(sources, every) + both

    def better(now: tuple[float, float, float]) -> tuple[float, float, float]:
        """Return the likeliest of some components and their neighbours."""
        lasting_m, lasts_s, white_m = now
        more = [(size, lasts, white_m) for size in _beside(lasting_m, _POSITIONS_M) for lasts in _CORRELATIONS_S]
        if lasting_m:
            more = [(size, lasts_s, white_m) for size in _beside(lasting_m, _POSITIONS_M)]
            more += [(lasting_m, lasts, white_m) for lasts in _beside(lasts_s, _CORRELATIONS_S)]
        more += [(lasting_m, lasts_s, size) for size in _beside(white_m, _POSITIONS_M)]
        return min([now, *more], key=lambda one: cost(*one))

    now, best = (0.0, 0.0, 0.0), min(((0.0, 10.0, 0.02), (0.02, 10.0, 0.0)), key=lambda one: cost(*one))
    while best != now:
        now, best = best, better(best)
    lasting_m, lasts_s, white_m = best
    for finer in _FINER if white_m else ():
        white_m = min(white_m, finer * white_m, key=lambda size: cost(lasting_m, lasts_s, size))
    return with_pose(model, pose_of(lasting_m, lasts_s, white_m))


def pose_of(lasting_m: float, lasts_s: float, white_m: float) -> PoseUncertainty:
    """Return an assumed pose with two kinds of position errors."""
    if not lasting_m:
        return replace(UNSTATED, position_m=white_m)
    return replace(UNSTATED, position_m=lasting_m, correlation_s=lasts_s, position_white_m=white_m)


def with_pose(model: SurveyModel, pose: PoseUncertainty) -> SurveyModel:
    """Return the model with a stated uncertainty of the pose."""
    errors = PoseErrors.of(pose, between_s=model.errors.between_s)
    return replace(model, record=model.record.with_pose(errors), errors=errors)


def _beside(value: float, grid: tuple[float, ...]) -> tuple[float, ...]:
    """Return the neighbours of a value in a grid."""
    at = grid.index(value)
    return tuple(grid[k] for k in (at - 1, at + 1) if 0 <= k < len(grid))
