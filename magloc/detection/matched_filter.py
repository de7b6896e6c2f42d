"""Matched-filter detector, with its threshold and its detection probability from simulated noise.

The distribution of the largest energy over all positions has no closed form. Its threshold is an order statistic of
simulated noise. Only the draws with the largest candidate energies are refined, because the others stay below it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq

from arrays.array import SensorArray
from arrays.io.values import accept_seed, seed_of
from arrays.typing import FloatArray, Rng
from magloc.chi_square import ChiSquareDetector, check_differences, check_probability, check_share
from magloc.detection.dipole_filter import DipoleFilter
from magloc.directions import fibonacci_directions
from magloc.levels import FALSE_ALARM

N_UNKNOWNS = 6
# Draws that are refined, as a multiple of those above the threshold.
_SCREENED = 10.0
_DRAWS_AT_ONCE = 50_000
# Distance, in circumradii, of the sources that a required energy is simulated with.
_FAR = 5.0


@dataclass(frozen=True)
class MatchedFilterDetector:
    """Matched filter of an array, with a threshold from simulated noise.

    Attributes
    ----------
    filter : DipoleFilter
        Matched filter of the array.
    threshold : float
        Energy [1] above which a source is reported.
    threshold_error : float
        Standard error of the threshold, from the neighbouring order statistics.
    false_alarm_rate : float
        Share of rows of noise alone whose energy is larger.
    seed : int
        Seed of the draws for the threshold and for required energies.

    Examples
    --------
    >>> import arrays
    >>> import magloc
    >>> array = arrays.tetrahedron(1.5)
    >>> detector = magloc.MatchedFilterDetector.of(array, 0.01, n_draws=2000)
    >>> detector.false_alarm_rate
    0.01
    """

    filter: DipoleFilter
    threshold: float
    threshold_error: float
    false_alarm_rate: float
    seed: int

    @classmethod
    @accept_seed
    def of(
        cls, array: SensorArray, false_alarm_rate: float = FALSE_ALARM, *, n_draws: int = 100_000, rng: Rng = 0
    ) -> MatchedFilterDetector:
        """Return the detector with a given false-alarm rate.

        Parameters
        ----------
        n_draws : int
            Number of simulated rows of noise. With n_draws = 100 / rate the rate is accurate to a tenth.

        rng : int or numpy.random.Generator
            Seed or generator of the noise.

        Raises
        ------
        ValueError
            There are fewer than ten exceedances, the array gives fewer than six differences, or it has scalar sensors
            without an ambient field.
        """
        check_share("false_alarm_rate", false_alarm_rate)
        n_above = round(false_alarm_rate * n_draws)
        if n_above < 10:
            raise ValueError(
                f"Input n_draws must be at least {10.0 / false_alarm_rate:.0f} for a false-alarm rate of"
                f" {false_alarm_rate:g}; instead received {n_draws}."
            )
        matched = DipoleFilter(array)
        check_differences(matched.n_differences, N_UNKNOWNS, "a position and a moment")
        seed = seed_of(rng)
        generator = np.random.default_rng(seed)
        noise = np.concatenate(
            [
                _loudest(matched, generator, n, min(1.0, _SCREENED * false_alarm_rate))
                for n in _parts(n_draws, _DRAWS_AT_ONCE)
            ]
        )
        statistic = np.sort(matched.largest_energy(noise))[::-1]
        spread = max(1, round(np.sqrt(n_above)))
        low, high = statistic[min(n_above + spread, statistic.size - 1)], statistic[max(n_above - spread, 0)]
        return cls(matched, float(statistic[n_above]), float(0.5 * (high - low)), false_alarm_rate, seed)

    def detects(self, readings_T: ArrayLike) -> NDArray[np.bool_]:
        """Return whether each set of raw readings (n, C) [T] has a source: (n,)."""
        return self.filter.largest_energy(self.filter.whitened(readings_T)) > self.threshold

    def probability(self, signals: FloatArray, rng: np.random.Generator) -> float:
        """Return the share of whitened signals (n, C) that are detected, with one draw of noise each."""
        return float(np.mean(self._above(signals + self.filter.noise(len(signals), rng))))

    def required_energy(self, probability: float, *, n_draws: int = 4_000) -> float:
        """Return the energy of a signal that is found with a probability, averaged over directions and moments.

        Parameters
        ----------
        probability : float
            Probability of detection, above the false-alarm rate.
        n_draws : int
            Number of sources and rows of noise in the simulation.

        Returns
        -------
        float
            Energy in units of the noise variance. It hardly depends on the position of the source; a test states how
            much it does.
        """
        check_probability(probability, self.false_alarm_rate)
        rng = np.random.default_rng([self.seed, 1])
        array = self.filter.array
        directions = fibonacci_directions(n_draws)
        moments = rng.normal(size=(n_draws, 3))
        signals = self.filter.signal(array.centroid + _FAR * array.circumradius * directions, moments)
        unit = signals / np.linalg.norm(signals, axis=1, keepdims=True)
        noise = self.filter.noise(n_draws, rng)

        @cache  # brentq evaluates both ends once more
        def surplus(amplitude: float) -> float:
            return float(np.mean(self._above(amplitude * unit + noise))) - probability

        high = np.sqrt(ChiSquareDetector(self.filter.n_differences, self.false_alarm_rate).required_energy(probability))
        while surplus(high) < 0.0:
            high *= 1.5
        # If the probability is hardly above the false-alarm rate, the draws may exceed it without a signal.
        return float(brentq(surplus, 0.0, high, xtol=1e-3)) ** 2 if surplus(0.0) < 0.0 else 0.0

    def _above(self, whitened: FloatArray) -> NDArray[np.bool_]:
        """Return which statistics are above the threshold; candidates and energy decide most."""
        above = self.filter.candidate_energy(whitened) > self.threshold
        open_ = np.flatnonzero(~above & (self.filter.energy(whitened) > self.threshold))
        if open_.size:
            above[open_] = self.filter.refined_energy(whitened[open_]) > self.threshold
        return above


def _loudest(matched: DipoleFilter, rng: np.random.Generator, n: int, share: float) -> FloatArray:
    """Return the share of n draws of noise with the largest candidate energies."""
    noise = matched.noise(n, rng)
    kept = max(1, round(share * n))
    return noise[np.argsort(-matched.candidate_energy(noise))[:kept]]


def _parts(n: int, most: int) -> list[int]:
    return [len(part) for part in np.array_split(np.empty(n), -(-n // most))]
