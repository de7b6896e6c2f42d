"""Simulated flights: their readings against their own attitude."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import sims

QUIET = sims.FlightSettings(
    duration_s=60.0,
    noise_T=0.0,
    slow_noise_T=0.0,
    gyro_noise_rad_s=0.0,
    gyro_walk_rad_s=0.0,
    gyro_bias_rad_s=0.0,
    gyro_scale=0.0,
    force_noise_m_s2=0.0,
    force_offset_m_s2=0.0,
)


@pytest.fixture(scope="module")
def flight():
    return sims.simulate_flight(4, QUIET)


def test_gyro_integrates_to_the_attitude(flight):
    turned = flight.rotation[0]
    for rate in flight.log.gyro_rad_s[1:]:
        turned = turned * Rotation.from_rotvec(0.01 * rate)
    assert (turned.inv() * flight.rotation[-1]).magnitude() < 1e-9


def test_force_is_gravity_and_a_bounded_velocity(flight):
    """The mean of the force in the world is gravity plus the change of velocity over the time."""
    world = flight.rotation.apply(flight.log.acceleration_m_s2)
    mean = world.mean(axis=0) - [0.0, 0.0, 9.80665]
    assert np.abs(mean).max() < 40.0 / 60.0
    assert np.ptp(np.cumsum(world[:, :2] - world[:, :2].mean(axis=0), axis=0) * 0.01, axis=0).max() < 60.0


def test_tilt_and_readings(flight):
    tilt = np.degrees(np.arccos(flight.rotation.apply([0.0, 0.0, 1.0])[:, 2]))
    assert tilt.max() == pytest.approx(25.0, abs=0.5)
    series, log = flight.log.magnetometers[0], flight.log
    rows = np.arange(100, 2000, 7)
    at = np.searchsorted(log.time_s, series.time_s[rows] - 0.03) - 1
    body = flight.rotation[at].inv().apply(QUIET.field_T)
    model = body @ flight.scale[0].T + flight.offset_T[0] + log.currents[0].values[at, None] * flight.current_T_A[0]
    # Within a step of 10 ms the field turns by less than a degree.
    assert np.abs(series.values[rows] - model).max() < 0.02 * np.linalg.norm(QUIET.field_T)
