"""Covariance of readings: noise, noise proportional to the field, calibration, induced fields."""

from __future__ import annotations

import numpy as np

from arrays.array import SensorArray
from arrays.typing import BoolArray, FloatArray, IntArray

# Relative addition to the variances of an uncertain calibration, which are singular: above rounding, below any effect.
_REGULAR_RTOL = 1e-13


def proportional_noise(array: SensorArray, readings_T: FloatArray) -> FloatArray:
    """Return the noise of every channel, with its part proportional to the field.

    ``σ² = noise² + (noise_fraction · |B|)²`` with |B| the modulus of the calibrated reading minus the array's mean
    (vector sensors; of a sensor alone the whole of it), or the deviation of the modulus from the mean modulus (scalar
    sensors). The noise is in the readings' units, so |B| is multiplied by the channel's gain.

    ``readings_T`` (..., C): raw readings [T], NaN where missing. Returns (..., C): standard deviations [T], in the
    units of the readings. In an incomplete reading the known axes replace the missing ones, and |B| is at least the
    largest of all complete sensors.
    """
    readings_T = np.asarray(readings_T, dtype=np.float64)
    noise = np.broadcast_to(array.channel_noise_T, readings_T.shape)
    if not array.noise_fractions.any():
        return noise.copy()
    vector = ~array.channel_is_scalar
    modulus = np.zeros_like(readings_T)
    if vector.any():
        modulus[..., vector] = _deviations(array, readings_T)[..., array.channel_sensor[vector]]
    if not vector.all():
        scalar = ~vector
        moduli = (readings_T[..., scalar] - array.channel_offset_T[scalar]) / array.channel_gain[scalar, 0]
        modulus[..., scalar] = np.abs(moduli - mean_of_finite(moduli, axis=-1))
    gain = np.linalg.norm(array.channel_gain, axis=1)
    fraction = array.noise_fractions[array.channel_sensor]
    return np.hypot(noise, fraction * gain * np.nan_to_num(modulus))


def reading_covariance(array: SensorArray, readings_T: FloatArray) -> FloatArray:
    r"""Return the covariance of the readings' errors.

    A vector sensor of scale S in the field b, in its own axes, that is turned by a small unknown rotation θ and has
    relative errors g of its gains reads :math:`S (b + θ × b + g ∘ b)`. Its block is

    .. math:: diag(σ²) + S (σ_θ² (|b|² I - b b^T) + σ_g² diag(b²) + σ_i² |b|²) S^T

    with σ of :func:`proportional_noise`. An error of an angle is perpendicular to the field; the field that is induced
    in the carrier has any direction (σ_i, `induced_uncertainty`). That of a scalar sensor is :math:`σ² + (σ_g² + σ_i²)
    (reading - offset)²`. Rotations, gains and carrier are constant, so the errors of different rows are correlated;
    this is the covariance within one row.

    ``readings_T`` (..., C): raw readings of the whole field [T], NaN where missing. The known ambient field
    replaces a missing axis of b, else the mean of the other sensors' fields, else zero. Returns (..., C, C):
    block-diagonal by sensor, in the units of the readings [T²]. Entries of missing channels are finite.
    """
    return block_diagonal(array.sensor_channels, covariance_blocks(array, readings_T))


def reading_errors(array: SensorArray, readings_T: FloatArray, normal: FloatArray) -> FloatArray:
    """Return errors (..., C) [T] with this covariance from standard normal numbers (..., C)."""
    if not array.noise_depends_on_reading:
        return array.channel_noise_T * normal
    used = array.sensor_channels >= 0
    root = np.linalg.cholesky(covariance_blocks(array, readings_T))
    slots = in_slots(used, np.asarray(normal, dtype=np.float64))
    errors: FloatArray = np.einsum("...nij,...nj->...ni", root, slots)
    return errors[..., used]


def covariance_blocks(array: SensorArray, readings_T: FloatArray) -> FloatArray:
    """Return the blocks of :func:`reading_covariance` (..., N, 3, 3) [T²]; unused slots have unit variance."""
    readings_T = np.asarray(readings_T, dtype=np.float64)
    channel, used = array.sensor_channels, array.sensor_channels >= 0
    variance = np.where(used, proportional_noise(array, readings_T)[..., channel] ** 2, 1.0)
    blocks: FloatArray = variance[..., None] * np.eye(3)
    misalignment = np.array([sensor.misalignment_rad for sensor in array.sensors])
    gain_error = np.array([sensor.gain_uncertainty for sensor in array.sensors])
    induced = np.array([sensor.induced_uncertainty for sensor in array.sensors])
    if not (misalignment.any() or gain_error.any() or induced.any()):
        return blocks
    turns, gains = np.split(calibration_errors(array, readings_T), 2, axis=-1)
    parts = [misalignment[:, None, None] * turns, gain_error[:, None, None] * gains]
    if induced.any():
        scale = _scales(array)
        field = np.linalg.norm(_fields_in_sensor_axes(array, readings_T, scale), axis=-1)
        parts.append(np.where(used[..., None], (induced * field)[..., None, None] * scale, 0.0))
    factor = np.concatenate(parts, axis=-1)
    # Formed from its factor, the product is singular to the rounding of its diagonal, also for a field along an axis.
    calibration = factor @ np.swapaxes(factor, -1, -2)
    return blocks + calibration * (1.0 + _REGULAR_RTOL * np.eye(3))


def calibration_errors(array: SensorArray, readings_T: FloatArray) -> FloatArray:
    """Return the derivatives (..., N, 3, 6) of readings by small rotations θ and gains g of a calibration.

    By sensor, axis, and (θ, g): ``S (θ × b + g ∘ b)`` [T]. A scalar sensor has its first axis only. Missing readings
    are replaced as in :func:`reading_covariance`.
    """
    readings_T, scale = np.asarray(readings_T, dtype=np.float64), _scales(array)
    b = _fields_in_sensor_axes(array, readings_T, scale)
    turned = np.swapaxes(np.cross(np.eye(3), b[..., None, :]), -1, -2)  # column k is e_k × b
    return scale @ np.concatenate([turned, b[..., None] * np.eye(3)], axis=-1)


def _scales(array: SensorArray) -> FloatArray:
    """Return the scales of the sensors (N, 3, 3), of scalar sensors in their first axis."""
    scale = np.tile(np.eye(3), (array.n_sensors, 1, 1))
    for i, sensor in enumerate(array.sensors):
        scale[i, : sensor.n_channels, : sensor.n_channels] = sensor.calibration.scale
    return scale


def _fields_in_sensor_axes(array: SensorArray, readings_T: FloatArray, scale: FloatArray) -> FloatArray:
    """Return the field at each sensor in its own axes, complete, (..., N, 3) [T]."""
    channel, used = array.sensor_channels, array.sensor_channels >= 0
    response = np.where(used, (readings_T - array.channel_offset_T)[..., channel], 0.0)
    missing = np.isnan(response)
    if missing.any():
        if array.ambient_T is not None:
            elsewhere = array.ambient_fields
        else:
            elsewhere = mean_of_finite(array.calibrated_field(readings_T), axis=-2)
        in_axes = np.einsum("nji,...nj->...ni", array.rotation_matrices, elsewhere + np.zeros((array.n_sensors, 1)))
        response = np.where(missing, np.einsum("nij,...nj->...ni", scale, in_axes), response)
    return np.einsum("nij,...nj->...ni", np.linalg.inv(scale), response)


def _deviations(array: SensorArray, readings_T: FloatArray) -> FloatArray:
    """Modulus of every sensor's field minus the array's mean: (..., N) [T]."""
    fields = array.calibrated_field(readings_T)
    # The mean estimates the common field; a single sensor has only its prior, zero.
    mean = mean_of_finite(fields, axis=-2) if array.n_sensors > 1 else np.zeros((*fields.shape[:-2], 1, 3))
    deviation: FloatArray = np.linalg.norm(fields - mean, axis=-1)
    missing = np.isnan(deviation)
    if missing.any():
        vector = np.flatnonzero(~array.channel_is_scalar)
        gain = array.channel_gain[vector]
        axes = (readings_T - array.channel_offset_T)[..., vector] - mean[..., 0, :] @ gain.T
        squares = np.full(readings_T.shape, np.nan)
        squares[..., vector] = np.where(np.isfinite(axes), axes / np.linalg.norm(gain, axis=1), np.nan) ** 2
        of_sensor = mean_of_finite(in_slots(array.sensor_channels >= 0, squares), axis=-1)[..., 0]
        largest = np.max(np.where(missing, 0.0, deviation), axis=-1, keepdims=True)
        deviation = np.where(missing, np.maximum(np.sqrt(3.0 * of_sensor), largest), deviation)
    return deviation


def mean_of_finite(values: FloatArray, axis: int) -> FloatArray:
    """Return the mean of finite values along an axis, which is kept; 0 if there are none."""
    finite = np.isfinite(values)
    count = np.maximum(finite.sum(axis=axis, keepdims=True), 1)
    return np.where(finite, values, 0.0).sum(axis=axis, keepdims=True) / count


def block_diagonal(channels: IntArray, blocks: FloatArray) -> FloatArray:
    """Return matrices (..., C, C) from blocks (..., N, 3, 3) of channels (N, 3), negative for none."""
    n = int(channels.max()) + 1
    slot = np.where(channels >= 0, channels, n)  # other slots go to a last row and column, which are removed
    matrix = np.zeros((*blocks.shape[:-3], n + 1, n + 1))
    matrix[..., slot[:, :, None], slot[:, None, :]] = blocks
    return matrix[..., :n, :n]


def in_slots(used: BoolArray, channels: FloatArray) -> FloatArray:
    """Return channels (..., C) by sensor and axis (..., N, 3); 0 for missing axes of scalar sensors."""
    if used.all():
        return channels.reshape(*channels.shape[:-1], *used.shape)
    slots = np.zeros((*channels.shape[:-1], *used.shape))
    slots[..., used] = channels
    return slots
