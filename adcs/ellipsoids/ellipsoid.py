"""Guaranteed ellipsoids: sets that contain the state for certain, where all that is known of the noise is a bound.

See docs/theory/guaranteed-ellipsoids.md. Source: Pankratova, Sholokhov, Cybernetics and Systems Analysis 55(1), 2019.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike

from adcs.ellipsoids.strip import STEP_RULES, StepRule, cut, tightened_strip
from arrays.io.errors import check_positive
from arrays.typing import BoolArray, FloatArray

# Eigenvalues below zero by this much of the largest one are rounding, as is a difference from the transpose.
_PSD_RTOL = 1e-9
# A direction along which the ellipsoid is thinner than this much of its trace is not seen by a reading.
UNSEEN_RTOL = 1e-12
# Least eigenvalue of a shape, in units of its trace, with which points are tested against a flat one.
_FLAT_RTOL = 1e-13
EPS = float(np.finfo(np.float64).eps)


@dataclass(frozen=True, eq=False)
class Ellipsoid:
    """An ellipsoid, flat ones and points included.

    Attributes
    ----------
    centre : ndarray, shape (n,)
    shape : ndarray, shape (n, n)
        H, symmetric positive semidefinite: its eigenvalues are the squared semi-axes.

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
        """Quadratic form of points, see :func:`quadratic_form`.

        Parameters
        ----------
        points : array_like, shape (..., n)

        Returns
        -------
        ndarray, shape (...)
            At most 1 inside.
        """
        return quadratic_form(self.centre, self.shape, points)

    def contains(self, points: ArrayLike, tolerance: float = 1e-9) -> BoolArray:
        """Whether the form of points, shape (..., n), is at most 1 + tolerance."""
        return self.form(points) <= 1.0 + tolerance


def quadratic_form(centres: ArrayLike, shapes: ArrayLike, points: ArrayLike) -> FloatArray:
    """(x - x̃)ᵀ H⁻¹ (x - x̃), eigenvalues of H taken as 1e-13 tr(H) at least: that keeps flat ellipsoids invertible.

    Shapes ``centres`` (..., n), ``shapes`` (..., n, n), ``points`` (..., n). Returns (...): of an ellipsoid that is a
    point: 0 there and infinite elsewhere.
    """
    shapes = np.asarray(shapes, dtype=np.float64)
    offset = np.asarray(points, dtype=np.float64) - np.asarray(centres, dtype=np.float64)
    trace = np.trace(shapes, axis1=-2, axis2=-1)
    is_point = trace == 0.0
    least = np.where(is_point, 1.0, _FLAT_RTOL * trace)
    # Raised one by one: an addition to all of them would be an error of the thin, not only of the flat ones.
    eigenvalues, axes = np.linalg.eigh(shapes)
    along = (axes.mT @ offset[..., None])[..., 0]
    form = np.sum(along**2 / np.maximum(eigenvalues, least[..., None]), axis=-1)
    return np.where(is_point & (form > 0.0), np.inf, form)


def transformed(ellipsoid: Ellipsoid, A: ArrayLike, offset: ArrayLike = 0.0) -> Ellipsoid:
    """Ellipsoid of all A x + offset.

    Shape ``offset`` (m,). ``A`` (m, n): may be singular or map to another dimension. Returns: exact but for an addition
    of some eps, which covers rounding: a flat or tiny ellipsoid would lose its points to it.
    """
    A, offset = np.asarray(A, dtype=np.float64), np.asarray(offset, dtype=np.float64)
    # An entry of A H Aᵀ is known to n eps r_i r_j, see the notes of intersect_strip.
    reach = np.abs(A) @ ellipsoid.half_widths
    shape = A @ ellipsoid.shape @ A.T + 4.0 * ellipsoid.n * EPS * np.diag(reach**2)
    size = np.abs(A) @ np.abs(ellipsoid.centre) + np.abs(offset)
    return Ellipsoid(A @ ellipsoid.centre + offset, _around_rounded(_symmetric(shape), size))


def minimum_trace_sum(H: FloatArray, Q: FloatArray) -> FloatArray:
    r"""Shape of the ellipsoid of least trace around the sum of two ellipsoids.

    :math:`(1 + 1/k) Q + (1 + k) H` with :math:`k^2 = \mathrm{tr} Q / \mathrm{tr} H`; its trace is
    :math:`(\sqrt{\mathrm{tr} H} + \sqrt{\mathrm{tr} Q})^2`.
    ``H``, ``Q`` (n, n): positive semidefinite; either may be zero or of low rank. Returns shape (n, n).
    """
    trace_H, trace_Q = float(np.trace(H)), float(np.trace(Q))
    if trace_Q == 0.0:
        return H
    if trace_H == 0.0:
        return Q
    # Of the roots, not of the traces: these may differ by more than a number can hold.
    k = math.sqrt(trace_Q) / math.sqrt(trace_H)
    return (1.0 + 1.0 / k) * Q + (1.0 + k) * H


def sum_with_ellipsoid(ellipsoid: Ellipsoid, Q: ArrayLike) -> Ellipsoid:
    """Ellipsoid of least trace around all x + w with wᵀ Q⁻¹ w ≤ 1.

    ``Q`` (n, n): positive semidefinite, singular ones as in :class:`Ellipsoid`.
    """
    added = shape_matrix(Q, ellipsoid.n, "Q")
    return Ellipsoid(ellipsoid.centre, minimum_trace_sum(ellipsoid.shape, added))


def sum_with_segment(ellipsoid: Ellipsoid, direction: ArrayLike, half_length: float) -> Ellipsoid:
    r"""Ellipsoid of least trace around all x + f η with \|η\| ≤ d.

    ``direction`` (n,): f; only its direction counts. ``half_length``: d, positive.
    """
    return Ellipsoid(
        ellipsoid.centre, minimum_trace_sum(ellipsoid.shape, segment_shape(direction, half_length, ellipsoid.n))
    )


def segment_shape(direction: ArrayLike, half_length: float, n: int) -> FloatArray:
    """Shape d² f fᵀ of rank one of the segment from -d f to d f, f of length 1; see :func:`sum_with_segment`."""
    f = unit_direction(direction, n)
    check_positive(half_length=half_length)
    return half_length * half_length * np.outer(f, f)


class Outcome(IntEnum):
    """What a reading did to an ellipsoid."""

    UNINFORMATIVE = 0
    REDUCED = 1
    INCONSISTENT = 2


@dataclass(frozen=True, eq=False)
class StripUpdate:
    """Result of a reading.

    ``ellipsoid``: contains what the strip leaves of the ellipsoid before; the same where the outcome is not
    ``REDUCED``.
    """

    ellipsoid: Ellipsoid
    outcome: Outcome  # ``INCONSISTENT`` where strip and ellipsoid have no point in common


def intersect_strip(
    ellipsoid: Ellipsoid, direction: ArrayLike, value: float, bound: float, rule: StepRule = "optimal"
) -> StripUpdate:
    r"""Ellipsoid around its intersection with the strip \|y - hᵀx\| ≤ c.

    Parameters
    ----------
    direction : array_like, shape (n,)
        h, of any length but zero.
    value : float
        y, the reading.
    bound : float
        c, the largest error of the reading, positive.
    rule : {'optimal', 'tightened', 'lemma'}
        ``optimal`` has the least trace for the strip as it is; ``tightened`` first narrows the strip to where it
        touches the ellipsoid, which usually gives the smallest set (2 % above the true minimum in the plane, on
        average); ``lemma`` is the source paper's simplified step.

    Raises
    ------
    ValueError
        The direction has no length, the reading is not finite, the bound is not positive, or there is no such rule.

    Notes
    -----
    See :mod:`adcs.ellipsoids.strip`. In one dimension the intersection of two intervals is an interval, and every rule
    gives it.

    Rounding is covered. With r = Σ \|h_i\| √H_ii, the largest half-width that an ellipsoid in the same box could have
    along h, e² is known to n eps r², and an entry of the cut shape to n eps (r/e)² √(H_ii H_jj); a matrix of entries
    below √(H_ii H_jj) is below n diag(H). So some n eps (r/e)² diag(H) is added, and as much to the growth of the
    shape, which may be a small difference of large numbers.
    """
    h = measurement_direction(direction, ellipsoid.n)
    check_positive(bound=bound)
    if rule not in STEP_RULES:
        raise ValueError(f"Input rule must be one of {', '.join(STEP_RULES)}; instead received {rule!r}.")
    if not math.isfinite(value):
        raise ValueError(f"Input value must be finite; instead received {value}.")
    x, H = ellipsoid.centre, ellipsoid.shape
    Hh = H @ h
    e2, trace = float(h @ Hh), ellipsoid.trace
    e = math.sqrt(max(e2, 0.0))
    nu = float(value - h @ x)
    c = bound + 4.0 * EPS * (abs(value) + float(np.abs(h) @ np.abs(x)))
    rounding = 4.0 * ellipsoid.n * EPS * float(np.abs(h) @ ellipsoid.half_widths) ** 2
    if abs(nu) > c + math.sqrt(max(e2, 0.0) + rounding):
        return StripUpdate(ellipsoid, Outcome.INCONSISTENT)
    if e2 <= UNSEEN_RTOL * trace * float(h @ h):
        return StripUpdate(ellipsoid, Outcome.UNINFORMATIVE)
    mu, delta = nu / e, c / e
    if ellipsoid.n == 1:
        if abs(mu) + 1.0 <= delta:
            return StripUpdate(ellipsoid, Outcome.UNINFORMATIVE)
        mu, delta = tightened_strip(mu, delta)
        shape = _around_rounded(delta * delta * H, np.abs(x) + ellipsoid.half_widths)
        return StripUpdate(Ellipsoid(x + (mu / e) * Hh, shape), Outcome.REDUCED)
    g = min(float(Hh @ Hh) / (e2 * trace), 1.0)
    margin = rounding / e2
    found = cut(mu, delta, g, rule, margin)
    if found is None:
        return StripUpdate(ellipsoid, Outcome.UNINFORMATIVE)
    mu, step, beta2 = found
    shape = beta2 * (H - (step / e2) * np.outer(Hh, Hh) + margin * np.diag(np.diagonal(H)))
    return StripUpdate(
        Ellipsoid(x + step * (mu / e) * Hh, _around_rounded(_symmetric(shape), np.abs(x))), Outcome.REDUCED
    )


def shape_matrix(shape: ArrayLike, n: int, name: str = "shape") -> FloatArray:
    """Symmetric copy of a positive semidefinite matrix, checked.

    Shapes ``shape`` (n, n) -> (n, n). ``name``: what an error calls it.
    """
    matrix = np.asarray(shape, dtype=np.float64)
    if matrix.shape != (n, n) or not np.isfinite(matrix).all():
        raise ValueError(f"Input {name} must be {n} by {n} finite numbers; instead received shape {matrix.shape}.")
    scale = float(np.abs(matrix).max())
    if np.abs(matrix - matrix.T).max() > _PSD_RTOL * scale:
        raise ValueError(f"Input {name} must be symmetric; instead received {matrix.tolist()}.")
    matrix = _symmetric(matrix)
    smallest = float(np.linalg.eigvalsh(matrix)[0])
    if smallest < -_PSD_RTOL * scale:
        raise ValueError(
            f"Input {name} must be positive semidefinite; instead received one with the eigenvalue {smallest:.3g}."
        )
    return matrix


def measurement_direction(direction: ArrayLike, n: int) -> FloatArray:
    """Direction of a reading, checked: shape (n,), finite and of a length that is not zero."""
    h = np.asarray(direction, dtype=np.float64)
    if h.shape != (n,) or not np.isfinite(h).all() or not h.any():
        raise ValueError(
            f"Input direction must be {n} finite numbers that are not all zero; instead received {h.tolist()}."
        )
    return h


def unit_direction(direction: ArrayLike, n: int) -> FloatArray:
    """Direction of length 1, checked as :func:`measurement_direction`."""
    h = measurement_direction(direction, n)
    h = h / np.abs(h).max()
    return h / np.linalg.norm(h)


def _around_rounded(shape: FloatArray, size: FloatArray) -> FloatArray:
    """Shape that also holds what rounding of the centre, a sum of terms up to size (n,), moves out of it."""
    return minimum_trace_sum(shape, np.diag(len(size) * (4.0 * EPS * size) ** 2))


def _symmetric(matrix: FloatArray) -> FloatArray:
    return 0.5 * (matrix + matrix.T)
