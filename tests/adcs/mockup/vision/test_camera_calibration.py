"""Tests of adcs.mockup.vision.camera_calibration.

Who checks whom
---------------

====================  =====================================================================================
of the calibration    oracle
====================  =====================================================================================
minimum               scipy.optimize.least_squares with numerical derivatives
estimates             the camera that took the frames
covariance            the scatter of many calibrations: χ² of all errors together
====================  =====================================================================================
"""

import math
from functools import cache

import numpy as np
import pytest
from scipy import optimize, stats

from adcs.mockup.vision.camera import Camera, Pose, distort, image_from_table, in_frame
from adcs.mockup.vision.camera_calibration import KnownFrame, calibrated_camera
from adcs.mockup.vision.centroids import find_stars
from adcs.mockup.vision.robust_matcher import RobustMatcher
from adcs.mockup.vision.sky import AmbiguousSkyWarning, LedSky, led_sky
from adcs.mockup.vision.triangles import TriangleCatalogue
from sims.experiments.mockup_vision import SkySetup, sky_run
from sims.mockup.frames import FrameQuality, rendered_frame

TRUTH = Camera(m_per_px=1.43e-3, k1=-0.05, centre_px=(325.0, 236.0))
TRUE_VALUES = np.array([1.43e-3, -0.05, 325.0, 236.0])
NOISE_PX = 0.04
sky = cache(led_sky)


def poses(n, rng):
    return [Pose(*place) for place in rng.uniform([-0.9, -0.7, -math.pi], [0.9, 0.7, math.pi], (n, 3))]


def measured(seed, n=15, position_sigma=0.0, heading_sigma=0.0, noise=NOISE_PX):
    """Centroids with Gaussian noise, and poses with Gaussian errors."""
    rng = np.random.default_rng(seed)
    frames = []
    for pose in poses(n, rng):
        pixels = image_from_table(TRUTH, pose, sky(0).positions_m)
        pixels = pixels[in_frame(TRUTH, pixels, 5.0)]
        error = rng.standard_normal(3) * [position_sigma, position_sigma, heading_sigma]
        believed = Pose(pose.x_m + error[0], pose.y_m + error[1], pose.heading_rad + error[2])
        frames.append(KnownFrame(believed, pixels + noise * rng.standard_normal(pixels.shape)))
    return frames


class TestEstimates:
    def test_exact_without_noise(self):
        calibration = calibrated_camera(sky(0), measured(1, noise=0.0))
        np.testing.assert_allclose(calibration.values, TRUE_VALUES, rtol=1e-9)
        assert calibration.residual_rms_px < 1e-9

    def test_minimum_of_the_squares(self):
        """Residuals of the same pairs, minimised without our derivatives."""
        frames = measured(2)
        calibration = calibrated_camera(sky(0), frames)

        def residuals(scaled):
            s, k1, *centre = scaled * [1e-3, 1.0, 1.0, 1.0]
            camera = Camera(m_per_px=s, k1=k1, centre_px=tuple(centre))
            left = []
            for frame in frames:
                all_px = image_from_table(camera, frame.pose, sky(0).positions_m)
                distance = np.linalg.norm(np.nan_to_num(all_px, nan=1e9)[:, None] - frame.positions_px, axis=-1)
                left.append(frame.positions_px - all_px[distance.argmin(axis=0)])
            return np.concatenate(left).ravel()

        start = TRUE_VALUES * [1e3, 1, 1, 1]
        best = optimize.least_squares(residuals, start, x_scale=[1e-4, 1e-3, 0.1, 0.1], xtol=1e-15)
        np.testing.assert_allclose(calibration.values, best.x * [1e-3, 1, 1, 1], atol=0.01 * calibration.std.min())
        free = best.fun.size - 4
        assert calibration.residual_rms_px == pytest.approx(np.sqrt(np.mean(best.fun**2)), rel=1e-6)
        covariance = np.linalg.inv(best.jac.T @ best.jac) * np.sum(best.fun**2) / free
        np.testing.assert_allclose(calibration.std, np.sqrt(np.diagonal(covariance)) * [1e-3, 1, 1, 1], rtol=0.1)

    @pytest.mark.slow_after(1)
    @pytest.mark.parametrize(("position_sigma", "heading_sigma"), [(0.0, 0.0), (1e-3, 1e-3)])
    def test_unbiased_and_as_uncertain_as_it_says(self, position_sigma, heading_sigma):
        """25 calibrations: each mean within 4 standard errors, and χ² of all four errors in its 99.99 % interval.

        False alarms: 4 · 6e-5 and 1e-4 for each case.
        """
        n = 25
        errors, chi2 = [], 0.0
        for seed in range(n):
            frames = measured(100 + seed, 15, position_sigma, heading_sigma)
            calibration = calibrated_camera(sky(0), frames, Camera(), position_sigma, heading_sigma)
            error = calibration.values - TRUE_VALUES
            errors.append(error / calibration.std)
            chi2 += error @ np.linalg.solve(calibration.covariance, error)
        assert np.abs(np.mean(errors, axis=0)).max() < 4.0 / math.sqrt(n)
        low, high = stats.chi2(4 * n).ppf([0.5e-4, 1.0 - 0.5e-4])
        assert low < chi2 < high

    def test_noise_is_told_from_the_poses_errors(self):
        """Poses off by 1 mm and 0.06° move lights by 0.8 px; centroids are off by 0.04 px, known to 5 % here."""
        calibration = calibrated_camera(sky(0), measured(3, 30, 1e-3, 1e-3), Camera(), 1e-3, 1e-3)
        assert calibration.noise_px == pytest.approx(NOISE_PX, rel=0.2)
        assert calibration.residual_rms_px > 10.0 * NOISE_PX

    def test_uncertain_poses_hide_the_centre_and_not_the_lens(self):
        exact = calibrated_camera(sky(0), measured(4))
        rough = calibrated_camera(sky(0), measured(4, 15, 1e-3, 1e-3), Camera(), 1e-3, 1e-3)
        np.testing.assert_array_less(rough.std[:2], 1.2 * exact.std[:2])
        assert (rough.std[2:] > 10.0 * exact.std[2:]).all()

    def test_more_frames_are_better(self):
        """Standard deviations fall with the root of the number of frames."""
        few, many = (calibrated_camera(sky(0), measured(5, n)).std for n in (10, 90))
        np.testing.assert_allclose(few / many, 3.0, rtol=0.25)


class TestPairs:
    def test_spurious_and_lost_lights_do_no_harm(self):
        rng = np.random.default_rng(7)
        frames = [
            KnownFrame(frame.pose, np.concatenate([frame.positions_px[2:], rng.uniform(0.0, 480.0, (2, 2))]))
            for frame in measured(6)
        ]
        calibration = calibrated_camera(sky(0), frames)
        assert np.abs((calibration.values - TRUE_VALUES) / calibration.std).max() < 5.0

    def test_start_far_off(self):
        """5 % of scale, 0.05 of distortion and 15 px of centre."""
        start = Camera(m_per_px=1.36e-3, k1=0.0, centre_px=(330.0, 225.0))
        calibration = calibrated_camera(sky(0), measured(8), start)
        assert np.abs((calibration.values - TRUE_VALUES) / calibration.std).max() < 5.0

    def test_poses_of_another_sky(self):
        frames = [KnownFrame(Pose(40.0, 40.0, 0.0), frame.positions_px) for frame in measured(9)]
        with pytest.raises(ValueError, match="8 lights near their predicted places; instead received 0"):
            calibrated_camera(sky(0), frames)

    def test_no_frames_and_empty_ones(self):
        for frames in ([], [KnownFrame(Pose(0.0, 0.0, 0.0), np.empty((0, 2)))]):
            with pytest.raises(ValueError, match="instead received 0"):
                calibrated_camera(sky(0), frames)

    def test_lights_on_one_circle_do_not_tell_scale_and_distortion_apart(self):
        angles = np.linspace(0.0, 6.0, 12)
        with pytest.warns(AmbiguousSkyWarning):
            circle = LedSky(0.25 * np.stack([np.cos(angles), np.sin(angles)], axis=1))
        pose = Pose(0.0, 0.0, 0.3)
        frame = KnownFrame(pose, image_from_table(Camera(), pose, circle.positions_m))
        with pytest.raises(ValueError, match="determine the camera"):
            calibrated_camera(circle, [frame])

    def test_negative_sigma(self):
        with pytest.raises(ValueError, match="sigmas"):
            calibrated_camera(sky(0), measured(9), Camera(), -1.0)


class TestFrames:
    """From rendered frames to fixes."""

    def calibration(self):
        rng = np.random.default_rng(11)
        quality = FrameQuality(spurious=1, lost=0.05)
        frames = []
        for pose in poses(25, rng):
            image = rendered_frame(sky(0), Camera(k1=-0.05), pose, rng, quality=quality).image
            frames.append(KnownFrame(pose, find_stars(image).positions_px))
        return calibrated_camera(sky(0), frames)

    def test_residual_falls_to_the_noise_of_centroids(self):
        """0.036 px, as tests of the centroids have it; without the lens it would be 7 px."""
        calibration = self.calibration()
        assert calibration.residual_rms_px == pytest.approx(calibration.noise_px, rel=0.05)
        assert calibration.noise_px == pytest.approx(0.036, rel=0.15)
        truth = [0.9 / 640, -0.05, 319.5, 239.5]
        assert np.abs((calibration.values - truth) / calibration.std).max() < 5.0

    def test_fixes_reach_the_accuracy_of_a_camera_without_distortion(self):
        """With the estimated k1 in the place of the true one."""
        k1 = self.calibration().camera.k1
        catalogue = TriangleCatalogue.of(sky(0).positions_m)
        rms = {}
        for name, setup in {
            "clean": SkySetup(poses=40),
            "blind": SkySetup(poses=40, k1=-0.05),
            "calibrated": SkySetup(poses=40, k1=-0.05, believed_k1=k1),
        }.items():
            run = sky_run(sky(0), RobustMatcher(catalogue, setup.believed_camera.m_per_px), setup, [4])
            assert run.good.all()
            rms[name] = run.summary()["position_rms_mm"]
        assert rms["blind"] > 0.5
        assert rms["calibrated"] < 1.3 * rms["clean"]

    def test_straight_lines(self):
        """Light by light: what the lens bent lies where an ideal lens would show it."""
        camera = self.calibration().camera
        grid = np.stack(np.meshgrid([-300.0, 0.0, 300.0], [-200.0, 0.0, 200.0]), axis=-1).reshape(-1, 2)
        shown = distort(Camera(k1=-0.05), grid)
        assert np.abs(distort(camera, grid) - shown).max() < 0.05
