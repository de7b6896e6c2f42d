"""χ² tests: thresholds of detection, and bounds of means."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import chdtri, chndtr, chndtrinc

from arrays.io.csv import Column
from arrays.typing import BoolArray, FloatArray, IntArray
from magloc.levels import CONSISTENCY, FALSE_ALARM


def mean_bounds(degrees_of_freedom: int, level: float = CONSISTENCY) -> tuple[float, float]:
    """Return two-sided bounds of χ² divided by its degrees of freedom."""
    if degrees_of_freedom <= 0:
        return math.nan, math.nan
    tail = 0.5 * (1.0 - level)
    low, high = chdtri(degrees_of_freedom, 1.0 - tail), chdtri(degrees_of_freedom, tail)
    return float(low) / degrees_of_freedom, float(high) / degrees_of_freedom


def bounds99(degrees_of_freedom: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return two-sided 99 % bounds of χ² divided by its degrees of freedom; NaN without any."""
    dof = np.asarray(degrees_of_freedom, dtype=np.float64)
    known = np.where(dof > 0.0, dof, np.nan)
    return chdtri(known, 0.995) / known, chdtri(known, 0.005) / known


def exceeds(chi2: FloatArray, dof: IntArray, probability: float) -> BoolArray:
    """Return whether each χ² is above the quantile that noise exceeds with a probability; False for dof = 0."""
    largest = np.full(dof.shape, np.inf)
    for n in set(dof.tolist()):  # The quantile is the slow part of a test, and most rows have the same number.
        largest[dof == n] = quantile(n, probability)
    return np.asarray(chi2 > largest)


@lru_cache(maxsize=256)
def quantile(dof: int, probability: float) -> float:
    """Return the χ² that noise exceeds with a probability; infinite where there is no degree of freedom."""
    return float(chdtri(dof, probability)) if dof > 0 else math.inf


def square_columns(name: str, square: FloatArray, dof: NDArray[np.int64]) -> dict[str, Column]:
    """Return columns of a normalised square, its degrees of freedom, and its 99 % bounds."""
    low, high = bounds99(dof)
    prefix = "" if name == "chi2" else f"{name}_"
    return {name: square, f"{prefix}dof": dof, f"{name}_low99": low * dof, f"{name}_high99": high * dof}


def normalised_square(error: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return normalised squared errors (...) of errors (..., N) with covariances (..., N, N).

    They follow χ² with N degrees of freedom if the covariance is right. NaN if the matrix is not a valid covariance, as
    after a filter has diverged.
    """
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        scaled, solved = _solved(covariance, error[..., None])
        return np.asarray(np.sum(scaled * solved, axis=(-2, -1)))


def error_factor(claimed: FloatArray, added: FloatArray) -> FloatArray:
    """Return the rms ratio of true to claimed standard deviations if errors have an added covariance (..., N, N).

    NaN if the claimed matrix is not a valid covariance.
    """
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        sigma = np.sqrt(np.diagonal(claimed, axis1=-2, axis2=-1))
        _, ratio = _solved(claimed, added / sigma[..., None, :])
        return np.asarray(np.sqrt(1.0 + np.trace(ratio, axis1=-2, axis2=-1) / claimed.shape[-1]))


def _solved(covariance: FloatArray, columns: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return columns (..., N, n) over the standard deviations, and their product with the inverse correlations.

    States have mixed units, but their correlations are well-conditioned. NaN if the matrix is not a valid covariance.
    """
    sigma = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
    correlation = covariance / (sigma[..., :, None] * sigma[..., None, :])
    scaled = columns / sigma[..., None]
    try:
        return scaled, np.asarray(np.linalg.solve(correlation, scaled), dtype=np.float64)
    except np.linalg.LinAlgError:
        regular = np.linalg.slogdet(correlation).sign > 0.0
        correlation = np.where(regular[..., None, None], correlation, np.nan)
        return scaled, np.asarray(np.linalg.solve(correlation, scaled), dtype=np.float64)


class Detector(Protocol):
    """A test for a source: a threshold, and the energy that a signal needs to exceed it."""

    @property
    def threshold(self) -> float:
        """Value of the statistic above which a source is reported."""

    def required_energy(self, probability: float) -> float:
        """Return the energy of a signal, in units of the noise variance, that is found with a probability."""


def energy_threshold(n_differences: int, false_alarm_rate: float = FALSE_ALARM) -> float:
    r"""Return the energy that k whitened differences of noise alone exceed with a given rate.

    It is a quantile of :math:`\|z'\|^2 \sim \chi^2_k`.
    """
    if n_differences < 1:
        raise ValueError(f"Input n_differences must be at least 1; instead received {n_differences}.")
    check_share("false_alarm_rate", false_alarm_rate)
    return quantile(n_differences, false_alarm_rate)


@dataclass(frozen=True)
class ChiSquareDetector:
    r"""Energy detector in a known space: all differences, or the moments of a source at a known position.

    Attributes
    ----------
    n_dimensions : int
        Dimensions of the space: the number of differences, or 3.
    """

    n_dimensions: int
    false_alarm_rate: float = FALSE_ALARM

    @property
    def threshold(self) -> float:
        """Value of the energy above which a source is reported."""
        return energy_threshold(self.n_dimensions, self.false_alarm_rate)

    def probability(self, signal_energy: ArrayLike) -> FloatArray:
        """Return the probability of detection (noncentral χ²) of signal energies in units of the noise variance."""
        energy = np.asarray(signal_energy, dtype=np.float64)
        return 1.0 - chndtr(self.threshold, float(self.n_dimensions), energy)

    def required_energy(self, probability: float) -> float:
        """Return the energy of a signal, in units of the noise variance, that is found with a probability.

        The probability must be above the false-alarm rate.
        """
        check_probability(probability, self.false_alarm_rate)
        return float(chndtrinc(self.threshold, float(self.n_dimensions), 1.0 - probability))


def check_differences(n: int, least: int, what: str) -> None:
    """Raise ValueError if an array gives fewer than the least number of independent differences."""
    if n < least:
        raise ValueError(
            f"Input array must give at least {least} independent differences for {what}; instead it gives {n}."
        )


def check_share(name: str, value: float) -> None:
    """Raise ValueError if a share is not between 0 and 1."""
    if not 0.0 < value < 1.0:
        raise ValueError(f"Input {name} must be between 0 and 1; instead received {value}.")


def check_probability(probability: float, false_alarm_rate: float) -> None:
    """Raise ValueError if a probability of detection is not between the false-alarm rate and 1."""
    if not false_alarm_rate < probability < 1.0:
        raise ValueError(
            f"Input probability must be between the false-alarm rate {false_alarm_rate:g} and 1;"
            f" instead received {probability}."
        )
