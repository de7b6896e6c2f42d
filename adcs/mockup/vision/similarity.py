r"""Similarities between the image of a camera that looks up and the table frame, in complex numbers.

A centred pixel of :mod:`adcs.mockup.vision.camera` (relative to the optical centre, free of distortion, y upwards) is
:math:`p = x + iy` [px], a point of the ceiling :math:`q = X + iY` [m]. The camera looks up at what the table frame
looks down upon, so that the image is mirrored, and

.. math:: q = a \bar p + b, \quad a = s\,e^{i\varphi}, \quad b = X_c + iY_c

with the scale s [m/px], the heading φ counter-clockwise and the camera's position b, which is where its optical axis
meets the ceiling. Leading axes are a batch; the last axis of points holds the points of one fit.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from arrays.typing import ComplexArray, FloatArray


def complex_points(points: ArrayLike, name: str = "points") -> ComplexArray:
    """Complex numbers x + iy of points (n, 2), checked.

    Parameters
    ----------
    points : array_like, shape (n, 2)
    name : str
        What an error calls them.

    Returns
    -------
    ndarray, shape (n,)

    Raises
    ------
    ValueError
        The shape is another one, or a number is not finite.
    """
    pairs = np.asarray(points, dtype=np.float64)
    if pairs.size == 0:
        return np.empty(0, dtype=np.complex128)
    if pairs.ndim != 2 or pairs.shape[1] != 2 or not np.isfinite(pairs).all():
        raise ValueError(f"Input {name} must be finite numbers of shape (n, 2); instead received shape {pairs.shape}.")
    plane: ComplexArray = pairs[:, 0] + 1j * pairs[:, 1]
    return plane


def mirrored_image(points_px: ArrayLike) -> ComplexArray:
    """Centred pixels (f, 2) as complex numbers x - iy: what is seen from above, see the module.

    Raises
    ------
    ValueError
        The shape is another one, or a number is not finite.
    """
    return np.conj(complex_points(points_px, "points_px"))


def pairs_of(plane: ComplexArray) -> FloatArray:
    """Real and imaginary part, shape (..., 2)."""
    return np.stack([plane.real, plane.imag], axis=-1)


def fitted_similarity(image: ComplexArray, table: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
    """Least squares of table - (a image + b): a and b.

    Parameters
    ----------
    image, table : ndarray, shape (..., k)
        Complex, k ≥ 2, the image points not all in one place (a is NaN there).

    Returns
    -------
    tuple of ndarray, shape (...)
        a and b.
    """
    p, q = image.mean(axis=-1), table.mean(axis=-1)
    centred = image - p[..., None]
    power = np.sum(centred.real**2 + centred.imag**2, axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        a = np.sum(np.conj(centred) * (table - q[..., None]), axis=-1) / power
    return a, q - a * p


def fitted_motion(image: ComplexArray, table: ComplexArray, scale: float) -> tuple[ComplexArray, ComplexArray]:
    """As :func:`fitted_similarity`, with the scale, the modulus of a, known [m/px]."""
    p, q = image.mean(axis=-1), table.mean(axis=-1)
    turned = np.sum(np.conj(image - p[..., None]) * (table - q[..., None]), axis=-1)
    a = scale * np.exp(1j * np.angle(turned))
    return a, q - a * p
