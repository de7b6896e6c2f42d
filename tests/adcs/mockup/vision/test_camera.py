"""Tests of adcs.mockup.vision.camera.

Who checks whom
---------------

====================  =====================================================================================
of the camera         oracle
====================  =====================================================================================
geometry              pinhole in three dimensions with right-handed axes (right, down, forward = up), turned
                      by scipy's Rotation
undoing of the lens   root of the cubic by scipy.optimize.brentq
batches               one pose after another
====================  =====================================================================================
"""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import optimize
from scipy.spatial.transform import Rotation

from adcs.mockup.vision.camera import (
    Camera,
    Pose,
    camera_of_footprint,
    centred_from_table,
    distort,
    footprint,
    image_from_table,
    in_frame,
    table_from_centred,
    table_from_image,
    undistorted,
)

seeds = st.integers(0, 2**32 - 1)
lenses = st.floats(-0.08, 0.5)  # below -0.09 the image would not fill its corners


def random_pose(rng):
    return Pose(rng.uniform(-1.2, 1.2), rng.uniform(-1.0, 1.0), rng.uniform(-math.pi, math.pi))


class TestGeometry:
    def test_what_is_where_in_the_picture(self):
        """Heading 0: the table's X is the image's right, its Y the image's down, where rows grow."""
        camera = Camera()
        points = np.array([[0.0, 0.0], [0.1, 0.0], [0.0, 0.1]])
        shift = 0.1 / camera.m_per_px
        expected = camera.centre + np.array([[0.0, 0.0], [shift, 0.0], [0.0, shift]])
        np.testing.assert_allclose(image_from_table(camera, Pose(0.0, 0.0, 0.0), points), expected)

    def test_turn_to_the_left_moves_lights_ahead_to_the_right_hand(self):
        """Counter-clockwise by 90°: the body's x points along the table's Y."""
        camera = Camera()
        pixel = image_from_table(camera, Pose(0.0, 0.0, math.pi / 2), [[0.0, 0.1]])
        np.testing.assert_allclose(pixel, [[camera.centre[0] + 0.1 / camera.m_per_px, camera.centre[1]]])

    @given(seeds)
    def test_pinhole_in_three_dimensions(self, seed):
        rng = np.random.default_rng(seed)
        pose, height, camera = random_pose(rng), rng.uniform(0.5, 3.0), Camera()
        points = rng.uniform(-1.5, 1.5, (6, 2))
        R_table_from_camera = Rotation.from_euler("z", pose.heading_rad).as_matrix()
        right, down, forward = R_table_from_camera.T
        np.testing.assert_allclose(np.cross(right, down), [0.0, 0.0, 1.0], atol=1e-12)  # it looks up
        ray = np.column_stack([points, np.full(6, height)]) - [pose.x_m, pose.y_m, 0.0]
        focal_px = height / camera.m_per_px
        expected = camera.centre + focal_px * np.stack([ray @ right, ray @ down], axis=1) / (ray @ forward)[:, None]
        np.testing.assert_allclose(image_from_table(camera, pose, points), expected, atol=1e-9)

    @given(seeds)
    def test_triangles_turn_the_other_way_in_the_picture(self, seed):
        rng = np.random.default_rng(seed)
        triangle = rng.uniform(-0.3, 0.3, (3, 2))
        centred = centred_from_table(Camera(), random_pose(rng), triangle)
        areas = [np.linalg.det(corners[1:] - corners[0]) for corners in (triangle, centred)]
        assert areas[0] * areas[1] <= 0.0

    @given(seeds)
    def test_complex_numbers(self, seed):
        """q = s exp(iφ) conj(p) + b, as matchers have it."""
        rng = np.random.default_rng(seed)
        camera, pose, points = Camera(), random_pose(rng), rng.uniform(-1.0, 1.0, (5, 2))
        p = centred_from_table(camera, pose, points) @ [1.0, 1.0j]
        q = camera.m_per_px * np.exp(1j * pose.heading_rad) * np.conj(p) + complex(pose.x_m, pose.y_m)
        np.testing.assert_allclose(q, points @ [1.0, 1.0j], atol=1e-12)

    @given(seeds, lenses)
    def test_back_to_the_ceiling(self, seed, k1):
        rng = np.random.default_rng(seed)
        camera = Camera(k1=k1, centre_px=(315.0, 244.0))
        pose = random_pose(rng)
        pixels = rng.uniform(0.0, 1.0, (7, 2)) * [639.0, 479.0]
        again = image_from_table(camera, pose, table_from_image(camera, pose, pixels))
        np.testing.assert_allclose(again, pixels, atol=1e-9)

    def test_many_poses_at_once(self):
        rng = np.random.default_rng(0)
        x, y, heading = rng.uniform(-1.0, 1.0, (3, 4, 5))
        camera, points, poses = Camera(k1=-0.05), rng.uniform(-0.2, 0.2, (6, 2)), Pose(x, y, heading)
        together = image_from_table(camera, poses, points)
        back = table_from_centred(camera, poses, centred_from_table(camera, poses, points))
        assert together.shape == (4, 5, 6, 2)
        for i, j in np.ndindex(4, 5):
            alone = image_from_table(camera, Pose(x[i, j], y[i, j], heading[i, j]), points)
            np.testing.assert_allclose(together[i, j], alone, rtol=1e-13)
            np.testing.assert_allclose(back[i, j], points, atol=1e-12)


class TestLens:
    def test_k1_is_what_happens_at_320_px(self):
        camera = Camera(k1=-0.05)
        np.testing.assert_allclose(distort(camera, [320.0, 0.0]) - camera.centre, [304.0, 0.0])
        np.testing.assert_allclose(distort(camera, [0.0, 320.0]) - camera.centre, [0.0, -304.0])

    @given(lenses, st.floats(0.01, 400.0), st.floats(-math.pi, math.pi))
    def test_undone_as_a_root_finder_does(self, k1, radius, angle):
        camera = Camera(k1=k1)
        image = camera.centre + radius * np.array([math.cos(angle), math.sin(angle)])
        ideal = np.linalg.norm(undistorted(camera, image))
        end = 320.0 / math.sqrt(-3.0 * k1) if k1 < 0.0 else 1000.0
        root = optimize.brentq(
            lambda r: r * (1.0 + k1 * (r / 320.0) ** 2) - radius, 0.0, min(end, 1e5), xtol=1e-10, rtol=1e-14
        )
        assert ideal == pytest.approx(root, rel=1e-7)

    @given(lenses)
    def test_centre_stays(self, k1):
        camera = Camera(k1=k1)
        np.testing.assert_array_equal(undistorted(camera, camera.centre), [0.0, 0.0])
        np.testing.assert_array_equal(distort(camera, [0.0, 0.0]), camera.centre)

    def test_tiny_k1_is_none(self):
        pixels = np.random.default_rng(0).uniform(0.0, 480.0, (50, 2))
        for k1 in (1e-15, -1e-15):
            np.testing.assert_allclose(undistorted(Camera(k1=k1), pixels), undistorted(Camera(), pixels), atol=1e-10)

    def test_a_barrel_does_not_fold_far_lights_back_into_the_picture(self):
        camera = Camera(k1=-0.05)
        fold = 320.0 / math.sqrt(0.15)
        radii = np.array([0.99 * fold, 1.01 * fold, 1431.0, 5000.0])  # at 1431 px the formula would give the centre
        shown = distort(camera, np.stack([radii, np.zeros(4)], axis=1))
        assert np.isfinite(shown[0]).all()
        assert np.isnan(shown[1:]).all()
        assert not in_frame(camera, shown).any()

    @pytest.mark.parametrize("k1", [-0.3, math.nan, math.inf])
    def test_no_lens(self, k1):
        with pytest.raises(ValueError, match="k1"):
            Camera(k1=k1)


class TestFootprint:
    @given(seeds)
    def test_size_of_the_ideal_one(self, seed):
        corners = footprint(Camera(), random_pose(np.random.default_rng(seed)))
        sides = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
        np.testing.assert_allclose(sides, [0.9, 0.675, 0.9, 0.675])
        assert Camera().footprint_m == pytest.approx((0.9, 0.675))

    def test_a_barrel_sees_more_and_a_cushion_less(self):
        def area(k1):
            x, y = footprint(Camera(k1=k1), Pose(0.0, 0.0, 0.0), points_per_side=50).T
            return 0.5 * abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))

        assert area(0.05) < area(0.0) < area(-0.05)
        assert area(0.0) == pytest.approx(0.9 * 0.675)

    def test_it_moves_with_the_pose(self):
        corners = footprint(Camera(), Pose(np.array([0.0, 1.0]), np.array([0.0, 2.0]), np.zeros(2)))
        np.testing.assert_allclose(corners[1] - corners[0], np.broadcast_to([1.0, 2.0], (4, 2)))

    def test_named_width(self):
        assert camera_of_footprint(0.6).footprint_m[0] == pytest.approx(0.6)


class TestRefused:
    @pytest.mark.parametrize(
        ("keys", "name"),
        [
            ({"width_px": 0}, "width_px"),
            ({"height_px": 480.5}, "height_px"),
            ({"height_px": math.nan}, "height_px"),
            ({"m_per_px": -1.0}, "m_per_px"),
            ({"m_per_px": math.nan}, "m_per_px"),
            ({"exposure_s": -1.0}, "exposure_s"),
            ({"centre_px": (1.0, math.inf)}, "centre_px"),
        ],
    )
    def test_no_camera(self, keys, name):
        with pytest.raises(ValueError, match=f"Input {name} "):
            Camera(**keys)
