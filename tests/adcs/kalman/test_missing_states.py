"""A tumbling CubeSat whose torques nobody stated: what is claimed, and which states the warning names.

The oracles: the truth of a compiled simulation, and χ². A mean NEES of a run is that of some hundred independent
errors, so that 3 is beyond any chance.
"""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

import adcs
from adcs import quaternion
from adcs.environment.orbit import circular_orbit
from adcs.kalman.error_state import sensor_set
from adcs.kalman.names import grouped_states
from adcs.kalman.process_noise import tuned_noise
from adcs.satellite.dynamics import WheelControl
from adcs.satellite.satellite import Satellite
from adcs.satellite.sensors import Gyro, Magnetometer, StarTracker, SunSensor
from adcs.satellite.telemetry import orbital_from_eci
from sims.attitude.scenario import AttitudeScenario
from sims.attitude.simulation import AttitudeRuns, prepare, simulate_motion
from tests.adcs.filter_runs import ANY_START, TABLETSAT_INERTIA_KGM2

INERTIA_KGM2 = np.diag([0.033, 0.034, 0.006])
ALL, STATES = "st+gyro+mag+sun", ("gyro-bias", "magnetometer")


def cubesat(dipole_Am2: float, seed: int, walk_deg_s_rts: float = 2e-5) -> AttitudeRuns:
    """An orbit of three units without wheels that tumble at 0.3 °/s, with a dipole of random direction."""
    orbit = circular_orbit(altitude_m=500e3, inclination_deg=97.4, local_time_h=13.0, epoch="2024-03-02")
    satellite = Satellite(
        inertia_kgm2=INERTIA_KGM2,
        orbit=orbit,
        control=WheelControl(np.zeros(3), np.zeros(3)),
        star_tracker=StarTracker(sigma_rad=np.radians(0.01) / 2.0),
        gyro=Gyro(sigma_rad_s=np.radians(0.01), bias_walk_rad_s=np.radians(walk_deg_s_rts)),
        magnetometer=Magnetometer(sigma_T=150e-9),
        sun_sensor=SunSensor(sigma_rad=np.radians(1.0)),
    )
    scenario = AttitudeScenario(
        satellite,
        conditions=ANY_START,
        duration_s=6000.0,
        dt_s=2.0,
        torque_Nm=2e-8,
        gyro_bias_rad_s=np.radians(0.03),
        field_bias_T=800e-9,
        field_gain=0.02,
        field_axes_rad=np.radians(0.5),
        start_attitude_rad=2.0,
        start_rate_rad_s=np.radians(0.3),
    )
    prepared = prepare(scenario, [seed])
    direction = np.random.default_rng(seed).normal(size=3)
    dipole = dipole_Am2 * direction / np.linalg.norm(direction)
    return simulate_motion(replace(prepared, dipole_Am2=np.broadcast_to(dipole, prepared.dipole_Am2.shape).copy()))


def estimated(runs: AttitudeRuns, sensors: str, states: tuple[str, ...]) -> adcs.AttitudeTrack:
    wanted = [state for state in states if state != "magnetometer" or "mag" in sensors]
    log = adcs.Telemetry.of(runs, runs.satellite.start)
    return adcs.estimate(log, runs.satellite, sensors=sensors, states=wanted)


def nees(runs: AttitudeRuns, track: adcs.AttitudeTrack) -> float:
    """Mean square of the attitude's error over σ, per axis, after the first five minutes."""
    true = quaternion.multiply(quaternion.conjugate(orbital_from_eci(runs.environment)[0]), runs.q[0])
    error = 2.0 * quaternion.error_vector(track.q, true[-len(track) :])
    return float(np.mean((error / track.sigma["attitude"])[150:] ** 2))


def named(track: adcs.AttitudeTrack) -> tuple[str, ...]:
    """States of the line that the warning gives; none without it."""
    found = re.findall(r"states = \[(.*?)\] in the table estimate", " ".join(track.warnings))
    return tuple(re.findall(r'"(.*?)"', found[0])) if found else ()


@pytest.mark.parametrize("sensors", [ALL, "st+gyro", "mag+sun+gyro"])
@pytest.mark.parametrize("dipole_Am2", [0.0, 0.005])
def test_no_state_of_a_torque(sensors: str, dipole_Am2: float) -> None:
    """TabletSat-Aurora, for which noise is tuned, turns 80 times more slowly by the same torque."""
    for seed in (9100, 9101):
        runs = cubesat(dipole_Am2, seed)
        assert nees(runs, estimated(runs, sensors, STATES)) < 3.0


@pytest.mark.parametrize("sensors", [ALL, "st+gyro", "mag+sun+gyro"])
def test_a_large_dipole_is_named(sensors: str) -> None:
    for seed in (9200, 9201):
        runs = cubesat(0.05, seed)
        first = estimated(runs, sensors, STATES)
        states = named(first)
        assert {"dipole"} <= set(states) or nees(runs, first) < 3.0
        cured = estimated(runs, sensors, states or (*STATES, "disturbance", "dipole"))
        assert nees(runs, cured) < 3.0
        assert named(cured) == ()
        size = np.linalg.norm(cured.states["dipole"][-1])
        assert size == pytest.approx(0.05, rel=0.05)


def test_nothing_is_named_where_readings_fit() -> None:
    runs = cubesat(0.0, 9300)
    assert named(estimated(runs, ALL, (*STATES, "disturbance", "dipole"))) == ()


def test_an_orbit_that_is_off_is_named() -> None:
    """By 60 km along the track: the field is 1° off for many minutes, which no torque explains."""
    runs = cubesat(0.0, 9400)
    log, orbit = adcs.Telemetry.of(runs, runs.satellite.start), runs.satellite.orbit
    off = replace(runs.satellite, orbit=replace(orbit, latitude_argument_rad=np.radians(0.5)))
    track = adcs.estimate(log, off, sensors="mag+sun+gyro", states=STATES)
    assert "field-model" in named(track)


def test_a_stated_walk_of_the_bias_is_followed() -> None:
    """NEES of the gyro's bias, which walks by 0.03 °/s in an orbit; with a constant bias it would be over 1,000."""
    runs = cubesat(0.005, 9500, walk_deg_s_rts=4e-4)
    track = estimated(runs, "st+gyro", (*STATES, "disturbance", "dipole"))
    error = track.states["gyro-bias"] - runs.prepared.gyro_bias_rad_s[0, -len(track) :]
    assert 0.5 < np.mean((error / track.sigma["gyro-bias"])[150:] ** 2) < 1.5


def test_noise_grows_as_inertia_falls() -> None:
    used = sensor_set("st+gyro", ["gyro-bias"])
    assert tuned_noise(used, TABLETSAT_INERTIA_KGM2) == tuned_noise(used)
    assert tuned_noise(used, INERTIA_KGM2).rate_rad_s == pytest.approx(0.5 / 0.006 * tuned_noise(used).rate_rad_s)


def test_states_are_named_as_they_are_written() -> None:
    used = sensor_set(ALL, ("disturbance", "magnetometer", "gyro-bias"))
    assert grouped_states(used.states) == ["magnetometer", "gyro-bias", "disturbance"]
    assert grouped_states(["field-bias"]) == ["field-bias"]
