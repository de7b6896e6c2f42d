"""The mock-up end to end: fixes of rendered frames along a drive."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from adcs.mockup.navigation.strapdown import wrapped
from adcs.mockup.vision.camera import undistorted
from adcs.mockup.vision.centroids import find_stars
from adcs.mockup.vision.paper_matcher import camera_fix
from adcs.mockup.vision.triangles import TriangleCatalogue
from sims.cli.mockup_options import MockupOptions
from sims.experiments.mockup_camera import TableCamera
from sims.experiments.mockup_navigation import fused_runs
from sims.mockup.frames import pose_and_motion, rendered_frame
from sims.mockup.table_run import CameraErrors, TableScenario, table_run

SCENARIO = TableScenario(duration_s=12.0)
SEED = 3


@pytest.fixture(scope="module")
def camera() -> TableCamera:
    return replace(MockupOptions().table_camera(), delay_s=0.25)


class TestFixes:
    def test_they_are_those_of_the_frames_where_the_satellite_truly_is(self, camera):
        run = camera.run(SCENARIO, SEED)
        at_s = float(run.exposure_s[4])
        pose, motion = pose_and_motion(run.truth, at_s)
        setup = camera.setup
        rng = np.random.default_rng([SEED, round(1e3 * at_s)])
        image = rendered_frame(camera.sky, setup.camera, pose, rng, motion, setup).image
        stars = undistorted(setup.camera, find_stars(image).positions_px)
        fix = camera.matcher.identify(stars)
        np.testing.assert_array_equal(run.fixes.position_m[4], fix.position_m)
        assert run.fixes.heading_rad[4] == fix.heading_rad

    def test_they_are_near_the_truth(self, camera):
        run = camera.run(SCENARIO, SEED)
        true = run.truth.at(run.exposure_s)
        assert np.hypot(*(run.fixes.position_m - true.position_m).T).max() < 5e-3
        assert np.abs(wrapped(run.fixes.heading_rad - true.heading_rad)).max() < np.radians(0.5)
        assert not run.false.any()

    def test_a_frame_at_every_exposure_of_the_drive(self, camera):
        exact = CameraErrors(failed=0.0)
        run = camera.run(SCENARIO, SEED)
        np.testing.assert_array_equal(run.exposure_s, table_run(replace(SCENARIO, camera=exact), SEED).exposure_s)

    def test_a_dark_sky_gives_none(self, camera):
        dark = replace(camera, setup=replace(camera.setup, lost=1.0))
        assert len(dark.run(SCENARIO, SEED).fixes) == 0
        summary = fused_runs("ekf", SCENARIO, [SEED], simulate=dark.run).summary()
        assert (summary["fixes"], summary["delay_ms_median"]) == (0, None)

    def test_outages_stay(self, camera):
        scenario = replace(SCENARIO, camera=CameraErrors(outages_s=((4.0, 8.0),)))
        exposure_s = camera.run(scenario, SEED).exposure_s
        assert not ((exposure_s >= 4.0) & (exposure_s < 8.0)).any()
        assert exposure_s.size

    def test_a_wrong_lens_is_seen_in_the_fixes(self, camera):
        wrong = replace(camera, setup=replace(camera.setup, k1=-0.05))
        exact, bent = camera.run(SCENARIO, SEED), wrong.run(SCENARIO, SEED)
        assert _rms_m(bent) > 1.5 * _rms_m(exact)


class TestSigma:
    """What a fix says of its own errors."""

    def test_it_is_that_of_the_fit(self):
        """Least squares of a similarity, by numerical derivatives of all its unknowns."""
        rng = np.random.default_rng(1)
        catalogue = TriangleCatalogue.of(rng.uniform(-0.4, 0.4, (12, 2)))
        image = rng.uniform(-300.0, 300.0, 12) + 1j * rng.uniform(-200.0, 200.0, 12)
        a, b = 1.4e-3 * np.exp(0.4j), 0.3 - 0.2j
        pairs = np.column_stack([np.arange(12), np.arange(12)])
        fix = camera_fix(catalogue, image, pairs, a, b, 12)

        def places(unknowns):
            x, y, heading, scale = unknowns
            at = scale * np.exp(1j * heading) * image + (x + 1j * y)
            return np.concatenate([at.real, at.imag])

        at = np.array([b.real, b.imag, 0.4, 1.4e-3])
        steps = np.diag(1e-6 * np.array([1.0, 1.0, 1.0, 1e-3]))
        J = np.column_stack([(places(at + step) - places(at - step)) / (2.0 * step.sum()) for step in steps])
        of_unit_noise = np.sqrt(np.diagonal(np.linalg.inv(J.T @ J)))
        assert fix.sigma_rad / fix.sigma_m == pytest.approx(of_unit_noise[2] / of_unit_noise[0], rel=1e-6)
        noise_m = fix.sigma_m / of_unit_noise[0]
        # With 20 numbers to spare it is nearly what the stars' distances say: half of their squares along each axis.
        assert noise_m == pytest.approx(fix.rms_m * np.sqrt(12 / 20), rel=0.2)

    def test_it_is_right(self, camera):
        """Three numbers of each of 60 fixes or so: mean squares over variances, 1 in 10,000 outside of 0.4 to 1.7."""
        runs = [camera.run(TableScenario(duration_s=18.0), seed) for seed in (60, 61)]
        errors = []
        for run in runs:
            true = run.truth.at(run.exposure_s)
            heading = wrapped(run.fixes.heading_rad - true.heading_rad)
            errors.append(np.column_stack([run.fixes.position_m - true.position_m, heading]) / run.fixes.sigma)
        assert 0.4 < np.mean(np.concatenate(errors) ** 2) < 1.7

    def test_the_filter_uses_it(self, camera):
        run = camera.run(SCENARIO, SEED)
        silent = replace(run, fixes=replace(run.fixes, sigma=None))
        errors = [
            fused_runs("ekf", SCENARIO, [SEED], simulate=lambda _, __, run=run: run).summary()["position_rms_mm"]
            for run in (run, silent)
        ]
        assert errors[0] < 0.5 * errors[1]


class TestDelay:
    def test_one_that_is_said(self, camera):
        run = camera.run(SCENARIO, SEED)
        np.testing.assert_allclose(run.fixes.arrival_s - run.exposure_s, 0.25, rtol=1e-9)

    def test_else_what_the_frame_takes_after_its_exposure(self, camera):
        delay_s = (lambda run: run.fixes.arrival_s - run.exposure_s)(replace(camera, delay_s=None).run(SCENARIO, SEED))
        # More than the rest of the exposure, and every frame another time.
        assert delay_s.min() > 0.5 * camera.setup.camera.exposure_s
        assert np.unique(delay_s).size == delay_s.size

    def test_the_same_fixes_whatever_it_is(self, camera):
        first, later = camera.run(SCENARIO, SEED), replace(camera, delay_s=1.0).run(SCENARIO, SEED)
        np.testing.assert_array_equal(first.fixes.position_m, later.fixes.position_m)


def _rms_m(run) -> float:
    error = run.fixes.position_m - run.truth.at(run.exposure_s).position_m
    return float(np.sqrt(np.mean(np.sum(error**2, axis=1))))
