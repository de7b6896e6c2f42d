"""Gaps in the readings of an inertial unit, and the rotation within a gap of the gyro."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from adcs.satellite.conventions import angle
from adcs.satellite.telemetry import is_read
from adcs.satellite.vector_record import GAP_STEPS
from arrays.typing import BoolArray, FloatArray

_CHANGE_S = 1.0  # time in which a hand changes its rate
_STEEP, _LONG = 6, 10.0
_SHOWN_RAD, _SHOWN_S = 0.15, 0.3  # in a shorter gap the room's field may change as much as by a rotation
_TINY = 1e-12
HELD_VARIANCE = 4.0
"""Ratio of variances with the rate at one end of a gap and at both ends, for a random-walk rate."""
UNKNOWN_RAD = math.pi / math.sqrt(3.0)
"""Standard deviation of an unknown angle."""
LOST_RAD = 0.05
"""Least σ of the rotation in a gap that a warning names."""
LEAST_GAP_S = 1.0
"""Least duration of a gap that a warning names, unless it hides a rotation."""


def numbered_windows(time_s: FloatArray, window_s: float) -> NDArray[np.intp]:
    """Return the number (n,) of the window of each instant; empty windows are not counted."""
    window = np.floor((time_s - time_s[0]) / window_s * (1.0 + 1e-9))
    return np.cumsum(np.diff(window, prepend=0.0) > 0.0, dtype=np.intp)


def window_scatter(values: FloatArray, window: NDArray[np.intp]) -> tuple[FloatArray, FloatArray, NDArray[np.intp]]:
    """Return mean (k, 3), largest standard deviation (k,) and number (k,) of each window's readings.

    ``values`` (n, 3): NaN without a reading. ``window`` (n,): number of its window, ascending from 0.
    """
    begins, read = np.flatnonzero(np.diff(window, prepend=-1)), np.isfinite(values.sum(axis=1))
    counts = np.add.reduceat(read, begins, dtype=np.intp)
    with np.errstate(invalid="ignore"):  # a window without a reading
        means = np.add.reduceat(np.where(read[:, None], values, 0.0), begins) / counts[:, None]
        squares = np.add.reduceat(np.where(read[:, None], (values - means[window]) ** 2, 0.0), begins)
        return means, np.sqrt(squares.max(axis=1) / counts), counts


def sensor_gaps(time_s: FloatArray, read: BoolArray, least_s: float = 0.0) -> NDArray[np.intp]:
    """Return the rows (k, 2) before and after each gap of a sensor; n after a gap at the end.

    A gap is longer than 2.5 usual steps of the sensor, and than ``least_s``. Time before the first reading is no gap.
    """
    rows = np.flatnonzero(read)
    span = np.diff(time_s[rows])
    longest = max(least_s, GAP_STEPS * float(np.median(span))) if len(span) else math.inf
    at = np.flatnonzero(span > longest)
    found = np.stack([rows[at], rows[at + 1]], axis=1)
    if len(rows) and time_s[-1] - time_s[rows[-1]] > longest:
        found = np.concatenate([found, [[rows[-1], len(time_s)]]])
    return found


def hidden_turn_rad(seconds: FloatArray, held_rad_s: float, usual_rad_s: float) -> FloatArray:
    """Return σ of the rotation in a gap of the gyro, relative to the rotation at the mean rate of its ends.

    In a short gap σ of the mean rate is ``held_rad_s``. After a second the unit may have any of its usual rates.
    """
    part = np.power(np.minimum(seconds / _CHANGE_S, _LONG), _STEEP)
    rate = np.hypot(held_rad_s, usual_rad_s * part / (1.0 + part))
    return np.asarray(np.minimum(rate * seconds, UNKNOWN_RAD))


def hidden_variance(
    time_s: FloatArray, rate_rad_s: FloatArray, gaps: NDArray[np.intp], held_rad_s: float, usual_rad_s: float
) -> FloatArray:
    """Return the growth (n,) of the attitude's variance within gaps of the gyro [rad²].

    It is positive in the whole gap. ``rate_rad_s`` (n, 3): NaN without a reading. Other rates: see
    :func:`hidden_turn_rad`; the rms rate of the log replaces ``usual_rad_s`` if it is higher.
    """
    growth = np.zeros(len(time_s))
    usual = max(usual_rad_s, math.sqrt(float(np.nanmean(np.einsum("ni,ni->n", rate_rad_s, rate_rad_s)))))
    for before, after in gaps:
        within = slice(before + 1, after + 1)
        variance = np.square(hidden_turn_rad(time_s[within] - time_s[before], held_rad_s, usual))
        growth[within] = np.maximum(np.diff(variance, prepend=0.0), _TINY)
    return growth


def observed_turn_variance(
    time_s: FloatArray, gaps: NDArray[np.intp], hidden_rad2: FloatArray, steady_field: FloatArray
) -> FloatArray:
    """Return the variance (n,) to add after gaps over which the field rotates by more than σ [rad²].

    ``steady_field`` (n, 3): field in the frame of the gyro alone, where only a gap changes it; NaN where it is not the
    Earth's.
    """
    more = np.zeros(len(time_s))
    rows = np.flatnonzero(is_read(steady_field))
    for before, after in gaps:
        i, k = np.searchsorted(rows, [before + 1, after])
        if i == 0 or k == len(rows) or time_s[after] - time_s[before] < _SHOWN_S:
            continue
        if time_s[rows[k]] - time_s[rows[i - 1]] < time_s[after] - time_s[before] + _CHANGE_S:
            variance = float(np.sum(hidden_rad2[before + 1 : after + 1]))
            turned = float(angle(steady_field[rows[i - 1]], steady_field[rows[k]]))
            if turned > max(math.sqrt(variance), _SHOWN_RAD):
                more[after] = turned**2 - variance
    return more


def gap_warnings(time_s: FloatArray, read: Mapping[str, BoolArray], lost: NDArray[np.intp]) -> list[str]:
    """Return a sentence for each sensor with gaps: number, duration and time.

    ``read``: masks (n,) of readings by sensor, the gyro first. ``lost`` (k, 2): gaps of the gyro that hide a rotation.
    """
    gyro, *others = read
    texts = []
    if len(lost):
        texts.append(f"{_gap_sentence(time_s, gyro, lost)}; the turn within a gap is unknown until the field shows it")
    for name in others:
        gaps = sensor_gaps(time_s, read[name], LEAST_GAP_S)
        seen = np.concatenate([[0], np.cumsum(read[gyro])])
        own = gaps[seen[np.minimum(gaps[:, 1], len(time_s))] - seen[gaps[:, 0] + 1] > 0]
        if len(own):
            texts.append(f"{_gap_sentence(time_s, name, own)}; the gyro alone held the attitude there")
    return texts


def _gap_sentence(time_s: FloatArray, name: str, gaps: NDArray[np.intp]) -> str:
    lasts_s = time_s[np.minimum(gaps[:, 1], len(time_s) - 1)] - time_s[gaps[:, 0]]
    k = int(np.argmax(lasts_s))
    times = "1 gap, of" if len(gaps) == 1 else f"{len(gaps)} gaps, the longest of"
    return f"the {name} has {times} {_duration(lasts_s[k])} from {time_s[gaps[k, 0]]:.10g} s on"


def _duration(seconds: float) -> str:
    return f"{seconds:.3g} s" if seconds < 1e3 else f"{seconds:.0f} s ({seconds / 86400.0:.3g} days)"
