"""The same filter on Earth: gyro, accelerometer and magnetometer, a drop-in for the field, the Sun and the gyro.

See docs/theory/complementary-filters.md. Source of the low-pass: D. Laidig, T. Seel, VQF, Information Fusion 91, 2023.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adcs import quaternion
from adcs.complementary.explicit import Gains, explicit_track
from adcs.satellite.vector_record import GyroSamples, VectorRecord, step_rates, steps_s
from arrays.typing import BoolArray, FloatArray

GRAVITY_TIME_S = 3.0
"""Time constant of the low-pass of the acceleration, as published for VQF."""
HEADING_TIME_S = 5.0
"""Time constant with which the heading follows the field."""
_UP_STEP = 0.15  # part of the tilt's error that a step corrects: the direction up is smooth already
_REST_S = 1.5
_REST_RATE_RAD_S = math.radians(0.5)
_REST_ACCELERATION_M_S2 = 0.15
_LAG_WINDOW_S = 0.2
_LONGEST_LAG_S = 0.04


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
        object.__setattr__(self, "time_s", np.asarray(self.time_s, dtype=np.float64))
        shape = (len(steps_s(self.time_s)), 3)
        if np.ptp(self.time_s) < 1.0:
            raise ValueError(f"Input time_s must last a second at least; instead received {np.ptp(self.time_s):g} s.")
        for name in ("rate_rad_s", "acceleration_m_s2", "field_T"):
            values = np.asarray(getattr(self, name), dtype=np.float64)
            if values.shape != shape or np.isinf(values).any():
                raise ValueError(f"Input {name} must be finite, of shape {shape}; instead received {values.shape}.")
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
    window = np.floor((record.time_s - record.time_s[0]) / _REST_S * (1.0 + 1e-9)).astype(np.intp)
    rate, scatter = _by_window(record.rate_rad_s, window)
    rest = (scatter < _REST_RATE_RAD_S) & (_by_window(record.acceleration_m_s2, window)[1] < _REST_ACCELERATION_M_S2)
    found = rate[rest]
    if len(found) == 0:
        return np.zeros((len(record), 3))
    means = np.array([found[max(0, i - 19) : i + 1].mean(axis=0) for i in range(len(found))])
    # A rest is known at its end.
    latest = np.maximum(np.cumsum(np.concatenate([[False], rest[:-1]])) - 1, 0)
    return means[latest[window]]


def _by_window(values: FloatArray, window: NDArray[np.intp]) -> tuple[FloatArray, FloatArray]:
    """Means (k, 3) and the largest standard deviation (k,) of each window's readings; inf where half of them miss."""
    seen = np.isfinite(values).all(axis=1)
    counts = np.bincount(window[seen], minlength=window[-1] + 1)
    with np.errstate(invalid="ignore", divide="ignore"):
        means, squares = (
            np.stack([np.bincount(window[seen], column[seen], window[-1] + 1) / counts for column in array.T], axis=1)
            for array in (values, (values - values[seen].mean(axis=0)) ** 2)
        )
        variance = squares - (means - values[seen].mean(axis=0)) ** 2
    scatter = np.sqrt(np.maximum(variance, 0.0).max(axis=1))
    return means, np.where(2 * counts < np.median(counts), np.inf, scatter)


@dataclass(frozen=True, eq=False)
class Prepared:
    """What the filter needs of a record.

    ``q_level`` (n, 4): attitude of gyro and accelerometer alone: level from body, with a heading that drifts from an
    unknown start.
    """

    time_s: FloatArray  # (n,)
    rate_rad_s: FloatArray  # (n, 3): less the bias, the mean over the step that ends at each instant
    bias_rad_s: FloatArray  # (n, 3)
    up: FloatArray  # (n, 3): unit vector, body axes
    field_T: FloatArray  # (n, 3): turned by the gyro to where it would be without the magnetometer's lag
    q_level: FloatArray
    lag_s: float  # of the magnetometer behind the gyro

    @property
    def starting(self) -> BoolArray:
        """Which instants are within the first second (n,)."""
        return self.time_s < self.time_s[0] + 1.0


def prepare(record: InertialMagneticRecord) -> Prepared:
    """Remove bias, lag and motion from a record; see :class:`Prepared`.

    Everything but the lag, for which the whole record is used, is what can be known at the time.
    """
    bias = rest_bias(record)
    rate = step_rates(record.rate_rad_s - bias, record.dt_s, record.gyro_samples)
    missing = np.full_like(rate, np.nan)
    gyro_alone = _vector_record(record.time_s, rate, missing, missing)
    q_gyro = explicit_track(gyro_alone, Gains(0.0, 0.0)).q[0]
    up = _up(q_gyro, record)
    lag = _lag_s(q_gyro, record)
    field_T = _without_lag(q_gyro, record.time_s, record.field_T, lag)
    vectors = _vector_record(record.time_s, rate, missing, up)
    q_level = explicit_track(vectors, _gains(vectors), q_start=_attitude(up[0], _across(up[0]))).q[0]
    return Prepared(record.time_s, rate, bias, up, field_T, q_level, lag)


def inertial_magnetic_track(prepared: Prepared, field_T: FloatArray) -> FloatArray:
    """Attitude by the explicit filter.

    ``field_T`` (n, 3): ``prepared.field_T``, or what is left of it, NaN where it is not used. Returns (n, 4): east,
    north, up from body.
    """
    horizontal = field_T - np.sum(field_T * prepared.up, axis=1, keepdims=True) * prepared.up
    first = horizontal[prepared.starting]
    first = first[np.isfinite(first).all(axis=1)]
    if len(first) == 0:
        raise ValueError("Input field_T must be there within the first second; instead received none.")
    vectors = _vector_record(prepared.time_s, prepared.rate_rad_s, horizontal, prepared.up)
    return explicit_track(vectors, _gains(vectors), q_start=_attitude(prepared.up[0], first.mean(axis=0))).q[0]


def undisturbed(prepared: Prepared, *, length: float = 0.1, dip_rad: float = math.radians(5.0)) -> FloatArray:
    """Field, NaN where its length or dip is not that of the first second: the usual rejection.

    ``length``: largest relative difference. ``dip_rad``: largest difference. Returns (n, 3) [T].
    """
    lengths = np.linalg.norm(prepared.field_T, axis=1)
    dips = np.arcsin(np.clip(np.sum(prepared.field_T * prepared.up, axis=1) / lengths, -1.0, 1.0))
    usual, usual_dip = np.nanmedian(lengths[prepared.starting]), np.nanmedian(dips[prepared.starting])
    good = (np.abs(lengths - usual) < length * usual) & (np.abs(dips - usual_dip) < dip_rad)
    return np.where(good[:, None], prepared.field_T, np.nan)


@dataclass(frozen=True)
class MagnetTuning:
    """What :func:`sensor_fixed_field` assumes.

    ``memory``, ``threshold``: smoothed squared innovation for each axis (1 on average) above which the offset is taken
    to change. ``start_heading_rad``, ``heading_rate_rad_s``: standard deviations of the heading at the start and of its
    drift.
    """

    block: int = 10  # readings that are averaged before they are used
    sigma_T: float = 1e-6  # of a block, mostly what is left of lag and calibration
    start_T: float = 0.5e-6  # standard deviation of the sensor's own offset at the start
    walk_T: float = 0.02e-6  # growth of the offset's standard deviation in one second
    memory: float = 0.7
    threshold: float = 5.0
    growth_T: float = 1.8e-6  # by which the offset's standard deviation then grows in a block
    start_heading_rad: float = 0.01
    heading_rate_rad_s: float = math.radians(0.05)


def sensor_fixed_field(prepared: Prepared, tuning: MagnetTuning = MagnetTuning()) -> FloatArray:
    r"""Field of what moves with the sensor, a magnet or its own offset, by a Kalman filter beside the heading.

    The state is (heading ψ of the level frame, its drift, offset o), and a block of readings, turned to the level
    frame, is :math:`f(\psi) + R\,o`, f the field of the first second turned by ψ. A magnet that comes or goes makes the
    innovations grow, and then the covariance of the offset: the heading is kept by the gyro until both are known.

    Returns
    -------
    ndarray, shape (n, 3)
        Body axes [T]; constant within blocks, zero before the end of the first.
    """
    size = tuning.block
    rows = np.flatnonzero(np.isfinite(prepared.field_T).all(axis=1))
    count = len(rows) // size
    of_block = rows[: count * size].reshape(count, size)
    level = quaternion.rotate(prepared.q_level[rows], prepared.field_T[rows])
    blocks = level[: count * size].reshape(count, size, 3).mean(axis=1)
    R_level = quaternion.matrix(prepared.q_level[of_block[:, size // 2]])
    start = level[prepared.starting[rows]].mean(axis=0)
    horizontal = math.hypot(start[0], start[1])
    ends_s = prepared.time_s[of_block[:, -1]]
    steps = np.diff(ends_s, prepend=prepared.time_s[0])
    x = np.array([math.atan2(-start[0], start[1]), 0.0, 0.0, 0.0, 0.0])
    start_sigmas = [tuning.start_heading_rad, tuning.heading_rate_rad_s, *[tuning.start_T] * 3]
    P = np.diag(np.square(start_sigmas))
    F = np.eye(5)
    R = tuning.sigma_T**2 * np.eye(3)
    H = np.zeros((3, 5))
    offsets, smoothed = np.zeros((count + 1, 3)), 1.0
    for i, h in enumerate(steps):
        F[0, 1] = h
        Q = np.diag([1e-10, 1e-10 * h, *[tuning.walk_T**2 * h] * 3])
        x, P = F @ x, F @ P @ F.T + Q
        c, s = math.cos(x[0]), math.sin(x[0])
        H[:, 0] = -horizontal * c, -horizontal * s, 0.0
        H[:, 2:] = R_level[i]
        nu = blocks[i] - np.array([-horizontal * s, horizontal * c, start[2]]) - R_level[i] @ x[2:]
        S = H @ P @ H.T + R
        smoothed = tuning.memory * smoothed + (1.0 - tuning.memory) * float(nu @ np.linalg.solve(S, nu)) / 3.0
        if smoothed > tuning.threshold:
            P[2:, 2:] += tuning.growth_T**2 * np.eye(3)
            S = H @ P @ H.T + R
        K = np.linalg.solve(S, H @ P).T
        x, P = x + K @ nu, P - K @ S @ K.T
        P = 0.5 * (P + P.T)
        offsets[i + 1] = x[2:]
    return offsets[np.searchsorted(ends_s, prepared.time_s, side="right")]


def _gains(vectors: VectorRecord) -> Gains:
    return Gains(1.0 / HEADING_TIME_S, 0.0, second_weight=_UP_STEP * HEADING_TIME_S / vectors.usual_dt_s)


def _vector_record(time_s: FloatArray, rate: FloatArray, first: FloatArray, up: FloatArray) -> VectorRecord:
    north, zenith = (np.tile(axis, (len(rate), 1)) for axis in ([0.0, 1.0, 0.0], [0.0, 0.0, 1.0]))
    return VectorRecord(steps_s(time_s), rate, first, up, north, zenith, np.zeros_like(rate))


def _up(q_gyro: FloatArray, record: InertialMagneticRecord) -> FloatArray:
    from adcs.complementary.inertial_magnetic_compiled import low_pass

    steady = quaternion.rotate(q_gyro, record.acceleration_m_s2)
    start = np.nanmean(steady[record.starting], axis=0)
    smooth = low_pass(steady, record.dt_s, GRAVITY_TIME_S, start)
    up = quaternion.rotate_back(q_gyro, smooth)
    return up / np.linalg.norm(up, axis=1, keepdims=True)


def _lag_s(q_gyro: FloatArray, record: InertialMagneticRecord) -> float:
    """Lag at which the field changes least within a fifth of a second, seen from a frame that does not turn."""
    from adcs.complementary.inertial_magnetic_compiled import without_turns

    rows = np.flatnonzero(np.isfinite(record.field_T).all(axis=1))
    step = float(np.median(record.dt_s))
    apart = max(1, round(_LAG_WINDOW_S / float(np.median(np.diff(record.time_s[rows])))))
    most = round(_LONGEST_LAG_S / step)
    changes = []
    for lag in range(most + 1):
        field_T = without_turns(q_gyro, record.time_s, rows, record.field_T, lag * step)
        changes.append(float(np.mean((field_T[apart:] - field_T[:-apart]) ** 2)))
    least = int(np.argmin(changes))
    if not 0 < least < most:
        return least * step
    a, b, c = changes[least - 1 : least + 2]
    return (least + 0.5 * (a - c) / (a - 2.0 * b + c)) * step


def _without_lag(q_gyro: FloatArray, time_s: FloatArray, field_T: FloatArray, lag_s: float) -> FloatArray:
    from adcs.complementary.inertial_magnetic_compiled import without_turns

    return quaternion.rotate_back(q_gyro, without_turns(q_gyro, time_s, np.arange(len(time_s)), field_T, lag_s))


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
