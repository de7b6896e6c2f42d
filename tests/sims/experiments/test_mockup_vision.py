"""Tests of sims.experiments.mockup_vision: whole frames, from light to fix, against the truth.

The figures asked for are those of spec 5 section 9; poses are random within ±1.25 m and ±1 m, the range of the source
paper's figures. The clean rows succeed in all frames, so that bounds of 97 and 99 % stand by the physics and not by the
draw. Shares of the damaged rows are binomial, with a deviation of 4 % of 120 frames: measured with seed 0, which was
not chosen, they are 64 % (paper, 55 asked), 85 % (robust, 75 asked) and 50 % (robust, badly damaged, 45 asked); the
slow size has 750 to 1500 frames of each.
"""

import math
import os
import subprocess
import sys
from dataclasses import replace
from functools import cache, lru_cache

import numpy as np
import pytest

from adcs.io.frame_files import write_frame
from adcs.mockup.vision.camera import Camera, Pose
from adcs.mockup.vision.centroids import find_faint_stars
from adcs.mockup.vision.paper_matcher import CameraFix, PaperMatcher
from adcs.mockup.vision.robust_matcher import RobustMatcher
from adcs.mockup.vision.sky import led_sky
from adcs.mockup.vision.triangles import TriangleCatalogue
from adcs.stars.identification import NoFix
from arrays.io.errors import InputError
from sims.experiments import mockup_vision as mockup_sky
from sims.experiments.mockup_vision import SkyRun, SkySetup, frame_result, identified_files, random_frame, sky_run
from sims.mockup.frames import rendered_frame

sky = cache(led_sky)
MOVING = SkySetup(poses=60, speed_m_s=0.6, turn_rate_rad_s=math.radians(29.0))
DISTORTED = SkySetup(poses=60, k1=-0.05)
DAMAGED = SkySetup(lost=0.25, spurious=4)


@pytest.fixture(scope="module", autouse=True)
def frames_are_rendered_once():
    """Rendering takes most of the time, and matchers share the frames of a set-up."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mockup_sky, "random_frame", lru_cache(maxsize=128)(random_frame))
        yield


@cache
def catalogue():
    return TriangleCatalogue.of(sky().positions_m)


def paper(setup):
    return PaperMatcher(catalogue())


def robust(setup):
    return RobustMatcher(catalogue(), setup.believed_camera.m_per_px)


@cache
def run(matcher, setup, seed=0):
    return sky_run(sky(), matcher(setup), setup, [seed])


def summary(matcher, setup):
    return run(matcher, setup).summary()


class TestAcceptance:
    @pytest.mark.parametrize("matcher", [paper, robust])
    def test_moving(self, matcher):
        result = summary(matcher, MOVING)
        assert result["success"] >= 0.97
        assert result["position_rms_mm"] <= 0.7
        assert result["false_fixes"] == 0

    def test_distorted(self):
        result = summary(robust, DISTORTED)
        assert result["success"] >= 0.97
        assert result["position_rms_mm"] <= 2.0

    @pytest.mark.slow_after(1)
    @pytest.mark.parametrize("matcher", [robust, paper])
    def test_calibrated_distortion_is_none(self, matcher):
        """The camera of a known k1 is as good as one without."""
        result = summary(matcher, replace(DISTORTED, believed_k1=-0.05))
        assert result["success"] >= 0.99
        assert result["position_rms_mm"] <= 1.3 * summary(matcher, SkySetup())["position_rms_mm"]

    def test_sums_of_pixels_stand_motion_that_breaks_lights_into_pieces(self):
        """1 m/s and 57°/s: with plain pixels spec 5 has 60 %, and 3.0 mm."""
        setup = SkySetup(poses=60, speed_m_s=1.0, turn_rate_rad_s=math.radians(57.0))
        result = sky_run(sky(), robust(setup), setup, finder=find_faint_stars).summary()
        assert result["success"] >= 0.97
        assert result["position_rms_mm"] <= 0.5
        assert result["false_fixes"] == 0
        assert summary(robust, setup)["success"] < 0.95

    def test_hot_pixels_do_nothing(self):
        assert summary(robust, SkySetup(poses=20, hot_pixels=10))["success"] == 1.0


@pytest.mark.slow
class TestManyFrames:
    @pytest.mark.parametrize("seed", [1, 2])
    def test_other_skies(self, seed):
        other = led_sky(seed)
        matcher = RobustMatcher(TriangleCatalogue.of(other.positions_m), Camera().m_per_px)
        for setup, success in ((SkySetup(poses=300), 0.99), (replace(MOVING, poses=300), 0.97)):
            result = sky_run(other, matcher, setup, [seed]).summary()
            assert result["success"] >= success
            assert result["false_fixes"] == 0


class StandIn:
    """A matcher that gives the fixes that it is told, in turn."""

    def __init__(self, *fixes):
        self.fixes = list(fixes)

    def identify(self, points_px):
        return self.fixes.pop(0)


def fix(x, y, heading):
    return CameraFix(np.array([x, y]), heading, np.zeros((3, 2), dtype=np.intp), 0.0, 3, 1e-3)


class TestScore:
    def scored(self, *offsets):
        """A run whose fixes are off by (x, y, heading), or no fix for None."""
        setup = SkySetup(poses=len(offsets))
        truth = sky_run(sky(), StandIn(*[NoFix("none")] * len(offsets)), setup).truth
        fixes = [NoFix("none") if off is None else fix(*(true + off)) for off, true in zip(offsets, truth, strict=True)]
        return sky_run(sky(), StandIn(*fixes), setup)

    def test_good_false_and_none(self):
        turn = math.radians(2.1)
        result = self.scored(
            (0.003, 0.004, 0.01), None, (0.0, 0.021, 0.0), (0.0, 0.0, turn), (0.0, 0.0, -turn), (0.015, -0.012, 0.0)
        )
        assert result.good.tolist() == [True, False, False, False, False, True]
        assert result.false_fixes.tolist() == [False, False, True, True, True, False]
        summary = result.summary()
        assert summary["success"] == pytest.approx(2 / 6)
        assert summary["false_fixes"] == 3
        assert summary["position_rms_mm"] == pytest.approx(math.sqrt((25 + 225 + 144) / 2))
        assert summary["heading_rms_deg"] == pytest.approx(math.degrees(0.01) / math.sqrt(2.0))
        assert [each.reason for each in result.results] == ["", "none", "", "", "", ""]
        assert [each.matched for each in result.results] == [3, 0, 3, 3, 3, 3]

    def test_whole_turns_do_not_count(self):
        result = self.scored((0.0, 0.0, 2.0 * math.pi), (0.0, 0.0, -2.0 * math.pi + 0.01))
        assert result.good.all()
        assert result.heading_errors_rad[1] == pytest.approx(0.01)

    def test_nothing_found(self):
        summary = self.scored(None, None).summary()
        assert summary["success"] == 0.0
        assert summary["position_rms_mm"] is None
        assert summary["heading_rms_deg"] is None

    def test_keys(self):
        assert list(summary(robust, SkySetup())) == [
            "poses",
            "success",
            "false_fixes",
            "position_rms_mm",
            "heading_rms_deg",
            "identify_ms_median",
            "frame_ms_median",
        ]


class TestRun:
    def test_poses_are_all_over_the_sky(self):
        truth = run(robust, SkySetup()).truth
        assert (np.abs(truth) <= [1.25, 1.0, math.pi]).all()
        assert (np.ptp(truth, axis=0) > [2.2, 1.8, 6.0]).all()

    def test_a_frame_does_not_depend_on_the_others(self):
        few = sky_run(sky(), robust(DAMAGED), replace(DAMAGED, poses=5))
        np.testing.assert_array_equal(few.estimates, run(robust, DAMAGED).estimates[:5])

    def test_a_row_can_be_had_again(self):
        result = run(robust, DAMAGED)
        pose, frame = random_frame(sky(), DAMAGED, 0, 7)
        np.testing.assert_array_equal([*pose.position_m, pose.heading_rad], result.truth[7])
        again = frame_result(frame.image, DAMAGED.believed_camera, robust(DAMAGED))
        assert len(again.stars) == len(result.results[7].stars)

    def test_seeds(self):
        setup = SkySetup(poses=3)
        runs = [sky_run(sky(), robust(setup), setup, seeds) for seeds in ([4], [4, 5], [5])]
        np.testing.assert_array_equal(runs[0].estimates, runs[1].estimates[:3])
        np.testing.assert_array_equal(runs[2].estimates, runs[1].estimates[3:])
        assert not np.array_equal(runs[0].truth, runs[2].truth)

    @pytest.mark.slow
    def test_number_of_threads_changes_no_digit(self, tmp_path):
        script = (
            "from adcs.mockup.vision.sky import led_sky; from adcs.mockup.vision.triangles import TriangleCatalogue;"
            "from adcs.mockup.vision.robust_matcher import RobustMatcher; from sims.experiments.mockup_vision import *;"
            "s = SkySetup(poses=6, lost=0.2, spurious=3); c = TriangleCatalogue.of(led_sky(0).positions_m);"
            "print(sky_run(led_sky(0), RobustMatcher(c, s.camera.m_per_px), s).estimates.tobytes().hex())"
        )
        printed = [
            subprocess.run(
                [sys.executable, "-c", script],
                env={**os.environ, "OMP_NUM_THREADS": n, "OPENBLAS_NUM_THREADS": n},
                capture_output=True,
                text=True,
                check=True,
            ).stdout
            for n in ("1", "2")
        ]
        assert len(printed[0]) > 200
        assert printed[0] == printed[1]

    def test_frames_in_which_nothing_shines_have_no_stars(self):
        """All lights dark, and no noise: one value in all pixels, which as a file is refused."""
        result = sky_run(sky(), robust(SkySetup()), SkySetup(poses=2, noise_DN=0.0, lost=1.0))
        assert [len(each.stars) for each in result.results] == [0, 0]
        assert [each.reason for each in result.results] == ["0 stars, 5 needed"] * 2

    def test_progress(self):
        steps = []
        sky_run(sky(), robust(SkySetup()), SkySetup(poses=4), progress=steps.append)
        assert sum(steps) == 4

    @pytest.mark.parametrize(
        ("keys", "name"),
        [
            ({"poses": 0}, "poses"),
            ({"speed_m_s": -1.0}, "speed_m_s"),
            ({"turn_rate_rad_s": math.nan}, "turn_rate_rad_s"),
            ({"lost": 1.5}, "lost"),
            ({"spurious": -1}, "spurious"),
            ({"hot_pixels": 640 * 480 + 1}, "hot_pixels"),
            ({"footprint_m": 0.0}, "m_per_px"),
            ({"k1": -0.5}, "k1"),
        ],
    )
    def test_refused(self, keys, name):
        with pytest.raises(ValueError, match=f"Input {name} "):
            sky_run(sky(), StandIn(), SkySetup(**keys))


class TestFiles:
    def test_fixes_of_png_files(self, tmp_path):
        poses = {"a.png": Pose(0.2, 0.1, 0.5), "b.png": Pose(-0.6, -0.3, -2.0)}
        for name, pose in poses.items():
            rng = np.random.default_rng(0)
            write_frame(rendered_frame(sky(), Camera(), pose, rng).image, tmp_path / name)
        results = identified_files(sorted(tmp_path.iterdir()), Camera(), robust(SkySetup()))
        for path, result in results.items():
            pose = poses[path.name]
            np.testing.assert_allclose(result.fix.position_m, pose.position_m, atol=2e-4)
            assert result.fix.heading_rad == pytest.approx(pose.heading_rad, abs=1e-3)
            assert result.frame_s >= result.identify_s > 0.0

    def test_a_file_that_is_none(self, tmp_path):
        (tmp_path / "a.png").write_bytes(b"no image")
        with pytest.raises(InputError, match="no PNG image"):
            identified_files([tmp_path / "a.png"], Camera(), robust(SkySetup()))


def test_a_run_is_a_table():
    result = run(robust, DAMAGED)
    assert isinstance(result, SkyRun)
    assert {len(getattr(result, name)) for name in ("truth", "results", "found", "estimates")} == {120}
    assert result.found.tolist() == [isinstance(each.fix, CameraFix) for each in result.results]
    assert np.isnan(result.estimates[~result.found]).all()
    assert np.isfinite(result.estimates[result.found]).all()
