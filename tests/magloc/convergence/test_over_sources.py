"""Maps over sources.

| what | who checks it |
|---|---|
| Cramér-Rao bounds | the specification's figures, and the errors of the fixes |
| found, missed | the χ² of the truth itself, an upper bound of the optimum searched from it |
| random numbers | boxes of other sizes |
| bodies | magpylib's cuboids and cylinders |
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from arrays.differences import decorrelated_differences
from arrays.geometries import axial, cube, grid, tetrahedron
from magloc.convergence.over_sources import SourcesMap, SourcesScenario, SourceStatus, summary
from magloc.grids.computed import computed_map
from magloc.grids.cube import Box
from magloc.plots.maps import sources
from tests.magloc.localization.test_finite_bodies import ASPECTS, LENGTH_M, magnet

PAPER = SourcesScenario()


@pytest.fixture(scope="module")
def paper_map():
    return computed_map(SourcesMap(PAPER, 21))


class TestFixes:
    def test_nearly_all_are_found(self, paper_map):
        assert summary(paper_map).fraction >= 0.9998

    def test_chi2_decides(self, paper_map):
        used = paper_map.status.to_numpy() != SourceStatus.LEFT_OUT
        found = (paper_map.chi2 <= paper_map.chi2_from_truth + 0.05).to_numpy()
        assert_array_equal(found[used], (paper_map.status == SourceStatus.FOUND).to_numpy()[used])

    def test_chi2_of_the_search_from_the_truth(self, paper_map):
        """12 readings less the common field and 6 unknowns: about 3 degrees of freedom, where they are observable."""
        near = (paper_map.sigma_range < 0.05).to_numpy()
        chi2 = paper_map.chi2_from_truth.to_numpy()[near]
        # Mean of n chi-square variables with 3 degrees of freedom within 4 sigma: one false alarm in 16,000.
        assert chi2.mean() == pytest.approx(3.0, abs=4.0 * np.sqrt(6.0 / chi2.size))

    def test_errors_are_as_large_as_their_bounds(self, paper_map):
        near = (paper_map.sigma_range < 0.05).to_numpy()
        squares = (paper_map.distance / paper_map.sigma_position).to_numpy()[near] ** 2
        # E[squares] = 1, and their variance is at most 2 (all of it along one axis): 4 sigma.
        assert squares.mean() == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / squares.size))

    def test_what_is_close_is_found_where_it_is(self, paper_map):
        near = (paper_map.sigma_range < 0.05).to_numpy()
        assert near.sum() > 100
        assert paper_map.truth_listed.to_numpy()[near].all()
        assert paper_map.range_observable.to_numpy()[near].all()
        assert (paper_map.solutions.to_numpy()[near] >= 1).all()

    def test_left_out(self, paper_map):
        distance = np.sqrt(paper_map.x**2 + paper_map.y**2 + paper_map.z**2).to_numpy()
        left_out = (distance < 1.0) | (distance > 12.0)
        assert_array_equal(paper_map.status.to_numpy() == SourceStatus.LEFT_OUT, left_out)
        for name in ("chi2", "distance", "sigma_range", "sigma_position"):
            assert_array_equal(np.isnan(paper_map[name].to_numpy()), left_out)
        assert (paper_map.truth_listed.to_numpy()[left_out] == -1).all()
        assert summary(paper_map).starts == (~left_out).sum()

    def test_sources_are_where_the_map_says(self):
        """On the side of the better sensors they are known better than on the other, whatever their moments."""
        board = cube(1.5)
        better = [replace(s, noise_T=1e-11 if s.position_m[0] > 0.0 else 1e-9) for s in board.sensors]
        scenario = SourcesScenario(replace(board, sensors=tuple(better)), half_width_m=2.0, nearest_m=1.9)
        sigma = computed_map(SourcesMap(scenario, 4)).sigma_range.to_numpy()
        assert (sigma[-1] < 0.7 * sigma[0]).all()

    def test_noise_that_grows_with_the_field(self):
        array = replace(tetrahedron(1.5, noise_T=1e-9), noise_fraction=0.01)
        dataset = computed_map(SourcesMap(replace(PAPER, array=array, farthest_m=4.0, half_width_m=4.0), 5))
        used = dataset.status.to_numpy() != SourceStatus.LEFT_OUT
        assert (dataset.status.to_numpy()[used] == SourceStatus.FOUND).mean() > 0.9
        exact = computed_map(SourcesMap(replace(PAPER, farthest_m=4.0, half_width_m=4.0), 5))
        assert (dataset.sigma_range > exact.sigma_range).to_numpy()[used].all()


class TestNotConverged:
    """A search from the truth that ends nowhere: the mean over the others stays, and their share is told."""

    @pytest.fixture(scope="class")
    @classmethod
    def hasty_map(cls):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("magloc.convergence.over_sources._MAX_ITERATIONS", 12)
            return computed_map(SourcesMap(PAPER, 7))

    def test_is_a_share_and_no_infinite_mean(self, hasty_map):
        used = hasty_map.status.to_numpy() != SourceStatus.LEFT_OUT
        lost = used & np.isnan(hasty_map.chi2_from_truth.to_numpy())
        assert 0 < lost.sum() < used.sum()
        assert np.isfinite(float(hasty_map.chi2_from_truth.mean()))
        counts = summary(hasty_map)
        assert counts.not_converged == lost.sum() / used.sum()
        assert f"from the truth {counts.not_converged:.2%} did not converge" in counts.lines()[0]

    def test_no_better_solution_is_known_there(self, hasty_map):
        lost = np.isnan(hasty_map.chi2_from_truth.to_numpy()) & np.isfinite(hasty_map.chi2.to_numpy())
        assert (hasty_map.status.to_numpy()[lost] == SourceStatus.FOUND).all()

    def test_the_paper_has_none(self, paper_map):
        assert summary(paper_map).not_converged == 0.0
        assert "converge" not in summary(paper_map).lines()[0]


class TestKnownStrength:
    """Fixes that know the moments' modulus to 10 %, by which the moments differ."""

    KNOWN = replace(PAPER, half_width_m=8.0, farthest_m=8.0, known_moment_sigma_Am2=30.0)

    @pytest.fixture(scope="class")
    @classmethod
    def known_map(cls):
        return computed_map(SourcesMap(cls.KNOWN, 7))

    @pytest.mark.slow
    def test_fixes_know_it_as_well_as_their_bounds(self, known_map):
        assert summary(known_map).fraction == 1.0
        used = known_map.status.to_numpy() == SourceStatus.FOUND
        squares = (known_map.distance / known_map.sigma_position).to_numpy()[used] ** 2
        # E[squares] = 1, and their variance is at most 2 (all of it along one axis): 4 sigma.
        assert squares.mean() == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / squares.size))

    def test_is_better_than_without(self, known_map):
        unknown = computed_map(SourcesMap(replace(self.KNOWN, known_moment_sigma_Am2=np.inf), 7))
        far = (unknown.sigma_range > 0.5).to_numpy()
        assert far.any()
        # The range goes as the cube root of the moment: 10 % of it are 3 % of 8 m.
        assert (known_map.sigma_range.to_numpy()[far] < 0.04 * 8.0).all()
        assert known_map.range_observable.to_numpy()[far].all()
        assert known_map.truth_listed.to_numpy()[far].all()

    def test_moments_differ_by_it(self):
        moment, *_ = SourcesMap(self.KNOWN, 17)._random(Box((0, 0, 0), (slice(0, 17),) * 3))
        size = np.linalg.norm(moment, axis=1)
        # Mean and deviation within 5 sigma of theirs: one false alarm in a million.
        assert_allclose([size.mean(), size.std()], [300.0, 30.0], atol=5.0 * 30.0 / np.sqrt(size.size))


class TestBodies:
    """Magnets of 2 cm, from about two lengths from the nearest of twelve sensors on."""

    BOARD = grid(4, 3, 0.8 * LENGTH_M, noise_T=1e-7)
    POINTS = SourcesScenario(
        BOARD, half_width_m=0.1, nearest_m=0.06, farthest_m=0.12, moment_Am2=0.5, body_length_m=0.0
    )
    BODIES = replace(POINTS, body_length_m=LENGTH_M)

    def test_drawn_bodies(self):
        dataset = computed_map(SourcesMap(self.BODIES, 7))
        assert summary(dataset).fraction == 1.0
        check_nees(dataset)
        points = computed_map(SourcesMap(self.POINTS, 7))
        used = points.status.to_numpy() == SourceStatus.FOUND
        assert (dataset.sigma_position > points.sigma_position).to_numpy()[used].all()

    @pytest.mark.parametrize("seeds", [1, pytest.param(20, marks=pytest.mark.slow)])
    def test_cuboids_and_cylinders(self, seeds):
        """Fields of magpylib, at the places and with the moments of the map."""
        of_bodies, of_points = [], []
        for seed in range(seeds):
            bodies, points = (SourcesMap(replace(scenario, seed=seed), 7) for scenario in (self.BODIES, self.POINTS))
            position, moment, noise, _ = drawn(bodies)
            fields = self.fields(position, moment, np.random.default_rng(seed))
            readings = self.BOARD.readings_of(fields) + self.BOARD.channel_noise_T * noise
            of_bodies.append(bodies._values_of(position, moment, readings)["nees"])
            of_points.append(points._values_of(position, moment, readings)["nees"])
        assert np.isfinite(of_bodies).mean() > 0.99
        assert 0.7 <= np.nanmean(of_bodies) <= 1.4
        assert np.nanmean(of_points) > 20.0

    def fields(self, position, moment, rng):
        """Fields (n, N, 3) of a body of random shape and attitude each."""
        fields = []
        for p, m in zip(position, moment, strict=True):
            turn = Rotation.random(rng=rng)
            in_body = turn.inv().apply(m)
            body, volume = magnet(("cuboid", "cylinder")[rng.integers(2)], rng.choice(ASPECTS), in_body)
            body.polarization = in_body * 4e-7 * np.pi / volume
            body.position, body.orientation = p, turn
            fields.append(body.getB(self.BOARD.positions))
        return np.array(fields)

    def test_near_the_array_a_quarter_of_the_distance_is_assumed(self):
        near = replace(self.BODIES, nearest_m=0.005, farthest_m=0.02, half_width_m=0.02, body_length_m=None)
        unsaid, points = (SourcesMap(replace(near, body_length_m=length), 5) for length in (None, 0.0))
        position, moment, noise, errors = drawn(unsaid)
        assert unsaid._lengths(position).any()
        assert not SourcesMap(replace(PAPER, body_length_m=None), 5)._lengths(np.array([[3.0, 0.0, 0.0]])).any()
        values = unsaid._values_of(position, moment, unsaid._readings(position, moment, noise, errors))
        bounds = points._values_of(position, moment, points._readings(position, moment, noise, errors))
        assert (values["sigma_position"] >= (1.0 - 1e-9) * bounds["sigma_position"]).all()  # equal, but for rounding
        assert (values["sigma_position"] > bounds["sigma_position"]).any()


class TestAmbientField:
    """Moduli in an ambient field that is not exact."""

    ARRAY = replace(grid(4, 3, 1.0, kind="scalar", noise_T=1e-10), ambient_T=(2e-5, 0.0, -4e-5))
    NEAR = SourcesScenario(ARRAY, half_width_m=4.0, nearest_m=2.2, farthest_m=5.0, moment_Am2=100.0)

    @pytest.mark.parametrize(
        ("sigma_T", "n"),
        [(50e-9, 4), pytest.param(50e-9, 12, marks=pytest.mark.slow), pytest.param(500e-9, 12, marks=pytest.mark.slow)],
    )
    def test_fixes_are_as_certain_as_they_say(self, sigma_T, n):
        errs = replace(self.ARRAY, ambient_uncertainty_T=sigma_T)
        dataset = computed_map(SourcesMap(replace(self.NEAR, array=errs), n))
        assert summary(dataset).fraction > 0.97
        check_nees(dataset)

    def test_not_stated(self):
        errs = SourcesMap(replace(self.NEAR, array=replace(self.ARRAY, ambient_uncertainty_T=50e-9)), 4)
        position, moment, noise, errors = drawn(errs)
        readings = errs._readings(position, moment, noise, errors)
        assert np.nanmean(SourcesMap(self.NEAR, 4)._values_of(position, moment, readings)["nees"]) > 10.0


def drawn(cube):
    """Places, moments, noise and model errors of the sources of a map that are used."""
    box = Box((0, 0, 0), (slice(0, cube.grid),) * 3)
    relative = box.points(cube.axis)
    distance = np.linalg.norm(relative, axis=1)
    used = (distance >= cube.scenario.nearest_m) & (distance <= cube.scenario.farthest_m)
    return cube.scenario.array.centroid + relative[used], *(part[used] for part in cube._random(box))


def check_nees(dataset):
    """NEES per dimension, of six, is 1 on average where the search did not miss the truth's optimum.

    Within 0.8 to 1.25, and within 4 sigma of the draws: one false alarm in 16,000.
    """
    assert summary(dataset).truth_listed > 0.97
    values = dataset.nees.to_numpy()[dataset.truth_listed.to_numpy() == 1]
    known = values[np.isfinite(values)]
    assert known.size >= 20
    chance = 4.0 / np.sqrt(3.0 * known.size)
    assert 0.8 - chance <= known.mean() <= 1.25 + chance


class TestRandomNumbers:
    def test_boxes_do_not_matter(self):
        cube = SourcesMap(replace(PAPER, seed=3), 9)
        whole = cube.values(Box((0, 0, 0), (slice(0, 9),) * 3))
        part = (slice(2, 5), slice(0, 9), slice(6, 8))
        for name, values in cube.values(Box((0, 0, 0), part)).items():
            assert_array_equal(values, whole[name][part])

    def test_moments_and_noise(self):
        cube = SourcesMap(PAPER, 17)
        moment, noise, errors = cube._random(Box((0, 0, 0), (slice(0, 17),) * 3))
        n = 17**3
        assert_allclose(np.linalg.norm(moment, axis=1), PAPER.moment_Am2)
        # Means within 5 sigma, 32 of them: one false alarm in 50,000.
        assert_allclose(moment.mean(axis=0) / PAPER.moment_Am2, 0.0, atol=5.0 / np.sqrt(3.0 * n))
        normal = np.concatenate([noise, errors], axis=1)
        assert_allclose(normal.mean(axis=0), 0.0, atol=5.0 / np.sqrt(n))
        assert len(np.unique(normal)) == normal.size
        other, *_ = SourcesMap(replace(PAPER, seed=1), 17)._random(Box((0, 0, 0), (slice(0, 17),) * 3))
        assert not np.isin(other, moment).any()


class TestRefused:
    @pytest.mark.parametrize(
        ("array", "grid", "expected"),
        [
            (PAPER.array, 1, "Input grid must be at least 2"),
            (tetrahedron(1.5, kind="scalar", noise_T=1e-9), 5, "3 independent differences, 6 are needed"),
            (tetrahedron(1.5, noise_T=1e140), 5, "must have a noise between 1e-11 and 1e12 nT"),
            (axial(1.0, noise_T=1e-9), 5, "3 independent differences, 6 are needed"),
        ],
    )
    def test_scenarios(self, array, grid, expected):
        with pytest.raises(ValueError, match=expected):
            computed_map(SourcesMap(replace(PAPER, array=array), grid))


def test_three_degrees_of_freedom():
    assert decorrelated_differences(PAPER.array).variance.size - 6 == 3


def test_figure(paper_map):
    figure = sources(paper_map)
    assert "4168 sources" in figure.get_suptitle()
    for ax in figure.axes[:6]:
        assert ax.get_xlabel().endswith("[m]")
        assert ax.get_ylabel().endswith("[m]")
