"""Attitude from vectors with known components in two frames: TRIAD, and Wahba's problem by QUEST.

Sources: H. D. Black, AIAA Journal 2 (7), 1964; M. D. Shuster, S. D. Oh, Three-Axis Attitude Determination from Vector
Observations, Journal of Guidance and Control 4 (1), 1981.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike

from adcs import quaternion
from arrays.typing import FloatArray

VectorMethod = Literal["quest", "triad"]
VECTOR_METHODS: tuple[VectorMethod, ...] = get_args(VectorMethod)


class VectorAttitudes(NamedTuple):
    """Attitudes of n instants; NaN with fewer than two vectors or collinear ones.

    Attributes
    ----------
    q : ndarray, shape (n, 4)
        Attitude, frame from body, scalar first.
    covariance : ndarray, shape (n, 3, 3)
        Covariance of the error angle, body axes [rad²].
    loss : ndarray, shape (n,)
        Twice Wahba's loss, Σ |b - Aᵀr|² / σ²: χ² with 2k - 3 degrees of freedom for k vectors with that noise.

    Examples
    --------
    >>> import adcs
    >>> import numpy as np
    >>> field, sun = np.array([[0.0, 2e-5, -4e-5]]), np.array([[1.0, 0.0, 0.0]])
    >>> found = adcs.attitude_of_vectors([field, sun], [field, sun], [0.01, 0.002])
    >>> np.degrees(np.sqrt(np.diagonal(found.covariance[0]))).round(2).tolist()
    [0.57, 0.11, 0.11]
    """

    q: FloatArray
    covariance: FloatArray
    loss: FloatArray


def attitude_of_vectors(
    body_vectors: Sequence[ArrayLike],
    frame_vectors: Sequence[ArrayLike],
    sigma_rad: Sequence[ArrayLike],
    *,
    method: VectorMethod = "quest",
) -> VectorAttitudes:
    r"""Estimate the attitude of each instant independently from two or more vectors.

    ``quest`` minimises :math:`\sum |b_k - A^T r_k|^2 / \sigma_k^2` of unit vectors by the largest eigenvalue of
    Davenport's matrix. Its covariance is :math:`(\sum (E - b_k b_k^T)/\sigma_k^2)^{-1}`. ``triad`` takes the direction
    of the first vector as exact and uses the second one for the rotation about it. Its covariance is given by Shuster
    and Oh.

    Parameters
    ----------
    body_vectors, frame_vectors : sequence of array_like, shape (n, 3)
        The same vectors in both frames, of any length; NaN where one is missing.
    sigma_rad : sequence of array_like, shape () or (n,)
        Noise of the direction of each vector, about each axis across it.
    method : str
        ``quest``, or ``triad`` with the first two vectors.

    Returns
    -------
    VectorAttitudes
        Attitudes, frame from body, with covariance and loss.

    Raises
    ------
    ValueError
        There are fewer than two vectors, shapes do not match, or a noise is not positive.

    Examples
    --------
    >>> import adcs
    >>> import numpy as np
    >>> up, north = np.array([[0.0, 0.0, 1.0]]), np.array([[0.0, 1.0, 0.0]])
    >>> adcs.attitude_of_vectors([up, north], [up, north], [0.1, 0.1], method="triad").q.tolist()
    [[1.0, 0.0, 0.0, 0.0]]
    """
    if method not in VECTOR_METHODS:
        raise ValueError(f"Input method must be one of {', '.join(VECTOR_METHODS)}; instead received {method!r}.")
    if not len(body_vectors) == len(frame_vectors) == len(sigma_rad) >= 2:
        raise ValueError(
            "Input body_vectors, frame_vectors and sigma_rad must have one length of two or more; instead received "
            f"{len(body_vectors)}, {len(frame_vectors)} and {len(sigma_rad)}."
        )
    body, frame = (np.stack([_units(v) for v in vectors]) for vectors in (body_vectors, frame_vectors))
    if body.shape != frame.shape or body.ndim != 3 or body.shape[-1] != 3:
        raise ValueError(f"Input vectors must have shape (n, 3); instead received {body.shape[1:]}, {frame.shape[1:]}.")
    sigma = np.stack([np.broadcast_to(np.asarray(s, dtype=np.float64), body.shape[1:2]) for s in sigma_rad])
    there = np.asarray(np.isfinite(body).all(axis=-1) & np.isfinite(frame).all(axis=-1))
    if not (sigma[there] > 0.0).all():
        raise ValueError("Input sigma_rad must be positive; instead received others.")
    if method == "triad":
        body, frame, sigma, there = body[:2], frame[:2], sigma[:2], there[:2]
    with np.errstate(invalid="ignore", divide="ignore"):
        weight = np.where(there, sigma**-2.0, 0.0)
    body, frame = np.where(there[..., None], body, 0.0), np.where(there[..., None], frame, 0.0)
    information = np.einsum("kn,knij->nij", weight, np.eye(3) - body[..., :, None] * body[..., None, :])
    several = np.sum(there, axis=0) >= 2
    told = np.flatnonzero(several & (np.linalg.cond(information) < 1e12))
    q, covariance = np.full((len(several), 4), np.nan), np.full((len(several), 3, 3), np.nan)
    loss = np.full(len(several), np.nan)
    if not told.size:
        return VectorAttitudes(q, covariance, loss)
    if method == "triad":
        q[told] = _triad(body[:, told], frame[:, told])
        covariance[told] = _triad_covariance(body[:, told], sigma[:, told])
    else:
        q[told] = _davenport(body[:, told], frame[:, told], weight[:, told])
        covariance[told] = np.linalg.inv(information[told])
    misfit = np.sum((body - quaternion.rotate_back(q, frame)) ** 2, axis=-1)
    loss[told] = np.sum(weight * misfit, axis=0)[told]
    return VectorAttitudes(q, covariance, loss)


def _units(vectors: ArrayLike) -> FloatArray:
    values = np.asarray(vectors, dtype=np.float64)
    lengths = np.linalg.norm(values, axis=-1, keepdims=True)
    if (lengths == 0.0).any():
        raise ValueError("Input vectors must have a length; instead received a zero vector.")
    return np.asarray(values / lengths)


def _triad(body: FloatArray, frame: FloatArray) -> FloatArray:
    """Return quaternions (n, 4) of two unit vectors each, (2, n, 3)."""

    def axes(first: FloatArray, second: FloatArray) -> FloatArray:
        across = np.cross(first, second)
        across /= np.linalg.norm(across, axis=-1, keepdims=True)
        return np.stack([first, across, np.cross(first, across)], axis=-1)

    from scipy.spatial.transform import Rotation

    return quaternion.from_rotation(Rotation.from_matrix(axes(*frame) @ axes(*body).mT))


def _triad_covariance(body: FloatArray, sigma: FloatArray) -> FloatArray:
    """Return σ₁² E + [(σ₂² - σ₁²) W₁W₁ᵀ + σ₁² (W₁·W₂)(W₁W₂ᵀ + W₂W₁ᵀ)] / |W₁ × W₂|²."""
    first, second = body
    cosine = np.sum(first * second, axis=-1)[:, None, None]
    variance = np.square(sigma)[..., None, None]
    across = np.sum(np.cross(first, second) ** 2, axis=-1)[:, None, None]
    own, mixed = first[:, :, None] * first[:, None, :], first[:, :, None] * second[:, None, :]
    spread = (variance[1] - variance[0]) * own + variance[0] * cosine * (mixed + mixed.mT)
    return np.asarray(variance[0] * np.eye(3) + spread / across)


def _davenport(body: FloatArray, frame: FloatArray, weight: FloatArray) -> FloatArray:
    """Return the quaternions (n, 4), frame from body, of Davenport's largest eigenvalue."""
    B = np.einsum("kn,kni,knj->nij", weight, frame, body)
    K = np.empty((len(B), 4, 4))
    K[:, 0, 0] = np.trace(B, axis1=-2, axis2=-1)
    K[:, 0, 1:] = K[:, 1:, 0] = np.sum(weight[..., None] * np.cross(body, frame), axis=0)
    K[:, 1:, 1:] = B + B.mT - K[:, 0, 0, None, None] * np.eye(3)
    vectors = np.linalg.eigh(K)[1][..., -1]
    return np.asarray(vectors * np.where(vectors[:, :1] < 0.0, -1.0, 1.0))
