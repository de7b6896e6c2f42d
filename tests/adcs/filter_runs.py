"""Runs for the tests of the filters: the source's set-up, and a truth that does exactly what a filter believes."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adcs import quaternion
from adcs.environment.orbit import circular_orbit
from adcs.kalman.error_state import (
    AttitudeTracks,
    FilterSettings,
    FilterStart,
    SensorSet,
    sensor_set,
    start_near,
)
from adcs.kalman.mekf import run_filter
from adcs.kalman.process_noise import tuned_noise
from adcs.satellite import dynamics
from adcs.satellite.satellite import Satellite
from adcs.satellite.telemetry import Record
from sims.attitude.scenario import AttitudeScenario, StartConditions
from sims.attitude.simulation import AttitudeRuns, PreparedRuns, prepare, simulate, start_estimates
from sims.experiments.attitude import Part, outcome_of
from tests.adcs.attitudes import commanded_torque, random_attitudes
from tests.adcs.kalman.readable import run_readable

Array = NDArray[np.float64]
START_RAD, START_RAD_S = math.radians(5.0), math.radians(0.1)
GYRO_BIAS_RAD_S, FIELD_BIAS_T = math.radians(0.027), 500e-9
SEEDS = range(10)
ANY_START = StartConditions(sunlit=False, least_separation_rad=0.0, least_field_T=0.0)
"""No condition at all."""


TABLETSAT_INERTIA_KGM2 = ((0.519, 0.002, 0.005), (0.002, 0.579, 0.009), (0.005, 0.009, 0.71))


def tabletsat(duration_s: float = 200.0, local_time_h: float = 15.0) -> AttitudeScenario:
    """TabletSat-Aurora as in Ivanov et al., Keldysh Institute preprint 64, 2014, with what it leaves open filled in.

    A circular orbit of 600 km and 97.8° on 2014-09-01; a constant torque of 8e-7 N·m; sensors of Table 1. Orbit, date,
    gains and the conditions of the start are ours.
    ``local_time_h``: mean solar time of the ascending node. With 15 h Sun and field never come nearer to each other
    than 31° in sunlight; with 13 h they come as near as 1.2°.
    """
    orbit = circular_orbit(altitude_m=600e3, inclination_deg=97.8, epoch="2014-09-01", local_time_h=local_time_h)
    satellite = Satellite(inertia_kgm2=TABLETSAT_INERTIA_KGM2, orbit=orbit)
    return AttitudeScenario(satellite, duration_s=duration_s, torque_Nm=8e-7)


def settings(sensors: str, states: Iterable[str] = ()) -> FilterSettings:
    used = sensor_set(sensors, states)
    return FilterSettings(used, tuned_noise(used))


def scenario_for(used: SensorSet, duration_s: float) -> AttitudeScenario:
    """A bias is there where the filter estimates it."""
    return replace(
        tabletsat(duration_s),
        gyro_bias_rad_s=GYRO_BIAS_RAD_S if "gyro-bias" in used.states else 0.0,
        field_bias_T=FIELD_BIAS_T if "field-bias" in used.states else 0.0,
    )


def start_of(runs: AttitudeRuns, attitude_rad: float = START_RAD, rate_rad_s: float = START_RAD_S) -> FilterStart:
    q, w = start_estimates(runs.prepared, attitude_rad, rate_rad_s)
    return start_near(q, w, attitude_rad, rate_rad_s)


def runs_for(used: SensorSet, duration_s: float, seeds: Iterable[int] = SEEDS) -> tuple[AttitudeRuns, FilterStart]:
    runs = simulate(scenario_for(used, duration_s), list(seeds))
    return runs, start_of(runs)


def evaluate(runs: AttitudeRuns, estimates: AttitudeTracks) -> dict[str, Any]:
    """Accuracy over the last minute, as ``adcs run --json`` prints it."""
    return outcome_of(Part(runs, estimates)).numbers()


def assert_as_readable(record: Record, chosen: FilterSettings, start: FilterStart) -> AttitudeTracks:
    """Tracks by the kernel, which must be those of the readable filter."""
    fast, slow = run_filter(record, chosen, start), run_readable(record, chosen, start)
    np.testing.assert_allclose(fast.q, slow.q, rtol=0, atol=1e-13)
    assert list(fast.states) == list(slow.states)
    scales = {"field-bias": 1e-6, "disturbance": 1e-6, "field-model": 1e-6, "dipole": 0.1}
    for name, values in slow.states.items():
        np.testing.assert_allclose(fast.states[name], values, rtol=0, atol=1e-10 * scales.get(name, 1e-3))
    by_deviations = slow.sigma[..., :, None] * slow.sigma[..., None, :]
    np.testing.assert_allclose(fast.covariance / by_deviations, slow.covariance / by_deviations, rtol=0, atol=1e-9)
    np.testing.assert_allclose(fast.nis, slow.nis, rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(fast.log_det, slow.log_det, rtol=1e-7, atol=1e-9)
    return fast


def followed(prepared: PreparedRuns) -> AttitudeRuns:
    """Truth and readings from the start and the torques of ``prepared``, which may have been changed."""
    satellite, around = prepared.scenario.satellite, prepared.environment
    states, torques = [(prepared.q, prepared.w, prepared.momentum_Nms)], []
    n = prepared.torque_Nm.shape[1]
    for row in range(n):
        rate = around.orbital_rate_rad_s[:, row]
        torques.append(
            commanded_torque(
                satellite.body, satellite.control, *states[row], quaternion.IDENTITY, rate, prepared.scenario.dt_s
            )
        )
        if row < n - 1:
            states.append(
                dynamics.step(
                    satellite.body,
                    *states[row],
                    torques[row],
                    prepared.torque_Nm[:, row],
                    rate,
                    around.gravity_s2[:, row],
                    prepared.true_field_orbital_T[:, row],
                    prepared.scenario.dt_s,
                    prepared.dipole_Am2[:, row],
                )
            )
    q, w, momentum = (np.stack(part, axis=1) for part in zip(*states, strict=True))
    return AttitudeRuns.of(prepared, q, w, momentum, np.stack(torques, axis=1))


def believed_runs(filter_settings: FilterSettings, duration_s: float, seeds: range) -> AttitudeRuns:
    """Runs whose disturbances and biases are random walks with the filter's own process noise and start deviations."""
    noise = filter_settings.noise
    used = filter_settings.sensors
    prepared = prepare(replace(tabletsat(duration_s), torque_Nm=0.0), seeds)
    shape = prepared.torque_Nm.shape
    rng = np.random.default_rng(seeds[0])

    def walk(start: float, step: float) -> Array:
        steps = step * rng.standard_normal(shape)
        steps[:, 0] = start * rng.standard_normal((shape[0], 3))
        return np.cumsum(steps, axis=1)

    body, dt_s = prepared.scenario.satellite.body, prepared.scenario.dt_s
    acceleration = noise.rate_rad_s / dt_s * rng.standard_normal(shape)
    if "disturbance" in used.states:
        acceleration = acceleration + walk(filter_settings.disturbance_sigma_s2, noise.disturbance_s2)
    changed = replace(prepared, torque_Nm=acceleration @ body.inertia_kgm2)
    if "dipole" in used.states:
        changed = replace(changed, dipole_Am2=walk(filter_settings.dipole_sigma_Am2, noise.dipole_Am2))
    if "field-gain" in used.states:
        deviation = np.where(np.eye(3), filter_settings.field_gain_sigma, filter_settings.field_axes_sigma_rad)
        changed = replace(changed, field_gain=deviation * rng.standard_normal((shape[0], 3, 3)))
    if "gyro-bias" in used.states:
        changed = replace(changed, gyro_bias_rad_s=walk(filter_settings.gyro_bias_sigma_rad_s, noise.gyro_bias_rad_s))
    if "field-bias" in used.states:
        changed = replace(changed, field_bias_T=walk(filter_settings.field_bias_sigma_T, noise.field_bias_T))
    return followed(changed)


def tumbled(duration_s: float, seeds: range, conditions: StartConditions | None = None) -> AttitudeRuns:
    """Runs whose true attitude is uniform over all rotations at the start."""
    prepared = prepare(replace(tabletsat(duration_s), conditions=conditions or StartConditions()), seeds)
    q = random_attitudes(len(seeds), np.random.default_rng(seeds[0]))
    rest = dynamics.absolute_rate(q, np.zeros((len(seeds), 3)), prepared.environment.orbital_rate_rad_s[:, 0])
    return followed(replace(prepared, q=q, w=rest))


def unlike_stars(runs: AttitudeRuns, worse: float = 20.0) -> AttitudeRuns:
    """Runs whose star cameras look elsewhere every time, and tell the turn about that some times worse."""
    axes = random_attitudes(runs.q.size // 4, np.random.default_rng(40)).reshape(runs.q.shape)
    unlike = np.swapaxes(quaternion.matrix(axes), -1, -2) * np.array([1.0, 1.0, 1.0 / worse])[:, None]
    error = quaternion.error_vector(runs.q, runs.readings.star)
    worsened = quaternion.from_error_vector((np.linalg.inv(unlike) @ error[..., None])[..., 0])
    star = np.where(np.isnan(error[..., :1]), np.nan, quaternion.multiply(runs.q, worsened))
    return replace(runs, readings=replace(runs.readings, star=star, star_whitening=unlike))
