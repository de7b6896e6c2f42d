"""Detection: statistics, thresholds, probabilities and ranges.

====================================  ==========================================================================
what                                  who checks it
====================================  ==========================================================================
energy threshold                      scipy.stats.chi2; share of simulated noise, binomial bounds
known position: its distribution      scipy.stats.ncx2 (noncentral χ²), Kolmogorov-Smirnov; own numpy projection
matched filter: the largest energy    scipy's simplex search over positions; never below any position's energy
its false-alarm rate                  independent noise, binomial bounds widened by the threshold's own error
detection range                       scipy's brentq along single directions; the far-field law r ~ m^(1/4)
====================================  ==========================================================================

Statistical tests have fixed seeds that were not tuned; each states the rate at which it fails by chance.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from scipy.optimize import brentq, minimize

from arrays.array import SensorArray
from arrays.differences import decorrelated_differences
from arrays.geometries import cube, hexagon, square, tetrahedron
from magloc.chi_square import ChiSquareDetector, energy_threshold
from magloc.detection.detection_range import detection_ranges
from magloc.detection.dipole_filter import DipoleFilter
from magloc.detection.matched_filter import MatchedFilterDetector
from magloc.directions import fibonacci_directions
from magloc.fields.dipole import field

ARRAY = tetrahedron(1.5)
SOURCE, MOMENT = np.array([4.0, 3.0, -2.0]), np.array([30.0, -20.0, 40.0])
SCALARS = replace(cube(1.0, "scalar", 1e-11), ambient_T=(2e-5, 0.0, -4.5e-5))


def readings(array: SensorArray, n: int, seed: int, moment: np.ndarray | None = None) -> np.ndarray:
    """Raw readings of a source, made without any code under test."""
    rng = np.random.default_rng(seed)
    fields = array.ambient_fields + rng.normal(0.0, 2e-8, 3) * (not array.channel_is_scalar.any())
    if moment is not None:
        fields = fields + field(array.positions, SOURCE, moment)
    return array.readings_of(fields) + rng.normal(size=(n, array.n_channels)) * array.channel_noise_T


@pytest.fixture(scope="module")
def detector() -> MatchedFilterDetector:
    return MatchedFilterDetector.of(ARRAY, 2e-2, n_draws=6_000, rng=3)


class TestEnergyThreshold:
    @pytest.mark.parametrize(("n", "rate"), [(3, 0.1), (9, 1e-3), (21, 1e-5)])
    def test_is_the_quantile_of_chi2(self, n, rate):
        assert energy_threshold(n, rate) == pytest.approx(stats.chi2.isf(rate, n), rel=1e-12)

    @pytest.mark.parametrize("array", [ARRAY, SCALARS])
    def test_false_alarms_are_binomial(self, array):
        """0.2 % of correct implementations fail."""
        matched = DipoleFilter(array)
        n, rate = 20_000, 1e-2
        energy = matched.energy(matched.whitened(readings(array, n, 1)))
        false_alarms = np.sum(energy > energy_threshold(matched.n_differences, rate))
        low, high = stats.binom.ppf([1e-3, 1.0 - 1e-3], n, rate)
        assert low <= false_alarms <= high

    @pytest.mark.parametrize(("n", "rate"), [(0, 1e-3), (9, 0.0), (9, 1.0)])
    def test_misuse(self, n, rate):
        with pytest.raises(ValueError, match=r"Input (n_differences|false_alarm_rate) must be"):
            energy_threshold(n, rate)


def energy_at(matched, whitened, position_m):
    """Energy of whitened readings (n, C) that a source at one position explains: (n,)."""
    components = whitened @ np.linalg.qr(matched.unit_signals(position_m)).Q
    return np.sum(components**2, axis=1)


class TestKnownPosition:
    def test_energy_is_noncentral_chi2(self):
        """The Kolmogorov-Smirnov test fails once in a thousand."""
        matched = DipoleFilter(ARRAY)
        signal = matched.signal(SOURCE, MOMENT)
        statistic = energy_at(matched, matched.whitened(readings(ARRAY, 4000, 2, MOMENT)), SOURCE)
        law = stats.ncx2(3, float(signal @ signal))
        assert stats.kstest(statistic, law.cdf).pvalue > 1e-3

    @pytest.mark.parametrize("energy", [0.0, 5.0, 25.0, 60.0])
    @pytest.mark.parametrize("dimensions", [3, 9])
    def test_probability_is_that_of_scipy(self, energy, dimensions):
        found = ChiSquareDetector(dimensions, 1e-3).probability(energy)
        law = stats.ncx2(dimensions, energy) if energy else stats.chi2(dimensions)
        assert found == pytest.approx(law.sf(stats.chi2.isf(1e-3, dimensions)), rel=1e-6)

    def test_required_energy_inverts_the_probability(self):
        detector = ChiSquareDetector(9, 1e-4)
        assert detector.probability(detector.required_energy(0.9)) == pytest.approx(0.9, rel=1e-9)

    def test_signal_is_that_of_the_differences(self):
        differences = decorrelated_differences(ARRAY)
        channels = field(ARRAY.positions, SOURCE, MOMENT).ravel()
        expected = np.sum((differences.transform @ channels) ** 2 / differences.variance)
        signal = DipoleFilter(ARRAY).signal(SOURCE, MOMENT)
        assert signal @ signal == pytest.approx(expected, rel=1e-12)


class TestMatchedFilter:
    def test_is_the_largest_energy_over_all_positions(self):
        """A simplex search by scipy, from the source and from other positions, finds the same and never more."""
        matched = DipoleFilter(ARRAY)
        whitened = matched.whitened(readings(ARRAY, 4, 4, 0.5 * MOMENT))
        statistic = matched.largest_energy(whitened)
        rng = np.random.default_rng(5)
        for row, found in zip(whitened, statistic, strict=True):
            starts = [SOURCE, *(rng.normal(size=(5, 3)) * rng.uniform(1.0, 8.0, (5, 1)))]
            others = [
                -minimize(
                    lambda p, row=row: -energy_at(matched, row[None], p)[0],
                    start,
                    method="Nelder-Mead",
                    options={"maxfev": 500},
                ).fun
                for start in starts
            ]
            assert found >= max(others) - 1e-6
            assert found == pytest.approx(max(others), rel=1e-3)

    def test_lies_between_a_known_position_and_all_energy(self):
        matched = DipoleFilter(SCALARS)
        whitened = matched.whitened(readings(SCALARS, 200, 6, 0.02 * MOMENT))
        largest = matched.largest_energy(whitened)
        assert np.all(largest <= matched.energy(whitened) * (1.0 + 1e-9))
        assert np.all(largest >= energy_at(matched, whitened, SOURCE) - 1e-3)

    def test_false_alarm_rate(self, detector):
        """Binomial bounds of 0.2 %, widened by three standard errors of the threshold itself."""
        n, rate = 6_000, detector.false_alarm_rate
        statistic = detector.filter.largest_energy(detector.filter.whitened(readings(ARRAY, n, 7)))
        low, high = stats.binom.ppf([1e-3, 1.0 - 1e-3], n, rate)
        assert np.sum(statistic > detector.threshold + 3.0 * detector.threshold_error) <= high
        assert np.sum(statistic > detector.threshold - 3.0 * detector.threshold_error) >= low
        assert detector.threshold_error < 0.3

    def test_screening_changes_nothing(self, detector):
        """The threshold comes from the loudest fifth of the draws alone: all of them give the same quantile."""
        noise = detector.filter.noise(6_000, np.random.default_rng(3))
        statistic = detector.filter.largest_energy(noise)
        assert detector.threshold == pytest.approx(np.sort(statistic)[-121], rel=1e-12)

    @pytest.mark.slow
    @pytest.mark.parametrize("array", [ARRAY, cube(1.0), SCALARS])
    def test_false_alarm_rate_of_one_in_a_thousand(self, array):
        """Binomial bounds of 0.2 %, widened by three standard errors of the threshold."""
        detector = MatchedFilterDetector.of(array)
        n = 200_000
        noise = detector.filter.noise(n, np.random.default_rng(8))
        low, high = stats.binom.ppf([1e-3, 1.0 - 1e-3], n, 1e-3)
        loud = noise[np.argsort(-detector.filter.candidate_energy(noise))[: n // 50]]
        statistic = detector.filter.largest_energy(loud)
        assert np.sum(statistic > detector.threshold + 3.0 * detector.threshold_error) <= high
        assert np.sum(statistic > detector.threshold - 3.0 * detector.threshold_error) >= low

    def test_required_energy_holds_near_and_far(self, detector):
        """Wherever the sources are, 0.9 becomes 0.87 to 0.93; the binomial error is 0.009."""
        energy = detector.required_energy(0.9, n_draws=2000)
        assert ChiSquareDetector(3, 2e-2).required_energy(0.9) < energy
        assert energy < 1.05 * ChiSquareDetector(9, 2e-2).required_energy(0.9)
        rng = np.random.default_rng(9)
        for radii in (1.5, 30.0):
            direction = rng.normal(size=(1200, 3))
            direction *= radii * ARRAY.circumradius / np.linalg.norm(direction, axis=1, keepdims=True)
            signals = detector.filter.signal(ARRAY.centroid + direction, rng.normal(size=(1200, 3)))
            signals *= np.sqrt(energy) / np.linalg.norm(signals, axis=1, keepdims=True)
            assert detector.probability(signals, rng) == pytest.approx(0.9, abs=0.03)

    def test_detects_raw_readings(self, detector):
        assert detector.detects(readings(ARRAY, 50, 10, 20.0 * MOMENT)).all()
        # 2 % of 500, and five standard deviations.
        assert detector.detects(readings(ARRAY, 500, 11)).sum() < 26

    def test_seed_makes_the_threshold(self):
        a, b, c = (MatchedFilterDetector.of(ARRAY, 0.1, n_draws=500, rng=seed).threshold for seed in (3, 3, 4))
        assert a == b != c


class TestDetectionRange:
    DIRECTIONS = np.array([[1.0, 0.0, 0.0], [0.0, 2.0, 1.0], [0.0, 0.0, -1.0]])

    @pytest.mark.parametrize("array", [ARRAY, square(0.4), hexagon(1.0)])
    def test_brentq_finds_the_same(self, array):
        detector = ChiSquareDetector(3)
        moments = 100.0 * fibonacci_directions(7)
        found = detection_ranges(array, self.DIRECTIONS, moments, detector)
        matched = DipoleFilter(array)
        required = stats.chi2.isf(1e-3, 3)
        for i, direction in enumerate(self.DIRECTIONS):
            unit = direction / np.linalg.norm(direction)
            for j, moment in enumerate(moments):

                def miss(r: float, unit=unit, moment=moment) -> float:
                    signal = matched.signal(array.centroid + r * unit, moment)
                    return float(stats.ncx2.sf(required, 3, signal @ signal)) - 0.9

                assert found[i, j] == pytest.approx(brentq(miss, 2.0 * array.circumradius, 60.0), rel=1e-4)

    def test_far_field_law(self):
        """Differences fall as r⁻⁴, but for terms of the order radius/r = 0.01: 16 times the moment, twice as far."""
        near, far = (
            detection_ranges(ARRAY, self.DIRECTIONS, size * fibonacci_directions(200), ChiSquareDetector(9))
            for size in (1e6, 16e6)
        )
        np.testing.assert_allclose(far / near, 2.0, rtol=2e-3)

    def test_detectors_are_in_order(self, detector):
        ranges = [
            np.median(detection_ranges(ARRAY, self.DIRECTIONS, 100.0 * fibonacci_directions(50), one))
            for one in (ChiSquareDetector(9, 2e-2), detector, ChiSquareDetector(3, 2e-2))
        ]
        assert ranges[0] < 1.005 * ranges[1]
        assert ranges[1] < ranges[2]

    def test_moment_too_weak(self):
        assert np.all(detection_ranges(ARRAY, self.DIRECTIONS, 1e-6 * np.eye(3), ChiSquareDetector(9)) == 0.0)

    @pytest.mark.parametrize(
        ("directions", "moments", "probability", "name"),
        [
            ([[0.0, 0.0, 0.0]], [[1.0, 0.0, 0.0]], 0.9, "directions"),
            ([1.0, 0.0, 0.0], [[1.0, 0.0, 0.0]], 0.9, "directions"),
            ([[1.0, 0.0, 0.0]], [1.0, 0.0, 0.0], 0.9, "moments_Am2"),
            ([[1.0, 0.0, 0.0]], [[np.nan, 0.0, 0.0]], 0.9, "moments_Am2"),
            ([[1.0, 0.0, 0.0]], [[1.0, 0.0, 0.0]], 1e-4, "probability"),
        ],
    )
    def test_misuse(self, directions, moments, probability, name):
        with pytest.raises(ValueError, match=f"Input {name} must be"):
            detection_ranges(ARRAY, directions, moments, ChiSquareDetector(9), probability=probability)


class TestMisuse:
    def test_too_few_differences(self):
        few = replace(square(1.0, "scalar"), ambient_T=(0.0, 0.0, 5e-5))
        with pytest.raises(ValueError, match="6 independent differences"):
            MatchedFilterDetector.of(few)
        assert detection_ranges(few, [[0.0, 0.0, 1.0]], 100.0 * np.eye(3), ChiSquareDetector(3)).shape == (1, 3)
        with pytest.raises(ValueError, match="3 independent differences"):
            DipoleFilter(replace(few, sensors=few.sensors[:3]))

    def test_moduli_without_ambient_field(self):
        with pytest.raises(ValueError, match="ambient field"):
            DipoleFilter(cube(1.0, "scalar"))

    def test_missing_readings(self):
        raw = readings(ARRAY, 2, 19)
        raw[1, 3] = np.nan
        with pytest.raises(ValueError, match="23 numbers are finite"):
            DipoleFilter(ARRAY).whitened(raw)

    def test_too_few_draws(self):
        with pytest.raises(ValueError, match="Input n_draws must be at least 10000"):
            MatchedFilterDetector.of(ARRAY, 1e-3, n_draws=5000)
