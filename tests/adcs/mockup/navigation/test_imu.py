"""Gyro and inclinometer."""

from __future__ import annotations

import math

import numpy as np
import pytest

from adcs.mockup.navigation.imu import G_M_S2, Inclinometer, RateGyro

GYRO = RateGyro(zero_rad_s=math.radians(0.3))


class TestReadings:
    def test_a_zero_is_linear_in_temperature(self) -> None:
        warm = Inclinometer(zero_m_s2=np.array([0.01, 0.0]), zero_slope_m_s2_K=np.array([3e-4, -3e-4]))
        readings = warm.readings(np.zeros((3, 2)), np.zeros((3, 2)), [20.0, 30.0, -10.0])
        np.testing.assert_allclose(readings, [[0.01, 0.0], [0.013, -0.003], [0.001, 0.009]])
        gyro = RateGyro(zero_rad_s=1e-3, zero_slope_rad_s_K=1e-4)
        np.testing.assert_allclose(gyro.readings([0.0, 0.0], [0.0, 0.0], [20.0, 60.0]), [1e-3, 5e-3])

    def test_a_tilted_axis_feels_gravity(self) -> None:
        tilted = Inclinometer(tilt_rad=np.array([math.radians(1.0), 0.0]))
        np.testing.assert_allclose(tilted.readings([0.0, 0.0], [0.0, 0.0]), [G_M_S2 * math.sin(math.radians(1.0)), 0.0])

    def test_noise_has_the_stated_size(self) -> None:
        noise = np.random.default_rng(1).standard_normal((1000, 2))
        np.testing.assert_allclose(Inclinometer().readings(np.zeros((1000, 2)), noise), 0.002 * noise)
        np.testing.assert_allclose(RateGyro().readings(np.zeros(1000), noise[:, 0]), math.radians(0.1) * noise[:, 0])

    def test_beyond_the_range_there_is_no_reading(self) -> None:
        limit = 0.26 * G_M_S2
        readings = Inclinometer().readings([[limit - 1e-9, limit + 1e-9], [-limit - 1e-9, 0.0]], np.zeros((2, 2)))
        np.testing.assert_array_equal(np.isnan(readings), [[False, True], [True, False]])
        rates = RateGyro().readings(np.radians([299.9, 300.1, -300.1]), np.zeros(3))
        np.testing.assert_array_equal(np.isnan(rates), [False, True, True])

    def test_temperatures_beyond_its_own_are_refused(self) -> None:
        with pytest.raises(ValueError, match="must be -40 to 85; instead received 90"):
            RateGyro().readings(0.0, 0.0, 90.0)
        with pytest.raises(ValueError, match="must be -40 to 125; instead received nan"):
            Inclinometer().readings([0.0, 0.0], [0.0, 0.0], math.nan)

    def test_settings_are_checked(self) -> None:
        with pytest.raises(ValueError, match="Input sigma must be 0 or more"):
            RateGyro(sigma_rad_s=-1.0)
        with pytest.raises(ValueError, match="Input tilt_rad must be two finite numbers"):
            Inclinometer(tilt_rad=np.zeros(3))
