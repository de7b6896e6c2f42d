"""The fixed-interval smoother: filterpy's, and no farther than a track."""

from __future__ import annotations

import numpy as np
from filterpy.kalman import KalmanFilter
from numpy.typing import NDArray

from magloc.tracking.batch import track_record
from magloc.tracking.chart.coordinates import Chart
from magloc.tracking.chart.mixture import Mixture
from magloc.tracking.motion import OrnsteinUhlenbeck
from magloc.tracking.results import Step, TrackPoint
from magloc.tracking.smoother import smoothed
from magloc.tracking.tracker import Tracker
from tests.passing_source import ARRAY, SLOW, moving_source, positions, readings_of, rows_from

FloatArray = NDArray[np.float64]


class TestSmoother:
    def test_is_filterpys(self) -> None:
        """Of steps so small that the chart is flat, by filterpy's Rauch-Tung-Striebel smoother in its coordinates."""
        rng = np.random.default_rng(4)
        n, small = 12, 1e-6
        place = np.array([3.0, 1.5, 0.8, 120.0, -150.0, 160.0])
        chart = Chart.at(place[None], ARRAY.centroid, ARRAY.circumradius)
        reference = KalmanFilter(dim_x=6, dim_z=4)
        reference.F = np.eye(6) + 0.1 * rng.normal(size=(6, 6))
        reference.H = rng.normal(size=(4, 6))
        reference.Q, reference.R, reference.P = 0.1 * np.eye(6), 0.5 * np.eye(4), 4.0 * np.eye(6)
        points, steps, xs, Ps = [], [], [], []

        def mixture(x: FloatArray, P: FloatArray) -> Mixture:
            state = chart.retracted(small * x[None])
            S = small * np.linalg.cholesky(P)[None]
            return Mixture(state, S, np.zeros(1), 6, ARRAY.centroid, ARRAY.circumradius)

        for i in range(n):
            prediction = None
            if i:
                reference.predict()
                prediction = mixture(reference.x.ravel(), reference.P)
            reference.update(rng.normal(size=4))
            x, P = reference.x.ravel().copy(), 0.5 * (reference.P + reference.P.T)
            xs.append(x)
            Ps.append(P)
            steps.append(Step(i, mixture(x, P), prediction, reference.F if i else None))
            points.append(TrackPoint(float(i), place[:3], place[3:], np.eye(6), status="tracked"))
        expected_x, expected_P, _, _ = reference.rts_smoother(np.array(xs)[..., None], np.array(Ps))
        for i, point in enumerate(smoothed(points, steps)):
            assert point.mixture is not None
            found = chart.coordinates(point.mixture.x)[0] / small
            np.testing.assert_allclose(found, expected_x[i].ravel(), atol=1e-3)
            root = point.mixture.S[0] / small
            np.testing.assert_allclose(root @ root.T, expected_P[i], rtol=1e-3, atol=1e-3)

    def test_goes_no_farther_than_a_track(self) -> None:
        """Every track is smoothed by itself: the last row of one stays as the filter had it."""
        time_s, p, m = moving_source(30)
        p[15:] += [-6.0, 0.0, 0.0]
        tracker = Tracker(ARRAY, SLOW, keep_steps=True)
        points = track_record(tracker, rows_from(time_s, readings_of(ARRAY, p, m)))
        again = points.index(next(point for point in points[1:] if point.status == "acquired"))
        finished = smoothed(points, tracker.steps)
        np.testing.assert_array_equal(finished[again - 1].position_m, points[again - 1].position_m)
        np.testing.assert_array_equal(finished[-1].position_m, points[-1].position_m)
        assert np.abs(positions(finished)[5] - positions(points)[5]).max() > 0.0

    def test_never_claims_to_know_less(self) -> None:
        time_s, p, m = moving_source(40)
        tracker = Tracker(ARRAY, OrnsteinUhlenbeck(0.1, 0.02), keep_steps=True)
        points = track_record(tracker, rows_from(time_s, readings_of(ARRAY, p, m)))
        for before, after in zip(points, smoothed(points, tracker.steps), strict=True):
            assert before.covariance is not None
            assert after.covariance is not None
            assert (np.diagonal(after.covariance) <= np.diagonal(before.covariance) * (1.0 + 1e-9)).all()

    def test_keeps_no_steps_unless_asked(self) -> None:
        time_s, p, m = moving_source(5)
        tracker = Tracker(ARRAY, SLOW)
        track_record(tracker, rows_from(time_s, readings_of(ARRAY, p, m)))
        assert tracker.steps == []
