"""Errors of pose and sensors of a survey, estimated from its own rows as variance components."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np

from arrays.array import SensorArray
from arrays.pose import PoseUncertainty
from magloc.measurement.pose import PoseErrors
from magloc.surveying.fit.joint_fit import Sources
from magloc.surveying.rounds import SurveyModel

_POSITION_M, _ATTITUDE_RAD = 0.02, math.radians(0.5)
COURSE_RAD = math.radians(3.0)
"""Assumed error of an attitude that is the course over ground."""
_POSITIONS_M = (0.0, 0.005, 0.01, 0.02, 0.04, 0.08, 0.16)
_CORRELATIONS_S = (2.0, 10.0, 40.0)
_FINER = (2.0**-0.5, 2.0**0.5, 2.0**-0.25, 2.0**0.25)
_OFFSETS = (0.0, 3.0, 10.0, 30.0, 100.0)  # fields fixed to the array, in units of the noise
_LEAST_GAIN = 30.0  # of minus twice the log-likelihood, by these fields: of right models 1 in a million reaches it
_BOTH = 10.0  # gain that a second kind of error must exceed: 1 % of χ² of two


def unstated_pose(array: SensorArray) -> PoseUncertainty:
    """Return the assumed errors until targets give an estimate."""
    by_course = array.columns is not None and array.columns.course
    return PoseUncertainty(position_m=_POSITION_M, attitude_rad=COURSE_RAD if by_course else _ATTITUDE_RAD)


def with_likeliest_pose(model: SurveyModel, sources: Sources) -> SurveyModel:
    """Return the model with the likeliest pose errors for given sources.

    The errors are correlated in time, white, or both; estimates are the size of each kind and the correlation time.
    """
    every, array = np.arange(len(model.record)), model.record.array

    @cache
    def cost(lasting_m: float, lasts_s: float, white_m: float) -> float:
        both = _BOTH if lasting_m and white_m else 0.0
        return with_pose(model, pose_of(array, lasting_m, lasts_s, white_m)).misfit(sources, every) + both

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
    return with_pose(model, pose_of(array, lasting_m, lasts_s, white_m))


def with_likeliest_offsets(model: SurveyModel, sources: Sources) -> SurveyModel:
    """Return the model with the likeliest size of fields fixed to the array, for given sources.

    Such a field is the heading error of a scalar sensor. It is not smaller than the stated `offset_uncertainty_T`.
    """
    every, array = np.arange(len(model.record)), model.record.array
    noise_T = float(np.median([sensor.noise_T for sensor in array.sensors]))

    def of_size(size: float) -> SurveyModel:
        sensors = (
            replace(sensor, offset_uncertainty_T=max(sensor.offset_uncertainty_T, size * noise_T))
            if sensor.kind == "scalar"
            else sensor
            for sensor in array.sensors
        )
        return replace(model, record=replace(model.record, array=replace(array, sensors=tuple(sensors))))

    if not array.channel_is_scalar.any():
        return model
    models = [of_size(size) for size in _OFFSETS]
    costs = [one.misfit(sources, every) for one in models]
    best = int(np.argmin(costs))
    return models[best] if costs[best] < costs[0] - _LEAST_GAIN else model


def pose_of(array: SensorArray, lasting_m: float, lasts_s: float, white_m: float) -> PoseUncertainty:
    """Return an assumed pose with two kinds of position errors."""
    if not lasting_m:
        return replace(unstated_pose(array), position_m=white_m)
    return replace(unstated_pose(array), position_m=lasting_m, correlation_s=lasts_s, position_white_m=white_m)


def with_pose(model: SurveyModel, pose: PoseUncertainty) -> SurveyModel:
    """Return the model with a stated uncertainty of the pose."""
    errors = PoseErrors.of(pose, between_s=model.errors.between_s)
    return replace(model, record=model.record.with_pose(errors), errors=errors)


def _beside(value: float, grid: tuple[float, ...]) -> tuple[float, ...]:
    """Return the neighbours of a value in a grid."""
    at = grid.index(value)
    return tuple(grid[k] for k in (at - 1, at + 1) if 0 <= k < len(grid))
