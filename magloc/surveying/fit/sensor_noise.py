"""White noise of the sensors of a survey, as stated and as measured."""

from __future__ import annotations

import logging
from dataclasses import replace

from arrays.array import SensorArray
from arrays.typing import FloatArray
from magloc.measurement.nuisances import without_lasting_errors
from magloc.measurement.plausibility import noise_ratio
from magloc.readings import Readings

_LOG = logging.getLogger(__name__)
NOISY = 2.0
"""Least ratio of measured to stated noise that is significant."""


def white_noise_T(array: SensorArray) -> FloatArray:
    """Return the stated noise of each channel (C,) that is independent from row to row."""
    return without_lasting_errors(array).channel_noise_T


def with_measured_noise(array: SensorArray, readings: Readings) -> SensorArray:
    """Return the array with the noise of whole rows where that exceeds the stated noise."""
    ratio = noise_ratio(array, readings.values_T)
    if not ratio > NOISY:
        return array
    sensors = tuple(replace(sensor, noise_T=ratio * sensor.noise_T) for sensor in array.sensors)
    words = dict.fromkeys(f"{1e9 * sensor.noise_T:.2g}" for sensor in sensors)
    _LOG.warning(
        f"the readings change from row to row by {ratio:.2g} times the stated noise: taken into account. State noise_nT"
        f" = {', '.join(words)}"
    )
    return replace(array, sensors=sensors)
