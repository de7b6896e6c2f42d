"""Field of a magnetic dipole: potential, induction, gradient tensor and their Jacobians.

A dipole of moment m at the position p (the source) is seen from a point s. With

    d = s - p,   r = |d|,   n = d/r,   k = mu_0/4 pi,

    (1)  U = -k (n.m)/r^2,  and B = +grad U (the sign of the paper below)
    (2)  B = A(d) m,  A(d) = k (3 n n^T - I)/r^3
    (3)  G = dB/ds = (3k/r^4) [(n.m) I + n m^T + m n^T - 5 (n.m) n n^T]
    (4)  grad |B| = G B/|B|

Everything is in SI units: metres, A m^2, tesla, T/m. Each argument has vectors along its last axis. The leading axes of
all arguments broadcast against each other, as in NumPy. All vectors share one Cartesian frame.

Exactly on the source every function returns NaN for that point only, without an exception or a warning. Distances
from 1e-75 m to 1e75 m neither overflow nor underflow, because each formula starts from the unit vector n.

References
----------
B. V. Pavlov, E. V. Karshakov, D. A. Goldin, "Determination of the magnetic field parameters of an object from remote
magnetogradient measurements", Large-Scale Systems Control, issue 109. The numbers above are its equations.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from arrays.io.errors import _vectors

Array = NDArray[np.float64]
MU0_OVER_4PI = 1e-7
"""Magnetic constant over 4 pi, T m/A: exact until the SI of 2019, and 1.3e-10 above the measured value since."""
_IDENTITY = np.eye(3)


def potential(points: ArrayLike, source: ArrayLike, moment: ArrayLike) -> Array:
    """
    Return the scalar potential U = -k (n.m)/r^2 of a dipole, equation (1), whose gradient is the field: B = +grad U.

    Parameters
    ----------
    points : array_like, shape (..., 3)
        Points of evaluation, m.
    source : array_like, shape (..., 3)
        Position of the dipole, m.
    moment : array_like, shape (..., 3)
        Moment of the dipole, A m^2.

    Returns
    -------
    ndarray, shape (...)
        Potential in T m; NaN on the source.

    Raises
    ------
    ValueError
        If an argument is not an array of 3-vectors, or the leading axes do not broadcast.
    """
    n, r = _direction_and_distance(points, source)
    return -MU0_OVER_4PI * _dot(n, _vectors("moment", moment)) / (r * r)[..., 0]


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


def modulus_gradient(
    points: ArrayLike, source: ArrayLike, moment: ArrayLike, ambient: ArrayLike | None = None
) -> Array:
    """
    Return the gradient of the modulus of the total field, grad |B_a + B| = G e, equation (4).

    The unit vector e is along B_a + B. The ambient field B_a is uniform, such as the geomagnetic field.

    Parameters
    ----------
    points : array_like, shape (..., 3)
        Points of evaluation, m.
    source : array_like, shape (..., 3)
        Position of the dipole, m.
    moment : array_like, shape (..., 3)
        Moment of the dipole, A m^2.
    ambient : array_like, shape (..., 3), optional
        Uniform ambient induction, T.

    Returns
    -------
    ndarray, shape (..., 3)
        Gradient of the modulus in T/m; NaN on the source and where the total field vanishes, for a modulus has a
        corner there.

    Raises
    ------
    ValueError
        If an argument is not an array of 3-vectors, or the leading axes do not broadcast.
    """
    total = field(points, source, moment)
    if ambient is not None:
        total = total + _vectors("ambient", ambient)
    e, _ = _unit(total)
    return _dot(gradient_tensor(points, source, moment), e[..., None, :])


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
    return _sum_over_dipoles(field, (3,), points, sources, moments)


def total_gradient_tensor(points: ArrayLike, sources: ArrayLike, moments: ArrayLike) -> Array:
    """
    Return the gradient tensor of the field of several dipoles: the sum of their tensors, equation (3).

    Parameters
    ----------
    points : array_like, shape (..., 3)
        Points of evaluation, m.
    sources : array_like, shape (..., K, 3)
        Positions of the K dipoles, m.
    moments : array_like, shape (..., K, 3)
        Moments of the K dipoles, A m^2.

    Returns
    -------
    ndarray, shape (..., 3, 3)
        Gradient tensor in T/m; NaN on any of the sources, zero for K = 0.

    Raises
    ------
    ValueError
        If an argument is not an array of 3-vectors, the numbers of sources and moments differ, or the leading axes
        do not broadcast.
    """
    return _sum_over_dipoles(gradient_tensor, (3, 3), points, sources, moments)


def _sum_over_dipoles(
    quantity: Callable[[Array, Array, Array], Array],
    quantity_shape: tuple[int, ...],
    points: ArrayLike,
    sources: ArrayLike,
    moments: ArrayLike,
) -> Array:
    """Sum one dipole's quantity over the second-to-last axis of sources and moments."""
    s = _vectors("points", points)
    p = _vectors("sources", sources)
    m = _vectors("moments", moments)
    if p.ndim < 2 or m.ndim < 2 or p.shape[-2] != m.shape[-2]:
        raise ValueError(
            "Inputs sources and moments must have shapes (..., K, 3) with one K; "
            f"instead received shapes {p.shape} and {m.shape}."
        )
    batch = np.broadcast_shapes(s.shape[:-1], p.shape[:-2], m.shape[:-2])
    total = np.zeros(batch + quantity_shape)
    # One dipole at a time: a broadcast over K would hold K times the memory of the result.
    for j in range(p.shape[-2]):
        total += quantity(s, p[..., j, :], m[..., j, :])
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
    return _unit(_vectors("points", points) - _vectors("source", source))


def _unit(vectors: Array) -> tuple[Array, Array]:
    """Return directions (..., 3) and lengths (..., 1) of vectors; both are NaN for a vector of length zero."""
    lengths = np.sqrt(_dot(vectors, vectors))[..., None]
    # NaN instead of zero spreads quietly through the arithmetic that follows; 0/0 would warn.
    lengths = np.where(lengths > 0.0, lengths, np.nan)
    return vectors / lengths, lengths


def _dot(a: Array, b: Array) -> Array:
    """Return scalar products a.b, shape (...)."""
    return np.vecdot(a, b)


def _outer(a: Array, b: Array) -> Array:
    """Return outer products a b^T, shape (..., 3, 3)."""
    return a[..., :, None] * b[..., None, :]
