"""How a calibration comes near its optimum: from fixes or a path, and from readings that are doubted to trusted ones.

With a nominal array that is wrong by many times the noise the nearest readings would throw the first steps far away.
Therefore the noise starts at what the prior leaves open of gains and offsets, and shrinks step by step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from arrays.array import SensorArray
from arrays.noise import proportional_noise
from arrays.sensor import Calibration
from arrays.typing import BoolArray, FloatArray
from magloc.calibration import least_squares as source_fit
from magloc.calibration import model as moving_source
from magloc.calibration.least_squares import Fit
from magloc.calibration.model import GAINS, OFFSET, POSITION, Problem, State
from magloc.least_squares import Optimum
from magloc.localization.fit.results import Fix
from magloc.localization.locator import Locator

SHARES = (1.0, 0.3, 0.1, 0.03)
"""Of what the prior leaves open, by which the noise is raised in turn."""
_ROUGHLY = 1.0
_LARGEST_DOUBT = 0.3
_BADLY = 20.0
_NOISE_PASSES = 3
_HEIGHTS = np.concatenate([-np.geomspace(4.0, 0.05, 8), np.geomspace(0.05, 4.0, 8)])


def calibrated_array(array: SensorArray, change: FloatArray) -> SensorArray:
    """The array with the change (N, 15) of position [m], gains, axes [rad] and offset [T] of every sensor."""
    factors = moving_source.response_factors(change)
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


def source_on_path(problem: Problem, start: State) -> State:
    """Moment and height that fit a known path best with the nominal array."""
    nominal = replace(doubted(problem, start, 1.0), free=np.zeros_like(problem.free))
    # At a moment of zero the field is linear in the moment, and the height has no effect.
    linear = replace(nominal, unknown_height=False)
    offsets = _HEIGHTS * problem.array.circumradius if problem.unknown_height else np.zeros(1)
    centre = float(problem.array.centroid[2]) if problem.unknown_height else 0.0
    starts = [replace(start, height_m=centre + float(offset)) for offset in offsets]
    optima = [source_fit.minimised(linear, s, max_iterations=20) for s in starts]
    # A height at which the path runs through a sensor has no cost.
    return min(optima, key=lambda optimum: np.nan_to_num(optimum.point.cost, nan=np.inf)).point.state


def untouched(problem: Problem, position_m: FloatArray, moment_Am2: FloatArray) -> State:
    """The nominal array with a source at some positions in its frame, of some moments in the world frame."""
    return State(np.zeros(problem.prior.shape), position_m, 0.0, moment_Am2, np.zeros_like(position_m))


def located(problem: Problem, fixes: Sequence[Fix]) -> State:
    """The nominal array with the source at the best solution of every row."""
    best = [fix.solutions[0] for fix in fixes]
    moment = np.stack([solution.moment_Am2 for solution in best])
    position = np.stack([solution.position_m for solution in best])
    return untouched(problem, position, np.einsum("tab,tb->ta", problem.world_from_array, moment))


def with_one_moment(problem: Problem, state: State) -> State:
    """A state with the median of its moments for all rows, every row looked for once more."""
    median = np.median(state.moment_Am2, axis=0)
    state = replace(state, moment_Am2=np.broadcast_to(median, state.moment_Am2.shape))
    every = np.ones(len(state.position_m), dtype=np.bool_)
    return looked_for_again(problem, state, every, 1.0)


def looked_for_again(problem: Problem, state: State, rows: BoolArray, share: float) -> State:
    """A state with some rows at that solution of a new fix whose moment is nearest to the median moment."""
    median = np.median(state.moment_Am2, axis=0)
    position, moment = state.position_m.copy(), state.moment_Am2.copy()
    locator = Locator(with_doubted_fields(problem, state, share), body_length_m=0.0, exclude_faulty=False)
    fixes = locator.fit_rows(problem.readings_T[rows])
    for t, fix in zip(np.flatnonzero(rows), fixes, strict=True):
        if fix.solutions:
            moments = np.stack([problem.world_from_array[t] @ solution.moment_Am2 for solution in fix.solutions])
            nearest = int(np.argmin(np.linalg.norm(moments - median, axis=1)))
            position[t] = fix.solutions[nearest].position_m
            if problem.moment == "free":
                moment[t] = moments[nearest]
    return replace(state, position_m=position, moment_Am2=moment)


def with_doubted_fields(problem: Problem, state: State, share: float = 1.0) -> SensorArray:
    """The array of a state with noise that grows with the field, by a share of what the prior leaves open.

    Open are the gains, and the field's change between nominal and true position, which at a source a circumradius away
    is three times the displacement over that distance.
    """
    deviations = np.where(problem.free, problem.prior, 0.0)
    displaced = 3.0 * deviations[:, POSITION].max() / problem.array.circumradius
    doubt = share * min(_LARGEST_DOUBT, float(np.hypot(deviations[:, GAINS].max(), displaced)))
    array = calibrated_array(problem.array, state.sensors)
    fractions = np.hypot(array.noise_fractions, doubt).tolist()
    sensors = tuple(replace(s, noise_fraction=f) for s, f in zip(array.sensors, fractions, strict=True))
    return replace(array, sensors=sensors)


def doubted(problem: Problem, state: State, share: float) -> Problem:
    """The problem with the noise of an array near a state, raised by a share of what the prior leaves open."""
    array = with_doubted_fields(problem, state, share)
    offsets = share * np.where(problem.free, problem.prior, 0.0)[:, OFFSET].max(axis=1)
    sensors = tuple(
        replace(sensor, noise_T=float(np.hypot(sensor.noise_T, offset)))
        for sensor, offset in zip(array.sensors, offsets, strict=True)
    )
    return replace(problem, noise_T=proportional_noise(replace(array, sensors=sensors), problem.readings_T))


def approached(problem: Problem, state: State, shares: Sequence[float] = SHARES) -> State:
    """A state near the optimum, through noises that shrink step by step towards the array's own."""
    for share in shares:
        lenient = doubted(problem, state, share)
        optimum = source_fit.minimised(lenient, state, tolerance=_ROUGHLY)
        if problem.unknown_position:
            optimum = _mended(lenient, optimum, share)
        state = optimum.point.state
    return state


def _mended(problem: Problem, optimum: Optimum[Fit], share: float) -> Optimum[Fit]:
    """The optimum with badly fitted rows looked for again: on the wrong side of the array they never come back."""
    chi2 = np.sum(moving_source.residuals(problem, optimum.point.state) ** 2, axis=1)
    bad = chi2 > _BADLY * np.median(chi2)
    if not bad.any():
        return optimum
    again = looked_for_again(problem, optimum.point.state, bad, share)
    other = source_fit.minimised(problem, again, tolerance=_ROUGHLY)
    return other if other.point.cost < optimum.point.cost else optimum


def fitted(problem: Problem, start: State) -> tuple[Problem, Optimum[Fit]]:
    """The optimum, and the problem with the noise that belongs to it."""
    state = approached(problem, start)
    for _ in range(_NOISE_PASSES if problem.array.noise_fractions.any() else 1):
        problem = doubted(problem, state, 0.0)
        optimum = source_fit.minimised(problem, state)
        state = optimum.point.state
    return problem, optimum
