r"""Is there a source at all? Detection statistics of readings, their thresholds and how often they find a source.

In units of its noise, a set of independent differences z' is standard normal without a source. Three statistics:

========================  =================================================================  ==========================
energy                    :math:`\|z'\|^2`                                                   :math:`\chi^2_k`
known position            energy in the space of the moments of a dipole at p, 3-dimensional :math:`\chi^2_3`
matched filter            the same, at the position where it is largest                      no closed form: simulated
========================  =================================================================  ==========================

With a source the first two are noncentral :math:`\chi^2`, their noncentrality the energy of its signal. The matched
filter is the generalised likelihood ratio, χ² without a source less χ² of the best one. Its many positions let noise
find something more often, but fewer dimensions collect noise than in the energy.

Signals are linear in the moment. Moduli are so where the ambient field is large against the source's, which a source
that is hard to detect fulfils; they need an ambient field.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import chdtri, chndtr, chndtrinc

from arrays.differences import Whitening, whitening
from arrays.sensor import SensorArray
from magloc import dipole
from magloc.joint import JointProblem
from magloc.kernels import over_rows
from magloc.kernels.separable import search_rows
from magloc.separable import candidate_positions
from magloc.starts import SingleArray, linear_bases, linear_scores

FloatArray = NDArray[np.float64]

FALSE_ALARM = 1e-3
# As Locator searches: starts of every refinement, least angle between them, linearisations at most.
_N_STARTS, _APART_RAD, _MOST_ITERATIONS = 6, 0.3, 100
_ROWS_AT_ONCE = 4096


class Detector(Protocol):
    """A statistic with a threshold, and the energy of a signal that it finds."""

    @property
    def threshold(self) -> float:
        """Value of the statistic above which there is a source."""

    def required_energy(self, probability: float) -> float:
        """Energy of a signal, in units of the noise's variance, that is found with a probability."""


def energy_threshold(n_differences: int, false_alarm_rate: float = FALSE_ALARM) -> float:
    r"""Energy of the whitened differences that noise alone exceeds at a given rate.

    Parameters
    ----------
    n_differences : int
        Number of independent differences k.
    false_alarm_rate : float
        Share of the sets of readings without a source that exceed the threshold.

    Returns
    -------
    float
        Quantile of :math:`\|z'\|^2 \sim \chi^2_k`, every difference in units of its noise.

    Raises
    ------
    ValueError
        There is no difference, or the rate is not between 0 and 1.
    """
    if n_differences < 1:
        raise ValueError(f"Input n_differences must be at least 1; instead received {n_differences}.")
    check_share("false_alarm_rate", false_alarm_rate)
    return float(chdtri(n_differences, false_alarm_rate))


@dataclass(frozen=True)
class ChiSquareDetector:
    r"""Energy in a space that is known beforehand: all differences, or the moments of a source of known position.

    Attributes
    ----------
    n_dimensions : int
        Dimensions of the space: the number of differences, or 3.
    false_alarm_rate : float
    """

    n_dimensions: int
    false_alarm_rate: float = FALSE_ALARM

    @property
    def threshold(self) -> float:
        """Value of the energy above which there is a source."""
        return energy_threshold(self.n_dimensions, self.false_alarm_rate)

    def probability(self, signal_energy: ArrayLike) -> FloatArray:
        """Probability of detection: the noncentral χ² beyond the threshold.

        Parameters
        ----------
        signal_energy : array_like
            Of the noise-free differences, in units of the noise's variance.

        Returns
        -------
        ndarray
        """
        energy = np.asarray(signal_energy, dtype=np.float64)
        found: FloatArray = 1.0 - chndtr(self.threshold, float(self.n_dimensions), energy)
        return found

    def required_energy(self, probability: float) -> float:
        """Energy of a signal that is found with a probability.

        Parameters
        ----------
        probability : float
            Above the false-alarm rate.

        Returns
        -------
        float
            In units of the noise's variance.
        """
        check_probability(probability, self.false_alarm_rate)
        return float(chndtrinc(self.threshold, float(self.n_dimensions), 1.0 - probability))


class DipoleFilter:
    """Detection statistics of one array's readings.

    Parameters
    ----------
    array : SensorArray
        Scalar sensors need its ambient field. Its noise is that without a source: `noise_fraction` does not count.

    Raises
    ------
    ValueError
        The array gives fewer than three differences, or has scalar sensors without an ambient field.
    """

    def __init__(self, array: SensorArray) -> None:
        self.array = array
        self.whitening: Whitening = whitening(array)
        check_differences(self.whitening.n_differences, 3, "the three components of a moment")
        self._problem = JointProblem.of(array, [self.whitening], array.ambient_fields[None])
        self._gain: FloatArray = self._problem.linear_gain(np.zeros((1, array.n_sensors, 3)))[0]
        if not np.any(self._gain[array.channel_is_scalar]) and array.channel_is_scalar.any():
            raise ValueError("Input array must have an ambient field for its scalar sensors; instead it has none.")
        self._without_source: FloatArray = array.readings_of(array.ambient_fields)

    @property
    def n_differences(self) -> int:
        """Number of independent differences."""
        return self.whitening.n_differences

    @cached_property
    def _candidates(self) -> FloatArray:
        return self._problem.homogeneous(candidate_positions(self.array))

    @cached_property
    def _bases(self) -> SingleArray:
        return linear_bases(self._problem, self._gain, 0, self._candidates)

    def whitened(self, readings_T: ArrayLike) -> FloatArray:
        """Readings as an orthogonal transform of the whitened differences.

        Parameters
        ----------
        readings_T : array_like, shape (n, C)
            Raw readings of all channels [T].

        Returns
        -------
        ndarray, shape (n, C)
            In units of the noise.

        Raises
        ------
        ValueError
            They have another shape, or some are missing.
        """
        readings = np.asarray(readings_T, dtype=np.float64)
        if readings.ndim != 2 or readings.shape[1] != self.array.n_channels or not np.isfinite(readings).all():
            raise ValueError(
                f"Input readings_T must be finite numbers of shape (n, {self.array.n_channels}); instead received shape"
                f" {readings.shape}, of which {int(np.isfinite(readings).sum())} numbers are finite."
            )
        return self.whitening.apply(readings - self._without_source)

    def noise(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Whitened noise of n sets of readings, shape (n, C)."""
        w = self.whitening
        unknown = w.basis[:, w.shrinkage == 1.0]
        draws = rng.normal(size=(n, self.array.n_channels))
        free: FloatArray = draws - draws @ unknown @ unknown.T
        return free

    def signal(self, position_m: ArrayLike, moment_Am2: ArrayLike) -> FloatArray:
        """Whitened signals of sources (..., 3), noise-free: (..., C)."""
        signal: FloatArray = np.einsum("...cj,...j->...c", self.unit_signals(position_m), np.asarray(moment_Am2))
        return signal

    def unit_signals(self, position_m: ArrayLike) -> FloatArray:
        """Whitened signals of the three unit moments at positions (..., 3) [m].

        Parameters
        ----------
        position_m : array_like, shape (..., 3)

        Returns
        -------
        ndarray, shape (..., C, 3)
            [1/(A·m²)]. Of a product with its own transpose the eigenvalues are the energies of the best, the middle and
            the worst moment of 1 A·m².
        """
        position = np.asarray(position_m, dtype=np.float64)[..., None, :]
        fields = dipole.field_matrix(self.array.positions, position)[..., self.array.channel_sensor, :, :]
        rows = np.einsum("cj,...cjk->...ck", self._gain, fields)
        w = self.whitening
        free: FloatArray = rows - (w.basis * w.shrinkage) @ (w.basis.T @ rows)
        return free

    def energy(self, whitened: FloatArray) -> FloatArray:
        """Energy of whitened readings (n, C), χ² without a source: (n,)."""
        energy: FloatArray = np.einsum("nc,nc->n", whitened, whitened)
        return energy

    def energy_at(self, whitened: FloatArray, position_m: ArrayLike) -> FloatArray:
        """Energy of whitened readings (n, C) that a source at one position (3,) [m] explains: (n,)."""
        orthonormal = np.linalg.qr(self.unit_signals(position_m)).Q
        components = whitened @ orthonormal
        energy: FloatArray = np.einsum("nj,nj->n", components, components)
        return energy

    def candidate_energy(self, whitened: FloatArray) -> FloatArray:
        """Energy of whitened readings (n, C) that the best of the candidate positions explains: (n,).

        A little below :meth:`largest_energy`, which refines the candidates, and a hundred times faster.
        """
        parts = np.array_split(whitened, -(-len(whitened) // _ROWS_AT_ONCE) or 1)
        return np.concatenate([linear_scores(self._bases, part).max(axis=1) for part in parts])

    def largest_energy(self, whitened: FloatArray) -> FloatArray:
        """Matched-filter statistic of whitened readings (n, C): the largest energy that a single source explains.

        Parameters
        ----------
        whitened : ndarray, shape (n, C)

        Returns
        -------
        ndarray, shape (n,)
            The generalised likelihood ratio, χ² without a source less χ² of the best source anywhere.
        """
        n = len(whitened)
        w, problem = self.whitening, self._problem
        y = np.ascontiguousarray(whitened)
        q, mu, chi2 = np.empty((n, _N_STARTS, 4)), np.empty((n, _N_STARTS, 3)), np.full((n, _N_STARTS), np.inf)
        over_rows(
            search_rows,
            n,
            y,
            y,
            np.arange(n),
            self._bases,
            self._candidates,
            np.empty((n, 0, 4)),
            np.cos(_APART_RAD),
            np.inf,
            _MOST_ITERATIONS,
            problem.sensors,
            problem.channel_sensor,
            self._gain[None],
            np.ascontiguousarray(w.basis.T)[None],
            w.shrinkage[None],
            np.zeros(n, dtype=np.intp),
            q,
            mu,
            chi2,
            np.empty((n, _N_STARTS), dtype=np.int64),
            np.zeros((n, 3), dtype=np.int64),
        )
        # A candidate is a source too, where none of the refinements converged.
        best: FloatArray = np.maximum(self.energy(y) - chi2.min(axis=1), self.candidate_energy(y))
        return best


def receiver_operating_characteristic(
    without_source: ArrayLike, with_source: ArrayLike, false_alarm_rate: ArrayLike
) -> FloatArray:
    """Probability of detection at given false-alarm rates, from draws of any statistic.

    Parameters
    ----------
    without_source, with_source : array_like, shapes (n,) and (m,)
        The statistic of simulated readings.
    false_alarm_rate : array_like, shape (...)

    Returns
    -------
    ndarray, shape (...)
        Share of `with_source` above the quantile of `without_source`; its standard error is √(P (1 − P)/m), and that of
        the rate √(rate (1 − rate)/n).
    """
    thresholds = np.quantile(np.asarray(without_source), 1.0 - np.asarray(false_alarm_rate))
    sorted_ = np.sort(np.asarray(with_source))
    found: FloatArray = 1.0 - np.searchsorted(sorted_, thresholds, side="right") / sorted_.size
    return found


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
