"""Runs of yaw in guaranteed ellipsoids: ``adcs run ellipsoid``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adcs.ellipsoids.names import StepRule
from adcs.ellipsoids.roll_yaw import (
    STEP_S,
    YAW,
    AttitudeLoop,
    SetTrack,
    observe,
    roll_yaw_observer,
    roll_yaw_system,
    violations,
)
from arrays.typing import FloatArray
from sims.attitude.roll_yaw import ErrorScenario, LoopScenario, error_runs, fly


@dataclass(frozen=True)
class EllipsoidSettings:
    """Settings of the simulation and of the observer.

    ``noise_rad``, ``drift_rad_s``: bounds of the horizon sensor's errors and of the yaw gyro's zero shift.
    """

    noise_rad: float
    drift_rad_s: float
    n_steps: int  # of 2 s
    step: StepRule = "tightened"  # rule by which a set shrinks to a reading
    jump_s: float | None = None  # when the readings become four times as bad as their bound
    closed_loop: bool = False  # the satellite in its attitude loop instead of the dynamics of the error alone


@dataclass(frozen=True, eq=False)
class EllipsoidRuns:
    """Truth and sets of runs."""

    seeds: range
    states_rad: FloatArray
    track: SetTrack
    roll_readings_rad: FloatArray
    increments_rad: FloatArray | None


def ellipsoid_runs(settings: EllipsoidSettings, seeds: range) -> EllipsoidRuns:
    """Simulate the runs of some seeds, all at once."""
    noise, drift, n_steps = settings.noise_rad, settings.drift_rad_s, settings.n_steps
    observer = roll_yaw_observer(roll_yaw_system(noise, drift), len(seeds), settings.step)
    if settings.closed_loop:
        loop = AttitudeLoop(observer, n_steps)
        scenario = LoopScenario(noise, drift, n_steps, first_yaw_rad=2.0 * noise, jump_s=settings.jump_s)
        flown = fly(scenario, loop, seeds)
        states = flown.angles_rad[..., [0, 2]]
        return EllipsoidRuns(seeds, states, loop.recorder.track, flown.roll_readings_rad, flown.increments_rad)
    runs = error_runs(ErrorScenario(noise, drift, n_steps, jump_s=settings.jump_s), seeds)
    return EllipsoidRuns(seeds, runs.states_rad, observe(observer, runs.readings_rad), runs.readings_rad, None)


def run_columns(runs: EllipsoidRuns) -> dict[str, NDArray[Any]]:
    """Return statistics (R,) of every run; the largest yaw is NaN for runs below 1000 s."""
    track, yaw = runs.track, runs.states_rad[..., YAW]
    late = np.abs(yaw[:, int(1000.0 / STEP_S) :])
    return {
        "final_error_deg": np.degrees(np.abs(track.centres[:, -1, YAW] - yaw[:, -1])),
        "half_width_deg": np.degrees(track.yaw_half_widths[:, -1]),
        "bound_deg": np.degrees(track.bounds[:, -1]),
        "resets": track.resets[:, -1],
        "violations": violations(track, runs.states_rad),
        "yaw_max_1000s_deg": np.degrees(late.max(axis=1)) if late.size else np.full(len(yaw), np.nan),
    }
