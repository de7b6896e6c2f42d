"""Tiles of a large survey: squares with a margin of rows, each surveyed separately."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from arrays.typing import BoolArray, FloatArray, IntArray

_CORE, _MARGIN = 4.0, 1.2  # widths relative to the distance from the sensors to the deepest sources
SEAM_M = 1.2  # wider than the margin of sources beside the rows


@dataclass(frozen=True, eq=False)
class Tile:
    """A rectangle, and the rows in it and around it.

    Attributes
    ----------
    low_m, high_m : ndarray, shape (2,)
        Corners of the rectangle; infinite on sides without another tile.
    rows : ndarray of int
    own : ndarray of bool
        True for rows in the rectangle, False for those in the margin.
    colour : int
        0 to 3; adjacent tiles differ.
    """

    low_m: FloatArray
    high_m: FloatArray
    rows: IntArray
    own: BoolArray
    colour: int = 0

    def extent_m(self, places_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the ends of the rectangle; on open sides those of places (n, 2) in it."""
        low = np.where(np.isfinite(self.low_m), self.low_m, places_m.min(axis=0))
        return low, np.where(np.isfinite(self.high_m), self.high_m, places_m.max(axis=0))

    def inside_m(self, position_m: FloatArray) -> FloatArray:
        """Return the distance (K,) of positions (K, 3) from the edge of the rectangle, negative outside."""
        xy = position_m[:, :2]
        return np.asarray(np.minimum(xy - self.low_m, self.high_m - xy).min(axis=1, initial=np.inf))

    def contains(self, position_m: FloatArray) -> BoolArray:
        """Return which positions (K, 3) are inside, or on the seam."""
        return self.inside_m(position_m) > -SEAM_M


def tiles_of(places_m: FloatArray, reach_m: float) -> tuple[list[Tile], float]:
    """Return the tiles of rows at places (n, 2), and the width of their margins.

    Sources are no farther from rows than the reach.
    """
    margin = _MARGIN * reach_m
    low, high = places_m.min(axis=0), places_m.max(axis=0)
    number = np.maximum(1, np.round((high - low) / (_CORE * reach_m))).astype(np.intp)
    size = (high - low) / number
    cell = np.clip(((places_m - low) / np.where(size > 0.0, size, 1.0)).astype(np.intp), 0, number - 1)
    cell = cell[:, 0] * number[1] + cell[:, 1]
    order = np.argsort(places_m[:, 0], kind="stable")
    x = places_m[order, 0]
    tiles = []
    for index in np.unique(cell):
        own_cell = np.array(divmod(index, number[1]))
        start, end = low + own_cell * size, low + (own_cell + 1) * size
        strip = order[slice(*np.searchsorted(x, [start[0] - margin, end[0] + margin]))]
        y = places_m[strip, 1]
        rows = np.sort(strip[(y >= start[1] - margin) & (y <= end[1] + margin)])
        open_low = np.where(own_cell == 0, -np.inf, start)
        open_high = np.where(own_cell == number - 1, np.inf, end)
        colour = int(own_cell[0] % 2 + 2 * (own_cell[1] % 2))
        tiles.append(Tile(open_low, open_high, rows, cell[rows] == index, colour))
    return tiles, margin


def assign_sources(tiles: Sequence[Tile], position_m: Sequence[FloatArray], same_m: float) -> list[tuple[int, int]]:
    """Return tile and index of every source that tiles found in (K, 3).

    A source on a seam counts once, for the tile in which it is farther from the edge.
    """
    found = []
    for t, (tile, places) in enumerate(zip(tiles, position_m, strict=True)):
        inside = tile.inside_m(places)
        found += [(float(inside[k]), t, int(k)) for k in np.flatnonzero(inside > -SEAM_M)]
    found.sort(key=lambda entry: (-entry[0], entry[1:]))
    kept: list[tuple[int, int]] = []
    on_seam: list[set[int]] = []  # tiles of each source on a seam
    places = np.empty((len(found), 3))
    for inside_m, t, k in found:
        if inside_m <= SEAM_M:
            n = len(on_seam)
            apart = np.linalg.norm(places[:n] - position_m[t][k], axis=1)
            same = [int(s) for s in np.flatnonzero(apart < same_m) if t not in on_seam[s]]
            if same:
                on_seam[min(same, key=apart.__getitem__)].add(t)
                continue
            places[n] = position_m[t][k]
            on_seam.append({t})
        kept.append((t, k))
    return kept
