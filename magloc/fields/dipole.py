"""Field of a magnetic dipole: induction, gradient tensor and their Jacobians.

A dipole of moment m at the position p (the source) is seen from a point s. With

    d = s - p,   r = |d|,   n = d/r,   k = mu_0/4 pi,

    (2)  B = A(d) m,  A(d) = k (3 n n^T - I)/r^3
    (3)  G = dB/ds = (3k/r^4) [(n.m) I + n m^T + m n^T - 5 (n.m) n n^T]

Everything is in SI units: metres, A m^2, tesla, T/m. Each argument has vectors along its last axis. The leading axes of
all arguments broadcast against each other, as in NumPy. All vectors share one Cartesian frame.

Exactly on the source every function returns NaN for that point only, without an exception or a warning. Distances
from 1e-75 m to 1e75 m neither overflow nor underflow, because each formula starts from the unit vector n.

References
----------
B. V. Pavlov, E. V. Karshakov, D. A. Goldin, "Determination of the magnetic field parameters of an object from remote
magnetogradient measurements", Large-Scale Systems Control, issue 109. The numbers above are its equations.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from arrays.io.errors import _vectors

Array = NDArray[np.float64]
MU0_OVER_4PI = 1e-7
"""Magnetic constant over 4 pi, T m/A: exact until the SI of 2019, and 1.3e-10 above the measured value since."""
_IDENTITY = np.eye(3)


def field(points: ArrayLike, source: ArrayLike, moment: ArrayLike) -> Array:
    """
    Return the induction B = k [3 (n.m) n - m]/r^3 of a dipole, equation (2).

    Parameters
    ----------
    points : array_like, shape (..., 3)
        Points of the field, m.
    source : array_like, shape (..., 3)
        Position of the dipole, m.
    moment : array_like, shape (..., 3)
        Moment of the dipole, A m^2.

    Returns
    -------
    ndarray, shape (..., 3)
        Induction in T; NaN on the source.

    Raises
    ------
    ValueError
        If an argument is not an array of 3-vectors, or the leading axes do not broadcast.
    """
    n, r = _direction_and_distance(points, source)
    m = _vectors("moment", moment)
    return MU0_OVER_4PI / (r * r * r) * (3.0 * _dot(n, m)[..., None] * n - m)


def field_matrix(points: ArrayLike, source: ArrayLike) -> Array:
    """
    Return the matrix A = k (3 n n^T - I)/r^3 that gives the field of a moment, B = A m, equation (2).

    The field is linear in the moment, so A is also its Jacobian dB/dm. It is symmetric and traceless.

    Parameters
    ----------
    points : array_like, shape (..., 3)
        Points of the field, m.
    source : array_like, shape (..., 3)
        Position of the dipole, m.

    Returns
    -------
    ndarray, shape (..., 3, 3)
        Matrix in T/(A m^2); NaN on the source.

    Raises
    ------
    ValueError
        If an argument is not an array of 3-vectors, or the leading axes do not broadcast.
    """
    return _field_matrix(*_direction_and_distance(points, source))


def gradient_tensor(points: ArrayLike, source: ArrayLike, moment: ArrayLike) -> Array:
    """
    Return the gradient tensor G = dB/ds of the field of a dipole, equation (3): G[i, j] = dB_i/ds_j.

    It is symmetric (bit for bit) because the field has no curl, and traceless because it has no divergence.

    Parameters
    ----------
    points : array_like, shape (..., 3)
        Points of the gradient, m.
    source : array_like, shape (..., 3)
        Position of the dipole, m.
    moment : array_like, shape (..., 3)
        Moment of the dipole, A m^2.

    Returns
    -------
    ndarray, shape (..., 3, 3)
        Gradient tensor in T/m; NaN on the source.

    Raises
    ------
    ValueError
        If an argument is not an array of 3-vectors, or the leading axes do not broadcast.
    """
    return _gradient_tensor(*_direction_and_distance(points, source), _vectors("moment", moment))


def field_jacobian(points: ArrayLike, source: ArrayLike, moment: ArrayLike) -> Array:
    """
    Return the Jacobian of the field by the dipole's state (p, m): [dB/dp, dB/dm] = [-G, A].

    Parameters
    ----------
    points : array_like, shape (..., 3)
        Points of the field, m.
    source : array_like, shape (..., 3)
        Position p of the dipole, m.
    moment : array_like, shape (..., 3)
        Moment m of the dipole, A m^2.

    Returns
    -------
    ndarray, shape (..., 3, 6)
        The first three columns in T/m, the last three in T/(A m^2); NaN on the source.

    Raises
    ------
    ValueError
        If an argument is not an array of 3-vectors, or the leading axes do not broadcast.
    """
    n, r = _direction_and_distance(points, source)
    by_position = -_gradient_tensor(n, r, _vectors("moment", moment))
    by_moment = np.broadcast_to(_field_matrix(n, r), by_position.shape)
    return np.concatenate([by_position, by_moment], axis=-1)


def total_field(points: ArrayLike, sources: ArrayLike, moments: ArrayLike) -> Array:
    """
    Return the induction of several dipoles together: the sum of their fields, equation (2).

    Parameters
    ----------
    points : array_like, shape (..., 3)
        Points of the field, m.
    sources : array_like, shape (..., K, 3)
        Positions of the K dipoles, m.
    moments : array_like, shape (..., K, 3)
        Moments of the K dipoles, A m^2.

    Returns
    -------
    ndarray, shape (..., 3)
        Induction in T; NaN on any of the sources, zero for K = 0.

    Raises
    ------
    ValueError
        If an argument is not an array of 3-vectors, the numbers of sources and moments differ, or the leading axes
        do not broadcast.

    See Also
    --------
    magloc.fields.points.field_at_points : the same, compiled and parallel, for many points.
    """
    s, p, m = _vectors("points", points), _vectors("sources", sources), _vectors("moments", moments)
    if p.ndim < 2 or m.ndim < 2 or p.shape[-2] != m.shape[-2]:
        raise ValueError(
            "Inputs sources and moments must have shapes (..., K, 3) with one K; "
            f"instead received shapes {p.shape} and {m.shape}."
        )
    total = np.zeros((*np.broadcast_shapes(s.shape[:-1], p.shape[:-2], m.shape[:-2]), 3))
    # One dipole at a time: a broadcast over K would hold K times the memory of the result.
    for k in range(p.shape[-2]):
        total += field(s, p[..., k, :], m[..., k, :])
    return total


def _field_matrix(n: Array, r: Array) -> Array:
    """Return :func:`field_matrix` for directions (..., 3) and distances (..., 1)."""
    return (MU0_OVER_4PI / (r * r * r))[..., None] * (3.0 * _outer(n, n) - _IDENTITY)


def _gradient_tensor(n: Array, r: Array, m: Array) -> Array:
    """Return :func:`gradient_tensor` of moments (..., 3) for directions (..., 3) and distances (..., 1)."""
    radial = _dot(n, m)[..., None, None]
    mixed = _outer(n, m)
    shape = radial * _IDENTITY + (mixed + mixed.mT) - 5.0 * radial * _outer(n, n)
    return (3.0 * MU0_OVER_4PI / (r * r * r * r))[..., None] * shape


def _direction_and_distance(points: ArrayLike, source: ArrayLike) -> tuple[Array, Array]:
    """Return unit vectors (..., 3) and distances (..., 1) from the source to the points; NaN on the source."""
    d = _vectors("points", points) - _vectors("source", source)
    r = np.sqrt(_dot(d, d))[..., None]
    # NaN propagates without a warning; 0/0 would warn.
    r = np.where(r > 0.0, r, np.nan)
    return d / r, r


def _dot(a: Array, b: Array) -> Array:
    """Return scalar products a.b, shape (...)."""
    return np.vecdot(a, b)


def _outer(a: Array, b: Array) -> Array:
    """Return outer products a b^T, shape (..., 3, 3)."""
    return a[..., :, None] * b[..., None, :]
