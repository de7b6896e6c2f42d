"""Unit quaternions of attitude: Hamilton's product, scalar part first.

See docs/theory/satellite-dynamics-and-sensors.md.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation
from arrays.typing import FloatArray

IDENTITY: FloatArray = np.array([1.0, 0.0, 0.0, 0.0])


def multiply(p: ArrayLike, q: ArrayLike) -> FloatArray:
    """Return the Hamilton product p∘q, the rotation q and then p; shapes (..., 4) broadcast."""
    p0, p1, p2, p3 = np.moveaxis(np.asarray(p, dtype=np.float64), -1, 0)
    q0, q1, q2, q3 = np.moveaxis(np.asarray(q, dtype=np.float64), -1, 0)
    return np.stack(
        [
            p0 * q0 - p1 * q1 - p2 * q2 - p3 * q3,
            p0 * q1 + p1 * q0 + p2 * q3 - p3 * q2,
            p0 * q2 - p1 * q3 + p2 * q0 + p3 * q1,
            p0 * q3 + p1 * q2 - p2 * q1 + p3 * q0,
        ],
        axis=-1,
    )


def conjugate(q: ArrayLike) -> FloatArray:
    """Return the conjugate q*, the inverse rotation; (..., 4) -> (..., 4)."""
    return np.asarray(q, dtype=np.float64) * np.array([1.0, -1.0, -1.0, -1.0])


def normalised(q: ArrayLike) -> FloatArray:
    """Return quaternions (..., 4) of length 1; NaN where the length is zero or not finite."""
    values = np.asarray(q, dtype=np.float64)
    norm = np.sqrt(np.einsum("...i,...i->...", values, values))[..., None]
    return values / np.where(norm > 0.0, norm, np.nan)


def rotate(q: ArrayLike, v: ArrayLike) -> FloatArray:
    """Return q∘v∘q*: for ``q_orbital_from_body``, the orbital components of a body vector.

    Shapes ``q`` (..., 4), unit quaternions, and ``v`` (..., 3), which broadcast. Returns (..., 3).
    """
    w, x, y, z = np.moveaxis(np.asarray(q, dtype=np.float64), -1, 0)
    a, b, c = np.moveaxis(np.asarray(v, dtype=np.float64), -1, 0)
    # Twice the cross product of vector part and v; np.cross takes five times as long.
    i, j, k = 2.0 * (y * c - z * b), 2.0 * (z * a - x * c), 2.0 * (x * b - y * a)
    return np.stack([a + w * i + y * k - z * j, b + w * j + z * i - x * k, c + w * k + x * j - y * i], axis=-1)


def rotate_back(q: ArrayLike, v: ArrayLike) -> FloatArray:
    """Return q*∘v∘q = A(q) v: for ``q_orbital_from_body``, the body components of an orbital vector."""
    return rotate(conjugate(q), v)


def matrix(q: ArrayLike) -> FloatArray:
    """Return the matrix R with ``R @ v`` = :func:`rotate` (q, v), the transpose of A(q); (..., 4) -> (..., 3, 3)."""
    q = np.asarray(q, dtype=np.float64)
    # Row i is the rotated unit vector i, which is column i of R.
    return rotate(q[..., None, :], np.eye(3)).mT


def exp(rotation_vector: ArrayLike) -> FloatArray:
    """Return the quaternion (cos θ/2, n sin θ/2) of a rotation vector θn [rad]; (..., 3) -> (..., 4)."""
    half = 0.5 * np.asarray(rotation_vector, dtype=np.float64)
    angle = np.linalg.norm(half, axis=-1, keepdims=True)
    # np.sinc(x) is sin(πx)/(πx), which is 1 at zero.
    return np.concatenate([np.cos(angle), half * np.sinc(angle / np.pi)], axis=-1)


def log(q: ArrayLike) -> FloatArray:
    """Return the rotation vector of a unit quaternion, at most π long [rad]; inverse of :func:`exp`."""
    q = np.asarray(q, dtype=np.float64)
    q = np.where(q[..., :1] < 0.0, -q, q)
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    half = np.arctan2(sine, q[..., :1])
    # np.sinc(x) is sin(πx)/(πx), which is 1 at zero.
    return 2.0 * q[..., 1:] / np.sinc(half / np.pi)


def error_vector(q_estimated: ArrayLike, q_true: ArrayLike) -> FloatArray:
    r"""Return the vector part δ of :math:`\hat q^* \circ q`, with the sign that makes its scalar part positive.

    Shapes ``q_estimated``, ``q_true`` (..., 4) -> (..., 3), body axes. For small errors 2δ is the error angle [rad].
    """
    error = multiply(conjugate(q_estimated), q_true)
    return np.where(error[..., :1] < 0.0, -error[..., 1:], error[..., 1:])


def from_error_vector(delta: ArrayLike) -> FloatArray:
    """Return the quaternion (√(1-|δ|²), δ), normalised where |δ| > 1; (..., 3) -> (..., 4)."""
    delta = np.asarray(delta, dtype=np.float64)
    squared = np.sum(delta * delta, axis=-1, keepdims=True)
    scalar = np.sqrt(np.clip(1.0 - squared, 0.0, None))
    return np.concatenate([scalar, delta / np.sqrt(np.maximum(squared, 1.0))], axis=-1)


def turned_onto(q: FloatArray, body: FloatArray, reference: FloatArray) -> FloatArray:
    """Return the attitude after the shortest rotation that turns a body vector onto a vector in the "to" frame.

    Shapes ``q`` (..., 4), ``body`` and ``reference`` (..., 3), of any length. Returns (..., 4).
    """
    length = np.linalg.norm(body, axis=-1, keepdims=True) * np.linalg.norm(reference, axis=-1, keepdims=True)
    there = rotate_back(q, reference)
    cosine = np.sum(body * there, axis=-1, keepdims=True) / length
    turn = np.concatenate([1.0 + cosine, np.cross(body, there) / length], axis=-1)
    # A half turn may be about any axis across.
    opposite = 1.0 + cosine[..., 0] < 1e-12
    across = np.cross(body[opposite], np.eye(3)[np.argmin(np.abs(body[opposite]), axis=-1)])
    turn[opposite] = np.insert(across, 0, 0.0, axis=-1)
    return normalised(multiply(q, normalised(turn)))


def angle_between(p: ArrayLike, q: ArrayLike) -> FloatArray:
    """Return the angle between two attitudes, 0 to π [rad]; shapes (..., 4) -> (...)."""
    error = multiply(conjugate(p), q)
    return 2.0 * np.arctan2(np.linalg.norm(error[..., 1:], axis=-1), np.abs(error[..., 0]))


def derivative(q: ArrayLike, w: ArrayLike) -> FloatArray:
    """Return the rate of change ½ q∘(0, w) [1/s].

    Shapes ``q`` (..., 4), ``w`` (..., 3) -> (..., 4). ``w`` is the rate of the "from" frame against the "to" frame, in
    "from" axes [rad/s].
    """
    w = np.asarray(w, dtype=np.float64)
    return 0.5 * multiply(q, np.concatenate([np.zeros_like(w[..., :1]), w], axis=-1))


def to_rotation(q: ArrayLike) -> Rotation:
    """Return scipy's Rotation of quaternions (..., 4), with ``Rotation.apply(v)`` = :func:`rotate` (q, v)."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(np.asarray(q, dtype=np.float64), scalar_first=True)


def from_rotation(rotation: Rotation) -> FloatArray:
    """Return the quaternions (..., 4) of scipy's Rotation, with scalar parts that are not negative."""
    return np.asarray(rotation.as_quat(canonical=True, scalar_first=True), dtype=np.float64)
