"""Rotations by vectors, their derivatives, and cross products as matrices."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from arrays.typing import FloatArray


def cross_matrix(vector: ArrayLike) -> FloatArray:
    """Return matrices ``[a]×`` (..., 3, 3) of vectors a (..., 3) with ``[a]× b = a × b``, equation (18)."""
    a = np.asarray(vector, dtype=np.float64)
    K = np.zeros((*a.shape, 3))
    K[..., 2, 1], K[..., 0, 2], K[..., 1, 0] = a[..., 0], a[..., 1], a[..., 2]
    K[..., 1, 2], K[..., 2, 0], K[..., 0, 1] = -a[..., 0], -a[..., 1], -a[..., 2]
    return K


def unit_across(direction: FloatArray) -> FloatArray:
    """Return unit vectors at right angles to directions (..., 3), which need not have the length 1."""
    # The axis of the smallest component is not along the direction.
    first = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction), axis=-1)])
    return np.asarray(first / np.linalg.norm(first, axis=-1, keepdims=True))


def rotation_matrix(rotation_vector: FloatArray) -> FloatArray:
    """Return rotation matrices (..., 3, 3) of vectors (..., 3) [rad], by Rodrigues' formula."""
    angle = np.sqrt(np.sum(rotation_vector * rotation_vector, axis=-1))[..., None, None]
    K = cross_matrix(rotation_vector)
    # sin(a)/a and (1 - cos(a))/a², without cancelling.
    first, half = np.sinc(angle / math.pi), np.sinc(0.5 * angle / math.pi)
    return np.asarray(np.eye(3) + first * K + 0.5 * half * half * (K @ K))


def turn_of_change(rotation_vector: FloatArray) -> FloatArray:
    """Return the left Jacobian J (..., 3, 3) at rotation vectors φ (..., 3): exp(φ + δ) = exp(J δ) exp(φ)."""
    square = np.sum(rotation_vector * rotation_vector, axis=-1)[..., None, None]
    angle = np.sqrt(square)
    K = cross_matrix(rotation_vector)
    # (1 - cos(a))/a², and (a - sin(a))/a³ by a series where it cancels.
    half, small = np.sinc(0.5 * angle / math.pi), angle < 1e-2
    safe = np.where(small, 1.0, angle)
    third = np.where(small, 1.0 / 6.0 - square / 120.0, (safe - np.sin(safe)) / safe**3)
    return np.asarray(np.eye(3) + 0.5 * half * half * K + third * (K @ K))
