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
from magloc.compilation import compiled, inlined
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

    Components (3, n, rows) are those of the readings along the candidates' bases. Rows are lanes. Four candidates are
    compared before the best so far is: a processor waits for that from one comparison to the next.
    """
    n, apart = len(candidates), np.float32(cos_apart)
    n_fours = -(-n // 4)
    fours = np.zeros((n_fours, 16), np.float32)  # coordinates of four candidates
    for j in range(n):
        for d in range(4):
            fours[j // 4, 4 * (j % 4) + d] = candidates[j, d]
    score = np.empty((4 * n_fours, LANES), np.float32)
    for j in range(n, 4 * n_fours):
        for i in range(LANES):
            score[j, i] = -1.0
    scores_of_four = score.reshape(n_fours, 4 * LANES)
    w = np.empty(6 * LANES, np.float32)  # coordinates of the last choice (4), best score, its candidate
    for block in range(begin, end, LANES):
        width = min(LANES, end - block)
        for j in range(n):
            x, y, z = components[0, j, block:], components[1, j, block:], components[2, j, block:]
            for i in range(width):
                score[j, i] = x[i] * x[i] + y[i] * y[i] + z[i] * z[i]
        w[: 4 * LANES] = 0.0
        for k in range(chosen.shape[1]):
            w[4 * LANES :] = 0.0
            for j in range(n_fours):
                s, place = scores_of_four[j], np.float32(4 * j)
                c0, c1, c2, c3 = _four(fours[j], 0), _four(fours[j], 4), _four(fours[j], 8), _four(fours[j], 12)
                for i in range(LANES):
                    q = (w[i], w[LANES + i], w[2 * LANES + i], w[3 * LANES + i])
                    v0, v1 = _left(c0, q, apart, s[i]), _left(c1, q, apart, s[LANES + i])
                    v2, v3 = _left(c2, q, apart, s[2 * LANES + i]), _left(c3, q, apart, s[3 * LANES + i])
                    s[i], s[LANES + i], s[2 * LANES + i], s[3 * LANES + i] = v0, v1, v2, v3
                    p01, v01 = np.float32(1.0) if v1 > v0 else np.float32(0.0), v1 if v1 > v0 else v0
                    p23, v23 = np.float32(3.0) if v3 > v2 else np.float32(2.0), v3 if v3 > v2 else v2
                    which, value = p23 if v23 > v01 else p01, v23 if v23 > v01 else v01
                    better = value > w[4 * LANES + i]
                    w[4 * LANES + i] = value if better else w[4 * LANES + i]
                    w[5 * LANES + i] = place + which if better else w[5 * LANES + i]
            for i in range(width):
                of_row = chosen[block + i]
                of_row[k] = int(w[5 * LANES + i]) if w[4 * LANES + i] > 0.0 else of_row[0] if k > 0 else 0
                for d in range(4):
                    w[d * LANES + i] = candidates[of_row[k], d]


@inlined
def _four(of_four: NDArray[np.float32], at: int) -> tuple[float, float, float, float]:
    return of_four[at], of_four[at + 1], of_four[at + 2], of_four[at + 3]


@inlined
def _left(
    candidate: tuple[float, float, float, float], q: tuple[float, float, float, float], cos_apart: Any, score: float
) -> Any:
    """Score of a candidate, or less than any where it is near q."""
    t = candidate[0] * q[0] + candidate[1] * q[1] + candidate[2] * q[2] + candidate[3] * q[3]
    return np.float32(-1.0) if abs(t) > cos_apart else score


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


@compiled
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
