"""Small linear algebra for compiled loops: Gram-Schmidt, tangents of spheres, damped solutions; tested by its users."""

from __future__ import annotations

import math

import numpy as np

from arrays.typing import FloatArray
from magloc.compilation import compiled


@compiled
def orthonormalise(rows: FloatArray, triangle: FloatArray) -> None:
    """Gram-Schmidt, twice, of rows (k, c) in place; triangle (k, k) becomes R with rows = Rᵀ · orthonormal rows."""
    n_rows, n = rows.shape
    for j in range(n_rows):
        for k in range(j):
            triangle[k, j] = 0.0
        for _ in range(2):
            for k in range(j):
                t = 0.0
                for c in range(n):
                    t += rows[k, c] * rows[j, c]
                triangle[k, j] += t
                for c in range(n):
                    rows[j, c] -= t * rows[k, c]
        t = 0.0
        for c in range(n):
            t += rows[j, c] * rows[j, c]
        norm = math.sqrt(t)
        triangle[j, j] = norm
        inverse = 1.0 / norm if norm > 0.0 else 0.0
        for c in range(n):
            rows[j, c] *= inverse


@compiled
def _tangent(q: FloatArray, tangent: FloatArray) -> None:
    """Orthonormal basis (3, 4) of the plane orthogonal to the unit vector q, from a Householder reflection."""
    sign = 1.0 if q[3] >= 0.0 else -1.0
    beta = 1.0 / (1.0 + sign * q[3])
    for j in range(3):
        for a in range(4):
            w = q[a] if a < 3 else q[3] + sign
            tangent[j, a] = (1.0 if a == j else 0.0) - beta * q[j] * w


@compiled
def put(target: FloatArray, source: FloatArray) -> None:
    """Copy a vector. A slice's assignment would do, but it compiles an error sentence of its own every time."""
    for i in range(target.size):
        target[i] = source[i]


@compiled
def put_rows(target: FloatArray, source: FloatArray) -> None:
    """Copy a matrix."""
    for i in range(len(target)):
        put(target[i], source[i])


@compiled
def fill_frame(line: FloatArray, frame: FloatArray) -> float:
    """Axes u, v, n as rows, n along a line, and its length. Duff et al., "Building an orthonormal basis, revisited"."""
    length = math.sqrt(line[0] * line[0] + line[1] * line[1] + line[2] * line[2])
    x, y, z = line[0] / length, line[1] / length, line[2] / length
    sign = math.copysign(1.0, z)
    a = -1.0 / (sign + z)
    b = x * y * a
    frame[0, 0], frame[0, 1], frame[0, 2] = 1.0 + sign * x * x * a, sign * b, -sign * x
    frame[1, 0], frame[1, 1], frame[1, 2] = b, sign + y * y * a, -y
    frame[2, 0], frame[2, 1], frame[2, 2] = x, y, z
    return length


@compiled
def _directional_tangent(q: FloatArray, tangent: FloatArray) -> None:
    """Two orthonormal rows orthogonal to u that leave s, and with it the range, alone; the third row is u itself."""
    fill_frame(q[:3], tangent[:, :3])
    tangent[:, 3] = 0.0


@compiled
def _solve_damped(a: FloatArray, b: FloatArray, n: int, damping: float, step: FloatArray) -> None:
    """Step = (a + damping · diag(a))⁻¹ b for n ≤ 3 by Cholesky; columns without information do not move."""
    m = np.empty((3, 3))
    largest = 0.0
    for i in range(n):
        largest = max(largest, a[i, i])
    for i in range(n):
        for j in range(n):
            m[i, j] = a[i, j]
        m[i, i] += damping * a[i, i] + 1e-14 * largest
    for i in range(n):
        for j in range(i + 1):
            t = m[i, j]
            for k in range(j):
                t -= m[i, k] * m[j, k]
            if i == j:
                m[i, i] = math.sqrt(t) if t > 0.0 else math.inf
            else:
                m[i, j] = t / m[j, j]
    for i in range(n):
        t = b[i]
        for k in range(i):
            t -= m[i, k] * step[k]
        step[i] = t / m[i, i]
    for i in range(n - 1, -1, -1):
        t = step[i]
        for k in range(i + 1, n):
            t -= m[k, i] * step[k]
        step[i] = t / m[i, i]
