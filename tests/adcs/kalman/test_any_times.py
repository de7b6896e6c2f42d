"""Logs whose times jitter, have gaps, or whose sensors have rates of their own."""

from dataclasses import replace

import numpy as np
import pytest

import adcs
from adcs import quaternion
from adcs.kalman.bank import EstimatorSettings
from adcs.satellite.telemetry import orbital_from_eci
from sims.attitude.simulation import simulate
from tests.adcs.filter_runs import assert_as_readable, start_of, tabletsat

FINE_S, EVERY = 0.05, 20
SENSORS = ("mag+sun+gyro", "st+gyro")


@pytest.fixture(scope="module")
def fine():
    """A run with a row every 50 ms; noise is added once rows are chosen."""
    return simulate(replace(tabletsat(300.0), dt_s=FINE_S), [0])


def log_of(runs, rows, seed, step_s=1.0):
    """Readings at some rows, with the noise of a seed: the same for every choice of as many rows."""
    satellite, rng, n = runs.satellite, np.random.default_rng(seed), len(rows)
    q, around = runs.q[0, rows], runs.environment
    noise = rng.standard_normal((4, n, 3))
    eci_from_orbital = quaternion.conjugate(orbital_from_eci(around)[0, rows])
    star = quaternion.multiply(q, quaternion.exp(2.0 * satellite.star_tracker.sigma_rad * noise[0]))
    start_s = (around.utc[0, 0] - satellite.start) / np.timedelta64(1, "s")
    return adcs.Telemetry(
        start_s + around.time_s[rows],
        star=quaternion.multiply(eci_from_orbital, star)[:, [1, 2, 3, 0]],
        gyro_rad_s=runs.w[0, rows] + satellite.gyro.sigma_rad_s * noise[1],
        field_T=quaternion.rotate_back(q, around.b_orbital_T[0, rows]) + satellite.magnetometer.sigma_T * noise[2],
        sun=quaternion.rotate_back(q, around.sun_orbital[0, rows]) + satellite.sun_sensor.sigma_rad * noise[3],
        wheels_Nms=runs.momentum_Nms[0, rows],
        step_s=step_s,
    )


def rms_deg(runs, rows, track):
    """Of the attitude in the second half of the rows."""
    eci_from_orbital = quaternion.conjugate(orbital_from_eci(runs.environment)[0, rows])
    true = quaternion.multiply(eci_from_orbital, runs.q[0, rows])
    error = np.degrees(quaternion.angle_between(track.q[track.rows], true))
    return np.sqrt(np.mean(error[len(error) // 2 :] ** 2))


class TestJitter:
    @pytest.mark.parametrize("sensors", SENSORS)
    def test_as_good_as_the_grid(self, fine, sensors):
        """Times off by up to 0.2 s, the same noise, eight draws of it: within 5 % in the mean."""
        states = ["gyro-bias", "disturbance"]
        grid = np.arange(EVERY, len(fine.time_s) - EVERY, EVERY)
        rms = []
        for seed in range(8):
            jitter = np.random.default_rng(100 + seed).integers(-4, 5, len(grid))
            rms.append(
                [
                    rms_deg(
                        fine,
                        rows,
                        adcs.estimate(log_of(fine, rows, seed), fine.satellite, sensors=sensors, states=states),
                    )
                    for rows in (grid, grid + jitter)
                ]
            )
        on_grid, jittered = np.mean(rms, axis=0)
        assert jittered == pytest.approx(on_grid, rel=0.05)

    def test_taken_for_the_grid_it_is_much_worse(self, fine):
        """What the figure above is worth: the same readings under the times of the grid."""
        grid = np.arange(EVERY, len(fine.time_s) - EVERY, EVERY)
        rows = grid + np.random.default_rng(100).integers(-4, 5, len(grid))
        log = log_of(fine, rows, 0)
        wrong = adcs.Telemetry(
            log.time_s[0] + np.arange(len(grid)), star=log.star, gyro_rad_s=log.gyro_rad_s, wheels_Nms=log.wheels_Nms
        )
        rms = [
            rms_deg(fine, rows, adcs.estimate(given, fine.satellite, sensors="st+gyro", states=["gyro-bias"]))
            for given in (log, wrong)
        ]
        assert rms[1] > 2.0 * rms[0]


class TestGapsAndRates:
    def test_several_rates(self, fine):
        """A gyro at 4 Hz, a star tracker now and then between its samples: better than the rows of both alone."""
        rows = np.arange(0, len(fine.time_s), 5)
        rare = np.arange(7, len(fine.time_s), 97)
        together = np.union1d(rows, rare)
        log = log_of(fine, together, 0)
        star = np.where(np.isin(together, rare)[:, None], log.star, np.nan)
        gyro = np.where(np.isin(together, rows)[:, None], log.gyro_rad_s, np.nan)
        mixed = adcs.Telemetry(log.time_s, star=star, gyro_rad_s=gyro, wheels_Nms=log.wheels_Nms, step_s=1.0)
        track = adcs.estimate(mixed, fine.satellite, sensors="st+gyro", states=["gyro-bias"])
        begun = together[len(together) - len(track.rows) :]
        assert rms_deg(fine, begun, track) < 0.01

    def test_a_gap(self, fine):
        """It is filled by steps of the usual length."""
        rows = np.concatenate([np.arange(3, 2000, 21), np.arange(2601, 5900, 21)])
        states = ["gyro-bias", "disturbance"]
        track = adcs.estimate(log_of(fine, rows, 1), fine.satellite, sensors="st+gyro", states=states)
        assert np.diff(track.time_s).max() < 1.5
        assert len(track.rows) == len(rows)
        assert rms_deg(fine, rows, track) < 0.01

    def test_constant_gain_is_refused(self, fine):
        rows = np.array([0, 20, 41, 60])
        with pytest.raises(ValueError, match="equal steps for a constant gain"):
            adcs.estimate(log_of(fine, rows, 0), fine.satellite, sensors="st", filter="constant-gain")


class TestTwins:
    def test_agree_in_any_steps(self, fine):
        rows = np.cumsum(np.random.default_rng(3).integers(3, 40, 120))
        record = log_of(fine, rows, 2).record(fine.satellite)
        chosen = EstimatorSettings.of("mag+sun+gyro", ["gyro-bias", "disturbance", "field-model"]).settings
        start = start_of(simulate(tabletsat(1.0), [0]))
        assert_as_readable(record, chosen, start)
