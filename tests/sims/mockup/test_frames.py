"""Tests of sims.mockup.frames: each effect alone, against what it is by definition.

Who checks whom
---------------

====================  =====================================================================================
of a frame            oracle
====================  =====================================================================================
point spread          the Gaussian itself, pixel by pixel
motion                error functions of scipy.special; L²/12 along an arc of the length ω r T; the poses
                      at both ends of the exposure
lens                  adcs.mockup.vision.camera, checked in its own tests
noise, losses         their distributions
====================  =====================================================================================
"""

import math

import numpy as np
import pytest
from scipy import special

from adcs.mockup.vision.camera import Camera, Pose, camera_of_footprint, image_from_table
from adcs.mockup.vision.sky import LedSky, led_sky
from sims.mockup.frames import FrameQuality, Motion, rendered_frame

# One light in the middle of what a camera at the origin sees; the others are never in view.
FAR = [[-7.0, -5.0], [8.0, -6.0], [5.0, 9.0]]
CAMERA, STILL, AT_REST = Camera(), Pose(0.0, 0.0, 0.0), Motion()
QUIET = FrameQuality(noise_DN=0.0)


def one_light(x=0.0, y=0.0):
    return LedSky(np.array([[x, y], *FAR]))


def picture(sky=None, camera=CAMERA, pose=STILL, motion=AT_REST, quality=QUIET, seed=0):
    return rendered_frame(sky or one_light(), camera, pose, np.random.default_rng(seed), motion, quality)


def moments(image, background=20.0):
    """Mass, mean (2,) and covariance (2, 2) in (column, row)."""
    weight = image.astype(float) - background
    rows, columns = np.indices(image.shape)
    places = np.stack([columns.ravel(), rows.ravel()])
    mean = places @ weight.ravel() / weight.sum()
    offset = places - mean[:, None]
    return weight.sum(), mean, (offset * weight.ravel()) @ offset.T / weight.sum()


class TestPointSpread:
    @pytest.mark.parametrize("place", [(0.0, 0.0), (0.0123, -0.0456), (0.4494, 0.2)])
    def test_gaussian(self, place):
        sky, camera = one_light(*place), Camera()
        column, row = image_from_table(camera, STILL, [place])[0]
        rows, columns = np.indices((480, 640))
        gaussian = np.exp(-((columns - column) ** 2 + (rows - row) ** 2) / (2.0 * 1.5**2))
        difference = picture(sky).image - (20.0 + 180.0 * gaussian)
        assert np.abs(difference).max() <= 0.5 + 0.07  # rounding, and the cut at 4 sigma

    def test_size_and_type(self):
        image = picture(camera=Camera(width_px=320, height_px=200)).image
        assert image.shape == (200, 320)
        assert image.dtype == np.uint8

    def test_light_beyond_the_border_shines_in(self):
        """Half of the disc of a light that is on the frame's edge."""
        edge = 0.5 * 640 * Camera().m_per_px
        inside = moments(picture(one_light(0.0)).image)[0]
        assert moments(picture(one_light(edge)).image)[0] == pytest.approx(0.5 * inside, rel=0.02)

    def test_bright_lights_saturate(self):
        assert picture(quality=FrameQuality(noise_DN=0.0, peak_DN=1000.0)).image.max() == 255


class TestMotion:
    @pytest.mark.parametrize(("speed", "course"), [(0.3, 0.0), (0.6, 1.0), (1.0, -2.2)])
    def test_smear_is_a_gaussian_folded_with_a_segment(self, speed, course):
        """A Gaussian across the course, a difference of error functions along it, pixel by pixel.

        The light is in the middle of it in the middle of the exposure.
        """
        camera = Camera()
        velocity = speed * np.array([math.cos(course), math.sin(course)])
        image = picture(motion=Motion(tuple(velocity))).image
        length = speed * camera.exposure_s / camera.m_per_px
        rows, columns = np.indices(image.shape)
        column, row = columns - camera.centre[0], rows - camera.centre[1]
        along = math.cos(course) * column + math.sin(course) * row
        across = math.cos(course) * row - math.sin(course) * column
        ends = [special.erf((along + end) / (1.5 * math.sqrt(2.0))) for end in (0.5 * length, -0.5 * length)]
        spread = 1.5 * math.sqrt(0.5 * math.pi) / length * (ends[0] - ends[1])
        expected = 20.0 + 180.0 * np.exp(-0.5 * (across / 1.5) ** 2) * spread
        assert np.abs(image - expected).max() <= 0.5 + 0.07 + 0.05  # rounding, cut at 4 sigma, steps

    def test_light_is_spread_and_not_lost(self):
        quality = FrameQuality(noise_DN=0.0, peak_DN=235.0)
        at_rest = moments(picture(quality=quality).image)[0]
        assert at_rest == pytest.approx(2.0 * math.pi * 1.5**2 * 235.0, rel=5e-3)
        assert moments(picture(quality=quality, motion=Motion((0.4, 0.0))).image)[0] == pytest.approx(at_rest, rel=0.01)

    def test_turning_draws_arcs_around_the_centre(self):
        """ω r T long, at right angles to the radius."""
        camera, rate = Camera(), 2.0
        image = picture(one_light(0.4, 0.0), motion=Motion(turn_rate_rad_s=rate)).image
        _, mean, covariance = moments(image)
        length = rate * camera.exposure_s * 0.4 / camera.m_per_px
        values, vectors = np.linalg.eigh(covariance)
        assert values[1] == pytest.approx(1.5**2 + length**2 / 12.0, rel=0.03)
        np.testing.assert_allclose(np.abs(vectors[:, 1]), [0.0, 1.0], atol=1e-2)
        np.testing.assert_allclose(mean, image_from_table(camera, STILL, [[0.4, 0.0]])[0], atol=0.3)

    def test_ends_of_a_smear_are_the_poses_at_both_ends_of_the_exposure(self):
        camera, motion = Camera(k1=-0.05), Motion((0.5, -0.3), 1.5)
        sky = one_light(0.25, 0.1)
        image = picture(sky, camera, motion=motion).image.astype(float) - 20.0
        half = 0.5 * camera.exposure_s
        ends = [Pose(0.5 * t, -0.3 * t, 1.5 * t) for t in (-half, half)]
        first, last = (image_from_table(camera, pose, [[0.25, 0.1]])[0] for pose in ends)
        along = (last - first) / np.linalg.norm(last - first)
        rows, columns = np.nonzero(image > 0.5 * image.max())
        reach = (np.stack([columns, rows], axis=1) - first) @ along
        # At the end itself a smear is half as bright as in its middle.
        assert reach.min() == pytest.approx(0.0, abs=1.0)
        assert reach.max() == pytest.approx(np.linalg.norm(last - first), abs=1.0)


class TestNoise:
    @pytest.mark.parametrize("noise", [4.0, 15.0])
    def test_deviation(self, noise):
        """Rounding adds 1/12. Of 307,200 pixels the deviation is known to 0.13 %: 1 % are 8 sigma."""
        image = picture(quality=FrameQuality(noise_DN=noise, background_DN=100.0, peak_DN=0.0)).image
        assert image.std() == pytest.approx(math.sqrt(noise**2 + 1.0 / 12.0), rel=0.01)
        assert image.mean() == pytest.approx(100.0, abs=8.0 * noise / math.sqrt(image.size))

    def test_hot_pixels(self):
        image = picture(quality=FrameQuality(hot_pixels=7)).image
        assert np.count_nonzero(image == 255) == 7

    def test_generator_alone_decides(self):
        quality = FrameQuality(lost=0.3, spurious=3, hot_pixels=2)
        first, again, other = (picture(led_sky(0), quality=quality, seed=seed).image for seed in (1, 1, 2))
        np.testing.assert_array_equal(first, again)
        assert not np.array_equal(first, other)


class TestLights:
    def test_lights_in_the_frame_are_named(self):
        sky, camera, pose = led_sky(0), Camera(k1=-0.05), Pose(0.3, -0.2, 1.0)
        frame = picture(sky, camera, pose)
        np.testing.assert_allclose(frame.lights_px, image_from_table(camera, pose, sky.positions_m[frame.lights]))
        image = frame.image.astype(float) - 20.0
        nearest = np.round(frame.lights_px).astype(int)
        assert len(nearest) > 5
        assert (image[nearest[:, 1], nearest[:, 0]] > 120.0).all()

    def test_far_lights_are_not_folded_in_by_a_barrel(self):
        """All of the frame's light belongs to the lights that are named, or to such at its very edge."""
        for seed in range(10):
            x, y, heading = np.random.default_rng(seed).uniform(-0.5, 0.5, 3)
            frame = picture(led_sky(0), Camera(k1=-0.05), Pose(x, y, heading))
            inner = frame.image[12:-12, 12:-12].astype(float) - 20.0
            in_inner = np.all((frame.lights_px > 18.0) & (frame.lights_px < [621.0, 461.0]), axis=1)
            near = np.all((frame.lights_px > 6.0) & (frame.lights_px < [633.0, 473.0]), axis=1)
            one = 2.0 * math.pi * 1.5**2 * 180.0
            assert 0.98 * one * in_inner.sum() <= inner.sum() <= 1.01 * one * near.sum()

    def test_lost_share(self):
        """A quarter of 1980 lights is dark, with a deviation of 19; 5 sigma are allowed."""
        camera = camera_of_footprint(4.0)
        seen = sum(len(picture(led_sky(s), camera, quality=FrameQuality(lost=0.25), seed=s).lights) for s in range(11))
        assert seen == pytest.approx(0.75 * 1980, abs=5.0 * math.sqrt(1980 * 0.75 * 0.25))

    def test_all_lost_and_none(self):
        assert len(picture(led_sky(0), quality=FrameQuality(lost=1.0)).lights) == 0

    def test_spurious_lights_shine_like_the_others(self):
        frame = picture(quality=FrameQuality(noise_DN=0.0, spurious=5), seed=3)
        assert frame.spurious_px.shape == (5, 2)
        assert moments(frame.image)[0] == pytest.approx(6 * 2.0 * math.pi * 1.5**2 * 180.0, rel=0.02)


class TestRefused:
    @pytest.mark.parametrize(
        ("keys", "name"),
        [
            ({"psf_px": 0.0}, "psf_px"),
            ({"noise_DN": -1.0}, "noise_DN"),
            ({"lost": 1.1}, "lost"),
            ({"lost": math.nan}, "lost"),
            ({"spurious": -1}, "spurious"),
        ],
    )
    def test_no_quality(self, keys, name):
        with pytest.raises(ValueError, match=f"Input {name} "):
            FrameQuality(**keys)
