"""Whitening of readings: the common field projected out, unit variance for the rest."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from arrays.array import SensorArray
from arrays.differences import _channels, _common_field, _groups, _mask
from arrays.noise import block_diagonal, in_slots
from arrays.typing import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Whitening:
    """Likelihood of the differences as a projection ``w = e - Q (g ∘ Qᵀ e)`` of ``e = L⁻¹ y``.

    The noise has the covariance ``L Lᵀ``. ``wᵀ w`` equals the χ² of :class:`Differences` for the same readings. Leading
    axes are rows.

    Attributes
    ----------
    roots : ndarray, shape (..., N, 3, 3)
        ``L⁻¹`` [1/T] of every sensor, lower triangular: 1/σ for independent noise. Rows and columns of missing channels
        are zero; the other channels of the sensor keep their marginal covariance.
    gain : ndarray, shape (..., C, 3)
        Gain of every channel in units of the noise: ``L⁻¹`` times that of the array [1/T].
    basis : ndarray, shape (..., C, q)
        Orthonormal basis of the common field in channels of unit noise.
    shrinkage : ndarray, shape (..., q)
        1 for an unknown common field, less with a prior.
    n_differences : int
        Number of independent scalars in w.
    channels : ndarray of int, shape (N, 3)
        Channels of the rows of the roots; negative for missing axes of a scalar sensor.
    """

    roots: FloatArray
    gain: FloatArray
    basis: FloatArray
    shrinkage: FloatArray
    n_differences: int
    channels: IntArray

    @cached_property
    def root(self) -> FloatArray:
        """``L⁻¹`` of all channels (..., C, C)."""
        return block_diagonal(self.channels, self.roots)

    @cached_property
    def per_noise(self) -> FloatArray | None:
        """1/σ of every channel (C,) [1/T], 0 if missing; None for correlated or varying noise."""
        if self.roots.ndim > 3 or (self.roots * (1.0 - np.eye(3))).any():
            return None
        return np.einsum("nii->ni", self.roots)[self.channels >= 0]

    def of_unit_noise(self, channels: FloatArray) -> FloatArray:
        """Return channels (..., C) [T] in units of the noise, including the common field."""
        if self.per_noise is not None:
            return channels * self.per_noise
        used = self.channels >= 0
        of_sensors: FloatArray = (self.roots @ in_slots(used, channels)[..., None])[..., 0]
        return of_sensors[..., used]

    def apply(self, channels: FloatArray) -> FloatArray:
        """Return whitened channels (..., C) of readings without offset or of Jacobian columns [T].

        Residuals have unit variance once the common field is projected out. Missing entries must be finite; they do not
        count.
        """
        e = channels @ self.root.T
        return e - ((e @ self.basis) * self.shrinkage) @ self.basis.T


def whitening(
    array: SensorArray, available: BoolArray | None = None, *, covariance_T2: FloatArray | None = None
) -> Whitening:
    """Return the projection form of :func:`decorrelated_differences`, with the same parameters.

    With channels ``y = U c + n``, n of covariance ``L Lᵀ`` and c the common field of prior variance λ:
    ``L⁻¹ U = Q diag(s) Vᵀ`` gives the shrinkage ``1 - 1/√(1 + s² λ)``, which is 1 for an unknown field.
    """
    if covariance_T2 is None:
        return _of_constant_noise(array, _mask(array, available).tobytes())
    mask, covariance = _channels(array, available, covariance_T2)
    return whitenings(array, mask, _blocks(array, covariance))


@lru_cache(maxsize=16)  # readings of a stream often miss the same channels
def _of_constant_noise(array: SensorArray, available: bytes) -> Whitening:
    """Return the whitening of the channels of a mask, with the noise that the array states."""
    mask, covariance = _channels(array, np.frombuffer(available, dtype=np.bool_), None)
    return whitenings(array, mask, _blocks(array, covariance))


def _blocks(array: SensorArray, covariance_T2: FloatArray) -> FloatArray:
    """Return the blocks (N, 3, 3) of a covariance (C, C); unused slots have unit variance."""
    channel, used = array.sensor_channels, array.sensor_channels >= 0
    both = used[:, :, None] & used[:, None, :]
    return np.where(both, covariance_T2[channel[:, :, None], channel[:, None, :]], np.eye(3))


def whitenings(array: SensorArray, available: BoolArray, blocks_T2: FloatArray) -> Whitening:
    """Return the whitening of covariances (..., N, 3, 3) [T²], for rows with the same channels."""
    n, used = array.n_channels, array.sensor_channels >= 0
    roots = _inverse_roots(blocks_T2, used & available[array.sensor_channels])
    of_sensors = in_slots(used, array.channel_gain.T).transpose(1, 2, 0)
    gain = (roots @ of_sensors)[..., used, :]
    prior = np.inf if array.common_field_T is None else array.common_field_T
    bases, shrinkages, lost = [np.zeros((*gain.shape[:-1], 0))], [np.zeros((*gain.shape[:-2], 0))], 0
    for group in _groups(array, available):
        q, s, _ = np.linalg.svd(_common_field(array, group, gain), full_matrices=False)
        keep = s > s.max(axis=-1, keepdims=True, initial=0.0) * 1e-10
        some = keep.reshape(-1, keep.shape[-1]).any(axis=0)
        basis = np.zeros((*gain.shape[:-2], n, int(some.sum())))
        basis[..., group, :] = q[..., some]
        with np.errstate(invalid="ignore"):  # zero times infinity, for what is not kept
            shrinkage = np.where(keep, 1.0 - 1.0 / np.sqrt(1.0 + (s * prior) ** 2), 0.0)[..., some]
        bases.append(basis)
        shrinkages.append(shrinkage)
        lost += basis.shape[-1] if array.common_field_T is None else 0
    basis, shrinkage = np.concatenate(bases, axis=-1), np.concatenate(shrinkages, axis=-1)
    return Whitening(roots, gain, basis, shrinkage, int(available.sum()) - lost, array.sensor_channels)


def _inverse_roots(covariance: FloatArray, present: BoolArray) -> FloatArray:
    """Return ``L⁻¹`` of covariances ``L Lᵀ`` (..., N, 3, 3) on axes with a reading, 0 elsewhere."""
    blocks = np.where(present[:, :, None] & present[:, None, :], covariance, np.eye(3))
    inverse = np.zeros_like(blocks)
    with np.errstate(invalid="ignore", divide="ignore"):
        l00 = np.sqrt(blocks[..., 0, 0])
        l10, l20 = blocks[..., 1, 0] / l00, blocks[..., 2, 0] / l00
        l11 = np.sqrt(blocks[..., 1, 1] - l10 * l10)
        l21 = (blocks[..., 2, 1] - l20 * l10) / l11
        l22 = np.sqrt(blocks[..., 2, 2] - l20 * l20 - l21 * l21)
        for i, pivot in enumerate((l00, l11, l22)):
            inverse[..., i, i] = 1.0 / pivot
        inverse[..., 1, 0] = -l10 * inverse[..., 0, 0] / l11
        inverse[..., 2, 1] = -l21 * inverse[..., 1, 1] / l22
        inverse[..., 2, 0] = -(l20 * inverse[..., 0, 0] + l21 * inverse[..., 1, 0]) / l22
    if not np.isfinite(inverse).all():
        raise ValueError("Input covariance_T2 must be positive definite; instead received one that is not.")
    return inverse if present.all() else inverse * (present[:, :, None] & present[:, None, :])
