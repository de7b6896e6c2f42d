"""Cramér-Rao bounds of sources before any array.

| what | who checks it |
|---|---|
| bounds | the printed figures of the reference problem |
| information, every nuisance marginalised | exact second derivatives (hyper-dual numbers) of the likelihood of all |
| | readings with all nuisances as parameters, formed from the formulas and inverted whole |
| bounds, whether they can be reached | scatter of the fits of magloc.localization.search.single_source |
| table and spreads, in each instruction set | cramer_rao_bounds; NumPy |
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.optimize import minimize
from scipy.stats import chi2

from arrays.array import SensorArray
from arrays.geometries import cube, grid, hexagon, square, tetrahedron
from arrays.pose import PoseUncertainty
from magloc.bounds.crlb import cramer_rao_bounds, nuisance_free_jacobian
from magloc.bounds.over_moments import (
    bounds_over_moments,
    sigma_table,
    spread_over,
)
from magloc.directions import moments_on_sphere, sphere_directions
from magloc.fields.multipole import finite_body_errors
from magloc.measurement.differences import DifferenceMeasurement, predicted_channels
from tests.arrays.test_differences import random_array
from tests.magloc.bounds.hyper_dual import Model
from tests.plain_locator import plain_locator

SOURCE = np.array([5.0, 0.0, 0.306])
AMBIENT = (2e-5, 1e-6, 4.5e-5)
TETRAHEDRON = tetrahedron(1.5, noise_T=1e-9)
SCALARS = replace(cube(1.5, kind="scalar", noise_T=1e-11), ambient_T=AMBIENT)
SEEDS = st.integers(0, 2**32 - 1)


def random_source(seed, distance_m=4.0, moment_Am2=200.0):
    direction, moment = np.random.default_rng([seed, 7]).normal(size=(2, 3))
    return (size * v / np.linalg.norm(v) for size, v in ((distance_m, direction), (moment_Am2, moment)))


def fisher_information(array, position, moment, **uncertain):
    """Information (6, 6) about (p, m), all nuisances marginalised."""
    W = nuisance_free_jacobian(array, position, moment, **uncertain)
    return W.mT @ W


def moments_over(array, n):
    """Moments of 100 A·m² in every direction that counts for the bounds of an array."""
    return moments_on_sphere(100.0, n, half=not array.channel_is_scalar.any())


class TestPrintedFigures:
    """The reference problem, 1 nT and a source at (5, 0, 0.306) m, to the printed digits (a 4.2 stands for 4.1498)."""

    @pytest.mark.parametrize(
        ("edge", "moment", "sigma_m", "sigma_Am2"),
        [
            (1.5, (0, 0, 100), ("0.289", "0.082", "0.076"), ("4.15", "1.7", "23.6")),
            (1.5, (60, 50, 60), ("0.169", "0.097", "0.082"), ("9.5", "8.7", "9.6")),
            (1.5, (100, 0, 0), ("0.134", "0.230", "0.254"), ()),
            (0.5, (0, 0, 100), ("2.74", "0.22", "0.21"), ("11.9", "4.5", "220")),
        ],
    )
    def test_position_and_moment(self, edge, moment, sigma_m, sigma_Am2):
        bounds = cramer_rao_bounds(tetrahedron(edge, noise_T=1e-9), SOURCE, moment)
        assert bounds.sigma_position_m == pytest.approx(np.linalg.norm(np.float64(sigma_m)), rel=0.01)
        # The range is along x but for 3.5 degrees.
        assert bounds.sigma_range_m == pytest.approx(float(sigma_m[0]), rel=0.02)
        for value, printed in zip(bounds.sigma, sigma_m + sigma_Am2, strict=False):
            assert f"{value:.{len(printed.partition('.')[2])}f}" == printed

    def test_moment_by_moduli_where_the_geometry_is_known(self):
        e = np.array([0.4, 0.0, 0.917])
        array = replace(tetrahedron(1.5, kind="scalar", noise_T=1e-9), ambient_T=tuple(5e-5 * e / np.linalg.norm(e)))
        information = fisher_information(array, SOURCE, (60.0, 50.0, 60.0))
        sigma = np.sqrt(np.diagonal(np.linalg.inv(information[3:, 3:])))
        assert_allclose(sigma, [1.3, 5.9, 2.8], atol=0.06)


class TestLikelihood:
    """The bound is the inverse of the expected Hessian of the exact likelihood, to 1e-8 of the standard deviations."""

    @staticmethod
    def check(array, position, moment, ambient_uncertainty_T=0.0):
        expected = Model(array, position, moment, ambient_uncertainty_T).covariance()
        bounds = cramer_rao_bounds(array, position, moment, ambient_uncertainty_T=ambient_uncertainty_T)
        unit = np.sqrt(np.diagonal(expected))
        assert_allclose(bounds.covariance / unit / unit[:, None], expected / unit / unit[:, None], rtol=0.0, atol=1e-8)
        information = fisher_information(array, position, moment, ambient_uncertainty_T=ambient_uncertainty_T)
        assert_allclose(information * unit * unit[:, None] @ (expected / unit / unit[:, None]), np.eye(6), atol=1e-6)

    @pytest.mark.parametrize("uncertain", [False, True], ids=["", "uncertain calibration"])
    @pytest.mark.parametrize("common_field_T", [None, 30e-9], ids=["unknown common field", "common field of 30 nT"])
    @pytest.mark.parametrize("seed", [1, 2])
    def test_vector_sensors(self, seed, common_field_T, uncertain):
        array = random_array(seed, 5, common_field_T=common_field_T, uncertain=uncertain)
        self.check(array, *random_source(seed))

    def test_vector_sensors_of_uncertain_axes_in_the_field_of_the_earth(self):
        array = replace(random_array(3, 6, uncertain=True), ambient_T=AMBIENT)
        self.check(array, *random_source(3))

    @pytest.mark.parametrize("ambient_uncertainty_T", [0.0, 20e-9], ids=["", "ambient field to 20 nT"])
    @pytest.mark.parametrize("common_field_T", [None, 1e-9], ids=["unknown common field", "common field of 1 nT"])
    def test_scalar_sensors(self, common_field_T, ambient_uncertainty_T):
        array = random_array(4, 10, kinds=("scalar",), common_field_T=common_field_T)
        self.check(replace(array, ambient_T=AMBIENT), *random_source(4), ambient_uncertainty_T)

    @pytest.mark.parametrize("common_field_T", [None, 30e-9], ids=["unknown common field", "common field of 30 nT"])
    def test_all_at_once(self, common_field_T):
        array = random_array(5, 8, kinds=("vector", "scalar"), common_field_T=common_field_T, uncertain=True)
        array = replace(array, ambient_T=AMBIENT)
        errors = {"offset_uncertainty_T": 5e-10, "induced_uncertainty": 2e-5}
        sensors = tuple(replace(s, **errors) for s in array.sensors)
        self.check(replace(array, sensors=sensors), *random_source(5), 20e-9)


class TestBodies:
    def test_what_a_dipole_leaves_out_is_noise(self):
        """The information of differences whose covariance has it, written out."""
        position, moment = random_source(6, distance_m=2.0)
        array, length_m = random_array(6, 5), np.array([0.0, 0.5])
        columns = finite_body_errors(array.positions - position, np.broadcast_to(moment, (5, 3)), 0.5)
        beyond = np.einsum("ci,cij->cj", array.channel_gain, columns[array.channel_sensor])
        measurement = DifferenceMeasurement.of(array)
        root, H = measurement.differences.transform @ beyond, measurement.jacobian(position, moment)
        found = cramer_rao_bounds(array, position, moment, body_length_m=length_m).covariance
        for covariance, share in zip(found, (0.0, 1.0), strict=True):
            noise = np.diag(measurement.variance) + share * root @ root.T
            unit = np.sqrt(np.diagonal(covariance))
            information = H.T @ np.linalg.solve(noise, H) * unit * unit[:, None]
            assert_allclose(information @ (covariance / unit / unit[:, None]), np.eye(6), atol=1e-6)

    def test_nothing_said_is_a_quarter_of_the_distance_near_the_array(self):
        array = grid(6, 5, 0.1, noise_T=1e-9)
        near, far = np.array([0.02, 0.03, 0.05]), np.array([0.0, 0.0, 2.0])
        nearest_m = np.linalg.norm(array.positions - near, axis=1).min()
        for position, length_m in ((near, 0.25 * nearest_m), (far, 0.0)):
            of_unsaid, of_said = (
                cramer_rao_bounds(array, position, [0.1, 0.0, 0.2], body_length_m=length) for length in (None, length_m)
            )
            assert_allclose(of_unsaid.covariance, of_said.covariance, rtol=1e-12)

    @pytest.mark.parametrize("length_m", [-0.1, np.nan, 1e5])
    def test_is_refused(self, length_m):
        with pytest.raises(ValueError, match="Input body_length_m must be from 0 to 10000 m"):
            cramer_rao_bounds(TETRAHEDRON, SOURCE, [0.0, 0.0, 1.0], body_length_m=length_m)


class TestParts:
    def test_position_is_range_and_bearing_together(self):
        array = random_array(7, 5)
        position, moment = random_source(7)
        bounds = cramer_rao_bounds(array, position, moment)
        together = bounds.sigma_range_m**2 + (bounds.range_m * bounds.sigma_bearing_rad) ** 2
        assert_allclose(bounds.sigma_position_m**2, together, rtol=1e-12)
        assert_allclose(bounds.sigma_position_m**2, np.sum(bounds.sigma[:3] ** 2), rtol=1e-12)
        n = (position - array.centroid) / bounds.range_m
        assert_allclose(bounds.sigma_range_m**2, n @ bounds.covariance[:3, :3] @ n, rtol=1e-9)


class TestNuisances:
    def test_noise_that_grows_with_the_field_counts(self):
        position, moment = random_source(6)
        sigma = [
            cramer_rao_bounds(replace(TETRAHEDRON, noise_fraction=part), position, moment).sigma
            for part in (0.0, 1e-3, 1e-1)
        ]
        assert np.all(np.diff(sigma, axis=0) > 0.0)


class TestSingular:
    def test_too_few_readings_leave_everything_open(self):
        four = replace(tetrahedron(1.5, kind="scalar", noise_T=1e-10), ambient_T=AMBIENT)
        two = SensorArray(TETRAHEDRON.sensors[:2])
        for array in (four, two):
            bounds = cramer_rao_bounds(array, SOURCE, (0.0, 0.0, 100.0))
            assert bounds.rank == 3
            assert not bounds.is_regular
            assert np.isinf([bounds.sigma_range_m, bounds.sigma_bearing_rad, bounds.sigma_position_m]).all()
            assert np.isinf(np.diagonal(bounds.covariance)).sum() >= 4

    def test_one_sensor_tells_nothing_by_differences(self):
        bounds = cramer_rao_bounds(SensorArray(TETRAHEDRON.sensors[:1]), SOURCE, (0.0, 0.0, 100.0))
        assert bounds.rank == 0
        assert np.isinf(bounds.sigma).all()

    def test_of_a_source_without_moment_the_moment_alone_is_estimable(self):
        bounds = cramer_rao_bounds(TETRAHEDRON, SOURCE, np.zeros(3))
        assert bounds.rank == 3
        assert np.isinf(bounds.sigma[:3]).all()
        known_place = np.linalg.inv(fisher_information(TETRAHEDRON, SOURCE, np.zeros(3))[3:, 3:])
        assert_allclose(bounds.covariance[3:, 3:], known_place, rtol=1e-9, atol=1e-12)
        assert np.isnan(bounds.covariance[:3, 3:]).all()

    def test_four_vector_sensors_have_isolated_blind_sources_and_eight_have_none(self):
        # A 9×6 matrix loses rank under four conditions; at a given range, source and moment have four angles.
        def unit(azimuth, elevation):
            return [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]

        def least_singular_value(angles, array):
            W = nuisance_free_jacobian(array, 4.0 * np.array(unit(*angles[:2])), unit(*angles[2:]))
            return float(np.linalg.svd(W / np.linalg.norm(W, axis=0), compute_uv=False)[-1])

        starts = np.random.default_rng(1).uniform(-1.5, 1.5, size=(200, 4))
        least = {}
        for array in (TETRAHEDRON, cube(1.0, noise_T=1e-9)):
            values = np.array([least_singular_value(start, array) for start in starts])
            ends = [
                minimize(
                    least_singular_value,
                    start,
                    args=(array,),
                    method="Nelder-Mead",
                    options={"xatol": 1e-10, "fatol": 1e-12, "maxiter": 1500},
                )
                for start in starts[np.argsort(values)[:3]]
            ]
            best = min(ends, key=lambda end: end.fun)
            least[array.n_sensors] = best.fun / np.median(values)
            if array is TETRAHEDRON:
                blind = cramer_rao_bounds(array, 4.0 * np.array(unit(*best.x[:2])), unit(*best.x[2:]))
        assert least[4] < 1e-9
        assert least[8] > 0.1
        assert blind.rank == 5
        assert np.isinf([blind.sigma_range_m, blind.sigma_bearing_rad, blind.sigma_position_m]).all()

    def test_on_a_sensor_everything_and_in_the_centroid_range_and_bearing_are_not_a_number(self):
        array = random_array(9, 5)
        bounds = cramer_rao_bounds(array, np.stack([array.positions[1], array.centroid, SOURCE]), (0.0, 0.0, 100.0))
        assert_array_equal(np.isnan(bounds.sigma_range_m), [True, True, False])
        assert_array_equal(np.isnan(bounds.sigma_bearing_rad), [True, True, False])
        assert_array_equal(np.isnan(bounds.sigma).all(axis=1), [True, False, False])
        assert_array_equal(bounds.rank, [0, 6, 6])


class TestScatterOfFits:
    """The bound is reached where the problem is regular (σ_range/range about 1 %): probability 1e-4 to fail each."""

    def test_covariance(self):
        n = 4000
        position, moment = np.array([2.0, 1.0, 1.2]), np.array([60.0, 50.0, 60.0])
        rng = np.random.default_rng(10)
        readings = predicted_channels(TETRAHEDRON, position, moment) + 1e-9 * rng.standard_normal((n, 12))
        fixes = plain_locator(TETRAHEDRON).fit_rows(readings)
        errors = np.array([[*f.solutions[0].position_m - position, *f.solutions[0].moment_Am2 - moment] for f in fixes])
        bounds = cramer_rao_bounds(TETRAHEDRON, position, moment)
        squares = np.einsum("ni,ij,nj->n", errors, np.linalg.inv(bounds.covariance), errors)
        low, high = chi2.ppf([5e-5, 1 - 5e-5], 6 * n)
        assert low < squares.sum() < high
        away = position - TETRAHEDRON.centroid
        along = errors[:, :3] @ away / np.linalg.norm(away)
        low, high = chi2.ppf([5e-5, 1 - 5e-5], n)
        assert low < np.sum((along / bounds.sigma_range_m) ** 2) < high


class TestBatches:
    def test_leading_axes_broadcast(self):
        positions = np.array([[3.0, 1.0, 0.5], [5.0, 0.0, 0.3]])
        moments = np.array([[0.0, 0.0, 100.0], [100.0, 0.0, 0.0], [60.0, 50.0, 60.0]])
        array = replace(random_array(6, 5, uncertain=True), noise_fraction=1e-3)
        many = cramer_rao_bounds(array, positions[:, None], moments)
        assert many.covariance.shape == (2, 3, 6, 6)
        assert many.rank.shape == many.is_regular.shape == (2, 3)
        for i, j in np.ndindex(2, 3):
            one = cramer_rao_bounds(array, positions[i], moments[j])
            assert_allclose(many.covariance[i, j], one.covariance, rtol=1e-9)
            assert_allclose(many.sigma_range_m[i, j], one.sigma_range_m, rtol=1e-9)

    @pytest.mark.parametrize(
        ("position", "moment", "uncertainty", "text"),
        [
            ([1.0, 2.0], [0.0, 0.0, 1.0], 0.0, "Input position_m must have shape"),
            ([1.0, 2.0, 3.0], 4.0, 0.0, "Input moment_Am2 must have shape"),
            ([1.0, 2.0, 3.0], [0.0, 0.0, 1.0], -1.0, "Input ambient_uncertainty_T must be finite and not negative"),
            ([1.0, 2.0, 3.0], [0.0, 0.0, 1.0], np.inf, "Input ambient_uncertainty_T must be finite and not negative"),
        ],
    )
    def test_wrong_input(self, position, moment, uncertainty, text):
        with pytest.raises(ValueError, match=text):
            cramer_rao_bounds(TETRAHEDRON, position, moment, ambient_uncertainty_T=uncertainty)


POSE = PoseUncertainty(0.02, 0.005, 0.02, 10.0, 0.05, 0.01, 0.0, (0.3, -0.2, 0.5))
MIXED = replace(random_array(13, 9, kinds=("vector", "scalar")), ambient_T=AMBIENT)
ARRAYS = {
    "tetrahedron": TETRAHEDRON,
    "any vector sensors": random_array(11, 6),
    "common field of 30 nT": random_array(12, 5, common_field_T=30e-9),
    "planar": square(1.0, noise_T=1e-9),
    "scalar": SCALARS,
    "mixed": MIXED,
    "noise that depends on the readings": replace(random_array(14, 5), noise_fraction=1e-2),
    "noise of one sensor that depends on its reading": replace(
        SCALARS, sensors=(replace(SCALARS.sensors[0], noise_fraction=0.1), *SCALARS.sensors[1:])
    ),
    "uncertain calibration": replace(
        random_array(15, 9, kinds=("vector", "scalar"), uncertain=True, common_field_T=50e-9),
        ambient_T=AMBIENT,
        noise_fraction=1e-2,
    ),
    "fields that the ambient one induces": replace(
        MIXED, sensors=tuple(replace(s, induced_uncertainty=1e-4 * (i + 1)) for i, s in enumerate(MIXED.sensors))
    ),
    "uncertain ambient field": replace(MIXED, ambient_uncertainty_T=3e-8),
    "a pose that errs": replace(random_array(16, 6), pose=POSE),
    "a pose that errs, mixed": replace(
        random_array(17, 9, kinds=("vector", "scalar"), common_field_T=50e-9), ambient_T=AMBIENT, pose=POSE
    ),
}
each_array = pytest.mark.parametrize("array", ARRAYS.values(), ids=ARRAYS.keys())


def places(array, n=40):
    directions = sphere_directions(n)
    return array.centroid + directions * np.geomspace(1.3 * array.circumradius, 30.0 * array.circumradius, n)[:, None]


class TestKnownModulus:
    """What is known of the moment's modulus adds the information of one more measurement."""

    @each_array
    def test_adds_its_information(self, array):
        position, moment = random_source(4)
        W, sigma = nuisance_free_jacobian(array, position, moment), 3.0
        along = np.concatenate([np.zeros(3), moment / np.linalg.norm(moment)])
        expected = np.linalg.inv(W.T @ W + np.outer(along, along) / sigma**2)
        bounds = cramer_rao_bounds(array, position, moment, known_moment_sigma_Am2=sigma)
        unit = np.sqrt(np.diagonal(expected))
        assert_allclose(bounds.covariance / unit / unit[:, None], expected / unit / unit[:, None], atol=1e-7)

    def test_a_sigma_of_nothing_is_refused(self):
        with pytest.raises(ValueError, match="known_moment_sigma_Am2 must be positive"):
            cramer_rao_bounds(TETRAHEDRON, SOURCE, (0.0, 0.0, 100.0), known_moment_sigma_Am2=0.0)


class TestTable:
    """Tables are cramer_rao_bounds, and spreads those of the table."""

    @each_array
    def test_equals_the_reference(self, array, instruction_sets):
        # Lanes have sources of two places, and some are idle at the end.
        positions, moments = places(array, 21), moments_over(array, 65)
        reference = cramer_rao_bounds(array, positions[:, None], moments)
        for _ in instruction_sets:
            for name, values in sigma_table(array, positions, moments)._asdict().items():
                expected = {"range_m": reference.sigma_range_m, "bearing_rad": reference.sigma_bearing_rad}.get(
                    name, reference.sigma_position_m
                )
                assert_allclose(values, expected, rtol=1e-10, err_msg=name)

    def test_singular_and_undefined_ones_too(self):
        array = replace(hexagon(1.0, kind="scalar", noise_T=1e-10), ambient_T=AMBIENT)  # five differences
        positions = np.stack([np.array([3.0, 1.0, 2.0]), array.positions[0], array.centroid])
        table = sigma_table(array, positions, np.eye(3))
        assert np.isinf(table.range_m[0]).all()
        assert np.isinf(table.bearing_rad[0]).all()
        assert np.isnan(np.array(table)[:, 1]).all()
        nothing = sigma_table(TETRAHEDRON, positions[:1], np.zeros((1, 3)))
        assert np.isinf(np.array(nothing)).all()

    @pytest.mark.parametrize("n_moments", [1, 9])
    @pytest.mark.usefixtures("instruction_set")
    def test_singular_and_undefined_ones_of_vector_sensors(self, n_moments):
        """Of few moments, and of as many as have their rows in common."""
        moments, positions = moments_over(TETRAHEDRON, n_moments), np.array([SOURCE, 2.0 * SOURCE])
        for n_sensors in (1, 2):
            too_few = SensorArray(TETRAHEDRON.sensors[:n_sensors])
            assert np.isinf(np.array(sigma_table(too_few, positions, moments))).all()
        undefined = np.stack([TETRAHEDRON.positions[1], TETRAHEDRON.centroid])
        assert np.isnan(np.array(sigma_table(TETRAHEDRON, undefined, moments))).all()
        no_moment = np.array(sigma_table(TETRAHEDRON, positions, np.vstack([np.zeros(3), moments])))
        assert np.isinf(no_moment[..., 0]).all()
        assert np.isfinite(no_moment[..., 1:]).all()

    @each_array
    @pytest.mark.parametrize(
        "known", [{"body_length_m": None}, {"body_length_m": 0.3}, {"known_moment_sigma_Am2": 5.0}], ids=str
    )
    def test_equals_the_reference_of_what_is_known(self, array, known, instruction_sets):
        # Inside the array nothing said is no point. Known moduli leave rounding to say what is singular far away.
        inside = array.centroid + 0.3 * array.circumradius * sphere_directions(4)
        more = inside if "body_length_m" in known else inside[:0]
        positions, moments = np.concatenate([places(array, 6)[:5], more]), moments_over(array, 70)
        reference = cramer_rao_bounds(array, positions[:, None], moments, **known)
        helps = -1.0 if "known_moment_sigma_Am2" in known else 1.0
        for _ in instruction_sets:
            table, of_nothing = (sigma_table(array, positions, moments, **options) for options in (known, {}))
            assert_allclose(table.range_m, reference.sigma_range_m, rtol=1e-8)
            assert_allclose(table.bearing_rad, reference.sigma_bearing_rad, rtol=1e-8)
            assert (helps * table.range_m >= helps * of_nothing.range_m * (1.0 - helps * 1e-9)).all()

    @each_array
    def test_spreads_are_those_of_the_table(self, array):
        positions, moments = places(array, 12), moments_over(array, 21)
        table = sigma_table(array, positions, moments)
        for sigma, spread in zip(table, bounds_over_moments(array, positions, moments), strict=True):
            assert_allclose(spread.mean, sigma.mean(axis=1), rtol=1e-12)
            assert_allclose(spread.median, np.quantile(sigma, 0.5, axis=1, method="inverted_cdf"), rtol=1e-12)
            assert_allclose(spread.q95, np.quantile(sigma, 0.95, axis=1, method="inverted_cdf"), rtol=1e-12)
            assert_allclose(spread.worst, sigma.max(axis=1), rtol=1e-12)

    def test_a_modulus_of_no_field_has_no_bound_and_leaves_the_others_theirs(self):
        array = cube(1.5, kind="scalar", noise_T=1e-11)
        positions, moments = places(array, 3), np.array([[0.0, 0.0, 0.0], [60.0, 50.0, 60.0]])
        range_m = sigma_table(array, positions, moments).range_m
        assert np.isnan(range_m[:, 0]).all()
        assert_allclose(range_m, cramer_rao_bounds(array, positions[:, None], moments).sigma_range_m, rtol=1e-9)

    @pytest.mark.parametrize("array", [TETRAHEDRON, ARRAYS["uncertain calibration"]], ids=["constant", "varying"])
    def test_does_not_depend_on_the_number_of_threads(self, array, threads):
        positions, moments = places(array, 401), moments_over(array, 50)  # several blocks
        results = []
        for n_threads in (1, 4):
            threads(n_threads)
            results.append((sigma_table(array, positions, moments), bounds_over_moments(array, positions, moments)))
        for one, other in zip(*results, strict=True):
            assert_array_equal(np.array(one), np.array(other))

    @pytest.mark.parametrize("shape", [(3,), (0, 3), (2, 2), (2, 2, 3)])
    def test_wrong_shapes(self, shape):
        with pytest.raises(ValueError, match="Input positions_m must have shape"):
            sigma_table(TETRAHEDRON, np.ones(shape), np.eye(3))
        with pytest.raises(ValueError, match="Input moments_Am2 must have shape"):
            bounds_over_moments(TETRAHEDRON, np.eye(3), np.ones(shape))


class TestSpread:
    def test_infinite_values_spoil_only_what_they_reach(self):
        spread = spread_over([[1.0, 2.0, 3.0, np.inf], [4.0, 3.0, 2.0, 1.0], [np.nan, 1.0, 2.0, 3.0]])
        assert_array_equal(spread.median, [2.0, 2.0, np.nan])
        assert_array_equal(spread.q95, [np.inf, 4.0, np.nan])
        assert_array_equal(spread.worst, [np.inf, 4.0, np.nan])
        assert_array_equal(spread.mean, [np.inf, 2.5, np.nan])


class TestDirections:
    @pytest.mark.parametrize("n", [1, 26, 400])
    def test_are_unit_vectors(self, n):
        for directions in (sphere_directions(n), moments_on_sphere(1.0, n, half=True)):
            assert_allclose(np.linalg.norm(directions, axis=1), 1.0, rtol=1e-12)

    def test_are_even(self):
        sphere = sphere_directions(1000)
        half = moments_on_sphere(1.0, 1000, half=True)
        # Moments of inertia of the sphere, and of its half, are those of a ball's surface: 1/3 each.
        for directions in (sphere, half):
            assert_allclose(directions.T @ directions / 1000, np.eye(3) / 3, atol=2e-3)
        assert half[:, 2].min() > 0.0
        assert_array_equal(moments_on_sphere(1.0, 1000), sphere)

    def test_none_are_refused(self):
        with pytest.raises(ValueError, match="Input n must be at least 1"):
            moments_on_sphere(1.0, 0)
