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
    """Rotations (..., 3, 3) by vectors (..., 3), by Rodrigues' formula [rad]."""
    angle = np.sqrt(np.sum(rotation_vector * rotation_vector, axis=-1))[..., None, None]
    K = cross_matrix(rotation_vector)
    # sin(a)/a and (1 - cos(a))/a², without cancelling.
    first, half = np.sinc(angle / math.pi), np.sinc(0.5 * angle / math.pi)
    return np.asarray(np.eye(3) + first * K + 0.5 * half * half * (K @ K))


def turn_of_change(rotation_vector: FloatArray) -> FloatArray:
    """The small turns J δ (..., 3, 3) that follow rotations by vectors (..., 3) when δ is added to these."""
    square = np.sum(rotation_vector * rotation_vector, axis=-1)[..., None, None]
    angle = np.sqrt(square)
    K = cross_matrix(rotation_vector)
    # (1 - cos(a))/a², and (a - sin(a))/a³ by a series where it cancels.
    half, small = np.sinc(0.5 * angle / math.pi), angle < 1e-2
    safe = np.where(small, 1.0, angle)
    third = np.where(small, 1.0 / 6.0 - square / 120.0, (safe - np.sin(safe)) / safe**3)
    return np.asarray(np.eye(3) + 0.5 * half * half * K + third * (K @ K))
