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
from magloc.localization.fit.linearisation_compiled import LANES
from magloc.localization.fit.variable_projection_compiled import OPTIMUM_TOLERANCE, Refined, refine, same_optimum
from magloc.measurement.whitened_compiled import LaneModel

# Gauss-Newton gain in χ² at which a start is so near an optimum that others are known to lead to the same.
_NEAR_TOLERANCE = 1e-2
# Times the linearisations that one of these may take from there on: along a flat valley steps hardly get shorter.
_LONGER = 3.0


class Ends(NamedTuple):
    """Outputs of the search, (rows, starts, …): q, mu, χ², linearisations; counts (rows, 3).

    These are the optima kept, the starts that did not converge, and all linearisations.
    """

    q: FloatArray
    mu: FloatArray
    chi2: FloatArray
    iterations: NDArray[np.int64]
    counts: NDArray[np.int64]

    @classmethod
    def empty(cls, n_rows: int, n_starts: int) -> Ends:
        """Places for them, NaN so far."""
        shape = (n_rows, n_starts)
        return cls(
            np.full((*shape, 4), np.nan),
            np.full((*shape, 3), np.nan),
            np.full(shape, np.nan),
            np.zeros(shape, dtype=np.int64),
            np.zeros((n_rows, 3), dtype=np.int64),
        )


@compiled
def choose_rows(
    begin: int,
    end: int,
    components: NDArray[np.float32],
    candidates: NDArray[np.float32],
    cos_apart: float,
    chosen: IntArray,
) -> None:
    """Candidates (n, 4) that explain most of rows begin to end, some angle apart; the best again if none is left.

    Components (rows, 3, n) are those of the readings along the candidates' bases. Candidates are lanes, four of a lane
    are compared before the best so far is: a processor waits for that from one comparison to the next.
    """
    n, apart = len(candidates), np.float32(cos_apart)
    n_fours = -(-n // (4 * LANES))
    fours = np.zeros((n_fours, 4, 4 * LANES), np.float32)
    for j in range(n):
        for d in range(4):
            fours[j // (4 * LANES), d, j % (4 * LANES)] = candidates[j, d]
    q = fours.reshape(n_fours, 16 * LANES)
    score = np.full(n_fours * 4 * LANES, np.float32(-1.0))
    scores_of_four = score.reshape(n_fours, 4 * LANES)
    w = np.empty(2 * LANES, np.float32)  # best score of a lane, and its place
    last = np.empty(4, np.float32)
    for row in range(begin, end):
        x, y, z = components[row, 0], components[row, 1], components[row, 2]
        for j in range(n):
            score[j] = x[j] * x[j] + y[j] * y[j] + z[j] * z[j]
        last[:] = 0.0
        for k in range(chosen.shape[1]):
            w[:] = 0.0
            of_last = (last[0], last[1], last[2], last[3])
            for j in range(n_fours):
                c, s, place = q[j], scores_of_four[j], np.float32(4 * LANES * j)
                for i in range(LANES):
                    v0, v1 = _left(c, i, of_last, apart, s), _left(c, LANES + i, of_last, apart, s)
                    v2, v3 = _left(c, 2 * LANES + i, of_last, apart, s), _left(c, 3 * LANES + i, of_last, apart, s)
                    s[i], s[LANES + i], s[2 * LANES + i], s[3 * LANES + i] = v0, v1, v2, v3
                    p01, v01 = np.float32(LANES) if v1 > v0 else np.float32(0.0), v1 if v1 > v0 else v0
                    p23, v23 = np.float32(3 * LANES) if v3 > v2 else np.float32(2 * LANES), v3 if v3 > v2 else v2
                    which, value = p23 if v23 > v01 else p01, v23 if v23 > v01 else v01
                    better = value > w[i]
                    w[i] = value if better else w[i]
                    w[LANES + i] = place + which if better else w[LANES + i]
            best = 0
            for i in range(1, LANES):
                earlier = w[i] == w[best] and w[LANES + i] + i < w[LANES + best] + best
                best = i if w[i] > w[best] or earlier else best
            found = int(w[LANES + best]) + best
            chosen[row, k] = found if w[best] > 0.0 else chosen[row, 0] if k > 0 else 0
            for d in range(4):
                last[d] = candidates[chosen[row, k], d]


@inlined
def _left(
    c: NDArray[np.float32], at: int, q: tuple[float, float, float, float], cos_apart: Any, score: NDArray[np.float32]
) -> Any:
    """Score of a candidate, or less than any where it is near q."""
    t = c[at] * q[0] + c[4 * LANES + at] * q[1] + c[8 * LANES + at] * q[2] + c[12 * LANES + at] * q[3]
    return np.float32(-1.0) if abs(t) > cos_apart else score[at]


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
    out: Ends,
) -> None:
    """Distinct optima of rows begin to end, best first; for :func:`magloc.compilation.over_rows`.

    Starts (rows, k, 4) of a row are refined on the signal (readings, s, 3) of its reading.
    """
    n_starts = starts.shape[1]
    n = (end - begin) * n_starts
    reading = np.empty(n, np.intp)
    for k in range(n):
        reading[k] = reading_of_row[begin + k // n_starts]
    near = Refined(
        np.empty((n, 4)), np.empty((n, 3)), np.empty(n), np.empty(n, np.intp), np.empty(n, np.bool_)
    )  # fmt: skip
    of_block = starts[begin:end].reshape(n, 4)
    refine(signal, reading, of_block, model, 1.0, _NEAR_TOLERANCE, float(max_iterations), near)
    first_end, n = np.zeros(end - begin + 1, np.intp), 0
    for row in range(begin, end):
        first = (row - begin) * n_starts
        lowest = math.inf
        out.counts[row, 1] = out.counts[row, 2] = 0
        for k in range(first, first + n_starts):
            out.counts[row, 1] += 0 if near.converged[k] else 1
            out.counts[row, 2] += near.iterations[k]
            lowest = min(lowest, near.chi2[k] if near.converged[k] else math.inf)
        for k in range(first, first + n_starts):
            if not near.converged[k] or near.chi2[k] > lowest + keep_within + 1.0:
                continue
            known = False
            for j in range(first_end[row - begin], n):
                known = known or same_optimum(near.q[k], near.chi2[k], near.q[j], near.chi2[j])
            if not known:
                put(near.q[n], near.q[k])
                near.chi2[n], near.iterations[n] = near.chi2[k], near.iterations[k]
                reading[n] = reading_of_row[row]
                n += 1
        first_end[row - begin + 1] = n
    ends = Refined(
        np.empty((n, 4)), np.empty((n, 3)), np.empty(n), np.empty(n, np.intp), np.empty(n, np.bool_)
    )  # fmt: skip
    refine(signal, reading[:n], near.q[:n], model, 1.0, OPTIMUM_TOLERANCE, _LONGER * max_iterations, ends)
    for row in range(begin, end):
        first, last = first_end[row - begin], first_end[row - begin + 1]
        for k in range(first, last):
            out.counts[row, 1] += 0 if ends.converged[k] else 1
            out.counts[row, 2] += ends.iterations[k]
            ends.iterations[k] += near.iterations[k]
        _distinct(ends, first, last, keep_within, row, out)


@internal
def _distinct(refined: Refined, first: int, last: int, keep_within: float, row: int, out: Ends) -> None:
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
            known = known or same_optimum(refined.q[best], refined.chi2[best], out.q[row, j], out.chi2[row, j])
        if not known:
            put(out.q[row, kept], refined.q[best])
            put(out.mu[row, kept], refined.mu[best])
            out.chi2[row, kept], out.iterations[row, kept] = refined.chi2[best], refined.iterations[best]
            kept += 1
    out.counts[row, 0] = kept
