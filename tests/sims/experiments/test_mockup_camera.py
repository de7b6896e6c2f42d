"""The mock-up end to end: fixes of rendered frames along a drive."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from adcs.mockup.navigation.strapdown import wrapped
from adcs.mockup.vision.camera import undistorted
from adcs.mockup.vision.centroids import find_stars
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
