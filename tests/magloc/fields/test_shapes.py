"""Tests of magloc.fields.shapes: magpylib near a magnet, farther away dipoles at Gauss's points of its volume."""

import magpylib
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from magloc import core
from magloc.fields import dipole
from magloc.fields.shapes import Shape, fields_or_nan, shape_fields, shape_jacobians
from tests.oracles import derivative

Array = NDArray[np.float64]
MU0 = 4e-7 * np.pi
SHAPES = [
    Shape("cuboid", (1.0, 1.0, 1.0)),
    Shape("cuboid", (1.0, 0.5, 0.1)),
    Shape("cuboid", (0.2, 0.3, 1.0)),
    Shape("cylinder", (1.0, 1.0)),
    Shape("cylinder", (1.0, 0.1)),
    Shape("cylinder", (0.1, 1.0)),
    Shape("ring", (0.5, 1.0, 0.4)),
    Shape("ring", (0.9, 1.0, 1.0)),
    Shape("sphere", (1.0,)),
]
MOMENTS = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.3, -0.5, 0.8]])
every_shape = pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: f"{shape.kind}-{shape.size_m}")
pytestmark = pytest.mark.usefixtures("instruction_set")


def volume(shape: Shape) -> float:
    *width, height = shape.size_m
    if shape.kind == "cuboid":
        return float(np.prod(shape.size_m))
    if shape.kind == "sphere":
        return np.pi / 6.0 * height**3
    return np.pi / 4.0 * (width[-1] ** 2 - (width[0] ** 2 if shape.kind == "ring" else 0.0)) * height


def magpylib_field(shape: Shape, points: Array, moment: Array) -> Array:
    """Field outside the material by magpylib, from the polarisation, because the mu_0 of its versions differ."""
    size, polarisation = shape.size_m, MU0 * moment / volume(shape)
    magnet: magpylib.magnet.Cuboid | magpylib.magnet.Cylinder | magpylib.magnet.CylinderSegment | magpylib.magnet.Sphere
    if shape.kind == "cuboid":
        magnet = magpylib.magnet.Cuboid(dimension=size, polarization=polarisation)
    elif shape.kind == "cylinder":
        magnet = magpylib.magnet.Cylinder(dimension=size, polarization=polarisation)
    elif shape.kind == "ring":
        segment = (size[0] / 2.0, size[1] / 2.0, size[2], 0.0, 360.0)
        magnet = magpylib.magnet.CylinderSegment(dimension=segment, polarization=polarisation)
    else:
        magnet = magpylib.magnet.Sphere(diameter=size[0], polarization=polarisation)
    return np.asarray(magnet.getB(points)).reshape(points.shape)


def volume_dipoles(shape: Shape, n: int = 12) -> tuple[Array, Array]:
    """Places and weights of dipoles that are exact for polynomials of order 2n - 1 over the volume."""
    x, w = np.polynomial.legendre.leggauss(n)
    if shape.kind == "sphere":
        return np.zeros((1, 3)), np.ones(1)
    a, b, c = np.meshgrid(x, x, x, indexing="ij")
    weight = (w[:, None, None] * w[:, None] * w / 8.0).ravel()
    if shape.kind == "cuboid":
        return 0.5 * np.stack([a, b, c], axis=-1).reshape(-1, 3) * shape.size_m, weight
    inner, outer = (shape.size_m[0], shape.size_m[1]) if shape.kind == "ring" else (0.0, shape.size_m[0])
    angle = 2.0 * np.pi / (2 * n) * np.arange(2 * n)
    square, turn, z = np.meshgrid((inner**2 + (outer**2 - inner**2) * (x + 1) / 2) / 4.0, angle, x, indexing="ij")
    places = np.sqrt(square) * np.cos(turn), np.sqrt(square) * np.sin(turn), 0.5 * shape.size_m[-1] * z
    weight = w[:, None, None] * w / 4.0 * np.full((2 * n, 1), 1.0 / (2 * n))
    return np.stack(places, axis=-1).reshape(-1, 3), weight.ravel()


def relative(found: Array, expected: Array, axes: int = 1) -> Array:
    last = tuple(range(-axes, 0))
    return np.asarray(np.sqrt(np.sum((found - expected) ** 2, axis=last) / np.sum(expected**2, axis=last)))


def points_at(shape: Shape, gaps: Array, seed: int) -> Array:
    """Points at distances from the surface in lengths of the magnet, above random points of it and of its edges."""
    rng = np.random.default_rng(seed)
    half = 0.5 * np.array(shape.size_m if shape.kind == "cuboid" else (shape.size_m[-2:][0],) * 2 + shape.size_m[-1:])
    if shape.kind == "sphere":
        half = np.full(3, 0.5 * shape.size_m[0])
    direction = rng.normal(size=(len(gaps), 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    points = np.empty_like(direction)
    for i, (d, gap) in enumerate(zip(direction, gaps, strict=True)):
        # From the point of a box or a cylinder nearest to a far point: over a face, an edge or a corner.
        far = d * 3.0 * rng.uniform(0.3, 1.0)
        if shape.kind == "cuboid":
            nearest = np.clip(far, -half, half)
        elif shape.kind == "sphere":
            nearest = half[0] * d
        else:
            rho = np.hypot(*far[:2])
            nearest = np.append(far[:2] * min(1.0, half[0] / rho), np.clip(far[2], -half[2], half[2]))
        away = far - nearest
        points[i] = nearest + gap * shape.length_m * away / np.linalg.norm(away)
    return points


@every_shape
class TestFields:
    def test_near_by_magpylib(self, shape: Shape) -> None:
        # Within one length: magpylib's own error for moments across the axis grows to 1e-9 farther along the axis.
        points = points_at(shape, np.random.default_rng(1).uniform(0.01, 0.8, 400), 2)
        for moment in MOMENTS:
            expected = magpylib_field(shape, points, moment)
            assert relative(shape_fields(shape, points, moment), expected).max() < 1e-10

    def test_within_a_hundredth_of_the_surface_by_magpylib(self, shape: Shape) -> None:
        # From 1e-4 lengths on: closer to an edge of a cuboid magpylib itself is off by 1e-8.
        points = points_at(shape, 10.0 ** np.random.default_rng(3).uniform(-4.0, -2.0, 400), 4)
        for moment in MOMENTS:
            expected = magpylib_field(shape, points, moment)
            assert relative(shape_fields(shape, points, moment), expected).max() < 1e-8

    def test_far_by_dipoles_of_the_volume(self, shape: Shape) -> None:
        rng = np.random.default_rng(5)
        direction = rng.normal(size=(60, 3))
        direction[:3], direction[3:6, 2] = np.eye(3), 0.0
        distance = shape.length_m * 10.0 ** rng.uniform(0.2, 3.0, 60)
        points = distance[:, None] * direction / np.linalg.norm(direction, axis=1)[:, None]
        places, weights = volume_dipoles(shape)
        for moment in MOMENTS:
            field, by_point, by_moment = shape_jacobians(shape, points, moment)
            expected = np.array([weights @ dipole.field(point, places, moment) for point in points])
            matrix = np.array([np.tensordot(weights, dipole.field_matrix(point, places), 1) for point in points])
            slope = [np.tensordot(weights, dipole.gradient_tensor(point, places, moment), 1) for point in points]
            assert relative(field, expected).max() < 1e-10
            assert relative(by_moment, matrix, 2).max() < 1e-10
            assert relative(by_point, np.array(slope), 2).max() < 1e-9

    def test_jacobians_near_by_differences_of_magpylib(self, shape: Shape) -> None:
        for point, moment in zip(points_at(shape, np.linspace(0.05, 0.8, 9), 6), np.tile(MOMENTS, (3, 1)), strict=True):
            _, by_point, by_moment = shape_jacobians(shape, point, moment)

            def at(x: Array, moment: Array = moment) -> Array:
                return magpylib_field(shape, x, moment)

            slope = derivative(at, point, 2e-3 * shape.length_m, atol=1e-18)
            assert relative(by_point, slope, 2) < 1e-7
            fields = [magpylib_field(shape, point[None], one)[0] for one in np.eye(3)]
            assert relative(by_moment, np.stack(fields, axis=-1), 2) < 1e-10

    def test_laws_of_the_field(self, shape: Shape) -> None:
        points = points_at(shape, np.random.default_rng(7).uniform(0.001, 20.0, 500), 8)
        field, by_point, by_moment = shape_jacobians(shape, points, MOMENTS[2])
        for one in (by_point, by_moment):
            size = np.linalg.norm(one, axis=(1, 2))
            assert relative(one, np.swapaxes(one, 1, 2), 2).max() < 1e-11
            assert (np.abs(np.trace(one, axis1=1, axis2=2)) <= 1e-11 * size).all()
        assert relative(by_moment @ MOMENTS[2], field).max() < 1e-12

    def test_the_series_continues_the_closed_form(self, shape: Shape) -> None:
        # The distances where the kernel changes from one to the other.
        size = shape.size_m
        change = {"cuboid": 15.0 * max(size), "sphere": 1.0}.get(shape.kind, 5.0 * shape.length_m)
        direction = np.random.default_rng(9).normal(size=(200, 3))
        direction[:3] = np.eye(3)
        points = change * direction / np.linalg.norm(direction, axis=1)[:, None]
        for moment in MOMENTS:
            near, far = (fields_or_nan(shape, points * (1.0 + step), moment) for step in (-1e-13, 1e-13))
            assert relative(near[0], far[0]).max() < 1e-10
            assert relative(near[1], far[1], 2).max() < 1e-9

    def test_unit_and_strength(self, shape: Shape) -> None:
        points = points_at(shape, np.array([0.1, 1.0, 5.0]), 10)
        small = Shape(shape.kind, tuple(1e-3 * size for size in shape.size_m))
        expected = 1e9 * 2.0 * shape_fields(shape, points, MOMENTS[2])
        assert relative(shape_fields(small, 1e-3 * points, 2.0 * MOMENTS[2]), expected).max() < 1e-12


coordinates = st.floats(-3.0, 3.0) | st.sampled_from([0.0, 0.05, -0.05, 0.25, 0.5, -0.5, 1e-9, -1e-6, 0.5 + 1e-9])


class TestSpecialPlaces:
    """Points on axes, on planes of faces and on lines of edges, where a term of the closed form is singular."""

    @given(shape=st.sampled_from(SHAPES), point=st.tuples(coordinates, coordinates, coordinates))
    def test_the_field_is_that_of_a_neighbour(self, shape: Shape, point: tuple[float, float, float]) -> None:
        d = np.array(point)
        field, by_point, by_moment = fields_or_nan(shape, d, MOMENTS[2])
        step = 1e-7 * np.array([0.6, 0.64, 0.48])
        beside = fields_or_nan(shape, [d - step, d + step], MOMENTS[2])
        assume(np.isfinite(field).all() and np.isfinite(beside[0]).all())
        size, slope = np.linalg.norm(field), np.linalg.norm(by_point)
        # The mean of two neighbours, where the field bends little between them.
        assume(np.linalg.norm(beside[1][1] - beside[1][0]) < 1e-4 * max(slope, size))
        assert np.linalg.norm(beside[0].mean(axis=0) - field) < 1e-7 * size
        assert np.linalg.norm(beside[1].mean(axis=0) - by_point) < 1e-7 * max(slope, size)
        assert relative(beside[2].mean(axis=0), by_moment, 2) < 1e-7

    @given(x=st.floats(1e-9, 0.4), z=st.floats(0.51, 4.0))
    def test_axis_of_a_cylinder_by_dipoles(self, x: float, z: float) -> None:
        shape, point = Shape("cylinder", (1.0, 1.0)), np.array([x, 0.3 * x, z])
        for moment in MOMENTS:
            if z > 1.2:
                places, weights = volume_dipoles(shape, 20)
                assert (
                    relative(shape_fields(shape, point, moment), weights @ dipole.field(point, places, moment)) < 1e-10
                )
            _, slope, _ = shape_jacobians(shape, point, moment)
            _, on_axis, _ = shape_jacobians(shape, [0.0, 0.0, z], moment)
            if x < 1e-6:
                assert relative(slope, on_axis, 2) < 1e-4


class TestInside:
    @pytest.mark.parametrize(
        ("shape", "inside", "outside"),
        [
            (Shape("cuboid", (2.0, 1.0, 1.0)), [0.9, 0.4, -0.4], [0.9, 0.6, -0.4]),
            (Shape("cylinder", (2.0, 1.0)), [0.7, 0.7, 0.4], [0.8, 0.8, 0.4]),
            (Shape("ring", (1.0, 2.0, 1.0)), [0.5, 0.5, 0.4], [0.1, 0.2, 0.0]),
            (Shape("sphere", (1.0,)), [0.2, 0.2, 0.3], [0.3, 0.3, 0.3]),
        ],
        ids=lambda value: getattr(value, "kind", None),
    )
    def test_is_refused(self, shape: Shape, inside: list[float], outside: list[float]) -> None:
        assert np.isfinite(shape_fields(shape, outside, MOMENTS[2])).all()
        assert np.isnan(fields_or_nan(shape, [inside, outside], MOMENTS[2])[0]).all(axis=1).tolist() == [True, False]
        with pytest.raises(ValueError, match=f"inside a {shape.kind} of size_m"):
            shape_fields(shape, [outside, inside], MOMENTS[2])

    def test_a_moment_that_is_nan_is_not_inside(self) -> None:
        assert np.isnan(shape_fields(SHAPES[3], [[0.0, 0.0, 2.0]], [0.0, np.nan, 1.0])).all()

    def test_hole_of_a_ring_by_magpylib(self) -> None:
        shape = Shape("ring", (0.5, 1.0, 0.4))
        rng = np.random.default_rng(11)
        points = np.stack([*(0.24 * rng.uniform(-0.7, 0.7, (2, 200))), rng.uniform(-0.3, 0.3, 200)], axis=-1)
        # Nearer to the axis magpylib itself is off by 1e-8 for moments across it.
        points = points[np.hypot(points[:, 0], points[:, 1]) > 0.05]
        for moment in MOMENTS:
            expected = magpylib_field(shape, points, moment)
            assert relative(shape_fields(shape, points, moment), expected).max() < 1e-10


def test_a_problem_without_a_shape_is_a_dipole() -> None:
    points, moments = np.random.default_rng(12).standard_normal((2, 50, 3))
    field, slopes, unused = np.empty((50, 3)), np.empty((50, 3, 3)), np.empty((50, 3, 3))
    results = {"fields": field, "gradients": slopes, "matrices": unused}
    work = core.problem("magnets", n_points=50, shape=0, size=(0.0,) * 3, points=points, moments=moments, **results)
    core.run("shape_fields", work, 50, block=50)
    np.testing.assert_allclose(
        field, dipole.field(points, 0.0 * points, moments), rtol=0, atol=1e-12 * abs(field).max()
    )


class TestShape:
    @pytest.mark.parametrize(
        ("kind", "size", "message"),
        [
            ("cone", (1.0,), "kind must be one of cuboid, cylinder, ring, sphere"),
            ("cuboid", (1.0, 2.0), "size_m must be the three edges of a cuboid"),
            ("cylinder", (1.0,), "size_m must be the diameter, height of a cylinder"),
            ("ring", (1.0, 2.0), "size_m must be the inner diameter, outer diameter, height"),
            ("sphere", (1.0, 1.0), "size_m must be the diameter of a sphere"),
            ("sphere", (0.0,), "size_m must be positive and finite"),
            ("cuboid", (1.0, 1.0, float("nan")), "size_m must be positive and finite"),
            ("ring", (2.0, 2.0, 1.0), "those of a ring with an inner diameter below"),
        ],
    )
    def test_bad_sizes(self, kind: str, size: tuple[float, ...], message: str) -> None:
        with pytest.raises(ValueError, match=message):
            Shape(kind, size)

    def test_length(self) -> None:
        assert Shape("cuboid", (2.0, 3.0, 6.0)).length_m == 7.0
        assert Shape("ring", (1.0, 3.0, 4.0)).length_m == 5.0
        assert Shape("sphere", (2.0,)).length_m == 2.0
