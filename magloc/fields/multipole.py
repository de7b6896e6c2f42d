"""Multipole fields of any order, equation of docs/theory/extended-sources.md."""

from __future__ import annotations

from functools import cache
from itertools import combinations_with_replacement, permutations

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import null_space

from arrays.io.errors import _vectors
from arrays.typing import FloatArray
from magloc.fields.dipole import MU0_OVER_4PI


def multipole_field_matrix(points_m: ArrayLike, source_m: ArrayLike, order: int) -> FloatArray:
    """Field of every component of a multipole: the dipole (order 1), the quadrupole (2), the octupole (3), and so on.

    Parameters
    ----------
    points_m : array_like, shape (..., 3)
        Where the field is wanted [m].
    source_m : array_like, shape (..., 3)
        Where the multipole is [m].
    order : int
        l, at least 1.

    Returns
    -------
    ndarray, shape (..., 3, 2 l + 1)
        [T/(A·m^(l+1))], for an orthonormal basis of the symmetric traceless tensors of rank l. NaN on the source.

    Raises
    ------
    ValueError
        The order is below 1, or the points are no 3-vectors.
    """
    if order < 1:
        raise ValueError(f"Input order must be at least 1; instead received {order}.")
    separation = _vectors("points_m", points_m) - _vectors("source_m", source_m)
    r = np.linalg.norm(separation, axis=-1)[..., None]
    r = np.where(r > 0.0, r, np.nan)
    n = separation / r
    # Contracted with n once per index: S n^(l-1) is a vector, S n^l a number.
    contracted = np.broadcast_to(_traceless_basis(order), n.shape[:-1] + (2 * order + 1,) + (3,) * order)
    for _ in range(order - 1):
        contracted = np.einsum(
            "...i,...i->...", contracted, n[(..., *(None,) * (contracted.ndim - n.ndim), slice(None))]
        )
    along = np.einsum("...si,...i->...s", contracted, n)
    pattern = (2 * order + 1) * along[..., None] * n[..., None, :] - order * contracted
    return MU0_OVER_4PI * np.swapaxes(pattern / r[..., None] ** (order + 2), -1, -2)


@cache
def _traceless_basis(order: int) -> FloatArray:
    """Orthonormal basis of the symmetric traceless tensors of a rank, (2 l + 1, 3, …, 3)."""
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
