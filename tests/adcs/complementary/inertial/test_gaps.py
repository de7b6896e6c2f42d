"""A hostile world of gaps: whatever is not read, the errors stay within σ, and the field tells the heading again."""

import math

import numpy as np
import pytest

from adcs.complementary.filters import LOST, inertial_magnetic_filter
from adcs.complementary.inertial.gaps import UNKNOWN_RAD, hidden_turn_rad, hidden_variance, sensor_gaps
from tests.adcs.complementary.inertial.units import squares, unit_log

SENSORS = {"gyro": 1, "accelerometer": 2, "magnetometer": 3}


def with_gap(log, at, lasts, missing):
    """The log without some sensors for a time; without its rows where ``missing`` is None."""
    time_s = log[0]
    inside = (time_s >= at) & (time_s < at + lasts)
    if missing is None:
        return tuple(values[~inside] for values in log)
    return tuple(
        np.where(inside[:, None], np.nan, v) if k in [SENSORS[m] for m in missing] else v for k, v in enumerate(log)
    )


class TestSigmaHoldsTheError:
    @pytest.mark.parametrize("offline", [False, True])
    @pytest.mark.parametrize(
        "missing",
        [None, ["gyro"], ["accelerometer"], ["magnetometer"], ["gyro", "magnetometer"], [*SENSORS]],
        ids=lambda names: "rows" if names is None else "+".join(names),
    )
    @pytest.mark.parametrize(("lasts", "turned"), [(1.0, 1.05), (3.0, math.pi)])
    def test_a_turn_in_a_gap(self, lasts, turned, missing, offline):
        """95 % of the rows within 4 σ, mean squares below 3, and the heading within 8° six seconds later."""
        log = unit_log(int(10 * lasts), turn=(12.0, lasts, turned))
        *readings, q = with_gap(log, 12.0, lasts, missing)
        track = inertial_magnetic_filter(*readings, offline=offline)
        after = (track.time_s > 12.0 + lasts) & (track.time_s < 24.0)
        for found in squares(track, q, after)[:2]:
            assert np.mean(found < 16.0) > 0.95
            assert found.mean() < 3.0
        late = squares(track, q, track.time_s > 18.0 + lasts)[2]
        assert np.degrees(np.abs(late)).max() < 8.0

    def test_the_gap_is_named(self):
        *readings, _ = with_gap(unit_log(), 12.0, 3.0, None)
        track = inertial_magnetic_filter(*readings)
        (said,) = track.warnings
        assert said.startswith("the gyro has 1 gap, of 3.04 s from 11.96 s on; the turn within a gap is unknown")
        assert track.degraded[LOST].any()
        *readings, _ = with_gap(unit_log(), 12.0, 2.0, ["accelerometer"])
        assert "the accelerometer has 1 gap, of 2.04 s" in inertial_magnetic_filter(*readings).warnings[0]

    @pytest.mark.parametrize("offline", [False, True])
    @pytest.mark.parametrize("lasts", [1e5, 1e9, 1e12])
    def test_days_and_years(self, lasts, offline):
        """Warnings are errors here: none is foreign, and the heading is right again."""
        time_s, *readings, q = unit_log()
        later = time_s + np.where(time_s > 15.0, lasts, 0.0)
        track = inertial_magnetic_filter(later, *readings, offline=offline)
        assert np.isfinite(track.sigma["level"]).all()
        assert "days" in track.warnings[0]
        assert np.degrees(np.abs(squares(track, q, time_s > 22.0)[2])).max() < 8.0

    def test_a_log_that_ends_without_a_gyro(self):
        *readings, _ = with_gap(unit_log(), 20.0, 20.0, ["gyro"])
        track = inertial_magnetic_filter(*readings)
        assert track.sigma["level"][-1, 2] == pytest.approx(UNKNOWN_RAD)


class TestParts:
    def test_hidden_turn(self):
        """It grows with the time, from what the ends leave to any turn."""
        seconds = np.linspace(0.01, 100.0, 1000)
        found = hidden_turn_rad(seconds, 0.1, 1.0)
        assert (np.diff(found) >= 0.0).all()
        assert found[0] == pytest.approx(0.001, rel=1e-6)
        assert found[-1] == UNKNOWN_RAD

    def test_gaps_and_variance(self):
        time_s = np.arange(20.0)
        read = np.ones(20, bool)
        read[5:9] = read[18:] = False
        np.testing.assert_array_equal(sensor_gaps(time_s, read), [[4, 9]])
        growth = hidden_variance(time_s, np.zeros((20, 3)), sensor_gaps(time_s, read), 0.1, 1.0)
        assert (growth[5:10] > 0.0).all()
        assert np.count_nonzero(growth) == 5
        assert growth.sum() == pytest.approx(UNKNOWN_RAD**2, rel=1e-6)
