"""Detumbling of a satellite of three units by torquers or rods: ``adcs run detumbling``."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from adcs import quaternion
from adcs.environment.orbit import circular_orbit
from adcs.kalman.error_state import AttitudeState, FilterSettings, sensor_set
from adcs.kalman.initialisation import vector_start
from adcs.kalman.mekf import initial_state, predict, update_state
from adcs.kalman.process_noise import tuned_noise
from adcs.satellite.dynamics import WheelControl, relative_rate
from adcs.satellite.magnetic_control import BDot, HysteresisRods, b_dot_gain, detumbled
from adcs.satellite.satellite import Satellite
from adcs.satellite.telemetry import Record, is_read, orbital_from_eci, part
from arrays.typing import BoolArray, FloatArray
from sims.attitude.scenario import AttitudeScenario, StartConditions
from sims.attitude.simulation import AttitudeRuns, Command, PreparedRuns, prepare, simulate_control, simulate_motion
from sims.noise import stream

Damping = Literal["readings", "estimate", "rods"]
INERTIA_KGM2 = np.diag([0.041, 0.041, 0.007])
ORBIT = circular_orbit(altitude_m=550e3, inclination_deg=97.6, epoch="2026-11-21", local_time_h=10.5)
RODS = HysteresisRods()
SLOW_RAD_S = math.radians(0.5)
ANYWHERE = StartConditions(sunlit=False, least_separation_rad=0.0, least_field_T=0.0)


def three_units(**more: Any) -> Satellite:
    """Return the satellite without wheels, with the options of its experiment."""
    no_wheels = WheelControl(np.zeros(3), np.zeros(3), torque_limit_Nm=1e-15)
    return Satellite(inertia_kgm2=INERTIA_KGM2, orbit=ORBIT, control=no_wheels, **more)


@dataclass(frozen=True, eq=False)
class Detumbling:
    """Runs of detumbling.

    Attributes
    ----------
    runs : AttitudeRuns
        Truth, readings, and the moments that were commanded: their mean over each cycle.
    time_s, theory_s : ndarray, shape (runs,)
        Time until the rate stays below 0.5 °/s for a minute, and its prediction by the mean torque; NaN if it is not
        reached within the run, and without torquers.
    """

    runs: AttitudeRuns
    time_s: FloatArray
    theory_s: FloatArray

    @property
    def last_rate_deg_s(self) -> FloatArray:
        """Rms rate of every run over the last ten minutes, against inertial space, shape (runs,)."""
        return np.degrees(np.sqrt(np.mean(np.sum(self._last(self.runs.w) ** 2, axis=-1), axis=1)))

    @property
    def last_off_field_deg(self) -> FloatArray:
        """Median over the last orbit of the angle between the axis z and the field, shape (runs,)."""
        b = quaternion.rotate_back(self.runs.q, self.runs.prepared.true_field_orbital_T)
        cosine = b[..., 2] / np.linalg.norm(b, axis=-1)
        return np.degrees(np.median(np.arccos(np.clip(self._last(cosine, ORBIT.period_s), -1.0, 1.0)), axis=1))

    def _last(self, values: FloatArray, seconds: float = 600.0) -> FloatArray:
        return values[:, -round(seconds / self.runs.dt_s) :]


def detumbling(
    seeds: Sequence[int],
    *,
    damping: Damping = "readings",
    rate_deg_s: float = 10.0,
    largest_Am2: float = 0.2,
    duty: float = 0.8,
    magnet_Am2: float = 0.0,
    rods: HysteresisRods = RODS,
    duration_s: float = 6000.0,
    advanced: Callable[[int], None] | None = None,
) -> Detumbling:
    """Simulate detumbling from rates in random directions, by torquers or by rods.

    Parameters
    ----------
    seeds : sequence of int
        One for each run.
    damping : str
        ``readings``: torquers with two readings of the magnetometer; ``estimate``: torquers with the rate of a filter
        of magnetometer, Sun sensor and gyro, after it has seen the Sun; ``rods``: no torquers.
    rate_deg_s : float
        Rate at the start, in a random direction.
    largest_Am2, duty : float
        Largest moment and duty cycle of the torquers; a cycle takes one second.
    magnet_Am2 : float
        Moment of a magnet along the axis z.
    rods : HysteresisRods
        Rods for ``rods``.
    duration_s : float
        Duration of every run.
    advanced : callable, optional
        Called with the number of steps finished since the last call.

    Returns
    -------
    Detumbling
        All runs, with the time that each takes and the predicted one.

    Examples
    --------
    >>> from sims import experiments
    >>> found = experiments.detumbling([0], rate_deg_s=1.0, duration_s=1500.0)
    >>> bool(found.time_s[0] < 1500.0)
    True
    """
    scenario = AttitudeScenario(
        three_units(residual_dipole_Am2=(0.0, 0.0, magnet_Am2)),
        conditions=ANYWHERE,
        duration_s=duration_s,
        torque_Nm=1e-8,
        torque_period_s=1000.0,  # a constant one about the magnet would spin the satellite up for days
        gyro_bias_rad_s=math.radians(0.02),
        rods=rods if damping == "rods" else None,
        start_attitude_rad=2.0,
    )
    directions = np.stack([stream(seed, "tumbling").standard_normal(3) for seed in seeds])
    w = math.radians(rate_deg_s) * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    prepared = replace(prepare(scenario, seeds), w=w)
    law = BDot(b_dot_gain(INERTIA_KGM2, float(prepared.environment.orbital_rate_rad_s[0, 0])), largest_Am2, duty)
    if damping == "rods":
        runs = simulate_motion(prepared)
        if advanced is not None:
            advanced(scenario.n_instants)
    else:
        command = _by_readings(law) if damping == "readings" else _by_estimate(law)
        runs = simulate_control(prepared, command, advanced)
    return Detumbling(
        runs,
        _time_below(np.linalg.norm(runs.w, axis=-1), scenario.dt_s),
        np.full(len(w), np.nan) if damping == "rods" else _time_below(_by_mean_torque(prepared, law), scenario.dt_s),
    )


def _by_readings(law: BDot) -> Command:
    """Return a command from readings: the mean over a cycle, in which torquers are on for a part."""

    def command(record: Record, row: int) -> FloatArray:
        field_T = record.readings.field_T
        before = field_T[:, row - 1] if row else np.full_like(field_T[:, 0], np.nan)
        return law.duty * law.moment_Am2(before, field_T[:, row], record.dt_s)

    return command


def _by_estimate(law: BDot) -> Command:
    """Return a command from the estimated rate, or from readings until the filter has started."""
    used = sensor_set("mag+sun+gyro", ["gyro-bias"])
    on_board, by_readings = _OnBoard(FilterSettings(used, tuned_noise(used))), _by_readings(law)

    def command(record: Record, row: int) -> FloatArray:
        state, started = on_board.update(record, row)
        around = record.environment
        b = quaternion.rotate_back(state.q, around.b_orbital_T[:, row])
        rate = relative_rate(state.q, state.w, around.orbital_rate_rad_s[:, row])
        return np.where(started[:, None], law.duty * law.moment_by_rate_Am2(b, rate), by_readings(record, row))

    return command


def _by_mean_torque(prepared: PreparedRuns, law: BDot) -> FloatArray:
    """Return the rate (runs, n) that the mean torque predicts."""
    eci_from_orbital = quaternion.conjugate(orbital_from_eci(prepared.environment))
    b_eci = quaternion.rotate(eci_from_orbital, prepared.true_field_orbital_T)
    eci_from_body = quaternion.multiply(eci_from_orbital[:, 0], prepared.q)
    H = quaternion.rotate(eci_from_body, prepared.w @ INERTIA_KGM2)
    return detumbled(law, H, b_eci, INERTIA_KGM2, prepared.scenario.dt_s) / INERTIA_KGM2.max()


class _OnBoard:
    """Error-state filter on board, without a gate; it starts when a run first sees field and Sun."""

    def __init__(self, settings: FilterSettings) -> None:
        self.settings = settings
        self.started: BoolArray | None = None
        self.state: AttitudeState | None = None

    def update(self, record: Record, row: int) -> tuple[AttitudeState, BoolArray]:
        """Process the readings of one instant; return the estimate, and which runs have started."""
        settings, readings = self.settings, record.readings
        both = is_read(readings.field_T[:, row]) & is_read(readings.sun[:, row])
        if self.state is None or self.started is None:
            state, begins = self._start(record, row, np.arange(len(both))), both
            self.started = both
        else:
            state, begins = predict(record, row - 1, self.state, settings)[0], both & ~self.started
            self.started = self.started | both
        if begins.any():
            fresh = self._start(record, row, np.flatnonzero(begins))
            state.q[begins], state.w[begins], state.P[begins] = fresh.q, fresh.w, fresh.P
            for name, values in fresh.optional.items():
                state.optional[name][begins] = values
        self.state, _ = update_state(record, row, state, settings)
        return self.state, self.started

    def _start(self, record: Record, row: int, runs: NDArray[np.intp]) -> AttitudeState:
        return initial_state(self.settings, vector_start(part(record, runs, slice(row, row + 1)), self.settings))


def _time_below(rate: FloatArray, step_s: float) -> FloatArray:
    """Return the time (runs,) from which rates stay low for a minute; NaN where they do not."""
    lasting = min(round(60.0 / step_s), rate.shape[1])
    largest = np.lib.stride_tricks.sliding_window_view(rate, lasting, axis=1).max(axis=-1)
    return np.where((largest < SLOW_RAD_S).any(axis=1), step_s * (largest < SLOW_RAD_S).argmax(axis=1), np.nan)
