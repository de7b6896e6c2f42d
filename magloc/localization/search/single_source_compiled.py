"""Compiled search for one dipole by variable projection: choice of starts, and of the optima that they end at.

The readable twin is :mod:`magloc.localization.search.single_source`, that of the choice
:func:`magloc.localization.search.candidates.distinct_best`.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from arrays.typing import FloatArray, IntArray
from magloc.compilation import compiled, inlined, internal
from magloc.linalg_compiled import put
from magloc.localization.fit.moduli_compiled import Moduli, refine_by_moduli
from magloc.localization.fit.variable_projection_compiled import (
    OPTIMUM_TOLERANCE,
    Refined,
    Rules,
    easy_first,
    part,
    refine,
    same_optimum,
)
from magloc.measurement.whitened_compiled import LaneModel

# Gauss-Newton gain in χ² at which a start is so near an optimum that others are known to lead to the same.
_NEAR_TOLERANCE = 1e-2
# Times the linearisations that one of these may take from there on: along a flat valley steps hardly get shorter.
_LONGER = 3.0
# Starts of a row that say how high χ² may be where the others lead.
_FIRST_STARTS = 3
# Candidates of which the best one is known.
_BLOCK = 64


class Ends(NamedTuple):
    """Outputs of the search, (rows, starts, …): q, mu, χ², linearisations; NaN and 0 where there are fewer optima.

    Counts (rows, 3) are the optima kept, the starts that did not converge, and all linearisations.
    """

    q: FloatArray
    mu: FloatArray
    chi2: FloatArray
    iterations: NDArray[np.int64]
    counts: NDArray[np.int64]

    @classmethod
    def empty(cls, n_rows: int, n_starts: int) -> Ends:
        """Places for them."""
        shape = (n_rows, n_starts)
        q, mu, chi2 = np.empty((*shape, 4)), np.empty((*shape, 3)), np.empty(shape)
        return cls(q, mu, chi2, np.empty(shape, dtype=np.int64), np.empty((n_rows, 3), dtype=np.int64))


@compiled
def choose_rows(
    begin: int,
    end: int,
    components: NDArray[np.float32],
    candidates: FloatArray,
    cos_apart: float,
    chosen: IntArray,
) -> None:
    """Candidates (n, 4) that explain most of rows begin to end, some angle apart; the best again if none is left.

    Components (rows, 3, n) are those of the readings along the candidates' bases. Candidates are taken one by one, the
    best first, and left where they are near one that is chosen already. A key has the score, whose bits as an integer
    are in order, and behind it how many candidates follow: the largest key of a block is the first of its best ones.
    """
    n, n_chosen = len(candidates), chosen.shape[1]
    n_blocks = -(-n // _BLOCK)
    score, key = np.empty(n, np.float32), np.full(n_blocks * _BLOCK, -1)
    bits, blocks, highest = score.view(np.int32), key.reshape(n_blocks, _BLOCK), np.empty(n_blocks, np.int64)
    for row in range(begin, end):
        x, y, z = components[row, 0], components[row, 1], components[row, 2]
        for j in range(n):
            explained = x[j] * x[j] + y[j] * y[j] + z[j] * z[j]
            score[j] = explained if explained > 0.0 else np.float32(-1.0)
        for j in range(n):
            key[j] = (np.int64(bits[j]) << 32) + (n - j)
        for b in range(n_blocks):
            highest[b] = _largest(blocks[b])
        n_found = 0
        while n_found < n_chosen:
            best = _largest(highest)
            if best <= 0:  # none is left
                chosen[row, n_found] = chosen[row, 0] if n_found else 0
                n_found += 1
                continue
            j = n - (best & 0xFFFFFFFF)
            key[j] = -1
            highest[j // _BLOCK] = _largest(blocks[j // _BLOCK])
            near = False
            for k in range(n_found):
                i = chosen[row, k]
                t = 0.0
                for d in range(4):
                    t += candidates[i, d] * candidates[j, d]
                near = near or abs(t) > cos_apart
            if not near:
                chosen[row, n_found] = j
                n_found += 1


@inlined
def _largest(values: IntArray) -> Any:
    largest = values[0]
    for i in range(1, len(values)):
        largest = max(largest, values[i])
    return largest


@compiled
def search_rows(
    begin: int,
    end: int,
    signal: FloatArray,
    reading_of_row: IntArray,
    starts: FloatArray,
    keep_within: float,
    max_iterations: int,
    model: LaneModel,
    moduli: Moduli | None,
    out: Ends,
) -> None:
    """Distinct optima of rows begin to end, best first; for :func:`magloc.compilation.over_rows`.

    Starts (rows, k, 4) of a row, or with moduli (rows, k, 7), are refined on the signal (readings, s, 3) of its
    reading. The first ones say above which χ² the others are given up.
    """
    n_rows, n_starts = end - begin, starts.shape[1]
    n_first, n, n_easy = min(_FIRST_STARTS, n_starts), n_rows * n_starts, 0
    place, reading = np.empty((n_rows, n_starts), np.intp), np.empty(n, np.intp)
    of_place, order = np.empty((n, starts.shape[2])), np.empty(n_rows, np.intp)
    if moduli is None:
        n_easy = easy_first(signal, reading_of_row[begin:end], model, order)
    else:
        for row in range(n_rows):
            order[row] = row
    for i in range(n_rows):
        row = order[i]
        for k in range(n_starts):
            j = i * n_first + k if k < n_first else n_rows * n_first + i * (n_starts - n_first) + k - n_first
            place[row, k], reading[j] = j, reading_of_row[begin + row]
            put(of_place[j], starts[begin + row, k])
    near, limit = _places(n), np.full(n, math.inf)
    first_ends, n_others = n_rows * n_first, n_starts - n_first
    edges = (0, n_easy * n_first, first_ends, first_ends + n_easy * n_others, n)
    for i in range(4):
        first, last = edges[i], edges[i + 1]
        rules = Rules(_NEAR_TOLERANCE, float(max_iterations), limit[first:last], True, i % 2 == 0)
        ends = part(near, first, last)
        if moduli is None:
            refine(signal, reading[first:last], of_place[first:last], model, 1.0, rules, ends)
        else:
            refine_by_moduli(signal, reading[first:last], of_place[first:last], model, moduli, 1.0, rules, ends)
        if i == 1:
            for row in range(n_rows):
                lowest = _lowest(near, place[row, :n_first])
                for j in place[row, n_first:]:
                    limit[j] = lowest + keep_within + 1.0
    distinct, count = np.empty((n, starts.shape[2])), 0
    chi2, iterations, first_end = np.empty(n), np.empty(n, np.intp), np.zeros(n_rows + 1, np.intp)
    for row in range(begin, end):
        lowest = _lowest(near, place[row - begin])
        out.counts[row, 1] = out.counts[row, 2] = 0
        for k in place[row - begin]:
            out.counts[row, 1] += 0 if near.converged[k] else 1
            out.counts[row, 2] += near.iterations[k]
            if not near.converged[k] or near.chi2[k] > lowest + keep_within + 1.0:
                continue
            known = False
            for j in range(first_end[row - begin], count):
                same = same_optimum(near.q[k], near.chi2[k], distinct[j], chi2[j])
                if moduli is not None:
                    same = same and _same_side(near.mu[k], distinct[j, 4:])
                known = known or same
            if not known:
                put(distinct[count], near.q[k])
                if moduli is not None:
                    put(distinct[count, 4:], near.mu[k])
                chi2[count], iterations[count] = near.chi2[k], near.iterations[k]
                reading[count] = reading_of_row[row]
                count += 1
        first_end[row - begin + 1] = count
    ends = _places(count)
    rules = Rules(OPTIMUM_TOLERANCE, _LONGER * max_iterations, np.full(count, math.inf), False, False)
    if moduli is None:
        refine(signal, reading[:count], distinct[:count], model, 1.0, rules, ends)
    else:
        refine_by_moduli(signal, reading[:count], distinct[:count], model, moduli, 1.0, rules, ends)
    for row in range(begin, end):
        first, last = first_end[row - begin], first_end[row - begin + 1]
        for k in range(first, last):
            out.counts[row, 1] += 0 if ends.converged[k] else 1
            out.counts[row, 2] += ends.iterations[k]
            ends.iterations[k] += iterations[k]
        _distinct(ends, first, last, keep_within, moduli, row, out)


@internal
def _places(n: int) -> Refined:
    return Refined(np.empty((n, 4)), np.empty((n, 3)), np.empty(n), np.empty(n, np.intp), np.empty(n, np.bool_))


@internal
def _lowest(near: Refined, places: IntArray) -> float:
    lowest = math.inf
    for j in places:
        lowest = min(lowest, near.chi2[j] if near.converged[j] else math.inf)
    return lowest


@internal
def _same_side(mu: FloatArray, other: FloatArray) -> bool:
    """Whether moments are not opposite: without an ambient field moduli do not tell these apart."""
    return mu[0] * other[0] + mu[1] * other[1] + mu[2] * other[2] > 0.0


@internal
def _distinct(
    refined: Refined, first: int, last: int, keep_within: float, moduli: Moduli | None, row: int, out: Ends
) -> None:
    """Optima of a row among ends first to last, best first, without those that are known already."""
    kept = 0
    while True:
        best = -1
        for k in range(first, last):
            if refined.converged[k] and (best < 0 or refined.chi2[k] < refined.chi2[best]):
                best = k
        if best < 0 or refined.chi2[best] > (out.chi2[row, 0] if kept else math.inf) + keep_within:
            break
        refined.converged[best] = False
        known = False
        for j in range(kept):
            same = same_optimum(refined.q[best], refined.chi2[best], out.q[row, j], out.chi2[row, j])
            if moduli is not None:
                same = same and _same_side(refined.mu[best], out.mu[row, j])
            known = known or same
        if not known:
            put(out.q[row, kept], refined.q[best])
            put(out.mu[row, kept], refined.mu[best])
            out.chi2[row, kept], out.iterations[row, kept] = refined.chi2[best], refined.iterations[best]
            kept += 1
    out.counts[row, 0] = kept
    out.q[row, kept:], out.mu[row, kept:], out.chi2[row, kept:] = math.nan, math.nan, math.nan
    out.iterations[row, kept:] = 0
