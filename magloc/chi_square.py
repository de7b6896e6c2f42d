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
    """Two-sided bounds of a χ² over its degrees of freedom."""
    if degrees_of_freedom <= 0:
        return math.nan, math.nan
    tail = 0.5 * (1.0 - level)
    low, high = chdtri(degrees_of_freedom, 1.0 - tail), chdtri(degrees_of_freedom, tail)
    return float(low) / degrees_of_freedom, float(high) / degrees_of_freedom


def bounds99(degrees_of_freedom: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Two-sided 99 % bounds of χ² over its degrees of freedom; NaN where there are none."""
    dof = np.asarray(degrees_of_freedom, dtype=np.float64)
    known = np.where(dof > 0.0, dof, np.nan)
    return chdtri(known, 0.995) / known, chdtri(known, 0.005) / known


def exceeds(chi2: FloatArray, dof: IntArray, probability: float) -> BoolArray:
    """Return whether each χ² is above the quantile that noise exceeds with a probability; False for dof = 0."""
    largest = np.full(dof.shape, np.inf)
    for n in set(dof.tolist()):  # inverse distributions take longer than all else of a test, and rows are alike
        largest[dof == n] = quantile(n, probability)
    return np.asarray(chi2 > largest)


@lru_cache(maxsize=256)
def quantile(dof: int, probability: float) -> float:
    """Return the χ² that noise exceeds with a probability; infinite where there is no degree of freedom."""
    return float(chdtri(dof, probability)) if dof > 0 else math.inf


def square_columns(name: str, square: FloatArray, dof: NDArray[np.int64]) -> dict[str, Column]:
    """Columns of a normalised square, its degrees of freedom, and its 99 % bounds."""
    low, high = bounds99(dof)
    prefix = "" if name == "chi2" else f"{name}_"
    return {name: square, f"{prefix}dof": dof, f"{name}_low99": low * dof, f"{name}_high99": high * dof}


def normalised_square(error: FloatArray, covariance: FloatArray) -> FloatArray:
    """Squared errors (..., N) in units of a covariance (..., N, N), shape (...): χ² of N numbers where it is right.

    NaN where the covariance is none, as that of a filter that has diverged.
    """
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        scaled, solved = _solved(covariance, error[..., None])
        return np.asarray(np.sum(scaled * solved, axis=(-2, -1)))


def error_factor(claimed: FloatArray, added: FloatArray) -> FloatArray:
    """How many times their standard deviations errors are, rms, where a covariance (..., N, N) is added to theirs.

    NaN where the claimed covariance is none.
    """
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        sigma = np.sqrt(np.diagonal(claimed, axis1=-2, axis2=-1))
        _, ratio = _solved(claimed, added / sigma[..., None, :])
        return np.asarray(np.sqrt(1.0 + np.trace(ratio, axis1=-2, axis2=-1) / claimed.shape[-1]))


def _solved(covariance: FloatArray, columns: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Columns (..., N, n) in units of standard deviations, and multiplied by the inverse of the correlations.

    States have mixed units: their correlations are well-conditioned. NaN where the covariance is none.
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
    """A statistic with a threshold, and the energy of a signal that it finds."""

    @property
    def threshold(self) -> float:
        """Value of the statistic above which there is a source."""

    def required_energy(self, probability: float) -> float:
        """Energy of a signal, in units of the noise's variance, that is found with a probability."""


def energy_threshold(n_differences: int, false_alarm_rate: float = FALSE_ALARM) -> float:
    r"""Quantile of :math:`\|z'\|^2 \sim \chi^2_k`: energy of k whitened differences that noise exceeds at a rate."""
    if n_differences < 1:
        raise ValueError(f"Input n_differences must be at least 1; instead received {n_differences}.")
    check_share("false_alarm_rate", false_alarm_rate)
    return quantile(n_differences, false_alarm_rate)


@dataclass(frozen=True)
class ChiSquareDetector:
    r"""Energy in a space that is known beforehand: all differences, or the moments of a source of known position.

    Attributes
    ----------
    n_dimensions : int
        Dimensions of the space: the number of differences, or 3.
    """

    n_dimensions: int
    false_alarm_rate: float = FALSE_ALARM

    @property
    def threshold(self) -> float:
        """Value of the energy above which there is a source."""
        return energy_threshold(self.n_dimensions, self.false_alarm_rate)

    def probability(self, signal_energy: ArrayLike) -> FloatArray:
        """Probability of detection: noncentral χ² beyond the threshold, for energies in units of the noise."""
        energy = np.asarray(signal_energy, dtype=np.float64)
        return 1.0 - chndtr(self.threshold, float(self.n_dimensions), energy)

    def required_energy(self, probability: float) -> float:
        """Energy, in units of the noise, of a signal that is found with a probability above the false-alarm rate."""
        check_probability(probability, self.false_alarm_rate)
        return float(chndtrinc(self.threshold, float(self.n_dimensions), 1.0 - probability))


def check_differences(n: int, least: int, what: str) -> None:
    """Refuse an array that gives fewer than the least number of differences for what is wanted."""
    if n < least:
        raise ValueError(
            f"Input array must give {least} independent differences at least for {what}; instead it gives {n}."
        )


def check_share(name: str, value: float) -> None:
    """Refuse a share that is not between 0 and 1."""
    if not 0.0 < value < 1.0:
        raise ValueError(f"Input {name} must be between 0 and 1; instead received {value}.")


def check_probability(probability: float, false_alarm_rate: float) -> None:
    """Refuse a probability of detection that noise alone reaches."""
    if not false_alarm_rate < probability < 1.0:
        raise ValueError(
            f"Input probability must be between the false-alarm rate {false_alarm_rate:g} and 1;"
            f" instead received {probability}."
        )
