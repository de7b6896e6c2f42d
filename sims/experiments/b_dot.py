"""A satellite of three units that tumbles, and B-dot by its own readings: ``adcs run detumbling``."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from adcs import quaternion
from adcs.environment.orbit import circular_orbit
from adcs.satellite.magnetic_control import BDot, b_dot_gain, detumbled
from adcs.satellite.satellite import Satellite
from adcs.satellite.telemetry import orbital_from_eci
from arrays.typing import FloatArray
from sims.attitude.scenario import AttitudeScenario, StartConditions
from sims.attitude.simulation import AttitudeRuns, advance, prepare, sense
from sims.noise import stream

INERTIA_KGM2 = np.diag([0.041, 0.041, 0.007])
SLOW_RAD_S = math.radians(0.5)


@dataclass(frozen=True, eq=False)
class Detumbling:
    """Some runs.

    Attributes
    ----------
    runs : AttitudeRuns
        Truth, readings, and the moments that were commanded: their mean over each cycle.
    time_s, theory_s : ndarray, shape (runs,)
        Until the rate stays below 0.5 °/s for a minute, and what the equation of the mean torque says; NaN where not
        within the run.
    """

    runs: AttitudeRuns
    time_s: FloatArray
    theory_s: FloatArray


def detumbling(
    seeds: Sequence[int],
    *,
    rate_deg_s: float = 10.0,
    largest_Am2: float = 0.2,
    duty: float = 0.8,
    duration_s: float = 6000.0,
    advanced: Callable[[int], None] | None = None,
) -> Detumbling:
    """Runs from rates in random directions, with a law that is told the magnetometer's readings and nothing else.

    Parameters
    ----------
    seeds : sequence of int
        One for each run.
    rate_deg_s : float
        At the start, of any direction.
    largest_Am2, duty : float
        Of the torquers; a cycle takes a second.
    duration_s : float
        Of every run.
    advanced : callable, optional
        Called with the number of steps finished since the last call.

    Examples
    --------
    >>> from sims import experiments
    >>> found = experiments.detumbling([0], rate_deg_s=1.0, duration_s=1500.0)
    >>> bool(found.time_s[0] < 1500.0)
    True
    """
    orbit = circular_orbit(altitude_m=550e3, inclination_deg=97.6, epoch="2026-11-21", local_time_h=10.5)
    scenario = AttitudeScenario(
        Satellite(inertia_kgm2=INERTIA_KGM2, orbit=orbit),
        conditions=StartConditions(sunlit=False, least_separation_rad=0.0, least_field_T=0.0),
        duration_s=duration_s,
        torque_Nm=1e-8,
        start_attitude_rad=2.0,
    )
    prepared = prepare(scenario, seeds)
    around, n = prepared.environment, scenario.n_instants
    directions = np.stack([stream(seed, "tumbling").standard_normal(3) for seed in seeds])
    w = math.radians(rate_deg_s) * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    law = BDot(b_dot_gain(INERTIA_KGM2, float(around.orbital_rate_rad_s[0, 0])), largest_Am2, duty)
    state, before = (prepared.q, w, prepared.momentum_Nms), np.full((len(seeds), 3), np.nan)
    q_all, w_all = np.empty((len(seeds), n, 4)), np.empty((len(seeds), n, 3))
    none = np.zeros((len(seeds), 3))
    for row in range(n):
        q_all[:, row], w_all[:, row] = state[:2]
        only = slice(row, row + 1)
        now = sense(prepared, q_all[:, only], w_all[:, only], only).field_T[:, 0]
        # What acts over the cycle is the mean over it: on for a part of it.
        prepared.torquers_Am2[:, row] = law.duty * law.moment_Am2(before, now, scenario.dt_s)
        before = now
        if row < n - 1:
            state = advance(prepared, state, none, row)
        if advanced is not None:
            advanced(1)
    runs = AttitudeRuns.of(prepared, q_all, w_all, *np.zeros((2, len(seeds), n, 3)))
    eci_from_orbital = quaternion.conjugate(orbital_from_eci(around))
    b_eci = quaternion.rotate(eci_from_orbital, prepared.true_field_orbital_T)
    eci_from_body = quaternion.multiply(eci_from_orbital[:, 0], prepared.q)
    H = quaternion.rotate(eci_from_body, w @ INERTIA_KGM2)
    theory = detumbled(law, H, b_eci, INERTIA_KGM2, scenario.dt_s) / INERTIA_KGM2.max()
    return Detumbling(
        runs, _time_below(np.linalg.norm(w_all, axis=-1), scenario.dt_s), _time_below(theory, scenario.dt_s)
    )


def _time_below(rate: FloatArray, step_s: float) -> FloatArray:
    """Time (runs,) from which rates (runs, n) stay below the slow one for a minute; NaN where they do not."""
    lasting = min(round(60.0 / step_s), rate.shape[1])
    largest = np.lib.stride_tricks.sliding_window_view(rate, lasting, axis=1).max(axis=-1)
    return np.where((largest < SLOW_RAD_S).any(axis=1), step_s * (largest < SLOW_RAD_S).argmax(axis=1), np.nan)
