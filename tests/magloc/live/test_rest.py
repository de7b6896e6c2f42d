"""The background of a rest: its mean, how well that is known, and what remains of it in a track."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

import magloc
from arrays import geometries
from arrays.io.errors import InputError
from arrays.sensor import Calibration
from magloc.live.follower import RESTING, Follower
from magloc.live.rest import RestBackground
from magloc.readings import Readings
from magloc.tracking.rows import Row
from tests.passing_source import ARRAY, NOISE_T, SLOW, moving_source, readings_of

N_REST = 40
OFFSET_T = 1e3 * NOISE_T * np.random.default_rng(0).normal(size=ARRAY.n_channels)


def rows_at_rest(seed: int) -> list[Row]:
    """Rows without a source, under offsets of a thousand times the noise."""
    rng = np.random.default_rng(seed)
    return [Row(0.1 * i, OFFSET_T + NOISE_T * rng.normal(size=ARRAY.n_channels)) for i in range(N_REST)]


class TestBackground:
    def test_its_error_is_as_large_as_it_says(self) -> None:
        """χ² of 100 means of 12 channels: a right one is outside once in a million."""
        found = [RestBackground.from_rows(ARRAY, rows_at_rest(seed)) for seed in range(100)]
        square = sum(float(np.sum(((one.mean_T - OFFSET_T) / one.sigma_T) ** 2)) for one in found)
        low, high = chi2.ppf([5e-7, 1.0 - 5e-7], 1200)
        assert low < square < high

    def test_a_calibrated_offset_is_left_to_the_calibration(self) -> None:
        """As everything else that is subtracted, it may not be taken off twice."""
        known = tuple(replace(s, calibration=Calibration.of("vector", 1.0, [1e-6, 2e-6, 3e-6])) for s in ARRAY.sensors)
        array = replace(ARRAY, sensors=known)
        found = RestBackground.from_rows(array, rows_at_rest(1))
        np.testing.assert_allclose(
            found.mean_T, RestBackground.from_rows(ARRAY, rows_at_rest(1)).mean_T - array.channel_offset_T
        )

    @pytest.mark.parametrize(("factor", "warned"), [(1.0, 0), (1.5, 100)])
    def test_a_noise_that_is_stated_too_small(
        self, factor: float, warned: int, caplog: pytest.LogCaptureFixture
    ) -> None:
        """The ratio is printed; five standard deviations of 480 readings: a right noise warns once in a million."""
        stated = replace(ARRAY, sensors=tuple(replace(s, noise_T=s.noise_T / factor) for s in ARRAY.sensors))
        for seed in range(100):
            RestBackground.from_rows(stated, rows_at_rest(seed))
        ratios = [float(r.getMessage().split(" times")[0].split()[-1]) for r in caplog.records if "multiply" in r.msg]
        assert len(ratios) == warned
        assert np.allclose(ratios, factor, rtol=0.27)

    def test_spikes_do_not_count(self) -> None:
        rows = rows_at_rest(2)
        spiked = list(rows)
        for i in range(0, N_REST, 8):
            spiked[i] = replace(rows[i], readings_T=rows[i].readings_T + 1e-3)
        found, plain = RestBackground.from_rows(ARRAY, spiked), RestBackground.from_rows(ARRAY, rows)
        assert np.all(np.abs(found.mean_T - plain.mean_T) < 3.0 * plain.sigma_T)
        assert np.all(found.sigma_T > plain.sigma_T)

    def test_a_sensor_that_was_moved_is_named(self) -> None:
        rows = rows_at_rest(3)
        ramp = np.zeros(ARRAY.n_channels)
        ramp[4] = 2.0 * NOISE_T
        moved = [replace(row, readings_T=row.readings_T + i * ramp) for i, row in enumerate(rows)]
        assert RestBackground.from_rows(ARRAY, moved).unsteady_sensors == ("s2",)
        assert RestBackground.from_rows(ARRAY, rows).unsteady_sensors == ()

    def test_readings_that_no_rest_has_are_refused(self) -> None:
        """A wild value in a rest of two rows would be taken for the sensor's noise."""
        rows = rows_at_rest(3)[:2]
        wild = np.zeros(ARRAY.n_channels)
        wild[4] = 1e5
        with pytest.raises(InputError, match=r"a rest: found readings of s2 that scatter by .* nT, expected an array"):
            RestBackground.from_rows(ARRAY, [rows[0], replace(rows[1], readings_T=rows[1].readings_T + wild)])

    def test_a_channel_without_readings_stays_without(self) -> None:
        rows = rows_at_rest(4)
        for row in rows:
            row.readings_T[5] = math.nan
        found = RestBackground.from_rows(ARRAY, rows)
        assert np.isnan(found.mean_T[5])
        assert np.isnan(found.subtract_from(Row(9.0, np.ones(12))).readings_T).sum() == 1
        assert all(
            math.isfinite(sensor.offset_uncertainty_T) for sensor in found.with_offset_uncertainty(ARRAY).sensors
        )

    def test_offsets_are_as_uncertain_as_it_is(self) -> None:
        found = RestBackground.from_rows(ARRAY, rows_at_rest(5)).with_offset_uncertainty(ARRAY)
        for sensor in found.sensors:
            assert sensor.offset_uncertainty_T == pytest.approx(NOISE_T / math.sqrt(N_REST), rel=0.6)


def squared_error_after_a_rest(seed: int) -> float:
    """NEES of the position in the last row of a passage that follows a rest of four seconds."""
    rest = rows_at_rest(seed)
    time_s, p, m = moving_source(40, 0.1)
    values = readings_of(ARRAY, p, m, seed=1000 + seed) + OFFSET_T
    values_T = np.vstack([[row.readings_T for row in rest], values])
    times = np.concatenate([[row.time_s for row in rest], rest[-1].time_s + 0.1 + time_s])
    points = list(Follower(ARRAY, SLOW, rest_s=0.1 * (N_REST - 0.5)).follow(Readings(values_T, time_s=times)))
    assert [point.status == RESTING for point in points] == [True] * N_REST + [False] * 40
    last = points[-1]
    assert last.position_m is not None
    assert last.covariance is not None
    error = last.position_m - p[-1]
    return float(error @ np.linalg.solve(last.covariance[:3, :3], error))


class TestTrackAfterARest:
    @pytest.mark.slow
    def test_is_as_good_as_it_says(self) -> None:
        """The sum of ten NEES is above its bound once in 10,000; the source moves less than is said."""
        assert sum(map(squared_error_after_a_rest, range(10))) < chi2.ppf(1.0 - 1e-4, 30)

    def test_without_a_rest_there_is_none(self) -> None:
        time_s, p, m = moving_source(20, 0.1)
        values = readings_of(ARRAY, p, m) + OFFSET_T
        points = list(Follower(ARRAY, SLOW).follow(Readings(values, time_s=time_s)))
        assert all(point.position_m is None for point in points)

    def test_scalar_sensors_are_refused(self) -> None:
        with pytest.raises(InputError, match="scalar sensor s1"):
            Follower(geometries.tetrahedron(1.0, "scalar"), rest_s=1.0)


class TestSubtractRest:
    def test_a_track_behind_it_is_that_of_live(self) -> None:
        rows = rows_at_rest(5)
        time_s, p, m = moving_source(30, dt_s=0.1)
        moving_T = readings_of(ARRAY, p, m) + OFFSET_T
        times = np.concatenate([[row.time_s for row in rows], 0.1 * N_REST + time_s - time_s[0]])
        readings = Readings(np.concatenate([[row.readings_T for row in rows], moving_T]), time_s=times)
        track = magloc.track(*magloc.subtract_rest(ARRAY, readings, 0.1 * (N_REST - 0.5)), motion=SLOW)
        live = list(Follower(ARRAY, SLOW, rest_s=0.1 * (N_REST - 0.5)).follow(readings))
        told = [point.position_m for point in live[N_REST:]]
        assert track.tracked[N_REST:].all()
        np.testing.assert_allclose(track.position_m[N_REST:], np.array(told), rtol=1e-9)

    def test_a_record_that_is_all_rest_is_refused(self) -> None:
        readings = Readings(np.zeros((3, ARRAY.n_channels)), time_s=np.arange(3.0))
        with pytest.raises(InputError, match="expected rows after the rest"):
            magloc.subtract_rest(ARRAY, readings, 10.0)

    def test_what_it_says_nothing_of_is_refused(self) -> None:
        scalar = geometries.cube(1.0, "scalar", 1e-9)
        readings = Readings(np.zeros((3, scalar.n_channels)), time_s=np.arange(3.0))
        with pytest.raises(InputError, match="scalar sensor"):
            magloc.subtract_rest(scalar, readings, 1.0)
