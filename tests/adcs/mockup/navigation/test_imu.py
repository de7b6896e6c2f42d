"""Gyro, inclinometer, and their calibration at rest.

Statistical tests have fixed seeds, not chosen, and state the probability with which a right program fails them.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from adcs.mockup.navigation.imu import G_M_S2, Inclinometer, NotAtRestError, RateGyro, zeros_at_rest
from adcs.mockup.navigation.strapdown import ImuRecord

GYRO = RateGyro(zero_rad_s=math.radians(0.3))
ACCELEROMETER = Inclinometer(zero_m_s2=np.array([0.01, -0.02]), tilt_rad=np.radians([0.2, -0.1]))
FALSE_ALARM = 1e-4


def rest(n, rng, push=None):
    """Readings of a satellite at rest, and of one that a push (n, 2) accelerates."""
    acceleration = np.zeros((n, 2)) if push is None else push
    time_s = 0.01 * np.arange(1.0, n + 1.0)
    readings = ACCELEROMETER.readings(acceleration, rng.standard_normal((n, 2)))
    return ImuRecord(0.0, time_s, readings, GYRO.readings(np.zeros(n), rng.standard_normal(n)))


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


class TestCalibrationAtRest:
    def test_zeros_and_tilt_are_found_as_well_as_stated(self) -> None:
        # χ² of 3 numbers in 200 calibrations: false alarm 1e-4.
        rng = np.random.default_rng(2)
        true = np.append(ACCELEROMETER.zero_m_s2 + G_M_S2 * np.sin(ACCELEROMETER.tilt_rad), GYRO.zero_rad_s)
        total = 0.0
        for _ in range(200):
            zeros = zeros_at_rest(rest(500, rng), ACCELEROMETER, GYRO, false_alarm=1e-9)
            sigma = [zeros.acceleration_sigma_m_s2, zeros.acceleration_sigma_m_s2, zeros.rate_sigma_rad_s]
            total += float(np.sum(((np.append(zeros.acceleration_m_s2, zeros.rate_rad_s) - true) / sigma) ** 2))
        low, high = stats.chi2.ppf([FALSE_ALARM / 2, 1 - FALSE_ALARM / 2], 600)
        assert low < total < high

    def test_rest_is_refused_no_more_often_than_stated(self) -> None:
        rng = np.random.default_rng(3)
        refused = 0
        for _ in range(1000):
            try:
                zeros_at_rest(rest(200, rng), ACCELEROMETER, GYRO, false_alarm=0.02)
            except NotAtRestError:
                refused += 1
        # Sharing the quantile can only lower the rate; a tenth of it would be a gate that is too wide.
        assert 2 <= refused <= stats.binom.isf(FALSE_ALARM, 1000, 0.02)

    @pytest.mark.parametrize("samples", [10, 60, 250])
    def test_a_pulse_of_a_valve_is_noticed(self, samples: int) -> None:
        # 0.04 m/s² for half of the time is 0.02 m/s² of zero, and for a fiftieth of it 0.0008.
        push = np.zeros((500, 2))
        push[100 : 100 + samples, 1] = 0.04
        with pytest.raises(NotAtRestError, match=r"acceleration along y that noise does not explain at \d"):
            zeros_at_rest(rest(500, np.random.default_rng(4), push), ACCELEROMETER, GYRO)

    def test_a_shift_of_the_zero_by_5_mm_s2_is_noticed(self) -> None:
        push = np.zeros((1000, 2))
        push[700:825, 0] = 0.04  # 0.005 m/s² on average
        with pytest.raises(NotAtRestError, match="along x"):
            zeros_at_rest(rest(1000, np.random.default_rng(5), push), ACCELEROMETER, GYRO)

    def test_a_turn_is_noticed(self) -> None:
        imu = rest(500, np.random.default_rng(6))
        with pytest.raises(NotAtRestError, match="a rate that noise"):
            zeros_at_rest(imu.less(0.0, np.linspace(0.0, math.radians(0.3), 500)), ACCELEROMETER, GYRO)

    def test_missing_readings_are_left_out(self) -> None:
        imu = rest(500, np.random.default_rng(7))
        some = imu.acceleration_m_s2.copy()
        some[::7, 0] = np.nan
        zeros = zeros_at_rest(ImuRecord(0.0, imu.time_s, some, imu.rate_rad_s), ACCELEROMETER, GYRO)
        assert zeros.acceleration_m_s2[0] == pytest.approx(np.nanmean(some[:, 0]), abs=1e-12)

    def test_one_sample_is_too_few(self) -> None:
        with pytest.raises(ValueError, match="two samples at least; instead received 1"):
            zeros_at_rest(rest(1, np.random.default_rng(8)), ACCELEROMETER, GYRO)
