"""Nearest lights of many points at once, by a table over the ceiling."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adcs.mockup.vision.triangles import TriangleCatalogue
from arrays.typing import ComplexArray, FloatArray, IntArray

_CELLS_PER_SPACING = 4  # cells per distance of the two closest lights
_MOST_CELLS = 2_000_000


@dataclass(frozen=True, eq=False)
class LightMap:
    """Nearest light of every cell of a grid over the ceiling; made by :meth:`of`."""

    plane: ComplexArray  # (n,): the lights, X + iY [m]
    corner: complex  # lower left corner of the grid [m]
    cell_m: float
    nearest: IntArray  # (rows, columns): index of the light nearest to the cell's middle

    @classmethod
    def of(cls, catalogue: TriangleCatalogue) -> LightMap:
        """Return the map of a catalogue's lights.

        A cell is a quarter of the smallest distance d between two lights. A point within 0.32 d of a light is therefore
        matched to that light.
        """
        positions = catalogue.positions_m
        distance = np.asarray(catalogue.star_tree.query(positions, k=2)[0])
        low, high = positions.min(axis=0), positions.max(axis=0)
        smallest = float(np.sqrt(np.prod(high - low) / _MOST_CELLS))
        cell = max(float(distance[:, 1].min()) / _CELLS_PER_SPACING, smallest)
        x, y = (np.arange(low[axis] - cell, high[axis] + 2.0 * cell, cell) for axis in range(2))
        middles = np.stack(np.meshgrid(x, y), axis=-1) + 0.5 * cell
        nearest = np.asarray(catalogue.star_tree.query(middles)[1], dtype=np.intp)
        return cls(catalogue.plane, complex(x[0], y[0]), cell, nearest)

    def lights_near(self, points: ComplexArray) -> IntArray:
        """Return the index of the light nearest to points X + iY [m].

        Points outside of the grid get a light near its border.
        """
        offset = (points - self.corner) * (1.0 / self.cell_m)
        rows, columns = self.nearest.shape
        column = np.clip(offset.real.astype(np.intp), 0, columns - 1)
        row = np.clip(offset.imag.astype(np.intp), 0, rows - 1)
        return self.nearest[row, column]

    def misses(self, points: ComplexArray, limit_m: float) -> FloatArray:
        """Sum the squared distances to the nearest light over the last axis, each at most the limit²."""
        offset = points - self.plane[self.lights_near(points)]
        return np.minimum(offset.real**2 + offset.imag**2, limit_m**2).sum(axis=-1)

    def misses_of_poses(self, image: ComplexArray, a: ComplexArray, b: ComplexArray, limit_m: float) -> FloatArray:
        """:meth:`misses` of an image under poses (h,), star by star; see :mod:`adcs.mockup.vision.similarity`."""
        total = np.zeros(len(a))
        for star in image:
            total += self.misses((a * star + b)[:, None], limit_m)
        return total
