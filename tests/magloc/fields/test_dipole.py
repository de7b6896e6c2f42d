"""Tests of magloc.fields.dipole: one class per physical law.

Who checks whom
---------------

===================== =========== ============ ======== ======= ================== =================================
function              closed form 120 decimals magpylib choclo  numerical          laws
                      on the axes                               derivative of
===================== =========== ============ ======== ======= ================== =================================
field                 x           x            x        x       potential          scaling, rotation, linearity
field_matrix                                            x (1)   field by m         field = A m, symmetry, trace
gradient_tensor       x           x (2)        x (3)            field by s         symmetry, trace, scaling, rotation
field_jacobian                                                  field by (p, m)
total_field                                    x                                   superposition
===================== =========== ============ ======== ======= ================== =================================

(1) as the gravity gradient tensor of a unit mass, by Poisson's relation; (2) differences of the field in 120 decimals;
(3) numerical derivative of magpylib's field. The compiled twins are checked against these functions in
test_dipole_kernels.py. Numerical derivatives are by scipy.differentiate.

Errors are norms of the difference relative to the norm of the quantity, for single components can be near zero.
A dipole's B, A and G are never zero as a whole: |B| >= k m/r^3 and |G| >= sqrt(2) 3k m/r^4.
"""

from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
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
POINTS = SOURCE + RNG.uniform(1.0, 6.0, (25, 1)) * Rotation.random(25, rng=RNG).apply([1.0, 0.0, 0.0])
SINGLE_DIPOLE_FUNCTIONS = [
    dipole.field,
    dipole.gradient_tensor,
    dipole.field_jacobian,
]
coordinates = st.floats(-10.0, 10.0)
vectors = st.tuples(coordinates, coordinates, coordinates).map(np.array)


@st.composite
def rotations(draw: st.DrawFn) -> Rotation:
    component = st.floats(-1.0, 1.0)
    quaternion = np.array(draw(st.tuples(component, component, component, component)))
    assume(np.linalg.norm(quaternion) > 0.1)
    return Rotation.from_quat(quaternion)


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


@pytest.mark.parametrize("r", [0.3, 1.0, 7.0])
class TestAxisAndEquator:
    """A dipole along z, seen along its axis and from its equator: the textbook values."""

    m = 250.0

    def test_on_the_axis(self, r: float) -> None:
        at = ([0.0, 0.0, r], [0.0, 0.0, 0.0], [0.0, 0.0, self.m])
        np.testing.assert_allclose(dipole.field(*at), [0, 0, 2 * K * self.m / r**3], rtol=ROUNDING, atol=0)
        # d/dz of 2 k m/z^3, half of it with the other sign across, for the trace is zero
        dbz_dz = -6 * K * self.m / r**4
        expected = np.diag([-dbz_dz / 2, -dbz_dz / 2, dbz_dz])
        np.testing.assert_allclose(dipole.gradient_tensor(*at), expected, rtol=ROUNDING, atol=0)

    def test_on_the_equator(self, r: float) -> None:
        at = ([r, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, self.m])
        np.testing.assert_allclose(dipole.field(*at), [0, 0, -K * self.m / r**3], rtol=ROUNDING, atol=0)
        # d/dx of -k m/x^3; the other components vanish by the symmetry of the equatorial plane
        dbz_dx = 3 * K * self.m / r**4
        expected = dbz_dx * np.array([[0, 0, 1], [0, 0, 0], [1, 0, 0]])
        np.testing.assert_allclose(dipole.gradient_tensor(*at), expected, rtol=ROUNDING, atol=0)

    def test_field_on_the_axis_is_twice_that_on_the_equator_and_opposite(self, r: float) -> None:
        on_axis = dipole.field([0.0, 0.0, r], [0.0, 0.0, 0.0], MOMENT * [0, 0, 1])
        on_equator = dipole.field([0.0, r, 0.0], [0.0, 0.0, 0.0], MOMENT * [0, 0, 1])
        assert relative_error(on_axis, -2 * on_equator) <= ROUNDING


class TestPotential:
    """The field is the gradient of the potential -k (n.m)/r^2, with the sign of the source paper."""

    def test_its_gradient_is_plus_the_field(self) -> None:
        def potential(x: Array) -> Array:
            d = x - SOURCE
            return -K * np.vecdot(d, MOMENT)[..., None] / np.linalg.norm(d, axis=-1, keepdims=True) ** 3

        for s in POINTS:
            gradient = oracles.derivative(potential, s, distance(s) / 20)
            assert relative_error(gradient[0], dipole.field(s, SOURCE, MOMENT)) <= DIFFERENCING


class TestMaxwell:
    """Outside the source the field has neither divergence nor curl."""

    def test_gradient_tensor_is_exactly_symmetric(self) -> None:
        gradient = dipole.gradient_tensor(POINTS, SOURCE, MOMENT)
        np.testing.assert_array_equal(gradient, gradient.mT)

    def test_gradient_tensor_is_traceless(self) -> None:
        gradient = dipole.gradient_tensor(POINTS, SOURCE, MOMENT)
        trace = np.trace(gradient, axis1=-2, axis2=-1)
        assert np.all(np.abs(trace) <= ROUNDING * np.linalg.norm(gradient, axis=(-2, -1)))

    def test_field_matrix_is_symmetric_and_traceless(self) -> None:
        matrix = dipole.field_matrix(POINTS, SOURCE)
        np.testing.assert_array_equal(matrix, matrix.mT)
        trace = np.trace(matrix, axis1=-2, axis2=-1)
        assert np.all(np.abs(trace) <= ROUNDING * np.linalg.norm(matrix, axis=(-2, -1)))

    def test_divergence_and_curl_of_the_field_vanish(self) -> None:
        # From the field alone, so that this holds whatever gradient_tensor says.
        for s in POINTS:
            derivatives = oracles.derivative(lambda x: dipole.field(x, SOURCE, MOMENT), s, distance(s) / 20)
            size = np.linalg.norm(derivatives)
            assert abs(np.trace(derivatives)) <= DIFFERENCING * size
            assert np.linalg.norm(derivatives - derivatives.T) <= DIFFERENCING * size


class TestJacobians:
    """Against numerical derivatives of the field."""

    def test_gradient_tensor_is_the_derivative_by_the_point(self) -> None:
        for s in POINTS:
            numerical = oracles.derivative(lambda x: dipole.field(x, SOURCE, MOMENT), s, distance(s) / 20)
            assert relative_error(dipole.gradient_tensor(s, SOURCE, MOMENT), numerical, 2) <= DIFFERENCING

    def test_field_matrix_is_the_derivative_by_the_moment(self) -> None:
        for s in POINTS:
            numerical = oracles.derivative(partial(dipole.field, s, SOURCE), MOMENT, 1.0)
            assert relative_error(dipole.field_matrix(s, SOURCE), numerical, 2) <= DIFFERENCING

    def test_field_jacobian_is_the_derivative_by_the_state(self) -> None:
        # One block at a time: the columns differ in unit, and an error in the smaller block must not hide.
        for s in POINTS:
            by_position = oracles.derivative(partial(dipole.field, s, moment=MOMENT), SOURCE, distance(s) / 20)
            by_moment = oracles.derivative(partial(dipole.field, s, SOURCE), MOMENT, 1.0)
            actual = dipole.field_jacobian(s, SOURCE, MOMENT)
            assert actual.shape == (3, 6)
            assert relative_error(actual[:, :3], by_position, 2) <= DIFFERENCING
            assert relative_error(actual[:, 3:], by_moment, 2) <= DIFFERENCING


class TestScaling:
    """B falls as r^-3, G as r^-4; a power of two only moves the exponent, so it holds bit for bit."""

    @pytest.mark.parametrize(("function", "power"), [(dipole.field, 3), (dipole.gradient_tensor, 4)])
    @pytest.mark.parametrize("factor", [2.0**-20, 0.5, 2.0, 2.0**20])
    def test_with_distance(self, function: Callable[..., Array], power: int, factor: float) -> None:
        d = POINTS - SOURCE
        origin = np.zeros(3)
        expected = function(d, origin, MOMENT) * factor**-power
        np.testing.assert_allclose(function(factor * d, origin, MOMENT), expected, rtol=4 * EPS, atol=0)


class TestRotation:
    """Turning point, source and moment together turns the result: no axis is special."""

    # The points are at least 1 m and at most 35 m from the source; turning coordinates of up to 17 m by a matrix is
    # wrong by up to 40 eps m, which the field's slope (at most 6 |B|/r, G's 10 |G|/r) turns into 400 eps.
    tolerance = 1000 * EPS

    @given(vectors, vectors, vectors, rotations())
    def test_is_equivariant(self, point: Array, source: Array, moment: Array, turn: Rotation) -> None:
        assume(np.linalg.norm(point - source) >= 1.0)
        assume(np.linalg.norm(moment) >= 1e-3)
        here = (point, source, moment)
        there = (turn.apply(point), turn.apply(source), turn.apply(moment))
        matrix = turn.as_matrix()
        field, gradient = dipole.field(*here), dipole.gradient_tensor(*here)
        assert relative_error(dipole.field(*there), matrix @ field) <= self.tolerance
        assert relative_error(dipole.gradient_tensor(*there), matrix @ gradient @ matrix.T, 2) <= self.tolerance


class TestLinearity:
    @given(vectors, vectors, coordinates, coordinates)
    def test_in_the_moment(self, m1: Array, m2: Array, a: float, b: float) -> None:
        for function in (dipole.field, dipole.gradient_tensor):
            sum_of_parts = a * function(POINTS, SOURCE, m1) + b * function(POINTS, SOURCE, m2)
            whole = function(POINTS, SOURCE, a * m1 + b * m2)
            size = abs(a) * np.max(np.abs(function(POINTS, SOURCE, m1)))
            size += abs(b) * np.max(np.abs(function(POINTS, SOURCE, m2)))
            # Subnormal moments have no relative precision left; they are 1e-308 of anything that matters.
            np.testing.assert_allclose(whole, sum_of_parts, rtol=0, atol=ROUNDING * size + 1e-300)

    def test_field_is_the_matrix_times_the_moment(self) -> None:
        expected = dipole.field(POINTS, SOURCE, MOMENT)
        assert relative_error(dipole.field_matrix(POINTS, SOURCE) @ MOMENT, expected) <= ROUNDING


class TestSuperposition:
    sources = SOURCE + np.array([[0.0, 0.0, 0.0], [0.3, -0.2, 0.1], [-0.4, 0.1, 0.2]])
    moments = np.array([[1.0, 2.0, 3.0], [-4.0, 1.0, 0.5], [2.0, 2.0, -7.0]])

    def test_total_field_is_the_sum_of_foreign_fields(self) -> None:
        parts = [oracles.magpylib_field(POINTS, p, m) for p, m in zip(self.sources, self.moments, strict=True)]
        size = np.sum(np.linalg.norm(parts, axis=-1), axis=0)
        error = np.linalg.norm(dipole.total_field(POINTS, self.sources, self.moments) - np.sum(parts, axis=0), axis=-1)
        assert np.all(error <= ROUNDING * size)

    def test_no_dipoles_make_no_field(self) -> None:
        none = np.empty((0, 3))
        np.testing.assert_array_equal(dipole.total_field(POINTS, none, none), np.zeros((25, 3)))

    def test_opposite_dipoles_in_one_place_cancel(self) -> None:
        total = dipole.total_field(POINTS, [SOURCE, SOURCE], [MOMENT, -MOMENT])
        np.testing.assert_array_equal(total, np.zeros_like(POINTS))

    def test_sets_of_dipoles_broadcast(self) -> None:
        sets = np.stack([self.sources, self.sources + 0.1])[:, None]  # (2, 1, K, 3) against points (25, 3)
        together = dipole.total_field(POINTS, sets, self.moments)
        one_by_one = np.stack([dipole.total_field(POINTS, p[0], self.moments) for p in sets])
        np.testing.assert_array_equal(together, one_by_one)


class TestPeers:
    def test_field_is_that_of_magpylib(self) -> None:
        expected = oracles.magpylib_field(POINTS, SOURCE, MOMENT)
        assert relative_error(dipole.field(POINTS, SOURCE, MOMENT), expected) <= ROUNDING

    def test_field_is_that_of_choclo(self) -> None:
        expected = oracles.choclo_field(POINTS, SOURCE, MOMENT)
        assert relative_error(dipole.field(POINTS, SOURCE, MOMENT), expected) <= ROUNDING

    def test_field_matrix_is_the_gravity_gradient_of_choclo(self) -> None:
        expected = oracles.choclo_field_matrix(POINTS, SOURCE)
        assert relative_error(dipole.field_matrix(POINTS, SOURCE), expected, 2) <= ROUNDING

    def test_gradient_tensor_is_the_derivative_of_the_field_of_magpylib(self) -> None:
        def foreign_field(x: Array) -> Array:
            return oracles.magpylib_field(x.reshape(-1, 3), SOURCE, MOMENT).reshape(x.shape)

        for s in POINTS:
            numerical = oracles.derivative(foreign_field, s, distance(s) / 20)
            assert relative_error(dipole.gradient_tensor(s, SOURCE, MOMENT), numerical, 2) <= DIFFERENCING


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
        self.check(function(self.points, SOURCE, moment))

    @pytest.mark.filterwarnings("error")
    def test_of_the_field_matrix(self) -> None:
        self.check(dipole.field_matrix(self.points, SOURCE))

    @pytest.mark.filterwarnings("error")
    def test_of_several_dipoles(self) -> None:
        self.check(dipole.total_field(self.points, [SOURCE, SOURCE + 10.0], [MOMENT, MOMENT]))

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

    def test_numbers_of_sources_and_moments_differ(self) -> None:
        for sources, moments in [(np.ones((2, 3)), np.ones((3, 3))), (np.ones((1, 3)), np.ones(3))]:
            with pytest.raises(ValueError, match="Inputs sources and moments must have shapes"):
                dipole.total_field(POINTS, sources, moments)
