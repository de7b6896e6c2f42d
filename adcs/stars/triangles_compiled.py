"""Compiled look-up of an image's triangles in a catalogue's, and check of the attitudes that they state by its stars.

The readable twin is ``TriangleIndex.hypotheses`` in :mod:`adcs.stars.triangles`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from arrays.typing import BoolArray, FloatArray, IntArray
from magloc.compilation import compiled, internal

CELLS = 64
"""Of the sky's cube along each axis."""
RATIOS = 64
"""Cells of a ratio of two sides."""
KEPT = 8
"""Best hypotheses."""
_LEAST = 3  # stars that match: a triangle's own


class Triangles(NamedTuple):
    """Triangles of stars: corners ordered by the opposite side, shortest first."""

    corners: IntArray  # (T, 3)
    sides: FloatArray  # (T, 3): chords, ascending
    is_counter_clockwise: BoolArray  # (T,): seen from the centre of the sphere


class SkyCells(NamedTuple):
    """Stars of a catalogue by the cell of the cube [-1, 1]³ in which they are."""

    directions: FloatArray  # (n, 3): ordered by cell
    begins: IntArray  # (CELLS³ + 1,)


class Checks(NamedTuple):
    """What an attitude has to pass."""

    side: float  # chord within which sides agree
    scale: float  # relative error of the image's scale
    near: float  # chord within which a star of the image is one of the catalogue
    stars: int  # of the image, brightest first
    enough: int  # of these, with which a search ends
    most: int  # attitudes, with which it ends too


@internal
def cell_of(x: float) -> int:
    """Cell of a coordinate."""
    return min(max(int((x + 1.0) * (0.5 * CELLS)), 0), CELLS - 1)


@internal
def is_star_near(x: float, y: float, z: float, near: float, sky: SkyCells) -> bool:
    """Whether the catalogue has a star within a chord of a direction."""
    for i in range(cell_of(x - near), cell_of(x + near) + 1):
        for j in range(cell_of(y - near), cell_of(y + near) + 1):
            first = (i * CELLS + j) * CELLS
            begin = sky.begins[first + cell_of(z - near)]
            end = sky.begins[first + cell_of(z + near) + 1]
            for k in range(begin, end):
                dx, dy, dz = sky.directions[k, 0] - x, sky.directions[k, 1] - y, sky.directions[k, 2] - z
                if dx * dx + dy * dy + dz * dz < near * near:
                    return True
    return False


@internal
def triad(corners: FloatArray, axes: FloatArray) -> None:
    """Axes (3, 3), in rows, of a triangle of directions (3, 3): its longest side, its middle across that, the third."""
    along = total = 0.0
    for k in range(3):
        axes[0, k] = corners[1, k] - corners[0, k]
        axes[1, k] = corners[0, k] + corners[1, k] + corners[2, k]
        total += axes[0, k] * axes[0, k]
    for k in range(3):
        axes[0, k] /= math.sqrt(total)
        along += axes[0, k] * axes[1, k]
    total = 0.0
    for k in range(3):
        axes[1, k] -= along * axes[0, k]
        total += axes[1, k] * axes[1, k]
    for k in range(3):
        axes[1, k] /= math.sqrt(total)
    for k in range(3):
        one, two = (k + 1) % 3, (k + 2) % 3
        axes[2, k] = axes[0, one] * axes[1, two] - axes[0, two] * axes[1, one]


@internal
def turn_between(tangents: FloatArray, stars: IntArray, factor: float, there: FloatArray, R: FloatArray) -> None:
    """Rotation R (3, 3) of three stars of the image, whose scale is by a factor another one, to directions (3, 3)."""
    seen, mine, theirs = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for c in range(3):
        x, y = factor * tangents[stars[c], 0], factor * tangents[stars[c], 1]
        norm = 1.0 / math.sqrt(x * x + y * y + 1.0)
        seen[c, 0], seen[c, 1], seen[c, 2] = x * norm, y * norm, -norm
    triad(seen, mine)
    triad(there, theirs)
    for a in range(3):
        for b in range(3):
            R[a, b] = theirs[0, a] * mine[0, b] + theirs[1, a] * mine[1, b] + theirs[2, a] * mine[2, b]


@internal
def matched_stars(tangents: FloatArray, R: FloatArray, factor: float, sky: SkyCells, checks: Checks, least: int) -> int:
    """Stars of the image near to one of the catalogue; less than ``least`` as soon as it cannot be more."""
    matched = 0
    for i in range(checks.stars):
        x, y = factor * tangents[i, 0], factor * tangents[i, 1]
        norm = 1.0 / math.sqrt(x * x + y * y + 1.0)
        u = (R[0, 0] * x + R[0, 1] * y - R[0, 2]) * norm
        v = (R[1, 0] * x + R[1, 1] * y - R[1, 2]) * norm
        w = (R[2, 0] * x + R[2, 1] * y - R[2, 2]) * norm
        if is_star_near(u, v, w, checks.near, sky):
            matched += 1
        elif matched + checks.stars - i - 1 < least:
            break
    return matched


@internal
def first_not_shorter(known: Triangles, begin: int, end: int, length: float) -> int:
    """First of some triangles, in the order of their longest sides, of which that is not shorter."""
    while begin < end:
        middle = (begin + end) // 2
        if known.sides[middle, 2] < length:
            begin = middle + 1
        else:
            end = middle
    return begin


@compiled
def search(
    tangents: FloatArray,
    image: Triangles,
    begin: int,
    known: Triangles,
    cell_begins: IntArray,
    bright: FloatArray,
    sky: SkyCells,
    checks: Checks,
) -> tuple[int, int, IntArray, FloatArray, FloatArray]:
    """Best attitudes that triangles of the image state, from one of them on until one matches enough stars.

    ``tangents`` (f, 2): of the image's stars, brightest first. ``known``: triangles of the catalogue, by the cell of
    their two ratios and in it by the longest side. ``cell_begins`` (RATIOS² + 1,). ``bright`` (n, 3): directions of
    their corners. Returns the triangle after the last one that was looked up, how many agreed, and of the best
    attitudes the stars that match (KEPT,), ascending, 0 where there is none, rotations (KEPT, 3, 3) and scales relative
    to the image's (KEPT,).
    """
    matched = np.zeros(KEPT, dtype=np.intp)
    rotations, factors = np.zeros((KEPT, 3, 3)), np.ones(KEPT)
    there, R = np.empty((3, 3)), np.empty((3, 3))
    agreeing, i = 0, begin
    while i < len(image.corners) and matched[KEPT - 1] < checks.enough and agreeing < checks.most:
        longest = image.sides[i, 2]
        one, two = image.sides[i, 0] / longest, image.sides[i, 1] / longest
        gate = checks.side / longest
        most = longest * (1.0 + checks.scale) + checks.side
        rows = max(int((one - gate) * RATIOS), 0), min(int((one + gate) * RATIOS), RATIOS - 1)
        columns = max(int((two - gate) * RATIOS), 0), min(int((two + gate) * RATIOS), RATIOS - 1)
        for cell in range(rows[0] * RATIOS, (rows[1] + 1) * RATIOS):
            if not columns[0] <= cell % RATIOS <= columns[1]:
                continue
            end = cell_begins[cell + 1]
            least = longest * (1.0 - checks.scale) - checks.side
            k = first_not_shorter(known, cell_begins[cell], end, least) - 1
            while k + 1 < end and known.sides[k + 1, 2] <= most:
                k += 1
                first = known.sides[k, 0] / known.sides[k, 2] - one
                second = known.sides[k, 1] / known.sides[k, 2] - two
                turned = known.is_counter_clockwise[k] != image.is_counter_clockwise[i]
                if turned or first * first + second * second > gate * gate:
                    continue
                agreeing += 1
                factor = (known.sides[k, 0] + known.sides[k, 1] + known.sides[k, 2]) / image.sides[i].sum()
                factor = min(max(factor, 1.0 - checks.scale), 1.0 + checks.scale)
                for c in range(3):
                    for axis in range(3):
                        there[c, axis] = bright[known.corners[k, c], axis]
                turn_between(tangents, image.corners[i], factor, there, R)
                needed = max(matched[0], _LEAST) + 1
                count = matched_stars(tangents, R, factor, sky, checks, needed)
                if count < needed:
                    continue
                place = 0
                while place < KEPT - 1 and matched[place + 1] < count:
                    matched[place], factors[place] = matched[place + 1], factors[place + 1]
                    rotations[place] = rotations[place + 1]
                    place += 1
                matched[place], factors[place], rotations[place] = count, factor, R
        i += 1
    return i, agreeing, matched, rotations, factors
