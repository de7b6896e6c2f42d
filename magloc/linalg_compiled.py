"""Small linear algebra for compiled loops: Gram-Schmidt, frames along lines, copies; tested by its users."""

from __future__ import annotations

import math

import numpy as np

from arrays.typing import FloatArray
from magloc.compilation import inlined_sum, internal

# Products of a matrix with fewer columns take longer to be handed to BLAS than to be computed.
_SMALL = 400


@inlined_sum
def dot(a: FloatArray, b: FloatArray) -> float:
    """Product of two vectors."""
    t = 0.0
    for c in range(a.size):
        t += a[c] * b[c]
    return t


@internal
def multiply_transposed(a: FloatArray, b: FloatArray, product: FloatArray) -> None:
    """Products (n, m) of rows a (n, c) and b (m, c)."""
    if product.size > _SMALL:
        np.dot(a, b.T, product)
        return
    for i in range(len(a)):
        for j in range(len(b)):
            product[i, j] = dot(a[i], b[j])


@internal
def subtract_product(rows: FloatArray, factors: FloatArray, others: FloatArray) -> None:
    """Subtract factors (n, m) times other rows (m, c) from rows (n, c) in place."""
    if factors.size > _SMALL:
        rows -= np.dot(factors, others)
        return
    for i in range(len(rows)):
        for j in range(len(others)):
            for c in range(rows.shape[1]):
                rows[i, c] -= factors[i, j] * others[j, c]


@internal
def orthonormalise(rows: FloatArray, triangle: FloatArray) -> None:
    """Gram-Schmidt, twice, of rows (k, c) in place; triangle (k, k) becomes R with rows = Rᵀ · orthonormal rows."""
    n_rows, n = rows.shape
    for j in range(n_rows):
        for k in range(j):
            triangle[k, j] = 0.0
        for _ in range(2):
            for k in range(j):
                t = dot(rows[k], rows[j])
                triangle[k, j] += t
                for c in range(n):
                    rows[j, c] -= t * rows[k, c]
        norm = math.sqrt(dot(rows[j], rows[j]))
        triangle[j, j] = norm
        inverse = 1.0 / norm if norm > 0.0 else 0.0
        for c in range(n):
            rows[j, c] *= inverse


@internal
def cholesky(matrix: FloatArray, ridge: float) -> None:
    """Upper root R of a positive matrix of unit diagonal, RᵀR, in place; the ridge is added, and the least pivot."""
    n = len(matrix)
    for j in range(n):
        pivot = matrix[j, j] + ridge
        root = math.sqrt(pivot if pivot > ridge else ridge)
        matrix[j, j] = root
        for k in range(j + 1, n):
            matrix[j, k] /= root
        for i in range(j + 1, n):
            t = matrix[j, i]
            for k in range(i, n):
                matrix[i, k] -= t * matrix[j, k]


@internal
def solve_cholesky(root: FloatArray, columns: FloatArray) -> None:
    """Solve RᵀR x = b for columns (n, m) in place."""
    n, m = columns.shape
    for i in range(n):
        for j in range(i):
            t = root[j, i]
            for c in range(m):
                columns[i, c] -= t * columns[j, c]
        for c in range(m):
            columns[i, c] /= root[i, i]
    for i in range(n - 1, -1, -1):
        for j in range(i + 1, n):
            t = root[i, j]
            for c in range(m):
                columns[i, c] -= t * columns[j, c]
        for c in range(m):
            columns[i, c] /= root[i, i]


@internal
def put(target: FloatArray, source: FloatArray) -> None:
    """Copy a vector. A slice's assignment would do, but it compiles an error sentence of its own every time."""
    for i in range(target.size):
        target[i] = source[i]


@internal
def put_rows(target: FloatArray, source: FloatArray) -> None:
    """Copy a matrix."""
    for i in range(len(target)):
        put(target[i], source[i])


@internal
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
