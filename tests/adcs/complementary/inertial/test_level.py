"""The start of an inertial unit that is not at rest, and a unit without a magnetometer."""

import numpy as np
import pytest

from adcs import quaternion
from adcs.complementary.filters import inertial_magnetic_filter
from adcs.complementary.inertial import level
from adcs.complementary.inertial_magnetic import InertialMagneticRecord, prepare
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


class TestTimeConstant:
    """The acceleration's time constant is the one that predicts later accelerations best."""

    @staticmethod
    def record(scale: float) -> tuple[InertialMagneticRecord, np.ndarray]:
        time_s, rate, *readings, q = unit_log(2)
        gains = 1.0 + scale * np.array([1.0, -1.0, 1.0])
        return InertialMagneticRecord(time_s, rate * gains, *readings), q

    @staticmethod
    def tilt_rad(record: InertialMagneticRecord, q: np.ndarray, *, offline: bool) -> tuple[np.ndarray, np.ndarray]:
        prepared = prepare(record, offline=offline)
        up = quaternion.rotate(prepared.q_level, quaternion.rotate_back(q, [0.0, 0.0, 1.0]))
        moving = record.time_s > 20.0
        return np.arccos(np.clip(up[moving, 2], -1.0, 1.0)), prepared.tilt_sigma_rad[moving]

    @pytest.mark.parametrize("offline", [False, True])
    def test_a_gyro_with_wrong_scales(self, offline, monkeypatch):
        """Its drift is followed and counts in σ; with the published time constant alone the error is larger."""
        record, q = self.record(0.15)
        error, sigma = self.tilt_rad(record, q, offline=offline)
        assert np.mean(error**2 / sigma**2) < 3.0
        monkeypatch.setattr(level, "_TIMES_S", (level.GRAVITY_TIME_S,))
        fixed, _ = self.tilt_rad(record, q, offline=offline)
        assert np.mean(error**2) < 0.7 * np.mean(fixed**2)

    @pytest.mark.parametrize("offline", [False, True])
    def test_a_good_gyro(self, offline, monkeypatch):
        """The published time constant stays."""
        record, q = self.record(0.0)
        found = self.tilt_rad(record, q, offline=offline)
        monkeypatch.setattr(level, "_TIMES_S", (level.GRAVITY_TIME_S,))
        np.testing.assert_allclose(found, self.tilt_rad(record, q, offline=offline), rtol=0, atol=1e-12)

    def test_only_the_past_counts(self):
        record, _ = self.record(0.15)
        early = record.time_s < 25.0
        part = InertialMagneticRecord(
            record.time_s[early], record.rate_rad_s[early], record.acceleration_m_s2[early], record.field_T[early]
        )
        np.testing.assert_allclose(
            prepare(part).tilt_sigma_rad, prepare(record).tilt_sigma_rad[early], rtol=0, atol=1e-12
        )
