"""Fields of several dipoles together at many points, by compiled kernels.

:mod:`magloc.fields.dipole` has the formulas and is the reference.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from arrays.typing import FloatArray
from magloc import core

_TERMS_A_BLOCK = 100_000
"""Number of points times sources in one call, which takes about a millisecond."""


def field_at_points(points: ArrayLike, sources: ArrayLike, moments: ArrayLike) -> FloatArray:
    """
    Return the induction of K dipoles together at N points.

    Parameters
    ----------
    points : array_like, shape (N, 3)
        Points of the field, m.
    sources : array_like, shape (K, 3)
        Positions of the dipoles, m.
    moments : array_like, shape (K, 3)
        Moments of the dipoles, A m^2.

    Returns
    -------
    ndarray, shape (N, 3)
        Induction in T; NaN on any of the sources, zero for K = 0.

    Raises
    ------
    ValueError
        If an argument has another shape, or the numbers of sources and moments differ.
    """
    return _summed("dipole_fields", points, sources, moments, ())


def gradient_at_points(points: ArrayLike, sources: ArrayLike, moments: ArrayLike) -> FloatArray:
    """Return the gradient tensors (N, 3, 3) of K dipoles together in T/m; arguments of :func:`field_at_points`."""
    return _summed("dipole_gradients", points, sources, moments, (3,))


def _summed(
    kernel: str, points: ArrayLike, sources: ArrayLike, moments: ArrayLike, more_axes: tuple[int, ...]
) -> FloatArray:
    """Return the sum over the dipoles, in their order, at each point."""
    s, p, m = _rows("points", points, "N"), _rows("sources", sources, "K"), _rows("moments", moments, "K")
    if len(p) != len(m):
        raise ValueError(
            f"Inputs sources and moments must have the same length; instead received {len(p)} and {len(m)}."
        )
    out = np.empty((len(s), 3, *more_axes))
    work = core.problem("dipoles", n_points=len(s), n_sources=len(p), points=s, sources=p, moments=m, out=out)
    core.run(kernel, work, len(s), block=max(64, _TERMS_A_BLOCK // max(1, len(p))))
    return out


def _rows(name: str, values: ArrayLike, n: str) -> FloatArray:
    """Return values as an array of shape (n, 3) in C order."""
    array = np.asarray(values, dtype=np.float64, order="C")
    if array.ndim != 2 or array.shape[-1] != 3:
        raise ValueError(f"Input {name} must have shape ({n}, 3); instead received shape {array.shape}.")
    return array
