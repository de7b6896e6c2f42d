"""Tests of magloc.fields.dipole.

| function | who checks it |
|---|---|
| field, gradient_tensor | arithmetic with 120 decimals, from 1 nm to 10⁹ m; choclo |
| potential | its gradient is the field |
| field_matrix | choclo: the gravity gradient of a unit mass, by Poisson's relation |
| field_jacobian | scipy.differentiate |
| modulus_gradient, total_field, total_gradient_tensor | magpylib's field, and its derivative by scipy.differentiate |

Kernels are compared with these functions in test_points.py.

Errors are norms of the difference relative to the norm of the quantity, for single components can be near zero.
A dipole's B, A and G are never zero as a whole: |B| >= k m/r^3 and |G| >= sqrt(2) 3k m/r^4.
"""

from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import constants
from scipy.spatial.transform import Rotation

from magloc.fields import dipole
from tests import oracles

Array = NDArray[np.float64]
K = 1e-7
EPS = float(np.finfo(np.float64).eps)
# Worst case to first order for the gradient tensor, in eps: the displacement is right to 1/2 per component, n to 2 and
# 1/r^4 to 8; the magnitudes of the terms add up to at most 6 times the norm of their sum. The field is better off, and
# a formula of another library, or a compiled one, much alike. Random points show 10.
ROUNDING = 64 * EPS
# Extrapolated differences of order 8 with steps of a twentieth of the distance: 1e-13 expected; an error in a formula
# is of order 1.
DIFFERENCING = 1e-10
RNG = np.random.default_rng(20261)
SOURCE = np.array([0.7, -1.1, 0.4])
MOMENT = np.array([3.0, -5.0, 8.0])
AMBIENT = np.array([18e-6, -2e-6, 45e-6])
POINTS = SOURCE + RNG.uniform(1.0, 6.0, (25, 1)) * Rotation.random(25, rng=RNG).apply([1.0, 0.0, 0.0])
SINGLE_DIPOLE_FUNCTIONS = [
    dipole.potential,
    dipole.field,
    dipole.gradient_tensor,
    dipole.modulus_gradient,
    dipole.field_jacobian,
]


def relative_error(actual: Array, expected: Array, n_axes: int = 1) -> float:
    """Largest error of vectors (n_axes = 1) or matrices (2), relative to the norm of what was expected."""
    axes = tuple(range(-n_axes, 0))
    assert actual.shape == expected.shape
    return float(np.max(np.sqrt(np.sum((actual - expected) ** 2, axes) / np.sum(expected**2, axes))))


def distance(point: Array) -> float:
    return float(np.linalg.norm(point - SOURCE))


class TestConstant:
    def test_is_the_magnetic_constant_over_four_pi(self) -> None:
        # 1e-7 was exact until 2019; the measured value is within 6e-10 of it in CODATA 2018 and in CODATA 2022.
        assert dipole.MU0_OVER_4PI == 1e-7
        assert pytest.approx(constants.mu_0 / (4 * np.pi), rel=6e-10) == dipole.MU0_OVER_4PI


class TestPotential:
    def test_its_gradient_is_plus_the_field(self) -> None:
        for s in POINTS:
            gradient = oracles.derivative(lambda x: dipole.potential(x, SOURCE, MOMENT)[..., None], s, distance(s) / 20)
            assert relative_error(gradient[0], dipole.field(s, SOURCE, MOMENT)) <= DIFFERENCING


class TestMaxwell:
    """Outside the source the field has neither divergence nor curl."""

    def test_gradient_tensor_is_exactly_symmetric(self) -> None:
        gradient = dipole.gradient_tensor(POINTS, SOURCE, MOMENT)
        np.testing.assert_array_equal(gradient, gradient.mT)


class TestJacobians:
    """Against numerical derivatives of the field."""

    def test_field_jacobian_is_the_derivative_by_the_state(self) -> None:
        # One block at a time: the columns differ in unit, and an error in the smaller block must not hide.
        for s in POINTS:
            by_position = oracles.derivative(partial(dipole.field, s, moment=MOMENT), SOURCE, distance(s) / 20)
            by_moment = oracles.derivative(partial(dipole.field, s, SOURCE), MOMENT, 1.0)
            actual = dipole.field_jacobian(s, SOURCE, MOMENT)
            assert actual.shape == (3, 6)
            assert relative_error(actual[:, :3], by_position, 2) <= DIFFERENCING
            assert relative_error(actual[:, 3:], by_moment, 2) <= DIFFERENCING


class TestModulusGradient:
    @pytest.mark.parametrize("ambient", [None, AMBIENT, 1e-3 * AMBIENT], ids=["none", "strong", "comparable"])
    def test_is_the_derivative_of_the_modulus_of_a_foreign_field(self, ambient: Array | None) -> None:
        def modulus(x: Array) -> Array:
            field = oracles.magpylib_field(x.reshape(-1, 3), SOURCE, MOMENT)
            total = field if ambient is None else ambient + field
            return np.asarray(np.linalg.norm(total, axis=-1)).reshape(*x.shape[:-1], 1)

        actual = dipole.modulus_gradient(POINTS, SOURCE, MOMENT, ambient)
        # The modulus of a sum keeps eps |B_a| of rounding, which differences over r/20 turn into a slope.
        field = dipole.field(POINTS, SOURCE, MOMENT)
        ratio = 0.0 if ambient is None else np.max(np.linalg.norm(ambient) / np.linalg.norm(field, axis=-1))
        for s, gradient in zip(POINTS, actual, strict=True):
            numerical = oracles.derivative(modulus, s, distance(s) / 20)[0]
            size = np.linalg.norm(dipole.gradient_tensor(s, SOURCE, MOMENT))
            assert np.linalg.norm(gradient - numerical) <= DIFFERENCING * (1 + ratio) * size

    def test_zero_ambient_field_is_no_ambient_field(self) -> None:
        np.testing.assert_array_equal(
            dipole.modulus_gradient(POINTS, SOURCE, MOMENT, np.zeros(3)),
            dipole.modulus_gradient(POINTS, SOURCE, MOMENT),
        )

    def test_is_nan_where_the_total_field_vanishes_and_there_only(self) -> None:
        ambient = -dipole.field(POINTS[3], SOURCE, MOMENT)
        is_nan = np.isnan(dipole.modulus_gradient(POINTS, SOURCE, MOMENT, ambient))
        np.testing.assert_array_equal(is_nan, np.repeat(np.arange(len(POINTS)) == 3, 3).reshape(-1, 3))


class TestSuperposition:
    sources = SOURCE + np.array([[0.0, 0.0, 0.0], [0.3, -0.2, 0.1], [-0.4, 0.1, 0.2]])
    moments = np.array([[1.0, 2.0, 3.0], [-4.0, 1.0, 0.5], [2.0, 2.0, -7.0]])

    def test_total_field_is_the_sum_of_foreign_fields(self) -> None:
        parts = [oracles.magpylib_field(POINTS, p, m) for p, m in zip(self.sources, self.moments, strict=True)]
        size = np.sum(np.linalg.norm(parts, axis=-1), axis=0)
        error = np.linalg.norm(dipole.total_field(POINTS, self.sources, self.moments) - np.sum(parts, axis=0), axis=-1)
        assert np.all(error <= ROUNDING * size)

    def test_total_gradient_tensor_is_the_derivative_of_the_sum_of_foreign_fields(self) -> None:
        def total(x: Array) -> Array:
            flat = x.reshape(-1, 3)
            parts = [oracles.magpylib_field(flat, p, m) for p, m in zip(self.sources, self.moments, strict=True)]
            return np.asarray(np.sum(parts, axis=0)).reshape(x.shape)

        for s in POINTS:
            nearest = np.min(np.linalg.norm(s - self.sources, axis=-1))
            numerical = oracles.derivative(total, s, float(nearest) / 20)
            actual = dipole.total_gradient_tensor(s, self.sources, self.moments)
            assert relative_error(actual, numerical, 2) <= DIFFERENCING

    def test_no_dipoles_make_no_field(self) -> None:
        none = np.empty((0, 3))
        np.testing.assert_array_equal(dipole.total_field(POINTS, none, none), np.zeros((25, 3)))
        np.testing.assert_array_equal(dipole.total_gradient_tensor(POINTS, none, none), np.zeros((25, 3, 3)))

    def test_sets_of_dipoles_broadcast(self) -> None:
        sets = np.stack([self.sources, self.sources + 0.1])[:, None]  # (2, 1, K, 3) against points (25, 3)
        for function in (dipole.total_field, dipole.total_gradient_tensor):
            together = function(POINTS, sets, self.moments)
            one_by_one = np.stack([function(POINTS, p[0], self.moments) for p in sets])
            np.testing.assert_array_equal(together, one_by_one)


class TestPeers:
    def test_field_is_that_of_choclo(self) -> None:
        expected = oracles.choclo_field(POINTS, SOURCE, MOMENT)
        assert relative_error(dipole.field(POINTS, SOURCE, MOMENT), expected) <= ROUNDING

    def test_field_matrix_is_the_gravity_gradient_of_choclo(self) -> None:
        expected = oracles.choclo_field_matrix(POINTS, SOURCE)
        assert relative_error(dipole.field_matrix(POINTS, SOURCE), expected, 2) <= ROUNDING


class TestAccuracy:
    """Against 120-digit arithmetic on the very floats that go in."""

    @pytest.mark.parametrize("exponent", range(-9, 10))
    @pytest.mark.parametrize("source", [np.zeros(3), SOURCE], ids=["origin", "elsewhere"])
    def test_from_near_to_far(self, exponent: int, source: Array) -> None:
        rng = np.random.default_rng(exponent + 100)
        for _ in range(5):
            s = source + 10.0**exponent * rng.normal(size=3)
            m = 10.0 ** rng.uniform(-3, 6) * rng.normal(size=3)
            field, gradient = dipole.field(s, source, m), dipole.gradient_tensor(s, source, m)
            assert relative_error(field, oracles.decimal_field(s, source, m)) <= ROUNDING
            assert relative_error(gradient, oracles.decimal_gradient_tensor(s, source, m), 2) <= ROUNDING

    @pytest.mark.parametrize("distance_m", [1e-70, 1e-30, 1e30, 1e70])
    def test_neither_overflows_nor_underflows(self, distance_m: float) -> None:
        s = distance_m * np.array([0.48, -0.6, 0.64])
        origin = np.zeros(3)
        # The norms are taken of numbers near one: the squares of these would leave the range themselves.
        unit = K / distance_m / distance_m / distance_m
        field = dipole.field(s, origin, MOMENT) / unit
        assert relative_error(field, oracles.decimal_field(s, origin, MOMENT) / unit) <= ROUNDING
        gradient = dipole.gradient_tensor(s, origin, MOMENT) / unit * distance_m
        expected = oracles.decimal_gradient_tensor(s, origin, MOMENT) / unit * distance_m
        assert relative_error(gradient, expected, 2) <= ROUNDING


class TestSingularPoint:
    """On the source the result is NaN for that point only, and no warning is raised (warnings are errors here)."""

    points = np.concatenate([POINTS[:2], [SOURCE], POINTS[2:4]])
    on_source = np.array([False, False, True, False, False])

    def check(self, result: Array) -> None:
        by_point = np.isnan(result).reshape(len(self.points), -1)
        np.testing.assert_array_equal(by_point, np.broadcast_to(self.on_source[:, None], by_point.shape))
        assert np.all(np.isfinite(result[~self.on_source]))

    @pytest.mark.filterwarnings("error")
    @pytest.mark.parametrize("function", SINGLE_DIPOLE_FUNCTIONS)
    @pytest.mark.parametrize("moment", [MOMENT, np.zeros(3)], ids=["dipole", "zero moment"])
    def test_of_one_dipole(self, function: Callable[..., Array], moment: Array) -> None:
        if function.__name__ == "modulus_gradient":
            self.check(function(self.points, SOURCE, moment, AMBIENT))
        else:
            self.check(function(self.points, SOURCE, moment))

    @pytest.mark.filterwarnings("error")
    def test_of_the_field_matrix(self) -> None:
        self.check(dipole.field_matrix(self.points, SOURCE))

    @pytest.mark.filterwarnings("error")
    @pytest.mark.parametrize("function", [dipole.total_field, dipole.total_gradient_tensor])
    def test_of_several_dipoles(self, function: Callable[..., Array]) -> None:
        self.check(function(self.points, [SOURCE, SOURCE + 10.0], [MOMENT, MOMENT]))

    @pytest.mark.filterwarnings("error")
    def test_of_a_missing_point(self) -> None:
        points = self.points.copy()
        points[2] = [np.nan, 0.0, 0.0]
        self.check(dipole.field(points, SOURCE, MOMENT))


class TestBroadcasting:
    """Leading axes broadcast, and a batch is the loop over its members to the bit."""

    points = RNG.normal(size=(4, 1, 5, 3))
    sources = RNG.normal(size=(3, 1, 3))
    moments = RNG.normal(size=(5, 3))

    @pytest.mark.parametrize("function", SINGLE_DIPOLE_FUNCTIONS)
    def test_batch_is_the_loop(self, function: Callable[..., Array]) -> None:
        batch = function(self.points, self.sources, self.moments)
        assert batch.shape[:3] == (4, 3, 5)
        for i, j, k in np.ndindex(4, 3, 5):
            single = function(self.points[i, 0, k], self.sources[j, 0], self.moments[k])
            np.testing.assert_array_equal(batch[i, j, k], single)

    def test_batch_of_matrices_is_the_loop(self) -> None:
        batch = dipole.field_matrix(self.points, self.sources)
        for i, j, k in np.ndindex(4, 3, 5):
            single = dipole.field_matrix(self.points[i, 0, k], self.sources[j, 0])
            np.testing.assert_array_equal(batch[i, j, k], single)

    def test_ambient_field_broadcasts(self) -> None:
        ambients = np.stack([AMBIENT, -AMBIENT])
        batch = dipole.modulus_gradient(POINTS[:, None], SOURCE, MOMENT, ambients)
        for j, ambient in enumerate(ambients):
            np.testing.assert_array_equal(batch[:, j], dipole.modulus_gradient(POINTS, SOURCE, MOMENT, ambient))

    @pytest.mark.parametrize("function", SINGLE_DIPOLE_FUNCTIONS)
    def test_empty_batch(self, function: Callable[..., Array]) -> None:
        assert function(np.empty((0, 3)), SOURCE, MOMENT).shape[0] == 0

    def test_lists_of_integers_are_numbers_too(self) -> None:
        np.testing.assert_array_equal(
            dipole.field([1, 2, 3], [0, 0, 0], [4, 5, 6]), dipole.field([1.0, 2.0, 3.0], [0.0] * 3, [4.0, 5.0, 6.0])
        )


class TestMisuse:
    @pytest.mark.parametrize("function", SINGLE_DIPOLE_FUNCTIONS)
    @pytest.mark.parametrize("name", ["points", "source", "moment"])
    @pytest.mark.parametrize("wrong", [1.0, [1.0], [1.0, 2.0], np.ones((3, 4))], ids=["()", "(1,)", "(2,)", "(3, 4)"])
    def test_not_a_vector(self, function: Callable[..., Array], name: str, wrong: object) -> None:
        arguments = {"points": POINTS[0], "source": SOURCE, "moment": MOMENT, name: wrong}
        with pytest.raises(ValueError, match=rf"Input {name} must have shape \(\.\.\., 3\); instead received shape"):
            function(**arguments)

    def test_ambient_field_is_not_a_vector(self) -> None:
        with pytest.raises(ValueError, match=r"Input ambient must have shape"):
            dipole.modulus_gradient(POINTS, SOURCE, MOMENT, 5e-5)

    @pytest.mark.parametrize("function", [dipole.total_field, dipole.total_gradient_tensor])
    def test_numbers_of_sources_and_moments_differ(self, function: Callable[..., Array]) -> None:
        for sources, moments in [(np.ones((2, 3)), np.ones((3, 3))), (np.ones((1, 3)), np.ones(3))]:
            with pytest.raises(ValueError, match="Inputs sources and moments must have shapes"):
                function(POINTS, sources, moments)
