"""Delaunay triangles of lights, and their catalogue.

See docs/theory/tabletop-vision.md. Source: Bindel, Ivanov, Nuzhdin, Ovchinnikov, Trofimov, KIAM preprint, "Star image
processing".
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import Delaunay, QhullError, cKDTree

from adcs.mockup.vision.similarity import complex_points, pairs_of
from adcs.mockup.vision.sky import interior_angles
from arrays.typing import BoolArray, ComplexArray, FloatArray, IntArray

# Smallest angle of a triangle; rounding makes flatter ones of lights in one line on the hull.
FLAT_RAD = 1e-6


@dataclass(frozen=True, eq=False)
class LightTriangles:
    """Triangles between numbered points."""

    corners: IntArray  # (T, 3): indices of the points at the smallest, the largest and the third angle
    angles_rad: FloatArray  # (T, 2): smallest and largest interior angle
    is_counter_clockwise: BoolArray  # (T,): orientation of the corners in that order

    def __len__(self) -> int:
        return len(self.corners)

    def select(self, chosen: BoolArray) -> LightTriangles:
        """Select triangles by a mask, shape (T,)."""
        return LightTriangles(self.corners[chosen], self.angles_rad[chosen], self.is_counter_clockwise[chosen])


def triangles_between(plane: ComplexArray, corners: IntArray) -> LightTriangles:
    """Return triangles with given corners (T, 3) in any order, between points x + iy."""
    angles = interior_angles(pairs_of(plane[corners]))
    order = np.argsort(angles, axis=1)[:, [0, 2, 1]]
    ordered = np.take_along_axis(corners, order, axis=1)
    first, second, third = plane[ordered].T
    turn = np.conj(second - first) * (third - first)
    return LightTriangles(ordered, np.take_along_axis(angles, order[:, :2], axis=1), turn.imag > 0.0)


def delaunay_triangles(plane: ComplexArray, smallest_rad: float = FLAT_RAD) -> LightTriangles:
    """Return the triangles of Delaunay's triangulation, without slivers.

    ``plane`` (n,): points x + iy; fewer than three points, or points in one line, have no triangle. ``smallest_rad``:
    smallest angle of a triangle that is not a sliver. The triangles are sorted by the indices of their points.
    """
    corners = np.empty((0, 3), dtype=np.intp)
    if len(plane) >= 3:
        with suppress(QhullError):  # all in one line or one place
            corners = Delaunay(pairs_of(plane)).simplices.astype(np.intp)
    numbers = np.sort(corners, axis=1)
    triangles = triangles_between(plane, corners[np.lexsort(numbers.T[::-1])])
    return triangles.select(triangles.angles_rad[:, 0] >= smallest_rad)


@dataclass(frozen=True, eq=False)
class TriangleCatalogue:
    """Lights of a sky and the triangles between them; made by :meth:`of`.

    Attributes
    ----------
    positions_m : ndarray, shape (n, 2)
        Lights, table axes.
    triangles : LightTriangles
        Delaunay triangles of all lights.

    Examples
    --------
    >>> from adcs import mockup
    >>> catalogue = mockup.TriangleCatalogue.of(mockup.led_sky().positions_m)
    >>> catalogue.n_stars, len(catalogue.triangles)
    (180, 322)
    """

    positions_m: FloatArray
    triangles: LightTriangles

    @classmethod
    def of(cls, positions_m: ArrayLike) -> TriangleCatalogue:
        """Return a catalogue of lights.

        Parameters
        ----------
        positions_m : array_like, shape (n, 2)
            Lights, table axes.

        Returns
        -------
        TriangleCatalogue
            Lights with their Delaunay triangles.

        Raises
        ------
        ValueError
            There are fewer than four lights, one is not finite, or all are in one line.
        """
        plane = complex_points(positions_m, "positions_m")
        if len(plane) < 4:
            raise ValueError(f"Input positions_m must have four lights at least; instead received {len(plane)}.")
        triangles = delaunay_triangles(plane)
        if not len(triangles):
            raise ValueError(f"Input positions_m must not lie in one line; instead received {len(plane)} that do.")
        return cls(pairs_of(plane), triangles)

    @property
    def n_stars(self) -> int:
        """Number of lights."""
        return len(self.positions_m)

    @cached_property
    def plane(self) -> ComplexArray:
        """Lights as X + iY, shape (n,) [m]."""
        return complex_points(self.positions_m)

    @cached_property
    def angle_tree(self) -> cKDTree:
        """Search tree of the triangles' pairs of angles."""
        return cKDTree(self.triangles.angles_rad)

    @cached_property
    def star_tree(self) -> cKDTree:
        """Search tree of the lights' positions."""
        return cKDTree(self.positions_m)
