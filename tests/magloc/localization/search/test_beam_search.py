"""Starts, and the search over several sources.

| what | who checks it |
|---|---|
| scores of candidates | numpy.linalg.lstsq and plain projections on magpylib's field |
| fits of the search | magloc's own refinement from the truth, itself checked by scipy in test_joint |
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from arrays.geometries import cube
from magloc.directions import hemisphere
from magloc.localization.fit.gauss_newton import JointFits
from magloc.localization.search.beam_search import BeamSearch, best_distinct, merge
from magloc.localization.search.candidates import (
    candidate_positions,
    distinct_best,
    linear_bases,
    linear_scores,
    modulus_scores,
    modulus_templates,
    rows_of_equal_gain,
)
from tests.magloc.localization.fit.test_gauss_newton import (
    array_of,
    drawn,
    noisy_readings,
    problem_of,
    random_sources,
    refined_from,
    scalar_cloud,
    whitened_residuals,
)

SEEDS = st.integers(0, 2**32 - 1)
CUBE = cube(2.0, noise_T=1e-10)


def everywhere(q, mu):
    """No bounds."""
    return np.ones(q.shape[:-1], dtype=bool)


def search_for(array, problem, **options):
    return BeamSearch(problem.homogeneous(candidate_positions(array)), options.pop("allowed", everywhere), **options)


def fits_of(q, mu, chi2):
    return JointFits(q, mu, chi2, np.ones(len(chi2), dtype=np.int64))


class TestLinearScores:
    """A candidate's score is the energy of the residual that its three moments explain."""

    @pytest.mark.slow_after(1)
    @pytest.mark.parametrize("kind", ["vector", "scalar in ambient", "mixed in ambient"])
    def test_against_least_squares(self, kind):
        array = array_of(kind, 1)
        rng = np.random.default_rng(1)
        p, m = random_sources(rng, 3, 1)
        # A weak source: moduli in 50 µT are linear in its moment.
        readings = noisy_readings(array, p, 1e-3 * m, rng)
        problem, y = problem_of(array, readings)
        places, _ = random_sources(rng, 40, 1)
        candidates = problem.homogeneous(places[:, 0])
        silent = np.zeros_like(problem.ambient)
        gain = problem.linear_gain(silent)
        residual = y - problem.predict(silent)
        scores = linear_scores(linear_bases(problem, gain[0], 0, candidates), residual)
        nothing = np.zeros((0, 3))
        for i in range(3):
            data = whitened_residuals(array, readings[i], nothing, nothing)
            silence = array.readings_of(array.ambient_fields)
            for j, place in enumerate(places):
                # Unit moments of 1e-6 A·m² keep the moduli linear.
                columns = [-1e6 * whitened_residuals(array, silence, place, 1e-6 * axis[None]) for axis in np.eye(3)]
                matrix = np.stack(columns, axis=-1)
                left = data - matrix @ np.linalg.lstsq(matrix, data)[0]
                explained = np.sum(data**2) - np.sum(left**2)
                assert scores[i, j] == pytest.approx(explained, rel=1e-3, abs=1e-3)

    def test_the_true_place_scores_best(self):
        rng = np.random.default_rng(2)
        p, m = random_sources(rng, 20, 1)
        problem, y = problem_of(CUBE, noisy_readings(CUBE, p, m, rng))
        scores = linear_scores(linear_bases(problem, problem.gain[0], 0, problem.homogeneous(p[:, 0])), y)
        assert (np.argmax(scores, axis=1) == np.arange(20)).all()


class TestModulusScores:
    """A pair of candidate and direction scores the energy along its reading, as projections on magpylib's moduli."""

    @pytest.mark.parametrize("kind", ["scalar", "mixed"])
    def test_against_plain_projections(self, kind):
        array = array_of(kind, 3)
        problem, y, _, _, readings, rng = drawn(array, 3, 2, 1)
        places, _ = random_sources(rng, 15, 1)
        directions = hemisphere(8)
        templates = modulus_templates(problem, 0, problem.homogeneous(places[:, 0]), directions)
        scores, best = modulus_scores(templates, y)
        nothing = np.zeros((0, 3))
        silence = array.readings_of(array.ambient_fields)
        for i in range(2):
            data = whitened_residuals(array, readings[i], nothing, nothing)
            for j, place in enumerate(places):
                rows = -np.stack([whitened_residuals(array, silence, place, axis[None]) for axis in directions])
                along = np.maximum(rows @ data / np.linalg.norm(rows, axis=1), 0.0)
                assert scores[i, j] == pytest.approx(along.max() ** 2, rel=1e-4, abs=1e-3)
                assert along[best[i, j]] == pytest.approx(along.max(), rel=1e-4, abs=1e-3)


class TestDirections:
    def test_a_hemisphere_is_covered(self):
        """24 caps of equal area would have a radius of 0.29 rad; no direction is farther than twice that."""
        directions = hemisphere(24)
        assert directions.shape == (24, 3)
        assert (directions[:, 2] > 0.0).all()
        assert_allclose(np.linalg.norm(directions, axis=1), 1.0, rtol=1e-12)
        anywhere = np.random.default_rng(0).normal(size=(2000, 3))
        anywhere /= np.linalg.norm(anywhere, axis=1, keepdims=True)
        nearest = np.abs(anywhere @ directions.T).max(axis=1)
        assert np.arccos(nearest.min()) < 0.58


class TestChoiceOfStarts:
    @given(SEEDS, st.integers(1, 8), st.floats(0.05, 1.0))
    @settings(max_examples=40, deadline=None)
    def test_apart_from_each_other_and_best_first(self, seed, n_starts, apart):
        rng = np.random.default_rng(seed)
        candidates = rng.normal(size=(60, 4))
        candidates /= np.linalg.norm(candidates, axis=1, keepdims=True)
        scores = rng.uniform(size=(3, 60))
        for row, chosen in zip(scores, distinct_best(scores, candidates, n_starts, apart), strict=True):
            assert chosen[0] == np.argmax(row)
            distinct = list(dict.fromkeys(chosen.tolist()))
            angles = np.arccos(np.clip(np.abs(candidates[distinct] @ candidates[distinct].T), 0.0, 1.0))
            assert (angles[~np.eye(len(distinct), dtype=bool)] >= apart - 1e-7).all()
            assert (np.diff(row[distinct]) <= 0.0).all()
            # Nothing better is left that is apart from all: greedy in order.
            for k, one in enumerate(distinct):
                free = (np.abs(candidates @ candidates[distinct[:k]].T) <= np.cos(apart)).all(axis=1)
                assert row[one] == row[free].max()
            # The first one stands in where none is left.
            assert set(chosen[len(distinct) :].tolist()) <= {int(chosen[0])}

    def test_rows_of_equal_gain_share_a_ranking(self):
        rng = np.random.default_rng(4)
        gain = rng.normal(size=(3, 12, 3))[[0, 1, 2, 1, 0, 2, 2]]
        groups = sorted(rows.tolist() for rows in rows_of_equal_gain(gain))
        assert groups == [[0, 4], [1, 3], [2, 5, 6]]
        together = [
            rows.tolist() for rows in rows_of_equal_gain(gain[[0, 0, 0]] * np.array([1.0, 3.0, 0.5])[:, None, None])
        ]
        assert together == [[0, 1, 2]]


class TestBeams:
    """The best fits of a row, no two of them the same."""

    q = np.random.default_rng(5).normal(size=(6, 2, 4))
    q /= np.linalg.norm(q, axis=-1, keepdims=True)
    mu = np.random.default_rng(6).normal(size=(6, 2, 3))

    def test_best_first(self):
        chi2 = np.array([5.0, 3.0, 9.0, 2.0, np.inf, 4.0])
        beam = best_distinct(fits_of(self.q, self.mu, chi2), 1, 4)
        assert beam.chi2.tolist() == [[2.0, 3.0, 4.0, 5.0]]
        assert_allclose(np.abs(beam.q[0, 0]), np.abs(self.q[3]))
        assert_allclose(beam.mu[0, 0], self.mu[3])

    def test_what_there_is_not_is_infinite(self):
        beam = best_distinct(fits_of(self.q, self.mu, np.array([1.0, *[np.inf] * 5])), 2, 2)
        assert beam.chi2.tolist() == [[1.0, np.inf], [np.inf, np.inf]]
        assert np.isnan(beam.q[:, 1]).all()

    def test_a_row_without_fit_keeps_a_start_whatever_rows_are_beside_it(self):
        chi2 = np.array([1.0, 2.0, 3.0, *[np.inf] * 3])
        together = best_distinct(fits_of(self.q, self.mu, chi2), 2, 2)
        alone = best_distinct(fits_of(self.q[3:], self.mu[3:], chi2[3:]), 1, 2)
        assert_allclose(together.rows(np.array([1])).q, alone.q)
        assert_allclose(np.abs(alone.q[0, 0]), np.abs(self.q[3]))

    def test_the_same_sources_in_another_order_or_as_minus_q_are_one_fit(self):
        q = np.stack([self.q[0], self.q[0, ::-1], -self.q[0], self.q[1]])
        mu = np.stack([self.mu[0], self.mu[0, ::-1], self.mu[0], self.mu[1]])
        beam = best_distinct(fits_of(q, mu, np.array([1.0, 1.0, 1.0, 1.0])), 1, 4)
        assert np.isfinite(beam.chi2).sum() == 2

    def test_opposite_moments_are_two_fits(self):
        q, mu = np.stack([self.q[0]] * 2), np.stack([self.mu[0], -self.mu[0]])
        assert np.isfinite(best_distinct(fits_of(q, mu, np.ones(2)), 1, 2).chi2).all()

    def test_two_beams_together(self):
        first = best_distinct(fits_of(self.q[:3], self.mu[:3], np.array([3.0, 5.0, 1.0])), 1, 3)
        second = best_distinct(fits_of(self.q[2:], self.mu[2:], np.array([1.0, 2.0, 4.0, 6.0])), 1, 3)
        assert merge(first, second).chi2.tolist() == [[1.0, 2.0, 3.0]]

    def test_rows_are_replaced_in_a_copy(self):
        beam = best_distinct(fits_of(self.q, self.mu, np.arange(6.0)), 3, 2)
        other = beam.replace(np.array([1]), beam.rows(np.array([0])))
        assert other.chi2.tolist() == [[0.0, 1.0], [0.0, 1.0], [4.0, 5.0]]
        assert beam.chi2.tolist() == [[0.0, 1.0], [2.0, 3.0], [4.0, 5.0]]


class TestFirstSource:
    """Without a start the search ends where the refinement from the truth ends, or better."""

    @pytest.mark.parametrize("kind", ["vector", "scalar", "scalar in ambient", "mixed", "mixed in ambient"])
    def test_no_worse_than_from_the_truth(self, kind):
        array = array_of(kind, 7)
        problem, y, p, m, *_ = drawn(array, 7, 20, 1)
        beam = search_for(array, problem).first_sources(problem, y)
        best = refined_from(problem, y, p, m)
        assert (beam.chi2[:, 0] < best.chi2 + 1e-3).all()

    def test_a_row_far_from_linear_does_not_change_what_the_others_find(self):
        """It begins from templates: a source a thousand times as strong, its field not small beside the ambient one."""
        array = scalar_cloud(9)
        rng = np.random.default_rng(9)
        p, m = random_sources(rng, 4, 1)
        m[2] *= 1000.0
        problem, y = problem_of(array, noisy_readings(array, p, m, rng))
        together, others = search_for(array, problem).first_sources(problem, y), np.array([0, 1, 3])
        alone = search_for(array, problem).first_sources(problem.rows(others), y[others])
        np.testing.assert_array_equal(together.chi2[others], alone.chi2)
        assert together.chi2[2, 0] < refined_from(problem, y, p, m).chi2[2] + 1e-3

    def test_moduli_without_ambient_field_come_with_both_signs(self):
        array = scalar_cloud(8, ambient_T=None)
        problem, y, *_ = drawn(array, 8, 5, 1)
        beam = search_for(array, problem).first_sources(problem, y)
        assert_allclose(beam.chi2[:, 1], beam.chi2[:, 0], rtol=1e-9)
        assert_allclose(beam.mu[:, 1], -beam.mu[:, 0], rtol=1e-9)


class TestMoreAndFewerSources:
    rng = np.random.default_rng(9)
    p, m = random_sources(rng, 12, 2, 2.2, 3.2)
    problem, y = problem_of(CUBE, noisy_readings(CUBE, p, m, rng))
    search = search_for(CUBE, problem)
    two = search.add_source(problem, y, search.first_sources(problem, y))
    best = refined_from(problem, y, p, m).chi2

    def test_a_second_source_is_found_in_what_the_first_leaves(self):
        found = self.two.chi2[:, 0] < self.best + 1e-3
        # A purely sequential start fails in some rows; the restarts are for those.
        assert found.mean() > 0.5
        beam, rng = self.two, np.random.default_rng(0)
        for _ in range(10):
            beam = self.search.restart(self.problem, self.y, beam, rng)
        assert (beam.chi2[:, 0] < self.best + 1e-3).all()

    def test_restarts_never_lose_the_best(self):
        again = self.search.restart(self.problem, self.y, self.two, np.random.default_rng(1))
        assert (again.chi2[:, 0] <= self.two.chi2[:, 0]).all()

    def test_restarts_are_those_of_their_seed(self):
        one, same = (
            self.search.restart(self.problem, self.y, self.two, np.random.default_rng(2)).chi2 for _ in range(2)
        )
        assert np.array_equal(one, same)

    def test_a_superfluous_source_is_left_out_again(self):
        p, m = self.p[:, :1], self.m[:, :1]
        readings = noisy_readings(CUBE, p, m, np.random.default_rng(3))
        problem, y = problem_of(CUBE, readings)
        one = self.search.first_sources(problem, y)
        fewer = self.search.remove_source(problem, y, self.search.add_source(problem, y, one))
        assert (fewer.chi2[:, 0] < refined_from(problem, y, p, m).chi2 + 1e-3).all()

    def test_more_sources_never_fit_worse(self):
        one = self.search.first_sources(self.problem, self.y)
        assert (self.two.chi2[:, 0] <= one.chi2[:, 0] + 1e-6).all()

    def test_only_what_is_known_to_be_possible_is_kept(self):
        def above(q, mu):
            return self.problem.position(q)[..., 2] > 0.0

        search = replace(self.search, allowed=above)
        beam = search.add_source(self.problem, self.y, search.first_sources(self.problem, self.y))
        listed = beam.q[np.isfinite(beam.chi2)]
        assert len(listed)
        assert (self.problem.position(listed)[..., 2] > 0.0).all()
