"""Small rotations: cross products as matrices, rotations by a vector, and how these change."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from arrays.typing import FloatArray


def cross_matrix(vector: ArrayLike) -> FloatArray:
    """Matrix ``[a]×`` with ``[a]× b = a × b``, equation (18): (..., 3, 3) of (..., 3)."""
    a = np.asarray(vector, dtype=np.float64)
    K = np.zeros((*a.shape, 3))
    K[..., 2, 1], K[..., 0, 2], K[..., 1, 0] = a[..., 0], a[..., 1], a[..., 2]
    K[..., 1, 2], K[..., 2, 0], K[..., 0, 1] = -a[..., 0], -a[..., 1], -a[..., 2]
    return K


def rotation_matrix(rotation_vector: FloatArray) -> FloatArray:
    """Rotation (3, 3) by a vector (3,), by Rodrigues' formula [rad]."""
    angle = math.sqrt(float(rotation_vector @ rotation_vector))
    if angle == 0.0:
        return np.eye(3)
    K = cross_matrix(rotation_vector)
    # sin(a)/a and (1 - cos(a))/a², without cancelling.
    first = math.sin(angle) / angle if angle > 1e-8 else 1.0
    half = 0.5 * angle
    second = 0.5 * (math.sin(half) / half) ** 2 if angle > 1e-8 else 0.5
    return np.eye(3) + first * K + second * (K @ K)


def turn_of_change(rotation_vector: FloatArray) -> FloatArray:
    """The small turn J δ (3, 3) that follows a rotation by a vector (3,) when δ is added to the vector."""
    square = float(rotation_vector @ rotation_vector)
    angle = math.sqrt(square)
    K = cross_matrix(rotation_vector)
    # (1 - cos(a))/a² and (a - sin(a))/a³, by series where they cancel.
    if angle < 1e-2:
        first, second = 0.5 - square / 24.0, 1.0 / 6.0 - square / 120.0
    else:
        first, second = (1.0 - math.cos(angle)) / square, (angle - math.sin(angle)) / (square * angle)
    return np.eye(3) + first * K + second * (K @ K)
