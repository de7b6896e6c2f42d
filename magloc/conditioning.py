"""Removal of trends, slow fields and mains hum from readings.

Filters run forwards and backwards over the whole record, so that they cause no delay. They need rows at equal intervals
without gaps. A column with a missing reading is refused, not interpolated. Tracks model trends and slow fields instead
(:class:`Background`). Users call the methods of :class:`magloc.readings.Readings`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from arrays.io.errors import InputError
from arrays.typing import FloatArray

_NOTCH_QUALITY = 30.0
_HIGH_PASS_ORDER = 2
_EQUAL_INTERVAL_RTOL = 1e-3


@dataclass(frozen=True)
class Background:
    """Model of the background of every channel: a trend, or a slow field.

    Attributes
    ----------
    trend_about_s : float, optional
        The background is a straight line that is zero at this time [s].
    corner_Hz : float, optional
        The background is an offset and all changes slower than this frequency [Hz].
    """

    trend_about_s: float | None = None
    corner_Hz: float | None = None

    def __bool__(self) -> bool:
        return self.trend_about_s is not None or self.corner_Hz is not None

    def taken_out(self, time_s: FloatArray, values_T: FloatArray) -> FloatArray:
        """Return columns without the background, for a search or a plot.

        The part of the signal that looks like the background is lost too.
        """
        if self.trend_about_s is not None:
            values_T = detrended(time_s, values_T)
        return values_T if self.corner_Hz is None else high_passed(time_s, values_T, self.corner_Hz)


NO_BACKGROUND = Background()


def detrended(time_s: FloatArray, values_T: FloatArray) -> FloatArray:
    """Return columns without their linear trends; the means stay."""
    values = values_T.copy()
    time = time_s - time_s.mean()
    for column in range(values.shape[1]):
        known = np.isfinite(values[:, column])
        if known.sum() < 2:
            raise InputError("found a channel with fewer than two readings, expected at least two to remove its trend.")
        t = time[known] - time[known].mean()
        values[known, column] -= t * (t @ values[known, column]) / (t @ t)
    return values


def high_passed(time_s: FloatArray, values_T: FloatArray, corner_Hz: float) -> FloatArray:
    """Return columns after a high-pass filter: Butterworth, of second order."""
    from scipy.signal import butter  # a third of a second to import

    rate = _rate_Hz(time_s, values_T, corner_Hz, 1e6)
    return _filtered(values_T, np.asarray(butter(_HIGH_PASS_ORDER, corner_Hz, "highpass", fs=rate, output="sos")))


def without_hum(time_s: FloatArray, values_T: FloatArray, mains_Hz: float) -> FloatArray:
    """Return columns without the mains frequency and its harmonics below half the rate of the rows."""
    from scipy.signal import iirnotch, tf2sos

    rate = _rate_Hz(time_s, values_T, mains_Hz, 2000.0)
    for harmonic in np.arange(mains_Hz, 0.5 * rate, mains_Hz):
        values_T = _filtered(values_T, np.asarray(tf2sos(*iirnotch(harmonic, _NOTCH_QUALITY, fs=rate))))
    return values_T


def _rate_Hz(time_s: FloatArray, values_T: FloatArray, frequency_Hz: float, most: float) -> float:
    """Return the rate of the rows; raise InputError unless it is 2 to `most` times a frequency."""
    intervals = np.diff(time_s)
    interval = float(np.median(intervals)) if intervals.size else 0.0
    if not interval > 0.0 or np.any(np.abs(intervals - interval) > _EQUAL_INTERVAL_RTOL * interval):
        raise InputError("found rows at unequal intervals, expected equal ones for a filter.")
    if not np.isfinite(values_T).all():
        raise InputError("found missing readings, expected none for a filter.")
    if not 0.0 < frequency_Hz < 0.5 / interval:
        raise InputError(
            f"found rows at {1.0 / interval:g} Hz, expected more than twice the {frequency_Hz:g} Hz of the filter."
        )
    if frequency_Hz * interval * most < 1.0:
        raise InputError(
            f"found rows at {1.0 / interval:g} Hz, expected at most {most:g} times the {frequency_Hz:g} Hz of a filter."
        )
    return 1.0 / interval


def _filtered(values_T: FloatArray, sections: FloatArray) -> FloatArray:
    from scipy.signal import sosfiltfilt

    least = 3 * (2 * len(sections) + 1)
    if len(values_T) <= least:
        raise InputError(f"found {len(values_T)} rows, expected more than {least} for a filter.")
    return np.asarray(sosfiltfilt(sections, values_T, axis=0))
