r"""Differences between sensors, their covariance, and the decorrelated form of both.

The measurements of a gradiometer are differences between its sensors: what is common to all
sensors (the ambient field and its variations in time) drops out, and no derivative is estimated.
Differences that share a base sensor have correlated noise. Two forms remove the correlation:

* :class:`Differences`, the form of the source paper: independent scalars
  :math:`z' = W y` with variances, which a filter may process one at a time.
* :class:`Whitening`, the same likelihood written as a projection: every reading divided by its own
  noise, the common field projected out. It costs O(channels) instead of O(channels²), which is what
  compiled fits want.

Both hold for any number of vector and scalar sensors, any noise, calibration and missing readings;
that they give the same :math:`\chi^2` is a tested identity.

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
    """The differences' likelihood as a projection: ``w = e - Q (g ∘ Qᵀ e)``, ``e = y / noise``.

    ``wᵀ w`` equals the χ² of :class:`Differences`, for the same readings.

    Attributes
    ----------
    inverse_noise : ndarray, shape (C,)
        1/σ of every channel [1/T]; zero where the reading is missing.
    basis : ndarray, shape (C, q)
        Orthonormal basis of the common field in channels divided by their noise.
    shrinkage : ndarray, shape (q,)
        1 where the common field is unknown, less where a prior bounds it.
    n_differences : int
        Number of independent scalars in w.
    """

    inverse_noise: FloatArray
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
        e = channels * self.inverse_noise
        w: FloatArray = e - ((e @ self.basis) * self.shrinkage) @ self.basis.T
        return w


def decorrelated_differences(
    array: SensorArray,
    available: BoolArray | None = None,
    *,
    base: int = -1,
    channel_noise_T: FloatArray | None = None,
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
    channel_noise_T : ndarray, shape (C,), optional
        Noise per channel in place of the array's own [T], for noise that depends on the reading.

    Returns
    -------
    Differences
        With k = channels - rank of the common field; k = channels under a prior.
    """
    mask, noise = _channels(array, available, channel_noise_T)
    transforms: list[FloatArray] = []
    variances: list[FloatArray] = []
    for group in _groups(array, mask):
        closed = None if array.common_field_T is not None else _closed_form(array, group, mask, noise, base)
        w, variance = closed if closed is not None else _numerical_form(array, group, noise)
        full = np.zeros((variance.size, array.n_channels))
        full[:, group] = w
        transforms.append(full)
        variances.append(variance)
    if not transforms:
        return Differences(np.zeros((0, array.n_channels)), np.zeros(0))
    return Differences(np.concatenate(transforms), np.concatenate(variances))


def whitening(
    array: SensorArray, available: BoolArray | None = None, *, channel_noise_T: FloatArray | None = None
) -> Whitening:
    """The projection form of :func:`decorrelated_differences`, with the same parameters.

    With channels ``y = U c + n``, n of covariance N (diagonal) and c the common field of prior variance λ:
    ``N^(-1/2) U = Q diag(s) Vᵀ`` gives the shrinkage ``1 - 1/√(1 + s² λ)``, which is 1 for an unknown field.
    """
    mask, noise = _channels(array, available, channel_noise_T)
    inverse_noise = np.where(mask, 1.0 / noise, 0.0)
    bases: list[FloatArray] = []
    shrinkages: list[FloatArray] = []
    for group in _groups(array, mask):
        q, s, _ = np.linalg.svd(_common_field(array, group) * inverse_noise[group, None], full_matrices=False)
        keep = s > s.max(initial=0.0) * 1e-10
        basis = np.zeros((array.n_channels, int(keep.sum())))
        basis[group] = q[:, keep]
        bases.append(basis)
        if array.common_field_T is None:
            shrinkages.append(np.ones(basis.shape[1]))
        else:
            shrinkages.append(1.0 - 1.0 / np.sqrt(1.0 + (s[keep] * array.common_field_T) ** 2))
    basis = np.concatenate(bases, axis=1) if bases else np.zeros((array.n_channels, 0))
    n = int(mask.sum()) - (basis.shape[1] if array.common_field_T is None else 0)
    return Whitening(inverse_noise, basis, np.concatenate(shrinkages) if shrinkages else np.zeros(0), n)


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
    array: SensorArray, available: BoolArray | None, channel_noise_T: FloatArray | None
) -> tuple[BoolArray, FloatArray]:
    n = array.n_channels
    mask = np.ones(n, dtype=np.bool_) if available is None else np.asarray(available, dtype=np.bool_)
    noise = array.channel_noise_T if channel_noise_T is None else np.asarray(channel_noise_T, dtype=np.float64)
    if mask.shape != (n,):
        raise ValueError(f"Input available must have shape ({n},); instead received {mask.shape}.")
    if noise.shape != (n,):
        raise ValueError(f"Input channel_noise_T must have shape ({n},); instead received {noise.shape}.")
    return mask, noise


def _groups(array: SensorArray, mask: BoolArray) -> list[NDArray[np.intp]]:
    """Available channels of the vector sensors, then of the scalar ones: each kind has its own common field."""
    kinds = (mask & ~array.channel_is_scalar, mask & array.channel_is_scalar)
    return [np.flatnonzero(kind) for kind in kinds if kind.any()]


def _common_field(array: SensorArray, group: NDArray[np.intp]) -> FloatArray:
    """How the common field enters the channels of one kind: (channels, 3), or (channels, 1) for moduli."""
    gain = array.channel_gain[group]
    return gain[:, :1] if array.channel_is_scalar[group[0]] else gain


def _closed_form(
    array: SensorArray, group: NDArray[np.intp], mask: BoolArray, noise: FloatArray, base: int
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
        covariance = (inverse * noise[channels] ** 2) @ inverse.T
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


def _numerical_form(array: SensorArray, group: NDArray[np.intp], noise: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Combinations of channels that are free of the common field, decorrelated by their eigenvectors."""
    common = _common_field(array, group)
    sigma2 = noise[group] ** 2
    if array.common_field_T is not None:
        t, variance = eigen_decorrelation(np.diag(sigma2) + array.common_field_T**2 * common @ common.T)
        return t, variance
    d: FloatArray = null_space(common.T).T
    if d.shape[0] == 0:
        return np.zeros((0, group.size)), np.zeros(0)
    t, variance = eigen_decorrelation((d * sigma2) @ d.T)
    return t @ d, variance
