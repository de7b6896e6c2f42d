"""Tests of adcs.satellite.sensors: one class per property. Statistical tests say how often they fail by chance."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.stats import chi2

from adcs import quaternion
from adcs.satellite import sensors
from adcs.satellite.sensors import Gyro, Magnetometer, StarTracker, SunSensor
from tests.adcs.attitudes import random_attitudes

Array = NDArray[np.float64]
N = 4000
RNG = np.random.default_rng(23)
Q = random_attitudes(N, RNG)
NONE = np.zeros((N, 3))
NORMAL = RNG.standard_normal((N, 3))
LEVEL = np.tile(quaternion.IDENTITY, (N, 1))
ABOVE = np.array([0.0, 0.0, 1.0])
BESIDE = np.array([1.0, 0.0, 0.0])
EARTH = np.radians(66.0)


def star(
    tracker: StarTracker, q: Array, noise: Array, *, w: Array = NONE, sun: Array = BESIDE, lit: float = 1.0
) -> Array:
    return sensors.star_tracker_readings(tracker, q, w[: len(q)], sun, EARTH, lit, noise[: len(q)])


def is_normal(values: Array, sigma: float) -> bool:
    """Whether the variance of all numbers together is σ², and their mean 0: wrongly no, once in a million."""
    n = values.size
    low, high = chi2.ppf([2.5e-7, 1 - 2.5e-7], n)
    return bool(low < np.sum(values**2) / sigma**2 < high and abs(values.mean()) < 5.03 * sigma / np.sqrt(n))


class TestNoise:
    """Of the size of Table 1."""

    def test_star_tracker(self) -> None:
        error = quaternion.error_vector(LEVEL, star(StarTracker(), LEVEL, NORMAL))
        assert is_normal(error, np.radians(0.0005))
        angle = 2.0 * star(StarTracker(sigma_rad=np.radians(0.001)), LEVEL, NORMAL)[:, 1:]
        assert is_normal(angle, np.radians(0.002))

    def test_gyro(self) -> None:
        assert is_normal(sensors.gyro_readings(Gyro(), NONE, NONE, NORMAL), np.radians(0.005))

    def test_magnetometer(self) -> None:
        assert is_normal(sensors.magnetometer_readings(Magnetometer(), NONE, NONE, NORMAL), 250e-9)

    def test_sun_sensor(self) -> None:
        sun = quaternion.rotate(Q, ABOVE)
        sun[:, 2] = np.abs(sun[:, 2])
        reading = sensors.sun_readings(SunSensor(), sun, 1.0, NORMAL)
        across = np.cross(sun, [0.6, 0.0, 0.8])
        across /= np.linalg.norm(across, axis=-1, keepdims=True)
        other = np.cross(sun, across)
        both = np.stack([np.sum(reading * across, axis=-1), np.sum(reading * other, axis=-1)])
        assert is_normal(both, np.radians(0.1))
        np.testing.assert_allclose(np.linalg.norm(reading, axis=-1), 1.0, rtol=1e-12)

    def test_none_without_numbers(self) -> None:
        w = 0.01 * NORMAL
        np.testing.assert_array_equal(sensors.gyro_readings(Gyro(), w, 0.001, NONE), w + 0.001)


class TestMisalignment:
    """All sensors of one turned unit agree with each other."""

    TURN = np.array([0.02, -0.01, 0.03])

    def test_same_turn_for_all(self) -> None:
        q, w, b = Q[:20], NORMAL[:20] * 0.001, NORMAL[:20] * 2e-5
        sun = quaternion.rotate_back(q, ABOVE)
        turned = StarTracker(boresight_body=ABOVE, misalignment_rad=self.TURN)
        q_unit = quaternion.multiply(q, quaternion.exp(self.TURN))
        seen = ~np.isnan(star(turned, q, NONE)[:, 0])
        np.testing.assert_allclose(star(turned, q, NONE)[seen], q_unit[seen], rtol=0, atol=1e-15)
        rates = sensors.gyro_readings(Gyro(misalignment_rad=self.TURN), w, NONE[:20], NONE[:20])
        np.testing.assert_allclose(quaternion.rotate(q_unit, rates), quaternion.rotate(q, w), rtol=0, atol=1e-15)
        field = sensors.magnetometer_readings(Magnetometer(misalignment_rad=self.TURN), b, NONE[:20], NONE[:20])
        np.testing.assert_allclose(quaternion.rotate(q_unit, field), quaternion.rotate(q, b), rtol=0, atol=1e-18)
        cube = SunSensor(heads_body=np.concatenate([np.eye(3), -np.eye(3)]), misalignment_rad=self.TURN)
        direction = sensors.sun_readings(cube, sun, 1.0, NONE[:20])
        np.testing.assert_allclose(quaternion.rotate(q_unit, direction), np.tile(ABOVE, (20, 1)), rtol=0, atol=1e-15)


class TestRange:
    def test_one_axis_beyond_takes_all(self) -> None:
        w = np.radians([[249.0, 0.0, 0.0], [251.0, 0.0, 0.0], [0.0, 0.0, -251.0]])
        missing = np.isnan(sensors.gyro_readings(Gyro(), w, 0.0, np.zeros((3, 3))))
        np.testing.assert_array_equal(missing, np.repeat([[False], [True], [True]], 3, axis=1))

    def test_bias_counts(self) -> None:
        field = np.array([[199_900e-9, 0.0, 0.0]])
        assert np.isnan(sensors.magnetometer_readings(Magnetometer(), field, 200e-9, np.zeros((1, 3)))).all()
        assert not np.isnan(sensors.magnetometer_readings(Magnetometer(), field, 0.0, np.zeros((1, 3)))).any()


class TestStarTrackerView:
    def test_rate_limit(self) -> None:
        w = np.radians([[1.99, 0.0, 0.0], [1.42, 1.42, 0.0]])  # 1.99 and 2.01
        np.testing.assert_array_equal(np.isnan(star(StarTracker(), LEVEL[:2], NONE, w=w))[:, 0], [False, True])

    def test_sun(self) -> None:
        tracker = StarTracker(sun_exclusion_rad=np.radians(30.0))
        for away, blinded in ((29.0, True), (31.0, False)):
            sun = np.array([np.sin(np.radians(away)), 0.0, np.cos(np.radians(away))])
            assert np.isnan(star(tracker, LEVEL[:1], NONE, sun=sun)).all() == blinded
            assert not np.isnan(star(tracker, LEVEL[:1], NONE, sun=sun, lit=0.0)).any()

    def test_earth(self) -> None:
        tracker = StarTracker(earth_exclusion_rad=np.radians(10.0))
        for tilt, hidden in ((103.0, False), (105.0, True), (180.0, True)):
            q = quaternion.exp(np.radians([tilt, 0.0, 0.0]))[None]
            assert np.isnan(star(tracker, q, NONE)).all() == hidden


class TestSunHeads:
    @given(st.integers(0, 2**32 - 1))
    def test_square_fields_leave_only_the_sixth_side_unseen(self, seed: int) -> None:
        direction = np.random.default_rng(seed).standard_normal((50, 3))
        direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
        seen = sensors.is_in_field(SunSensor(), direction).any(axis=-1)
        below = -direction[:, 2] > np.abs(direction[:, :2]).max(axis=-1)
        np.testing.assert_array_equal(seen, ~below)

    def test_part_of_the_sky(self) -> None:
        # Five sides of a cube see 5/6. With 4000 directions three standard deviations are 1.8 %; once in 370.
        seen = sensors.is_in_field(SunSensor(), quaternion.rotate(Q, ABOVE)).any(axis=-1)
        assert seen.mean() == pytest.approx(5 / 6, abs=0.018)

    def test_head_that_looks_anywhere(self) -> None:
        axis = np.array([1.0, 2.0, -2.0]) / 3.0
        sensor = SunSensor(heads_body=5.0 * axis[None], half_field_rad=np.radians(20.0))
        aside = np.cross(axis, [0.0, 0.0, 1.0])
        aside /= np.linalg.norm(aside)
        for degrees, seen in ((0.0, True), (19.0, True), (30.0, False), (180.0, False)):
            direction = np.cos(np.radians(degrees)) * axis + np.sin(np.radians(degrees)) * aside
            assert bool(sensors.is_in_field(sensor, direction)[0]) == seen

    def test_eclipse(self) -> None:
        sun = np.tile(ABOVE, (3, 1))
        missing = np.isnan(sensors.sun_readings(SunSensor(), sun, [1.0, 0.5, 0.49], np.zeros((3, 3))))[:, 0]
        np.testing.assert_array_equal(missing, [False, False, True])


class TestBadSettings:
    @pytest.mark.parametrize("kind", [StarTracker, Gyro, Magnetometer, SunSensor])
    def test_every_number_is_checked(self, kind: type[StarTracker | Gyro | Magnetometer | SunSensor]) -> None:
        for one in fields(kind):
            with pytest.raises(ValueError, match=rf"Input {one.name} must .*"):
                kind(**{one.name: np.full((1, 3), np.nan) if one.name == "heads_body" else np.full(3, np.nan)})
            if one.name.startswith(("sigma", "range", "rate", "half")):
                with pytest.raises(ValueError, match=rf"Input {one.name} must be positive; instead received 0\.0"):
                    kind(**{one.name: 0.0})

    def test_no_direction(self) -> None:
        with pytest.raises(ValueError, match=r"Input boresight_body must have a length"):
            StarTracker(boresight_body=np.zeros(3))
        with pytest.raises(ValueError, match=r"Input heads_body must be vectors that are not zero"):
            SunSensor(heads_body=np.zeros((2, 3)))
