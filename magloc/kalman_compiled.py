"""Compiled steps of a square-root Kalman filter; the readable twin is :mod:`magloc.kalman`."""

from __future__ import annotations

import math

from arrays.typing import FloatArray
from magloc.compilation import compiled


@compiled
def triangular_root(rows: FloatArray, root: FloatArray) -> None:
    """Lower root, ``L Lᵀ = rows rowsᵀ``, by modified Gram-Schmidt on the rows (n, m), which are spoilt.

    With rows ``[F S, S_q]`` it is the twin of :func:`magloc.kalman.predict_square_root`.
    """
    n, m = rows.shape
    root[:] = 0.0
    for i in range(n):
        norm = 0.0
        for c in range(m):
            norm += rows[i, c] * rows[i, c]
        norm = math.sqrt(norm)
        root[i, i] = norm
        if norm > 0.0:
            inverse = 1.0 / norm
            for c in range(m):
                rows[i, c] *= inverse
            for j in range(i + 1, n):
                t = 0.0
                for c in range(m):
                    t += rows[j, c] * rows[i, c]
                root[j, i] = t
                for c in range(m):
                    rows[j, c] -= t * rows[i, c]
