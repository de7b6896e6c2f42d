"""The door of a track.

====================================  ==================================================================================
what                                  who checks it
====================================  ==================================================================================
columns                               the points of the readable tracker and its smoother
what the library decides              readings without those that saturate, models that are named
its text, dataset and map             the command; the points; pymap3d back again
consistency                           the filter's and the smoother's bound; truth without moments
====================================  ==================================================================================
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pymap3d
import pytest
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

import magloc
from arrays.io.errors import InputError
from arrays.io.tables import by_sigma
from magloc.tracking.files import at_rest
from magloc.tracking.results import TrackPoint
from magloc.tracking.rows import rows_of
from magloc.tracking.track import SPEED_M_S, TURN_RAD_S
from magloc.tracking.whole_records.posterior_bound import posterior_bound
from magloc.tracking.whole_records.smoother import smooth_points
from tests.passing_source import ARRAY, SLOW, moving_source, readings_of

N_ROWS, N_EMPTY = 24, 3
TIME_S, TRUE_M, MOMENT_AM2 = moving_source(N_ROWS)
TRUTH = magloc.Truth(TIME_S, TRUE_M, MOMENT_AM2)
FAR = np.where(np.arange(N_ROWS)[:, None] < N_EMPTY, 100.0, 1.0)
READINGS = magloc.Readings(readings_of(ARRAY, FAR * TRUE_M, MOMENT_AM2), time_s=TIME_S)


@pytest.fixture(scope="module")
def track() -> magloc.Track:
    return magloc.track(ARRAY, READINGS, motion=SLOW)


class TestColumns:
    def test_are_those_of_the_points(self, track: magloc.Track) -> None:
        points = list(magloc.Tracker(ARRAY, SLOW).run(rows_of(READINGS)))
        assert track.status == [point.status for point in points]
        np.testing.assert_array_equal(track.tracked, np.arange(N_ROWS) >= N_EMPTY)
        np.testing.assert_array_equal(track.time_s, TIME_S)
        for name in ("position_m", "moment_Am2", "covariance", "estimability"):
            column = getattr(track, name)
            assert np.isnan(column[:N_EMPTY]).all()
            expected = [getattr(point, name) for point in points[N_EMPTY:]]
            np.testing.assert_allclose(column[N_EMPTY:], expected, rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(track.nis, [point.nis for point in points], rtol=1e-6)
        np.testing.assert_array_equal(track.nis_dof, [point.nis_dof for point in points])

    def test_ranges(self, track: magloc.Track) -> None:
        """Of the source that is tracked, twice the 95 % interval at most: z beyond 3.9 once in 10,000, in 21 rows."""
        for row, ((low, high),) in list(enumerate(track.range_interval_m))[N_EMPTY:]:
            range_m = float(np.linalg.norm(TRUE_M[row] - ARRAY.centroid))
            assert high is not None
            assert abs(range_m - 0.5 * (low + high)) < high - low

    def test_a_track_is_a_sequence(self, track: magloc.Track) -> None:
        assert len(track) == len(list(track)) == N_ROWS
        assert track[-1] is track.points[-1]
        assert track[N_EMPTY:] == track.points[N_EMPTY:]

    def test_of_no_rows(self) -> None:
        track = magloc.track(ARRAY, np.zeros((0, 12)))
        assert track.position_m.shape == (0, 3)
        assert track.covariance.shape == (0, 6, 6)


class TestDecisions:
    @pytest.mark.parametrize("smooth", [False, True])
    def test_motion_of_a_source_of_which_nothing_is_said(self, smooth: bool) -> None:
        kind = magloc.OrnsteinUhlenbeck if smooth else magloc.RandomWalk
        named = magloc.track(ARRAY, READINGS, motion=kind(SPEED_M_S, TURN_RAD_S), smooth=smooth)
        silent = magloc.track(ARRAY, READINGS, smooth=smooth)
        np.testing.assert_array_equal(named.position_m, silent.position_m)

    def test_smoothed(self) -> None:
        motion = magloc.OrnsteinUhlenbeck(0.1, 0.02)
        tracker = magloc.Tracker(ARRAY, motion, keep_steps=True)
        points = smooth_points(list(tracker.run(rows_of(READINGS))), tracker.steps)
        track = magloc.track(ARRAY, READINGS, motion=motion, smooth=True)
        expected = [point.position_m for point in points[N_EMPTY:]]
        np.testing.assert_allclose(track.position_m[N_EMPTY:], expected, rtol=1e-6)

    def test_saturated_readings_are_not_used(self) -> None:
        limit_T = 3e-6
        limited = replace(ARRAY, sensors=tuple(replace(sensor, saturation_T=limit_T) for sensor in ARRAY.sensors))
        values = READINGS.values_T.copy()
        values[10, 4] = limit_T
        missing = values.copy()
        missing[10, 4] = np.nan
        assert np.nanmax(np.abs(missing)) < limit_T
        saturated = replace(READINGS, values_T=values)
        expected = magloc.track(ARRAY, replace(READINGS, values_T=missing), motion=SLOW)
        found = magloc.track(limited, saturated, motion=SLOW)
        np.testing.assert_array_equal(found.position_m, expected.position_m)
        assert np.isnan(found.readings.values_T[10, 4])
        tracker = magloc.Tracker(limited, SLOW)
        points = [tracker.update(row) for row in saturated]
        np.testing.assert_allclose(points[10].position_m, expected.position_m[10], rtol=1e-6)

    def test_frame(self, track: magloc.Track) -> None:
        assert track.frame == "array"
        pose = {"array_position_m": np.zeros((N_ROWS, 3)), "array_rotation": Rotation.identity(N_ROWS)}
        assert magloc.track(ARRAY, replace(READINGS, **pose), motion=SLOW).frame == "world"

    def test_rows_that_go_back_in_time(self) -> None:
        with pytest.raises(ValueError, match="Input time_s must increase"):
            magloc.track(ARRAY, READINGS[::-1], motion=SLOW)

    def test_one_row_at_a_time(self) -> None:
        with pytest.raises(ValueError, match="Input row must be readings of length one; instead received 2 rows"):
            magloc.Tracker(ARRAY, SLOW).update(READINGS[:2])


class TestShapes:
    def test_text(self, track: magloc.Track) -> None:
        *lines, caution = track.table().splitlines()
        assert caution.startswith("the source counts as a point")
        assert len(lines) == 1 + N_ROWS
        assert " ".join(lines[0].split()) == "time_s x_m y_m z_m s_x_m s_y_m s_z_m m_Am2 s_m nis status"
        short = repr(track).splitlines()
        assert len(short) == 12
        assert short[6] == f"… {N_ROWS} rows"
        assert short[0] in track._repr_html_()

    def test_figure(self, track: magloc.Track) -> None:
        assert isinstance(track.plot(), Figure)

    def test_dataset(self, track: magloc.Track) -> None:
        dataset = track.to_xarray()
        np.testing.assert_array_equal(dataset["position_m"].sel(axis="y"), track.position_m[:, 1])
        assert all({"units", "long_name"} <= set(dataset[name].attrs) for name in dataset.variables if name != "axis")
        assert dataset.attrs["frame"] == "array"

    def test_map(self, track: magloc.Track) -> None:
        place = (48.0, 11.0, 500.0)
        line, *points = track.to_geojson(place)["features"]
        assert line["geometry"]["type"] == "LineString"
        longitude, latitude, height = np.array([point["geometry"]["coordinates"] for point in points]).T
        enu = pymap3d.geodetic2enu(latitude, longitude, height, *place)
        np.testing.assert_allclose(np.array(enu).T, track.position_m[N_EMPTY:], atol=1e-6)


class TestSourceAtRest:
    """On a map, a source that no row puts elsewhere is one point."""

    PLACE = (48.0, 11.0, 500.0)

    @pytest.mark.slow
    def test_diver(self) -> None:
        """The magnet lies 0.6 m below the origin; the point is that of the best row, with its σ."""
        diver = magloc.datasets.load("diver")
        track = magloc.track(diver.array, diver.readings)
        (point,) = track.to_geojson(self.PLACE)["features"]
        assert point["geometry"]["type"] == "Point"
        found = point["properties"]
        sigma = np.array([found[f"sigma_{axis}_m"] for axis in ("east", "north", "up")])
        of_best = np.nanmin(np.trace(track.covariance[:, :3, :3], axis1=1, axis2=2))
        assert np.sum(sigma**2) == pytest.approx(of_best, rel=1e-12)
        enu = np.array(pymap3d.geodetic2enu(*np.array(point["geometry"]["coordinates"])[[1, 0, 2]], *self.PLACE))
        assert found["depth_m"] == pytest.approx(-enu[2], abs=1e-6)
        assert np.sum(((enu - [0.0, 0.0, -0.6]) / sigma) ** 2) < 16.3  # χ² of 3, once in a thousand
        assert len(found["moment_Am2"]) == len(found["sigma_moment_Am2"]) == 3
        kml = track.to_kml(self.PLACE)
        assert kml.count("<Placemark>") == kml.count("<Point>") == 1
        assert f"{' ± '.join(by_sigma(found['depth_m'], sigma[2]))} m below the origin" in kml

    def test_one_that_moves(self, track: magloc.Track) -> None:
        assert at_rest(track) is None
        kml = track.to_kml(self.PLACE)
        assert (kml.count("<LineString>"), kml.count("<Point>")) == (1, 2)  # its ends

    @pytest.mark.parametrize(("step_m", "rests"), [(0.0, True), (1e-3, False)])
    def test_known_places(self, step_m: float, rests: bool) -> None:
        """They have no covariance."""
        covariance = np.diag([0.0, 0.0, 0.0, 1.0, 1.0, 1.0])
        places = [np.array([1.0 + i * step_m, 2.0, 3.0]) for i in range(3)]
        points = [TrackPoint(float(i), place, np.ones(3), covariance) for i, place in enumerate(places)]
        assert (at_rest(points) is not None) == rests

    def test_one_row_tells_nothing(self, track: magloc.Track) -> None:
        assert at_rest([*track[:N_EMPTY], track[N_EMPTY]]) is None


class TestConsistency:
    @pytest.mark.parametrize("smooth", [False, True])
    def test_bound_is_that_of_the_estimator(self, smooth: bool) -> None:
        motion = magloc.OrnsteinUhlenbeck(0.1, 0.02)
        track = magloc.track(ARRAY, READINGS, motion=motion, smooth=smooth)
        found = track.consistency(TRUTH)
        tracker, rows = magloc.Tracker(ARRAY, motion), list(rows_of(READINGS))
        expected = posterior_bound(tracker, rows, TRUE_M, MOMENT_AM2, smooth=smooth)
        np.testing.assert_allclose(found.bound_m, expected, rtol=1e-9)
        np.testing.assert_array_equal(np.isfinite(found.nees), track.tracked)
        mean = found.nees[N_EMPTY:].sum() / found.nees_dof.sum()
        assert mean == pytest.approx(found.nees_per_dimension)

    def test_without_moments_there_is_no_bound(self, track: magloc.Track) -> None:
        found = track.consistency(magloc.Truth(TIME_S, TRUE_M))
        assert found.bound_m is None
        np.testing.assert_array_equal(found.nees_dof, np.where(track.tracked, 3, 0))

    def test_of_other_times(self, track: magloc.Track) -> None:
        with pytest.raises(InputError, match=r"^truth: found none of the times"):
            track.consistency(replace(TRUTH, time_s=TIME_S + 1e3))
