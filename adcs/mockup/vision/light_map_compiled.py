"""Compiled check of very many poses by all stars; the readable twin is in :mod:`adcs.mockup.vision.light_map`."""

from __future__ import annotations

import numpy as np

from arrays.typing import ComplexArray, FloatArray, IntArray
from magloc.compilation import compiled


@compiled
def misses_of_poses(
    a: ComplexArray,
    b: ComplexArray,
    image: ComplexArray,
    plane: ComplexArray,
    nearest: IntArray,
    corner: complex,
    cells_per_m: float,
    limit_squared: float,
) -> FloatArray:
    """Sum over stars of the squared distance to the nearest light, at most the limit each, under every pose.

    ``a``, ``b`` (h,): poses q = a p̄ + b, see :mod:`adcs.mockup.vision.similarity`. ``image`` (f,): mirrored stars.
    ``plane``, ``nearest``, ``corner``, ``cells_per_m``: the map. Returns shape (h,).
    """
    rows, columns = nearest.shape
    total = np.empty(a.size)
    for i in range(a.size):
        summed = 0.0
        for j in range(image.size):
            place = a[i] * image[j] + b[i]
            column = int((place.real - corner.real) * cells_per_m)
            row = int((place.imag - corner.imag) * cells_per_m)
            light = plane[nearest[min(max(row, 0), rows - 1), min(max(column, 0), columns - 1)]]
            x, y = place.real - light.real, place.imag - light.imag
            summed += min(x * x + y * y, limit_squared)
        total[i] = summed
    return total
