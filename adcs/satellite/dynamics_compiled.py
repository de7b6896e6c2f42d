"""Compiled vectors and quaternions, for the kernels of :mod:`adcs.complementary`.

:mod:`adcs.quaternion` is the readable twin. Vectors and quaternions are tuples of scalars, which the compiler keeps in
registers.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magloc.compilation import compiled, internal

Array = NDArray[np.float64]
Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


@compiled
def vector_at(values: Array) -> Vector:
    """Tuple of a row (3,)."""
    return values[0], values[1], values[2]


@compiled
def quaternion_at(values: Array) -> Quaternion:
    """Tuple of a row (4,)."""
    return values[0], values[1], values[2], values[3]


@internal
def combined(a: Vector, scale: float, b: Vector) -> Vector:
    """Vector a + scale·b."""
    return a[0] + scale * b[0], a[1] + scale * b[1], a[2] + scale * b[2]


@internal
def dot(a: Vector, b: Vector) -> float:
    """Product a·b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled
def cross(a: Vector, b: Vector) -> Vector:
    """Vector a×b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@compiled
def multiply(p: Quaternion, q: Quaternion) -> Quaternion:
    """Hamilton product p∘q."""
    return (
        p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3],
        p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2],
        p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1],
        p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0],
    )


@compiled
def conjugate(q: Quaternion) -> Quaternion:
    """Conjugate q*."""
    return q[0], -q[1], -q[2], -q[3]


@compiled
def normalised(q: Quaternion) -> Quaternion:
    """Quaternion of length 1."""
    inverse = 1.0 / np.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    return q[0] * inverse, q[1] * inverse, q[2] * inverse, q[3] * inverse


@compiled
def rotate_back(q: Quaternion, v: Vector) -> Vector:
    """Vector A(q) v = q*∘v∘q."""
    p = (q[1], q[2], q[3])
    twice = cross(p, v)
    twice = (2.0 * twice[0], 2.0 * twice[1], 2.0 * twice[2])
    return combined(combined(v, -q[0], twice), 1.0, cross(p, twice))


@compiled
def error_vector(q_estimated: Quaternion, q_true: Quaternion) -> Vector:
    """Vector part of q̂*∘q with the sign that makes the scalar part positive."""
    e = multiply(conjugate(q_estimated), q_true)
    sign = -1.0 if e[0] < 0.0 else 1.0
    return sign * e[1], sign * e[2], sign * e[3]
