"""Tracks of a source whose moment is known, modulus or components; fixes with the same prior are the twins."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

import magloc
from arrays.geometries import axial
from magloc.measurement.differences import predicted_channels
from magloc.tracking.chart.known_moment import ConstantModulus
from magloc.tracking.rows import Row
from magloc.tracking.tracker import Tracker
from tests.passing_source import ARRAY
from tests.tracked_sources import MODULUS_AM2 as MODULUS
from tests.tracked_sources import MODULUS_SIGMA_AM2 as SIGMA
from tests.tracked_sources import of_known_modulus as source
from tests.tracked_sources import walk_of_known_modulus

WALK = magloc.RandomWalk(0.1, 0.02)
KNOWN = magloc.SourcePrior(known_moment_Am2=MODULUS, known_moment_sigma_Am2=SIGMA)


def track(seed: int, range_m: float, prior: magloc.SourcePrior, n_rows: int = 10) -> magloc.Track:
    """Of a source that moves as is stated; it turns, and is as strong throughout."""
    return magloc.track(ARRAY, walk_of_known_modulus(seed, range_m, n_rows)[1], motion=WALK, prior=prior)


def range_sigma(point: magloc.TrackPoint | magloc.Solution, centroid_m: NDArray[np.float64]) -> float:
    """Standard deviation along the line of sight."""
    unit = point.position_m - centroid_m
    unit = unit / np.linalg.norm(unit)
    return float(np.sqrt(unit @ point.covariance[:3, :3] @ unit))


class TestFirstRow:
    @pytest.mark.parametrize("seed", range(3))
    def test_is_the_fix_with_the_same_prior(self, seed: int) -> None:
        """Of a row that both call Gaussian, 3 m away: places within a tenth of σ, σ within 5 %."""
        x = source(seed, 3.0)
        readings = predicted_channels(ARRAY, x[:3], x[3:]) + 2e-10 * np.random.default_rng(seed).normal(size=12)
        point, fix = (
            Tracker(ARRAY, WALK, prior=KNOWN).update(Row(0.0, readings)),
            magloc.locate(ARRAY, readings, prior=KNOWN),
        )
        assert point.position_m is not None
        assert point.covariance is not None
        sigma = np.sqrt(np.diagonal(fix.covariance[0]))
        assert np.abs(point.position_m - fix.position_m[0]).max() < 0.1 * sigma[:3].max()
        np.testing.assert_allclose(np.sqrt(np.diagonal(point.covariance)), sigma, rtol=0.05)

    def test_of_a_far_source_the_range_is_known_as_the_modulus_is(self) -> None:
        """12 m away: σ of the modulus, 2 %, is a third of that in the range, and nothing else is."""
        for seed in range(3):
            known, unknown = (track(seed, 12.0, prior, 1)[0] for prior in (KNOWN, magloc.SourcePrior()))
            assert known.centroid_m is not None
            assert range_sigma(known, known.centroid_m) < 0.3 * range_sigma(unknown, known.centroid_m)
            assert known.mixture is not None
            strengths = np.linalg.norm(known.mixture.x[:, 3:], axis=1)
            np.testing.assert_allclose(strengths, MODULUS, atol=3.0 * SIGMA)

    def test_three_numbers_are_known_in_the_axes_of_the_array(self) -> None:
        x = source(1, 6.0)
        readings = predicted_channels(ARRAY, x[:3], x[3:])
        prior = magloc.SourcePrior(known_moment_Am2=tuple(x[3:].tolist()), known_moment_sigma_Am2=1.0)
        R = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        point = Tracker(ARRAY, WALK, prior=prior).update(Row(0.0, readings, np.array([5.0, 0.0, 0.0]), R))
        assert point.position_m is not None
        assert point.moment_Am2 is not None
        np.testing.assert_allclose(point.moment_Am2, R @ x[3:], atol=3.0)
        np.testing.assert_allclose(point.position_m, R @ x[:3] + [5.0, 0.0, 0.0], atol=0.1)


class TestTrack:
    def test_the_modulus_stays_known_while_it_turns(self) -> None:
        """Ten rows: without the prior its σ is larger, with it that of the prior, and it is right within 4.5 σ."""
        for seed in range(3):
            known, unknown = track(seed, 8.0, KNOWN), track(seed, 8.0, magloc.SourcePrior())
            sigma = []
            for found in (known, unknown):
                unit = found.moment_Am2[-1] / np.linalg.norm(found.moment_Am2[-1])
                sigma.append(float(np.sqrt(unit @ found.covariance[-1, 3:, 3:] @ unit)))
            assert sigma[0] <= 1.05 * SIGMA < sigma[1]
            strength = np.linalg.norm(source(seed, 8.0)[3:])
            assert abs(np.linalg.norm(known.moment_Am2[-1]) - strength) < 4.5 * sigma[0]

    @pytest.mark.slow
    def test_errors_are_claimed(self) -> None:
        """Last rows of 30 tracks of truths that are drawn as is stated: χ² of 90 numbers, at 1 in 1,000."""
        total = 0.0
        for seed in range(30):
            found, x = track(seed, 8.0, KNOWN), walk_of_known_modulus(seed, 8.0, 10)[0][-1]
            off = found.position_m[-1] - x[:3]
            total += float(off @ np.linalg.solve(found.covariance[-1, :3, :3], off))
        low, high = stats.chi2.ppf([5e-4, 1.0 - 5e-4], 90)
        assert low < total < high

    @pytest.mark.slow
    def test_of_rows_of_few_readings_the_range_is_known_sooner(self) -> None:
        """A pair of sensors, 4 m away, in eight rows: the set of ranges is narrower, and holds the truth."""
        pair = axial(1.5, "vector", 5e-9)
        place, moment = np.array([2.0, 3.0, 1.0]), MODULUS * np.array([0.6, 0.0, 0.8])
        points = []
        for prior in (KNOWN, magloc.SourcePrior()):
            tracker, rng = Tracker(pair, magloc.RandomWalk(1e-6, 1e-6), prior=prior), np.random.default_rng(5)
            for i in range(8):
                origin = np.array([0.05 * i, 0.0, 0.0])
                readings = predicted_channels(pair, place - origin, moment) + 5e-9 * rng.normal(size=6)
                point = tracker.update(Row(0.5 * i, readings, origin))
            points.append(point)
        (low, high), (low_other, high_other) = (point.range_interval_m[0] for point in points)  # type: ignore[index]
        range_m = float(np.linalg.norm(place - origin - pair.centroid))
        assert high is not None
        assert low < range_m < high
        assert math.log(high / low) < 0.5 * math.log((high_other or math.inf) / low_other)


class TestKeptModulus:
    def test_noise_turns_the_moment_alone(self) -> None:
        x = np.array([1.0, 2.0, 3.0, 4.0, -5.0, 6.0])
        kept = ConstantModulus.of(WALK, KNOWN)
        moved, F, S_q = kept.step(x, 0.5)
        plain = WALK.step(x, 0.5)
        np.testing.assert_array_equal(moved, plain[0])
        np.testing.assert_array_equal(F, plain[1])
        np.testing.assert_allclose(x[3:] @ S_q[3:], 0.0, atol=1e-12)
        np.testing.assert_array_equal(S_q[:3], plain[2][:3])
        across = np.array([5.0, 4.0, 0.0])
        np.testing.assert_allclose(across @ S_q[3:], across @ plain[2][3:], atol=1e-12)

    def test_nothing_known_is_the_motion_itself(self) -> None:
        assert ConstantModulus.of(WALK, magloc.SourcePrior()) is WALK
