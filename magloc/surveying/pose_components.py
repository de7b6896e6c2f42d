"""How wrong the pose of a survey is, as its own rows tell, where nothing is stated: variance components."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np

from arrays.pose import PoseUncertainty
from magloc.measurement.pose import PoseErrors
from magloc.surveying.fit.joint_fit import Sources
from magloc.surveying.rounds import Model

UNSTATED = PoseUncertainty(position_m=0.02, attitude_rad=math.radians(0.5))
"""What is assumed until targets tell more."""
_POSITIONS_M = (0.0, 0.005, 0.01, 0.02, 0.04, 0.08, 0.16)
_CORRELATIONS_S = (2.0, 10.0, 40.0)
_FINER = (2.0**-0.5, 2.0**0.5, 2.0**-0.25, 2.0**0.25)
_BOTH = 10.0  # that two kinds of errors must explain more than one: 1 % of χ² of two


def with_likeliest_pose(model: Model, sources: Sources) -> Model:
    """The model whose errors of the pose have the largest likelihood where sources are.

    They last, or are new in every row, or are of both kinds: how large each is, and how lasting.
    """
    every = np.arange(len(model.record))

    @cache
    def cost(lasting_m: float, lasts_s: float, white_m: float) -> float:
        both = _BOTH if lasting_m and white_m else 0.0
        return with_pose(model, pose_of(lasting_m, lasts_s, white_m)).misfit(sources, every) + both

    def better(now: tuple[float, float, float]) -> tuple[float, float, float]:
        """The likeliest of some components and those beside them."""
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
    """Return an assumed pose whose places have errors of two kinds."""
    if not lasting_m:
        return replace(UNSTATED, position_m=white_m)
    return replace(UNSTATED, position_m=lasting_m, correlation_s=lasts_s, position_white_m=white_m)


def with_pose(model: Model, pose: PoseUncertainty) -> Model:
    """The model where some uncertainty of the pose is stated."""
    errors = PoseErrors.of(pose, between_s=model.errors.between_s)
    return replace(model, record=model.record.with_pose(errors), errors=errors)


def _beside(value: float, grid: tuple[float, ...]) -> tuple[float, ...]:
    """The values of a grid next to one of them."""
    at = grid.index(value)
    return tuple(grid[k] for k in (at - 1, at + 1) if 0 <= k < len(grid))
