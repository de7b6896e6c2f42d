"""Gyro, accelerometer and magnetometer on Earth: what is level, before the heading is asked for.

See docs/theory/complementary-filters.md. Source of the low-pass: D. Laidig, T. Seel, VQF, Information Fusion 91, 2023.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adcs import quaternion
from adcs.complementary.heading import HeadingModel
from adcs.satellite.vector_record import GAP_STEPS, GyroSamples, instants_within, step_rates, steps_s
from arrays.io.values import numbers, seconds
from arrays.typing import BoolArray, FloatArray

GRAVITY_TIME_S = 3.0
"""Time constant of the low-pass of the acceleration, as published for VQF."""
_TILT_FLOOR_RAD = math.radians(0.4)
_TURN_S = 0.5  # for how long a hand turns one way
_UP_STEP = 0.15  # part of the tilt's error that a step corrects: the direction up is smooth already
_LONGEST_UP_STEP = 0.5 / _UP_STEP  # of usual ones: after a gap half of it is corrected
_REST_S = 1.5
_REST_RATE_RAD_S = math.radians(0.5)
_REST_ACCELERATION_M_S2 = 0.15
_LAG_WINDOW_S = 0.2
_LAG_EVERY_S = 0.01  # readings closer than that say the same
_LONGEST_LAG_S = 0.04
_USUAL_LENGTH = 0.1  # relative difference of a field's length
_LARGEST = {"rate_rad_s": 1e4, "acceleration_m_s2": 1e6, "field_T": 1.0}  # of a reading: more is something else


@dataclass(frozen=True, eq=False)
class InertialMagneticRecord:
    """Readings of one sensor at n instants, NaN where one has none.

    Attributes
    ----------
    time_s : ndarray, shape (n,)
        Ascending, in any steps.
    rate_rad_s, acceleration_m_s2, field_T : ndarray, shape (n, 3)
        The acceleration is 9.8 m/s² upwards at rest.
    gyro_samples : str
        What a sample of the gyro is: see :func:`adcs.satellite.vector_record.step_rates`.

    Raises
    ------
    ValueError
        The times do not ascend, the shapes do not match, a value is infinite, a sensor is not read at the start, a
        vector is zero, or there is less than a second.
    """

    time_s: FloatArray
    rate_rad_s: FloatArray
    acceleration_m_s2: FloatArray
    field_T: FloatArray
    gyro_samples: GyroSamples = "mean"

    def __post_init__(self) -> None:
        object.__setattr__(self, "time_s", seconds(self.time_s))
        shape = (len(steps_s(self.time_s)), 3)
        if np.ptp(self.time_s) < 1.0:
            raise ValueError(f"Input time_s must last a second at least; instead received {np.ptp(self.time_s):g} s.")
        for name in ("rate_rad_s", "acceleration_m_s2", "field_T"):
            values = numbers(getattr(self, name))
            if values.shape != shape or np.isinf(values).any():
                raise ValueError(f"Input {name} must be finite, of shape {shape}; instead received {values.shape}.")
            if np.nanmax(np.abs(values), initial=0.0) > _LARGEST[name]:
                raise ValueError(f"Input {name} must not exceed {_LARGEST[name]:g}; instead received more.")
            if not np.isfinite(values[self.starting]).all(axis=1).any():
                raise ValueError(f"Input {name} must have a reading within the first second; instead received none.")
            if name != "rate_rad_s" and (values == 0.0).all(axis=1).any():
                raise ValueError(f"Input {name} must have a length; instead received a zero vector.")
            object.__setattr__(self, name, values)

    @property
    def dt_s(self) -> FloatArray:
        """Steps (n,) that end at each instant."""
        return steps_s(self.time_s)

    @property
    def starting(self) -> BoolArray:
        """Which instants are within the first second (n,)."""
        return self.time_s < self.time_s[0] + 1.0

    def __len__(self) -> int:
        """Return the number of instants."""
        return len(self.time_s)


def rest_bias(record: InertialMagneticRecord) -> FloatArray:
    """Bias of the gyro at every instant: the mean of the last 20 rests of 1.5 s, the first of them before it.

    Returns (n, 3): zero where the sensor never rests [rad/s].
    """
    from adcs.complementary.inertial_magnetic_compiled import window_scatter

    window = np.floor((record.time_s - record.time_s[0]) / _REST_S * (1.0 + 1e-9)).astype(np.intp)
    rate, *of_rate = window_scatter(record.rate_rad_s, window)
    _, *of_acceleration = window_scatter(record.acceleration_m_s2, window)
    rest = np.ones(len(rate), dtype=np.bool_)
    for (scatter, counts), most in ((of_rate, _REST_RATE_RAD_S), (of_acceleration, _REST_ACCELERATION_M_S2)):
        rest &= (scatter < most) & (2 * counts >= np.median(counts))
    found = rate[rest]
    if len(found) == 0:
        return np.zeros((len(record), 3))
    means = np.array([found[max(0, i - 19) : i + 1].mean(axis=0) for i in range(len(found))])
    # A rest is known at its end.
    latest = np.maximum(np.cumsum(np.concatenate([[False], rest[:-1]])) - 1, 0)
    return means[latest[window]]


@dataclass(frozen=True, eq=False)
class Prepared:
    """What the filter needs of a record.

    ``q_level`` (n, 4): attitude of gyro and accelerometer alone: level from body, with a heading that drifts from an
    unknown start.
    """

    time_s: FloatArray  # (n,)
    rate_rad_s: FloatArray  # (n, 3): less the bias, the mean over the step that ends at each instant
    bias_rad_s: FloatArray  # (n, 3)
    field_T: FloatArray  # (n, 3): turned by the gyro to where it would be without the magnetometer's lag
    q_level: FloatArray
    lag_s: float  # of the magnetometer behind the gyro
    tilt_sigma_rad: FloatArray  # (n,): of the angle between up and its estimate

    @property
    def starting(self) -> BoolArray:
        """Which instants are within the first second (n,)."""
        return self.time_s < self.time_s[0] + 1.0


def prepare(record: InertialMagneticRecord, model: HeadingModel = HeadingModel(), *, offline: bool = False) -> Prepared:
    """Remove bias, lag and motion from a record; see :class:`Prepared`.

    Everything but the lag, for which the whole record is used, is what can be known at the time, or, offline, what the
    whole record tells.
    """
    from adcs.complementary.inertial_magnetic_compiled import gyro_attitudes, levelled

    dt_s, bias = record.dt_s, rest_bias(record)
    rate = step_rates(record.rate_rad_s - bias, dt_s, record.gyro_samples)
    q_gyro = gyro_attitudes(rate, dt_s)
    steady = _steady_up(q_gyro, record, dt_s, offline)
    lag = _lag_s(q_gyro, record)
    field_T = _without_lag(q_gyro, record.time_s, record.field_T, lag)
    usual = float(np.median(dt_s))
    part = _UP_STEP * np.minimum(dt_s / usual, _LONGEST_UP_STEP)
    q_level = levelled(q_gyro, steady, part, _attitude(steady[0], _across(steady[0])))
    return Prepared(record.time_s, rate, bias, field_T, q_level, lag, _tilt_sigma_rad(dt_s, rate, model))


def _tilt_sigma_rad(dt_s: FloatArray, rate: FloatArray, model: HeadingModel) -> FloatArray:
    """What an accelerometer at rest leaves, and what the gyro's scale makes of turns while the low-pass is behind."""
    from adcs.complementary.inertial_magnetic_compiled import low_pass

    gap_rad_s = model.gap_rad_s * np.where(dt_s > GAP_STEPS * np.median(dt_s), dt_s, 0.0) / _TURN_S
    squares = (model.gyro_scale**2 * np.einsum("ni,ni->n", rate, rate) + gap_rad_s**2)[:, None]
    smooth = low_pass(squares, dt_s, GRAVITY_TIME_S, squares[0])[:, 0]
    return np.sqrt(_TILT_FLOOR_RAD**2 + _TURN_S**2 * np.maximum(smooth, 0.0))


def _steady_up(q_gyro: FloatArray, record: InertialMagneticRecord, dt_s: FloatArray, offline: bool) -> FloatArray:
    """Upward unit vectors (n, 3) in the gyro's frame; offline the mean of a low-pass from either end, never late."""
    from adcs.complementary.inertial_magnetic_compiled import low_pass, rotated

    steady = rotated(q_gyro, record.acceleration_m_s2)
    smooth = low_pass(steady, dt_s, GRAVITY_TIME_S, np.nanmean(steady[record.starting], axis=0))
    if offline:
        seen = steady[np.isfinite(steady).all(axis=1)]
        end = seen[-np.count_nonzero(record.starting) :].mean(axis=0)
        steps = np.concatenate([dt_s[:1], dt_s[:0:-1]])
        smooth = 0.5 * (smooth + low_pass(steady[::-1].copy(), steps, GRAVITY_TIME_S, end)[::-1])
    return smooth / np.sqrt(np.einsum("ni,ni->n", smooth, smooth))[:, None]


def _lag_s(q_gyro: FloatArray, record: InertialMagneticRecord) -> float:
    """Lag at which the field changes least within a fifth of a second, seen from a frame that does not turn.

    Readings whose length is not that of the first second are left out: a magnet on the sensor turns with it.
    """
    from adcs.complementary.inertial_magnetic_compiled import change_without_turns

    time_s, field_T = record.time_s, record.field_T
    lengths = np.sqrt(np.einsum("ni,ni->n", field_T, field_T))
    usual = np.nanmedian(lengths[record.starting])
    rows = np.flatnonzero(np.isfinite(lengths))
    step = float(np.median(record.dt_s))
    rows = rows[:: instants_within(_LAG_EVERY_S, time_s[rows])]
    apart = instants_within(_LAG_WINDOW_S, time_s[rows])
    good = np.abs(lengths[rows] - usual) < _USUAL_LENGTH * usual
    most = round(_LONGEST_LAG_S / step)
    changes = [change_without_turns(q_gyro, time_s, rows, field_T, good, apart, lag * step) for lag in range(most + 1)]
    least = int(np.argmin(changes))
    if not 0 < least < most:
        return least * step
    a, b, c = changes[least - 1 : least + 2]
    return (least + 0.5 * (a - c) / (a - 2.0 * b + c)) * step


def _without_lag(q_gyro: FloatArray, time_s: FloatArray, field_T: FloatArray, lag_s: float) -> FloatArray:
    from adcs.complementary.inertial_magnetic_compiled import rotated, without_turns

    steady = without_turns(q_gyro, time_s, np.arange(len(time_s)), field_T, lag_s)
    return rotated(quaternion.conjugate(q_gyro), steady)


def turned_back(
    q: FloatArray, time_s: FloatArray, rows: NDArray[np.intp], field_T: FloatArray, lag_s: float
) -> FloatArray:
    """Readable twin of :func:`adcs.complementary.inertial_magnetic_compiled.without_turns`."""
    wanted_s = time_s[rows] - lag_s
    row = np.clip(np.searchsorted(time_s, wanted_s, side="right") - 1, 0, len(time_s) - 2)
    part = np.clip((wanted_s - time_s[row]) / (time_s[row + 1] - time_s[row]), 0.0, 1.0)[:, None]
    then = quaternion.normalised((1.0 - part) * q[row] + part * q[row + 1])
    return quaternion.rotate(then, field_T[rows])


def _attitude(up: FloatArray, north: FloatArray) -> FloatArray:
    """East, north, up from body: quaternion (4,) of an upward unit vector and one that leans to the north."""
    from scipy.spatial.transform import Rotation

    y = north - north @ up * up
    y = y / np.linalg.norm(y)
    return quaternion.from_rotation(Rotation.from_matrix(np.stack([np.cross(y, up), y, up])))


def _across(v: FloatArray) -> FloatArray:
    """Some axis that is not along v."""
    return np.eye(3)[np.argmin(np.abs(v))]
