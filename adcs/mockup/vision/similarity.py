"""Similarities between the image of a camera that looks up and the table frame, in complex numbers.

See docs/theory/tabletop-vision.md.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from arrays.typing import ComplexArray, FloatArray


def complex_points(points: ArrayLike, name: str = "points") -> ComplexArray:
    """Return points (n, 2) as complex numbers x + iy; check their shape.

    Shapes ``points`` (n, 2) -> (n,). ``name``: name of the argument in errors.
    """
    pairs = np.asarray(points, dtype=np.float64)
    if pairs.size == 0:
        return np.empty(0, dtype=np.complex128)
    if pairs.ndim != 2 or pairs.shape[1] != 2 or not np.isfinite(pairs).all():
        raise ValueError(f"Input {name} must be finite numbers of shape (n, 2); instead received shape {pairs.shape}.")
    return pairs[:, 0] + 1j * pairs[:, 1]


def mirrored_image(points_px: ArrayLike) -> ComplexArray:
    """Return centred pixels (f, 2) as complex numbers x - iy, as seen from above.

    See docs/theory/tabletop-vision.md.
    """
    return np.conj(complex_points(points_px, "points_px"))


def pairs_of(plane: ComplexArray) -> FloatArray:
    """Return real and imaginary part, shape (..., 2)."""
    return np.stack([plane.real, plane.imag], axis=-1)


def fit_similarity(image: ComplexArray, table: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
    """Return a and b of the least-squares fit of table - (a image + b).

    Shapes ``image``, ``table`` (..., k) -> (...), complex, k ≥ 2. If all image points are in one place, a is NaN.
    """
    p, q = image.mean(axis=-1), table.mean(axis=-1)
    centred = image - p[..., None]
    power = np.sum(centred.real**2 + centred.imag**2, axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        a = np.sum(np.conj(centred) * (table - q[..., None]), axis=-1) / power
    return a, q - a * p
