"""Array design: the criterion, its slope, the descent, the volumes, and what a design gains.

====================================  ==========================================================================
what                                  who checks it
====================================  ==========================================================================
σ of the range                        magloc.bounds.crlb (an SVD of the whitened Jacobian), vector and scalar sensors
its slope                             scipy.differentiate, by places of the sensors
smoothed quantile                     scipy.stats.mstats.hdquantiles; its gap to the order statistic
descent                               scipy's simplex search does not find better nearby; projected slope
nearest points of volumes             variational inequality; trimesh.proximity on a mesh
gain over the regular tetrahedron     the figures of the project: 20 % at 2 m, 10 % at 4 m, little at 8 m
====================================  ==========================================================================
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.differentiate import jacobian
from scipy.optimize import minimize
from scipy.spatial.distance import cdist, pdist
from scipy.stats import qmc
from scipy.stats.mstats import hdquantiles

from arrays.geometries import cube, tetrahedron
from magloc.bounds.crlb import cramer_rao_bounds
from magloc.design.descent import ArrayProblem, Sample, descend, is_spaced, move_into_volume
from magloc.design.evaluation import references, worst_case
from magloc.design.optimise import design_array, random_sample, sobol_sample, starts_of
from magloc.design.regions import Block, Cap, Mean, Quantile
from magloc.design.task import DesignSearch, DesignTask
from magloc.design.volumes import Ball, BoxVolume, Cylinder, MeshSurface, even_grid
from magloc.fields.dipole import field
from magloc.plots.designs import clearest_azimuth
from tests.plain_locator import plain_locator

RADIUS = 0.92
BALL = Ball((0.0, 0.0, 0.0), RADIUS)
HALF_SPACE = Cap(2.0, 2.0, (1.0, 0.0, 0.0), 0.5 * np.pi)
TASK = DesignTask("half-space", 4, "vector", 1e-9, BALL, HALF_SPACE, 100.0, Quantile(0.95))
SCALAR = replace(TASK, n_sensors=8, kind="scalar", noise_T=1e-11, ambient_T=(2e-5, 0.0, -4.5e-5))
TETRAHEDRON = tetrahedron(RADIUS / np.sqrt(3.0 / 8.0)).positions
CUBE = cube(2.0 * RADIUS / np.sqrt(3.0)).positions
SMALL = DesignSearch(n_starts=4, n_refined=1, log2_small=8, log2_large=10, small_iterations=15, large_iterations=40,
                     n_judged=4000)  # fmt: skip


def rng(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


class TestRangeDeviation:
    @pytest.mark.parametrize(
        ("task", "shape"), [(TASK, TETRAHEDRON), (SCALAR, CUBE), (replace(TASK, n_sensors=8), CUBE)]
    )
    @pytest.mark.usefixtures("instruction_set")
    def test_equals_the_bounds(self, task, shape):
        sensors = shape + rng(1).normal(0.0, 0.1, shape.shape)
        sample = random_sample(task, 500, rng(2))
        expected = cramer_rao_bounds(task.array(sensors), sample.positions, sample.moments).sigma_range_m
        np.testing.assert_allclose(sample.deviations(task, sensors), expected, rtol=1e-7)

    @pytest.mark.parametrize(("task", "shape"), [(TASK, TETRAHEDRON), (SCALAR, CUBE)])
    @pytest.mark.usefixtures("instruction_set")
    def test_slope_is_the_derivative(self, task, shape):
        sensors = shape + rng(3).normal(0.0, 0.1, shape.shape)
        for source in range(5):
            every = random_sample(task, 5, rng(4))
            one = Sample(every.positions[source : source + 1], every.moments[source : source + 1])

            def log_deviation(x: np.ndarray, one=one) -> np.ndarray:
                flat = x.reshape(sensors.size, -1).T
                values = [np.log(one.deviations(task, places.reshape(-1, 3))[0]) for places in flat]
                return np.array(values).reshape(x.shape[1:])

            _, slope = one.log_value_and_slope(task, sensors)
            found = jacobian(log_deviation, sensors.ravel(), initial_step=1e-2, tolerances={"rtol": 1e-8})
            np.testing.assert_allclose(slope.ravel(), found.df, rtol=1e-4, atol=1e-5 * np.abs(found.df).max())

    def test_no_range_without_enough_sensors(self):
        flat = np.array([[0.0, 0.0, 1.0]] * 4)
        assert np.all(np.isinf(random_sample(TASK, 10, rng(5)).deviations(TASK, flat)))

    def test_threads_do_not_matter(self, threads):
        sample = random_sample(TASK, 30_000, rng(6))  # several blocks
        results = []
        for n_threads in (1, 4):
            threads(n_threads)
            results.append(sample.log_value_and_slope(TASK, TETRAHEDRON))
        assert results[0][0] == results[1][0]
        np.testing.assert_array_equal(results[0][1], results[1][1])


class TestCriterion:
    @pytest.mark.parametrize("level", [0.5, 0.95])
    def test_weights_are_those_of_harrell_and_davis(self, level):
        values = rng(7).lognormal(size=400)
        found = Quantile(level).weights(400) @ np.sort(values)
        assert found == pytest.approx(float(hdquantiles(values, level)[0]), rel=1e-9)

    def test_smoothing_stays_within_the_sampling_error(self):
        """Between the order statistics two standard errors of the level below and above."""
        sample = sobol_sample(TASK, 12, rng(8))
        deviations = sample.deviations(TASK, TETRAHEDRON)
        error = np.sqrt(0.95 * 0.05 / deviations.size)
        low, high = np.quantile(deviations, [0.95 - 2.0 * error, 0.95 + 2.0 * error])
        assert low < sample.value(TASK, TETRAHEDRON) < high

    @pytest.mark.parametrize("criterion", [Quantile(0.9), Mean()])
    def test_slope_of_the_criterion(self, criterion):
        task = replace(TASK, criterion=criterion)
        sample = sobol_sample(task, 9, rng(9))
        sensors = TETRAHEDRON + rng(10).normal(0.0, 0.1, (4, 3))
        value, slope = sample.log_value_and_slope(task, sensors)
        assert value == pytest.approx(np.log(sample.value(task, sensors)), rel=1e-12)
        for i in range(12):
            step = 1e-5 * np.eye(12)[i].reshape(4, 3)
            rise = np.log(sample.value(task, sensors + step)) - np.log(sample.value(task, sensors - step))
            assert rise / 2e-5 == pytest.approx(slope.ravel()[i], rel=1e-3, abs=1e-3)

    def test_infinite_deviations_above_the_quantile_do_not_count(self):
        assert Quantile(0.5).of(np.array([1.0, 2.0, 3.0, np.inf])) == 2.0


class TestSources:
    def test_half_space(self):
        positions, moments = TASK.sources(rng(15).random((4000, 5)))
        np.testing.assert_allclose(np.linalg.norm(positions, axis=1), 2.0, rtol=1e-12)
        np.testing.assert_allclose(np.linalg.norm(moments, axis=1), 100.0, rtol=1e-12)
        assert positions[:, 0].min() >= 0.0
        # The height of an even distribution over a half-sphere is even (Archimedes): 4 standard errors.
        assert positions[:, 0].mean() == pytest.approx(1.0, abs=4.0 * 2.0 / np.sqrt(12.0 * 4000))
        assert np.abs(moments.mean(axis=0)).max() < 4.0 * 100.0 / np.sqrt(3.0 * 4000)

    def test_cone_and_block(self):
        cone = Cap(1.0, 3.0, (0.0, 2.0, 0.0), np.radians(20.0)).positions(rng(16).random((500, 3)))
        length = np.linalg.norm(cone, axis=1)
        assert (length.min() >= 1.0) & (length.max() <= 3.0)
        assert (cone[:, 1] / length).min() >= np.cos(np.radians(20.0)) - 1e-12
        block = Block((1.0, 2.0, 3.0), (2.0, 2.0, 5.0)).positions(rng(17).random((500, 3)))
        assert np.all((block >= [1.0, 2.0, 3.0]) & (block <= [2.0, 2.0, 5.0]))


HULL = MeshSurface(trimesh.creation.icosphere(subdivisions=2, radius=0.5).apply_translation([0.1, -0.2, 0.3]))
VOLUMES = [
    BALL,
    BoxVolume((0.1, 0.2, 0.3), (1.0, 2.0, 0.0)),
    Cylinder((0.0, -0.3, 0.1), 0.5, 1.0),
    HULL,
]


class TestVolumes:
    @pytest.mark.parametrize("volume", VOLUMES)
    def test_points_of_it_stay(self, volume):
        points = volume.random(50, rng(18))
        np.testing.assert_allclose(volume.nearest(points), points, atol=1e-12)
        assert np.linalg.norm(points - volume.centre, axis=1).max() <= volume.radius * (1.0 + 1e-6)

    @pytest.mark.parametrize("volume", VOLUMES)
    def test_nothing_is_nearer(self, volume):
        points = volume.centre + rng(19).normal(0.0, 2.0, (30, 3))
        distance = np.linalg.norm(volume.nearest(points) - points, axis=1)
        others = volume.random(3000, rng(20))
        assert np.all(distance <= np.linalg.norm(others - points[:, None], axis=-1).min(axis=1) + 1e-12)

    def test_surface_as_trimesh_finds_it(self):
        points = rng(21).normal(0.0, 0.6, (40, 3))
        expected, distance, _ = trimesh.proximity.closest_point_naive(HULL.mesh, points)
        np.testing.assert_allclose(HULL.nearest(points), expected, atol=1e-9)
        np.testing.assert_allclose(np.linalg.norm(HULL.nearest(points) - points, axis=1), distance, atol=1e-12)

    @pytest.mark.parametrize("volume", VOLUMES)
    def test_spacing(self, volume):
        task = replace(TASK, n_sensors=6, volume=volume, least_spacing_m=0.3)
        together = np.tile(volume.random(1, rng(22)), (6, 1))
        apart = move_into_volume(task, together)
        assert is_spaced(task, apart)
        assert pdist(apart).min() >= 0.3 * (1.0 - 1e-6)
        np.testing.assert_allclose(volume.nearest(apart), apart, atol=1e-9)

    @pytest.mark.parametrize("axis", range(3))
    def test_spacing_at_the_end_of_a_rod(self, axis):
        size = 2.0 * np.eye(3)[axis]
        task = replace(TASK, volume=BoxVolume((0.0, 0.0, 0.0), tuple(size)), least_spacing_m=0.3)
        apart = move_into_volume(task, np.tile(3.0 * size, (4, 1)))
        assert pdist(apart).min() >= 0.3 * (1.0 - 1e-6)
        np.testing.assert_array_equal(np.delete(apart, axis, axis=1), 0.0)


class TestBlock:
    def test_sources_fill_it_and_point_everywhere(self):
        """Mean of 4096 points of a Sobol sequence, and of a unit vector's squares: to a per cent."""
        task = replace(TASK, region=Block((1.0, 2.0, 3.0), (2.0, 4.0, 7.0)))
        positions, moments = task.sources(qmc.Sobol(5, seed=3).random(4096))
        np.testing.assert_allclose(positions.mean(axis=0), [1.5, 3.0, 5.0], rtol=0.01)
        np.testing.assert_allclose(np.ptp(positions, axis=0), [1.0, 2.0, 4.0], rtol=0.01)
        np.testing.assert_allclose(np.linalg.norm(moments, axis=1), TASK.moment_Am2)
        np.testing.assert_allclose((moments**2).mean(axis=0), TASK.moment_Am2**2 / 3.0, rtol=0.01)


class TestDescent:
    def test_simplex_search_finds_no_better_place_nearby(self):
        """Of scipy's Nelder-Mead, from the end of a descent that converged, on the same sample."""
        sample = sobol_sample(TASK, 9, rng(23))
        steps: list[int] = []
        start = starts_of(TASK, 4, rng(24))[0]
        found = descend(ArrayProblem(TASK, sample), start, max_iterations=400, step_done=steps.append)
        assert found.converged
        assert sum(steps) == 400  # those that were not needed count as done
        again = minimize(
            lambda x: np.log(sample.value(TASK, BALL.nearest(x.reshape(4, 3)))),
            found.points.ravel(),
            method="Nelder-Mead",
            options={"maxfev": 2000, "initial_simplex": found.points.ravel() + 0.01 * np.eye(13, 12)},
        )
        assert again.fun > np.log(found.value) - 0.03

    @pytest.mark.parametrize("seed", range(3))
    def test_never_worse_than_its_start(self, seed):
        sample = sobol_sample(TASK, 7, rng(25))
        start = BALL.random(4, rng(seed))
        found = descend(ArrayProblem(TASK, sample), start, max_iterations=5)
        assert found.value <= sample.value(TASK, start)
        assert found.value == pytest.approx(sample.value(TASK, found.points), rel=1e-9)

    def test_iterations_used_up_are_no_convergence(self):
        sample = sobol_sample(TASK, 7, rng(26))
        steps: list[int] = []
        found = descend(ArrayProblem(TASK, sample), TETRAHEDRON, max_iterations=3, step_done=steps.append)
        assert not found.converged
        assert sum(steps) == 3


@pytest.fixture(scope="module")
def found():
    return design_array(replace(TASK, search=SMALL), rng=1)


class TestEvenGrid:
    """As many sensors in the same volume, of which nothing is computed."""

    def test_nine_on_a_plate_are_three_by_three(self):
        plate = BoxVolume((1.0, 2.0, 3.0), (0.6, 0.6, 0.001))
        points = even_grid(plate, 9, rng(40)) - plate.centre
        places = np.stack(np.meshgrid([-0.3, 0.0, 0.3], [-0.3, 0.0, 0.3], [0.0]), axis=-1).reshape(-1, 3)
        assert cdist(points, places).min(axis=0).max() < 1e-9

    def test_seven_in_a_cube_are_no_line(self):
        """Which is the only lattice that they have."""
        assert np.linalg.matrix_rank(even_grid(BoxVolume((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)), 7, rng(43))) == 3

    def test_four_in_a_ball_are_a_regular_tetrahedron(self):
        points = even_grid(BALL, 4, rng(41))
        np.testing.assert_allclose(pdist(points), np.sqrt(8.0 / 3.0) * RADIUS, rtol=0.06)
        assert np.linalg.norm(points, axis=1).max() == pytest.approx(RADIUS, rel=1e-6)

    def test_on_a_surface(self):
        points = even_grid(HULL, 12, rng(42))
        _, distance, _ = trimesh.proximity.closest_point_naive(HULL.mesh, points)
        assert distance.max() < 1e-9
        assert pdist(points).min() > 0.1


class TestDesign:
    def test_is_inside_and_better_than_its_starts(self, found):
        assert np.linalg.norm(found.array.positions, axis=1).max() <= RADIUS * (1.0 + 1e-9)
        assert found.fitted_m <= found.start_m
        assert found.judged[0].array is found.array
        assert [judged.name for judged in found.judged[1:]] == [
            "best start",
            "tetrahedron",
            "cube",
            "cross",
            "even grid",
        ]

    def test_judged_on_independent_sources(self, found):
        sources = random_sample(TASK, 20_000, rng(27))
        own = TASK.criterion.of(sources.deviations(TASK, found.array.positions))
        assert found.judged[0].criterion_m == pytest.approx(own, rel=0.05)
        tetrahedron_ = found.judged[2]
        assert tetrahedron_.gain == pytest.approx(1.0 - own / tetrahedron_.criterion_m, abs=0.05)
        assert 0.0 < tetrahedron_.gain_error < 0.05

    def test_same_seed_same_array_whatever_the_threads(self, found, threads):
        threads(1)
        again = design_array(replace(TASK, search=SMALL), rng=1)
        assert again.array == found.array
        other = design_array(
            replace(TASK, search=replace(SMALL, n_starts=2, small_iterations=3, large_iterations=3)), rng=2
        )
        assert other.array != found.array

    def test_fixes_of_simulated_readings_gain_as_well(self, found):
        """The bound is what fixes attain: their range errors fall as it does, to three standard errors of 4 %."""
        sources = random_sample(TASK, 2500, rng(33))
        errors = []
        for array in (found.array, found.judged[2].array):
            fields = field(array.positions, sources.positions[:, None], sources.moments[:, None])
            noise = rng(34).normal(0.0, 1e-9, (2500, 12))
            fixes = plain_locator(array).fit_rows(array.readings_of(fields) + noise)
            ranges = [np.linalg.norm(fix.solutions[0].position_m - array.centroid) for fix in fixes]
            errors.append(np.abs(ranges - np.linalg.norm(sources.positions - array.centroid, axis=1)))
        own, theirs = np.quantile(errors, 0.95, axis=1)
        assert own / theirs == pytest.approx(1.0 - found.judged[2].gain, rel=0.12)

    def test_surface(self):
        task = replace(TASK, volume=HULL, least_spacing_m=0.2)
        result = design_array(replace(task, search=replace(SMALL, n_starts=2)), rng=3)
        _, distance, _ = trimesh.proximity.closest_point_naive(HULL.mesh, result.array.positions)
        assert distance.max() < 1e-9
        assert pdist(result.array.positions).min() >= 0.2 * (1.0 - 1e-6)
        assert result.fitted_m <= result.start_m

    def test_references_have_the_span(self):
        for reference in references(TASK, sobol_sample(TASK, 6, rng(28)), rng(29))[:3]:
            np.testing.assert_allclose(np.linalg.norm(reference.positions, axis=1), RADIUS, rtol=1e-12)

    def test_references_that_could_be_built_are_starts(self):
        """So that no tetrahedron of the span, in none of the tried attitudes, is better on the sample."""
        search = replace(SMALL, n_starts=2, small_iterations=1, large_iterations=1)
        result = design_array(replace(TASK, search=search), rng=4)
        sample = sobol_sample(TASK, search.log2_large, rng(0))
        for judged in (result.judged[2], result.judged[4]):
            assert sample.value(TASK, result.array.positions) < 1.03 * sample.value(TASK, judged.array.positions)

    def test_lengths_scale(self):
        """Everything a thousand times smaller, and a moment that leaves σ the same share of the range."""
        small = replace(
            TASK,
            volume=Ball((0.0, 0.0, 0.0), 1e-3 * RADIUS),
            region=Cap(2e-3, 2e-3, (1.0, 0.0, 0.0), 0.5 * np.pi),
            moment_Am2=1e-7,
        )
        search = replace(SMALL, n_starts=2, large_iterations=5, small_iterations=5, n_judged=1000)
        one, other = (design_array(replace(task, search=search)) for task in (TASK, small))
        np.testing.assert_allclose(1e3 * other.array.positions, one.array.positions, rtol=1e-6, atol=1e-6)
        assert 1e3 * other.fitted_m == pytest.approx(one.fitted_m, rel=1e-6)

    def test_progress_comes_to_the_end(self):
        steps: list[int] = []
        search = replace(SMALL, n_starts=3, small_iterations=4, large_iterations=4, n_judged=500)
        design_array(replace(TASK, search=search), progress=steps.append)
        assert sum(steps) == search.n_steps

    def test_no_room(self):
        with pytest.raises(ValueError, match="Input task must allow sensors"):
            design_array(replace(TASK, least_spacing_m=5.0, search=SMALL))

    def test_too_few_sensors(self):
        with pytest.raises(ValueError, match="Input n_sensors must be at least 3 for vector sensors"):
            replace(TASK, n_sensors=2)
        with pytest.raises(ValueError, match="Input ambient_T must be given"):
            replace(SCALAR, ambient_T=None)


class TestWorstCase:
    def test_four_vector_sensors_have_none(self, found):
        """The σ grows until rounding stops it, for any four sensors: a thousand times the 95 % quantile and more."""
        sample = sobol_sample(TASK, 9, rng(30))
        for sensors in (TETRAHEDRON, found.array.positions, BALL.random(4, rng(31))):
            assert worst_case(TASK, sensors, sample) > 1e3 * sample.value(TASK, sensors)
        assert not found.worst_is_bounded

    def test_eight_have_one(self):
        task = replace(TASK, n_sensors=8)
        sample = sobol_sample(task, 9, rng(32))
        assert worst_case(task, CUBE, sample) < 10.0 * sample.value(task, CUBE)


@pytest.mark.slow
class TestGain:
    """The project's figures, for the default search, with independent seeds."""

    @pytest.mark.parametrize(("distance", "least", "most"), [(2.0, 0.2, 1.0), (4.0, 0.1, 1.0), (8.0, 0.0, 0.1)])
    @pytest.mark.parametrize("seed", [0, 1, 2])
    def test_over_the_tetrahedron(self, distance, least, most, seed):
        task = replace(TASK, region=Cap(distance, distance, (1.0, 0.0, 0.0), 0.5 * np.pi))
        result = design_array(task, rng=seed)
        tetrahedron_ = result.judged[2]
        assert least <= tetrahedron_.gain - 2.0 * tetrahedron_.gain_error
        assert tetrahedron_.gain < most
        assert ("tetrahedron" in result.near_optimal) == (distance == 8.0)
        assert result.converged


class TestPicture:
    """It is looked at from where the names of the sensors do not cover each other."""

    @pytest.mark.parametrize("azimuth", [-55.0, 35.0])
    def test_two_sensors_behind_one_another_are_seen_from_elsewhere(self, azimuth):
        e, a = np.radians([22.0, azimuth])
        sight = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
        points = np.array([sight, -sight, [0.0, 0.0, 2.0]])
        e, a = np.radians([22.0, clearest_azimuth(points)])
        towards = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
        assert np.linalg.norm(np.cross(towards, 2.0 * sight)) > 1.0
