"""The fixed-interval smoother: filterpy's, and no farther than a track."""

from __future__ import annotations

import numpy as np
from filterpy.kalman import KalmanFilter

from magloc.tracking.motion import OrnsteinUhlenbeck
from magloc.tracking.results import Prediction, Step
from magloc.tracking.tracker import Tracker
from magloc.tracking.whole_records.smoother import smooth_points, smooth_states
from tests.passing_source import ARRAY, SLOW, followed, moving_source, positions, readings_of, rows_from


class TestSmoother:
    def test_is_filterpys(self) -> None:
        """Of a linear system with random transitions, by filterpy's Rauch-Tung-Striebel smoother."""
        rng = np.random.default_rng(4)
        n = 12
        reference = KalmanFilter(dim_x=6, dim_z=4)
        reference.F = np.eye(6) + 0.1 * rng.normal(size=(6, 6))
        reference.H = rng.normal(size=(4, 6))
        reference.Q, reference.R, reference.P = 0.1 * np.eye(6), 0.5 * np.eye(4), 4.0 * np.eye(6)
        steps, xs, Ps = [], [], []
        for i in range(n):
            prediction = None
            if i:
                reference.predict()
                x_predicted = reference.x.ravel().copy()
                root = np.linalg.cholesky(reference.P)
                prediction = Prediction(x_predicted, root, reference.F, np.linalg.cholesky(reference.Q))
            reference.update(rng.normal(size=4))
            x, P = reference.x.ravel().copy(), 0.5 * (reference.P + reference.P.T)
            xs.append(x)
            Ps.append(P)
            steps.append(Step(i, prediction, x, np.linalg.cholesky(P)))
        expected_x, expected_P, _, _ = reference.rts_smoother(np.array(xs)[..., None], np.array(Ps))
        for i, (x, S) in enumerate(smooth_states(steps)):
            np.testing.assert_allclose(x, expected_x[i].ravel(), rtol=1e-8, atol=1e-9)
            np.testing.assert_allclose(S @ S.T, expected_P[i], rtol=1e-8, atol=1e-9)

    def test_goes_no_farther_than_a_track(self) -> None:
        """Every track is smoothed by itself: the last row of one stays as the filter had it."""
        time_s, p, m = moving_source(30)
        p[15:] += [-6.0, 0.0, 0.0]
        tracker = Tracker(ARRAY, SLOW, keep_steps=True)
        points = followed(tracker, rows_from(time_s, readings_of(ARRAY, p, m)))
        again = points.index(next(point for point in points[1:] if point.status == "acquired"))
        finished = smooth_points(points, tracker.steps)
        np.testing.assert_allclose(positions(finished)[again - 1], positions(points)[again - 1], rtol=1e-9)
        np.testing.assert_allclose(positions(finished)[-1], positions(points)[-1], rtol=1e-9)
        assert np.abs(positions(finished)[5] - positions(points)[5]).max() > 0.0

    def test_never_claims_to_know_less(self) -> None:
        time_s, p, m = moving_source(40)
        tracker = Tracker(ARRAY, OrnsteinUhlenbeck(0.1, 0.02), keep_steps=True)
        points = followed(tracker, rows_from(time_s, readings_of(ARRAY, p, m)))
        for before, after in zip(points, smooth_points(points, tracker.steps), strict=True):
            assert before.covariance is not None
            assert after.covariance is not None
            assert (np.diagonal(after.covariance) <= np.diagonal(before.covariance) * (1.0 + 1e-9)).all()

    def test_keeps_no_steps_unless_asked(self) -> None:
        time_s, p, m = moving_source(5)
        tracker = Tracker(ARRAY, SLOW)
        followed(tracker, rows_from(time_s, readings_of(ARRAY, p, m)))
        assert tracker.steps == []
