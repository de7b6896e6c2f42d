"""Readings of an array for one dipole, their Cramér-Rao bound, and fixes of simulated readings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chndtr

from arrays.array import SensorArray
from arrays.differences import Differences, decorrelated_differences
from arrays.io.errors import own_sentence
from arrays.noise import reading_covariance, reading_errors
from arrays.typing import FloatArray
from magloc.bounds.crlb import cramer_rao_bounds
from magloc.chi_square import energy_threshold
from magloc.localization.fit.results import Fix, is_observable, open_ended
from magloc.localization.locator import Locator
from magloc.localization.search.single_source import N_UNKNOWNS
from magloc.localization.uncertainty.range_interval import gaussian_ranges
from magloc.measurement.differences import DifferenceMeasurement, predicted_channels

_CERTAIN = 1e5  # squared signal-to-noise ratio that any array detects: an upper limit for the distribution


@dataclass(frozen=True, eq=False)
class Forecast:
    """Readings of a dipole, and the bound for its position and moment.

    Attributes
    ----------
    readings_T : ndarray, shape (C,)
        Noise-free readings, with ambient field and offsets [T].
    signal_T : ndarray, shape (C,)
        Part of the readings due to the dipole [T].
    signal_to_noise : float
        Root of the sum of squared whitened differences.
    detectable : bool
        Whether the probability of detection by a fix exceeds one half.
    covariance : ndarray, shape (6, 6), optional
        Cramér-Rao bound of (position, moment); None if the readings do not determine them.
    range_interval_m : tuple of (low, high)
        95 % interval of the distance from the sensors' centroid by the bound [m]; high is None if it is open.
    range_observable : bool
        Whether the interval is closed and its ends differ by at most a factor of two.
    reason : str
        Reason why there is no bound; empty if there is one.
    """

    readings_T: FloatArray
    signal_T: FloatArray
    signal_to_noise: float
    detectable: bool
    covariance: FloatArray | None = None
    range_interval_m: tuple[float, float | None] = (0.0, None)
    range_observable: bool = False
    reason: str = ""


class LiveFit:
    """Forecasts and fixes with one array, fast enough to follow a dragged dipole."""

    def __init__(self, array: SensorArray) -> None:
        self.array = array
        self._without_source = array.readings_of(array.ambient_fields)
        self._differences = decorrelated_differences(array)
        self._locator: Locator | None = None
        self._reason = ""
        try:
            self._locator = Locator(array, exclude_faulty=False)
        except ValueError as error:
            self._reason = own_sentence(error).rstrip(".")

    def forecast(self, position_m: ArrayLike, moment_Am2: ArrayLike) -> Forecast:
        """Return the readings of a dipole, NaN for a sensor at its position, and their bound."""
        array = self.array
        readings = predicted_channels(array, position_m, moment_Am2) + array.channel_offset_T
        signal = readings - self._without_source
        if not np.isfinite(readings).all():
            sensor = array.ids[int(array.channel_sensor[np.isnan(readings).argmax()])]
            return Forecast(readings, signal, np.nan, False, reason=f"the dipole stands on sensor {sensor}")
        measurement = DifferenceMeasurement(array, self._differences_at(readings))
        whitened = measurement.differences.transform @ signal / np.sqrt(measurement.variance)
        energy, k = float(whitened @ whitened), whitened.size
        detectable = k > 0 and float(chndtr(energy_threshold(k), k, min(energy, _CERTAIN))) < 0.5
        if k < N_UNKNOWNS:
            reason = f"the array gives {k} independent differences, {N_UNKNOWNS} are needed"
            return Forecast(readings, signal, energy**0.5, detectable, reason=reason)
        bounds = cramer_rao_bounds(array, position_m, moment_Am2)
        if not bounds.is_regular:
            return Forecast(readings, signal, energy**0.5, detectable, reason=_singularity_reason(moment_Am2))
        offset_m = np.asarray(position_m) - array.centroid
        low, high = gaussian_ranges(bounds.covariance, offset_m, array.circumradius).tolist()
        return Forecast(
            readings,
            signal,
            energy**0.5,
            detectable,
            bounds.covariance,
            open_ended(low, high),
            is_observable(low, high),
        )

    def simulate(self, readings_T: FloatArray, seed: int) -> FloatArray:
        """Return the readings with one draw of the array's noise, shape (C,) [T]."""
        normal = np.random.default_rng(seed).standard_normal(self.array.n_channels)
        return readings_T + reading_errors(self.array, readings_T, normal)

    def fix(self, readings_T: FloatArray) -> Fix:
        """Return the fix of one row of readings (C,) [T], without a start."""
        if self._locator is None:
            return Fix((), self._reason)
        if not np.isfinite(readings_T).all():
            return Fix((), "the readings are not finite")
        return self._locator.fit(readings_T)

    def _differences_at(self, readings_T: FloatArray) -> Differences:
        if not self.array.noise_depends_on_reading:
            return self._differences
        return decorrelated_differences(self.array, covariance_T2=reading_covariance(self.array, readings_T))


def _singularity_reason(moment_Am2: ArrayLike) -> str:
    if not np.any(moment_Am2):
        return "a dipole without a moment has no signal"
    return "the differences between the sensors do not determine the source"
