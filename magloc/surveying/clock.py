"""How much later than their poses the readings of a survey are, as targets that are passed both ways show."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

from arrays.typing import FloatArray, IntArray
from magloc.navigation.poses import vectors_at
from magloc.readings import Readings
from magloc.surveying.fit.joint_fit import Sources
from magloc.surveying.fit.record import SurveyRecord
from magloc.surveying.rounds import Model

_STEP_M = 0.05  # of the way, for the curvature of the likelihood
_MOST_S = 1.0
_TOLERANCE_S = 1e-3
_MISFIT, _SHARE = 2.0, 0.5  # per reading, and of the misfit without a lag


class Lag(NamedTuple):
    """Seconds by which readings are late, and their standard deviation."""

    s: float
    sigma_s: float


def lag_of(model: Model, sources: Sources, group: IntArray, delayed: Callable[[float], SurveyRecord]) -> Lag:
    """Likeliest lag of a record, 0 where it explains no more than chance does; ``delayed`` has one corrected."""
    record = model.record
    way = np.linalg.norm(np.diff(record.middles_m, axis=0), axis=1)
    speed = float(np.median(way / np.diff(record.time_s)))
    if not len(sources) or speed * _MOST_S < _STEP_M:
        return Lag(0.0, math.inf)
    step = _STEP_M / speed

    def cost(lag_s: float) -> float:
        """Twice the negative logarithm of the likelihood, sources refitted."""
        at = replace(model, record=delayed(lag_s)) if lag_s else model
        return at.misfit(at.refitted(sources, group), group)

    size = (int(group[-1]) + 1) * record.array.n_channels

    def chance(cost: float) -> float:
        """What a lag explains by chance: what is not found yet makes it larger."""
        return model.threshold * max(1.0, cost / size)

    before, here, after = cost(-step), cost(0.0), cost(step)
    curvature = (before - 2.0 * here + after) / step**2
    slope = (after - before) / (2.0 * step)
    if here < min(before, after) and slope**2 < 2.0 * curvature * chance(here):
        return Lag(0.0, math.sqrt(2.0 / curvature))
    found = minimize_scalar(cost, bounds=(-_MOST_S, _MOST_S), method="bounded", options={"xatol": _TOLERANCE_S})
    explained = found.fun < max(_MISFIT * size, _SHARE * here)  # else something is wrong that a lag imitates
    if not explained or here - found.fun < chance(found.fun) or abs(found.x) > 0.99 * _MOST_S:
        return Lag(0.0, math.inf)
    around = [cost(found.x + sign * step) for sign in (-1.0, 1.0)]
    return Lag(float(found.x), step * math.sqrt(2.0 / (sum(around) - 2.0 * found.fun)))


def rows_around(time_s: FloatArray, rows: IntArray) -> IntArray:
    """Some rows of a record, with those that a lag of them reaches and the next ones to these."""
    first = np.maximum(np.searchsorted(time_s, time_s[rows] - _MOST_S) - 1, 0)
    end = np.minimum(np.searchsorted(time_s, time_s[rows] + _MOST_S) + 1, len(time_s))
    size = len(time_s) + 1
    return np.flatnonzero(np.cumsum(np.bincount(first, minlength=size) - np.bincount(end, minlength=size)))


def taken_earlier(readings: Readings, lag_s: float) -> Readings:
    """Readings with the poses of some time before their own, and the direction of the ambient field with these.

    Its modulus stays that of the row's own time, as a base station at the clock of the readings has it.
    """
    posed = readings.posed_later(-lag_s)
    ambient = readings.ambient_T
    if ambient is not None:  # in the world it hardly turns between two rows
        assert readings.array_rotation is not None
        assert posed.array_rotation is not None
        in_world = vectors_at(readings.time_s - lag_s, readings.time_s, readings.array_rotation.apply(ambient))
        earlier = posed.array_rotation.inv().apply(in_world)
        own, theirs = (np.linalg.norm(field, axis=1, keepdims=True) for field in (ambient, earlier))
        ambient = earlier * (own / theirs)
    return replace(posed, ambient_T=ambient)
