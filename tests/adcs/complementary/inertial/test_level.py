"""The start of an inertial unit that is not at rest, and a unit without a magnetometer."""

import numpy as np
import pytest

from adcs.complementary.filters import inertial_magnetic_filter
from tests.adcs.complementary.inertial.units import squares, unit_log


class TestStart:
    @pytest.mark.parametrize("offline", [False, True])
    @pytest.mark.parametrize("seed", range(4))
    def test_a_shaken_start_is_said_and_honest(self, seed, offline):
        *readings, q = unit_log(seed, shaken_s=3.0)
        track = inertial_magnetic_filter(*readings, offline=offline)
        assert "not at rest in the first second" in track.warnings[0]
        for found in squares(track, q, track.time_s > 5.0)[:2]:
            assert found.mean() < 3.0

    def test_a_unit_that_never_rests(self):
        time_s, *readings, q = unit_log(3)
        moving = time_s > 5.0
        track = inertial_magnetic_filter(time_s[moving], *(values[moving] for values in readings))
        assert "never rests, so that the gyro's bias is unknown" in track.warnings[0]
        assert all(found.mean() < 3.0 for found in squares(track, q[moving], slice(100, None))[:2])

    @pytest.mark.parametrize("seed", range(5))
    def test_a_start_at_rest_says_nothing(self, seed):
        *readings, _ = unit_log(seed)
        assert inertial_magnetic_filter(*readings).warnings == ()


class TestSixAxes:
    @pytest.mark.parametrize("none", [False, True])
    def test_relative_heading(self, none):
        """None and a field that is NaN are the same: tilt, and a heading whose σ grows and holds its error."""
        *readings, field, q = unit_log(1)
        track = inertial_magnetic_filter(*readings, None if none else np.full_like(field, np.nan))
        (said,) = track.warnings
        assert "there is no magnetometer" in said
        assert track.used == ("accelerometer",)
        sigma = track.sigma["level"][:, 2]
        assert sigma[0] == 0.0
        assert sigma[-1] > sigma[200] > 0.0
        of_heading, of_tilt, heading = squares(track, q, slice(100, None), relative=True)
        assert of_heading.mean() < 3.0
        assert of_tilt.mean() < 3.0
        assert np.degrees(np.abs(heading)).max() < 6.0
