"""Readings as smooth functions of time: without fast noise, across short dropouts, and with their rate."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d, maximum_filter1d
from scipy.signal import butter, sosfiltfilt

from arrays.typing import BoolArray, FloatArray

_RATE_HZ = 5.0  # rate of the samples: platforms turn more slowly than 2.5 Hz
_ORDER = 8
_DROPOUT_S, _DROPOUT_ROWS = 0.5, 3.0  # longest gap that is interpolated, in seconds or in intervals
_REACH = 2  # steps around a dropout in which the low-pass filter shows it
_SHORTEST = 16  # intervals


@dataclass(frozen=True, eq=False)
class Signal:
    """Channels of a log as functions of time, in stretches between gaps.

    Attributes
    ----------
    stretches : tuple of CubicSpline
        Functions of time, whose values are (..., m).
    filled : tuple of ndarray of bool
        Points of each function near a dropout.
    step : int
        Interval of the samples, in intervals of the log.
    interval_s : float
        Interval of the log.
    """

    stretches: tuple[CubicSpline, ...]
    filled: tuple[BoolArray, ...]
    step: int
    interval_s: float

    @classmethod
    def of(cls, time_s: FloatArray, values: FloatArray) -> Signal:
        """Return the signal of channels (n, m) in order of time; NaN where missing."""
        interval_s = float(np.median(np.diff(time_s)))
        step = max(1, round(1.0 / (_RATE_HZ * interval_s)))
        low_pass = butter(_ORDER, 1.0 / step, output="sos") if step > 1 else None
        good = np.isfinite(values).all(axis=1)
        time, read = time_s[good], values[good]
        ends = np.flatnonzero(np.diff(time) > max(_DROPOUT_S, _DROPOUT_ROWS * interval_s)) + 1
        stretches, filled = [], []
        for own, y in zip(np.split(time, ends), np.split(read, ends), strict=True):
            n = round((own[-1] - own[0]) / interval_s) + 1 if len(own) else 0
            if n < _SHORTEST + 4 * step:
                continue
            grid = np.linspace(own[0], own[-1], n)
            even = np.stack([np.interp(grid, own, column) for column in y.T], axis=1)
            if low_pass is not None:
                even = sosfiltfilt(low_pass, even, axis=0, padlen=min(n - 1, 20 * step))
            stretches.append(CubicSpline(grid, even))
            after = np.clip(np.searchsorted(own, grid - 0.25 * interval_s), 1, len(own) - 1)
            missing = (np.diff(own)[after - 1] > 1.5 * interval_s) & (own[after] > grid + 0.25 * interval_s)
            filled.append(maximum_filter1d(missing, 1 + 2 * _REACH * step))
        return cls(tuple(stretches), tuple(filled), step, interval_s)

    def samples(self) -> tuple[FloatArray, FloatArray]:
        """Return the times (k,) and the values (k, m) of independent samples, without those near dropouts."""
        pairs = zip(self.stretches, self.filled, strict=True)
        times = [spline.x[:: self.step][~filled[:: self.step]] for spline, filled in pairs]
        if not times:
            return np.zeros(0), np.zeros((0, 0))
        return np.concatenate(times), np.concatenate([of(t) for of, t in zip(self.stretches, times, strict=True)])

    def at(self, time_s: FloatArray, rate: bool = False) -> FloatArray:
        """Return values (n, m), or their rates, at some times; NaN more than an interval beyond a stretch."""
        m = self.stretches[0].c.shape[2] if self.stretches else 1
        out = np.full((len(time_s), m), np.nan)
        for spline in self.stretches:
            within = (time_s >= spline.x[0] - self.interval_s) & (time_s <= spline.x[-1] + self.interval_s)
            out[within] = spline(time_s[within], int(rate))
        return out

    def noise_share(self) -> float:
        """Return the share of the variance of white noise that the signal keeps."""
        return 1.0 / self.step


def white_noise(time_s: FloatArray, values: FloatArray) -> FloatArray:
    """Return the standard deviation (m,) of the white noise of channels (n, m), from their fourth differences."""
    fourth = np.diff(values, 4, axis=0)
    whole = np.isfinite(fourth).all(axis=1)
    if not whole.any():
        return np.zeros(values.shape[1])
    return np.asarray(np.median(np.abs(fourth[whole]), axis=0) / (0.6745 * math.sqrt(70.0)))


def smooth_in_stretches(time_s: FloatArray, values: FloatArray, width_s: float) -> FloatArray:
    """Return values (n,) after a Gaussian filter of some width, stretch by stretch."""
    interval_s = float(np.median(np.diff(time_s)))
    ends = np.flatnonzero(np.diff(time_s) > width_s) + 1
    parts = np.split(values, ends)
    return np.concatenate([gaussian_filter1d(part, width_s / interval_s, mode="nearest") for part in parts])


def band_passed(time_s: FloatArray, values: FloatArray, corner_s: float) -> FloatArray:
    """Return values (n, ...) without their changes over times longer than a corner."""
    columns = values.reshape(len(values), -1)
    slow = np.stack([smooth_in_stretches(time_s, column, corner_s) for column in columns.T], axis=1)
    return (columns - slow).reshape(values.shape)
