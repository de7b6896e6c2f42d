"""Readings conditioned before they are tracked: trends, mains hum and slow fields taken out, windows averaged.

Filters run forwards and backwards over the whole record, so that nothing is delayed; they need rows at equal intervals
without gaps. A column with a missing reading is refused, not interpolated.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.signal import butter, iirnotch, sosfiltfilt, tf2sos

from arrays.array import SensorArray
from arrays.io.errors import InputError
from arrays.typing import FloatArray
from magloc.readings import Readings

_NOTCH_QUALITY = 30.0
_HIGH_PASS_ORDER = 2
_EQUAL_INTERVAL_RTOL = 1e-3


def detrended(readings: Readings) -> Readings:
    """Readings without each channel's straight line over the record, its mean kept.

    Raises
    ------
    InputError
        A channel has fewer than two readings.
    """
    values = readings.values_T.copy()
    time = readings.time_s - readings.time_s.mean()
    for column in range(values.shape[1]):
        known = np.isfinite(values[:, column])
        if known.sum() < 2:
            raise InputError(
                "found a channel with fewer than two readings, expected two at least to take its trend out."
            )
        t = time[known] - time[known].mean()
        values[known, column] -= t * (t @ values[known, column]) / (t @ t)
    return replace(readings, values_T=values)


def high_passed(readings: Readings, corner_Hz: float) -> Readings:
    """Readings without what changes more slowly than a corner frequency: a Butterworth filter of second order.

    Raises
    ------
    InputError
        The rows are not at equal intervals without gaps, or the corner is not below half their rate.
    """
    rate = _rate_Hz(readings, corner_Hz)
    return _filtered(readings, np.asarray(butter(_HIGH_PASS_ORDER, corner_Hz, "highpass", fs=rate, output="sos")))


def without_hum(readings: Readings, mains_Hz: float) -> Readings:
    """Readings without the mains frequency and those of its harmonics that the rate of the rows shows.

    Raises
    ------
    InputError
        The rows are not at equal intervals without gaps, or the mains frequency is not below half their rate.
    """
    rate = _rate_Hz(readings, mains_Hz)
    for harmonic in np.arange(mains_Hz, 0.5 * rate, mains_Hz):
        readings = _filtered(readings, np.asarray(tf2sos(*iirnotch(harmonic, _NOTCH_QUALITY, fs=rate))))
    return readings


def window_averages(readings: Readings, window_s: float) -> Readings:
    """Means of successive windows of time; the pose is that of the row in the middle.

    Parameters
    ----------
    readings : Readings
    window_s : float
        Length of a window [s].

    Returns
    -------
    Readings
        One row for each window that has one. A channel is missing where it is missing in the whole window.
    """
    window = np.floor((readings.time_s - readings.time_s[0]) / window_s + 1e-9).astype(np.intp)
    _, first, count = np.unique(window, return_index=True, return_counts=True)
    middle = first + count // 2
    known = np.isfinite(readings.values_T)
    total = np.add.reduceat(np.where(known, readings.values_T, 0.0), first)
    n_known = np.add.reduceat(known.astype(np.intp), first)
    with np.errstate(invalid="ignore"):
        values = total / n_known
    ambient = readings.ambient_T
    return Readings(
        time_s=np.add.reduceat(readings.time_s, first) / count,
        values_T=values,
        line_numbers=readings.line_numbers[middle],
        array_position_m=None if readings.array_position_m is None else readings.array_position_m[middle],
        array_rotation_xyzw=None if readings.array_rotation_xyzw is None else readings.array_rotation_xyzw[middle],
        ambient_T=None if ambient is None else np.add.reduceat(ambient, first) / count[:, None],
    )


def window_averaging_array(array: SensorArray, readings: Readings, window_s: float) -> SensorArray:
    """The array with the white noise of :func:`window_averages`' rows, by the median number of readings in one."""
    window = np.floor((readings.time_s - readings.time_s[0]) / window_s + 1e-9)
    root = float(np.sqrt(np.median(np.unique(window, return_counts=True)[1])))
    sensors = tuple(replace(sensor, noise_T=sensor.noise_T / root) for sensor in array.sensors)
    return replace(array, sensors=sensors, noise_fraction=array.noise_fraction / root)


def _rate_Hz(readings: Readings, frequency_Hz: float) -> float:
    """Rate of the rows."""
    intervals = np.diff(readings.time_s)
    interval = float(np.median(intervals)) if intervals.size else 0.0
    if not interval > 0.0 or np.any(np.abs(intervals - interval) > _EQUAL_INTERVAL_RTOL * interval):
        raise InputError("found rows at unequal intervals, expected equal ones for a filter.")
    if not np.isfinite(readings.values_T).all():
        raise InputError("found missing readings, expected none for a filter.")
    if not 0.0 < frequency_Hz < 0.5 / interval:
        raise InputError(
            f"found rows at {1.0 / interval:g} Hz, expected more than twice the {frequency_Hz:g} Hz of the filter."
        )
    return 1.0 / interval


def _filtered(readings: Readings, sections: FloatArray) -> Readings:
    least = 3 * (2 * len(sections) + 1)
    if len(readings) <= least:
        raise InputError(f"found {len(readings)} rows, expected more than {least} for a filter.")
    return replace(readings, values_T=np.asarray(sosfiltfilt(sections, readings.values_T, axis=0)))
