"""Direction up of an inertial unit: the acceleration, smoothed in a frame that does not rotate."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from adcs.complementary.inertial.gaps import (
    HELD_VARIANCE,
    LEAST_GAP_S,
    UNKNOWN_RAD,
    numbered_windows,
    sensor_gaps,
    window_scatter,
)
from adcs.complementary.inertial.integration import low_pass
from adcs.satellite.conventions import angle
from adcs.satellite.telemetry import is_read
from arrays.typing import BoolArray, FloatArray

GRAVITY_TIME_S = 3.0
"""Longest time constant of the low-pass of the acceleration, as published for VQF."""
TILT_FLOOR_RAD = math.radians(0.4)
"""Least σ of the tilt; a shorter time constant is used only if it gains more than this."""
_TIMES_S = (GRAVITY_TIME_S, 1.5, 0.7)
_PREDICTED_S = 2.0  # time over which the mean acceleration is predicted
_GRAVITY_M_S2 = 9.81
_MEAN_S = 0.5  # means of a hand's acceleration over longer times decrease in proportion
_WINDOW_S = 1.5
_LEAST_RAD = 0.025  # least σ in a gap after which smoothing restarts
_MUCH = 2.0  # largest σ of the estimate before a gap that is used, in σ of a reading
_LEAST_M_S2 = 0.1  # error of an accelerometer's mean


@dataclass(frozen=True, eq=False)
class Up:
    """Direction up at n instants, in the frame of the gyro alone."""

    up: FloatArray  # (n, 3): unit vectors
    sigma_rad: FloatArray  # (n,): σ of their angle after gaps and a start in motion
    fresh: BoolArray  # (n,): instants with few readings since a restart; the attitude follows them at once
    hidden_rad2: (
        FloatArray  # (n,): growth of the attitude's variance in gaps of the gyro, and by rotations seen after them
    )
    drift_rad: FloatArray  # (n,): σ of the drift of a gyro for which the longest time constant is too long


@dataclass(frozen=True, eq=False)
class Steady:
    """Accelerations at n instants, in the frame of the gyro alone, and gaps of the gyro."""

    time_s: FloatArray
    dt_s: FloatArray
    acceleration_m_s2: FloatArray  # (n, 3): NaN without a reading
    at_rest: BoolArray  # (n,): readings that start the first low-pass; none if the unit moves at the start
    gaps: NDArray[np.intp]  # (k, 2): rows before and after the gaps of the gyro
    hidden_rad2: FloatArray  # (n,): growth of the attitude's variance within these gaps
    drift_rad_s: float  # drift of the gyro


def direction_up(steady: Steady, *, offline: bool) -> Up:
    """Smooth accelerations with the time constant that predicts later ones best.

    A gyro with large errors of scale needs a short one. Offline the whole record decides, else the past.
    """
    gaps = _gaps(steady)
    scatter = _scatter_rad(steady, gaps)
    later = _later_means(steady)
    tried = [_smoothed_up(steady, gaps, scatter, gravity_s, offline=False) for gravity_s in _TIMES_S]
    error_rad2 = np.array([later.mean_square(one.up, offline=offline) for one in tried])
    gained = error_rad2[0] - np.min(error_rad2, axis=0)
    best = np.where(gained > TILT_FLOOR_RAD**2, np.argmin(error_rad2, axis=0), 0)
    drift_rad = np.sqrt(gained) * (best > 0)
    if offline:
        chosen = _smoothed_up(steady, gaps, scatter, _TIMES_S[best[0]], offline=True)
        return replace(chosen, drift_rad=drift_rad)
    if not best.any():
        return tried[0]
    rows = np.arange(len(best))
    of_rows = {name: np.array([getattr(one, name) for one in tried])[best, rows] for name in vars(tried[0])}
    return Up(**{**of_rows, "drift_rad": drift_rad})


@dataclass(frozen=True, eq=False)
class _LaterMeans:
    """Directions of the mean acceleration after some instants, and the instants at which they are known."""

    began: NDArray[np.intp]  # (k,)
    ends: NDArray[np.intp]  # (k,)
    unit: FloatArray  # (k, 3)
    counts: FloatArray  # (n,): number that are known

    def mean_square(self, up: FloatArray, *, offline: bool) -> FloatArray:
        """Return the mean squared angle (n,) to a direction up (n, 3), over the rows so far; offline, over all rows."""
        square = np.sum((self.unit - up[self.began]) ** 2, axis=1)
        errors = np.cumsum(np.bincount(self.ends, square, len(up))) / np.maximum(self.counts, 1.0)
        return np.full(len(errors), errors[-1]) if offline else errors


def _later_means(steady: Steady) -> _LaterMeans:
    read = is_read(steady.acceleration_m_s2)
    weight = np.where(read, steady.dt_s, 0.0)[:, None]
    total = np.cumsum(np.where(read[:, None], steady.acceleration_m_s2, 0.0) * weight, axis=0)
    ends = np.searchsorted(steady.time_s, steady.time_s + _PREDICTED_S)
    began = np.flatnonzero(ends < len(ends))
    mean = total[ends[began]] - total[began]
    length = np.sqrt(np.einsum("ni,ni->n", mean, mean))
    known = length > 0.0
    began = began[known]
    counts = np.cumsum(np.bincount(ends[began], minlength=len(ends))).astype(np.float64)
    return _LaterMeans(began, ends[began], mean[known] / length[known, None], counts)


def _smoothed_up(
    steady: Steady,
    gaps: list[tuple[int, int, FloatArray, bool]],
    scatter: FloatArray,
    gravity_s: float,
    *,
    offline: bool,
) -> Up:
    """Smooth accelerations; offline by the mean of a forward and a backward low-pass, without delay.

    After a gap that hides a larger rotation than the σ of a few readings, the low-pass restarts from the mean of the
    first seconds.
    """
    n, acceleration = len(steady.time_s), steady.acceleration_m_s2
    smooth, sigma, fresh, hidden = np.empty((n, 3)), np.zeros(n), np.zeros(n, np.bool_), steady.hidden_rad2.copy()
    read = is_read(acceleration)
    rest = steady.at_rest & read
    smooth[0] = acceleration[rest].mean(axis=0) if rest.any() else acceleration[read][0]
    begin, unknown = 0, UNKNOWN_RAD
    for before, after, growth, turns in [*gaps, (n - 1, n, np.zeros(0), False)]:
        piece = slice(begin, before + 1)
        last = smooth[max(begin - 1, 0)]
        smooth[piece], sigma[piece], fresh[piece] = _smooth_piece(
            steady, piece, last, unknown, scatter, gravity_s, offline
        )
        smooth[before + 1 : after] = smooth[before]
        sigma[before + 1 : after] = np.sqrt(sigma[before] ** 2 + HELD_VARIANCE * growth[: after - before - 1])
        if after < n:
            begin, unknown = after, math.hypot(sigma[before], math.sqrt(growth[-1]))
            seen = float(angle(smooth[before], acceleration[after])) if turns and read[after] else 0.0
            if seen > max(unknown, 3.0 * scatter[after]):
                hidden[after] += seen**2 - unknown**2
                unknown = seen
        elif before < n - 1:
            break
    return Up(smooth / np.sqrt(np.einsum("ni,ni->n", smooth, smooth))[:, None], sigma, fresh, hidden, np.zeros(n))


def _gaps(steady: Steady) -> list[tuple[int, int, FloatArray, bool]]:
    """Return significant gaps: rows before and after, growth of the variance, and True for a gap of the gyro."""
    time_s, found = steady.time_s, []
    for before, after in steady.gaps:
        growth = np.cumsum(steady.hidden_rad2[before + 1 : after + 1])
        if growth[-1] > _LEAST_RAD**2:
            found.append((int(before), int(after), growth, True))
    for before, after in sensor_gaps(time_s, is_read(steady.acceleration_m_s2), LEAST_GAP_S):
        if not any(a < after and before < b for a, b, *_ in found):
            since = time_s[before + 1 : after + 1] - time_s[before]
            found.append((int(before), int(after), np.square(steady.drift_rad_s * since), False))
    return sorted(found, key=lambda one: one[0])


def _scatter_rad(steady: Steady, gaps: list[tuple[int, int, FloatArray, bool]]) -> FloatArray:
    """Return σ (n,) of the angle of one reading, from the scatter of nearby and of all accelerations."""
    begins = np.diff(numbered_windows(steady.time_s, _WINDOW_S), prepend=0) > 0
    for before, after, *_ in gaps:
        begins[[before + 1, min(after, len(begins) - 1)]] = True
    window = np.cumsum(begins, dtype=np.intp)
    _, scatter, _ = window_scatter(steady.acceleration_m_s2, window)
    scatter = np.where(np.isfinite(scatter), scatter, 0.0)
    near = np.maximum(scatter, np.append(scatter[1:], 0.0))
    return np.asarray(np.hypot(np.maximum(near, np.median(scatter)), _LEAST_M_S2)[window] / _GRAVITY_M_S2)


def _smooth_piece(
    steady: Steady,
    piece: slice,
    last: FloatArray,
    before_rad: float,
    scatter: FloatArray,
    gravity_s: float,
    offline: bool,
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return smoothed accelerations of some rows, σ of their direction, and the fresh rows.

    ``last`` is the smooth acceleration before them, and ``before_rad`` σ of its direction.
    """
    values, dt_s = steady.acceleration_m_s2[piece], steady.dt_s[piece]
    seen = np.flatnonzero(is_read(values))
    age_s = steady.time_s[piece] - steady.time_s[piece][seen[0] if len(seen) else 0]
    fresh = np.zeros(len(values), np.bool_)
    if steady.at_rest[piece][0]:
        start, sigma = last, np.zeros(len(values))
    elif len(seen) == 0:
        return np.broadcast_to(last, values.shape), np.full(len(values), before_rad), fresh
    elif before_rad < _MUCH * scatter[piece][seen[0]]:
        start, part = last, np.maximum(age_s, 0.0) / gravity_s
        sigma = before_rad * (1.0 + part) * np.exp(-part)
    else:
        fresh = age_s < gravity_s
        late = np.maximum(age_s - gravity_s, 0.0) / gravity_s
        sigma = scatter[piece][seen[0]] / (1.0 + np.maximum(age_s, 0.0) / _MEAN_S) * np.exp(-late)
        sigma[: seen[0]] = before_rad
        counts = np.maximum(np.cumsum(is_read(values)), 1)[:, None]
        means = np.nancumsum(values, axis=0) / counts
        means[: seen[0]] = means[seen[0]]
        start = means[fresh][-1]
    smooth = low_pass(values, dt_s, gravity_s, start)
    if fresh.any():
        k = np.count_nonzero(fresh)
        smooth = np.concatenate([means[:k], low_pass(values[k:], dt_s[k:], gravity_s, start)])
    if offline and len(seen):
        count = max(int(np.count_nonzero(age_s < 1.0)), 1)
        end = values[seen[-count:]].mean(axis=0)
        steps = np.concatenate([dt_s[:1], dt_s[:0:-1]])
        smooth = 0.5 * (smooth + low_pass(values[::-1].copy(), steps, gravity_s, end)[::-1])
    return smooth, sigma, fresh
