"""Directions spread evenly over the sphere."""

from __future__ import annotations

import numpy as np

from arrays.typing import FloatArray

_GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))


def sphere_directions(n: int) -> FloatArray:
    """Return evenly spread directions over the whole sphere (n, 3): a Fibonacci lattice, from +z to -z."""
    return _fibonacci(n, -1.0)


def _fibonacci(n: int, lowest: float) -> FloatArray:
    """Return a lattice (n, 3) on the unit sphere above z = lowest, with the same area for every point."""
    i = np.arange(n)
    z = 1.0 - (1.0 - lowest) * (i + 0.5) / n
    radius = np.sqrt(1.0 - z * z)
    return np.stack([radius * np.cos(_GOLDEN_ANGLE * i), radius * np.sin(_GOLDEN_ANGLE * i), z], axis=-1)


def moments_on_sphere(moment_Am2: float, n: int = 50, *, half: bool = False) -> FloatArray:
    """Return moments of one size in evenly spread directions: a Fibonacci lattice.

    Parameters
    ----------
    moment_Am2 : float
        Size of the moments [A·m²].
    n : int
        Number of moments, at least 1.
    half : bool
        Cover half of the sphere. This is enough for bounds of vector sensors, which are the same for m and -m.

    Returns
    -------
    ndarray, shape (n, 3)
        Moments [A·m²].

    Raises
    ------
    ValueError
        n is less than 1.

    Examples
    --------
    >>> import magloc
    >>> magloc.moments_on_sphere(2.0, 100).shape
    (100, 3)
    """
    if n < 1:
        raise ValueError(f"Input n must be at least 1; instead received {n}.")
    return moment_Am2 * _fibonacci(n, 0.0 if half else -1.0)


def fibonacci_directions(n: int) -> FloatArray:
    """Return nearly uniform unit vectors (n, 3) on a Fibonacci spiral."""
    i = np.arange(n) + 0.5
    z = 1.0 - 2.0 * i / n
    azimuth = np.pi * (1.0 + np.sqrt(5.0)) * i
    in_plane = np.sqrt(1.0 - z * z)
    return np.stack([in_plane * np.cos(azimuth), in_plane * np.sin(azimuth), z], axis=-1)


def hemisphere(n: int) -> FloatArray:
    """Return nearly uniform unit vectors (n, 3) with z > 0."""
    return fibonacci_directions(2 * n)[:n]
