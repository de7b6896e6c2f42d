"""Symmetry of a body: rotations and permutations of its magnets that leave the set of magnets as it is.

All poses of an orbit of this group have the same field. They are one solution.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from arrays.typing import FloatArray
from magloc.bodies.body import MagnetBody
from magloc.navigation.rotations import unit_across

_SAME = 1e-6  # largest relative difference of magnets that map onto each other
_COLLINEAR = 1e-6


@dataclass(frozen=True, eq=False)
class BodySymmetry:
    """Rotations about the centre of the magnets that map a body to itself.

    Attributes
    ----------
    centre_m : ndarray, shape (3,)
        Centre of the magnets in the body's frame [m].
    rotations : ndarray, shape (g, 3, 3)
        Rotations of the group, the identity first.
    axis : ndarray, shape (3,), optional
        Axis about which every rotation maps the body to itself; then `rotations` contains only rotations that keep or
        reverse it.
    """

    centre_m: FloatArray
    rotations: FloatArray
    axis: FloatArray | None = None

    @property
    def order(self) -> int:
        """Number of rotations; those about a continuous axis are not counted."""
        return len(self.rotations)

    @property
    def words(self) -> str:
        """Sentence about the symmetry; empty for a body without one."""
        if self.axis is not None:
            axis = ", ".join(f"{x:.3g}" for x in self.axis)
            return f"the body looks the same after every rotation about its axis ({axis}): this angle is unknown"
        if self.order > 1:
            return f"the body looks the same in {self.order} poses, which are one solution: the one nearest to rest"
        return ""

    def orbit(self, position_m: FloatArray, R: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return all poses (..., g, 3) and (..., g, 3, 3) that look like poses (..., 3) and (..., 3, 3)."""
        turned = R[..., None, :, :] @ self.rotations
        moved = (R[..., None, :, :] - turned) @ self.centre_m
        return position_m[..., None, :] + moved, turned

    def nearest_to_rest(self, position_m: FloatArray, R: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the poses of the orbits with the smallest rotation, and the rotations (..., 3, 3) that lead there."""
        places, turned = self.orbit(position_m, R)
        best = np.argmax(np.trace(turned, axis1=-2, axis2=-1), axis=-1)[..., None]
        place = np.take_along_axis(places, best[..., None], axis=-2)[..., 0, :]
        turn = np.take_along_axis(turned, best[..., None, None], axis=-3)[..., 0, :, :]
        return place, turn, self.rotations[best[..., 0]]


def body_symmetry(body: MagnetBody) -> BodySymmetry:
    """Return the symmetry of a body, from its magnets as dipoles or with their shapes."""
    centre = body.centre_m
    arms = (body.positions_m - centre) / max(body.radius_m, np.finfo(np.float64).tiny)
    moments = body.moments_Am2 / np.linalg.norm(body.moments_Am2, axis=1).max()
    vectors = np.concatenate([arms, moments])
    first = int(np.argmax(np.linalg.norm(vectors, axis=1)))
    across = np.linalg.norm(np.cross(vectors[first], vectors), axis=1)
    second = int(np.argmax(across))
    if across[second] < _COLLINEAR:
        axis = vectors[first] / np.linalg.norm(vectors[first])
        flip = 2.0 * np.outer(unit_across(axis), unit_across(axis)) - np.eye(3)
        turns = [np.eye(3), *([flip] if _maps(body, flip, arms, moments) else [])]
        return BodySymmetry(centre, np.array(turns), axis)
    frame = _frame(vectors[first], vectors[second])
    n = len(arms)
    found: list[FloatArray] = [np.eye(3)]
    for i, j in product(range(n), repeat=2):
        a, b = vectors[i + n * (first >= n)], vectors[j + n * (second >= n)]
        if np.linalg.norm(np.cross(a, b)) < _COLLINEAR:
            continue
        turn = _frame(a, b) @ frame.T
        known = any(np.allclose(turn, other, atol=1e-5) for other in found)
        if not known and _maps(body, turn, arms, moments):
            found.append(turn)
    return BodySymmetry(centre, np.array(found))


def _frame(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the orthonormal frame (3, 3), in columns, of two vectors."""
    x = a / np.linalg.norm(a)
    z = np.cross(a, b) / np.linalg.norm(np.cross(a, b))
    return np.column_stack([x, np.cross(z, x), z])


def _maps(body: MagnetBody, turn: FloatArray, arms: FloatArray, moments: FloatArray) -> bool:
    """Return whether a rotation maps every magnet onto another one of the same shape."""
    apart = np.linalg.norm(arms @ turn.T - arms[:, None], axis=-1)
    apart = apart + np.linalg.norm(moments @ turn.T - moments[:, None], axis=-1)
    nearest = apart.argmin(axis=0)
    shapes = [magnet.shape for magnet in body.magnets]
    return (
        bool((apart.min(axis=0) < _SAME).all())
        and len(set(nearest.tolist())) == len(nearest)
        and all(shapes[k] == shapes[to] for k, to in enumerate(nearest.tolist()))
    )
