r"""Differences between sensors, their covariance, and the decorrelated form of both.

The measurements of a gradiometer are differences between its sensors: what is common to all
sensors (the ambient field and its variations in time) drops out, and no derivative is estimated.
Differences that share a base sensor have correlated noise. Two forms remove the correlation:

* :class:`Differences`, the form of the source paper: independent scalars
  :math:`z' = W y` with variances, which a filter may process one at a time.
* :class:`Whitening`, the same likelihood written as a projection: the readings of every sensor freed
  of their own noise, the common field projected out. A model costs O(channels) instead of O(channels²),
  which is what compiled fits want.

Both hold for any number of vector and scalar sensors, any calibration and missing readings, and any
noise that is independent between sensors (:func:`reading_covariance`); that they give the same
:math:`\chi^2` is a tested identity.

Source: Pavlov, Karshakov, Goldin, "Determination of the magnetic field parameters of an object from
remote magnetogradient measurements", equations (5), (9), (13)-(16), (20), (24), (28).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, helmert, null_space

from arrays.sensor import SensorArray

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_EQUAL_NOISE_RTOL = 1e-12
# Relative addition to the variances of an uncertain calibration, which are singular: above rounding, below any effect.
_REGULAR_RTOL = 1e-13


def contrasts(n_sensors: int, base: int = -1) -> FloatArray:
    """Differences against a base sensor as a matrix, equations (5) and (20).

    Parameters
    ----------
    n_sensors : int
        Number of sensors, at least 2.
    base : int
        Index of the base sensor; the paper's is the last one.

    Returns
    -------
    ndarray, shape (n_sensors - 1, n_sensors)
        Rows with +1 at a sensor and -1 at the base, in sensor order.
    """
    if n_sensors < 2:
        raise ValueError(f"Input n_sensors must be at least 2; instead received {n_sensors}.")
    base = range(n_sensors)[base]
    rows = np.delete(np.eye(n_sensors), base, axis=0)
    rows[:, base] = -1.0
    return rows


def difference_covariance(noise: FloatArray, base: int = -1) -> FloatArray:
    """Covariance of the differences against a base sensor, equation (13) for any noise.

    Parameters
    ----------
    noise : ndarray, shape (N,)
        Standard deviation of each sensor [T].
    base : int
        Index of the base sensor.

    Returns
    -------
    ndarray, shape (N - 1, N - 1)
        ``diag(noise_i²) + noise_base² 1 1ᵀ`` [T²].
    """
    noise = np.asarray(noise, dtype=np.float64)
    d = contrasts(noise.size, base)
    return (d * noise**2) @ d.T


def helmert_decorrelation(n_differences: int) -> FloatArray:
    """Orthonormal eigenvectors of ``I + 1 1ᵀ``, equation (14) for any number of differences.

    Row 0 belongs to the eigenvalue ``n_differences + 1``, the others to the eigenvalue 1 (equation (15)).
    For three differences this is the paper's T to the sign.

    Parameters
    ----------
    n_differences : int
        Number of differences that share a base sensor, at least 1.

    Returns
    -------
    ndarray, shape (n_differences, n_differences)
    """
    if n_differences < 1:
        raise ValueError(f"Input n_differences must be at least 1; instead received {n_differences}.")
    t: FloatArray = helmert(n_differences, full=True)[:, ::-1].copy()
    t[1:2] *= -1.0  # the sign that the paper prints for (0, 1, -1)/√2
    return t


def eigen_decorrelation(covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Orthonormal T and variances with ``T R Tᵀ = diag(variance)``, for any covariance R.

    Parameters
    ----------
    covariance : ndarray, shape (n, n)
        Symmetric positive definite.

    Returns
    -------
    transform : ndarray, shape (n, n)
        Eigenvectors as rows, largest eigenvalue first as in equation (15).
    variance : ndarray, shape (n,)
        Eigenvalues in the same order.
    """
    # LAPACK's tolerances are absolute in the largest entry: field variances in T² need scaling to keep their digits.
    scale = float(np.max(np.abs(np.diagonal(covariance))))
    eigenvalue, eigenvector = np.linalg.eigh(covariance / scale)
    return eigenvector.T[::-1].copy(), eigenvalue[::-1] * scale


@dataclass(frozen=True, eq=False)
class Differences:
    """Independent scalar differences ``z' = transform @ (readings - offset)`` of an array.

    Attributes
    ----------
    transform : ndarray, shape (k, C)
        From the array's channels, offset removed, to decorrelated differences. Columns of missing channels are zero.
    variance : ndarray, shape (k,)
        Variance of each decorrelated difference [T²].
    """

    transform: FloatArray
    variance: FloatArray

    @property
    def n_differences(self) -> int:
        """Number of independent scalars k."""
        return int(self.variance.size)


@dataclass(frozen=True, eq=False)
class Whitening:
    """The differences' likelihood as a projection: ``w = e - Q (g ∘ Qᵀ e)``, ``e = L⁻¹ y``, noise covariance ``L Lᵀ``.

    ``wᵀ w`` equals the χ² of :class:`Differences`, for the same readings.

    Attributes
    ----------
    root : ndarray, shape (C, C)
        ``L⁻¹`` [1/T], block-diagonal by sensor: 1/σ of every channel where the channels' noise is independent. Rows and
        columns of missing channels are zero; a sensor's other channels keep the covariance that they have without them.
    basis : ndarray, shape (C, q)
        Orthonormal basis of the common field in channels of unit noise.
    shrinkage : ndarray, shape (q,)
        1 where the common field is unknown, less where a prior bounds it.
    n_differences : int
        Number of independent scalars in w.
    """

    root: FloatArray
    basis: FloatArray
    shrinkage: FloatArray
    n_differences: int

    def apply(self, channels: FloatArray) -> FloatArray:
        """Whitened channels.

        Parameters
        ----------
        channels : ndarray, shape (..., C)
            Readings with their offset removed, or predictions, or one column of a Jacobian [T]. Missing entries must
            be finite; they do not count.

        Returns
        -------
        ndarray, shape (..., C)
            Residuals of unit variance once the common field is projected out.
        """
        e = channels @ self.root.T
        w: FloatArray = e - ((e @ self.basis) * self.shrinkage) @ self.basis.T
        return w


def decorrelated_differences(
    array: SensorArray,
    available: BoolArray | None = None,
    *,
    base: int = -1,
    covariance_T2: FloatArray | None = None,
) -> Differences:
    """Decorrelated differences of an array, equations (16) and (28) for any sensors.

    Vector sensors and scalar sensors are differenced within their own kind. Sensors of equal noise use the closed
    form (the paper's T for four sensors, Helmert's for any number), other cases numerical eigenvectors. With
    ``array.common_field_T`` the common field is not removed but marginalised with that prior.

    Parameters
    ----------
    array : SensorArray
    available : ndarray of bool, shape (C,), optional
        Channels that have a reading; all by default.
    base : int
        Base sensor among the complete sensors of a kind. It changes the differences, never their likelihood.
    covariance_T2 : ndarray, shape (C, C), optional
        Covariance of the channels' noise in place of the array's own [T²], as one of :func:`reading_covariance`:
        block-diagonal by sensor. What it holds of channels without a reading does not count.

    Returns
    -------
    Differences
        With k = channels - rank of the common field; k = channels under a prior.
    """
    mask, covariance = _channels(array, available, covariance_T2)
    transforms: list[FloatArray] = []
    variances: list[FloatArray] = []
    for group in _groups(array, mask):
        closed = None if array.common_field_T is not None else _closed_form(array, group, mask, covariance, base)
        w, variance = closed if closed is not None else _numerical_form(array, group, covariance)
        full = np.zeros((variance.size, array.n_channels))
        full[:, group] = w
        transforms.append(full)
        variances.append(variance)
    if not transforms:
        return Differences(np.zeros((0, array.n_channels)), np.zeros(0))
    return Differences(np.concatenate(transforms), np.concatenate(variances))


def whitening(
    array: SensorArray, available: BoolArray | None = None, *, covariance_T2: FloatArray | None = None
) -> Whitening:
    """The projection form of :func:`decorrelated_differences`, with the same parameters.

    With channels ``y = U c + n``, n of covariance ``L Lᵀ`` and c the common field of prior variance λ:
    ``L⁻¹ U = Q diag(s) Vᵀ`` gives the shrinkage ``1 - 1/√(1 + s² λ)``, which is 1 for an unknown field.
    """
    mask, covariance = _channels(array, available, covariance_T2)
    return whitenings(array, mask, covariance[None])[0]


def whitenings(array: SensorArray, available: BoolArray, covariances_T2: FloatArray) -> list[Whitening]:
    """Whitening of each of n covariances at once, for rows that have the same readings.

    Parameters
    ----------
    array : SensorArray
    available : ndarray of bool, shape (C,)
        Channels that have a reading.
    covariances_T2 : ndarray, shape (n, C, C)
        As one of :func:`reading_covariance` [T²].

    Returns
    -------
    list of Whitening
        As :func:`whitening` makes them one by one.
    """
    n_rows, n = len(covariances_T2), array.n_channels
    root = _inverse_root(array, available, covariances_T2)
    gain = root @ array.channel_gain
    basis, shrinkage, keep = np.zeros((n_rows, n, 0)), np.zeros((n_rows, 0)), np.zeros((n_rows, 0), dtype=np.bool_)
    for group in _groups(array, available):
        q, s, _ = np.linalg.svd(_common_field(array, group, gain), full_matrices=False)
        of_group = np.zeros((n_rows, n, s.shape[1]))
        of_group[:, group] = q
        basis = np.concatenate([basis, of_group], axis=2)
        keep = np.concatenate([keep, s > s.max(axis=1, keepdims=True, initial=0.0) * 1e-10], axis=1)
        prior = np.inf if array.common_field_T is None else array.common_field_T
        with np.errstate(invalid="ignore"):  # zero times infinity, for what is not kept
            shrinkage = np.concatenate([shrinkage, 1.0 - 1.0 / np.sqrt(1.0 + (s * prior) ** 2)], axis=1)
    lost = keep.sum(axis=1) if array.common_field_T is None else np.zeros(n_rows, dtype=np.intp)
    n_differences = (int(available.sum()) - lost).tolist()
    return [Whitening(root[i], basis[i][:, keep[i]], shrinkage[i, keep[i]], n_differences[i]) for i in range(n_rows)]


def proportional_noise(array: SensorArray, readings_T: FloatArray) -> FloatArray:
    """Noise of every channel when a part of it is proportional to the field.

    ``σ² = noise² + (noise_fraction · |B|)²`` with |B| the modulus of the calibrated reading minus the array's mean
    (vector sensors), or the deviation of the modulus from the mean modulus (scalar sensors). The noise is in the
    readings' units, so |B| is multiplied by the channel's gain.

    Parameters
    ----------
    array : SensorArray
    readings_T : ndarray, shape (..., C)
        Raw readings [T], NaN where missing.

    Returns
    -------
    ndarray, shape (..., C)
        Standard deviations [T], in the units of the readings. Of a sensor whose reading is incomplete the known axes
        stand for the missing ones, and the largest |B| of a complete sensor is the least it is given.
    """
    readings_T = np.asarray(readings_T, dtype=np.float64)
    noise = np.broadcast_to(array.channel_noise_T, readings_T.shape)
    if array.noise_fraction == 0.0:
        return noise.copy()
    vector = ~array.channel_is_scalar
    modulus = np.zeros_like(readings_T)
    if vector.any():
        modulus[..., vector] = _deviations(array, readings_T)[..., array.channel_sensor[vector]]
    if not vector.all():
        scalar = ~vector
        moduli = (readings_T[..., scalar] - array.channel_offset_T[scalar]) / array.channel_gain[scalar, 0]
        modulus[..., scalar] = np.abs(moduli - _mean_of_finite(moduli, axis=-1))
    gain = np.linalg.norm(array.channel_gain, axis=1)
    result: FloatArray = np.hypot(noise, array.noise_fraction * gain * np.nan_to_num(modulus))
    return result


def reading_covariance(array: SensorArray, readings_T: FloatArray) -> FloatArray:
    r"""Covariance of the readings' errors: noise, proportional noise, and what the calibration does not know.

    A vector sensor of scale S in the field b, in its own axes, that is turned by a small unknown rotation θ and has
    relative errors g of its gains reads :math:`S (b + θ × b + g ∘ b)`. Its block is

    .. math:: diag(σ²) + S (σ_θ² (|b|² I - b b^T) + σ_g² diag(b²)) S^T

    with σ of :func:`proportional_noise`; the error of an angle stands at right angles to the field. That of a scalar
    sensor is :math:`σ² + σ_g² (reading - offset)²`. The rotations and gains are constant, so that the errors of one
    sensor's rows are not independent of each other: this is their covariance within one row.

    Parameters
    ----------
    array : SensorArray
    readings_T : ndarray, shape (..., C)
        Raw readings of the whole field [T], NaN where missing. For a missing axis of b stands the known ambient field,
        else the mean of the other sensors' fields, else zero.

    Returns
    -------
    ndarray, shape (..., C, C)
        Block-diagonal by sensor, in the units of the readings [T²]. Entries of missing channels are finite.
    """
    return _block_diagonal(array, _covariance_blocks(array, readings_T), array.sensor_channels >= 0)


def reading_errors(array: SensorArray, readings_T: FloatArray, normal: FloatArray) -> FloatArray:
    """Errors of the covariance of :func:`reading_covariance`, from independent standard normal numbers.

    Parameters
    ----------
    array : SensorArray
    readings_T : ndarray, shape (..., C)
        Readings without errors [T].
    normal : ndarray, shape (..., C)
        The numbers.

    Returns
    -------
    ndarray, shape (..., C)
        To be added to the readings [T].
    """
    if not array.noise_depends_on_reading:
        return array.channel_noise_T * normal
    channel, used = array.sensor_channels, array.sensor_channels >= 0
    root = np.linalg.cholesky(_covariance_blocks(array, readings_T))
    slots = np.where(used, np.asarray(normal, dtype=np.float64)[..., channel], 0.0)
    errors: FloatArray = np.einsum("...nij,...nj->...ni", root, slots)
    return errors[..., used]


def _covariance_blocks(array: SensorArray, readings_T: FloatArray) -> FloatArray:
    """Blocks of :func:`reading_covariance`, (..., N, 3, 3) [T²], with unit variances in the slots that are not used."""
    readings_T = np.asarray(readings_T, dtype=np.float64)
    channel, used = array.sensor_channels, array.sensor_channels >= 0
    variance = np.where(used, proportional_noise(array, readings_T)[..., channel] ** 2, 1.0)
    blocks: FloatArray = variance[..., None] * np.eye(3)
    misalignment = np.array([sensor.misalignment_rad for sensor in array.sensors])
    gain_error = np.array([sensor.gain_uncertainty for sensor in array.sensors])
    if not (misalignment.any() or gain_error.any()):
        return blocks
    turns, gains = np.split(calibration_errors(array, readings_T), 2, axis=-1)
    factor = np.concatenate([misalignment[:, None, None] * turns, gain_error[:, None, None] * gains], axis=-1)
    # Formed from its factor, the product is singular to the rounding of its diagonal, also for a field along an axis.
    calibration = factor @ np.swapaxes(factor, -1, -2)
    return blocks + calibration * (1.0 + _REGULAR_RTOL * np.eye(3))


def calibration_errors(array: SensorArray, readings_T: FloatArray) -> FloatArray:
    """What small errors of a calibration do to the readings: derivatives with respect to turns θ and gains g.

    Parameters
    ----------
    array : SensorArray
    readings_T : ndarray, shape (..., C)
        Raw readings [T], NaN where missing; see :func:`reading_covariance` for what stands for those.

    Returns
    -------
    ndarray, shape (..., N, 3, 6)
        By sensor, its three axes, and (θ, g): ``S (θ × b + g ∘ b)`` [T]. A scalar sensor has its first axis only.
    """
    readings_T = np.asarray(readings_T, dtype=np.float64)
    scale = np.tile(np.eye(3), (array.n_sensors, 1, 1))
    for i, sensor in enumerate(array.sensors):
        scale[i, : sensor.n_channels, : sensor.n_channels] = sensor.calibration.scale
    b = _fields_in_sensor_axes(array, readings_T, scale)
    turned = np.swapaxes(np.cross(np.eye(3), b[..., None, :]), -1, -2)  # column k is e_k × b
    derivative: FloatArray = scale @ np.concatenate([turned, b[..., None] * np.eye(3)], axis=-1)
    return derivative


def _fields_in_sensor_axes(array: SensorArray, readings_T: FloatArray, scale: FloatArray) -> FloatArray:
    """Field that each sensor saw, in its own axes, complete: (..., N, 3) [T]; (modulus, 0, 0) of a scalar sensor."""
    channel, used = array.sensor_channels, array.sensor_channels >= 0
    response = np.where(used, (readings_T - array.channel_offset_T)[..., channel], 0.0)
    missing = np.isnan(response)
    if missing.any():
        if array.ambient_T is not None:
            elsewhere = array.ambient_fields
        else:
            elsewhere = _mean_of_finite(array.calibrated_field(readings_T), axis=-2)
        in_axes = np.einsum("nji,...nj->...ni", array.rotation_matrices, elsewhere + np.zeros((array.n_sensors, 1)))
        response = np.where(missing, np.einsum("nij,...nj->...ni", scale, in_axes), response)
    field: FloatArray = np.einsum("nij,...nj->...ni", np.linalg.inv(scale), response)
    return field


def _deviations(array: SensorArray, readings_T: FloatArray) -> FloatArray:
    """Modulus of every sensor's field minus the array's mean: (..., N) [T]."""
    fields = array.calibrated_field(readings_T)
    mean = _mean_of_finite(fields, axis=-2)
    deviation: FloatArray = np.linalg.norm(fields - mean, axis=-1)
    missing = np.isnan(deviation)
    if missing.any():
        vector = np.flatnonzero(~array.channel_is_scalar)
        gain = array.channel_gain[vector]
        axes = (readings_T - array.channel_offset_T)[..., vector] - mean[..., 0, :] @ gain.T
        axes = np.where(np.isfinite(axes), axes / np.linalg.norm(gain, axis=1), np.nan)
        of_sensor = np.stack(
            [
                _mean_of_finite(axes[..., array.channel_sensor[vector] == i] ** 2, axis=-1)
                for i in range(array.n_sensors)
            ],
            axis=-2,
        )[..., 0]
        largest = np.max(np.where(missing, 0.0, deviation), axis=-1, keepdims=True)
        deviation = np.where(missing, np.maximum(np.sqrt(3.0 * of_sensor), largest), deviation)
    return deviation


def _mean_of_finite(values: FloatArray, axis: int) -> FloatArray:
    finite = np.isfinite(values)
    count = np.maximum(finite.sum(axis=axis, keepdims=True), 1)
    mean: FloatArray = np.where(finite, values, 0.0).sum(axis=axis, keepdims=True) / count
    return mean


def _channels(
    array: SensorArray, available: BoolArray | None, covariance_T2: FloatArray | None
) -> tuple[BoolArray, FloatArray]:
    n = array.n_channels
    mask = np.ones(n, dtype=np.bool_) if available is None else np.asarray(available, dtype=np.bool_)
    if mask.shape != (n,):
        raise ValueError(f"Input available must have shape ({n},); instead received {mask.shape}.")
    if covariance_T2 is None:
        return mask, np.diag(array.channel_noise_T**2)
    covariance = np.asarray(covariance_T2, dtype=np.float64)
    if covariance.shape != (n, n):
        raise ValueError(f"Input covariance_T2 must have shape ({n}, {n}); instead received {covariance.shape}.")
    if covariance[array.channel_sensor[:, None] != array.channel_sensor].any():
        raise ValueError(
            "Input covariance_T2 must be block-diagonal by sensor; instead received one that correlates two sensors."
        )
    return mask, covariance


def _inverse_root(array: SensorArray, mask: BoolArray, covariance: FloatArray) -> FloatArray:
    """``L⁻¹`` of ``covariance = L Lᵀ`` among the channels that have a reading, zero elsewhere: (..., C, C)."""
    channel = array.sensor_channels
    present = (channel >= 0) & mask[channel]
    blocks = covariance[..., channel[:, :, None], channel[:, None, :]]
    blocks = np.where(present[:, :, None] & present[:, None, :], blocks, np.eye(3))
    try:
        inverse = np.linalg.inv(np.linalg.cholesky(blocks))
    except np.linalg.LinAlgError:
        raise ValueError("Input covariance_T2 must be positive definite; instead received one that is not.") from None
    return _block_diagonal(array, inverse, present)


def _block_diagonal(array: SensorArray, blocks: FloatArray, present: BoolArray) -> FloatArray:
    """Matrices (..., C, C) of the sensors' blocks (..., N, 3, 3), zero for channels that are not present (N, 3)."""
    n = array.n_channels
    slot = np.where(present, array.sensor_channels, n)  # the others end in a row and a column that are cut off
    matrix = np.zeros((*blocks.shape[:-3], n + 1, n + 1))
    matrix[..., slot[:, :, None], slot[:, None, :]] = blocks
    return matrix[..., :n, :n]


def _groups(array: SensorArray, mask: BoolArray) -> list[NDArray[np.intp]]:
    """Available channels of the vector sensors, then of the scalar ones: each kind has its own common field."""
    kinds = (mask & ~array.channel_is_scalar, mask & array.channel_is_scalar)
    return [np.flatnonzero(kind) for kind in kinds if kind.any()]


def _common_field(array: SensorArray, group: NDArray[np.intp], gain: FloatArray) -> FloatArray:
    """How the common field enters the channels of one kind: (..., channels, 3), or (..., channels, 1) for moduli."""
    return gain[..., group, :1] if array.channel_is_scalar[group[0]] else gain[..., group, :]


def _closed_form(
    array: SensorArray, group: NDArray[np.intp], mask: BoolArray, covariance_T2: FloatArray, base: int
) -> tuple[FloatArray, FloatArray] | None:
    """The paper's form where it holds: complete sensors whose calibrated noise is the same along every axis."""
    width = 1 if array.channel_is_scalar[group[0]] else 3
    sensors = np.unique(array.channel_sensor[group])
    if group.size != width * sensors.size or sensors.size < 2:
        return None
    uncalibrate, sigma = [], np.empty(sensors.size)
    for i, sensor in enumerate(sensors):
        channels = np.flatnonzero((array.channel_sensor == sensor) & mask)
        inverse = np.linalg.inv(array.channel_gain[channels, :width])
        covariance = inverse @ covariance_T2[np.ix_(channels, channels)] @ inverse.T
        sigma[i] = np.sqrt(covariance[0, 0])
        if not np.allclose(covariance, sigma[i] ** 2 * np.eye(width), rtol=0.0, atol=1e-12 * sigma[i] ** 2):
            return None
        uncalibrate.append(inverse)
    d = contrasts(sensors.size, base)
    if np.allclose(sigma, sigma[0], rtol=_EQUAL_NOISE_RTOL, atol=0.0):
        t = helmert_decorrelation(sensors.size - 1)
        variance = sigma[0] ** 2 * np.concatenate([[float(sensors.size)], np.ones(sensors.size - 2)])
    else:
        t, variance = eigen_decorrelation(difference_covariance(sigma, base))
    w: FloatArray = np.kron(t @ d, np.eye(width)) @ block_diag(*uncalibrate)
    return w, np.repeat(variance, width)


def _numerical_form(
    array: SensorArray, group: NDArray[np.intp], covariance_T2: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Combinations of channels that are free of the common field, decorrelated by their eigenvectors."""
    common = _common_field(array, group, array.channel_gain)
    covariance = covariance_T2[np.ix_(group, group)]
    if array.common_field_T is not None:
        t, variance = eigen_decorrelation(covariance + array.common_field_T**2 * common @ common.T)
        return t, variance
    d: FloatArray = null_space(common.T).T
    if d.shape[0] == 0:
        return np.zeros((0, group.size)), np.zeros(0)
    t, variance = eigen_decorrelation(d @ covariance @ d.T)
    return t @ d, variance
