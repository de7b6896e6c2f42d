"""Ambiguity of a row: weights of all its solutions, and their covariances."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from arrays.typing import FloatArray
from magloc.levels import DELTA_CHI2_95
from magloc.localization.uncertainty.range_interval import relative_range_sigma

LARGEST_GAUSSIAN_SIGMA = 0.04
"""Largest relative σ of position (over range) and of moment for Gaussian errors."""
LARGEST_RISE_ERROR = 0.5
"""Largest deviation from 1 of the rise of χ² at one standard deviation for Gaussian errors."""


def log_evidence_volume(
    covariance: FloatArray, moment: FloatArray, offset_m: FloatArray | None = None, *, scale_m: float | None = None
) -> FloatArray:
    r"""Return the log of the prior volume (...) that a solution represents, up to a constant.

    The prior has no scale: direction, orientation and the logarithms of range and moment are uniform, which is a
    density :math:`\propto r^{-3} |m|^{-3}` of position and moment. By Laplace's method the volume is the root of the
    determinant of the covariance (..., 6 K, 6 K), or (..., 3, 3) of a moment alone, in units of r and |m|. The standard
    deviation of the logarithm of the range is limited to 1, because χ² is not a parabola beyond. A known moment gives a
    scale; positions are then uniform in space, in units of any length.
    """
    unit = _units(*([moment] if offset_m is None else [offset_m, moment]))
    if scale_m is not None and offset_m is not None:
        unit = np.broadcast_to(np.tile(np.repeat([scale_m, 1.0], 3), offset_m.shape[-2]), unit.shape)
    with np.errstate(invalid="ignore", divide="ignore"):
        relative = covariance / (unit[..., :, None] * unit[..., None, :])
    known = np.asarray(np.isfinite(relative).all(axis=(-2, -1)))
    relative = np.where(known[..., None, None], relative, np.eye(unit.shape[-1]))
    volume: FloatArray = 0.5 * np.linalg.slogdet(relative)[1]
    if offset_m is not None:
        for k in range(offset_m.shape[-2]):
            sigma = relative_range_sigma(covariance[..., 6 * k :, 6 * k :], offset_m[..., k, :])
            volume = volume - np.log(np.fmax(np.where(known, sigma, 1.0), 1.0))
    return volume


def _units(*vectors: FloatArray) -> FloatArray:
    """Return lengths of the vectors (..., K, 3) of every source, in the order of a state.

    States are (..., 6 K) or (..., 3 K).
    """
    lengths = np.stack([np.linalg.norm(vector, axis=-1) for vector in vectors], axis=-1)
    return np.repeat(lengths.reshape(*lengths.shape[:-2], lengths.shape[-2] * len(vectors)), 3, axis=-1)


def weights(chi2: ArrayLike, volume: ArrayLike) -> FloatArray:
    r"""Return the weights of solutions (..., n), :math:`\propto V \exp(-\chi^2/2)`.

    All are zero if there is no solution.
    """
    values = np.asarray(volume, dtype=np.float64) - 0.5 * np.asarray(chi2, dtype=np.float64)
    best = values.max(axis=-1, keepdims=True)
    relative = np.exp(values - np.where(np.isfinite(best), best, 0.0))
    return relative / np.maximum(relative.sum(axis=-1, keepdims=True), 1e-300)


def relative_sigma(covariance: FloatArray, offset_m: FloatArray, moment: FloatArray) -> FloatArray:
    """Return the larger relative σ of position over range and moment, of (..., 6, 6)."""
    variance = np.diagonal(covariance, axis1=-2, axis2=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        parts = [
            np.sqrt(np.sum(of_vector, axis=-1) / np.sum(vector * vector, axis=-1))
            for of_vector, vector in ((variance[..., :3], offset_m), (variance[..., 3:6], moment))
        ]
    return np.maximum(*parts)


def longest_axes(covariance: FloatArray, offset_m: FloatArray, moment: FloatArray) -> FloatArray:
    """Return the longest semi-axes (..., 6 K) of 1σ ellipsoids, scaled by range and moment."""
    unit = _units(offset_m, moment)
    variance, axis = np.linalg.eigh(covariance / (unit[..., :, None] * unit[..., None, :]))
    return unit * axis[..., -1] * np.sqrt(np.maximum(variance[..., -1:], 0.0))


def widen(
    covariance: FloatArray, offset_m: FloatArray, low_m: FloatArray, high_m: FloatArray, source: int = 0
) -> FloatArray:
    """Return covariances (..., 6 K, 6 K) that cover the set of ranges of one source, if it is not observable.

    The state follows the range along :math:`w = C e / e^T C e`, with the gradient e of the range; variance is added in
    this direction. Given the range, the uncertainty of all other quantities does not change. The 95 % interval then
    reaches the farther end of the set. If the set is open, σ of the range is at least the range itself.
    """
    distance = np.linalg.norm(offset_m, axis=-1)
    farther = np.maximum(distance - low_m, high_m - distance) / math.sqrt(DELTA_CHI2_95)
    wanted = np.where(np.isfinite(farther), farther, distance)
    place = slice(6 * source, 6 * source + 3)
    with np.errstate(invalid="ignore", divide="ignore"):
        following = np.einsum("...ij,...j->...i", covariance[..., place], offset_m / distance[..., None])
        variance = np.sum(following[..., place] * offset_m, axis=-1) / distance
        missing = np.nan_to_num(np.maximum(wanted**2 - variance, 0.0) / variance**2, nan=0.0, posinf=0.0)
    return covariance + missing[..., None, None] * following[..., :, None] * following[..., None, :]
