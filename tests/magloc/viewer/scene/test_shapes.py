"""Shapes of the viewer against closed forms, magpylib and simulation."""

from __future__ import annotations

import magpylib
import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.path import Path
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from arrays.geometries import cross, cube, square, tetrahedron
from magloc.viewer.scene import shapes
from magloc.viewer.scene.shapes import NOTHING, Surface

FloatArray = NDArray[np.float64]
POSITION = np.array([1.2, -0.7, 0.4])
SPREAD = np.array([[0.09, 0.02, 0.0], [0.02, 0.04, -0.01], [0.0, -0.01, 0.25]])
VECTORS = st.tuples(*[st.floats(-1.0, 1.0)] * 3).map(np.array).filter(lambda v: np.linalg.norm(v) > 0.1)


def mesh_of(surface: Surface) -> trimesh.Trimesh:
    """The vertices that some face uses, those in one place merged."""
    mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    mesh.merge_vertices()
    mesh.remove_unreferenced_vertices()
    return mesh


def sphere_values(n: int = 41) -> tuple[FloatArray, FloatArray]:
    """Distance from a point near the middle of a cube of ±2 m."""
    axis = np.linspace(-2.0, 2.0, n)
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    return axis, np.sqrt((x - 0.2) ** 2 + y**2 + z**2) + 1e-9


class TestFieldLines:
    """Field lines run along the field of a dipole."""

    @given(moment=VECTORS)
    def test_tangents_are_parallel_to_the_field_that_magpylib_has(self, moment: FloatArray) -> None:
        lines = shapes.field_lines(POSITION, moment, 3.0, points=401)
        points, tangents = lines[:, 100:301], np.gradient(lines, axis=1)[:, 100:301]
        field = magpylib.getB(magpylib.misc.Dipole(moment=moment, position=POSITION), points.reshape(-1, 3))
        field = np.asarray(field).reshape(points.shape)
        cosine = np.abs(np.sum(tangents * field, axis=-1))
        cosine /= np.linalg.norm(tangents, axis=-1) * np.linalg.norm(field, axis=-1)
        # Central differences of 400 steps over π are off by less than a milliradian there.
        assert cosine.min() > 1.0 - 1e-6

    def test_the_outermost_reach_as_far_as_asked_at_the_equator(self) -> None:
        lines = shapes.field_lines(POSITION, [0.0, 0.0, 5.0], 3.0)
        distance = np.linalg.norm(lines - POSITION, axis=-1)
        assert distance.max() == pytest.approx(3.0, rel=1e-12)
        assert np.allclose(lines[-1, 24, 2], POSITION[2])

    def test_shells_and_meridians_count(self) -> None:
        assert shapes.field_lines(POSITION, [1.0, 0.0, 0.0], 1.0, shells=2, meridians=5, points=9).shape == (10, 9, 3)

    def test_without_a_moment_there_is_no_line(self) -> None:
        assert np.isnan(shapes.field_lines(POSITION, np.zeros(3), 1.0)).all()


class TestSegments:
    """Lines with gaps become segments that are all finite."""

    def test_a_point_that_is_missing_takes_both_its_segments(self) -> None:
        line = np.arange(15.0).reshape(5, 3)
        line[2] = np.nan
        segments = shapes.line_segments(line)
        assert segments.tolist() == [[line[0].tolist(), line[1].tolist()], [line[3].tolist(), line[4].tolist()]]

    def test_box_has_twelve_edges_that_meet_in_threes(self) -> None:
        edges = shapes.box_edges([0.0, 0.0, 0.0], [1.0, 2.0, 3.0])
        assert sorted(np.linalg.norm(edges[:, 0] - edges[:, 1], axis=1).tolist()) == [1.0] * 4 + [2.0] * 4 + [3.0] * 4
        _, counts = np.unique(edges.reshape(-1, 3), axis=0, return_counts=True)
        assert counts.tolist() == [3] * 8


class TestFrameEdges:
    """Bars between sensors are those that one would build."""

    def test_edges_of_known_solids(self) -> None:
        for array, n_edges, length in ((tetrahedron(1.5), 6, 1.5), (square(2.0), 4, 2.0), (cube(0.3), 12, 0.3)):
            edges = shapes.frame_edges(array.positions)
            assert len(edges) == n_edges
            assert np.linalg.norm(edges[:, 0] - edges[:, 1], axis=1) == pytest.approx(length)

    def test_size_does_not_matter(self) -> None:
        positions = np.random.default_rng(1).normal(size=(12, 3))
        small, large = (shapes.frame_edges(factor * positions) for factor in (0.01, 10.0))
        assert large == pytest.approx(1000.0 * small)

    def test_any_array_is_held_together(self) -> None:
        for seed in range(5):
            positions = np.random.default_rng(seed).normal(size=(20, 3))
            edges = shapes.frame_edges(positions)
            index = {tuple(p): i for i, p in enumerate(positions.tolist())}
            pairs = [(index[tuple(a)], index[tuple(b)]) for a, b in edges.tolist()]
            groups = trimesh.graph.connected_components(np.array(pairs), nodes=np.arange(20))
            assert len(groups) == 1

    def test_two_sensors_and_one(self) -> None:
        assert shapes.frame_edges(np.array([[0.0, 0, 0], [1.0, 0, 0]])).shape == (1, 2, 3)
        assert shapes.frame_edges(np.zeros((1, 3))).shape == (0, 2, 3)

    def test_cross_is_a_cross(self) -> None:
        assert len(shapes.frame_edges(cross(1.0).positions)) >= cross(1.0).n_sensors - 1


class TestEllipsoid:
    """The 95 % ellipsoid holds 95 % of a Gaussian."""

    def test_its_points_are_at_the_quantile(self) -> None:
        offset = shapes.ellipsoid(POSITION, SPREAD).vertices - POSITION
        assert np.einsum("ni,ij,nj->n", offset, np.linalg.inv(SPREAD), offset) == pytest.approx(7.814727903251179)

    def test_a_gaussian_is_inside_as_often_as_said(self) -> None:
        # 20000 draws: the fraction's σ is 0.0015; the faceted surface loses 0.2 %. False alarms are one in 10^4.
        draws = np.random.default_rng(7).multivariate_normal(POSITION, SPREAD, 20_000)
        mesh = mesh_of(shapes.ellipsoid(POSITION, SPREAD))
        normal = mesh.face_normals
        distance = np.einsum("dk,dk->d", mesh.triangles_center, normal)
        inside = [np.all(normal @ draw <= distance) for draw in draws]
        assert np.mean(inside) == pytest.approx(0.948, abs=0.006)

    def test_closed_and_turned_outside(self) -> None:
        mesh = mesh_of(shapes.ellipsoid(POSITION, SPREAD))
        assert mesh.is_watertight
        volume = 4.0 / 3.0 * np.pi * 7.814727903251179**1.5 * np.sqrt(np.linalg.det(SPREAD))
        assert mesh.volume == pytest.approx(volume, rel=0.02)

    def test_flat_one_has_no_nan(self) -> None:
        assert np.isfinite(shapes.ellipsoid(POSITION, np.diag([1.0, 1.0, 0.0])).vertices).all()

    @pytest.mark.parametrize("bad", [np.nan, np.inf])
    def test_what_is_not_finite_is_nothing(self, bad: float) -> None:
        assert shapes.ellipsoid(POSITION, np.diag([1.0, bad, 1.0])) is NOTHING
        assert shapes.ellipsoid([bad, 0.0, 0.0], np.eye(3)) is NOTHING

    def test_many_are_the_same_as_one(self) -> None:
        turns = Rotation.random(20, rng=np.random.default_rng(3)).as_matrix()
        covariances = turns @ np.diag([0.01, 0.04, 0.25]) @ turns.transpose(0, 2, 1)
        rotations, semi_axes = shapes.ellipsoid_axes(covariances)
        assert np.linalg.det(rotations) == pytest.approx(1.0)
        again = np.einsum("nij,nj,nkj->nik", rotations, semi_axes**2, rotations) / shapes.CHI2_95[3]
        assert again == pytest.approx(covariances)


class TestRangeRegion:
    """The region of an unobservable range is as long as the interval, and as wide as the direction is uncertain."""

    CENTROID = np.array([0.1, 0.2, 0.0])
    AT = CENTROID + np.array([5.0, 0.0, 0.0])
    # Range known to 2.5 m, directions to 0.04 and 0.02 rad, range and the first direction going together.
    SIGMA = np.array([[6.25, 0.3, 0.0], [0.3, 0.04, 0.0], [0.0, 0.0, 0.01]])

    def test_ranges_are_those_of_the_interval(self) -> None:
        surface = shapes.range_region(self.AT, self.SIGMA, self.CENTROID, (3.0, 9.0), 30.0)
        ranges = np.linalg.norm(mesh_of(surface).vertices - self.CENTROID, axis=1)
        assert ranges.min() == pytest.approx(3.0)
        assert ranges.max() == pytest.approx(9.0)

    def test_an_open_end_is_cut_where_asked(self) -> None:
        surface = shapes.range_region(self.AT, self.SIGMA, self.CENTROID, (3.0, None), 40.0)
        assert np.linalg.norm(surface.vertices - self.CENTROID, axis=1).max() == pytest.approx(40.0)
        near = shapes.range_region(self.AT, self.SIGMA, self.CENTROID, (3.0, None), 1.0)
        assert np.linalg.norm(near.vertices - self.CENTROID, axis=1).max() == pytest.approx(10.0)

    @pytest.mark.parametrize("interval", [(3.0, 9.0), (0.0, None), (0.0, 6.0)])
    def test_closed_and_turned_outside(self, interval: tuple[float, float | None]) -> None:
        mesh = mesh_of(shapes.range_region(self.AT, self.SIGMA, self.CENTROID, interval, 30.0))
        assert mesh.is_watertight
        assert mesh.volume > 0.0

    def test_it_is_as_wide_as_the_direction_is_uncertain(self) -> None:
        surface = shapes.range_region(self.AT, np.diag([6.25, 0.04, 0.01]), self.CENTROID, (3.0, 9.0), 30.0)
        offset = surface.vertices - self.CENTROID
        # The 95 % ellipse of two independent angles of 0.2/5 and 0.1/5 rad.
        assert np.abs(offset[:, 1] / offset[:, 0]).max() == pytest.approx(np.sqrt(5.991464547107979) * 0.04, rel=1e-6)
        assert np.abs(offset[:, 2] / offset[:, 0]).max() == pytest.approx(np.sqrt(5.991464547107979) * 0.02, rel=1e-6)

    def test_it_bends_where_range_and_direction_go_together(self) -> None:
        surface = shapes.range_region(self.AT, self.SIGMA, self.CENTROID, (3.0, 12.0), 30.0)
        rings = surface.vertices.reshape(35, 25, 3)[:33] - self.CENTROID
        angle = np.arctan2(rings[:, -1, 1], rings[:, -1, 0])
        # The conditional mean of an angle given 1/r: slope -(0.3/6.25)·5 per unit of 1/r - 1/r0.
        expected = np.arctan(-0.3 / 6.25 * 5.0 * (1.0 / np.linalg.norm(rings[:, -1], axis=1) - 0.2))
        assert angle == pytest.approx(expected)
        assert angle[0] < 0.0 < angle[-1]

    def test_a_gaussian_of_direction_and_inverse_range_is_inside_as_often_as_said(self) -> None:
        # Given a range of the interval the direction is inside for 95 %: some 19000 draws, σ 0.0016; the 24-gon
        # that the ring is loses 0.17 %. False alarms are one in 10^3.
        to_angles = np.array([[-1 / 25, 0, 0], [0, 1 / 5, 0], [0, 0, 1 / 5]])  # of (x, y, z) to (1/r, y angle, z angle)
        C = to_angles @ np.diag([0.25, 0.04, 0.01]) @ to_angles.T
        w, a, b = np.random.default_rng(11).multivariate_normal([0.2, 0.0, 0.0], C, 20_000).T
        direction = np.stack([np.ones_like(a), a, b], axis=-1)
        direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
        draws = self.CENTROID + direction / w[:, None]
        surface = shapes.range_region(self.AT, np.diag([0.25, 0.04, 0.01]), self.CENTROID, (3.9, 6.9), 30.0)
        ring = surface.vertices.reshape(35, 25, 3)[16, :24] - self.CENTROID
        outline = ring[:, 1:] / ring[:, :1]
        nearer = (1.0 / w > 3.9) & (1.0 / w < 6.9)
        seen = (draws - self.CENTROID)[nearer]
        inside = Path(outline).contains_points(seen[:, 1:] / seen[:, :1])
        assert inside.mean() == pytest.approx(0.948, abs=0.006)

    def test_an_observable_range_is_an_ellipsoid_and_others_are_long(self) -> None:
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = self.SIGMA
        options = {"range_interval_m": [(3.0, 9.0)], "farthest_m": 30.0}
        small = shapes.uncertainty(self.AT, covariance, self.CENTROID, range_observable=True, **options)  # type: ignore[arg-type]
        assert small.vertices.tolist() == shapes.ellipsoid(self.AT, self.SIGMA).vertices.tolist()
        two = [(3.0, 4.0), (6.0, None)]
        long = shapes.uncertainty(
            self.AT, covariance, self.CENTROID, range_observable=False, range_interval_m=two, farthest_m=30.0
        )
        assert len(mesh_of(long).split()) == 2
        assert np.linalg.norm(long.vertices - self.CENTROID, axis=1).max() == pytest.approx(30.0)

    def test_without_a_direction_or_a_covariance_there_is_nothing(self) -> None:
        assert shapes.range_region(self.CENTROID, self.SIGMA, self.CENTROID, (1.0, 2.0), 5.0) is NOTHING
        assert shapes.range_region(self.AT, np.full((3, 3), np.nan), self.CENTROID, (1.0, 2.0), 5.0) is NOTHING


class TestIsoSurface:
    """The surface stands where the values pass the level."""

    def test_a_ball_of_known_volume(self) -> None:
        axis, values = sphere_values()
        mesh = mesh_of(shapes.iso_surface(axis, values, 1.0))
        assert mesh.is_watertight
        assert mesh.volume == pytest.approx(4.0 / 3.0 * np.pi, rel=0.01)
        assert mesh.center_mass == pytest.approx([0.2, 0.0, 0.0], abs=1e-3)
        assert np.linalg.norm(mesh.vertices - [0.2, 0.0, 0.0], axis=1) == pytest.approx(1.0, abs=0.01)

    def test_it_grows_with_the_level(self) -> None:
        axis, values = sphere_values(21)
        volumes = [mesh_of(shapes.iso_surface(axis, values, level)).volume for level in (0.5, 1.0, 1.5)]
        assert volumes == sorted(volumes)

    def test_points_at_the_border_are_enclosed(self) -> None:
        axis, values = sphere_values(21)
        mesh = mesh_of(shapes.iso_surface(axis, values, 100.0))
        assert mesh.is_watertight
        assert mesh.bounds == pytest.approx(np.array([[-2.1] * 3, [2.1] * 3]), abs=0.11)

    def test_points_without_a_value_stay_outside(self) -> None:
        axis, values = sphere_values(21)
        values[:10] = np.nan
        mesh = mesh_of(shapes.iso_surface(axis, values, 1.0))
        assert mesh.is_watertight
        assert mesh.vertices[:, 0].min() == pytest.approx(-0.1, abs=0.1)

    def test_a_single_point_has_a_surface(self) -> None:
        values = np.full((5, 5, 5), np.nan)
        values[2, 2, 2] = 3.0
        mesh = mesh_of(shapes.iso_surface(np.arange(5.0), values, 3.0))
        assert mesh.is_watertight
        assert mesh.volume > 0.0
        assert mesh.bounds.mean(axis=0) == pytest.approx([2.0, 2.0, 2.0])

    def test_nothing_below_the_level_is_nothing(self) -> None:
        axis, values = sphere_values(11)
        assert shapes.iso_surface(axis, values + 5.0, 1.0) is NOTHING
        assert shapes.iso_surface(axis, np.full_like(values, np.nan), 1.0) is NOTHING


class TestBody:
    """The body of a dipole is of the size that was asked for."""

    @pytest.mark.parametrize("size_m", [1e-30, 2.0, 5e29])
    def test_arrow_is_as_long_as_asked(self, size_m: float) -> None:
        body = shapes.dipole_body(size_m)
        assert body.vertices[:, 2].max() == pytest.approx(size_m, rel=1e-12)
        assert len(body.faces) == len(shapes.dipole_body(1.0).faces)

    def test_ball_shaft_and_head_are_closed(self) -> None:
        body = shapes.dipole_body(2.0)
        assert len(mesh_of(body).split(only_watertight=True)) == 3

    def test_joined_surfaces_keep_their_faces(self) -> None:
        one = shapes.ellipsoid(POSITION, SPREAD)
        both = shapes.join_surfaces([one, one])
        assert len(both.faces) == 2 * len(one.faces)
        assert both.faces.max() == len(both.vertices) - 1
        assert shapes.join_surfaces([]).faces.shape == (0, 3)
