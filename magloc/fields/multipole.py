"""Multipole fields of any order; docs/theory/extended-sources.md has the equation."""

from __future__ import annotations

from functools import cache
from itertools import combinations_with_replacement, permutations
from math import factorial, prod

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import null_space

from arrays.io.errors import _vectors
from arrays.typing import FloatArray
from magloc.fields.dipole import MU0_OVER_4PI

BODY_SIGMA = {2: 0.025, 4: 0.0015}
"""Standard deviations of the components of a body's moments of rank 2 and 4, in units of L² and L⁴."""
_LONGEST_BODY_M = 1e4
DEFAULT_LENGTH = 0.25
"""Assumed length of a body of unknown length, divided by its distance from the nearest sensor."""
NEAR, _N_NEAR = 0.6, 4
"""A default body is assumed if this many sensors are nearer than this distance, in circumradii of the array.

A source near a single sensor may be a fault of that sensor.
"""
N_BODY_ERRORS = sum(2 * rank + 1 for rank in BODY_SIGMA)
"""Number of independent errors of a body that is fitted as a dipole."""


def multipole_field_matrix(points_m: ArrayLike, source_m: ArrayLike, order: int) -> FloatArray:
    """Return the field of each component of a multipole: dipole (order 1), quadrupole (2), octupole (3), and so on.

    Parameters
    ----------
    points_m : array_like, shape (..., 3)
        Points of the field [m].
    source_m : array_like, shape (..., 3)
        Position of the multipole [m].
    order : int
        Order l, at least 1.

    Returns
    -------
    ndarray, shape (..., 3, 2 l + 1)
        Fields [T/(A·m^(l+1))] for an orthonormal basis of the symmetric traceless tensors of rank l; NaN on the source.

    Raises
    ------
    ValueError
        The order is below 1, or the points are not 3-vectors.
    """
    if order < 1:
        raise ValueError(f"Input order must be at least 1; instead received {order}.")
    separation = _vectors("points_m", points_m) - _vectors("source_m", source_m)
    r = np.linalg.norm(separation, axis=-1)[..., None]
    r = np.where(r > 0.0, r, np.nan)
    n = separation / r
    # Contracted with n once per index: S n^(l-1) is a vector, S n^l a number.
    contracted = np.broadcast_to(traceless_basis(order), n.shape[:-1] + (2 * order + 1,) + (3,) * order)
    for _ in range(order - 1):
        contracted = np.einsum(
            "...i,...i->...", contracted, n[(..., *(None,) * (contracted.ndim - n.ndim), slice(None))]
        )
    along = np.einsum("...si,...i->...s", contracted, n)
    pattern = (2 * order + 1) * along[..., None] * n[..., None, :] - order * contracted
    return MU0_OVER_4PI * np.swapaxes(pattern / r[..., None] ** (order + 2), -1, -2)


def finite_body_fields(separation_m: FloatArray, moment_Am2: FloatArray, rank: int) -> FloatArray:
    r"""Return derivatives (..., 3, 2 n + 1) of a body's field by the components of its moments of rank n.

    The traceless moment T of even rank n, 2 or 4, of the magnetisation density adds :math:`T \cdot \nabla^n B / n!` to
    the field of the dipole. Derivatives are by orthonormal components of T, in tesla per m^n. Separations (..., 3) are
    from the body's centre to the points.
    """
    separation, moment = np.broadcast_arrays(separation_m, moment_Am2)
    # Points come last, (3, p), so that inner loops run over them.
    x, m = (np.ascontiguousarray(of.reshape(-1, 3).T) for of in (separation, moment))
    r = np.sqrt(np.sum(x * x, axis=0))
    with np.errstate(invalid="ignore", divide="ignore"):
        n = x / r
    factors, tensors = _contractions(rank)
    powers = [n[of] for of in factors]
    # Tensors contracted with n but for one index, and with the moment instead of one n.
    vector = (tensors @ prod(powers)).reshape(3, 2 * rank + 1, r.size)
    places = range(len(factors))
    once = sum(prod([m[factors[i]] if i == at else powers[i] for i in places]) for at in places)
    bent = (tensors @ (once / len(factors))).reshape(vector.shape)
    number, v_m, n_m = np.sum(vector * n[:, None], axis=0), np.sum(vector * m[:, None], axis=0), np.sum(n * m, axis=0)
    a = 2 * rank + 1
    # The second derivatives of T·xⁿ/r^(2n+1) along the moment.
    pattern = rank * (rank - 1) * bent - (rank * a * n_m) * vector
    pattern += (a * (a + 2) * n_m * number - rank * a * v_m) * n[:, None]
    pattern -= (a * number) * m[:, None]
    with np.errstate(invalid="ignore", divide="ignore"):
        pattern *= MU0_OVER_4PI * prod(range(1, a, 2)) / factorial(rank) / r ** (rank + 3)
    return np.ascontiguousarray(pattern.transpose(2, 0, 1)).reshape(*separation.shape, a)


def finite_body_errors(separation_m: FloatArray, moment_Am2: FloatArray, length_m: FloatArray | float) -> FloatArray:
    """Return one σ of the field that bodies of lengths (..., 1, 1) add to their dipoles: (..., 3, 14) [T].

    The moments of rank 2 and 4 are unknown, with standard deviations that grow with the length:
    docs/theory/extended-sources.md.
    """
    parts = [s * length_m**rank * finite_body_fields(separation_m, moment_Am2, rank) for rank, s in BODY_SIGMA.items()]
    return np.concatenate(parts, axis=-1)


def assumed_body_lengths(
    sensors_m: FloatArray, position_m: FloatArray, radius_m: float, body_length_m: ArrayLike | None
) -> FloatArray:
    """Return lengths (...) of bodies at positions (..., 3): as stated, else a share of the distance near the array."""
    if body_length_m is not None:
        length_m = np.asarray(body_length_m, dtype=np.float64)
        return np.broadcast_to(length_m, np.broadcast_shapes(length_m.shape, position_m.shape[:-1]))
    distance = np.linalg.norm(position_m[..., None, :] - sensors_m, axis=-1)
    last = min(_N_NEAR, distance.shape[-1]) - 1
    ordered = np.partition(distance, [0, last], axis=-1)
    return np.where(ordered[..., last] < NEAR * radius_m, DEFAULT_LENGTH * ordered[..., 0], 0.0)


def check_body_length(body_length_m: ArrayLike | None) -> None:
    """Raise ValueError for invalid lengths of bodies; None means that no length is stated."""
    length_m = np.ravel(0.0 if body_length_m is None else body_length_m)
    wrong = length_m[~((length_m >= 0.0) & (length_m <= _LONGEST_BODY_M))]
    if wrong.size:
        raise ValueError(f"Input body_length_m must be from 0 to {_LONGEST_BODY_M:g} m; instead received {wrong[0]:g}.")


@cache
def traceless_basis(order: int) -> FloatArray:
    """Return an orthonormal basis of the symmetric traceless tensors of a rank, (2 l + 1, 3, …, 3)."""
    symmetric = []
    for index in combinations_with_replacement(range(3), order):
        tensor = np.zeros((3,) * order)
        for place in set(permutations(index)):
            tensor[place] = 1.0
        symmetric.append(tensor / np.linalg.norm(tensor))
    basis = np.stack(symmetric)
    if order == 1:
        return basis
    traces = np.trace(basis, axis1=1, axis2=2).reshape(len(basis), -1)
    return np.tensordot(null_space(traces.T).T, basis, axes=1)


@cache
def _contractions(rank: int) -> tuple[list[list[int]], FloatArray]:
    """Return the factors' indices of all monomials of rank - 1, and the traceless basis by them (3 (2 l + 1), f)."""
    monomials = list(combinations_with_replacement(range(3), rank - 1))
    basis = np.moveaxis(traceless_basis(rank), 0, 1).reshape(3, 2 * rank + 1, -1)
    places = [[np.ravel_multi_index(of, (3,) * (rank - 1)) for of in set(permutations(every))] for every in monomials]
    columns = [basis[..., of].sum(axis=-1) for of in places]
    return [list(of) for of in zip(*monomials, strict=True)], np.stack(columns, axis=-1).reshape(-1, len(monomials))
