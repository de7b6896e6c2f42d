"""The doors to the complementary filters: attitude of any record of a gyro and two vectors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike

from adcs import quaternion
from adcs.complementary.adaptive import AdaptiveTuning, adaptive_track
from adcs.complementary.explicit import BEST_GAINS, Gains, explicit_track
from adcs.complementary.gauss_newton import gauss_newton_track
from adcs.complementary.inertial_magnetic import (
    InertialMagneticRecord,
    inertial_magnetic_track,
    prepare,
    sensor_fixed_field,
    undisturbed,
)
from adcs.complementary.names import MAGNETS, METHODS, Magnet, Method
from adcs.satellite.attitude_track import AttitudeTrack
from adcs.satellite.telemetry import is_read
from adcs.satellite.vector_record import GyroSamples, VectorRecord, step_rates, steps_s
from arrays.typing import FloatArray

_NAMES = ("first vector", "second vector")


def complementary_filter(
    time_s: ArrayLike,
    gyro_rad_s: ArrayLike,
    body_vectors: Sequence[ArrayLike],
    frame_vectors: Sequence[ArrayLike],
    *,
    method: Method = "explicit",
    settings: Gains | AdaptiveTuning | None = None,
    gyro_samples: GyroSamples = "mean",
) -> AttitudeTrack:
    """Attitude from a gyro and two vectors, such as those of an IMU, in a frame that does not turn.

    It starts where the first readings of both vectors put it, and has used all that was read up to each instant.

    Parameters
    ----------
    time_s : array_like, shape (n,)
        Ascending, in any steps.
    gyro_rad_s : array_like, shape (n, 3)
        Rate, body axes; where NaN, the last one is held, and the next one makes up for it.
    body_vectors : two array_like, shape (n, 3)
        What is measured, of any length, such as acceleration and field; NaN where missing.
    frame_vectors : two array_like, shape (3,) or (n, 3)
        The same in the frame, such as up and the local field.
    method : str
        ``explicit`` and ``gauss-newton`` (of a measured quaternion) have fixed gains; ``adaptive`` is a Kalman filter
        that lets the bias change where its innovations grow: its first vector is to be a field in tesla.
    settings : Gains or AdaptiveTuning, optional
        By default those of a satellite with a magnetometer of 1000 nT, which forget the start in a minute.
    gyro_samples : str
        A sample is the ``mean`` rate since the one before, as of a gyro that integrates or filters, or the rate at its
        ``point`` in time.

    Returns
    -------
    AttitudeTrack
        Frame from body.

    Raises
    ------
    ValueError
        A shape does not match, the times do not ascend, a vector is zero, or the filter would be unstable.

    Examples
    --------
    >>> import adcs
    >>> import numpy as np
    >>> up, field = [0.0, 0.0, 1.0], [0.0, 20e-6, -43e-6]
    >>> at_rest = [np.tile(up, (50, 1)), np.tile(field, (50, 1))]
    >>> time_s, gyro_rad_s = np.arange(50) / 10.0, np.zeros((50, 3))
    >>> attitude = adcs.complementary_filter(time_s, gyro_rad_s, at_rest, [up, field])
    >>> bool(attitude.rotation[-1].magnitude() < 1e-6)
    True
    """
    if method not in METHODS:
        raise ValueError(f"Input method must be one of {', '.join(METHODS)}; instead received {method!r}.")
    times = np.asarray(time_s, dtype=np.float64)
    dt_s = steps_s(times)
    for name, vectors in (("body_vectors", body_vectors), ("frame_vectors", frame_vectors)):
        if len(vectors) != 2:
            raise ValueError(f"Input {name} must be two vectors; instead received {len(vectors)}.")
    rate = np.asarray(gyro_rad_s, dtype=np.float64)
    body = [np.asarray(v, dtype=np.float64) for v in body_vectors]
    frame = [np.broadcast_to(np.asarray(v, dtype=np.float64), (len(times), 3)) for v in frame_vectors]
    vectors = body[0], body[1], frame[0], frame[1]
    record = VectorRecord(dt_s, step_rates(rate, dt_s, gyro_samples), *vectors, np.zeros_like(rate))
    start = _first_attitude(body, frame)
    sigma: dict[str, FloatArray] = {}
    if method == "adaptive":
        adapted = adaptive_track(record, _of_kind(settings, AdaptiveTuning()), q_start=start)
        q, bias = adapted.q[0], adapted.bias_rad_s[0]
        deviations = np.sqrt(np.diagonal(adapted.covariance[0], axis1=-2, axis2=-1))
        sigma = {"attitude": deviations[:, :3], "gyro-bias": deviations[:, 3:]}
    else:
        run = explicit_track if method == "explicit" else gauss_newton_track
        found = run(record, _of_kind(settings, BEST_GAINS), q_start=start)
        q, bias = found.q[0], -found.integral_rad_s[0]
    return AttitudeTrack(
        title=f"complementary filter, {method}",
        time_s=times,
        rows=np.arange(len(times)),
        q=q,
        states={"rate": rate - bias, "gyro-bias": bias},
        used=_NAMES,
        seen=dict(zip(_NAMES, map(is_read, body), strict=True)),
        sigma=sigma,
    )


def inertial_magnetic_filter(
    time_s: ArrayLike,
    gyro_rad_s: ArrayLike,
    acceleration_m_s2: ArrayLike,
    field_T: ArrayLike,
    *,
    magnet: Magnet = "rejected",
    gyro_samples: GyroSamples = "mean",
) -> AttitudeTrack:
    """Attitude of an inertial unit with a magnetometer that is moved by hand, with magnets near it or not.

    The acceleration is smoothed in a frame that does not turn, the gyro's bias is that of rests, and the
    magnetometer's lag is found. The field of the first second, which must be at rest, is north.

    Parameters
    ----------
    time_s : array_like, shape (n,)
        Ascending, in any steps.
    gyro_rad_s, acceleration_m_s2, field_T : array_like, shape (n, 3)
        Body axes; at rest the acceleration is upwards. NaN where a sensor has no reading.
    magnet : str
        Readings of an unusual length or dip are ``rejected``; or a field that moves with the sensor is ``subtracted``
        as it is estimated beside the heading, for a magnet that comes or goes with it; or all are ``kept``.
    gyro_samples : str
        As of :func:`adcs.complementary_filter`.

    Returns
    -------
    AttitudeTrack
        East, north, up from body.

    Raises
    ------
    ValueError
        A shape does not match, the times do not ascend, a sensor has no first reading, or a vector is zero.

    Examples
    --------
    >>> import adcs
    >>> imu = adcs.datasets.load("imu")
    >>> readings = imu.gyro_rad_s, imu.acceleration_m_s2, imu.field_T
    >>> track = adcs.inertial_magnetic_filter(imu.time_s, *readings, magnet="subtracted")
    >>> bool((track.rotation.inv() * imu.truth).magnitude().max() < 0.1)
    True
    """
    if magnet not in MAGNETS:
        raise ValueError(f"Input magnet must be one of {', '.join(MAGNETS)}; instead received {magnet!r}.")
    times, rate, acceleration, field = (
        np.asarray(values, dtype=np.float64) for values in (time_s, gyro_rad_s, acceleration_m_s2, field_T)
    )
    prepared = prepare(InertialMagneticRecord(times, rate, acceleration, field, gyro_samples))
    used = prepared.field_T
    if magnet == "subtracted":
        used = used - sensor_fixed_field(prepared)
    elif magnet == "rejected":
        used = undisturbed(prepared)
    return AttitudeTrack(
        title=f"inertial and magnetic filter, magnet {magnet}",
        time_s=times,
        rows=np.arange(len(times)),
        q=inertial_magnetic_track(prepared, used),
        states={"rate": prepared.rate_rad_s, "gyro-bias": prepared.bias_rad_s},
        used=("accelerometer", "magnetometer"),
        seen={"accelerometer": is_read(acceleration), "magnetometer": is_read(used)},
    )


_Settings = TypeVar("_Settings", Gains, AdaptiveTuning)


def _of_kind(settings: Gains | AdaptiveTuning | None, default: _Settings) -> _Settings:
    """Settings of the filter that is asked for."""
    if settings is None:
        return default
    if not isinstance(settings, type(default)):
        raise ValueError(
            f"Input settings must be {type(default).__name__} for this method; instead received {settings!r}."
        )
    return settings


def _first_attitude(body: list[FloatArray], frame: list[FloatArray]) -> FloatArray:
    """Quaternion (4,) of the first instant that has both vectors; the identity without one."""
    from scipy.spatial.transform import Rotation

    both = np.flatnonzero(is_read(body[0]) & is_read(body[1]))
    if not both.size:
        return quaternion.IDENTITY
    seen, there = (np.stack([v[both[0]] / np.linalg.norm(v[both[0]]) for v in pair]) for pair in (body, frame))
    return quaternion.from_rotation(Rotation.align_vectors(there, seen)[0])
