"""The lag between readings and poses: white errors of places neither make one nor hide one."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import arrays
import magloc
from arrays.typing import FloatArray
from magloc.surveying.clock import UNKNOWN, ClockLag, SmoothTrack, agreed_lag

AMBIENT_T = np.array([1.3e-6, 20.4e-6, -43.9e-6])
PLACES_M = np.array([[2.0, 0.9, -0.45], [5.0, 2.4, -0.6], [9.0, 1.3, -0.5]])
MOMENTS_Am2 = np.array([[0.2, 0.3, 0.0], [0.5, -0.4, 0.1], [-0.3, 0.1, 0.4]])
ARRAY = arrays.SensorArray(
    tuple(arrays.Sensor(name, "scalar", (0.0, 0.0, z), 0.5e-9) for name, z in (("low", 0.0), ("up", 1.0))),
    pose=arrays.PoseUncertainty(position_m=0.05, position_constant_m=0.0, attitude_constant_rad=0.0),
)


def walked(lag_s: float, error_m: FloatArray | float) -> magloc.Readings:
    """Seven lines of 11 m to and fro, with 5 s between them; readings of poses some time earlier."""
    line, second = np.divmod(np.arange(7 * 110), 110)
    time_s = 16.0 * line + second / 10.0

    def way(seconds: FloatArray) -> FloatArray:
        x = np.where(line % 2, 11.0 - seconds, seconds)
        return np.stack([x, 0.5 * line + 0.05 * np.sin(time_s / 1.4), 0.4 + 0.04 * np.sin(time_s / 1.1)], axis=1)

    sensors = way(second / 10.0 - lag_s)[:, None] + ARRAY.positions
    fields = magloc.dipole.field(sensors[:, :, None], PLACES_M, MOMENTS_Am2).sum(axis=2)
    noise = 0.5e-9 * np.random.default_rng(2).standard_normal((len(time_s), 2))
    return magloc.Readings(
        np.linalg.norm(AMBIENT_T + fields, axis=2) + noise,
        time_s=time_s,
        array_position_m=way(second / 10.0) + error_m,
        array_rotation=Rotation.identity(len(time_s)),
        ambient_T=np.tile(AMBIENT_T, (len(time_s), 1)),
    )


@cache
def white_errors() -> FloatArray:
    return 0.05 * np.random.default_rng(1).standard_normal((770, 3))


class TestTakenEarlier:
    @pytest.mark.parametrize("lag_s", [-0.95, -0.05, 0.05, 0.23])
    def test_white_errors_stay_as_large(self, lag_s: float) -> None:
        """Of 2,310 the variance differs by 12 % once in 20,000 times; means of two lose a half. Not beyond the ends."""
        still = replace(walked(0.0, 0.0), array_position_m=white_errors())
        moved = SmoothTrack.of(still).with_earlier_poses(lag_s).array_position_m
        assert moved is not None
        inside = np.abs(np.arange(770) % 110 - 54.5) < 45.0
        assert np.mean(moved[inside] ** 2) == pytest.approx(np.mean(white_errors()[inside] ** 2), rel=0.12)

    def test_a_smooth_way_moves_along_itself(self) -> None:
        readings = walked(0.0, 0.0)
        moved = SmoothTrack.of(readings).with_earlier_poses(0.2).array_position_m
        place = readings.array_position_m
        assert moved is not None
        assert place is not None
        inside = np.arange(len(moved)) % 110 >= 2
        np.testing.assert_allclose(moved[inside], np.roll(place, 2, axis=0)[inside], atol=2e-4)
        np.testing.assert_allclose((moved - place)[::220, 0], -0.2, atol=2e-3)  # straight on beyond the ends

    def test_some_rows_move_as_all(self) -> None:
        track, rows = SmoothTrack.of(walked(0.0, 0.0)), np.arange(150, 400, 3)
        own, of_all = track.with_earlier_poses(0.33, rows), track.with_earlier_poses(0.33)[rows]
        np.testing.assert_array_equal(own.array_position_m, of_all.array_position_m)
        np.testing.assert_array_equal(own.ambient_T, of_all.ambient_T)

    def test_attitudes(self) -> None:
        readings = walked(0.0, 0.0)
        turn, before = (
            Rotation.from_rotvec(np.outer(0.7 * (readings.time_s - late_s), [0.0, 0.0, 1.0])) for late_s in (0.0, 0.1)
        )
        moved = SmoothTrack.of(replace(readings, array_rotation=turn)).with_earlier_poses(0.1).array_rotation
        assert moved is not None
        assert np.all((moved * before.inv()).magnitude()[np.arange(770) % 110 > 0] < 1e-5)

    def test_the_modulus_stays_that_of_the_readings(self) -> None:
        """A base station has it at their clock; the direction in the world moves with the poses."""
        readings = walked(0.0, 0.0)
        assert readings.ambient_T is not None
        storm = 1.0 + 1e-3 * np.sin(readings.time_s)[:, None]
        quiet = SmoothTrack.of(readings).with_earlier_poses(0.5).ambient_T
        stormy = (
            SmoothTrack.of(replace(readings, ambient_T=readings.ambient_T * storm)).with_earlier_poses(0.5).ambient_T
        )
        assert quiet is not None
        np.testing.assert_allclose(stormy, quiet * storm, rtol=1e-6)


class TestAgreedLag:
    """Two estimates of one lag."""

    LINES = ClockLag(-0.515, 0.03)

    def test_agreement(self) -> None:
        """The smaller error counts."""
        assert agreed_lag(self.LINES, ClockLag(-0.48, 0.01)) == ClockLag(-0.48, 0.01)
        assert agreed_lag(self.LINES, ClockLag(-0.48, 0.09)) == self.LINES
        weak = agreed_lag(ClockLag(-0.58, 0.21), ClockLag(-0.322, 0.006))
        assert weak.doubt == "the targets alone show it, opposite lines give -0.580 ± 0.210 s"

    def test_disagreement(self) -> None:
        """Lines need no model; the doubt states both."""
        found = agreed_lag(self.LINES, ClockLag(-0.269, 0.008))
        assert found[:2] == self.LINES[:2]
        assert found.doubt == "the targets show -0.269 ± 0.008 s, opposite lines -0.515 ± 0.030 s"

    def test_one_of_them(self) -> None:
        alone = agreed_lag(UNKNOWN, ClockLag(0.2, 0.01))
        assert alone[:2] == (0.2, 0.01)
        assert "the targets alone" in alone.doubt
        assert not agreed_lag(UNKNOWN, ClockLag(0.01, 0.01)).doubt
        assert agreed_lag(self.LINES, UNKNOWN) == self.LINES
        assert not agreed_lag(UNKNOWN, UNKNOWN).is_significant


class TestLag:
    """A claim is one of five standard deviations: no seed was chosen."""

    @pytest.mark.slow_after(1)
    @pytest.mark.parametrize("lag_s", [0.0, 0.2])
    def test_new_errors_in_every_row(self, lag_s: float) -> None:
        found = magloc.survey(ARRAY, walked(lag_s, white_errors()))
        assert found.lag_s == pytest.approx(lag_s, abs=0.02)  # four standard deviations
        assert len(found) == 3
        for target in found:
            low, high = target.depth_interval95_m
            assert low <= target.depth_m <= high
            error = target.position_m - PLACES_M[np.linalg.norm(PLACES_M - target.position_m, axis=1).argmin()]
            # χ² of three: 1 in 10,000 right ones is beyond 21.
            assert error @ np.linalg.solve(target.covariance[:3, :3], error) < 21.0

    @pytest.mark.slow
    def test_errors_of_places_that_last_a_line(self) -> None:
        """0.3 m, of which the array states 5 cm: 0.11 s in the mean of 7 lines. Five σ, and not one of white errors."""
        each = 0.3 * np.random.default_rng(5).standard_normal((7, 3)) * [1.0, 1.0, 0.0]
        found = magloc.check_quality(ARRAY, walked(0.5, np.repeat(each, 110, axis=0)))
        assert found.lag is not None
        assert found.lag.s == pytest.approx(0.5, abs=5.0 * max(found.lag.sigma_s, 0.0))
        assert found.lag.sigma_s > 0.02

    @pytest.mark.slow
    def test_a_lag_beyond_the_first_interval(self) -> None:
        found = magloc.survey(ARRAY, walked(0.9, white_errors()))
        assert found.lag_s == pytest.approx(0.9, abs=0.02)  # four standard deviations

    @pytest.mark.slow
    def test_what_all_places_share_is_in_the_ellipses(self) -> None:
        """A constant of 5 cm moves all targets together: nothing tells it, nor does the curvature of fields."""
        shifting = replace(ARRAY, pose=replace(ARRAY.pose, position_constant_m=0.05))
        for target in magloc.survey(shifting, walked(0.0, white_errors())):
            assert (np.diagonal(target.covariance)[:3] > 0.048**2).all()
            assert np.linalg.norm(PLACES_M - target.position_m, axis=1).min() < 0.06
