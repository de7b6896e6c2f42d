"""Logs of inertial units that are misread are named by what they are misread as; right ones are not named."""

import numpy as np
import pytest

from adcs.complementary.inertial_magnetic import InertialMagneticRecord, check_units
from tests.adcs.complementary.inertial.units import unit_log

MANGLED = {
    "the gyro in rad/s taken for °/s": lambda t, g, a, m: (t, np.radians(g), a, m),
    "the gyro in °/s taken for rad/s": lambda t, g, a, m: (t, np.degrees(g), a, m),
    "the gyro, all its signs reversed": lambda t, g, a, m: (t, -g, a, m),
    "the gyro, its axis z reversed": lambda t, g, a, m: (t, g * [1, 1, -1], a, m),
    "the gyro, its axes in the order z, x, y": lambda t, g, a, m: (t, g[:, [2, 0, 1]], a, m),
    "the magnetometer, its axes in the order y, x, -z": lambda t, g, a, m: (t, g, a, m[:, [1, 0, 2]] * [1, 1, -1]),
    "the magnetometer, its axis x reversed": lambda t, g, a, m: (t, g, a, m * [-1, 1, 1]),
    "the accelerometer, its axes x and y exchanged": lambda t, g, a, m: (t, g, a[:, [1, 0, 2]], m),
    "the time in ms taken for s": lambda t, g, a, m: (1e3 * t, g, a, m),
    "the time in µs taken for s": lambda t, g, a, m: (1e6 * t, g, a, m),
    "the accelerometer in g taken for m/s²": lambda t, g, a, m: (t, g, a / 9.80665, m),
    "the accelerometer in m/s² taken for g": lambda t, g, a, m: (t, g, a * 9.80665, m),
    "the magnetometer in µT taken for nT": lambda t, g, a, m: (t, g, a, 1e-3 * m),
    "the magnetometer in mG taken for nT": lambda t, g, a, m: (t, g, a, 1e-2 * m),
    "the magnetometer in G taken for nT": lambda t, g, a, m: (t, g, a, 1e-5 * m),
}


class TestMangled:
    @pytest.mark.parametrize("name", MANGLED)
    @pytest.mark.parametrize("seed", [0, 1])
    def test_is_named(self, seed, name):
        *readings, _ = unit_log(seed, 40.0, acceleration=0.1)
        with pytest.raises(ValueError, match="Input ") as refused:
            check_units(InertialMagneticRecord(*MANGLED[name](*readings)))
        assert name in str(refused.value)

    def test_without_gravity(self):
        readings = list(unit_log(2)[:4])
        still = unit_log(2, acceleration=0.0)[2]
        readings[2] = readings[2] - still + 0.01
        with pytest.raises(ValueError, match=r"must include gravity.*without gravity"):
            check_units(InertialMagneticRecord(*readings))

    def test_without_a_magnetometer(self):
        time_s, rates, accelerations, field, _ = unit_log(0, 40.0, acceleration=0.1)
        with pytest.raises(ValueError, match="the gyro in rad/s taken for °/s"):
            check_units(InertialMagneticRecord(time_s, np.radians(rates), accelerations, np.full_like(field, np.nan)))


class TestLeftAlone:
    @pytest.mark.slow_after(20)
    @pytest.mark.parametrize("seed", range(100))
    def test_right_logs(self, seed):
        """Slow and fast, calm and shaken, near magnets; 0 refused of 100: a rate below 3 % with 95 % confidence."""
        rng = np.random.default_rng(seed)
        made = {"dt": rng.choice([0.01, 0.04, 0.08]), "rate": rng.choice([0.02, 0.3, 1.5])}
        made |= {"seconds": rng.choice([10.0, 40.0]), "acceleration": rng.choice([0.05, 0.5, 2.0])}
        time_s, rates, accelerations, field, _ = unit_log(seed, **made)
        if seed % 3 == 0:  # a magnet on the unit, or beside it, for half of the time
            field = field + 20e-6 * rng.standard_normal(3) * (time_s > 0.5 * time_s[-1])[:, None]
        check_units(InertialMagneticRecord(time_s, rates, accelerations, field))
