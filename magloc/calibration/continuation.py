"""Steps of a calibration from its start, fixes or a path, to its optimum.

If the nominal array is wrong by many times the noise, the readings nearest to the source make the first steps far too
long. Therefore the noise starts at what the prior allows for gains and offsets, and shrinks step by step.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from arrays.array import SensorArray
from arrays.noise import proportional_noise
from arrays.sensor import Calibration
from arrays.typing import BoolArray, FloatArray
from magloc.calibration import least_squares as source_fit
from magloc.calibration.least_squares import CalibrationIterate
from magloc.calibration.model import CalibrationProblem, CalibrationState
from magloc.calibration.sensors import OFFSET, POSITION, SensorProblem, State, response_factors
from magloc.least_squares import Optimum
from magloc.localization.fit.results import Fix
from magloc.localization.locator import Locator

SHARES = (1.0, 0.3, 0.1, 0.03)
"""Shares of the prior's uncertainty that are added to the noise, one after the other."""
_ROUGHLY = 1.0
_LARGEST_DOUBT = 0.3
_BADLY = 20.0
_NOISE_PASSES = 3
_MISFIT = 2.0  # χ²/dof above which the stated noise is too small
Problem = TypeVar("Problem", bound=SensorProblem[Any])
_HEIGHTS = np.concatenate([-np.geomspace(4.0, 0.05, 8), np.geomspace(0.05, 4.0, 8)])


def apply_calibration(array: SensorArray, change: FloatArray) -> SensorArray:
    """Return the array changed by (N, 15): positions [m], gains, axes [rad], offsets [T]."""
    factors = response_factors(change)
    sensors = []
    for sensor, factor, row in zip(array.sensors, factors, change, strict=True):
        position = np.asarray(sensor.position_m) + row[POSITION]
        calibration = Calibration.of(
            "vector",
            factor @ np.asarray(sensor.calibration.scale),
            np.asarray(sensor.calibration.offset_T) + row[OFFSET],
        )
        sensors.append(replace(sensor, position_m=tuple(position.tolist()), calibration=calibration))
    return replace(array, sensors=tuple(sensors))


def fit_source_on_path(problem: CalibrationProblem, start: CalibrationState) -> CalibrationState:
    """Fit moment and height to a known path with the nominal array."""
    nominal = replace(inflate_noise(problem, start.sensors, 1.0), free=np.zeros_like(problem.free))
    # At a moment of zero the field is linear in the moment, and the height has no effect.
    linear = replace(nominal, unknown_height=False)
    offsets = _HEIGHTS * problem.array.circumradius if problem.unknown_height else np.zeros(1)
    centre = float(problem.array.centroid[2]) if problem.unknown_height else 0.0
    starts = [replace(start, height_m=centre + float(offset)) for offset in offsets]
    optima = [source_fit.fit_state(linear, s, max_iterations=20) for s in starts]
    # A height at which the path runs through a sensor has no cost.
    return min(optima, key=lambda optimum: np.nan_to_num(optimum.point.cost, nan=np.inf)).point.state


def nominal_state(problem: CalibrationProblem, position_m: FloatArray, moment_Am2: FloatArray) -> CalibrationState:
    """Return the state of the nominal array with sources (n, 3) and moments in the world frame."""
    return CalibrationState(np.zeros(problem.prior.shape), position_m, 0.0, moment_Am2, np.zeros_like(position_m))


def state_from_fixes(problem: CalibrationProblem, fixes: Sequence[Fix]) -> CalibrationState:
    """Return a state of the nominal array, with the best solution of every row's fix."""
    best = [fix.solutions[0] for fix in fixes]
    moment = np.stack([solution.moment_Am2 for solution in best])
    position = np.stack([solution.position_m for solution in best])
    return nominal_state(problem, position, np.einsum("tab,tb->ta", problem.world_from_array, moment))


def with_common_moment(problem: CalibrationProblem, state: CalibrationState) -> CalibrationState:
    """Return a state with the median moment in all rows, after a new fix of every row."""
    median = np.median(state.moment_Am2, axis=0)
    state = replace(state, moment_Am2=np.broadcast_to(median, state.moment_Am2.shape))
    every = np.ones(len(state.position_m), dtype=np.bool_)
    return relocate(problem, state, every, 1.0)


def relocate(problem: CalibrationProblem, state: CalibrationState, rows: BoolArray, share: float) -> CalibrationState:
    """Locate some rows again and take the solutions whose moment is nearest to the median."""
    median = np.median(state.moment_Am2, axis=0)
    position, moment = state.position_m.copy(), state.moment_Am2.copy()
    locator = Locator(inflate_field_noise(problem, state.sensors, share), body_length_m=0.0, exclude_faulty=False)
    fixes = locator.fit_rows(problem.readings_T[rows])
    for t, fix in zip(np.flatnonzero(rows), fixes, strict=True):
        if fix.solutions:
            moments = np.stack([problem.world_from_array[t] @ solution.moment_Am2 for solution in fix.solutions])
            nearest = int(np.argmin(np.linalg.norm(moments - median, axis=1)))
            position[t] = fix.solutions[nearest].position_m
            if problem.moment == "free":
                moment[t] = moments[nearest]
    return replace(state, position_m=position, moment_Am2=moment)


def inflate_field_noise(problem: SensorProblem[State], sensors: FloatArray, share: float = 1.0) -> SensorArray:
    """Return the array of sensors (N, 15) with noise in proportion to the field, by a share of the prior's doubt."""
    doubt = share * min(_LARGEST_DOUBT, problem.field_doubt)
    array = apply_calibration(problem.array, sensors)
    fractions = np.hypot(array.noise_fractions, doubt).tolist()
    inflated = tuple(replace(s, noise_fraction=f) for s, f in zip(array.sensors, fractions, strict=True))
    return replace(array, sensors=inflated)


def inflate_noise(problem: Problem, sensors: FloatArray, share: float) -> Problem:
    """Return the problem with the noise at some sensors (N, 15), raised by a share of the prior."""
    array = inflate_field_noise(problem, sensors, share)
    offsets = share * np.where(problem.free, problem.prior, 0.0)[:, OFFSET].max(axis=1)
    inflated = tuple(
        replace(sensor, noise_T=float(np.hypot(sensor.noise_T, offset)))
        for sensor, offset in zip(array.sensors, offsets, strict=True)
    )
    return replace(problem, noise_T=proportional_noise(replace(array, sensors=inflated), problem.readings_T))


def approach_optimum(
    problem: CalibrationProblem, state: CalibrationState, shares: Sequence[float] = SHARES
) -> CalibrationState:
    """Return a state near the optimum, fitted with noise that shrinks step by step."""
    for share in shares:
        lenient = inflate_noise(problem, state.sensors, share)
        optimum = source_fit.fit_state(lenient, state, tolerance=_ROUGHLY)
        if not problem.is_on_path:
            optimum = _relocate_misfits(lenient, optimum, share)
        state = optimum.point.state
    return state


def _relocate_misfits(
    problem: CalibrationProblem, optimum: Optimum[CalibrationIterate[CalibrationState]], share: float
) -> Optimum[CalibrationIterate[CalibrationState]]:
    """Fix badly fitted rows again; on the wrong side of the array they never return."""
    chi2 = np.sum(problem.residuals(problem.prediction_T(optimum.point.state)) ** 2, axis=1)
    bad = chi2 > _BADLY * np.median(chi2)
    if not bad.any():
        return optimum
    again = relocate(problem, optimum.point.state, bad, share)
    other = source_fit.fit_state(problem, again, tolerance=_ROUGHLY)
    return other if other.point.cost < optimum.point.cost else optimum


def fit_calibration(problem: Problem, state: State) -> tuple[Problem, Optimum[CalibrationIterate[State]]]:
    """Return the problem with the noise at the optimum, and the optimum near a state.

    If residuals exceed the stated noise, priors are weighted relative to the noise that the residuals show.
    """
    for _ in range(_NOISE_PASSES if problem.array.noise_fractions.any() else 1):
        problem = inflate_noise(problem, state.sensors, 0.0)
        optimum = source_fit.fit_state(problem, state)
        state = optimum.point.state
    excess = problem.chi2(state) / max(1, problem.n_numbers - len(problem.estimated_indices))
    if excess > _MISFIT:
        problem = replace(problem, noise_scale=math.sqrt(excess))
        optimum = source_fit.fit_state(problem, state)
    return problem, optimum
