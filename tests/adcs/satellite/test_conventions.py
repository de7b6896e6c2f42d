"""Logs that are misread are named by what they are misread as; those that are right, or just bad, are left alone."""

import math
from dataclasses import replace

import numpy as np
import pytest

import adcs
from adcs.environment.orbit import Sgp4Orbit
from sims.attitude.simulation import simulate
from tests.adcs.filter_runs import tabletsat

SENSORS = "st+gyro+mag+sun"


@pytest.fixture(scope="module")
def flight():
    runs = simulate(tabletsat(300.0), [0])
    return adcs.Telemetry.of(runs, runs.satellite.start), runs.satellite


def changed(log, **values):
    given = {name: getattr(log, name) for name in ("star", "gyro_rad_s", "field_T", "sun", "wheels_Nms", "step_s")}
    return adcs.Telemetry(log.time_s, **(given | values))


MANGLED = {
    "the star tracker, scalar last taken for scalar first": lambda log: {"star": np.roll(log.star, -1, axis=1)},
    "the star tracker, scalar first taken for scalar last": lambda log: {"star": np.roll(log.star, 1, axis=1)},
    "the star tracker, body from inertial taken for inertial from": lambda log: {"star": log.star * [-1, -1, -1, 1]},
    "the magnetometer in µT taken for nT": lambda log: {"field_T": 1e-3 * log.field_T},
    "the magnetometer in nT taken for µT": lambda log: {"field_T": 1e3 * log.field_T},
    "the magnetometer in mG taken for nT": lambda log: {"field_T": 1e-2 * log.field_T},
    "the gyro in rad/s taken for °/s": lambda log: {"gyro_rad_s": np.radians(log.gyro_rad_s)},
    "the gyro in °/s taken for rad/s": lambda log: {"gyro_rad_s": np.degrees(log.gyro_rad_s)},
    "the gyro, all its signs reversed": lambda log: {"gyro_rad_s": -log.gyro_rad_s},
    "the Sun sensor, all its signs reversed": lambda log: {"sun": -log.sun},
    "the magnetometer, its axis z reversed": lambda log: {"field_T": log.field_T * [1, 1, -1]},
    "the magnetometer, its axes x and y exchanged": lambda log: {"field_T": log.field_T[:, [1, 0, 2]]},
}


class TestMangled:
    @pytest.mark.parametrize("name", MANGLED)
    def test_is_named(self, flight, name):
        log, satellite = flight
        with pytest.raises(ValueError, match="must agree with itself and with the orbit") as refused:
            adcs.estimate(changed(log, **MANGLED[name](log)), satellite, sensors=SENSORS)
        assert name in str(refused.value)

    @pytest.mark.slow_after(4)
    @pytest.mark.parametrize("name", [name for name in MANGLED if "star" not in name])
    def test_is_named_without_a_star_tracker(self, flight, name):
        log, satellite = flight
        with pytest.raises(ValueError, match="must agree") as refused:
            adcs.estimate(changed(log, **MANGLED[name](log)), satellite, sensors="mag+sun+gyro")
        assert name in str(refused.value)

    @pytest.mark.parametrize("days", [-40, 60, 850])
    def test_old_elements_are_no_misreading(self, caplog, days):
        """A good log of a satellite that is elsewhere than its elements say; what contradicts itself is named still."""
        line2 = "2 99017  97.4000 210.7000 0008000  80.0000 280.0000 15.24000000 12346"
        old = Sgp4Orbit(
            "1 99017U 23999A   24080.50000000  .00020000  00000-0  65000-3 0  9993", line2, allow_old_elements=True
        )
        start = old.epoch + np.timedelta64(days, "D")
        orbit = adcs.circular_orbit(altitude_m=480e3, inclination_deg=97.4, local_time_h=15.0, epoch=start)
        there = replace(tabletsat(300.0).satellite, orbit=orbit, start=start)
        log = adcs.Telemetry.of(simulate(replace(tabletsat(300.0), satellite=there), [0]), start)
        believed = replace(there, orbit=old)
        adcs.estimate(log, believed, sensors="mag+sun+gyro")
        assert "days from the epoch 2024-03-20T12:00:00 of the two-line elements" in caplog.text
        with pytest.raises(ValueError, match="the gyro in rad/s taken for °/s"):
            adcs.estimate(changed(log, gyro_rad_s=np.radians(log.gyro_rad_s)), believed, sensors="st+gyro")

    def test_vectors_too(self, flight):
        log, satellite = flight
        with pytest.raises(ValueError, match="the Sun sensor, all its signs reversed"):
            adcs.vector_attitude(changed(log, sun=-log.sun), satellite)


class TestLeftAlone:
    @pytest.mark.parametrize(
        "values",
        [
            lambda log: {},
            lambda log: {"field_T": 1.1 * log.field_T + 3e-6},
            lambda log: {"gyro_rad_s": log.gyro_rad_s + math.radians(0.05)},
            lambda log: {"sun": np.where(np.arange(len(log.sun))[:, None] % 3 == 0, -log.sun, log.sun)},
        ],
        ids=["right", "uncalibrated field", "gyro with a bias", "a third of the Sun's readings wild"],
    )
    def test_a_log_that_is_only_bad(self, flight, values):
        log, satellite = flight
        adcs.estimate(changed(log, **values(log)), satellite, sensors=SENSORS, states=["gyro-bias"])

    @pytest.mark.parametrize(("local_time_h", "latitude_deg"), [(15.0, 90.0), (3.0, 180.0)])
    def test_a_wrong_orbit_is_no_misread_axis(self, flight, local_time_h, latitude_deg):
        """Axes keep the modulus, so that a modulus off by over 15 % must put the orbit before the axes."""
        log, satellite = flight
        orbit = adcs.circular_orbit(
            altitude_m=600e3,
            inclination_deg=20.0,
            local_time_h=local_time_h,
            latitude_argument_deg=latitude_deg,
            epoch=satellite.start,
        )
        with pytest.raises(ValueError, match="Check the orbit: start, altitude"):
            adcs.estimate(log, replace(satellite, orbit=orbit), sensors="mag+sun+gyro", states=["gyro-bias"])

    @pytest.mark.parametrize(("gain", "words"), [(1.0, ""), (1.08, "check the orbit too"), (1.13, "Check the orbit")])
    def test_a_modulus_that_is_off_names_the_orbit(self, flight, gain, words):
        """Exchanged axes, and a modulus that they do not explain."""
        log, satellite = flight
        with pytest.raises(ValueError, match="undo") as refused:
            adcs.estimate(changed(log, field_T=gain * log.field_T[:, [1, 0, 2]]), satellite, sensors=SENSORS)
        assert words in str(refused.value)
        assert "its axes x and y exchanged" in str(refused.value)
        assert ("orbit too" in str(refused.value)) == (gain == 1.08)

    def test_a_wrong_orbit_that_no_axis_explains_is_a_warning(self, flight):
        log, satellite = flight
        orbit = adcs.circular_orbit(altitude_m=1500e3, inclination_deg=97.8, local_time_h=15.0, epoch=satellite.start)
        wrong = adcs.estimate(log, replace(satellite, orbit=orbit), sensors="mag+gyro")
        right = adcs.estimate(log, satellite, sensors="mag+gyro")
        assert "check the start, altitude" in " ".join(wrong.warnings)
        assert "check the start, altitude" not in " ".join(right.warnings)

    def test_a_sensor_that_is_not_used(self, flight):
        log, satellite = flight
        adcs.estimate(changed(log, field_T=1e-3 * log.field_T), satellite, sensors="st+gyro")
