"""Differences between sensors, their covariance, and the decorrelated form of both.

What is common to all sensors drops out of their differences, and no derivative is estimated. Those that share a base
sensor have correlated noise: :class:`Differences` are the source paper's independent scalars :math:`z' = W y`, which a
filter may process one at a time; :mod:`arrays.whitening` has the same likelihood as a projection.

Source: Pavlov, Karshakov, Goldin, "Determination of the magnetic field parameters of an object from
remote magnetogradient measurements", equations (5), (9), (13)-(16), (20), (24), (28).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, helmert, null_space

from arrays.array import SensorArray
from arrays.typing import BoolArray, FloatArray

_EQUAL_NOISE_RTOL = 1e-12
_LOST = 1e-13
"""A deviation below this share of the largest one is a rounding error."""


def contrasts(n_sensors: int, base: int = -1) -> FloatArray:
    """Differences against a base sensor as rows (n_sensors - 1, n_sensors) of +1 and -1, equations (5) and (20)."""
    if n_sensors < 2:
        raise ValueError(f"Input n_sensors must be at least 2; instead received {n_sensors}.")
    base = range(n_sensors)[base]
    rows = np.delete(np.eye(n_sensors), base, axis=0)
    rows[:, base] = -1.0
    return rows


def helmert_decorrelation(n_differences: int) -> FloatArray:
    """Orthonormal eigenvectors (n, n) of ``I + 1 1ᵀ``, equation (14) for any number n of differences against one base.

    Row 0 belongs to the eigenvalue ``n + 1``, the others to the eigenvalue 1 (equation (15)).
    For three differences this is the paper's T to the sign.
    """
    if n_differences < 1:
        raise ValueError(f"Input n_differences must be at least 1; instead received {n_differences}.")
    t: FloatArray = helmert(n_differences, full=True)[:, ::-1].copy()
    t[1:2] *= -1.0  # the sign that the paper prints for (0, 1, -1)/√2
    return t


def eigen_decorrelation(root: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Orthonormal T and variances, largest first, with ``T R Tᵀ = diag(variance)``, for ``R = root rootᵀ`` (n, m).

    The rounded R may have lost its smallest variances, of sensors that are 1e8 times as good as others.
    """
    vectors, deviations, _ = np.linalg.svd(root, full_matrices=False)
    if not deviations[-1] > _LOST * deviations[0]:
        raise ValueError("Input array must have noise, and a common field, within a factor of 1e13 of each other.")
    return vectors.T, deviations**2


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

    @property
    def whitened(self) -> Differences:
        """The differences in units of their standard deviations."""
        return Differences(self.transform / np.sqrt(self.variance)[:, None], np.ones_like(self.variance))


def decorrelated_differences(
    array: SensorArray, available: BoolArray | None = None, *, base: int = -1, covariance_T2: FloatArray | None = None
) -> Differences:
    """Decorrelated differences of an array, equations (16) and (28) for any sensors.

    Vector sensors and scalar sensors are differenced within their own kind. Sensors of equal noise use the closed
    form (the paper's T for four sensors, Helmert's for any number), other cases numerical eigenvectors. With
    ``array.common_field_T`` the common field is not removed but marginalised with that prior.

    ``available`` (C,): channels that have a reading; all by default. ``base``: base sensor among the complete
    sensors of a kind. It changes the differences, never their likelihood. ``covariance_T2`` (C, C): covariance of
    the channels' noise instead of the array's own [T²], as one of :func:`reading_covariance`: block-diagonal by
    sensor. Entries of channels without a reading are ignored. Returns: with k = channels - rank of the
    common field; k = channels under a prior.
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


def _mask(array: SensorArray, available: BoolArray | None) -> BoolArray:
    n = array.n_channels
    mask = np.ones(n, dtype=np.bool_) if available is None else np.asarray(available, dtype=np.bool_)
    if mask.shape != (n,):
        raise ValueError(f"Input available must have shape ({n},); instead received {mask.shape}.")
    return mask


def _channels(
    array: SensorArray, available: BoolArray | None, covariance_T2: FloatArray | None
) -> tuple[BoolArray, FloatArray]:
    n, mask = array.n_channels, _mask(array, available)
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


def _groups(array: SensorArray, mask: BoolArray) -> list[NDArray[np.intp]]:
    """Available channels of the vector sensors, then of the scalar ones: each kind has its own common field."""
    kinds = (mask & ~array.channel_is_scalar, mask & array.channel_is_scalar)
    return [np.flatnonzero(kind) for kind in kinds if kind.any()]


def _common_field(array: SensorArray, group: NDArray[np.intp], gain: FloatArray) -> FloatArray:
    """Return the gain of channels of one kind for the common field, (..., n, 3) or (..., n, 1)."""
    return gain[..., group, :1] if array.channel_is_scalar[group[0]] else gain[..., group, :]


def _closed_form(
    array: SensorArray, group: NDArray[np.intp], mask: BoolArray, covariance_T2: FloatArray, base: int
) -> tuple[FloatArray, FloatArray] | None:
    """Return the form of the paper, for complete sensors with equal calibrated noise on all axes."""
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
        t, variance = eigen_decorrelation(d * sigma)
    w: FloatArray = np.kron(t @ d, np.eye(width)) @ block_diag(*uncalibrate)
    return w, np.repeat(variance, width)


def _numerical_form(
    array: SensorArray, group: NDArray[np.intp], covariance_T2: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return combinations of channels without the common field, decorrelated by eigenvectors."""
    common = _common_field(array, group, array.channel_gain)
    root = np.linalg.cholesky(covariance_T2[np.ix_(group, group)])
    if array.common_field_T is not None:
        return eigen_decorrelation(np.hstack([root, array.common_field_T * common]))
    d: FloatArray = null_space(common.T).T
    if d.shape[0] == 0:
        return np.zeros((0, group.size)), np.zeros(0)
    t, variance = eigen_decorrelation(d @ root)
    return t @ d, variance
