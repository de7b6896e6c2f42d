"""What is said of targets: depth intervals against fits with the depth held, and which moments could be seen."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import magpylib
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import chi2 as chi2_distribution
from scipy.stats import ncx2

import magloc
import sims
from arrays.typing import FloatArray, IntArray
from magloc.fields import dipole
from magloc.surveying.fit.joint_fit import (
    JointFit,
    SourceBounds,
    Sources,
    SurveyBackground,
    fit_jointly,
    jacobian_of,
    residual_of,
    with_free_sources,
)
from magloc.surveying.piece import Ground, Piece
from magloc.surveying.preparation import whole_rows
from magloc.surveying.reach import DEPTHS_M, least_moments
from magloc.surveying.rounds import AT_LAST, WHILE_SEARCHING, SearchState, SurveyModel
from magloc.surveying.search import PITCH, WINDOW, SearchGrid
from magloc.surveying.targets import is_misfit, profile_of, second_source_chi2, shift_by_second
from magloc.surveying.tiled import TiledSurvey
from sims.magnetics.paths import Lawnmower, Steered
from sims.magnetics.scenario import Carrier, MagneticScenario, Source

WEAK = ((-1.0, 1.0, -1.1), (0.1, 0.2, -0.3))
Fitted = tuple[SurveyModel, JointFit, SurveyBackground]
STRONG = ((3.0, -2.0, -0.6), (6.0, 5.0, -8.0))
DRAWS = 50


@cache
def plot() -> Piece:
    """A weak target 5 m from a strong one, both known."""
    whole = sims.read_scenario("survey-drone")
    assert isinstance(whole, MagneticScenario)
    assert isinstance(whole.carrier.path, Lawnmower)
    path = replace(whole.carrier.path, start_m=(-5.0, 5.0, 1.7), length_m=10.0, lines=11)
    sources = tuple(Source(Carrier(Steered(place)), moment) for place, moment in (WEAK, STRONG))
    carrier, seconds = replace(whole.carrier, path=path), (110.0 + 5.0 * np.pi) / path.speed_m_s
    scenario = replace(whole, carrier=carrier, targets=None, sources=sources, duration_s=seconds, rate_Hz=8.0)
    field = sims.simulate(scenario, rng=912)
    tiled = TiledSurvey.of(
        *whole_rows(field.array, field.readings), Ground(magloc.SourcePrior(), magloc.Terrain(), 15.0, 25.0)
    )
    place, moment = np.array([WEAK, STRONG]).transpose(1, 0, 2)
    return replace(tiled, sources=Sources(place, moment)).piece(0)


def groups(length_m: float) -> IntArray:
    """Rows within a length."""
    return plot().groups(fitted()[0].record, length_m)


@cache
def fitted() -> Fitted:
    """The two fitted where they are."""
    piece = plot()
    model = piece.model()
    return model, *model.fit(piece.known, piece.groups(model.record, AT_LAST * model.nearest_m), 1e-3)


def test_free_sources_leave_nothing_of_themselves() -> None:
    """What a source could add by moving is projected out, beside a ground that is Gaussian and not free."""
    model, fit, background = fitted()
    J = jacobian_of(model.record, background, fit.sources, fit.sources.fields(model.record))
    Q = with_free_sources(model.record, background, fit.sources)
    left = np.linalg.norm(J - Q @ (Q.T @ J), axis=0)
    assert (left < 1e-6 * np.linalg.norm(J, axis=0)).all()


def test_errors_of_sources_beside_are_projected_out() -> None:
    """Of one that other rows tell, 2.6 cm beside where it is and 5 % stronger: less is left than that is unlikely."""
    model, fit, _ = fitted()
    record = model.record
    weak, strong = (fit.sources.some(np.array([k])) for k in (0, 1))
    beside = replace(model, record=record.beside(strong.position_m, strong.moment_Am2), beside=strong)
    background = beside.background(weak, groups(AT_LAST * model.nearest_m))
    moved = Sources(strong.position_m + np.array([0.015, -0.015, 0.015]), 1.05 * strong.moment_Am2)
    change = record.predict(moved.fields(record)) - record.predict(strong.fields(record))
    wrong = background.white(change[..., None])[:, 0]
    assert wrong @ wrong > 50.0
    # A tenth of a metre and a fifth of the moment are one σ.
    unlikely = 3 * 0.15**2 + 0.25**2
    assert wrong @ (wrong - background.Q @ (background.Q.T @ wrong)) < 1.2 * unlikely


def test_at_its_ends_a_depth_interval_costs_what_chance_does() -> None:
    """χ² of nonlinear joint fits by SciPy, the depth held, is larger by 3.84 there, within the steps of the profile."""
    model, fit, background = fitted()
    square, V = np.linalg.eigh(background.Q.T @ background.Q)
    kept = background.Q @ V * ((1.0 - np.sqrt(1.0 - square)) / square)  # a root of 1 - QQᵀ is 1 - kept (QV)ᵀ

    def residual(free: FloatArray, depth_m: float) -> FloatArray:
        parameters = np.insert(free, 2, -depth_m).reshape(2, 6)
        fields = Sources(parameters[:, :3], parameters[:, 3:]).fields(model.record)
        r = residual_of(model.record, background, fields)
        return np.asarray(r - kept @ ((background.Q @ V).T @ r))

    found = np.concatenate([fit.sources.position_m, fit.sources.moment_Am2], axis=1)
    assert np.sum(residual(np.delete(found, 2), -found[0, 2]) ** 2) == pytest.approx(fit.cost)
    for depth in profile_of(model, fit, background, 0).depth_interval95_m:
        there = least_squares(residual, np.delete(found, 2), x_scale="jac", args=(depth,))
        assert 2.0 * there.cost - fit.cost == pytest.approx(3.84, abs=0.5)


class TestMisfit:
    """Of 300 groups of a lawnmower's passes, two channels each."""

    AT = np.concatenate([np.arange(first, first + 20) for first in range(0, 1500, 100)])

    @staticmethod
    def lasting(rng: np.random.Generator, correlation: float) -> FloatArray:
        """Unit variance; successive ones correlated."""
        left = rng.standard_normal((1500, 2))
        for i in range(1, len(left)):
            left[i] = correlation * left[i - 1] + np.sqrt(1.0 - correlation**2) * left[i]
        return left

    def test_white_residuals_are_none(self) -> None:
        """Two tests of 1 in 10,000: four or more of 2,000 have a probability of 1 in 1,200."""
        rng = np.random.default_rng(5)
        assert sum(is_misfit(rng.standard_normal((1500, 2)), self.AT) for _ in range(2000)) < 4

    def test_residuals_that_last_are(self) -> None:
        """As large as they should be, and alike from group to group: 0.3 is 7 standard deviations."""
        rng = np.random.default_rng(6)
        assert all(is_misfit(self.lasting(rng, 0.3), self.AT) for _ in range(20))

    def test_noise_that_is_understated_is(self) -> None:
        assert is_misfit(1.5 * np.random.default_rng(7).standard_normal((1500, 2)), self.AT)

    def test_passes_that_do_not_follow_each_other_are_not_compared(self) -> None:
        """Groups that are alike, each in another pass."""
        assert not is_misfit(np.ones((1500, 2)), np.arange(0, 1500, 100))


def test_where_places_are_gaussian_their_scatter_is_the_covariance() -> None:
    """That of a strong source, whose likelihood is Gaussian."""
    model, fit, background = fitted()
    scatter = profile_of(model, fit, background, 1).scatter_m2
    np.testing.assert_allclose(scatter, fit.covariance[6:8, 6:8], atol=0.15 * scatter.max())


class TestSearchedAgain:
    """Only where sources have changed more than noise hides."""

    @staticmethod
    def searched() -> tuple[SearchState, Sources, SurveyBackground]:
        model, fit, _ = fitted()
        grid = SearchGrid.of(model.bounds.low_m, model.bounds.high_m, model.record.height_m, [1.0])
        background = model.background(fit.sources, groups(WHILE_SEARCHING * model.nearest_m))
        return SearchState.empty(model, groups, grid), fit.sources, background

    def test_nowhere_where_nothing_has(self) -> None:
        searched, sources, background = self.searched()
        first = searched.update(sources, background)
        assert (searched.of == 0).all()
        again = searched.update(sources.apply_step(np.full((2, 6), 1e-6)), background)
        assert (searched.of == 0).all()
        np.testing.assert_array_equal(again.chi2, first.chi2)

    def test_as_from_the_start_beside_a_new_one(self) -> None:
        """In a corner: 0.02 A·m² that nobody feels in the other."""
        searched, sources, background = self.searched()
        searched.update(sources, background)
        more = sources.with_more(Sources(np.array([[4.5, 4.5, -0.2]]), np.array([[0.0, 0.0, 0.02]])))
        found = searched.update(more, background)
        anew, *_ = self.searched()
        whole = anew.update(more, background)
        new = np.repeat(searched.of == 1, [len(places) for _, places in searched.grid.tiles])
        assert 0 < new.sum() < len(new)
        np.testing.assert_array_equal(found.chi2[new], whole.chi2[new])
        np.testing.assert_allclose(found.chi2[~new], whole.chi2[~new], atol=1.0)


def test_the_least_moment_is_seen_with_95_percent() -> None:
    """Its χ², as of a source of a joint fit, has the tail that is promised in the worst of 300 directions."""
    model, fit, background = fitted()
    low, high = model.bounds.low_m[:2] + 1.0, model.bounds.high_m[:2] - 1.0
    places, moments = least_moments(model, fit.sources, groups, low, high)
    assert sorted(set((-places[:, 2]).round(6))) == list(DEPTHS_M)
    directions = np.random.default_rng(1).normal(size=(300, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    everywhere = SourceBounds(np.full(3, -np.inf), np.full(3, np.inf))
    for at in np.linspace(0, len(places) - 1, 5).astype(int):
        with_one = fit.sources.with_more(Sources(places[[at]], moments[at] * directions[:1]))
        there = fit_jointly(model.record, background, with_one, everywhere, most=0)
        own, others = np.arange(15, 18), np.arange(12)
        cross = there.information[np.ix_(others, own)]
        known = np.linalg.solve(there.information[np.ix_(others, others)], cross)
        left = there.information[np.ix_(own, own)] - cross.T @ known
        chi2 = moments[at] ** 2 * np.einsum("ki,ij,kj->k", directions, left, directions).min()
        # More than promised, as a search looks at near rows only, but not by much.
        assert 0.949 < ncx2(3, chi2).sf(model.threshold) < 0.99


def test_no_place_where_no_row_is_near() -> None:
    """Of a rectangle that goes on for 300 m: places beside the rows, where little is seen, and none far from them."""
    model, fit, _ = fitted()
    far = replace(model, bounds=SourceBounds(model.bounds.low_m, model.bounds.high_m + 300.0 * np.eye(3)[0]))
    low, high = far.bounds.low_m[:2], far.bounds.high_m[:2]
    places, moments = least_moments(far, fit.sources, groups, low, high)
    beside_m = places[:, 0] - model.bounds.high_m[0]
    deepest = model.record.height_m + DEPTHS_M[-1]
    assert 5.0 < beside_m.max() < (WINDOW + 8.0 / PITCH) * deepest  # squares of 8 by 8 places are searched at once
    assert np.isfinite(moments).all()
    assert np.median(moments[beside_m > 5.0]) > 10.0 * np.median(moments[beside_m < 0.0])
    assert not least_moments(model, fit.sources, groups, high, high + 20.0)[0].size  # beside all sources


def plot_of(seen: Callable[[FloatArray], FloatArray], start: Sources, body_length_m: float = 0.0) -> Fitted:
    """A source fitted to what fields (n, N, 3) at the sensors of a small plot look like, without noise."""
    model, _, _ = fitted()
    values = model.record.predict(seen(model.record.sensors_m))
    model = replace(model, record=replace(model.record, values_T=values), body_length_m=body_length_m)
    group = np.arange(len(model.record)) // 2
    background = model.background(start, group)
    return model, fit_jointly(model.record, background, start, model.bounds), background


class TestSecondSource:
    """Two dipoles near each other are one, a quadrupole and an octupole."""

    @staticmethod
    def chi2s(gap_m: float) -> tuple[float, float]:
        """What the test says and what one dipole leaves of two that are some way apart."""
        place, moment = np.array([[0.3, -0.2, -0.8]]), np.array([[6.0, -4.0, 9.0]])
        places, moments = place + np.array([[0.5], [-0.5]]) * gap_m * np.eye(3)[:1], moment * [[0.6], [0.4]]
        model, fit, background = plot_of(
            lambda sensors: dipole.total_field(sensors, places, moments), Sources(place, moment)
        )
        directions = model.record.directions(fit.sources.fields(model.record))
        Q = with_free_sources(model.record, background, fit.sources)
        left = fit.residual - Q @ (Q.T @ fit.residual)
        return second_source_chi2(model, background, directions, Q, left, fit.sources.position_m[0]), fit.cost

    @pytest.mark.parametrize("gap_m", [0.3, 0.6])
    def test_explains_what_one_dipole_leaves(self, gap_m: float) -> None:
        explained, left = self.chi2s(gap_m)
        assert 0.9 * left < explained < 1.02 * left
        assert left > 1.0

    @pytest.mark.parametrize("beside", [(0.9, 0.3, 0.1), (-0.5, 0.8, -0.3)])
    def test_it_moves_the_first_one(self, beside: tuple[float, float, float]) -> None:
        """By about as much as one dipole in place of two errs, which its covariance without noise does not tell."""
        place, moment = np.array([0.3, -0.2, -0.8]), np.array([6.0, -4.0, 9.0])
        places, moments = np.array([place, place + beside]), np.array([moment, 0.06 * moment[::-1]])
        model, fit, background = plot_of(
            lambda sensors: dipole.total_field(sensors, places, moments), Sources(place[None], moment[None])
        )
        Q = with_free_sources(model.record, background, fit.sources)
        moved = shift_by_second(model, fit, background, Q, fit.residual - Q @ (Q.T @ fit.residual), 0)
        wrong = np.linalg.norm(fit.sources.position_m[0] - place)
        assert 0.3 * wrong < np.linalg.norm(moved[:3]) < 3.0 * wrong

    @pytest.mark.parametrize("body_length_m", [0.0, 0.7])
    def test_of_noise_it_is_chi_square(self, body_length_m: float) -> None:
        """Noise as the model has it, ground and bodies included; of right ones 1 in 1000 sums is beyond the limits."""
        model, fit, _ = fitted()
        model, source = replace(model, body_length_m=body_length_m), fit.sources.some(np.array([1]))
        background = model.background(source, groups(AT_LAST * model.nearest_m))
        U, size, _ = np.linalg.svd(background.Q, full_matrices=False)
        noise = np.random.default_rng(5).normal(size=(DRAWS, len(U)))
        noise += (noise @ U * (1.0 / np.sqrt(1.0 - size**2) - 1.0)) @ U.T  # of covariance (1 - QQᵀ)⁻¹
        directions = model.record.directions(source.fields(model.record))
        Q = with_free_sources(model.record, background, source)
        place = source.position_m[0]
        chi2 = [second_source_chi2(model, background, directions, Q, r - Q @ (Q.T @ r), place) for r in noise]
        low, high = chi2_distribution(9 * DRAWS).interval(0.999)
        assert low < np.sum(chi2) < high

    def test_one_dipole_leaves_nothing(self) -> None:
        explained, left = self.chi2s(0.0)
        assert explained < 1e-6
        assert left < 1e-6


class TestBodies:
    """A bar that is long against its distance, its field magpylib's."""

    LENGTH_M = 0.7
    PLACE, MOMENT = np.array([0.3, -0.2, -0.5]), np.array([20.0, 0.0, -10.0])

    def error2(self, body_length_m: float) -> float:
        """Square of the position's error in its own covariance."""
        size = np.array([self.LENGTH_M, 0.1, 0.1])
        polarization = 4e-7 * np.pi * self.MOMENT / size.prod()
        bar = magpylib.magnet.Cuboid(polarization=polarization, dimension=size, position=self.PLACE)
        start = Sources(self.PLACE[None], self.MOMENT[None])
        _, fit, _ = plot_of(
            lambda sensors: bar.getB(sensors.reshape(-1, 3)).reshape(sensors.shape), start, body_length_m
        )
        error = fit.sources.position_m[0] - self.PLACE
        return float(error @ np.linalg.solve(fit.covariance[:3, :3], error))

    def test_its_length_covers_its_error(self) -> None:
        """Without noise a right model errs by less than one σ, a point's by more than noise and pose allow."""
        assert self.error2(self.LENGTH_M) < 1.0
        assert self.error2(0.0) > 5.0 * self.error2(self.LENGTH_M)
