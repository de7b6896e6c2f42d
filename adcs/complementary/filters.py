"""Public functions of the complementary filters: attitude from a gyro and two vectors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from adcs import quaternion
from adcs.complementary.adaptive import AdaptiveTuning, adaptive_track
from adcs.complementary.attitude_filter import AttitudeConfig, filter_rows
from adcs.complementary.explicit import BEST_GAINS, Gains, complementary_track
from adcs.complementary.heading import HeadingModel, heading_track, relative_heading, rotate_to_north
from adcs.complementary.inertial.gaps import UNKNOWN_RAD
from adcs.complementary.inertial_magnetic import (
    InertialMagneticRecord,
    RecordMotion,
    check_units,
    magnetometer_lag,
    prepare,
)
from adcs.complementary.names import MAGNETS, METHODS, Magnet, Method
from adcs.satellite.attitude_track import AttitudeTrack
from adcs.satellite.telemetry import is_read
from adcs.satellite.vector_record import GyroSamples, VectorRecord, step_rates, steps_s
from adcs.satellite.wahba import attitude_of_vectors
from arrays.io.values import numbers, seconds
from arrays.typing import BoolArray, FloatArray

LEFT_OUT, SUBTRACTED = "field left out", "magnet subtracted"
"""Names of rows in which the field of an inertial unit is disturbed."""
LOST, DOUBTED = "heading lost", "heading doubtful"
"""Name of rows in which the heading of an inertial unit is hardly known."""
LOST_RAD = 0.5
_RELATIVE = (
    "there is no magnetometer: the heading is from gyro and accelerometer alone, relative to the first row, "
    "and its σ grows to {:.2g}°"
)
_NAMES = ("first vector", "second vector")
_MAGNET = 5.0  # offset of a magnet in σ of the sensor's own offset


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
    """Estimate the attitude from a gyro and two vectors, such as those of an IMU, in a fixed frame.

    The filter starts from the first readings of both vectors. Each estimate uses all readings up to its instant.

    Parameters
    ----------
    time_s : array_like, shape (n,)
        Ascending times, in any steps.
    gyro_rad_s : array_like, shape (n, 3)
        Rate, body axes. Where it is NaN, the last one is held, and the next one corrects for it.
    body_vectors : two array_like, shape (n, 3)
        Measured vectors of any length, such as acceleration and field, body axes; NaN where missing.
    frame_vectors : two array_like, shape (3,) or (n, 3)
        The same vectors in the frame, such as up and the local field.
    method : str
        ``explicit`` and ``gauss-newton`` (with a measured quaternion) have fixed gains. ``adaptive`` is a Kalman filter
        that lets the bias change when its innovations grow; its first vector must be a field in tesla.
    settings : Gains or AdaptiveTuning, optional
        Settings of the method; by default those of a satellite with a magnetometer of 1000 nT, which forget the start
        within a minute.
    gyro_samples : str
        Kind of a sample: the ``mean`` rate since the one before, as of a gyro that integrates or filters, or the rate
        at its ``point`` in time.

    Returns
    -------
    AttitudeTrack
        Attitude, frame from body, with rate and gyro bias; standard deviations from ``adaptive`` only.

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
    times = seconds(time_s)
    dt_s = steps_s(times)
    for name, vectors in (("body_vectors", body_vectors), ("frame_vectors", frame_vectors)):
        if len(vectors) != 2:
            raise ValueError(f"Input {name} must be two vectors; instead received {len(vectors)}.")
    rate, body = numbers(gyro_rad_s), list(map(numbers, body_vectors))
    frame = [np.broadcast_to(np.asarray(v, dtype=np.float64), (len(times), 3)) for v in frame_vectors]
    vectors = body[0], body[1], frame[0], frame[1]
    record = VectorRecord(dt_s, step_rates(rate, dt_s, gyro_samples), *vectors, np.zeros_like(rate))
    start = _first_attitude(body, frame)
    sigma: dict[str, FloatArray] = {}
    if method == "adaptive":
        adapted = adaptive_track(record, _check_settings(settings, AdaptiveTuning()), q_start=start)
        q, bias = adapted.q[0], adapted.bias_rad_s[0]
        deviations = np.sqrt(np.diagonal(adapted.covariance[0], axis1=-2, axis2=-1))
        sigma = {"attitude": deviations[:, :3], "gyro-bias": deviations[:, 3:]}
    else:
        found = complementary_track(record, _check_settings(settings, BEST_GAINS), method=method, q_start=start)
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
    field_T: ArrayLike | None,
    *,
    magnet: Magnet = "auto",
    gyro_samples: GyroSamples = "mean",
    offline: bool = False,
    model: HeadingModel = HeadingModel(),
) -> AttitudeTrack:
    """Estimate the attitude of a hand-held inertial unit with a magnetometer, also near magnets.

    The acceleration is smoothed in a frame that does not rotate, the gyro's bias is measured at rest, and the
    magnetometer's lag is estimated. The field of the first second, in which the unit should rest, defines north. A
    Kalman filter estimates the heading. Its further states are the gyro's scale and drift, the sensor's offset, and the
    difference of the room's field from that of the start. Without a field the heading is from the gyro, relative to
    the first row.

    Parameters
    ----------
    time_s : array_like, shape (n,)
        Ascending times, in any steps.
    gyro_rad_s, acceleration_m_s2, field_T : array_like, shape (n, 3)
        Readings in body axes, NaN where missing; at rest the acceleration is upwards. Within a gap of the gyro, σ grows
        by the possible rotation of a hand. Without a magnetometer the field is None, or NaN everywhere.
    magnet : str
        Treatment of a field that contradicts the filter. ``rejected`` ignores it. ``subtracted`` subtracts it, as the
        field of a magnet that moves with the sensor. ``auto`` ignores it until rotations show that it moves with the
        sensor, and then subtracts it. ``kept`` uses all readings.
    gyro_samples : str
        Kind of a sample, as in :func:`adcs.complementary_filter`.
    offline : bool
        Whether each instant uses the whole log, not only the readings up to it.
    model : HeadingModel
        Noise and limits of the heading filter.

    Returns
    -------
    AttitudeTrack
        Attitude, east, north, up from body. ``sigma["level"]`` (n, 3) is about east, north and up [rad]: σ of the tilt
        in the first two, of the heading in the third. ``degraded`` marks the rows in which the field is ignored, a
        magnet is subtracted, or the heading is lost or doubtful. ``warnings`` name gaps, a start that is not at rest, a
        missing magnetometer, and minutes in which the gyro alone holds the heading.

    Raises
    ------
    ValueError
        A shape does not match, the times do not ascend, a sensor has no reading within the first second, a vector is
        zero, or the unit or axes of a sensor, or the unit of time, contradict the other sensors.

    Examples
    --------
    >>> import adcs
    >>> imu = adcs.datasets.load("imu")
    >>> readings = imu.gyro_rad_s, imu.acceleration_m_s2, imu.field_T
    >>> track = adcs.inertial_magnetic_filter(imu.time_s, *readings, gyro_samples="point")
    >>> bool((track.rotation.inv() * imu.truth).magnitude().max() < 0.1)
    True
    """
    if magnet not in MAGNETS:
        raise ValueError(f"Input magnet must be one of {', '.join(MAGNETS)}; instead received {magnet!r}.")
    times, rate, acceleration = seconds(time_s), numbers(gyro_rad_s), numbers(acceleration_m_s2)
    field = np.full_like(rate, np.nan) if field_T is None else numbers(field_T)
    record = InertialMagneticRecord(times, rate, acceleration, field, gyro_samples)
    check_units(record)
    found = _smoothed(record, magnet, model) if offline else _filtered(record, magnet, model)
    of_tilt = found.tilt_sigma_rad / math.sqrt(2.0)
    return AttitudeTrack(
        title=f"inertial and magnetic filter, magnet {magnet}{', offline' if offline else ''}",
        time_s=times,
        rows=np.arange(len(times)),
        q=found.q,
        states={"rate": found.rate_rad_s, "gyro-bias": found.bias_rad_s},
        used=("accelerometer", "magnetometer") if record.has_field else ("accelerometer",),
        seen={
            "accelerometer": is_read(record.acceleration_m_s2),
            "magnetometer": is_read(record.field_T) & ~found.left_out,
        },
        sigma={
            "attitude": _body_sigma(found.q, of_tilt, found.heading_sigma_rad),
            "level": np.stack([of_tilt, of_tilt, found.heading_sigma_rad], axis=-1),
        },
        warnings=(
            *found.warnings,
            *(() if record.has_field else (_RELATIVE.format(math.degrees(found.heading_sigma_rad[-1])),)),
            *_gyro_only_minutes(times, found.left_out),
            *_doubted_times(times, found.doubted),
        ),
        degraded={
            LEFT_OUT: found.left_out,
            SUBTRACTED: found.subtracted,
            LOST: found.heading_sigma_rad > LOST_RAD,
            DOUBTED: found.doubted,
        },
    )


class _Attitudes(NamedTuple):
    """Attitudes of a record, each (n,) or (n, k)."""

    q: FloatArray
    rate_rad_s: FloatArray
    bias_rad_s: FloatArray
    tilt_sigma_rad: FloatArray
    heading_sigma_rad: FloatArray
    left_out: BoolArray
    subtracted: BoolArray
    doubted: BoolArray
    warnings: tuple[str, ...]


def _filtered(record: InertialMagneticRecord, magnet: Magnet, model: HeadingModel) -> _Attitudes:
    """Run the filter for one reading at a time over a record, with the lag of the record."""
    motion = RecordMotion.of(record, model)
    config = AttitudeConfig(magnet, record.gyro_samples, magnetometer_lag(record, motion), model)
    rows = filter_rows(config, record.time_s, record.rate_rad_s, record.acceleration_m_s2, record.field_T)
    if rows.status.any():
        raise ValueError(f"Input time_s must be within 1e14 s; instead received {np.abs(record.time_s).max():g} s.")
    left_out, subtracted, doubted = map(rows.has_flag, ("field-left-out", "magnet-subtracted", "heading-doubtful"))
    tilt, heading = rows.sigma.T.copy()
    if record.has_field:  # until the first field the filter's heading is relative to the first row
        heading[: np.argmax(is_read(record.field_T))] = UNKNOWN_RAD
    return _Attitudes(
        rows.q,
        rows.corrected_rate,
        rows.bias,
        tilt,
        heading,
        left_out,
        subtracted,
        doubted,
        motion.warnings,
    )


def _smoothed(record: InertialMagneticRecord, magnet: Magnet, model: HeadingModel) -> _Attitudes:
    """Estimate each attitude from the whole record."""
    prepared = prepare(record, model, offline=True)
    model = replace(model, gyro_drift_rad_s=max(model.gyro_drift_rad_s, prepared.bias_sigma_rad_s))
    turns = record.time_s, prepared.rate_rad_s, prepared.q_level
    if record.has_field:
        heading = heading_track(
            *turns,
            prepared.field_T,
            _limit_model(magnet, model),
            offline=True,
            hidden_rad2=prepared.hidden_rad2,
            start_tilt_rad=prepared.start_tilt_rad,
        )
    else:
        heading = relative_heading(*turns, model, hidden_rad2=prepared.hidden_rad2)
    has_magnet = heading.changes.size > 0
    return _Attitudes(
        rotate_to_north(prepared.q_level, heading.heading_rad),
        prepared.rate_rad_s,
        prepared.bias_rad_s,
        prepared.tilt_sigma_rad,
        heading.sigma_rad,
        heading.left_out,
        has_magnet & (np.linalg.norm(heading.offset_T, axis=1) > _MAGNET * model.offset_T),
        heading.doubted,
        prepared.warnings,
    )


def _limit_model(magnet: Magnet, model: HeadingModel) -> HeadingModel:
    """Return the model with the limits of a treatment of magnets."""
    if magnet == "auto":
        return model
    if magnet == "kept":
        return replace(model, gate=math.inf, mean_nis=math.inf)
    return replace(model, evidence=math.inf if magnet == "rejected" else -math.inf)


def _body_sigma(q: FloatArray, of_tilt: FloatArray, of_heading: FloatArray) -> FloatArray:
    """Return standard deviations (n, 3) about the axes of the body."""
    w, x, y, z = q.T
    up = np.stack([2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)], axis=-1)
    tilt = (of_tilt * of_tilt)[:, None]
    return np.sqrt(tilt + ((of_heading * of_heading)[:, None] - tilt) * up * up)


def _gyro_only_minutes(time_s: FloatArray, left_out: BoolArray) -> tuple[str, ...]:
    """Return a sentence for each minute in which the gyro alone holds the heading for a second or more."""
    minutes, which = np.unique((time_s[left_out] - time_s[0]) // 60.0, return_inverse=True)
    seconds = np.bincount(which, weights=steps_s(time_s)[left_out], minlength=len(minutes))
    return tuple(
        f"minute {minute + 1:.0f}: the field was ignored for {lasted:.0f} s, the gyro alone held the heading"
        for minute, lasted in zip(minutes, seconds, strict=True)
        if lasted >= 1.0
    )


def _doubted_times(time_s: FloatArray, doubted: BoolArray) -> tuple[str, ...]:
    """Return a sentence if the heading changed by more than the gyro allows for a second or more."""
    seconds = float(np.sum(steps_s(time_s)[doubted]))
    if seconds < 1.0:
        return ()
    first, last = time_s[doubted][[0, -1]] - time_s[0]
    return (
        f"the field turned the heading by more than the gyro's errors allow, for {seconds:.0f} s between {first:.0f} s"
        f" and {last:.0f} s; the heading is doubtful there, and its σ is larger",
    )


_Settings = TypeVar("_Settings", Gains, AdaptiveTuning)


def _check_settings(settings: Gains | AdaptiveTuning | None, default: _Settings) -> _Settings:
    """Return settings of the type of ``default``, which is used without any."""
    if settings is None:
        return default
    if not isinstance(settings, type(default)):
        raise ValueError(
            f"Input settings must be {type(default).__name__} for this method; instead received {settings!r}."
        )
    return settings


def _first_attitude(body: list[FloatArray], frame: list[FloatArray]) -> FloatArray:
    """Return the quaternion (4,) of the first instant with both vectors, or the identity."""
    both = np.flatnonzero(is_read(body[0]) & is_read(body[1]))[:1]
    q = attitude_of_vectors([v[both] for v in body], [v[both] for v in frame], [1.0, 1.0]).q
    return q[0] if np.isfinite(q).all() and both.size else quaternion.IDENTITY
