"""Fixes from one set of readings.

| what | who checks it |
|---|---|
| the optimum | scipy.optimize.least_squares from the truth; noise-free readings from magpylib |

| covariance, range interval | test_range_interval, test_kernels |
"""

from __future__ import annotations

import numpy as np
import pytest
import scipy.optimize
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.stats import chi2 as chi2_distribution

from arrays.array import SensorArray
from arrays.differences import decorrelated_differences
from arrays.geometries import axial, cross, grid, square, tetrahedron
from arrays.noise import proportional_noise
from arrays.sensor import Sensor
from magloc.localization.fit.prior import SourcePrior
from magloc.localization.search.candidates import candidate_positions
from magloc.localization.search.single_source import SingleSourceSearch
from magloc.measurement.differences import DifferenceMeasurement, predicted_channels
from tests.arrays.test_differences import random_array
from tests.plain_locator import noisy_readings, plain_locator, random_sources

SEEDS = st.integers(0, 2**32 - 1)
TETRAHEDRON = tetrahedron(1.5, noise_T=1e-9)


def scipy_chi2(array, readings, position, moment):
    """χ² of scipy's local optimum from a start."""
    available = np.isfinite(readings)
    measurement = DifferenceMeasurement(array, decorrelated_differences(array, available))
    z, sigma = measurement.measured(readings), np.sqrt(measurement.variance)
    size = np.linalg.norm(moment)

    def residual(x):
        return (measurement.predicted(x[:3], size * x[3:]) - z) / sigma

    found = scipy.optimize.least_squares(
        residual, np.concatenate([position, moment / size]), x_scale="jac", xtol=1e-12, ftol=1e-12, gtol=1e-12
    )
    return 2.0 * found.cost


class TestNoiseFreeReadings:
    """The true source comes back, whatever the array's sensors, poses, gains and offsets."""

    @given(SEEDS, st.integers(4, 12))
    @settings(max_examples=25, deadline=None)
    def test_any_array(self, seed, n):
        array = random_array(seed, n)
        p, m = random_sources(np.random.default_rng(seed), 1, 3.0, 8.0, moment_Am2=1e4)
        readings = predicted_channels(array, p[0], m[0]) + array.channel_offset_T
        found = plain_locator(array).fit(readings).solutions
        distance = [np.linalg.norm(s.position_m - p[0]) for s in found]
        best = found[int(np.argmin(distance))]
        assert_allclose(best.position_m, p[0], atol=1e-4 * np.linalg.norm(p))
        assert_allclose(best.moment_Am2, m[0], atol=1e-3 * np.linalg.norm(m))
        assert best.chi2 < 1e-6


class TestBestFit:
    """The first solution is the maximum of the likelihood: nothing that scipy finds from the truth is better."""

    @pytest.mark.slow_after(1)
    @pytest.mark.parametrize("case", ["tetrahedron", "irregular", "square", "common field", "proportional noise"])
    def test_no_worse_than_scipy_from_the_truth(self, case):
        array, nearest, farthest = {
            "tetrahedron": (TETRAHEDRON, 1.2, 10.0),
            "irregular": (random_array(7, 7), 3.0, 12.0),
            "square": (square(1.0, noise_T=1e-9), 1.0, 6.0),
            "common field": (SensorArray(TETRAHEDRON.sensors, common_field_T=2e-9), 1.2, 10.0),
            "proportional noise": (SensorArray(TETRAHEDRON.sensors, noise_fraction=0.01), 1.2, 10.0),
        }[case]
        rng = np.random.default_rng(11)
        p, m = random_sources(rng, 60, nearest, farthest)
        readings = noisy_readings(array, p, m, rng)
        worse = []
        for i, fix in enumerate(plain_locator(array).fit_rows(readings)):
            row = array
            if case == "proportional noise":  # scipy gets the noise of this row as the sensors' own
                noise = proportional_noise(array, readings[i])[::3]
                row = SensorArray(
                    tuple(
                        Sensor(id=s.id, kind=s.kind, position_m=s.position_m, noise_T=float(sigma))
                        for s, sigma in zip(array.sensors, noise, strict=True)
                    )
                )
            if fix.solutions[0].chi2 > scipy_chi2(row, readings[i], p[i], m[i]) + 0.05:
                worse.append(i)
        assert worse == []

    def test_chi_square_of_good_fits(self):
        """Sum of 200 χ² of 3 degrees of freedom at high signal; two-sided false-alarm rate 1e-4."""
        rng = np.random.default_rng(2)
        p, m = random_sources(rng, 200, 1.5, 4.0, moment_Am2=1000.0)
        fixes = plain_locator(TETRAHEDRON).fit_rows(noisy_readings(TETRAHEDRON, p, m, rng))
        assert {fix.solutions[0].dof for fix in fixes} == {3}
        low, high = chi2_distribution.ppf([0.5e-4, 1 - 0.5e-4], 3 * 200)
        assert low < sum(fix.solutions[0].chi2 for fix in fixes) < high


class TestSolutionsAreRanked:
    def test_best_first_and_within_20(self):
        rng = np.random.default_rng(4)
        p, m = random_sources(rng, 40, 6.0, 12.0)
        fixes = plain_locator(TETRAHEDRON).fit_rows(noisy_readings(TETRAHEDRON, p, m, rng))
        several = [[s.chi2 for s in fix.solutions] for fix in fixes if len(fix.solutions) > 1]
        assert several, "weak signals have more than one solution"
        for chi2 in several:
            assert chi2 == sorted(chi2)
            assert chi2[-1] <= chi2[0] + 20.0

    @pytest.mark.slow
    def test_weak_mirror_solution_is_listed(self):
        """The truth's own basin is among the solutions even where another one fits better."""
        rng = np.random.default_rng(5)
        p, m = random_sources(rng, 100, 8.0, 12.0)
        readings = noisy_readings(TETRAHEDRON, p, m, rng)
        mirrored = 0
        for i, fix in enumerate(plain_locator(TETRAHEDRON).fit_rows(readings)):
            local = scipy_chi2(TETRAHEDRON, readings[i], p[i], m[i])
            assert any(abs(s.chi2 - local) < 0.05 or s.chi2 < local for s in fix.solutions)
            mirrored += fix.solutions[0].chi2 < local - 0.05
        assert mirrored < 100


class TestMissingReadings:
    def test_the_rest_of_the_row_is_used(self):
        array = random_array(1, 6)
        rng = np.random.default_rng(10)
        p, m = random_sources(rng, 3, 3.0, 5.0, moment_Am2=1e4)
        readings = noisy_readings(array, p, m, rng)
        readings[0, 4] = readings[1, [0, 7, 9]] = np.nan
        fixes = plain_locator(array).fit_rows(readings)
        assert [fix.solutions[0].dof for fix in fixes] == [8, 6, 9]
        for i in range(3):
            assert fixes[i].solutions[0].chi2 < scipy_chi2(array, readings[i], p[i], m[i]) + 0.05

    def test_too_few_are_a_reason_and_the_others_still_come_out(self):
        readings = np.stack([predicted_channels(TETRAHEDRON, [3, 1, 0], [0, 0, 100])] * 2)
        readings[0, 2:9] = np.nan
        fixes = plain_locator(TETRAHEDRON).fit_rows(readings)
        assert fixes[0].solutions == ()
        assert "6 are needed" in fixes[0].reason
        assert fixes[1].solutions


class TestWhatCannotBeSolved:
    def test_no_signal(self):
        fix = plain_locator(TETRAHEDRON).fit(np.tile([2e-5, 1e-6, 4.5e-5], 4))
        assert fix.solutions == ()
        assert "no signal" in fix.reason

    def test_two_sensors_do_not_determine_a_source(self):
        array = axial(1.0, noise_T=1e-9)
        fix = plain_locator(array).fit(predicted_channels(array, [3, 1, 0], [0, 0, 100]))
        assert fix.solutions == ()
        assert "3 independent differences" in fix.reason

    def test_iterations_that_run_out_are_not_a_fix(self):
        rng = np.random.default_rng(0)
        p, m = random_sources(rng, 1, 4.0, 6.0)
        hasty = plain_locator(TETRAHEDRON)
        hasty._search = SingleSourceSearch(TETRAHEDRON, max_iterations=1)
        fix = hasty.fit(noisy_readings(TETRAHEDRON, p, m, rng)[0])
        assert fix.solutions == ()
        assert fix.failed_starts > 0
        assert "did not converge" in fix.reason

    def test_scalar_sensors_are_refused(self):
        with pytest.raises(ValueError, match="vector sensors only"):
            SingleSourceSearch(tetrahedron(1.5, kind="scalar"))

    def test_wrong_shape_is_named(self):
        with pytest.raises(ValueError, match=r"shape \(n, 12\)"):
            plain_locator(TETRAHEDRON).fit(np.zeros(9))


class TestKnowledge:
    """What is known beforehand removes solutions, and only those that contradict it."""

    rng = np.random.default_rng(14)
    p, m = random_sources(rng, 60, 6.0, 12.0)
    readings = noisy_readings(TETRAHEDRON, p, m, rng)

    def test_half_space(self):
        everything = plain_locator(TETRAHEDRON).fit_rows(self.readings)
        above = plain_locator(TETRAHEDRON, prior=SourcePrior(low_m=(-np.inf, -np.inf, 0.0))).fit_rows(self.readings)
        assert any(s.position_m[2] < 0 for fix in everything for s in fix.solutions)
        assert all(s.position_m[2] >= 0 for fix in above for s in fix.solutions)
        for free, bound in zip(everything, above, strict=True):
            for s in (s for s in free.solutions if s.position_m[2] >= 0):
                assert any(np.allclose(s.position_m, other.position_m, rtol=1e-3) for other in bound.solutions)

    def test_largest_moment(self):
        fixes = plain_locator(TETRAHEDRON, prior=SourcePrior(largest_moment_Am2=400.0)).fit_rows(self.readings)
        solved = [s for fix in fixes for s in fix.solutions]
        assert solved
        assert all(np.linalg.norm(s.moment_Am2) <= 400.0 for s in solved)
        assert all("known region" in fix.reason for fix in fixes if not fix.solutions)

    def test_bounds_that_leave_nothing(self):
        with pytest.raises(ValueError, match="low_m must be below high_m"):
            SourcePrior((1.0, 0.0, 0.0), (0.0, 1.0, 1.0))
        with pytest.raises(ValueError, match="must be positive"):
            SourcePrior(largest_moment_Am2=0.0)
        with pytest.raises(ValueError, match="excludes all of them"):
            plain_locator(TETRAHEDRON, prior=SourcePrior(low_m=(1e6, 1e6, 1e6)))


class TestFitFrom:
    def test_every_start_leads_to_the_best_fit(self):
        p, m = np.array([5.0, 0.0, 0.306]), np.array([0.0, 0.0, 100.0])
        readings = predicted_channels(TETRAHEDRON, p, m)
        starts = np.random.default_rng(0).uniform(-20, 20, (50, 3))
        ends = SingleSourceSearch(TETRAHEDRON).optima_from(readings, starts)
        assert_allclose(ends.position_m, np.tile(p, (50, 1)), atol=1e-4)
        assert (ends.linearisations > 0).all()


class TestCandidates:
    def test_scale_with_the_array(self):
        small, large = candidate_positions(cross(0.03)), candidate_positions(cross(30.0))
        assert_allclose(1000.0 * small, large, rtol=1e-9, atol=1e-9)


class TestNeighbouringOptima:
    """What is one optimum and what are two: 0.01 rad on the sphere of homogeneous coordinates, 0.01 in χ²."""

    @pytest.mark.parametrize("position", [[1.2, 0.36, 0.18], [1.2, 0.36, 0.24], [3.0, 0.9, 0.45], [3.0, 0.9, 0.6]])
    def test_mirror_images_are_both_listed(self, position):
        """Sensors of one axis that stand in a plane across it cannot know on which side a source is."""
        array = grid(3, 3, 0.5, noise_T=1e-9)
        readings = predicted_channels(array, position, 5.0 * np.array([30.0, -20.0, 50.0])) + array.channel_offset_T
        readings[np.arange(readings.size) % 3 != 2] = np.nan
        found = plain_locator(array).fit(readings).solutions
        image = np.array([1.0, 1.0, -1.0]) * position
        for side in (position, image):
            assert min(np.linalg.norm(s.position_m - side) + s.chi2 for s in found) < 1e-3
