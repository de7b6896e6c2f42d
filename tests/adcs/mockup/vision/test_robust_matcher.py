"""The robust matcher on damaged frames: more fixes than the paper's, and none that is false.

Statistical tests have one fixed seed that was not chosen; see :mod:`tests.adcs.mockup.vision.test_paper_matcher`.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from adcs.mockup.vision.camera import Pose
from adcs.mockup.vision.paper_matcher import CameraFix, PaperMatcher
from adcs.mockup.vision.robust_matcher import RobustMatcher, one_to_one
from adcs.mockup.vision.similarity import mirrored_image
from adcs.mockup.vision.triangles import TriangleCatalogue
from adcs.stars.identification import NoFix
from sims.experiments.mockup_vision import SkySetup
from tests.adcs.mockup.stars_of_poses import (
    Field,
    catalogue,
    projected,
    projected_set,
    random_points,
    rendered_set,
    score,
)

M_PER_PX = Field().camera.m_per_px


@pytest.fixture(scope="module")
def matcher():
    return RobustMatcher(catalogue(), M_PER_PX)


class TestDamagedFrames:
    def test_a_quarter_lost_and_four_false_lights(self, matcher):
        """At least 75 %; 83 % of 1,500 others, chance falls below in 1 run of 5,000."""
        frames = projected_set(Field(lost=0.25, spurious=4), 300, 0)
        result = score(matcher, frames)
        assert result.success >= 0.75
        assert result.false == 0
        assert result.success > score(PaperMatcher(catalogue()), frames).success

    def test_two_fifths_lost_and_six_false_lights(self, matcher):
        """At least 45 %; 52 % of 1,500 others, chance falls below in 1 run of 100."""
        result = score(matcher, projected_set(Field(lost=0.4, spurious=6), 300, 0))
        assert result.success >= 0.45
        assert result.false == 0

    @pytest.mark.slow
    def test_three_thousand_frames_without_a_false_fix(self, matcher):
        """25 to 40 % lost, four to six false lights: none is off by more than 20 mm or 2°."""
        for lost, spurious in ((0.25, 4), (0.325, 5), (0.4, 6)):
            assert score(matcher, projected_set(Field(lost=lost, spurious=spurious), 1000, 2)).false == 0

    @pytest.mark.slow
    def test_three_thousand_rendered_frames_without_a_false_fix(self, matcher):
        for lost, spurious in ((0.25, 4), (0.325, 5), (0.4, 6)):
            setup = SkySetup(poses=1000, lost=lost, spurious=spurious)
            assert score(matcher, rendered_set(setup, 2)).false == 0


class TestGates:
    def test_five_stars_near_lights_are_not_enough(self, matcher):
        """The spec's gates alone (five stars within 8 mm, half of all) take three in a thousand such frames."""
        frames = random_points(8, 600, 3)
        as_specified = replace(matcher, most_chance=math.inf)
        assert not any(isinstance(matcher.identify(points), CameraFix) for points in frames)
        assert any(isinstance(as_specified.identify(points), CameraFix) for points in frames)

    def test_a_sky_that_repeats_itself_gives_no_fix(self):
        """On a regular grid any place is like those a spacing away, and more stars can fit only at its border."""
        grid = 0.2 * np.stack(np.meshgrid(np.arange(-7.0, 8.0), np.arange(-5.0, 6.0)), axis=-1).reshape(-1, 2)
        known = TriangleCatalogue.of(grid)
        rng = np.random.default_rng(0)
        poses = [Pose(*rng.uniform(-0.6, 0.6, 2), rng.uniform(-math.pi, math.pi)) for _ in range(40)]
        frames = [(pose, projected(known, Field(), pose, rng)) for pose in poses]
        result = score(RobustMatcher(known, M_PER_PX), frames)
        assert (result.success, result.false) == (0.0, 0)

    def test_another_scale_is_refused(self):
        """A camera half as high sees triangles of the same angles; they are not taken for this one's."""
        matcher = RobustMatcher(catalogue(), 0.5 * M_PER_PX)
        assert score(matcher, projected_set(Field(), 30, 3)).success == 0.0
        wide = replace(matcher, scale_range=(0.5, 2.5))
        assert score(wide, projected_set(Field(), 30, 3)).success > 0.9

    def test_four_stars_are_too_few(self, matcher):
        points = random_points(4, 1, 0)[0]
        assert matcher.identify(points) == NoFix("4 stars, 5 needed")

    def test_half_of_the_stars_must_fit(self, matcher):
        """Clutter that outnumbers the lights by far hides them."""
        _, points = projected_set(Field(), 1, 4)[0]
        assert isinstance(matcher.identify(points), CameraFix)
        clutter = random_points(len(points) + 8, 1, 1)[0]
        assert isinstance(matcher.identify(np.concatenate([points, clutter])), NoFix)


class TestOneToOne:
    def test_the_nearer_of_two_stars_has_the_light(self):
        known = catalogue()
        at = np.array([0.002, 0.001, -0.5]) + known.plane[[7, 7, 7]]
        points = np.conj(at) / M_PER_PX
        image = mirrored_image(np.stack([points.real, points.imag], axis=1))
        stars = one_to_one(known, image, complex(M_PER_PX), 0j, 0.008)
        assert_array_equal(stars[stars[:, 1] == 7], [[1, 7]])


def test_isosceles_triangles_are_found_whichever_corner_noise_puts_first():
    """Two equal angles swap with noise, and the sense of the corners with them: other triangles make up for it."""
    frames = projected_set(Field(noise_px=0.5), 100, 5)
    result = score(RobustMatcher(catalogue(), M_PER_PX), frames)
    assert result.success >= 0.97
    assert result.heading_rms_rad <= math.radians(0.1)
