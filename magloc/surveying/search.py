"""Matched filter over a grid: places where one more source explains most of the residuals."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from arrays.typing import BoolArray, FloatArray, IntArray
from magloc import core
from magloc.surveying.fit.joint_fit import Sources, SurveyBackground, residual_of, with_free_sources
from magloc.surveying.fit.record import SurveyRecord
from magloc.surveying.fit.whitening import RecordWhitening
from magloc.terrain.surface import FLAT, Terrain

N_DISTANCES = 5
PITCH = 1.8
"""Distance of a source from the sensors over the pitch of the grid, which finds 91 % of its energy in the median."""
WINDOW = 4.0
"""Size of the window of rows, in distances from the sensors."""
_CHUNK = 6  # places along each side of a tile
_LEAST_SEEN, _TINY = 1e-3, 1e-30
# A peak starts a source if it has a share of the strongest one's χ². Near a stronger peak, whose skirt it may be, the
# share is larger; very near they are the same peak.
_LEAST_SHARE = 0.05
_SKIRT, _SKIRT_SHARE = 6.0, 0.6
_SAME = 1.5


@dataclass(frozen=True, eq=False)
class Candidates:
    """Grid places (m, 3), distances from the sensors, explained χ² and moments."""

    place_m: FloatArray
    distance_m: FloatArray
    chi2: FloatArray
    moment_Am2: FloatArray

    @classmethod
    def concatenate(cls, parts: Iterable[Candidates]) -> Candidates:
        """Return the candidates of several tiles together."""
        return cls(*map(np.concatenate, zip(*(vars(part).values() for part in parts), strict=True)))

    def without(self, which: BoolArray) -> Candidates:
        """Return candidates with χ² of zero at some places."""
        return replace(self, chi2=np.where(which, 0.0, self.chi2))


@dataclass(frozen=True, eq=False)
class SearchGrid:
    """Places under the sensors, in tiles of one distance each."""

    tiles: list[tuple[float, FloatArray]]

    @property
    def levels(self) -> dict[float, SearchGrid]:
        """Grids, one for each distance."""
        distances = dict.fromkeys(distance for distance, _ in self.tiles)
        return {at: SearchGrid([tile for tile in self.tiles if tile[0] == at]) for at in distances}

    def some(self, which: BoolArray) -> SearchGrid:
        """Return the grid of some tiles."""
        return SearchGrid([tile for tile, kept in zip(self.tiles, which, strict=True) if kept])

    def tiles_near(self, places_m: FloatArray) -> BoolArray:
        """Return which tiles use rows at some places (n, 3)."""
        return np.array([near(places_m, places, WINDOW * distance).any() for distance, places in self.tiles], np.bool_)

    @classmethod
    def below(cls, record: SurveyRecord, low_m: FloatArray, high_m: FloatArray) -> SearchGrid:
        """Return the grid of a box above a flattened ground, with distances in geometric steps."""
        height = record.height_m
        nearest, farthest = max(height - high_m[2], 0.3), height - low_m[2]
        distances = np.geomspace(nearest * 1.1, max(farthest, nearest * 1.2), N_DISTANCES)
        return cls.of(low_m, high_m, height, distances.tolist(), record.terrain)

    @classmethod
    def of(
        cls,
        low_m: FloatArray,
        high_m: FloatArray,
        height_m: float,
        distances_m: Sequence[float],
        terrain: Terrain = FLAT,
    ) -> SearchGrid:
        """Return the grid of a rectangle, or a line along an axis, at distances below a height above the ground."""
        tiles = []
        for distance in distances_m:
            pitch = distance / PITCH
            first = low_m[:2] + 0.5 * np.minimum(pitch, high_m[:2] - low_m[:2])
            x, y = (np.arange(first[a], high_m[a] + 0.5 * pitch, pitch) for a in range(2))
            for i in range(0, len(x), _CHUNK):
                for j in range(0, len(y), _CHUNK):
                    square = np.meshgrid(x[i : i + _CHUNK], y[j : j + _CHUNK], [height_m - distance], indexing="ij")
                    tiles.append((distance, terrain.drape(np.stack(square, axis=-1).reshape(-1, 3))))
        return cls(tiles)


def search(record: SurveyRecord, background: SurveyBackground, sources: Sources, grid: SearchGrid) -> list[Candidates]:
    """Return χ² and moment of one more source at every place of each tile.

    The sources so far are free to move.
    """
    white = background.white
    fields = sources.fields(record)
    directions = record.directions(fields)
    Q = with_free_sources(record, background, sources)
    residual = residual_of(record, background, fields)
    left = residual - Q @ (Q.T @ residual)
    Q = Q.astype(np.float32)  # rounding does not matter for projected-out columns

    def explain(tile: tuple[float, FloatArray]) -> Candidates:
        distance, places = tile
        used = groups_near(record, white, places, WINDOW * distance)
        moment, chi2 = likeliest_moments(*normal_equations(record, white, directions, places, used, Q, left))
        return Candidates(places, np.full(len(places), distance), chi2, moment)

    with ThreadPoolExecutor(core.threads()) as pool:
        return list(pool.map(explain, grid.tiles))


def likeliest_moments(alone: FloatArray, projected: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return moments (m, 3) from normal equations, and the χ² (m,) that they explain."""
    # If others nearly imitate a source, only rounding and the window's edge remain; they must not count.
    least = np.maximum(_LEAST_SEEN * np.trace(alone, axis1=1, axis2=2), _TINY)[:, None, None] * np.eye(3)
    moment = np.linalg.solve(projected + least, v[..., None])[..., 0]
    return moment, np.sum(v * moment, axis=1)


def normal_equations(
    record: SurveyRecord,
    white: RecordWhitening,
    directions: FloatArray,
    places: FloatArray,
    used: IntArray,
    Q: FloatArray,
    left: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return matrices (m, 3, 3), twice, and right sides (m, 3) for moments at places (m, 3).

    Some groups of rows take part.

    The first matrix contains the moments alone, the second has everything else projected out by Q; ``left`` is the
    residual.
    """
    A = white.of_moments(record, directions, places, used)
    of = white.entries(used)
    whole, lost = (X.reshape(-1, 3, len(places)).transpose(2, 1, 0) for X in (A, Q[of].T @ A.astype(Q.dtype)))
    alone = whole @ whole.mT
    return alone, alone - lost @ lost.mT, (A.T @ left[of]).reshape(3, -1).T


def peaks(found: Candidates, threshold: float) -> IntArray:
    """Return places to start sources from, strongest first, without the flanks of stronger peaks."""
    order = np.argsort(-found.chi2)
    kept: list[int] = []
    for i in order:
        if found.chi2[i] < max(threshold, _LEAST_SHARE * found.chi2[order[0]]):
            break
        if all(_stands_beside(found, int(i), other) for other in kept):
            kept.append(int(i))
    return np.array(kept, dtype=np.intp)


def _stands_beside(found: Candidates, i: int, stronger: int) -> bool:
    apart = math.dist(found.place_m[i, :2], found.place_m[stronger, :2])
    h = max(found.distance_m[i], found.distance_m[stronger])
    if apart < _SAME * h:
        return False
    return bool(apart > _SKIRT * h or found.chi2[i] > _SKIRT_SHARE * found.chi2[stronger])


def near(rows_m: FloatArray, places: FloatArray, window_m: float) -> BoolArray:
    """Return which rows at (n, 3) are within a distance of places (m, 3) on the map."""
    low, high = places[:, :2].min(axis=0) - window_m, places[:, :2].max(axis=0) + window_m
    return np.asarray(np.all((rows_m[:, :2] >= low) & (rows_m[:, :2] <= high), axis=1))


def groups_near(record: SurveyRecord, white: RecordWhitening, places: FloatArray, window_m: float) -> IntArray:
    """Return the groups of rows within a distance of places (m, 3) on the map."""
    return np.flatnonzero(near(record.middles_m[white.starts[:-1]], places, window_m))


def sources_at(found: Candidates, which: IntArray) -> Sources:
    """Return the sources of some candidates."""
    return Sources(found.place_m[which], found.moment_Am2[which])
