"""Starts of runs: instants of a day from which the conditions of a scenario hold."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from adcs.environment.environment import Environment, environment
from adcs.environment.orbit import Orbit
from adcs.frames import DAY_S, Instants
from arrays.typing import BoolArray
from magloc.fields.geomagnetic import Model
from sims.attitude.scenario import AttitudeScenario, StartConditions
from sims.noise import stream

GRID_S = 10.0
"""Step of the instants at which conditions are checked; shorter changes may be missed."""


def starts(scenario: AttitudeScenario, seeds: list[int]) -> Instants:
    """Draw the start of every run (runs,) from the instants that the conditions allow."""
    satellite = scenario.satellite
    day = _day(satellite.orbit, satellite.start, scenario.duration_s, satellite.field_model)
    n = 1 + math.ceil(scenario.duration_s / GRID_S)
    allowed = np.flatnonzero(_allowed(scenario.conditions, day, n))
    if not allowed.size:
        raise ValueError(
            f"Input conditions must hold for {scenario.duration_s:g} s somewhere in the 24 hours from "
            f"{satellite.start}; instead received {scenario.conditions}, which never do."
        )
    return np.array([day.utc[stream(seed, "start").choice(allowed)] for seed in seeds])


@lru_cache(maxsize=4)
def _day(orbit: Orbit, day: np.datetime64, duration_s: float, model: Model) -> Environment:
    return environment(orbit, day, np.arange(0.0, DAY_S + duration_s + 2.0 * GRID_S, GRID_S), model=model)


def _allowed(conditions: StartConditions, day: Environment, n: int) -> BoolArray:
    """Return a mask of the instants at which a run of n instants may start."""
    lit = day.sunlit
    field_T = np.linalg.norm(day.b_orbital_T, axis=-1)
    throughout = (day.separation_rad >= conditions.least_separation_rad) & (field_T >= conditions.least_field_T)
    if conditions.sunlit:
        throughout &= lit
    once = day.separation_rad <= conditions.most_separation_rad
    allowed: BoolArray = np.logical_and(_windows(throughout, n).all(axis=-1), _windows(once, n).any(axis=-1))
    if conditions.eclipse_after_s is not None:
        before = max(1, round(conditions.eclipse_after_s / GRID_S))
        in_time = _windows(lit, before + 1)
        entering = in_time[:, :-1].all(axis=-1) & ~in_time[:, -1]
        m = min(len(allowed), len(entering))
        allowed = allowed[:m] & entering[:m]
    return allowed[: round(DAY_S / GRID_S)]


def _windows(values: BoolArray, n: int) -> BoolArray:
    """Return all windows of n values, shape (..., n)."""
    return np.lib.stride_tricks.sliding_window_view(values, n)
