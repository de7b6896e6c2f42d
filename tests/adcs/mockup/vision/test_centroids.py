"""Tests of adcs.mockup.vision.centroids.

Who checks whom
---------------

====================  =====================================================================================
of the centroids      oracle
====================  =====================================================================================
blobs, their sums     skimage.measure.label and regionprops, with intensities
accuracy              the renderer's truth, and the Cramér-Rao bound of a Gaussian in white noise
threshold             numpy.median
sums                  scipy.ndimage.uniform_filter
====================  =====================================================================================
"""

import math
from functools import cache

import numpy as np
import pytest
from scipy import ndimage
from skimage import measure

from adcs.mockup.vision.camera import Camera, Pose
from adcs.mockup.vision.centroids import find_faint_stars, find_stars, find_stars_between_extremes
from adcs.mockup.vision.sky import led_sky
from sims.mockup.frames import FrameQuality, Motion, rendered_frame
from tests.calls import calls_of

POSE, AT_REST = Pose(-0.4, 0.3, 0.8), Motion()


def frame(seed=0, pose=POSE, motion=AT_REST, **quality):
    return rendered_frame(led_sky(0), Camera(), pose, np.random.default_rng(seed), motion, FrameQuality(**quality))


def errors_px(frames, finder=find_stars):
    """Distances of centroids to the true light nearest to each, all frames together, shape (n, 2)."""
    errors = []
    for one in frames:
        found = finder(one.image).positions_px
        offsets = found[:, None] - one.lights_px
        nearest = np.linalg.norm(offsets, axis=-1).argmin(axis=1)
        errors.append(offsets[np.arange(len(found)), nearest])
    return np.concatenate(errors)


@cache
def some_frames(n, **keys):
    places = np.random.default_rng(5).uniform([-0.9, -0.7, -3.1], [0.9, 0.7, 3.1], (n, 3))
    return [frame(seed, Pose(*place), **keys) for seed, place in enumerate(places)]


class TestBlobs:
    @pytest.mark.parametrize("seed", range(4))
    def test_as_skimage_finds_them(self, seed):
        image = frame(seed, motion=Motion((0.3, 0.1), 0.5), hot_pixels=20, spurious=4).image
        stars = find_stars(image)
        bright = np.where(image > stars.background_DN + stars.threshold_DN, image - stars.background_DN, 0.0)
        regions = measure.regionprops(measure.label(bright > 0.0, connectivity=2), intensity_image=bright)
        kept = [
            region
            for region in regions
            if region.area >= 4
            and min(region.bbox[:2]) > 0
            and region.bbox[2] < image.shape[0]
            and region.bbox[3] < image.shape[1]
        ]
        kept.sort(key=lambda region: -region.intensity_mean * region.area)
        assert len(stars) == len(kept) > 5
        centroids = np.array([region.centroid_weighted[::-1] for region in kept])
        np.testing.assert_allclose(stars.positions_px, centroids, atol=1e-9)
        np.testing.assert_allclose(stars.intensity_DN, [region.intensity_mean * region.area for region in kept])
        np.testing.assert_array_equal(stars.n_pixels, [region.area for region in kept])

    def test_corners_connect(self):
        image = np.full((40, 60), 10, dtype=np.uint8)
        image[[10, 11, 12, 13], [20, 21, 22, 23]] = 200
        stars = find_stars(image)
        np.testing.assert_allclose(stars.positions_px, [[21.5, 11.5]])
        assert stars.intensity_DN == 4 * 190

    def test_too_small_and_at_the_border(self):
        image = np.full((40, 60), 10, dtype=np.uint8)
        image[5, 5:8] = 255  # three pixels
        for rows, columns in (((0, 2), (30, 33)), ((38, 40), (30, 33)), ((20, 23), (0, 2)), ((20, 23), (58, 60))):
            image[slice(*rows), slice(*columns)] = 255
        assert len(find_stars(image)) == 0

    def test_a_brighter_background_changes_nothing(self):
        image = frame(background_DN=20.0, noise_DN=3.0, peak_DN=150.0).image
        before, after = find_stars(image), find_stars(image + np.uint8(50))
        np.testing.assert_allclose(after.positions_px, before.positions_px)
        assert after.background_DN == before.background_DN + 50.0


class TestThreshold:
    @pytest.mark.parametrize("noise", [4.0, 15.0])
    def test_six_deviations_above_the_median(self, noise):
        image = frame(noise_DN=noise, background_DN=100.0).image
        stars = find_stars(image)
        median = np.median(image)
        assert stars.background_DN == median
        assert stars.threshold_DN == pytest.approx(6.0 * 1.4826 * np.median(np.abs(image - median)))
        assert stars.threshold_DN == pytest.approx(6.0 * noise, rel=0.15)  # medians of whole numbers

    def test_noise_alone_shows_no_star(self):
        """Of a Gaussian one pixel in 10⁹ is above; four in touch never are."""
        for seed in range(8):
            assert len(find_stars(frame(seed, peak_DN=0.0, noise_DN=10.0, background_DN=60.0).image)) == 0

    def test_quiet_image(self):
        """Without noise the median deviation is zero, and rounding alone stands for it."""
        one = frame(noise_DN=0.0)
        assert len(find_stars(one.image)) == np.sum(np.all((one.lights_px > 8) & (one.lights_px < [631, 471]), axis=1))


class TestHotPixel:
    """Lights dimmed by motion, and one pixel that is stuck at 255."""

    motion = Motion((0.5, 0.2), 0.0)

    def image_with(self, hot_pixels):
        image = frame(motion=self.motion).image
        image[100, 200 : 200 + hot_pixels] = 255
        return image

    def test_both_thresholds_agree_without_one(self):
        robust, extremes = find_stars(self.image_with(0)), find_stars_between_extremes(self.image_with(0), 0.5)
        assert len(robust) == len(extremes) > 8
        distances = np.linalg.norm(robust.positions_px[:, None] - extremes.positions_px, axis=-1).min(axis=1)
        assert distances.max() < 0.5

    def test_one_hides_all_stars_from_the_papers_threshold(self):
        assert len(find_stars_between_extremes(self.image_with(1), 0.5)) == 0

    def test_and_none_from_the_robust_one(self):
        np.testing.assert_array_equal(
            find_stars(self.image_with(1)).positions_px, find_stars(self.image_with(0)).positions_px
        )

    def test_as_it_stands_the_paper_also_loses_or_gains_stars(self):
        """At its default level too: with a hot pixel it does not find what it finds without."""
        counts = [len(find_stars_between_extremes(self.image_with(n))) for n in (0, 1)]
        assert counts[1] < counts[0]


class TestAccuracy:
    def test_at_rest(self):
        """No bias, and within twice the Cramér-Rao bound √(2/π) noise/peak.

        500 lights: a mean of more than 4.5 standard errors has a chance of 1e-5 on each axis.
        """
        errors = errors_px(some_frames(40))
        assert len(errors) > 400
        bound = math.sqrt(2.0 / math.pi) * 4.0 / 180.0
        assert bound < errors.std() < 2.5 * bound
        assert np.abs(errors.mean(axis=0)).max() < 4.5 * errors.std() / math.sqrt(len(errors))

    def test_noise_free(self):
        """Rounding to whole numbers and the threshold are all that is left."""
        assert np.abs(errors_px(some_frames(5, noise_DN=0.0))).max() < 0.02

    def test_smeared(self):
        """The centroid of a smear is where the light was in the middle of the exposure."""
        errors = errors_px(some_frames(20, motion=Motion((0.4, -0.44), 0.5)))
        assert errors.std() < 0.4
        assert np.abs(errors.mean(axis=0)).max() < 4.5 * 0.4 / math.sqrt(len(errors))


class TestFaint:
    """Sums of 3 × 3 pixels."""

    fast = Motion((0.8, -0.6), 1.0)  # 24 pixels and more, a third of the noise above the threshold

    def test_sums_as_scipy_makes_them(self):
        """Blobs of a uniform filter of the frame, as skimage finds them."""
        image = frame(3, motion=self.fast).image
        stars = find_faint_stars(image)
        sums = np.round(9.0 * ndimage.uniform_filter(image.astype(float), 3))[1:-1, 1:-1]
        bright = np.where(sums > stars.background_DN + stars.threshold_DN, sums - stars.background_DN, 0.0)
        regions = measure.regionprops(measure.label(bright > 0.0, connectivity=2), intensity_image=bright)
        centroids = {tuple(np.round(np.array(region.centroid_weighted[::-1]) + 1.0, 6)) for region in regions}
        assert len(stars) > 8
        assert {tuple(np.round(place, 6)) for place in stars.positions_px} <= centroids

    def test_fast_lights_are_found_whole(self):
        """At 1 m/s plain pixels break lights into pieces, off by several pixels; sums do not."""
        frames = some_frames(20, motion=self.fast)
        plain, sums = (errors_px(frames, finder).std() for finder in (find_stars, find_faint_stars))
        assert plain > 2.0
        assert sums < 0.5

    def test_better_at_rest_as_well(self):
        """Nearer to the Cramér-Rao bound, and without bias."""
        frames = some_frames(40)
        plain, sums = (errors_px(frames, finder) for finder in (find_stars, find_faint_stars))
        assert math.sqrt(2.0 / math.pi) * 4.0 / 180.0 < sums.std() < 0.95 * plain.std()
        assert np.abs(sums.mean(axis=0)).max() < 4.5 * sums.std() / math.sqrt(len(sums))

    def test_hot_pixels_are_no_stars(self):
        image = frame().image
        image[100:460:60, 50:600:110] = 255
        places = find_faint_stars(image).positions_px
        assert len(places) == len(find_faint_stars(frame().image))

    def test_noise_alone_shows_no_star(self):
        """Sums of neighbours are correlated; still none of 8 frames shows ten of them above six deviations."""
        for seed in range(8):
            assert len(find_faint_stars(frame(seed, peak_DN=0.0, noise_DN=10.0, background_DN=60.0).image)) == 0

    def test_too_small_a_frame(self):
        with pytest.raises(ValueError, match="3 pixels each way"):
            find_faint_stars(np.array([[1, 2], [3, 4]], dtype=np.uint8))


class TestSpeed:
    @pytest.mark.parametrize("finder", [find_stars, find_faint_stars])
    def test_pixels_and_stars_are_worked_through_in_arrays(self, finder):
        """Four times the pixels and the stars: next to no interpreted call more."""
        image = frame().image
        assert calls_of(lambda: finder(np.tile(image, (2, 2)))) < 1.5 * calls_of(lambda: finder(image))


class TestRefused:
    @pytest.mark.parametrize("method", [find_stars, find_faint_stars, find_stars_between_extremes])
    @pytest.mark.parametrize(
        ("image", "words"),
        [
            (np.zeros((480, 640), dtype=np.uint8), "black"),
            (np.full((480, 640), 255, dtype=np.uint8), "saturated"),
            (np.full((480, 640), 37, dtype=np.uint8), "37 in all pixels"),
            (np.zeros((480, 640, 3), dtype=np.uint8), "grey image"),
            (np.zeros((0, 640), dtype=np.uint8), "grey image"),
            (np.zeros((480, 640)), "uint8"),
        ],
    )
    def test_no_frame(self, method, image, words):
        with pytest.raises(ValueError, match=words):
            method(image)

    def test_mostly_white(self):
        image = frame().image
        image[:300] = 255
        with pytest.raises(ValueError, match="saturated"):
            find_stars(image)

    @pytest.mark.parametrize("level", [0.0, 1.0, math.nan])
    def test_no_level(self, level):
        with pytest.raises(ValueError, match="level"):
            find_stars_between_extremes(frame().image, level)
