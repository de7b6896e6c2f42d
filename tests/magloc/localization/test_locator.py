"""One dipole by any sensors, without a start: seven scalar sensors and more, and mixed arrays.

Readings are made with magpylib's field. Random arrays and sources come from seeds that were never tuned.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.stats import chi2 as chi2_distribution

from arrays.array import SensorArray
from arrays.geometries import tetrahedron
from magloc.localization.fit.prior import SourcePrior
from tests.magloc.localization.fit.test_gauss_newton import (
    AMBIENT,
    array_of,
    chi2_by_magpylib,
    magpylib_readings,
    noisy_readings,
    scalar_cloud,
    scipy_optimum,
)
from tests.plain_locator import plain_locator, random_sources


def sources_anywhere(rng, n, nearest=2.8, farthest=5.0, moment=300.0):
    """Positions and moments (n, 1, 3) in any direction."""
    position, m = random_sources(rng, n, nearest, farthest, moment)
    return position[:, None], m[:, None]


def position_errors(fixes, positions):
    """Distances of the first solutions from the truth, infinite where there is none."""
    return np.array(
        [
            np.linalg.norm(fix.solutions[0].position_m - p[0]) if fix.solutions else np.inf
            for fix, p in zip(fixes, positions, strict=True)
        ]
    )


def nees_of(solution, position, moment):
    """Squared error in units of the reported covariance."""
    error = np.concatenate([solution.position_m - position, solution.moment_Am2 - moment])
    return error @ np.linalg.solve(solution.covariance, error)


class TestTwelveScalarSensors:
    """Within 1.5 m, 0.01 nT, source 2.8 to 5 m away, 300 A·m², no start: 1 mm median, 98 % within 1 cm.

    Every array stands elsewhere at random; with and without an ambient field of 50 µT.
    """

    @pytest.mark.parametrize("ambient", [AMBIENT, None])
    @pytest.mark.parametrize(("n_arrays", "n_rows"), [(5, 20), pytest.param(50, 40, marks=pytest.mark.slow)])
    def test_position(self, n_arrays, n_rows, ambient):
        errors = []
        for seed in range(n_arrays):
            array = scalar_cloud(seed, ambient)
            rng = np.random.default_rng([1, seed])
            p, m = sources_anywhere(rng, n_rows)
            errors.append(position_errors(plain_locator(array).fit_rows(noisy_readings(array, p, m, rng)), p))
        assert np.median(errors) <= 1e-3
        assert np.mean(np.concatenate(errors) <= 0.01) >= 0.98

    def test_scatter_of_fixes(self):
        """NEES of 100 fixes by the reported covariance, two-sided false-alarm rate 1e-4."""
        array = scalar_cloud(3)
        rng = np.random.default_rng(3)
        p, m = sources_anywhere(rng, 100)
        nees = 0.0
        for fix, *truth in zip(plain_locator(array).fit_rows(noisy_readings(array, p, m, rng)), p, m, strict=True):
            nees += nees_of(fix.solutions[0], *np.reshape(truth, (2, 3)))
        low, high = chi2_distribution.ppf([0.5e-4, 1 - 0.5e-4], 6 * 100)
        assert low < nees < high


class TestBothSigns:
    """Moduli are even in the field: only an ambient field tells a moment from its opposite.

    True solutions are those within the 1 - 1e-6 quantile of their NEES.
    """

    def test_without_ambient_field_both_are_listed(self):
        array = scalar_cloud(4, None)
        rng = np.random.default_rng(4)
        p, m = sources_anywhere(rng, 20)
        for fix, place, moment in zip(
            plain_locator(array).fit_rows(noisy_readings(array, p, m, rng)), p, m, strict=True
        ):
            first, second = fix.solutions[:2]
            assert_allclose(second.moment_Am2, -first.moment_Am2, rtol=1e-9)
            assert_allclose(second.position_m, first.position_m, rtol=1e-9)
            assert second.chi2 == pytest.approx(first.chi2, rel=1e-9)
            nees = [nees_of(s, place[0], moment[0]) for s in (first, second)]
            assert min(nees) < chi2_distribution.ppf(1.0 - 1e-6, 6)
            assert max(nees) > 1e4

    def test_in_an_ambient_field_the_true_one_alone(self):
        array = scalar_cloud(4)
        rng = np.random.default_rng(5)
        p, m = sources_anywhere(rng, 20)
        for fix, place, moment in zip(
            plain_locator(array).fit_rows(noisy_readings(array, p, m, rng)), p, m, strict=True
        ):
            assert len(fix.solutions) == 1
            assert nees_of(fix.solutions[0], place[0], moment[0]) < chi2_distribution.ppf(1.0 - 1e-6, 6)

    def test_two_vector_sensors_more_tell_them_apart(self):
        """The difference of two components is not even."""
        scalar = scalar_cloud(6, None)
        pair = (replace(s, id=f"v{s.id}") for s in tetrahedron(1.5, noise_T=1e-10).sensors[:2])
        array = SensorArray((*scalar.sensors, *pair))
        rng = np.random.default_rng(6)
        p, m = sources_anywhere(rng, 5)
        for fix, place, moment in zip(
            plain_locator(array).fit_rows(noisy_readings(array, p, m, rng)), p, m, strict=True
        ):
            assert len(fix.solutions) == 1
            assert nees_of(fix.solutions[0], place[0], moment[0]) < chi2_distribution.ppf(1.0 - 1e-6, 6)


class TestFewScalarSensors:
    """Seven moduli give six differences: as many as unknowns."""

    array = SensorArray(scalar_cloud(7).sensors[:7], ambient_T=AMBIENT)

    def test_seven_give_the_source_exactly(self):
        """Six equations may have several roots: the true one is among them, and all explain the readings."""
        p, m = sources_anywhere(np.random.default_rng(7), 8)
        readings = np.stack([magpylib_readings(self.array, *source) for source in zip(p, m, strict=True)])
        fixes = plain_locator(self.array).fit_rows(readings)
        errors = [
            min((np.linalg.norm(s.position_m - place[0]) for s in fix.solutions), default=np.inf)
            for fix, place in zip(fixes, p, strict=True)
        ]
        assert np.median(errors) < 1e-3
        assert all(s.dof == 0 for fix in fixes for s in fix.solutions)

    def test_six_are_too_few(self):
        with pytest.raises(ValueError, match=r"must give at least 6 independent differences .* instead it gives 5"):
            plain_locator(SensorArray(self.array.sensors[:6], ambient_T=AMBIENT))

    def test_rows_with_too_few_readings_say_so(self):
        p, m = sources_anywhere(np.random.default_rng(8), 2)
        readings = np.stack([magpylib_readings(self.array, *source) for source in zip(p, m, strict=True)])
        readings[0, 3] = np.nan
        fixes = plain_locator(self.array).fit_rows(readings)
        assert fixes[0].solutions == ()
        assert fixes[0].reason == "6 readings give 5 independent differences, 6 are needed"
        assert fixes[1].solutions

    def test_no_signal(self):
        fix = plain_locator(scalar_cloud(7)).fit(np.full(12, np.linalg.norm(AMBIENT)))
        assert fix.solutions == ()
        assert "no signal" in fix.reason


class TestBestFit:
    """Nothing that scipy finds from the truth is better."""

    @pytest.mark.slow_after(1)
    @pytest.mark.parametrize("kind", ["scalar", "scalar in ambient", "mixed", "mixed in ambient"])
    def test_no_worse_than_scipy_from_the_truth(self, kind):
        array = array_of(kind, 9, 16)
        rng = np.random.default_rng(9)
        p, m = sources_anywhere(rng, 6, 3.5, 5.0)
        readings = noisy_readings(array, p, m, rng)
        for row, fix, *truth in zip(readings, plain_locator(array).fit_rows(readings), p, m, strict=True):
            best = fix.solutions[0]
            assert best.chi2 < scipy_optimum(array, row, *truth)[0] + 0.01
            expected = chi2_by_magpylib(array, row, best.position_m[None], best.moment_Am2[None])
            assert best.chi2 == pytest.approx(expected, rel=1e-5, abs=1e-4)


class TestRows:
    """Missing readings, an ambient field of every row, and what is known of the source."""

    def test_missing_readings(self):
        array = scalar_cloud(11)
        rng = np.random.default_rng(11)
        p, m = sources_anywhere(rng, 4)
        readings = noisy_readings(array, p, m, rng)
        readings[0, 2] = readings[1, [0, 5, 6]] = np.nan
        fixes = plain_locator(array).fit_rows(readings)
        assert [fix.solutions[0].dof for fix in fixes] == [4, 2, 5, 5]
        for i, fix in enumerate(fixes):
            assert fix.solutions[0].chi2 < scipy_optimum(array, readings[i], p[i], m[i])[0] + 0.01

    def test_ambient_field_of_every_row(self):
        array = scalar_cloud(12)
        rng = np.random.default_rng(12)
        p, m = sources_anywhere(rng, 4)
        ambient = 3e-5 * rng.normal(size=(4, 3))
        rows = [replace(array, ambient_T=tuple(field)) for field in ambient]
        readings = np.stack([magpylib_readings(*row) for row in zip(rows, p, m, strict=True)])
        together = plain_locator(array).fit_rows(readings, ambient)
        for i, fix in enumerate(together):
            assert_allclose(fix.solutions[0].position_m, p[i, 0], rtol=1e-4)
            alone = plain_locator(array).fit(readings[i], ambient[i])
            assert_allclose(alone.solutions[0].position_m, fix.solutions[0].position_m, rtol=1e-6)

    def test_a_known_region_and_largest_moment(self):
        array = scalar_cloud(13, None)
        rng = np.random.default_rng(13)
        p, m = sources_anywhere(rng, 10)
        known = SourcePrior(low_m=(-np.inf, -np.inf, 0.0), largest_moment_Am2=400.0)
        fixes = plain_locator(array, prior=known).fit_rows(noisy_readings(array, p, m, rng))
        listed = [s for fix in fixes for s in fix.solutions]
        assert all(s.position_m[2] >= 0.0 and np.linalg.norm(s.moment_Am2) <= 400.0 for s in listed)
        above = p[:, 0, 2] > 0.0
        assert (position_errors(fixes, p)[above] < 0.01).all()
        reasons = {fix.reason for fix in fixes if not fix.solutions}
        assert all("known region" in reason for reason in reasons)
