"""Tracking: what a prediction adds to a matcher that knows nothing.

What is checked                  by what
places and radii                 finite differences of the camera's projection; predictions drawn at random
fixes                            the truth of simulated frames, against the matcher by odds

Statistical tests have one fixed seed that was not chosen; see :mod:`tests.adcs.mockup.vision.test_paper_matcher`.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from adcs.mockup.vision.camera import Camera, Pose, centred_from_table, distort, in_frame
from adcs.mockup.vision.odds_matcher import OddsMatcher
from adcs.mockup.vision.paper_matcher import CameraFix
from adcs.mockup.vision.pose_odds import PoseOdds
from adcs.mockup.vision.predicted_matcher import CENTROID_PX, LightTracker, expected_lights
from adcs.stars.identification import NoFix
from tests.adcs.mockup.stars_of_poses import Field, catalogue, projected, projected_set, score, score_of

SPARSE = Field(footprint_m=0.45)
POSE = Pose(0.3, -0.2, 0.7)


def covariance(position_m, heading_deg):
    return np.diag([position_m, position_m, math.radians(heading_deg)]) ** 2


def predicted(pose, P, rng, wrong_m=0.0):
    x, y, heading = rng.multivariate_normal([pose.x_m, pose.y_m, pose.heading_rad], P)
    course = rng.uniform(-math.pi, math.pi)
    return Pose(x + wrong_m * math.cos(course), y + wrong_m * math.sin(course), heading)


def tracked(field, P, n, wrong_m=0.0):
    """Score of the tracker over frames, with predictions drawn from their covariance."""
    tracker = LightTracker(PoseOdds.of(catalogue(), field.camera))
    rng = np.random.default_rng(10)
    frames = projected_set(field, n, 0)
    return score_of(
        [(tracker.identify_near(points, predicted(pose, P, rng, wrong_m), P), pose) for pose, points in frames]
    )


class TestExpectedLights:
    def test_places_are_those_of_the_camera(self):
        expected = expected_lights(catalogue(), Camera(), POSE, covariance(0.01, 1.0))
        places = centred_from_table(Camera(), POSE, catalogue().positions_m[expected.lights])
        assert_allclose(expected.points_px, places, atol=1e-9)

    def test_radius_is_the_worst_axis_of_the_projected_covariance(self):
        P = np.array([[4e-4, 1e-4, 2e-5], [1e-4, 1e-4, -1e-5], [2e-5, -1e-5, 3e-5]])
        expected = expected_lights(catalogue(), Camera(), POSE, P, sigmas=3.0)
        lights = catalogue().positions_m[expected.lights]
        step = 1e-6
        J = np.stack(
            [
                centred_from_table(Camera(), Pose(*(np.array([0.3, -0.2, 0.7]) + step * axis)), lights)
                - centred_from_table(Camera(), Pose(*(np.array([0.3, -0.2, 0.7]) - step * axis)), lights)
                for axis in np.eye(3)
            ],
            axis=-1,
        ) / (2.0 * step)
        largest = np.linalg.eigvalsh(J @ P @ np.swapaxes(J, 1, 2))[:, 1]
        assert_allclose(expected.radius_px, 3.0 * np.sqrt(largest + CENTROID_PX**2), rtol=1e-6)

    def test_all_lights_in_the_frame_are_expected(self):
        """From any pose that the prediction allows (4 σ: one of 3,000 beyond)."""
        P, rng = covariance(0.02, 1.0), np.random.default_rng(0)
        expected = expected_lights(catalogue(), Camera(), POSE, P)
        for _ in range(200):
            points = centred_from_table(Camera(), predicted(POSE, P, rng), catalogue().positions_m)
            seen = np.flatnonzero(in_frame(Camera(), distort(Camera(), points)))
            row = np.searchsorted(expected.lights, seen)
            assert np.isin(seen, expected.lights).all()
            distance = np.linalg.norm(points[seen] - expected.points_px[row], axis=1)
            # A turn bends the path of a light that is far from the centre, by half its square: 1.4 px at 4 σ.
            assert (distance <= expected.radius_px[row] + 1.5).all()

    def test_lights_behind_the_fold_of_a_lens_are_not(self):
        expected = expected_lights(catalogue(), Camera(k1=-0.05), POSE, covariance(0.001, 0.1))
        place = distort(Camera(k1=-0.05), expected.points_px)
        assert np.isfinite(place).all()

    @pytest.mark.parametrize(
        "P", [np.eye(2), np.full((3, 3), np.nan), -np.eye(3), np.array([[1.0, 1, 0], [0, 1, 0], [0, 0, 1]])]
    )
    def test_no_covariance(self, P):
        with pytest.raises(ValueError, match="Input covariance must be"):
            expected_lights(catalogue(), Camera(), POSE, P)


class TestFixes:
    @pytest.mark.parametrize(("position_m", "heading_deg"), [(0.005, 0.2), (0.02, 0.5)])
    def test_sparse_fields(self, position_m, heading_deg):
        """Every frame of two stars and more, where the matcher that knows nothing needs three."""
        result = tracked(SPARSE, covariance(position_m, heading_deg), 200)
        frames = projected_set(SPARSE, 200, 0)
        assert result.success >= score(OddsMatcher.of(catalogue(), SPARSE.camera), frames).success + 0.1
        assert result.success >= 0.95 * np.mean([len(points) >= 2 for _, points in frames])
        assert result.false == 0

    def test_damaged_fields(self):
        result = tracked(Field(lost=0.4, spurious=6), covariance(0.02, 0.5), 120)
        assert result.success >= 0.9
        assert result.false == 0

    @pytest.mark.parametrize("field", [Field(), SPARSE, replace(SPARSE, lost=0.25, spurious=2)])
    def test_a_wrong_prediction_gives_no_fix(self, field):
        """30 cm off where it claims 2 cm: the lights there are others."""
        result = tracked(field, covariance(0.02, 0.5), 100, wrong_m=0.3)
        assert (result.success, result.false) == (0.0, 0)

    def test_the_fix_is_that_of_the_stars(self):
        """A prediction that is off by one σ does not draw the fix towards it."""
        tracker = LightTracker(PoseOdds.of(catalogue(), Camera()))
        points = projected(catalogue(), Field(noise_px=0.0), POSE, np.random.default_rng(0))
        fix = tracker.identify_near(points, Pose(0.32, -0.21, 0.71), covariance(0.02, 0.5))
        assert_allclose(fix.position_m, POSE.position_m, atol=1e-12)
        assert fix.heading_rad == pytest.approx(POSE.heading_rad, abs=1e-12)

    def test_one_star_is_no_fix(self):
        tracker = LightTracker(PoseOdds.of(catalogue(), Camera()))
        points = projected(catalogue(), Field(noise_px=0.0), POSE, np.random.default_rng(0))
        assert isinstance(tracker.identify_near(points[:1], POSE, covariance(0.005, 0.2)), NoFix)
        assert isinstance(tracker.identify_near(points[:2], POSE, covariance(0.005, 0.2)), CameraFix)
        assert isinstance(tracker.identify_near([], POSE, covariance(0.005, 0.2)), NoFix)

    def test_a_mirrored_image_is_refused(self):
        tracker = LightTracker(PoseOdds.of(catalogue(), Camera()))
        points = projected(catalogue(), Field(noise_px=0.0), POSE, np.random.default_rng(0))
        assert isinstance(tracker.identify_near(points * [1.0, -1.0], POSE, covariance(0.02, 0.5)), NoFix)

    @pytest.mark.slow
    def test_three_thousand_sparse_frames_without_a_false_fix(self):
        for lost, spurious, wrong in ((0.1, 1, 0.0), (0.25, 2, 0.0), (0.1, 1, 0.3)):
            field = replace(SPARSE, lost=lost, spurious=spurious)
            assert tracked(field, covariance(0.02, 0.5), 1000, wrong).false == 0
