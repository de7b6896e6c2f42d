"""Decorrelation of differences: the common field taken out, the rest at unit variance."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from arrays.array import SensorArray
from arrays.differences import _channels, _common_field, _groups, _mask
from arrays.noise import _block_diagonal
from arrays.typing import BoolArray, FloatArray


@dataclass(frozen=True, eq=False)
class Whitening:
    """The differences' likelihood as a projection: ``w = e - Q (g ∘ Qᵀ e)``, ``e = L⁻¹ y``, noise covariance ``L Lᵀ``.

    ``wᵀ w`` equals the χ² of :class:`Differences`, for the same readings. Of many rows, one for every row along leading
    axes.

    Attributes
    ----------
    root : ndarray, shape (..., C, C)
        ``L⁻¹`` [1/T], block-diagonal by sensor: 1/σ of every channel where the channels' noise is independent. Rows and
        columns of missing channels are zero; a sensor's other channels keep the covariance that they have without them.
    gain : ndarray, shape (..., C, 3)
        Of every channel in units of the noise: ``L⁻¹`` times the array's [1/T].
    basis : ndarray, shape (..., C, q)
        Orthonormal basis of the common field in channels of unit noise.
    shrinkage : ndarray, shape (..., q)
        1 where the common field is unknown, less where a prior bounds it.
    n_differences : int
        Number of independent scalars in w.
    """

    root: FloatArray
    gain: FloatArray
    basis: FloatArray
    shrinkage: FloatArray
    n_differences: int

    def apply(self, channels: FloatArray) -> FloatArray:
        """Whitened channels (..., C) of readings without offset, predictions or columns of a Jacobian [T], of one row.

        Residuals have unit variance once the common field is projected out. Missing entries must be finite; they do not
        count.
        """
        e = channels @ self.root.T
        return e - ((e @ self.basis) * self.shrinkage) @ self.basis.T


def whitening(
    array: SensorArray, available: BoolArray | None = None, *, covariance_T2: FloatArray | None = None
) -> Whitening:
    """The projection form of :func:`decorrelated_differences`, with the same parameters.

    With channels ``y = U c + n``, n of covariance ``L Lᵀ`` and c the common field of prior variance λ:
    ``L⁻¹ U = Q diag(s) Vᵀ`` gives the shrinkage ``1 - 1/√(1 + s² λ)``, which is 1 for an unknown field.
    """
    if covariance_T2 is None:
        return _of_constant_noise(array, _mask(array, available).tobytes())
    return whitenings(array, *_channels(array, available, covariance_T2))


@lru_cache(maxsize=16)  # readings that come one by one miss the same channels
def _of_constant_noise(array: SensorArray, available: bytes) -> Whitening:
    """Whitening of the channels of a mask, with the noise that the array states."""
    mask, covariance = _channels(array, np.frombuffer(available, dtype=np.bool_), None)
    return whitenings(array, mask, covariance)


def whitenings(array: SensorArray, available: BoolArray, covariances_T2: FloatArray) -> Whitening:
    """:func:`whitening` of covariances (..., C, C) [T²], for rows that have the same readings."""
    n = array.n_channels
    root = _inverse_root(array, available, covariances_T2)
    gain = root @ array.channel_gain
    prior = np.inf if array.common_field_T is None else array.common_field_T
    bases, shrinkages, lost = [np.zeros((*root.shape[:-1], 0))], [np.zeros((*root.shape[:-2], 0))], 0
    for group in _groups(array, available):
        q, s, _ = np.linalg.svd(_common_field(array, group, gain), full_matrices=False)
        keep = s > s.max(axis=-1, keepdims=True, initial=0.0) * 1e-10
        some = keep.reshape(-1, keep.shape[-1]).any(axis=0)
        basis = np.zeros((*root.shape[:-2], n, int(some.sum())))
        basis[..., group, :] = q[..., some]
        with np.errstate(invalid="ignore"):  # zero times infinity, for what is not kept
            shrinkage = np.where(keep, 1.0 - 1.0 / np.sqrt(1.0 + (s * prior) ** 2), 0.0)[..., some]
        bases.append(basis)
        shrinkages.append(shrinkage)
        lost += basis.shape[-1] if array.common_field_T is None else 0
    basis, shrinkage = np.concatenate(bases, axis=-1), np.concatenate(shrinkages, axis=-1)
    return Whitening(root, gain, basis, shrinkage, int(available.sum()) - lost)


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
