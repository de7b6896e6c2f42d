"""Guaranteed ellipsoids: sets that contain the state with certainty if the noise is bounded.

See docs/theory/guaranteed-ellipsoids.md. Source: Pankratova, Sholokhov, Cybernetics and Systems Analysis 55(1), 2019.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from arrays.io.errors import check_positive
from arrays.typing import BoolArray, FloatArray

# Largest rounding error of an eigenvalue, or of a difference from the transpose, relative to the largest element.
_PSD_RTOL = 1e-9
# Smallest eigenvalue of a shape over its trace; smaller ones are raised to it, so that flat ellipsoids are invertible.
_FLAT_RTOL = 1e-13


@dataclass(frozen=True, eq=False)
class Ellipsoid:
    """Ellipsoid, including flat ones and points.

    Attributes
    ----------
    centre : ndarray, shape (n,)
        Centre x̃.
    shape : ndarray, shape (n, n)
        H, symmetric and positive semidefinite: its eigenvalues are the squared semi-axes.

    Raises
    ------
    ValueError
        The sizes do not match, a number is not finite, or the shape is not symmetric positive semidefinite.

    Examples
    --------
    >>> import numpy as np
    >>> import adcs
    >>> adcs.Ellipsoid(np.zeros(2), np.diag([4.0, 9.0])).trace
    13.0
    """

    centre: FloatArray
    shape: FloatArray

    def __post_init__(self) -> None:
        centre = np.array(self.centre, dtype=np.float64)
        if centre.ndim != 1 or centre.size == 0 or not np.isfinite(centre).all():
            raise ValueError(f"Input centre must be a vector of finite numbers; instead received {self.centre}.")
        object.__setattr__(self, "centre", centre)
        object.__setattr__(self, "shape", shape_matrix(self.shape, centre.size))

    @property
    def n(self) -> int:
        """Dimension of the space."""
        return int(self.centre.size)

    @property
    def trace(self) -> float:
        """Sum of the squared semi-axes."""
        return float(np.trace(self.shape))

    @property
    def semi_axes(self) -> FloatArray:
        """Lengths of the semi-axes, largest first, shape (n,)."""
        return np.sqrt(np.maximum(np.linalg.eigvalsh(self.shape)[::-1], 0.0))

    @property
    def half_widths(self) -> FloatArray:
        """Half-widths of the box around the ellipsoid, √H_ii, shape (n,)."""
        return np.sqrt(np.diagonal(self.shape))

    def form(self, points: ArrayLike) -> FloatArray:
        """Return the quadratic form of points; see :func:`quadratic_form`.

        Parameters
        ----------
        points : array_like, shape (..., n)
            Points in the space of the ellipsoid.

        Returns
        -------
        ndarray, shape (...)
            Values of at most 1 inside the ellipsoid.
        """
        return quadratic_form(self.centre, self.shape, points)

    def contains(self, points: ArrayLike, tolerance: float = 1e-9) -> BoolArray:
        """Return whether points are inside the ellipsoid.

        Parameters
        ----------
        points : array_like, shape (..., n)
            Points in the space of the ellipsoid.
        tolerance : float
            Excess of the quadratic form over 1 that still counts as inside.

        Returns
        -------
        ndarray of bool, shape (...)
            True inside and on the boundary.
        """
        return self.form(points) <= 1.0 + tolerance


def quadratic_form(centres: ArrayLike, shapes: ArrayLike, points: ArrayLike) -> FloatArray:
    """Return (x - x̃)ᵀ H⁻¹ (x - x̃), with eigenvalues of H of at least 1e-13 tr(H).

    Shapes ``centres`` (..., n), ``shapes`` (..., n, n), ``points`` (..., n) -> (...). For an ellipsoid that is a point
    the form is 0 there and infinite elsewhere.
    """
    shapes = np.asarray(shapes, dtype=np.float64)
    offset = np.asarray(points, dtype=np.float64) - np.asarray(centres, dtype=np.float64)
    trace = np.trace(shapes, axis1=-2, axis2=-1)
    is_point = trace == 0.0
    least = np.where(is_point, 1.0, _FLAT_RTOL * trace)
    # Small eigenvalues are raised one by one: adding to all of them would change thin ellipsoids too.
    eigenvalues, axes = np.linalg.eigh(shapes)
    along = (axes.mT @ offset[..., None])[..., 0]
    form = np.sum(along**2 / np.maximum(eigenvalues, least[..., None]), axis=-1)
    return np.where(is_point & (form > 0.0), np.inf, form)


def segment_shape(direction: ArrayLike, half_length: float, n: int) -> FloatArray:
    """Return the shape d² f fᵀ of the segment from -d f to d f, with f of length 1."""
    f = unit_direction(direction, n)
    check_positive(half_length=half_length)
    return half_length * half_length * np.outer(f, f)


def shape_matrix(shape: ArrayLike, n: int, name: str = "shape") -> FloatArray:
    """Return a symmetric copy of a matrix; raise ValueError unless it is positive semidefinite.

    Shapes ``shape`` (n, n) -> (n, n). ``name``: name of the argument in errors.
    """
    matrix = np.asarray(shape, dtype=np.float64)
    if matrix.shape != (n, n) or not np.isfinite(matrix).all():
        raise ValueError(f"Input {name} must be {n} by {n} finite numbers; instead received shape {matrix.shape}.")
    scale = float(np.abs(matrix).max())
    if np.abs(matrix - matrix.T).max() > _PSD_RTOL * scale:
        raise ValueError(f"Input {name} must be symmetric; instead received {matrix.tolist()}.")
    matrix = 0.5 * (matrix + matrix.T)
    smallest = float(np.linalg.eigvalsh(matrix)[0])
    if smallest < -_PSD_RTOL * scale:
        raise ValueError(
            f"Input {name} must be positive semidefinite; instead received one with the eigenvalue {smallest:.3g}."
        )
    return matrix


def measurement_direction(direction: ArrayLike, n: int) -> FloatArray:
    """Return the direction of a reading, (n,); raise ValueError unless it is finite and not zero."""
    h = np.asarray(direction, dtype=np.float64)
    if h.shape != (n,) or not np.isfinite(h).all() or not h.any():
        raise ValueError(
            f"Input direction must be {n} finite numbers that are not all zero; instead received {h.tolist()}."
        )
    return h


def unit_direction(direction: ArrayLike, n: int) -> FloatArray:
    """Return a direction of length 1; errors as in :func:`measurement_direction`."""
    h = measurement_direction(direction, n)
    h = h / np.abs(h).max()
    return h / np.linalg.norm(h)
