"""The same filter on Earth: gyro, accelerometer and magnetometer, a drop-in for the field, the Sun and the gyro.

See docs/theory/complementary-filters.md. Source of the low-pass: D. Laidig, T. Seel, VQF, Information Fusion 91, 2023.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from adcs import quaternion
from adcs.complementary.explicit import Gains, explicit_track
from adcs.satellite.vector_record import VectorRecord
from arrays.io.errors import check_positive
from arrays.typing import FloatArray

GRAVITY_TIME_S = 2.0
"""Time constant of the low-pass of the acceleration."""
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
    """Readings of one sensor at n instants.

    Attributes
    ----------
    rate_rad_s, acceleration_m_s2, field_T : ndarray, shape (n, 3)
        The acceleration is 9.8 m/s² upwards at rest.

    Raises
    ------
    ValueError
        The shapes do not match, a value is not finite, a vector is zero, or there is less than a second.
    """

    dt_s: float
    rate_rad_s: FloatArray
    acceleration_m_s2: FloatArray
    field_T: FloatArray

    def __post_init__(self) -> None:
        check_positive(dt_s=self.dt_s)
        shape = np.shape(self.rate_rad_s)
        if len(shape) != 2 or shape[1] != 3 or shape[0] * self.dt_s < 1.0:
            raise ValueError(f"Input rate_rad_s must be rows of 3 for a second at least; instead received {shape}.")
        for name in ("rate_rad_s", "acceleration_m_s2", "field_T"):
            values = np.asarray(getattr(self, name), dtype=np.float64)
            if values.shape != shape or not np.isfinite(values).all():
                raise ValueError(f"Input {name} must be finite, of shape {shape}; instead received {values.shape}.")
            if name != "rate_rad_s" and (values == 0.0).all(axis=1).any():
                raise ValueError(f"Input {name} must have a length; instead received a zero vector.")
            object.__setattr__(self, name, values)

    def __len__(self) -> int:
        """Return the number of instants."""
        return len(self.rate_rad_s)


def rest_bias(record: InertialMagneticRecord) -> FloatArray:
    """Bias of the gyro at every instant: the mean of the last 20 rests of 1.5 s, the first of them before it.

    Returns (n, 3): zero where the sensor never rests [rad/s].
    """
    window = max(2, round(_REST_S / record.dt_s))
    count = len(record) // window
    rates = record.rate_rad_s[: count * window].reshape(count, window, 3)
    accelerations = record.acceleration_m_s2[: count * window].reshape(count, window, 3)
    rest = (rates.std(axis=1).max(axis=1) < _REST_RATE_RAD_S) & (
        accelerations.std(axis=1).max(axis=1) < _REST_ACCELERATION_M_S2
    )
    found = rates[rest].mean(axis=1)
    if len(found) == 0:
        return np.zeros((len(record), 3))
    means = np.array([found[max(0, i - 19) : i + 1].mean(axis=0) for i in range(len(found))])
    # A rest is known at its end.
    latest = np.maximum(np.cumsum(np.concatenate([[False], rest])) - 1, 0)
    return means[latest[np.minimum(np.arange(len(record)) // window, count)]]


@dataclass(frozen=True, eq=False)
class Prepared:
    """What the filter needs of a record.

    ``q_level`` (n, 4): attitude of gyro and accelerometer alone: level from body, with a heading that drifts from an
    unknown start.
    """

    dt_s: float
    rate_rad_s: FloatArray  # (n, 3): less the bias
    up: FloatArray  # (n, 3): unit vector, body axes
    field_T: FloatArray  # (n, 3): turned by the gyro to where it would be without the magnetometer's lag
    q_level: FloatArray
    lag_s: float  # of the magnetometer behind the gyro


def prepare(record: InertialMagneticRecord) -> Prepared:
    """Remove bias, lag and motion from a record; see :class:`Prepared`.

    Everything but the lag, for which the whole record is used, is what can be known at the time.
    """
    rate = record.rate_rad_s - rest_bias(record)
    q_gyro = _integrated(rate, record.dt_s)
    up = _up(q_gyro, record)
    lag = _lag_samples(q_gyro, record)
    field_T = _without_lag(q_gyro, record.field_T, round(lag))
    missing = np.full_like(up, np.nan)
    vectors = _vector_record(record.dt_s, rate, missing, up)
    q_level = explicit_track(vectors, _gains(record.dt_s), q_start=_attitude(up[0], _across(up[0]))).q[0]
    return Prepared(record.dt_s, rate, up, field_T, q_level, lag * record.dt_s)


def inertial_magnetic_track(prepared: Prepared, field_T: FloatArray) -> FloatArray:
    """Attitude by the explicit filter.

    ``field_T`` (n, 3): ``prepared.field_T``, or what is left of it, NaN where it is not used. Returns (n, 4): east,
    north, up from body.
    """
    horizontal = field_T - np.sum(field_T * prepared.up, axis=1, keepdims=True) * prepared.up
    first = horizontal[: round(1.0 / prepared.dt_s)]
    first = first[np.isfinite(first).all(axis=1)]
    if len(first) == 0:
        raise ValueError("Input field_T must be there within the first second; instead received none.")
    vectors = _vector_record(prepared.dt_s, prepared.rate_rad_s, horizontal, prepared.up)
    gains = _gains(prepared.dt_s)
    return explicit_track(vectors, gains, q_start=_attitude(prepared.up[0], first.mean(axis=0))).q[0]


def undisturbed(prepared: Prepared, *, length: float = 0.1, dip_rad: float = math.radians(5.0)) -> FloatArray:
    """Field, NaN where its length or dip is not that of the first second: the usual rejection.

    ``length``: largest relative difference. ``dip_rad``: largest difference. Returns (n, 3) [T].
    """
    n_first = round(1.0 / prepared.dt_s)
    lengths = np.linalg.norm(prepared.field_T, axis=1)
    dips = np.arcsin(np.clip(np.sum(prepared.field_T * prepared.up, axis=1) / lengths, -1.0, 1.0))
    usual = np.median(lengths[:n_first])
    good = (np.abs(lengths - usual) < length * usual) & (np.abs(dips - np.median(dips[:n_first])) < dip_rad)
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
    count = len(prepared.field_T) // size
    level = quaternion.rotate(prepared.q_level, prepared.field_T)
    blocks = level[: count * size].reshape(count, size, 3).mean(axis=1)
    R_level = quaternion.matrix(prepared.q_level[size // 2 :: size][:count])
    start = blocks[: max(1, round(1.0 / (prepared.dt_s * size)))].mean(axis=0)
    horizontal = math.hypot(start[0], start[1])
    h = size * prepared.dt_s
    x = np.array([math.atan2(-start[0], start[1]), 0.0, 0.0, 0.0, 0.0])
    start_sigmas = [tuning.start_heading_rad, tuning.heading_rate_rad_s, *[tuning.start_T] * 3]
    P = np.diag(np.square(start_sigmas))
    F = np.eye(5)
    F[0, 1] = h
    Q = np.diag([1e-10, 1e-10 * h, *[tuning.walk_T**2 * h] * 3])
    R = tuning.sigma_T**2 * np.eye(3)
    H = np.zeros((3, 5))
    offsets, smoothed = np.zeros((count + 1, 3)), 1.0
    for i in range(count):
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
    return offsets[np.minimum(np.arange(len(prepared.field_T)) // size, count)]


def _gains(dt_s: float) -> Gains:
    return Gains(1.0 / HEADING_TIME_S, 0.0, second_weight=_UP_STEP * HEADING_TIME_S / dt_s)


def _vector_record(dt_s: float, rate: FloatArray, first: FloatArray, up: FloatArray) -> VectorRecord:
    north, zenith = (np.tile(axis, (len(rate), 1)) for axis in ([0.0, 1.0, 0.0], [0.0, 0.0, 1.0]))
    return VectorRecord(dt_s, rate, first, up, north, zenith, np.zeros_like(rate))


def _integrated(rate: FloatArray, dt_s: float) -> FloatArray:
    """Attitude (n, 4) of the gyro alone, from the identity on."""
    missing = np.full_like(rate, np.nan)
    return explicit_track(_vector_record(dt_s, rate, missing, missing), Gains(0.0, 0.0)).q[0]


def _up(q_gyro: FloatArray, record: InertialMagneticRecord) -> FloatArray:
    from scipy.signal import butter, sosfilt, sosfilt_zi

    # A Butterworth filter of second order rises to 1 - 1/e within the time constant at this frequency.
    cutoff_Hz = math.sqrt(2.0) / (2.0 * math.pi * GRAVITY_TIME_S)
    sections = butter(2, 2.0 * record.dt_s * cutoff_Hz, output="sos")
    steady = quaternion.rotate(q_gyro, record.acceleration_m_s2)
    first = steady[: max(1, round(min(GRAVITY_TIME_S, 1.0) / record.dt_s))].mean(axis=0)
    start = sosfilt_zi(sections)[..., None] * first
    smooth, _ = sosfilt(sections, steady, axis=0, zi=start)
    up = quaternion.rotate_back(q_gyro, smooth)
    return up / np.linalg.norm(up, axis=1, keepdims=True)


def _lag_samples(q_gyro: FloatArray, record: InertialMagneticRecord) -> float:
    """Lag at which the field changes least within a fifth of a second, seen from a frame that does not turn."""
    apart = max(1, round(_LAG_WINDOW_S / record.dt_s))
    most = round(_LONGEST_LAG_S / record.dt_s)
    changes = []
    for lag in range(most + 1):
        field_T = quaternion.rotate(q_gyro, _without_lag(q_gyro, record.field_T, lag))
        changes.append(float(np.mean((field_T[apart:] - field_T[:-apart]) ** 2)))
    least = int(np.argmin(changes))
    if not 0 < least < most:
        return float(least)
    a, b, c = changes[least - 1 : least + 2]
    return least + 0.5 * (a - c) / (a - 2.0 * b + c)


def _without_lag(q_gyro: FloatArray, field_T: FloatArray, lag: int) -> FloatArray:
    then = q_gyro[np.maximum(np.arange(len(q_gyro)) - lag, 0)]
    return quaternion.rotate_back(q_gyro, quaternion.rotate(then, field_T))


def _attitude(up: FloatArray, north: FloatArray) -> FloatArray:
    """East, north, up from body: quaternion (4,) of an upward unit vector and one that leans to the north."""
    from scipy.spatial.transform import Rotation

    y = north - north @ up * up
    y = y / np.linalg.norm(y)
    return quaternion.from_rotation(Rotation.from_matrix(np.stack([np.cross(y, up), y, up])))


def _across(v: FloatArray) -> FloatArray:
    """Some axis that is not along v."""
    return np.eye(3)[np.argmin(np.abs(v))]
