"""Extended sources: multipoles, demagnetising factors, bodies as dipoles, and when a fix is of no dipole.

| what | who checks it |
|---|---|
| multipole_field_matrix | magpylib's magnets and pairs of dipoles; it is harmonic and scales as r^-(l+2) |
| demagnetising_factors | closed forms of spheroids and their series, Osborn's limits and table |
| equivalent_dipole | limits of the sphere, the needle and the disc; magpylib's magnets |
| dipole_validity | magpylib's magnets |
| nearness_test | its false alarms; magpylib's magnets; a recording; readings with another fault |
"""

from __future__ import annotations

import math
from itertools import pairwise

import magpylib
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation
from scipy.stats import binom

from arrays.array import SensorArray
from arrays.geometries import tetrahedron
from arrays.sensor import Sensor
from magloc.fields import dipole
from magloc.fields.body import demagnetising_factors, equivalent_dipole, induced_and_permanent_moment
from magloc.fields.multipole import finite_body_fields, multipole_field_matrix, traceless_basis
from magloc.localization.dipole_validity import dipole_validity, nearness_test
from magloc.measurement.differences import predicted_channels
from tests import oracles
from tests.plain_locator import plain_locator

MU0 = 4e-7 * np.pi
ORIGIN = np.zeros(3)


def sphere_of_points(n=200, seed=0):
    u = np.random.default_rng(seed).normal(size=(n, 3))
    return u / np.linalg.norm(u, axis=1, keepdims=True)


def explained(points, field, orders):
    """Relative rms of what multipoles of some orders at the origin leave of a field."""
    columns = np.concatenate([multipole_field_matrix(points, ORIGIN, order) for order in orders], axis=-1)
    columns = columns.reshape(-1, columns.shape[-1])
    columns = columns / np.linalg.norm(columns, axis=0)
    rest = field.ravel() - columns @ np.linalg.lstsq(columns, field.ravel(), rcond=None)[0]
    return np.linalg.norm(rest) / np.linalg.norm(field)


class TestMultipoles:
    def test_order_1_is_the_dipole(self):
        points = sphere_of_points()
        assert_allclose(
            multipole_field_matrix(points, [0.1, 0.2, 0.3], 1), dipole.field_matrix(points, [0.1, 0.2, 0.3]), atol=1e-20
        )

    @pytest.mark.parametrize("order", [1, 2, 3, 4])
    def test_scaling_with_distance_and_number_of_components(self, order):
        points = sphere_of_points()
        near, far = (multipole_field_matrix(r * points, ORIGIN, order) for r in (1.0, 2.0))
        assert near.shape == (200, 3, 2 * order + 1)
        assert_allclose(far, near / 2.0 ** (order + 2), rtol=1e-12)
        assert np.linalg.matrix_rank(near.reshape(600, -1)) == 2 * order + 1

    @pytest.mark.parametrize("order", [2, 3, 4])
    def test_no_divergence_and_no_curl(self, order):
        def field(x):
            return 1e7 * multipole_field_matrix(x, ORIGIN, order)[..., 0]

        gradient = oracles.derivative(field, [0.7, -0.4, 0.6], 0.05)
        assert_allclose(gradient, gradient.T, atol=1e-8 * np.abs(gradient).max())
        assert abs(np.trace(gradient)) < 1e-8 * np.abs(gradient).max()

    def test_two_dipoles_apart(self):
        """Each order that is added takes what is left down by the separation over the distance, at the least."""
        ends = 0.05 * np.array([[1.0, 2.0, -1.0], [-2.0, 0.5, 1.0]])
        moments = np.array([[1.0, -2.0, 0.5], [0.5, 1.0, 2.0]])
        points = sphere_of_points()
        field = dipole.total_field(points, ends, moments)
        left = [explained(points, field, range(1, order + 1)) for order in (1, 2, 3, 4, 5)]
        assert left[0] > 0.05
        for before, after in pairwise(left):
            assert after < 0.25 * before

    def test_a_symmetric_magnet_has_an_octupole_and_no_quadrupole(self):
        magnet = magpylib.magnet.Cuboid(dimension=(0.4, 0.2, 0.1), polarization=(0.3, 0.5, 1.0))
        points = sphere_of_points()
        field = magnet.getB(points)
        assert explained(points, field, (1, 2)) > 0.99 * explained(points, field, (1,))
        assert explained(points, field, (1, 3)) < 0.1 * explained(points, field, (1,))

    def test_the_source_itself_is_singular(self):
        field = multipole_field_matrix([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], ORIGIN, 2)
        assert np.isnan(field[0]).all()
        assert np.isfinite(field[1]).all()

    def test_misuse(self):
        with pytest.raises(ValueError, match="Input order must be at least 1; instead received 0"):
            multipole_field_matrix(ORIGIN + 1.0, ORIGIN, 0)
        with pytest.raises(
            ValueError, match=r"Input points_m must have shape \(\.\.\., 3\); instead received shape \(2,\)"
        ):
            multipole_field_matrix(np.ones(2), ORIGIN, 2)


def spheroid_factor(ratio):
    """Along the axis of a spheroid of this length over width: the closed forms, near the sphere their power series.

    With x = 1 - ratio² the series is Σ (c_n - c_{n+1}) xⁿ, c_n = 4ⁿ n!²/(2n + 1)!, that of arcsin(√x)/(√x √(1 - x)).
    """
    x = (1.0 - ratio) * (1.0 + ratio)
    if abs(x) < 0.3:
        c = [4.0**n * math.factorial(n) ** 2 / math.factorial(2 * n + 1) for n in range(40)]
        return math.fsum((c[n] - c[n + 1]) * x**n for n in range(39))
    if ratio > 1.0:
        return (1.0 - ratio / math.sqrt(-x) * math.acosh(ratio)) / x
    return (1.0 - ratio / math.sqrt(x) * math.acos(ratio)) / x


class TestFiniteBodyFields:
    """What a cuboid adds to its dipole, by its second and fourth moments; the oracle is magpylib's exact field."""

    SIDES = np.array([0.2, 0.3, 0.5])
    POINTS = np.array([[1.5, 0.4, 0.9], [0.2, 1.2, 1.0], [0.0, 0.0, 1.5]])

    def moments(self, rank):
        """Mean of xⁿ over the cuboid in the orthonormal traceless basis, by a fine midpoint rule."""
        axis = (np.arange(30) + 0.5) / 30.0 - 0.5
        x = np.stack(np.meshgrid(*(axis * side for side in self.SIDES), indexing="ij"), axis=-1).reshape(-1, 3)
        tensor = x
        for _ in range(rank - 1):
            tensor = np.einsum("n...,ni->n...i", tensor, x)
        return np.tensordot(traceless_basis(rank), tensor.mean(axis=0), rank)

    def test_each_order_takes_most_of_what_is_left(self):
        cuboid = magpylib.magnet.Cuboid(polarization=(0.3, 0.0, 1.0), dimension=self.SIDES)
        exact = cuboid.getB(self.POINTS)
        moment = np.array([0.3, 0.0, 1.0]) * np.prod(self.SIDES) / (4e-7 * np.pi)
        predicted = dipole.field(self.POINTS, ORIGIN, moment)
        left = [np.linalg.norm(exact - predicted, axis=1)]
        for rank in (2, 4):
            predicted = predicted + finite_body_fields(self.POINTS, moment, rank) @ self.moments(rank)
            left.append(np.linalg.norm(exact - predicted, axis=1))
        assert (left[1] < 0.1 * left[0]).all()
        assert (left[2] < 0.4 * left[1]).all()
        assert (left[2] < 1e-4 * np.linalg.norm(exact, axis=1)).all()


class TestDemagnetisingFactors:
    @given(st.floats(-6.0, 6.0))
    @settings(max_examples=100, deadline=None)
    def test_spheroids_of_any_shape(self, decades):
        ratio = 10.0**decades
        factors = demagnetising_factors([1.0, 1.0, ratio])
        assert_allclose(factors[2], spheroid_factor(ratio), rtol=1e-12)
        assert_allclose(factors[0], 0.5 * (1.0 - spheroid_factor(ratio)), rtol=1e-12, atol=1e-15)

    @pytest.mark.parametrize("difference", [0.0, 1e-15, -1e-12, 1e-9, -1e-6, 1e-4, 1e-2])
    def test_near_the_sphere(self, difference):
        """To first order 1/3 - (4/15) of the difference."""
        factor = demagnetising_factors([1.0, 1.0, 1.0 + difference])[2]
        assert_allclose(factor, spheroid_factor(1.0 + difference), rtol=1e-14)
        assert factor == pytest.approx(1.0 / 3.0 - 4.0 / 15.0 * difference, abs=difference**2 + 1e-15)

    @given(st.lists(st.floats(1e-3, 1e3), min_size=3, max_size=3))
    @settings(max_examples=100, deadline=None)
    def test_their_sum_is_1_and_longer_axes_have_smaller_ones(self, axes):
        factors = demagnetising_factors(axes)
        assert np.sum(factors) == pytest.approx(1.0, abs=1e-14)
        assert np.all(np.diff(factors[np.argsort(axes)]) <= 1e-15)
        assert_allclose(demagnetising_factors(axes[::-1]), factors[::-1], rtol=1e-14)

    def test_a_long_elliptic_cylinder(self):
        """b/(a + b) and a/(a + b) across, none along: Osborn's limit."""
        assert_allclose(demagnetising_factors([3.0, 1.0, 1e7]), [0.25, 0.75, 0.0], atol=1e-12)

    def test_a_published_value(self):
        """A prolate spheroid of ratio 2 has 0.1735 along its axis, one of ratio 10 has 0.0203 (Osborn's table)."""
        assert demagnetising_factors([2.0, 1.0, 1.0])[0] == pytest.approx(0.1735, abs=1e-4)
        assert demagnetising_factors([10.0, 1.0, 1.0])[0] == pytest.approx(0.0203, abs=1e-4)

    def test_batches(self):
        axes = np.random.default_rng(0).uniform(0.1, 3.0, (2, 4, 3))
        factors = demagnetising_factors(axes)
        assert_allclose(factors[1, 2], demagnetising_factors(axes[1, 2]), rtol=1e-15)

    @pytest.mark.parametrize("axes", [[1.0, 0.0, 1.0], [1.0, np.inf, 1.0], [1.0, -1.0, 1.0]])
    def test_misuse(self, axes):
        with pytest.raises(ValueError, match="Input semi_axes_m must be positive and finite"):
            demagnetising_factors(axes)


def ellipsoid_mesh(semi_axes, turn=None, centre=ORIGIN):
    """An inscribed polyhedron: 2e-3 smaller in volume."""
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=1.0)
    mesh.apply_scale(semi_axes)
    transform = np.eye(4)
    transform[:3, :3] = np.eye(3) if turn is None else turn.as_matrix()
    transform[:3, 3] = centre
    mesh.apply_transform(transform)
    return mesh


class TestEquivalentDipole:
    AMBIENT = np.array([2e-5, -1e-5, 4.5e-5])

    @pytest.mark.parametrize("susceptibility", [-1.0, 0.1, 5.0, 1e3, 1e9])
    def test_sphere(self, susceptibility):
        """M = 3 χ/(3 + χ) H, and 3 H for a large χ."""
        body = equivalent_dipole(ellipsoid_mesh([0.3, 0.3, 0.3]), susceptibility, self.AMBIENT)
        expected = body.volume_m3 * 3.0 * susceptibility / (3.0 + susceptibility) * self.AMBIENT / MU0
        assert_allclose(body.moment_Am2, expected, rtol=1e-5)

    def test_long_needle_and_thin_disc(self):
        needle = equivalent_dipole(ellipsoid_mesh([1.0, 1e-4, 1e-4]), 100.0, [5e-5, 0.0, 0.0])
        assert_allclose(needle.moment_Am2, [needle.volume_m3 * 100.0 * 5e-5 / MU0, 0.0, 0.0], rtol=1e-4, atol=1e-12)
        disc = equivalent_dipole(ellipsoid_mesh([1.0, 1.0, 1e-4]), 100.0, [0.0, 0.0, 5e-5])
        assert_allclose(disc.moment_Am2[2], disc.volume_m3 * 100.0 / 101.0 * 5e-5 / MU0, rtol=2e-2)

    @pytest.mark.slow
    @given(st.integers(0, 2**32 - 1))
    @settings(max_examples=20, deadline=None)
    def test_an_ellipsoid_is_found_wherever_it_is_and_however_it_is_turned(self, seed):
        rng = np.random.default_rng(seed)
        axes, turn, centre = np.array([0.5, 0.3, 0.1]), Rotation.random(random_state=seed), rng.normal(size=3)
        body = equivalent_dipole(
            ellipsoid_mesh(axes, turn, centre), 20.0, self.AMBIENT, remanence_A_m=[100.0, 20.0, -3.0]
        )
        assert_allclose(body.position_m, centre, atol=1e-9)
        assert_allclose(body.semi_axes_m, axes, rtol=2e-3)
        assert body.body_length_m == pytest.approx(1.0, rel=2e-3)
        assert_allclose(np.abs(np.sum(body.axes * turn.as_matrix().T, axis=1)), 1.0, rtol=1e-6)
        # The inner field H = H0 - N M and the material's law M = χ H + M_r, both in the body's frame.
        factors = turn.as_matrix() @ np.diag(demagnetising_factors(axes)) @ turn.as_matrix().T
        magnetisation = body.moment_Am2 / body.volume_m3
        inner = self.AMBIENT / MU0 - factors @ magnetisation
        assert_allclose(magnetisation, 20.0 * inner + [100.0, 20.0, -3.0], rtol=1e-3, atol=0.1)

    def test_a_magnet_keeps_its_magnetisation(self):
        """magpylib: a magnetised sphere is a dipole everywhere outside."""
        body = equivalent_dipole(ellipsoid_mesh([0.1, 0.1, 0.1]), 0.0, ORIGIN, remanence_A_m=[1e3, 2e3, -5e2])
        magnet = magpylib.magnet.Sphere(diameter=0.2, magnetization=(1e3, 2e3, -5e2))
        points = 0.15 * sphere_of_points()
        found = dipole.field(points, body.position_m, body.moment_Am2) * (4e-3 / 3 * np.pi / body.volume_m3)
        assert_allclose(found, magnet.getB(points), rtol=1e-6, atol=1e-9 * np.abs(found).max())

    @pytest.mark.parametrize("sides", [(1.0, 1.0, 1.0), (1.0, 1.0, 2.0), (1.0, 2.0, 3.0), (1.0, 1.0, 0.3)])
    def test_bricks_are_nearly_ellipsoids(self, sides):
        """Mean inner field of a uniformly magnetised brick by magpylib: to 0.05, and of cubes exactly."""
        body = equivalent_dipole(trimesh.creation.box(sides), 1.0, self.AMBIENT)
        assert body.body_length_m == pytest.approx(np.linalg.norm(sides))
        grid = [(np.arange(24) + 0.5) / 24 * side - side / 2 for side in sides]
        inside = np.stack(np.meshgrid(*grid, indexing="ij"), axis=-1).reshape(-1, 3)
        for axis, factor in zip(body.axes, body.demagnetising_factors, strict=True):
            magnet = magpylib.magnet.Cuboid(dimension=sides, magnetization=axis)
            assert -np.mean(magnet.getH(inside) @ axis) == pytest.approx(
                factor, abs=0.05 if len(set(sides)) > 1 else 1e-9
            )

    @pytest.mark.parametrize(
        ("mesh", "susceptibility", "ambient", "sentence"),
        [
            (
                trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]),
                1.0,
                ORIGIN,
                "Input mesh must be a closed",
            ),
            (trimesh.creation.box(), -2.0, ORIGIN, "Input susceptibility must be finite and at least -1"),
            (trimesh.creation.box(), 1.0, np.ones(2), r"Input ambient_T must be finite and have shape \(3,\)"),
        ],
    )
    def test_misuse(self, mesh, susceptibility, ambient, sentence):
        with pytest.raises(ValueError, match=sentence):
            equivalent_dipole(mesh, susceptibility, ambient)


def magnets():
    """Magnets whose longest side is 1 m, and how much their field differs from a dipole's at three lengths at most."""
    yield "cube", magpylib.magnet.Cuboid(dimension=(1, 1, 1), polarization=(0, 0, 1)), 1.0, 0.003
    yield "cylinder", magpylib.magnet.Cylinder(dimension=(1, 1), polarization=(0, 0, 1)), np.pi / 4, 0.012
    yield "disc", magpylib.magnet.Cylinder(dimension=(1, 0.1), polarization=(0, 0, 1)), np.pi / 40, 0.04
    yield "brick", magpylib.magnet.Cuboid(dimension=(0.5, 1, 0.25), polarization=(0, 1, 0)), 0.125, 0.05
    yield "rod along", magpylib.magnet.Cylinder(dimension=(0.1, 1), polarization=(0, 0, 1)), np.pi / 400, 0.06
    yield "rod across", magpylib.magnet.Cylinder(dimension=(0.1, 1), polarization=(1, 0, 0)), np.pi / 400, 0.065


class TestValidity:
    @pytest.mark.parametrize(("name", "magnet", "volume", "largest"), list(magnets()))
    def test_error_of_the_dipole_at_three_lengths(self, name, magnet, volume, largest):
        """0.3, 1.2, 4.0, 4.8, 5.7 and 6.3 %: below 1 % for the cube only, for the others from four to eight lengths."""
        points = np.concatenate([np.eye(3), sphere_of_points(1000)])
        moment = volume * np.asarray(magnet.polarization) / MU0

        def error(lengths):
            of_dipole = dipole.field(lengths * points, ORIGIN, moment)
            wrong = magnet.getB(lengths * points) - of_dipole
            return np.max(np.linalg.norm(wrong, axis=1) / np.linalg.norm(of_dipole, axis=1))

        assert 0.85 * largest < error(3.0) < largest
        assert error(1.0) > 0.1
        assert error(8.0) < 0.01

    def test_from_three_lengths_on(self):
        distances = np.array([0.0, 2.9, 3.0, 3.1, np.nan])
        assert dipole_validity(distances, 1.0).tolist() == [False, False, True, True, False]
        assert dipole_validity(1.0, [0.1, 0.5]).tolist() == [True, False]

    def test_misuse(self):
        with pytest.raises(ValueError, match=r"Input body_length_m must not be negative; instead received -1\.0"):
            dipole_validity(1.0, -1.0)


def board(noise_T=1e-9, pitch_m=0.4):
    """Thirty tri-axial sensors in a plane."""
    places = [(i, j) for i in range(5) for j in range(6)]
    return SensorArray(
        tuple(Sensor(f"s{i}{j}", "vector", (pitch_m * (i - 2), pitch_m * (j - 2.5), 0.0), noise_T) for i, j in places)
    )


def near_tests(array, readings, **options):
    return [
        nearness_test(array, fix.solutions[0].position_m, fix.solutions[0].moment_Am2, row, **options)
        for fix, row in zip(plain_locator(array).fit_rows(readings), readings, strict=True)
    ]


class TestNearness:
    SOURCE, MOMENT = np.array([0.3, 0.2, 1.5]), np.array([10.0, 20.0, 30.0])

    def magnet(self, length):
        """A brick four times as long as wide with the moment of the dipole."""
        magnetisation = self.MOMENT / (length**3 / 16.0)
        return magpylib.magnet.Cuboid(
            dimension=(length, length / 4, length / 4), magnetization=magnetisation, position=self.SOURCE
        )

    @pytest.mark.slow_after(1)
    @pytest.mark.parametrize(("array", "source"), [(board(), SOURCE), (tetrahedron(1.5, noise_T=1e-9), 2.0 * SOURCE)])
    def test_false_alarms_for_a_dipole(self, array, source):
        """600 dipoles at a stated rate of 5 %: more than allowed in 1e-3 of all seeds at that rate."""
        rng = np.random.default_rng(0)
        clean = predicted_channels(array, source, self.MOMENT)
        results = near_tests(array, clean + 1e-9 * rng.normal(size=(600, clean.size)), false_alarm=0.05)
        assert sum(result.extended or result.misfit for result in results) <= binom.ppf(1 - 1e-3, 600, 0.05)
        # Each of the two χ² tests alone has the rate that it states.
        for k in range(len(results[0].gains)):
            count = sum(result.gains[k].noise_probability < 0.1 for result in results)
            assert binom.ppf(5e-4, 600, 0.1) <= count <= binom.ppf(1 - 5e-4, 600, 0.1)

    def test_a_quadrupole_adds_two_numbers_to_a_dipole(self):
        """Three of its five are a shift of the dipole."""
        array = board()
        result = nearness_test(array, self.SOURCE, self.MOMENT, predicted_channels(array, self.SOURCE, self.MOMENT))
        assert [(gain.order, gain.n_parameters) for gain in result.gains] == [(2, 2), (3, 7)]
        assert result.dof == 81
        assert result.chi2 < 1e-10

    def test_magnets_come_near(self):
        """Found always from three lengths inwards, never at fifteen, and between them as noise has it."""
        array, rng = board(), np.random.default_rng(0)
        found = []
        for length in (0.1, 0.5, 0.8):
            clean = self.magnet(length).getB(array.positions).ravel()
            results = near_tests(array, clean + 1e-9 * rng.normal(size=(30, clean.size)))
            found.append(sum(result.extended for result in results))
        assert found[0] <= 1
        assert found[1:] == [30, 30]

    def test_two_dipoles_apart_have_a_quadrupole(self):
        array, rng = board(), np.random.default_rng(0)
        ends = self.SOURCE + np.array([[0.0, 0.0, 0.25], [0.0, 0.0, -0.25]])
        fields = dipole.total_field(array.positions, ends, np.array([[20.0, 0.0, 0.0], [0.0, 10.0, 20.0]]))
        (result,) = near_tests(array, fields.reshape(1, -1) + 1e-9 * rng.normal(size=(1, array.n_channels)))
        assert result.extended
        assert min(result.gains, key=lambda gain: gain.misfit_probability).order == 2

    def test_another_fault_is_not_taken_for_it(self):
        """A channel that is wrong by 30 σ: a misfit in all of 100 cases, but with the pattern in 10 % at most."""
        array, rng = board(), np.random.default_rng(0)
        readings = predicted_channels(array, self.SOURCE, self.MOMENT) + 1e-9 * rng.normal(size=(100, array.n_channels))
        readings[np.arange(100), rng.integers(0, array.n_channels, 100)] += 3e-8
        results = near_tests(array, readings)
        assert all(result.misfit for result in results)
        assert sum(result.extended for result in results) <= binom.ppf(1 - 1e-3, 100, 0.1)

    def test_missing_readings(self):
        array = board()
        readings = self.magnet(0.8).getB(array.positions).ravel()
        readings[[0, 10, 11, 12]] = np.nan
        (result,) = near_tests(array, readings[None])
        assert result.extended
        assert result.dof == 77

    def test_scalar_sensors_in_an_ambient_field(self):
        places = board().positions
        array = SensorArray(
            tuple(Sensor(f"s{k}", "scalar", tuple(place), 1e-11) for k, place in enumerate(places)),
            ambient_T=(2e-5, 0.0, 4.5e-5),
        )
        clean = predicted_channels(array, self.SOURCE, self.MOMENT)
        assert not nearness_test(array, self.SOURCE, self.MOMENT, clean).extended
        fields = self.magnet(0.8).getB(places) + np.array([2e-5, 0.0, 4.5e-5])
        result = nearness_test(array, self.SOURCE, self.MOMENT, np.linalg.norm(fields, axis=1))
        assert result.extended

    def test_few_differences_tell_no_pattern(self):
        """Three vector sensors: no degree of freedom is left beside the six unknowns."""
        array = tetrahedron(1.5, noise_T=1e-9).subset(["s1", "s2", "s3"])
        readings = predicted_channels(array, 2.0 * self.SOURCE, self.MOMENT) + 1e-6
        result = nearness_test(array, 2.0 * self.SOURCE, self.MOMENT, readings)
        assert result.dof == 0
        assert not result.extended
        assert not result.misfit

    def test_a_source_so_near_that_no_expansion_holds_is_a_misfit(self, data_folder):
        """Sixteen magnetised cells in a row of 16 mm, seen from 2 mm: sixty single components of four planes."""
        for k in range(4):
            record = np.loadtxt(data_folder / "rock-microscope" / f"data{k}.txt")
            rows = record[np.random.default_rng(0).choice(len(record), 60, replace=False)]
            normal = int(np.argmin(np.ptp(rows[:, :3], axis=0)))
            array = SensorArray(
                tuple(Sensor(f"s{i}", "vector", tuple(place), 3e-6) for i, place in enumerate(rows[:, :3])),
                common_field_T=1e-6,
            )
            readings = np.full((60, 3), np.nan)
            readings[:, normal] = rows[:, 3] * 1e-9
            (result,) = near_tests(array, readings.reshape(1, -1))
            assert result.misfit

    def test_misuse(self):
        array = tetrahedron(1.5)
        with pytest.raises(ValueError, match=r"Input readings_T must have shape \(12,\); instead received \(11,\)"):
            nearness_test(array, self.SOURCE, self.MOMENT, np.zeros(11))
        with pytest.raises(ValueError, match=r"Input false_alarm must be between 0 and 1; instead received 0\.0"):
            nearness_test(array, self.SOURCE, self.MOMENT, np.zeros(12), false_alarm=0.0)
        with pytest.raises(ValueError, match=r"Input position_m must be finite and have shape \(3,\)"):
            nearness_test(array, [np.nan, 0.0, 0.0], self.MOMENT, np.zeros(12))


class TestInducedAndPermanentMoment:
    AMBIENT = np.array([1e-5, -2e-5, 4.5e-5])

    def test_a_sphere_is_magnetised_along_the_field(self) -> None:
        """Closed form: α of a permeable sphere is the same in all attitudes, 3 (μr - 1)/(μr + 2) V/μ0."""
        mu_r, radius = 100.0, 0.2
        alpha = 3.0 * (mu_r - 1.0) / (mu_r + 2.0) * (4.0 / 3.0 * math.pi * radius**3) / (4e-7 * math.pi)
        for R in Rotation.random(4, rng=np.random.default_rng(0)).as_matrix():
            moment = induced_and_permanent_moment(R, np.zeros(3), alpha * np.eye(3), self.AMBIENT)
            np.testing.assert_allclose(moment, alpha * self.AMBIENT, rtol=1e-12)

    def test_a_permanent_moment_turns_with_the_body(self) -> None:
        turn = Rotation.from_euler("z", 90.0, degrees=True).as_matrix()
        moment = induced_and_permanent_moment(turn, [1.0, 2.0, 3.0], np.zeros((3, 3)), self.AMBIENT)
        np.testing.assert_allclose(moment, [-2.0, 1.0, 3.0], atol=1e-15)

    def test_a_needle_shows_the_field_along_its_axis(self) -> None:
        """m = α (a·B) a of a body that is magnetised along its axis a only."""
        R = Rotation.from_rotvec([0.3, -0.8, 0.4]).as_matrix()
        axis = R[:, 0]
        moment = induced_and_permanent_moment(R, np.zeros(3), np.diag([5e6, 0.0, 0.0]), self.AMBIENT)
        np.testing.assert_allclose(moment, 5e6 * (axis @ self.AMBIENT) * axis, rtol=1e-12)

    def test_batches(self) -> None:
        rng = np.random.default_rng(2)
        R = Rotation.random(5, rng=rng).as_matrix()
        permanent, ambient = rng.normal(size=(2, 5, 3))
        polarisability = rng.normal(size=(5, 3, 3))
        together = induced_and_permanent_moment(R, permanent, polarisability, ambient)
        assert together.shape == (5, 3)
        for i in range(5):
            alone = induced_and_permanent_moment(R[i], permanent[i], polarisability[i], ambient[i])
            np.testing.assert_allclose(together[i], alone, rtol=1e-12)
