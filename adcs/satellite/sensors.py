"""Models of the attitude sensors: their readings, and the conditions for a reading.

See docs/theory/satellite-dynamics-and-sensors.md. Defaults are Table 1 of the source: Ivanov, Ivlev, Karpenko,
Ovchinnikov, Keldysh Institute preprint 64, 2014.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from adcs import quaternion
from arrays.typing import BoolArray, FloatArray

ANGLE_NOISE_RAD = math.radians(0.0005)
"""Noise of the star tracker's quaternion: half of the noise of the angle, 0.001°."""
FIVE_HEADS: FloatArray = np.array(
    [[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]]
)
"""Axes of Sun heads on ±x, ±y and +z; +z points to the zenith in the orbital frame."""

SENSORS = ("st", "gyro", "mag", "sun")
"""Names of star tracker, gyro, magnetometer and Sun sensor, in the order in which filters process them."""
SENSOR_WORDS = dict(zip(SENSORS, ("star tracker", "gyro", "magnetometer", "Sun sensor"), strict=True))
NIS_SIZES = dict(zip(SENSORS, (3, 3, 3, 2), strict=True))
"""Degrees of freedom of a sensor's NIS; a direction to the Sun has two."""


class _Sensor:
    """Checks of the parameters of all sensors."""

    def __post_init__(self) -> None:
        """Raise ValueError if a parameter is not finite, negative, or zero where it must be positive."""
        for name, value in vars(self).items():
            values = np.array(value, dtype=np.float64)
            if np.isnan(values).any():
                raise ValueError(f"Input {name} must be numbers; instead received NaN.")
            if name in ("misalignment_rad", "boresight_body", "heads_body"):
                if values.shape[-1:] != (3,) or not np.isfinite(values).all():
                    raise ValueError(f"Input {name} must be 3 finite numbers; instead received shape {values.shape}.")
                object.__setattr__(self, name, values)
                continue
            may_be_zero = name.endswith("exclusion_rad") or name.startswith("bias_walk")
            if values < 0.0 or (values == 0.0 and not may_be_zero):
                raise ValueError(
                    f"Input {name} must be {'0 or more' if may_be_zero else 'positive'}; instead received {values}."
                )


@dataclass(frozen=True, eq=False)
class StarTracker(_Sensor):
    """Star tracker, which measures the attitude.

    Attributes
    ----------
    sigma_rad : float
        Standard deviation of each component of the vector part of the quaternion's error: half of that of the angle.
    rate_limit_rad_s : float
        Largest rate at which stars are found.
    boresight_body : ndarray, shape (3,)
        Optical axis.
    sun_exclusion_rad, earth_exclusion_rad : float
        Least angle of the axis from the Sun, and from the limb of the Earth.
    misalignment_rad : ndarray, shape (3,)
        Rotation vector of the misalignment.

    Raises
    ------
    ValueError
        A number is not finite, or not positive where it must be.
    """

    sigma_rad: float = ANGLE_NOISE_RAD
    rate_limit_rad_s: float = math.radians(2.0)
    boresight_body: FloatArray = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    sun_exclusion_rad: float = 0.0
    earth_exclusion_rad: float = 0.0
    misalignment_rad: FloatArray = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        super().__post_init__()
        length = float(np.linalg.norm(self.boresight_body))
        if not length > 0.0:
            raise ValueError("Input boresight_body must have a length; instead received a zero vector.")
        object.__setattr__(self, "boresight_body", self.boresight_body / length)


@dataclass(frozen=True, eq=False)
class Gyro(_Sensor):
    """Gyro, which measures the rate against inertial space.

    Attributes
    ----------
    sigma_rad_s : float
        Standard deviation of one reading of one axis.
    range_rad_s : float
        Largest rate of an axis.
    bias_walk_rad_s : float
        Growth of the bias's standard deviation in one second [rad/s per √s].
    misalignment_rad : ndarray, shape (3,)
        Rotation vector of the misalignment.

    Raises
    ------
    ValueError
        A number is not finite, or not positive where it must be.
    """

    sigma_rad_s: float = math.radians(0.005)
    range_rad_s: float = math.radians(250.0)
    bias_walk_rad_s: float = 0.0
    misalignment_rad: FloatArray = field(default_factory=lambda: np.zeros(3))


@dataclass(frozen=True, eq=False)
class Magnetometer(_Sensor):
    """Magnetometer, which measures the field.

    Attributes
    ----------
    sigma_T : float
        Standard deviation of one reading of one axis.
    range_T : float
        Largest field along an axis.
    bias_walk_T : float
        Growth of the bias's standard deviation in one second [T per √s].
    misalignment_rad : ndarray, shape (3,)
        Rotation vector of the misalignment.

    Raises
    ------
    ValueError
        A number is not finite, or not positive where it must be.
    """

    sigma_T: float = 250e-9
    range_T: float = 200_000e-9
    bias_walk_T: float = 0.0
    misalignment_rad: FloatArray = field(default_factory=lambda: np.zeros(3))


@dataclass(frozen=True, eq=False)
class SunSensor(_Sensor):
    """Sun sensor: heads that measure the direction to the Sun.

    Attributes
    ----------
    sigma_rad : float
        Standard deviation of the direction along each of two axes across it.
    heads_body : ndarray, shape (h, 3)
        Axes of the heads.
    half_field_rad : float
        Half the side of the square field. A head sees the Sun if both angles are within it: those of the projections on
        the planes through the head's axis and its two sides.
    misalignment_rad : ndarray, shape (3,)
        Rotation vector of all heads together.

    Raises
    ------
    ValueError
        A number is not finite, or not positive where it must be, or a head has no direction.
    """

    sigma_rad: float = math.radians(0.1)
    heads_body: FloatArray = field(default_factory=lambda: FIVE_HEADS.copy())
    half_field_rad: float = math.radians(45.0)
    misalignment_rad: FloatArray = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        super().__post_init__()
        heads = np.atleast_2d(self.heads_body)
        lengths = np.linalg.norm(heads, axis=-1, keepdims=True)
        if heads.ndim != 2 or heads.shape[1] != 3 or not (lengths > 0.0).all():
            raise ValueError(f"Input heads_body must be vectors that are not zero; instead received {heads.tolist()}.")
        object.__setattr__(self, "heads_body", heads / lengths)


def star_tracker_readings(
    tracker: StarTracker,
    q: ArrayLike,
    w: ArrayLike,
    sun_orbital: ArrayLike,
    earth_radius_rad: ArrayLike,
    illuminated: ArrayLike,
    unit_noise: ArrayLike,
) -> FloatArray:
    """Return the readings of a star tracker, q∘exp of misalignment and noise.

    ``q`` (..., 4): true attitude, orbital from body. ``w`` (..., 3): true rate [rad/s]. ``sun_orbital`` (..., 3): unit
    vector to the Sun, which blinds the tracker unless it is eclipsed. ``earth_radius_rad`` (...): angular radius of the
    Earth around nadir. ``illuminated`` (...): visible part of the Sun. ``unit_noise`` (..., 3): standard normal
    numbers. Returns (..., 4): orbital from body, NaN without a reading.
    """
    delta = tracker.sigma_rad * np.asarray(unit_noise, dtype=np.float64)
    turned_by = quaternion.multiply(quaternion.exp(tracker.misalignment_rad), quaternion.from_error_vector(delta))
    blinded = is_blinded(tracker, q, sun_orbital, earth_radius_rad, illuminated)
    seen = (np.linalg.norm(w, axis=-1) <= tracker.rate_limit_rad_s) & ~blinded
    return np.where(seen[..., None], quaternion.multiply(q, turned_by), np.nan)


def is_blinded(
    tracker: StarTracker,
    q: ArrayLike,
    sun_orbital: ArrayLike,
    earth_radius_rad: ArrayLike,
    illuminated: ArrayLike,
) -> BoolArray:
    """Return whether Sun or Earth blind a star tracker; arguments as for :func:`star_tracker_readings`."""
    axis = quaternion.rotate(q, tracker.boresight_body)
    sun_away = np.arccos(np.clip(np.sum(axis * np.asarray(sun_orbital, dtype=np.float64), axis=-1), -1.0, 1.0))
    nadir_away = np.arccos(np.clip(-axis[..., 2], -1.0, 1.0))
    sees_sun = (sun_away <= tracker.sun_exclusion_rad) & (np.asarray(illuminated) > 0.0)
    return np.asarray(sees_sun | (nadir_away <= np.asarray(earth_radius_rad) + tracker.earth_exclusion_rad))


def gyro_readings(gyro: Gyro, w: ArrayLike, bias_rad_s: ArrayLike, unit_noise: ArrayLike) -> FloatArray:
    """Return the readings of a gyro [rad/s]; arguments (..., 3), NaN if an axis is beyond the range."""
    return _vector_readings(w, gyro.misalignment_rad, bias_rad_s, gyro.sigma_rad_s, unit_noise, gyro.range_rad_s)


def magnetometer_readings(
    magnetometer: Magnetometer, b_body_T: ArrayLike, bias_T: ArrayLike, unit_noise: ArrayLike
) -> FloatArray:
    """Return the readings of a magnetometer [T]; arguments (..., 3), NaN as in :func:`gyro_readings`."""
    m = magnetometer
    return _vector_readings(b_body_T, m.misalignment_rad, bias_T, m.sigma_T, unit_noise, m.range_T)


def sun_readings(sensor: SunSensor, sun_body: ArrayLike, illuminated: ArrayLike, unit_noise: ArrayLike) -> FloatArray:
    """Return the readings of the Sun heads.

    Noise rotates the direction by ``sigma_rad`` about each of two axes across it. It is added to all three components,
    and normalising the sum removes the part along the direction.
    ``sun_body`` (..., 3): true unit vector. ``illuminated`` (...): visible part of the Sun, of which a half is needed.
    ``unit_noise`` (..., 3): standard normal numbers. Returns (..., 3): unit vectors, NaN if no head sees the Sun.
    """
    sun = np.asarray(sun_body, dtype=np.float64)
    seen = is_in_field(sensor, sun).any(axis=-1) & (np.asarray(illuminated) >= 0.5)
    noise = sensor.sigma_rad * np.asarray(unit_noise, dtype=np.float64)
    reading = quaternion.rotate_back(quaternion.exp(sensor.misalignment_rad), sun) + noise
    return np.where(seen[..., None], reading / np.linalg.norm(reading, axis=-1, keepdims=True), np.nan)


def is_in_field(sensor: SunSensor, direction_body: ArrayLike) -> BoolArray:
    """Return which heads have a direction in their square fields, (..., 3) -> (..., h)."""
    axes = np.stack([_head_axes(axis) for axis in sensor.heads_body])
    along = np.einsum("hij,...j->...hi", axes, np.asarray(direction_body, dtype=np.float64))
    angles = np.abs(np.arctan2(along[..., :2], along[..., 2:]))
    # Rounding must not exclude a direction on the edge between two heads from both.
    return np.asarray((angles <= sensor.half_field_rad + 1e-12).all(axis=-1))


def _vector_readings(
    true: ArrayLike, misalignment_rad: FloatArray, bias: ArrayLike, sigma: float, unit_noise: ArrayLike, largest: float
) -> FloatArray:
    in_sensor = quaternion.rotate_back(quaternion.exp(misalignment_rad), true)
    noise = sigma * np.asarray(unit_noise, dtype=np.float64)
    reading = in_sensor + np.asarray(bias, dtype=np.float64) + noise
    within = (np.abs(reading) <= largest).all(axis=-1, keepdims=True)
    return np.where(within, reading, np.nan)


def _head_axes(axis: FloatArray) -> FloatArray:
    """Return two sides of the square field and the axis as rows.

    The first side is along the body axis with the largest angle to the head's axis.
    """
    side = np.eye(3)[np.argmin(np.abs(axis))]
    x = side - axis * (axis @ side)
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(axis, x), axis])
