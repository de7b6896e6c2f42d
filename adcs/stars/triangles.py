"""Triangles of stars, and attitude hypotheses from matches of image and catalogue."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from adcs.stars.catalogue import CELLS, SkyCells
from arrays.typing import BoolArray, FloatArray, IntArray
from magloc import core

NEIGHBOURS = 24
"""Number of nearest neighbours among which brighter stars are searched."""
KEPT = 8
"""Number of best hypotheses."""
_FIRST_LEVEL, _LEVEL_NEIGHBOURS = 24, 16
"""Number of stars of the first level of a catalogue's triangles, and of nearest neighbours in the later ones."""
_RATIOS = 64
"""Number of cells of a ratio of two sides."""
_BLOCK = 16
"""Triangles of an image per call; each takes up to a millisecond."""


class StarTriangles(NamedTuple):
    """Triangles of stars: corners ordered by the opposite side, shortest first."""

    corners: IntArray  # (T, 3)
    sides: FloatArray  # (T, 3): chords, ascending
    is_counter_clockwise: BoolArray  # (T,): seen from the centre of the sphere


class Checks(NamedTuple):
    """Limits that an attitude hypothesis must pass."""

    side: float  # largest difference of two sides, as chords
    scale: float  # relative error of the image's scale
    near: float  # largest chord between a star of the image and its place in the catalogue
    stars: int  # number of the image's brightest stars that are checked
    enough: int  # number of matches that ends a search
    most: int  # number of attitudes that ends a search


def star_triangles(
    directions: FloatArray, longest: float, brighter: int, *, first: int = 0, neighbours: int = NEIGHBOURS
) -> StarTriangles:
    """Return the triangles of each star with its nearest brighter neighbours.

    ``directions`` (n, 3): unit vectors, brightest first. ``longest``: longest side, a chord. ``brighter``: number of
    neighbours of each star, among the ``neighbours`` nearest. Each triangle is returned once. ``first``: row from which
    on stars make triangles with brighter ones.
    """
    n = len(directions)
    if n < 3:
        return StarTriangles(np.empty((0, 3), np.intp), np.empty((0, 3)), np.empty(0, np.bool_))
    k = min(neighbours + 1, n)
    found = np.asarray(cKDTree(directions).query(directions[first:], k=k)[1], dtype=np.intp).reshape(-1, k)
    own = np.arange(first, n)[:, None]
    order = np.argsort(found >= own, axis=1, kind="stable")[:, : min(brighter, k)]
    nearest = np.take_along_axis(found, order, axis=1)
    one, two = np.array(list(combinations(range(nearest.shape[1]), 2)), dtype=np.intp).reshape(-1, 2).T
    corners = np.stack([np.broadcast_to(own, (len(own), len(one))), nearest[:, one], nearest[:, two]], axis=-1).reshape(
        -1, 3
    )
    corners = corners[(corners[:, 1:] < corners[:, :1]).all(axis=1)]
    at = directions[corners]
    opposite = np.linalg.norm(at[:, [1, 2, 0]] - at[:, [2, 0, 1]], axis=-1)
    order = np.argsort(opposite, axis=1)
    corners, sides = np.take_along_axis(corners, order, axis=1), np.take_along_axis(opposite, order, axis=1)
    short = (sides[:, 2] > 0.0) & (sides[:, 2] <= longest)  # stars at one place make no triangle
    # The triple product is positive for corners that are clockwise seen from the centre.
    a, b, c = np.moveaxis(directions[corners[short]], 1, 0)
    return StarTriangles(corners[short], sides[short], np.sum(np.cross(a, b) * c, axis=-1) < 0.0)


class RankedTriangles:
    """Triangles of a catalogue, computed down to the brightness that is asked for.

    A star's nearest brighter neighbours do not depend on fainter stars, so those of fewer stars are among those of
    more.

    Parameters
    ----------
    directions : ndarray, shape (n, 3)
        Unit vectors, brightest first.
    brighter : int
        Number of brighter neighbours of each star.
    """

    def __init__(self, directions: FloatArray, brighter: int) -> None:
        self.directions = directions
        self._brighter = brighter
        self._levels = [star_triangles(directions[:_FIRST_LEVEL], 2.0, brighter)]
        self._done = min(_FIRST_LEVEL, len(directions))

    def of_brightest(self, n: int, longest: float) -> StarTriangles:
        """Return the triangles of the ``n`` brightest stars whose longest side, a chord, is at most ``longest``."""
        n = min(n, len(self.directions))
        while self._done < n:
            # Half of the neighbours or more are brighter than any star of the level.
            end = min(2 * self._done, n)
            level = star_triangles(
                self.directions[:end], 2.0, self._brighter, first=self._done, neighbours=_LEVEL_NEIGHBOURS
            )
            self._levels.append(level)
            self._done = end
        corners, sides, turns = (np.concatenate(parts) for parts in zip(*self._levels, strict=True))
        within = (sides[:, 2] <= longest) & (corners.max(axis=1, initial=0) < n)
        return StarTriangles(corners[within], sides[within], turns[within])


@dataclass(frozen=True)
class AttitudeHypothesis:
    """Attitude from the match of one triangle."""

    R: FloatArray  # (3, 3): catalogue from image
    scale: float  # scale relative to the image's
    tried: int  # number of hypotheses so far


@dataclass(frozen=True, eq=False)
class TriangleIndex:
    """Triangles of a catalogue, indexed by the ratios of their sides; made by :meth:`of`."""

    bright: FloatArray  # (n, 3): directions of stars that make triangles, brightest first
    triangles: StarTriangles  # by cell of the ratios, and in it by the longest side
    begins: IntArray  # (_RATIOS² + 1,): first triangle of each cell

    @classmethod
    def of(cls, ranked: RankedTriangles, brightest: int, longest: float) -> TriangleIndex:
        """Return the index of the triangles of the brightest stars; see :meth:`RankedTriangles.of_brightest`."""
        made = ranked.of_brightest(brightest, longest)
        ratios = np.minimum((made.sides[:, :2] / made.sides[:, 2:] * _RATIOS).astype(np.intp), _RATIOS - 1)
        cell = ratios @ np.array([_RATIOS, 1])
        order = np.lexsort((made.sides[:, 2], cell))
        begins = np.searchsorted(cell[order], np.arange(_RATIOS**2 + 1))
        ordered = StarTriangles(made.corners[order], made.sides[order], made.is_counter_clockwise[order])
        return cls(ranked.directions[:brightest], ordered, begins)

    def best(
        self, tangents: FloatArray, image: StarTriangles, sky: SkyCells, checks: Checks
    ) -> Iterator[list[AttitudeHypothesis]]:
        """Yield the best hypotheses that match further stars, for one part of the image's triangles at a time.

        ``tangents`` (f, 2): tangents of the image's stars, brightest first.
        """
        n, known = len(image.corners), self.triangles
        progress = np.zeros(2, np.int64)
        while progress[0] < n and progress[1] < checks.most:
            matched, R, scale = np.zeros(KEPT, np.int64), np.empty((KEPT, 3, 3)), np.empty(KEPT)
            work = core.problem(
                "star_triangles",
                n_image=n,
                n_checked=checks.stars,
                tangents=np.ascontiguousarray(tangents),
                image_corners=image.corners,
                image_sides=image.sides,
                image_is_counter_clockwise=image.is_counter_clockwise.view(np.uint8),
                n_ratios=_RATIOS,
                begins=self.begins,
                corners=known.corners,
                sides=known.sides,
                is_counter_clockwise=known.is_counter_clockwise.view(np.uint8),
                bright=self.bright,
                n_cells=CELLS,
                sky_begins=sky.begins,
                sky=sky.directions,
                side_gate=checks.side,
                scale_gate=checks.scale,
                star_gate=checks.near,
                n_enough=checks.enough,
                n_most=int(progress[1]) + checks.most,
                progress=progress,
                n_kept=KEPT,
                matched=matched,
                rotations=R,
                scales=scale,
            )
            core.run("star_search", work, n, block=_BLOCK, chain=n)
            goes_on = progress[0] < n and progress[1] < checks.most
            chosen = np.flatnonzero(matched >= (checks.enough if goes_on else 1))[::-1]
            if len(chosen):
                yield [AttitudeHypothesis(R[i], float(scale[i]), int(progress[1])) for i in chosen]
