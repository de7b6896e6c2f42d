"""What a row of readings says of the range, and how true it is: sets, weights, covariances.

| what | who checks it |
|---|---|
| set of ranges | χ² of the readable twin, over all directions of a sphere and by scipy from the best of them |
| rise for weak signals | the likelihood of detected readings, maximised over the strength by scipy |
| rise for several solutions | scipy's χ² distribution |
| coverage, claims, weights, NEES | the truth of random problems, with binomial and χ² bounds |
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
import scipy.optimize
import scipy.stats
from numpy.testing import assert_allclose
from numpy.typing import NDArray

from arrays.array import SensorArray
from arrays.geometries import square, tetrahedron
from arrays.sensor import Sensor
from arrays.whitening import whitening
from magloc.directions import fibonacci_directions
from magloc.levels import DELTA_CHI2_95
from magloc.localization.fit.gauss_newton import JointFits, damped_gauss_newton, refine
from magloc.localization.fit.results import (
    EVERYWHERE,
    Fix,
    Intervals,
    Solution,
    Source,
    intervals_of,
    is_observable_set,
)
from magloc.localization.uncertainty import range_profile
from magloc.localization.uncertainty.ambiguity import weights
from magloc.localization.uncertainty.range_interval import (
    gaussian_ranges,
    is_detected,
    levels,
    ranges_of,
    rise,
    union,
)
from magloc.measurement.differences import DifferenceMeasurement, predicted_channels
from magloc.measurement.rows import whitened_rows
from magloc.measurement.whitened import WhitenedModel
from magloc.tracking.motion import RandomWalk
from magloc.tracking.results import TrackPoint
from magloc.tracking.rows import Row
from magloc.tracking.tracker import Tracker
from tests import oracles
from tests.passing_source import ARRAY, MOMENT, POSITION, followed, readings_of
from tests.plain_locator import plain_locator, random_sources
from tests.variable_projection import projected_chi2

FloatArray = NDArray[np.float64]
TETRAHEDRON = tetrahedron(1.5, noise_T=1e-9)
FALSE_ALARM = 1e-3


def irregular(n: int, seed: int) -> SensorArray:
    """Vector sensors anywhere in a cube of 2 m."""
    places = np.random.default_rng(seed).uniform(-1.0, 1.0, (n, 3))
    return SensorArray(
        tuple(Sensor(id=f"s{i}", kind="vector", position_m=p, noise_T=1e-9) for i, p in enumerate(places))
    )


def scalar_array(ambient_T: tuple[float, float, float] | None = None) -> SensorArray:
    """Nine scalar sensors anywhere in a cube of 2 m."""
    sensors = (Sensor(id=s.id, kind="scalar", position_m=s.position_m, noise_T=1e-9) for s in irregular(9, 4).sensors)
    return SensorArray(tuple(sensors), ambient_T=ambient_T)


# Arrays, and from where to where their sources are: from clearly observable to hopeless.
CASES = {
    "tetrahedron 1.5 m": (TETRAHEDRON, 1.5, 30.0),
    "tetrahedron 0.5 m": (tetrahedron(0.5, noise_T=1e-9), 0.6, 20.0),
    "six irregular": (irregular(6, 3), 2.0, 30.0),
    "seven irregular": (irregular(7, 5), 2.0, 30.0),
    "square 1 m": (square(1.0, noise_T=1e-9), 1.2, 20.0),
}


@dataclass(frozen=True, eq=False)
class Problems:
    """Random sources of 300 A·m², ranges uniform, and their fixes."""

    array: SensorArray
    position_m: FloatArray
    moment_Am2: FloatArray
    readings_T: FloatArray
    fixes: list[Fix]

    @classmethod
    def of(cls, case: str, n: int, seed: int) -> Problems:
        return cls.around(*CASES[case], n, seed)

    @classmethod
    def around(cls, array: SensorArray, nearest: float, farthest: float, n: int, seed: int) -> Problems:
        rng = np.random.default_rng(seed)
        offset, moment = random_sources(rng, n, nearest, farthest)
        position = array.centroid + offset
        clean = predicted_channels(array, position, moment)
        readings = clean + rng.normal(size=clean.shape) * array.channel_noise_T
        return cls(array, position, moment, readings, plain_locator(array).fit_rows(readings))

    @property
    def ranges_m(self) -> FloatArray:
        return np.linalg.norm(self.position_m - self.array.centroid, axis=1)

    @property
    def detected(self) -> NDArray[np.bool_]:
        """By their own count of the energy, against scipy's quantile."""
        white = whitening(self.array)
        energy = np.array([np.sum(white.apply(row) ** 2) for row in self.readings_T])
        return np.asarray(energy > scipy.stats.chi2.isf(FALSE_ALARM, white.n_differences))

    @property
    def claimed(self) -> NDArray[np.bool_]:
        return np.array([bool(fix.solutions) and fix.solutions[0].range_observable for fix in self.fixes])

    @property
    def covered(self) -> NDArray[np.bool_]:
        sets = [fix.solutions[0].range_interval_m if fix.solutions else () for fix in self.fixes]
        return np.array([holds(intervals, r) for intervals, r in zip(sets, self.ranges_m, strict=True)])


def holds(intervals: Intervals, range_m: float) -> bool:
    return any(low <= range_m and (high is None or range_m <= high) for low, high in intervals)


def ends_of(told: Solution | TrackPoint) -> list[float]:
    return [np.inf if end is None else end for pair in told.range_interval_m or () for end in pair]


class Sphere:
    """Least χ² of sources at one range, of all directions."""

    def __init__(self, array: SensorArray, n_directions: int = 250) -> None:
        self.whitening = whitening(array)
        self.problem = WhitenedModel.of(array, self.whitening, array.ambient_fields[None])
        self.directions = fibonacci_directions(n_directions)

    def chi2(self, readings_T: FloatArray, range_m: float) -> float:
        y = self.whitening.apply(readings_T)

        def of(direction: FloatArray) -> FloatArray:
            return projected_chi2(
                self.problem, self.problem.homogeneous(self.problem.centroid + range_m * direction), y
            )

        def of_angles(angles: FloatArray) -> float:
            theta, phi = angles
            u = np.array([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])
            return float(of(u))

        coarse = of(self.directions)
        best = np.inf
        for start in self.directions[self._apart(coarse)]:
            angles = [np.arccos(start[2]), np.arctan2(start[1], start[0])]
            found = scipy.optimize.minimize(of_angles, angles, method="Nelder-Mead", options={"fatol": 1e-3})
            best = min(best, found.fun)
        return float(best)

    def _apart(self, chi2: FloatArray) -> list[int]:
        """The best directions, half a radian apart."""
        left, chosen = chi2.copy(), []
        for _ in range(3):
            chosen.append(int(np.argmin(left)))
            left[self.directions @ self.directions[chosen[-1]] > np.cos(0.5)] = np.inf
        return chosen


def expected_rise(fix: Fix, readings_T: FloatArray, array: SensorArray) -> float:
    """The rise of a row's set, from its listed solutions."""
    white = whitening(array)
    energy, chi2 = np.sum(white.apply(readings_T) ** 2), np.array([[s.chi2 for s in fix.solutions]])
    level = levels(chi2, np.array([[s.weight for s in fix.solutions]]))
    return float(rise(energy, chi2[0, 0], white.n_differences, level[0]))


def binomial_bounds(n: int, low: float, high: float) -> tuple[float, float]:
    """Bounds of a share that is between low and high, exceeded with a probability of 1e-4 a side at most."""
    return scipy.stats.binom.ppf(1e-4, n, low) / n, scipy.stats.binom.isf(1e-4, n, high) / n


class TestCoverage:
    """The 95 % set of ranges holds the truth in 93 to 97 % of the detected rows."""

    def check(self, problems: Problems) -> tuple[float, float]:
        """Everything that holds at any size; share of the detected rows that are covered, and of false claims."""
        detected, claimed, covered = problems.detected, problems.claimed, problems.covered
        assert [fix.detected for fix in problems.fixes] == detected.tolist()
        assert not (claimed & ~detected).any()
        for fix, seen in zip(problems.fixes, detected, strict=True):
            for solution in fix.solutions:
                assert solution.range_observable == is_observable_set(solution.range_interval_m)
                if not seen:
                    assert solution.range_interval_m == EVERYWHERE
        # Outside the 99.7 % set there are only rows outside the 95 % set.
        sphere, false = Sphere(problems.array), 0
        for i in np.flatnonzero(claimed & ~covered):
            at_truth = sphere.chi2(problems.readings_T[i], problems.ranges_m[i])
            false += at_truth - problems.fixes[i].solutions[0].chi2 > 9.0
        return float(covered[detected].mean()), false / int(claimed.sum())

    @pytest.mark.parametrize(("case", "seed"), [("tetrahedron 1.5 m", 1), ("seven irregular", 2)])
    def test_quick(self, case: str, seed: int) -> None:
        """700 rows; two-sided false-alarm rate 2e-4 of the coverage, and 1e-4 of the claims."""
        problems = Problems.of(case, 700, seed)
        coverage, false_claims = self.check(problems)
        low, high = binomial_bounds(int(problems.detected.sum()), 0.93, 0.97)
        assert low <= coverage <= high
        n_claims = int(problems.claimed.sum())
        assert n_claims > 100
        assert false_claims <= scipy.stats.binom.isf(1e-4, n_claims, 0.005) / n_claims

    @pytest.mark.slow
    @pytest.mark.parametrize("case", CASES)
    def test_of_ten_thousand(self, case: str) -> None:
        """The figures as they are asked for, of 10,000 rows."""
        problems = Problems.of(case, 10_000, 3)
        coverage, false_claims = self.check(problems)
        assert 0.93 <= coverage <= 0.97
        assert false_claims <= 0.005


class TestUndetected:
    """Noise alone: seldom detected, and then every range is possible."""

    def test_noise_is_detected_once_in_a_thousand(self) -> None:
        """4,000 rows; false-alarm rate 2e-4."""
        readings = 1e-9 * np.random.default_rng(1).normal(size=(4000, 12))
        fixes = plain_locator(TETRAHEDRON).fit_rows(readings)
        n = sum(fix.detected for fix in fixes)
        assert scipy.stats.binom.ppf(1e-4, 4000, FALSE_ALARM) <= n <= scipy.stats.binom.isf(1e-4, 4000, FALSE_ALARM)
        for fix in fixes:
            if not fix.detected:
                assert all(s.range_interval_m == EVERYWHERE for s in fix.solutions)
                assert not any(s.range_observable or s.gaussian for s in fix.solutions)

    def test_readings_without_any_difference(self) -> None:
        assert not plain_locator(TETRAHEDRON).fit(np.full(12, 5e-5)).detected

    def test_several_sources_and_moduli_say_so_too(self) -> None:
        rng = np.random.default_rng(2)
        array = irregular(6, 3)
        (joint,) = plain_locator(array, sources=2).fit_rows(1e-9 * rng.normal(size=(1, 18)))
        assert not joint.detected
        assert all(s.range_interval_m == EVERYWHERE for solution in joint.solutions for s in solution.sources)
        ambient = (2e-5, 0.0, 4.5e-5)
        scalar = scalar_array(ambient)
        readings = float(np.linalg.norm(ambient)) + 1e-9 * rng.normal(size=(3, 9))
        fixes = plain_locator(scalar).fit_rows(readings)
        assert not any(fix.detected for fix in fixes)
        assert all(s.range_interval_m == EVERYWHERE for fix in fixes for s in fix.solutions)

    def test_a_known_place_stays_known(self) -> None:
        (fix,) = plain_locator(TETRAHEDRON, position_m=[3.0, 0.0, 0.0]).fit_rows(
            1e-9 * np.random.default_rng(3).normal(size=(1, 12))
        )
        assert not fix.detected
        assert fix.solutions[0].range_observable


class TestSetOfRanges:
    """It is where the least χ² at a range, whatever the direction, is within the rise of the least of all."""

    @pytest.mark.slow_after(1)
    @pytest.mark.parametrize("case", ["tetrahedron 1.5 m", "seven irregular"])
    def test_against_all_directions(self, case: str) -> None:
        problems, sphere = Problems.of(case, 120, 4), Sphere(CASES[case][0])
        rng, n_compared, n_several = np.random.default_rng(5), 0, 0
        weak = [i for i in np.flatnonzero(problems.detected) if not problems.fixes[i].solutions[0].gaussian]
        for i in weak[:9]:
            best = problems.fixes[i].solutions[0]
            allowed = expected_rise(problems.fixes[i], problems.readings_T[i], problems.array)
            n_several += len(best.range_interval_m) > 1 or len(problems.fixes[i].solutions) > 1
            for range_m in np.exp(rng.uniform(np.log(0.5), np.log(80.0), 5)):
                risen = sphere.chi2(problems.readings_T[i], range_m) - best.chi2
                if abs(risen - allowed) > 0.1:
                    assert (risen < allowed) == holds(best.range_interval_m, range_m)
                    n_compared += 1
        assert n_compared > 30
        assert n_several > 2

    def test_far_sources_are_one_sided(self) -> None:
        """As strong as they are: the array is too small to tell their range."""
        rng = np.random.default_rng(6)
        p = np.array([25.0, 5.0, -10.0])
        readings = predicted_channels(TETRAHEDRON, p, [2e4, 5e3, 1.5e4]) + 1e-9 * rng.normal(size=(20, 12))
        ends = []
        for fix in plain_locator(TETRAHEDRON).fit_rows(readings):
            assert fix.detected
            assert not fix.solutions[0].range_observable
            ends.append((fix.solutions[0].range_interval_m[0][0], fix.solutions[0].range_interval_m[-1][1]))
        assert all(low > 1.0 for low, _ in ends)
        assert sum(high is None for _, high in ends) >= 10

    def test_both_sides_of_infinity_count(self) -> None:
        near, far, other_side = 1.0 / np.tan(0.3), 1.0 / np.tan(0.1), 1.0 / np.tan(0.4)
        ends = ranges_of(np.array([[0.1, 0.3], [-0.2, 0.3], [-0.4, 0.3]]))
        assert_allclose(ends, [[near, far], [near, np.inf], [other_side, np.inf]])
        right_angle = 0.5 * np.pi
        ends = ranges_of(np.array([[0.3, right_angle], [-right_angle, 0.1]]), 2.0)
        assert_allclose(ends, [[0.0, 2.0 * near], [0.0, np.inf]])

    def test_intervals_that_overlap_become_one(self) -> None:
        pairs = np.array([[[3.0, 5.0], [1.0, 2.0], [np.nan, np.nan], [4.0, np.inf]], np.full((4, 2), np.nan)])
        merged = union(pairs)
        assert [intervals_of(of_row) for of_row in merged] == [((1.0, 2.0), (3.0, None)), ()]
        assert is_observable_set(((3.0, 4.0), (5.0, 6.0)))
        assert not is_observable_set(((3.0, 4.0), (5.0, 6.1)))
        assert not is_observable_set(((3.0, None),))
        assert not is_observable_set(EVERYWHERE)

    @pytest.mark.parametrize("seed", [7, 8])
    def test_does_not_depend_on_the_frame_nor_on_the_order(self, seed: int) -> None:
        problems = Problems.of("seven irregular", 40, seed)
        rng = np.random.default_rng(seed)
        R = np.linalg.qr(rng.normal(size=(3, 3))).Q
        R *= np.linalg.det(R)
        order = rng.permutation(7)
        turned = SensorArray(
            tuple(replace(problems.array.sensors[i], position_m=R @ problems.array.positions[i]) for i in order)
        )
        readings = (problems.readings_T.reshape(40, 7, 3)[:, order] @ R.T).reshape(40, 21)
        # Candidates stand along other directions of the turned array: rarely one more or less of the worst is found.
        same = 0
        for one, other in zip(problems.fixes, plain_locator(turned).fit_rows(readings), strict=True):
            assert one.detected == other.detected
            a, b = one.solutions[0], other.solutions[0]
            chi2 = [[s.chi2 for s in fix.solutions] for fix in (one, other)]
            if len(chi2[0]) == len(chi2[1]) and np.allclose(chi2[0], chi2[1], atol=1e-3):
                same += 1
                assert_allclose(b.position_m, R @ a.position_m, rtol=1e-3, atol=1e-3 * np.linalg.norm(a.position_m))
                assert len(a.range_interval_m) == len(b.range_interval_m)
                ends = [[np.inf if end is None else end for pair in s.range_interval_m for end in pair] for s in (a, b)]
                assert_allclose(ends[0], ends[1], rtol=0.01)
                assert [s.weight for s in other.solutions] == pytest.approx([s.weight for s in one.solutions], abs=0.01)
        assert same > 30


class TestRise:
    """3.84 for a strong signal with one solution, more for weak ones and for several."""

    def test_strong_signals(self) -> None:
        assert_allclose(rise([1e3, 1e5, 1e9], [5.0, 5.0, 5.0], 9), DELTA_CHI2_95)

    def test_nothing_detected(self) -> None:
        assert np.isinf(rise([20.0], [5.0], 9)).all()

    @pytest.mark.parametrize(
        ("energy", "chi2", "k"), [(28.5, 4.0, 9), (31.0, 2.0, 9), (45.0, 6.0, 9), (60.0, 12.0, 15)]
    )
    def test_against_the_likelihood_of_detected_readings(self, energy: float, chi2: float, k: int) -> None:
        """-2 log L of the best strength, by scipy, is 3.84 higher where χ² is higher by the rise."""
        threshold = scipy.stats.chi2.isf(FALSE_ALARM, k)

        def best(chi2: float) -> float:
            explained = energy - chi2

            def cost(strength: float) -> float:
                seen = scipy.stats.ncx2.logsf(threshold, k, strength**2)
                return chi2 + float((np.sqrt(explained) - strength) ** 2 + 2.0 * seen)

            trials = np.linspace(1e-3, 1.2 * np.sqrt(explained), 60)
            start = int(np.argmin([cost(t) for t in trials]))
            bounds = trials[max(start - 1, 0)], trials[min(start + 1, 59)]
            return float(scipy.optimize.minimize_scalar(cost, bounds=bounds, method="bounded").fun)

        raised = float(rise(energy, chi2, k))
        assert raised > DELTA_CHI2_95
        assert best(chi2 + raised) - best(chi2) == pytest.approx(DELTA_CHI2_95, abs=0.01)

    def test_several_solutions_leave_a_twentieth_outside(self) -> None:
        rng = np.random.default_rng(9)
        above = np.sort(rng.uniform(0.0, 12.0, (30, 4)), axis=1)
        above[:, 0] = 0.0
        weight = rng.dirichlet(np.ones(4), 30)
        c = levels(5.0 + above, weight)
        outside = np.sum(weight * scipy.stats.chi2.sf(c[:, None] - above, 1), axis=1)
        assert_allclose(outside, 0.05, rtol=1e-4)
        assert levels(np.array([[3.0, np.inf]]), np.array([[1.0, 0.0]]))[0] == DELTA_CHI2_95
        assert levels(np.array([[3.0, 3.0]]), np.array([[0.5, 0.5]]))[0] == pytest.approx(DELTA_CHI2_95, abs=1e-5)


class TestProfileOfModuli:
    """Points of the profile of moduli are refined in lanes: its ends are those of the readable damped steps."""

    N = 60

    def stretches(self, rise: float) -> FloatArray:
        """Of the best fits of sources at 1.5 to 8 m, from clearly observable to hopeless."""
        array, rng = scalar_array((2e-5, 1e-6, 4e-5)), np.random.default_rng(11)
        offset, moment = random_sources(rng, self.N, 1.5, 8.0, 100.0)
        readings = predicted_channels(array, array.centroid + offset, moment) + rng.normal(0.0, 1e-9, (self.N, 9))
        (rows,) = whitened_rows(array, readings, None, self.N)
        (optima,) = plain_locator(array)._search.optima(rows)
        solved, best = np.unique(optima.of_row, return_index=True)
        return range_profile.profile_stretches(
            rows.model.rows(solved),
            rows.y[solved],
            optima.fits.rows(best),
            0,
            np.full(len(solved), np.nan),
            np.full(len(solved), rise),
        )

    def test_points_are_as_low_as_those_of_damped_steps(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Valleys are curved: either may stand in another one, the readable twin more often."""
        ours, twin = [], []

        def both(*start: Any, **options: Any) -> JointFits:
            found = refine(*start, **options)
            ours.append(found.chi2)
            twin.append(damped_gauss_newton(*start, **options).chi2)
            return found

        monkeypatch.setattr(range_profile, "refine", both)
        self.stretches(DELTA_CHI2_95)
        above = np.concatenate(ours) - np.concatenate(twin)
        assert len(above) > 500
        assert np.mean(above <= 1e-3) >= 0.97
        assert np.sum(above > 1e-3) <= np.sum(above < -1e-3)

    def test_no_end_where_nothing_rises_so_much(self) -> None:
        assert_allclose(self.stretches(1e12), np.tile([-0.5 * np.pi, 0.5 * np.pi], (self.N, 1)))


class TestWeights:
    """They add up to one, and a solution is the true one about as often as its weight says."""

    def test_add_up_to_one(self) -> None:
        for fix in Problems.of("tetrahedron 1.5 m", 200, 10).fixes:
            assert sum(s.weight for s in fix.solutions) == pytest.approx(1.0)
            assert all(0.0 <= s.weight <= 1.0 for s in fix.solutions)

    def test_opposite_moments_of_moduli_are_equally_likely(self) -> None:
        scalar = scalar_array()
        p, m = np.array([3.0, 1.0, 2.0]), np.array([4000.0, 2000.0, 1000.0])
        (fix,) = plain_locator(scalar).fit_rows(predicted_channels(scalar, p, m)[None])
        assert len(fix.solutions) == 2
        assert [s.weight for s in fix.solutions] == pytest.approx([0.5, 0.5], rel=1e-6)
        moments = plain_locator(scalar, position_m=p).fit_rows(predicted_channels(scalar, p, m)[None])[0]
        assert sum(s.weight for s in moments.solutions) == pytest.approx(1.0)
        assert moments.solutions[0].weight == pytest.approx(moments.solutions[1].weight, rel=1e-6)

    def test_several_sources(self) -> None:
        array = irregular(9, 6)
        p = np.array([[4.0, 1.0, 0.0], [-2.0, 3.0, 4.0]])
        readings = predicted_channels(array, p, np.full((2, 3), 3000.0)).sum(axis=0)
        (fix,) = plain_locator(array, sources=2).fit_rows(readings[None])
        assert fix.detected
        assert sum(s.weight for s in fix.solutions) == pytest.approx(1.0)
        assert all(source.range_observable and source.gaussian for source in fix.solutions[0].sources)

    def test_formula(self) -> None:
        expected = np.array([1.0, 2.0 * np.exp(-0.5), 0.0])
        assert_allclose(weights([3.0, 4.0, np.inf], np.log([1.0, 2.0, 5.0])), expected / expected.sum())

    @pytest.mark.slow
    @pytest.mark.parametrize("case", ["tetrahedron 1.5 m", "seven irregular", "square 1 m"])
    def test_reliability(self, case: str) -> None:
        """Where χ² is nearly a parabola (σ of the range below 0.3 of it) to 0.08, else to 0.15, and three deviations.

        Far and weak sources have solutions near the sensors that only somebody who knows that the source is large
        would leave out: there the best solution is claimed too often.
        """
        problems = Problems.of(case, 5_000, 11)
        claimed, true, sigma = [], [], []
        for i in np.flatnonzero(problems.detected).tolist():
            fix = problems.fixes[i]
            is_true = own_solution(problems, i) if len(fix.solutions) > 1 else None
            if is_true is not None:
                claimed += [s.weight for s in fix.solutions]
                true += [j == is_true for j in range(len(fix.solutions))]
                sigma += [range_sigma(problems, i)] * len(fix.solutions)
        values, of_sigma = np.array([claimed, true]), np.array(sigma)
        bins = np.digitize(claimed, [0.02, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.98])
        for largest, allowed in ((0.3, 0.08), (np.inf, 0.15)):
            parts = [values[:, (bins == k) & (of_sigma <= largest)] for k in range(12)]
            for said, share, n in ((*part.mean(axis=1), part.shape[1]) for part in parts if part.shape[1] > 30):
                assert abs(share - said) < allowed + 3.0 * np.sqrt(said * (1.0 - said) / n)


def range_sigma(problems: Problems, i: int) -> float:
    """σ of the range over the range by the information at the best solution."""
    best = problems.fixes[i].solutions[0]
    information = oracles.fisher_information(DifferenceMeasurement.of(problems.array), best.position_m, best.moment_Am2)
    unit = np.repeat([np.linalg.norm(v) for v in (best.position_m - problems.array.centroid, best.moment_Am2)], 3)
    covariance = np.linalg.inv(information * np.outer(unit, unit))
    along = (best.position_m - problems.array.centroid) / unit[0]
    return float(np.sqrt(along @ covariance[:3, :3] @ along))


def own_solution(problems: Problems, i: int) -> int | None:
    """The solution that descent from the truth leads to; None if that is not listed."""
    measurement = DifferenceMeasurement.of(problems.array)
    z, sigma = measurement.measured(problems.readings_T[i]), np.sqrt(measurement.variance)
    unit = np.repeat([problems.ranges_m[i], 300.0], 3)
    truth = np.concatenate([problems.position_m[i], problems.moment_Am2[i]])

    def residual(x: FloatArray) -> FloatArray:
        state = x * unit
        return np.asarray((measurement.predicted(state[:3], state[3:]) - z) / sigma)

    def jacobian(x: FloatArray) -> FloatArray:
        state = x * unit
        return np.asarray(measurement.jacobian(state[:3], state[3:]) * unit / sigma[:, None])

    found = scipy.optimize.least_squares(residual, truth / unit, jacobian, x_scale="jac", max_nfev=100)
    for j, solution in enumerate(problems.fixes[i].solutions):
        apart = np.linalg.norm(solution.position_m - (found.x * unit)[:3])
        if abs(solution.chi2 - 2.0 * found.cost) < 0.05 and apart < 0.1 * np.linalg.norm(solution.position_m):
            return j
    return None


class TestCovariance:
    """It is never a small ellipse where the range is not observable, and Gaussian where it says so."""

    def test_is_as_long_as_the_set(self) -> None:
        problems = Problems.of("tetrahedron 1.5 m", 300, 12)
        centroid = problems.array.centroid
        n_closed = n_open = 0
        for fix in problems.fixes:
            for s in fix.solutions:
                if s.range_observable:
                    continue
                offset = s.position_m - centroid
                distance = float(np.linalg.norm(offset))
                sigma = float(np.sqrt(offset @ s.covariance[:3, :3] @ offset)) / distance
                low, high = s.range_interval_m[0][0], s.range_interval_m[-1][1]
                if high is None:
                    assert sigma >= 0.999 * distance
                    n_open += 1
                else:
                    assert 1.96 * sigma >= 0.999 * max(distance - low, high - distance)
                    n_closed += 1
        assert min(n_closed, n_open) > 10

    def test_all_else_given_the_range_stays_as_certain(self) -> None:
        """The covariance of (u, m) given the range is that of the inverse information."""
        problems = Problems.of("tetrahedron 1.5 m", 60, 13)
        compared = 0
        for fix in problems.fixes:
            for s in fix.solutions:
                offset = s.position_m - problems.array.centroid
                unit = np.repeat([np.linalg.norm(offset), np.linalg.norm(s.moment_Am2)], 3)
                information = oracles.fisher_information(
                    DifferenceMeasurement.of(problems.array), s.position_m, s.moment_Am2
                )
                information = information * np.outer(unit, unit)
                if np.linalg.cond(information) > 1e10:
                    continue
                covariances = np.linalg.inv(information), s.covariance / np.outer(unit, unit)
                e = np.concatenate([offset / unit[0], np.zeros(3)])
                given = [C - np.outer(C @ e, C @ e) / (e @ C @ e) for C in covariances]
                assert_allclose(given[1], given[0], atol=1e-4 * np.abs(given[0]).max())
                compared += 1
        assert compared > 60

    def nees(self, problems: Problems) -> tuple[FloatArray, FloatArray]:
        """Cartesian NEES per dimension of Gaussian rows, and likelihood ratios per dimension of claimed ones."""
        measurement = DifferenceMeasurement.of(problems.array)
        cartesian, ratios = [], []
        for i in np.flatnonzero(problems.claimed):
            s = problems.fixes[i].solutions[0]
            truth = problems.position_m[i], problems.moment_Am2[i]
            residual = measurement.measured(problems.readings_T[i]) - measurement.predicted(*truth)
            ratios.append((float(np.sum(residual**2 / measurement.variance)) - s.chi2) / 6.0)
            if s.gaussian:
                sigma = np.sqrt(np.diagonal(s.covariance))
                error = np.concatenate([s.position_m - truth[0], s.moment_Am2 - truth[1]]) / sigma
                cartesian.append(float(error @ np.linalg.solve(s.covariance / np.outer(sigma, sigma), error)) / 6.0)
        return np.array(cartesian), np.array(ratios)

    def test_gaussian_rows_quick(self) -> None:
        """1,500 rows: NEES within its 99.99 % bounds of [0.9, 1.1], the ratio within those of [0.95, 1.05]."""
        for values, low, high in zip(
            self.nees(Problems.of("six irregular", 1500, 14)), (0.9, 0.95), (1.1, 1.05), strict=True
        ):
            n = 6 * len(values)
            assert n > 600
            assert low * scipy.stats.chi2.ppf(5e-5, n) / n < values.mean() < high * scipy.stats.chi2.isf(5e-5, n) / n

    @pytest.mark.slow
    @pytest.mark.parametrize("case", CASES)
    def test_of_ten_thousand(self, case: str) -> None:
        cartesian, ratios = self.nees(Problems.of(case, 10_000, 15))
        assert 0.9 < cartesian.mean() < 1.1
        assert 0.95 < ratios.mean() < 1.05

    def test_a_rival_is_not_gaussian(self) -> None:
        """However small the ellipse, where another solution is as likely it is not the uncertainty."""
        for fix in Problems.of("square 1 m", 400, 16).fixes:
            for s in fix.solutions:
                assert not (s.gaussian and s.weight < 0.99)
                assert not (s.gaussian and not s.range_observable)


class TestBentErrors:
    """A small ellipse is not Gaussian either where χ² does not follow it: near a long array, most of all."""

    # Five sensors of unequal noise, nearly in a line.
    ARRAY = SensorArray(
        tuple(
            Sensor(f"s{i}", "vector", place, noise)
            for i, (place, noise) in enumerate(
                zip(
                    (np.random.default_rng(2).normal(size=(5, 3)) * [1.0, 0.6, 0.3]).tolist(),
                    (1e-9, 5e-10, 2e-9, 1e-9, 7e-10),
                    strict=True,
                )
            )
        )
    )

    def problems(self) -> Problems:
        return Problems.around(self.ARRAY, 2.0, 4.0, 600, 18)

    def test_chi2_rises_by_one_along_the_longest_axis(self) -> None:
        """By the differences that share a base sensor; the axis by a singular value decomposition."""
        problems = self.problems()
        measurement = DifferenceMeasurement.of(self.ARRAY)
        told, found = [], []
        for fix, readings in zip(problems.fixes, problems.readings_T, strict=True):
            s = fix.solutions[0]
            offset = s.position_m - self.ARRAY.centroid
            unit = np.repeat([np.linalg.norm(offset), np.linalg.norm(s.moment_Am2)], 3)
            jacobian = measurement.jacobian(s.position_m, s.moment_Am2) * unit / np.sqrt(measurement.variance)[:, None]
            _, w, Vt = np.linalg.svd(jacobian)
            sigma = [np.sqrt(np.sum((Vt.T[part] / w) ** 2)) for part in (slice(3), slice(3, 6))]
            if max(sigma) > 0.04 or s.weight < 0.99 or len(s.range_interval_m) > 1 or not s.range_observable:
                assert not s.gaussian
                continue
            rises = []
            for step in (unit * Vt[-1] / w[-1], -unit * Vt[-1] / w[-1]):
                moved = measurement.predicted(s.position_m + step[:3], s.moment_Am2 + step[3:])
                rises.append(np.sum((measurement.measured(readings) - moved) ** 2 / measurement.variance) - s.chi2)
            told.append(s.gaussian)
            found.append(np.abs(np.array(rises) - 1.0).max())
        bends, gaussian = np.array(found), np.array(told)
        assert gaussian[bends < 0.49].all()
        assert not gaussian[bends > 0.51].any()
        assert np.count_nonzero(bends > 0.51) >= 3
        assert gaussian.mean() > 0.9

    @pytest.mark.slow
    def test_nees_of_ten_thousand(self) -> None:
        """1.01; 2.0 without looking at the longest axis, and thousands with the row that the search misses."""
        problems = Problems.around(self.ARRAY, 2.0, 8.0, 10_000, 2)
        cartesian, _ = TestCovariance().nees(problems)
        assert 0.9 < cartesian.mean() < 1.1

    def test_a_misfit_is_not_gaussian(self) -> None:
        problems = self.problems()
        wrong = problems.readings_T + 100.0 * self.ARRAY.channel_noise_T * (np.arange(15) == 4)
        misfits = 0
        for fix in plain_locator(self.ARRAY).fit_rows(wrong):
            s = fix.solutions[0]
            if scipy.stats.chi2.sf(s.chi2, s.dof) < 1e-6:
                misfits += 1
                assert not s.gaussian
        assert misfits > 100


class TestTrack:
    """Every row of a track says what is known of the range."""

    def points(self, n: int, distance: float) -> tuple[Tracker, list[TrackPoint]]:
        position = distance * POSITION / np.linalg.norm(POSITION)
        readings = readings_of(ARRAY, np.tile(position, (n, 1)), np.tile(MOMENT, (n, 1)), 0)
        tracker = Tracker(ARRAY, RandomWalk(0.01, 0.01))
        return tracker, followed(tracker, [Row(0.5 * i, values) for i, values in enumerate(readings)])

    def test_of_a_track_it_is_that_of_its_covariance(self) -> None:
        _, points = self.points(20, 2.5)
        last = points[-1]
        assert last.position_m is not None
        assert last.covariance is not None
        offset = last.position_m - ARRAY.centroid
        low, high = ends_of(last)
        assert_allclose([low, high], gaussian_ranges(last.covariance, offset, ARRAY.circumradius))
        sigma = float(np.sqrt(offset @ last.covariance[:3, :3] @ offset)) / np.linalg.norm(offset)
        assert 0.5 * (high - low) == pytest.approx(1.96 * sigma, rel=0.01)
        assert low < 2.5 < high
        assert last.range_observable
        assert 0.99 < last.weight <= 1.0
        assert last.rivals == ()

    def test_without_one_it_is_that_of_the_row(self) -> None:
        """The rows show nothing of a source that is so far."""
        _, points = self.points(8, 22.0)
        locator = plain_locator(ARRAY)
        position = 22.0 * POSITION / np.linalg.norm(POSITION)
        readings = readings_of(ARRAY, np.tile(position, (8, 1)), np.tile(MOMENT, (8, 1)), 0)
        for point, fix in zip(points, locator.fit_rows(readings), strict=True):
            assert point.position_m is None
            assert np.isnan(point.weight)
            assert not point.gaussian
            assert point.range_interval_m is not None
            assert_allclose(ends_of(point), ends_of(fix.solutions[0]), rtol=1e-6)
            assert point.range_observable == fix.solutions[0].range_observable

    def test_rows_that_say_nothing_allow_every_range(self) -> None:
        (point,) = Tracker(ARRAY, RandomWalk(0.1, 0.1)).run([Row(0.0, np.full(ARRAY.n_channels, np.nan))])
        assert point.range_interval_m == EVERYWHERE
        assert not point.range_observable

    def test_gaussian_ranges_open_where_the_source_is_far(self) -> None:
        """In α the interval is symmetric; a standard deviation as large as the range opens it."""
        offset = np.array([[10.0, 0.0, 0.0], [10.0, 0.0, 0.0]])
        ends = gaussian_ranges(np.array([np.eye(3), 100.0 * np.eye(3)]), offset, 1.0)
        assert np.isinf(ends[1, 1])
        a, middle = np.arctan(1.0 / ends[0]), np.arctan(0.1)
        assert 0.5 * (a[0] + a[1]) == pytest.approx(middle)
        assert is_detected(30.0, 9)


def test_solutions_say_what_they_are() -> None:
    """Defaults of a solution that somebody else makes: the only one, and not known to be Gaussian."""
    solution = Solution((Source(np.zeros(3), np.ones(3), np.eye(6), ((1.0, 2.0),)),), np.eye(6), 0.0, 3)
    assert solution.weight == 1.0
    assert not solution.gaussian
