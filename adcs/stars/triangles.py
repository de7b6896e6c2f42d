"""Triangles of stars, and the attitudes that those of an image state by those of a catalogue."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.spatial import cKDTree

from adcs.stars.triangles_compiled import RATIOS, Checks, SkyCells, Triangles, search
from arrays.typing import FloatArray, IntArray

NEIGHBOURS = 24
"""Among which brighter ones are looked for."""


def star_triangles(directions: FloatArray, longest: float, brighter: int) -> Triangles:
    """Triangles of every star with its nearest brighter neighbours.

    ``directions`` (n, 3): unit vectors, brightest first. ``longest``: longest side, a chord. ``brighter``: neighbours
    of each star. Returns: each triangle once.
    """
    n = len(directions)
    k = min(NEIGHBOURS + 1, n)
    found = np.asarray(cKDTree(directions).query(directions, k=k)[1], dtype=np.intp).reshape(n, k)
    own = np.arange(n)[:, None]
    first = np.argsort(found >= own, axis=1, kind="stable")[:, : min(brighter, k)]
    nearest = np.take_along_axis(found, first, axis=1)
    one, two = np.array(list(combinations(range(nearest.shape[1]), 2)), dtype=np.intp).reshape(-1, 2).T
    corners = np.stack([np.broadcast_to(own, (n, len(one))), nearest[:, one], nearest[:, two]], axis=-1).reshape(-1, 3)
    corners = corners[(corners[:, 1:] < corners[:, :1]).all(axis=1)]
    at = directions[corners]
    opposite = np.linalg.norm(at[:, [1, 2, 0]] - at[:, [2, 0, 1]], axis=-1)
    order = np.argsort(opposite, axis=1)
    corners, sides = np.take_along_axis(corners, order, axis=1), np.take_along_axis(opposite, order, axis=1)
    short = (sides[:, 2] > 0.0) & (sides[:, 2] <= longest)  # stars at one place make no triangle
    # Turned inside out: the triple product is positive for corners that go round clockwise seen from the centre.
    a, b, c = np.moveaxis(directions[corners[short]], 1, 0)
    return Triangles(corners[short], sides[short], np.sum(np.cross(a, b) * c, axis=-1) < 0.0)


@dataclass(frozen=True)
class Hypothesis:
    """An attitude that a triangle states."""

    R: FloatArray  # (3, 3): into the catalogue's frame from the image's
    scale: float  # relative to the image's
    tried: int  # hypotheses so far


@dataclass(frozen=True, eq=False)
class TriangleIndex:
    """Triangles of a catalogue, to be found by the ratios of their sides, which no scale changes; see :meth:`of`."""

    bright: FloatArray  # (n, 3): directions of stars that make triangles, brightest first
    triangles: Triangles  # by cell of the ratios, and in it by the longest side
    begins: IntArray  # (RATIOS² + 1,): of the cells

    @classmethod
    def of(cls, bright: FloatArray, longest: float, brighter: int) -> TriangleIndex:
        """Index of all triangles of these stars; see :func:`star_triangles`."""
        made = star_triangles(bright, longest, brighter)
        ratios = np.minimum((made.sides[:, :2] / made.sides[:, 2:] * RATIOS).astype(np.intp), RATIOS - 1)
        cell = ratios @ np.array([RATIOS, 1])
        order = np.lexsort((made.sides[:, 2], cell))
        begins = np.searchsorted(cell[order], np.arange(RATIOS**2 + 1))
        ordered = Triangles(made.corners[order], made.sides[order], made.is_counter_clockwise[order])
        return cls(bright, ordered, begins)

    def best(self, tangents: FloatArray, image: Triangles, sky: SkyCells, checks: Checks) -> Iterator[list[Hypothesis]]:
        """Hypotheses that match stars besides their own, the best of a part of the image's triangles at a time, if any.

        ``tangents`` (f, 2): of the image's stars, brightest first.
        """
        begin = tried = 0
        while begin < len(image.corners) and tried < checks.most:
            begin, agreeing, matched, R, scale = search(
                tangents, image, begin, self.triangles, self.begins, self.bright, sky, checks
            )
            tried += agreeing
            goes_on = begin < len(image.corners) and tried < checks.most
            chosen = np.flatnonzero(matched >= (checks.enough if goes_on else 1))[::-1]
            if len(chosen):
                yield [Hypothesis(R[i], float(scale[i]), tried) for i in chosen]

    def hypotheses(self, tangents: FloatArray, image: Triangles, checks: Checks) -> tuple[FloatArray, FloatArray]:
        """Rotations (h, 3, 3) and relative scales (h,) of all pairs of triangles that agree."""
        known, longest = self.triangles, image.sides[:, 2:]
        gate = checks.side / longest
        off = image.sides[:, None, :2] / longest[:, None] - known.sides[:, :2] / known.sides[:, 2:]
        agree = (off**2).sum(axis=-1) <= gate**2
        agree &= np.abs(known.sides[:, 2] - longest) <= checks.scale * longest + checks.side
        agree &= image.is_counter_clockwise[:, None] == known.is_counter_clockwise
        i, k = np.nonzero(agree)
        scale = np.clip(known.sides[k].sum(axis=1) / image.sides[i].sum(axis=1), 1.0 - checks.scale, 1.0 + checks.scale)
        seen = scale[:, None, None] * tangents[image.corners[i]]
        seen = np.concatenate([seen, np.full((*seen.shape[:2], 1), -1.0)], axis=2)
        seen /= np.linalg.norm(seen, axis=2, keepdims=True)
        return np.swapaxes(_triad(self.bright[known.corners[k]]), 1, 2) @ _triad(seen), scale


def _triad(corners: FloatArray) -> FloatArray:
    """Axes (h, 3, 3), in rows, of triangles (h, 3, 3): the longest side, the middle across it, and the third."""
    along = corners[:, 1] - corners[:, 0]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    middle = corners.sum(axis=1)
    middle -= np.sum(middle * along, axis=1, keepdims=True) * along
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    return np.stack([along, middle, np.cross(along, middle)], axis=1)
