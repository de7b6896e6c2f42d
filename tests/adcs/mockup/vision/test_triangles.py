"""Triangles of lights.

What is checked                  by what
catalogue's triangles            no light inside any circumcircle (Delaunay's definition); how many: test_sky
angles                           law of cosines
table                            unchanged by similarity and reflection
order of corners, sense          hand-made triangles
"""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from adcs.mockup.vision.triangles import TriangleCatalogue, delaunay_triangles, triangles_between
from tests.adcs.mockup.stars_of_poses import catalogue

DEGREE = math.pi / 180.0


def plane(points):
    return np.array([complex(*point) for point in points])


class TestCatalogue:
    def test_no_light_is_inside_a_circumcircle(self):
        known = catalogue()
        a, b, c = known.plane[known.triangles.corners].T
        # The circumcentre relative to a, from its textbook formula in complex numbers.
        u, v = b - a, c - a
        centre = a + (np.abs(u) ** 2 * v - np.abs(v) ** 2 * u) / (np.conj(u) * v - u * np.conj(v))
        radius = np.abs(centre - a)
        distance = np.abs(known.plane - centre[:, None])
        assert (distance >= (1.0 - 1e-9) * radius[:, None]).all()

    def test_angles_obey_the_law_of_cosines(self):
        known = catalogue()
        first, largest, third = known.plane[known.triangles.corners].T
        for apex, one, other, angle in (
            (first, largest, third, known.triangles.angles_rad[:, 0]),
            (largest, third, first, known.triangles.angles_rad[:, 1]),
        ):
            p, q, r = np.abs(one - apex), np.abs(other - apex), np.abs(one - other)
            assert_allclose(np.cos(angle), (p**2 + q**2 - r**2) / (2.0 * p * q), atol=1e-12)

    def test_order_of_the_angles(self):
        smallest, largest = catalogue().triangles.angles_rad.T
        third = math.pi - smallest - largest
        assert (smallest <= third + 1e-12).all()
        assert (third <= largest + 1e-12).all()

    @given(
        st.floats(-math.pi, math.pi), st.floats(0.01, 100.0), st.floats(-50.0, 50.0), st.floats(-50.0, 50.0),
        st.booleans(),
    )  # fmt: skip
    def test_table_is_unchanged_by_similarity_and_reflection(self, turn, scale, x, y, mirror):
        known = catalogue()
        moved = scale * np.exp(1j * turn) * (np.conj(known.plane) if mirror else known.plane)
        # A shift of a thousand times the sky's size costs three digits, and no more.
        moved = moved + scale * complex(x, y)
        other = TriangleCatalogue.of(np.stack([moved.real, moved.imag], axis=1)).triangles
        assert_array_equal(other.corners, known.triangles.corners)
        assert_allclose(other.angles_rad, known.triangles.angles_rad, rtol=0.0, atol=1e-9 * DEGREE)
        assert_array_equal(other.is_counter_clockwise != mirror, known.triangles.is_counter_clockwise)

    @pytest.mark.parametrize("points", [[[0, 0], [1, 0], [0, 1]], [[0, 0], [1, 1], [2, 2], [3, 3]]])
    def test_too_few_lights_or_all_in_one_line(self, points):
        with pytest.raises(ValueError, match="Input positions_m must"):
            TriangleCatalogue.of(points)


class TestTriangles:
    def test_corners_are_in_the_order_smallest_largest_third(self):
        # Angles 36.87° at 0, 90° at 1, 53.13° at 2.
        triangles = triangles_between(plane([(4, 0), (0, 0), (0, 3)]), np.array([[2, 0, 1]]))
        assert_array_equal(triangles.corners, [[0, 1, 2]])
        assert_allclose(triangles.angles_rad, [[math.atan2(3, 4), math.pi / 2]])
        assert_array_equal(triangles.is_counter_clockwise, [False])

    def test_reflection_turns_the_sense(self):
        mirrored = triangles_between(np.conj(plane([(4, 0), (0, 0), (0, 3)])), np.array([[0, 1, 2]]))
        assert_array_equal(mirrored.is_counter_clockwise, [True])

    def test_slivers_are_left_out(self):
        points = plane([(0, 0), (10, 0), (5, 0.2), (5, 4)])
        all_of_them = delaunay_triangles(points)
        thick = delaunay_triangles(points, 3.0 * DEGREE)
        assert len(all_of_them) == 3
        assert len(thick) == 2
        assert thick.angles_rad.min() >= 3.0 * DEGREE

    @pytest.mark.parametrize("points", [[], [(0, 0)], [(0, 0), (1, 0)], [(0, 0), (1, 1), (2, 2)], [(1, 1)] * 4])
    def test_no_triangle_of_too_few_points_or_a_line(self, points):
        assert len(delaunay_triangles(plane(points))) == 0
