"""First attitudes, mounting and offsets of a log, without any knowledge of the sensors' errors."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter1d

from adcs import quaternion
from adcs.complementary.inertial.integration import gyro_attitudes, level_attitudes
from adcs.log_calibration.record import FEWEST_ROWS, InertialData, Series
from arrays.typing import FloatArray, IntArray

_LEVEL_S = 10.0
_QUIET_S, _QUIET_RAD_S = 3.0, math.radians(0.4)
_WINDOW_S, _ROW_S = 300.0, 0.5
_LARGEST_BIAS_RAD_S, _PHASE_RAD = math.radians(2.0), 0.3
_LONG = 0.8  # of the longest readings
_BETTER = 0.5  # ratio of residuals at which a turned mounting is taken
_LEAST_MISFIT = 0.05  # of the field, below which the stated mounting is kept


@dataclass(frozen=True, eq=False)
class Start:
    """Start of the estimate.

    Attributes
    ----------
    q : ndarray, shape (n, 4)
        Attitudes, world from body, with the field's horizontal part along y.
    gyro_bias_rad_s : ndarray, shape (3,)
    mountings : ndarray, shape (M, 3, 3)
        Nearest rotation by multiples of 45° about z and of 90°, sensor axes from body axes.
    offsets_uT : ndarray, shape (M, 3)
    field_uT : ndarray, shape (3,)
        Field in the world frame.
    """

    q: FloatArray
    gyro_bias_rad_s: FloatArray
    mountings: FloatArray
    offsets_uT: FloatArray
    field_uT: FloatArray


def mountings() -> FloatArray:
    """Return the rotations (48, 3, 3) of autopilots: 24 by right angles, each also with 45° about z before."""
    quarter = []
    for axes in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[np.arange(3), axes] = signs
            if np.linalg.det(matrix) > 0.0:
                quarter.append(matrix)
    quarter.sort(key=lambda matrix: -np.trace(matrix))
    c = math.sqrt(0.5)
    eighth = np.array([[c, c, 0.0], [-c, c, 0.0], [0.0, 0.0, 1.0]])
    return np.concatenate([quarter, np.array(quarter) @ eighth])


def find_start(data: InertialData, magnetometers: tuple[Series, ...]) -> Start:
    """Return a start from the level attitude and the mounting and heading rate that fit each magnetometer best."""
    bias = _quiet_bias(data)
    q = _level(data, bias)
    samples = [_sampled(data, series) for series in magnetometers]
    found = [_fit_mounting(data.time_s, q, *each) for each in samples]
    # Few attitudes fit any heading: a magnetometer that stops early does not set it.
    spans = [float(np.ptp(data.time_s[at])) for at, _ in samples]
    whole = [fit for fit, span in zip(found, spans, strict=True) if span >= _LONG * max(spans)]
    best = min(whole, key=lambda fit: fit.misfit)
    turned = _rotate_heading(data.time_s, q, best.heading_rate)
    solved = [_solve(turned, *each, fit.mounting) for each, fit in zip(samples, found, strict=True)]
    field = solved[found.index(best)][:3]
    east = math.atan2(field[0], field[1])
    offsets = [fit.mounting @ x[3:] for fit, x in zip(found, solved, strict=True)]
    R_bias = quaternion.rotate_back(turned, np.array([0.0, 0.0, best.heading_rate])).mean(axis=0)
    return Start(
        quaternion.multiply(quaternion.exp([0.0, 0.0, east]), turned),
        bias + R_bias,
        np.array([fit.mounting for fit in found]),
        np.array(offsets),
        np.array([0.0, math.hypot(field[0], field[1]), field[2]]),
    )


@dataclass(frozen=True, eq=False)
class _Mounting:
    mounting: FloatArray
    heading_rate: float
    misfit: float


def _quiet_bias(data: InertialData) -> FloatArray:
    """Return the mean rate of the quietest seconds, or of the whole log where the vehicle never rests."""
    n = max(2, round(_QUIET_S / float(np.median(data.dt_s))))
    mean = uniform_filter1d(data.rate_rad_s, n, axis=0)
    square = uniform_filter1d(data.rate_rad_s**2, n, axis=0)
    scatter = np.sqrt(np.maximum(square - mean**2, 0.0).max(axis=1))
    quietest = int(np.argmin(scatter))
    if scatter[quietest] < _QUIET_RAD_S and np.abs(mean[quietest]).max() < _LARGEST_BIAS_RAD_S:
        return np.asarray(mean[quietest])
    bias = np.average(data.rate_rad_s, axis=0, weights=data.dt_s)
    return np.asarray(np.clip(bias, -_LARGEST_BIAS_RAD_S, _LARGEST_BIAS_RAD_S))


def _level(data: InertialData, bias: FloatArray) -> FloatArray:
    """Return attitudes whose z axis is the smoothed direction of the specific force, with the gyro's heading."""
    q_gyro = gyro_attitudes(data.rate_rad_s - bias, data.dt_s)
    up = quaternion.rotate(q_gyro, data.acceleration_m_s2)
    n = max(1, round(_LEVEL_S / float(np.median(data.dt_s))))
    for _ in range(3):
        up = uniform_filter1d(up, n, axis=0)
    up /= np.maximum(np.linalg.norm(up, axis=1, keepdims=True), 1e-9)
    start = quaternion.turned_onto(quaternion.IDENTITY, up[0], np.array([0.0, 0.0, 1.0]))
    return level_attitudes(q_gyro, np.ascontiguousarray(up), np.ones(len(up)), start)


def _rotate_heading(time_s: FloatArray, q: FloatArray, rate_rad_s: float) -> FloatArray:
    """Return attitudes without a constant rate about the vertical."""
    turn = np.outer(time_s - time_s[0], [0.0, 0.0, -rate_rad_s])
    return quaternion.multiply(quaternion.exp(turn), q)


def _sampled(data: InertialData, series: Series) -> tuple[IntArray, FloatArray]:
    """Return sparse instants of the inertial data, and the readings there, in the part with most turns."""
    turns = np.cumsum(np.linalg.norm(data.rate_rad_s, axis=1) * data.dt_s)
    t = data.time_s
    later = np.minimum(np.searchsorted(t, t + _WINDOW_S), len(t) - 1)
    begin = t[int(np.argmax(turns[later] - turns))]
    inside = (series.time_s >= max(begin, t[0])) & (series.time_s <= min(begin + _WINDOW_S, t[-1]))
    rows = np.flatnonzero(inside)
    if len(rows) < FEWEST_ROWS:
        raise ValueError(
            f"Input magnetometers must have ten readings during the inertial readings; instead received {len(rows)} of"
            f" {series.name}."
        )
    step = max(1, round(_ROW_S * len(rows) / max(np.ptp(series.time_s[rows]), 1e-9)))
    rows = rows[::step]
    return np.searchsorted(t, series.time_s[rows]), series.values[rows]


def _design(q: FloatArray) -> FloatArray:
    """Return derivatives (n, 3, 6) of Q^T reading by the field in the world frame and by Q^T offset."""
    R = quaternion.matrix(q)
    return np.concatenate([R.transpose(0, 2, 1), np.broadcast_to(np.eye(3), R.shape)], axis=2)


def _fit_mounting(time_s: FloatArray, q: FloatArray, at: IntArray, readings: FloatArray) -> _Mounting:
    """Return the mounting and the rate of the heading with the least residuals."""
    choices = mountings()
    y = np.einsum("qji,nj->niq", choices, readings).reshape(-1, len(choices))
    length = min(float(np.ptp(time_s[at])), _WINDOW_S)  # a gap may follow the last reading
    steps = max(1, math.ceil(_LARGEST_BIAS_RAD_S * length / 2.0 / _PHASE_RAD))
    rates = _LARGEST_BIAS_RAD_S * np.arange(-steps, steps + 1) / steps
    squares = np.empty((len(rates), len(choices)))
    for i, rate in enumerate(rates):
        X = _design(_rotate_heading(time_s[at], q[at], rate)).reshape(-1, 6)
        basis = np.linalg.svd(X, full_matrices=False)
        known = basis.U[:, basis.S / basis.S[0] > 1e-3]
        squares[i] = np.sum((y - known @ (known.T @ y)) ** 2, axis=0)
    rms = np.sqrt(squares.min(axis=0) / len(at))
    best = int(np.argmin(rms))
    size = float(np.sqrt(np.mean(np.sum((readings - readings.mean(axis=0)) ** 2, axis=1))))
    if rms[best] > _BETTER * rms[0] or rms[0] < _LEAST_MISFIT * max(size, 1.0):
        best = 0
    return _Mounting(choices[best], float(rates[np.argmin(squares[:, best])]), float(rms[best]))


def _solve(q: FloatArray, at: IntArray, readings: FloatArray, mounting: FloatArray) -> FloatArray:
    """Return the field in the world frame and the offset in body axes (6,)."""
    X = _design(q[at]).reshape(-1, 6)
    # Of equal fits the one with the smaller offset.
    weight = np.diag([1e-6, 1e-6, 1e-6, 1e-4, 1e-4, 1e-4]) * len(at)
    return np.asarray(np.linalg.solve(X.T @ X + weight, X.T @ (readings @ mounting).ravel()))
