"""Compiled search for one dipole by variable projection: choice of starts, and of the optima that they end at.

The readable twin is :mod:`magloc.localization.search.single_source`, that of the choice
:func:`magloc.localization.search.candidates.distinct_best`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from arrays.typing import FloatArray, IntArray
from magloc.compilation import compiled
from magloc.linalg_compiled import put
from magloc.localization.fit.linearisation_compiled import LANES
from magloc.localization.fit.variable_projection_compiled import OPTIMUM_TOLERANCE, Refined, refine, same_optimum
from magloc.measurement.whitened_compiled import LaneModel


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

    Components (3, n, rows) are those of the readings along the candidates' bases. Rows are lanes.
    """
    n, apart = len(candidates), np.float32(cos_apart)
    score = np.empty((n, LANES), np.float32)
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
            for j in range(n):
                c0, c1, c2, c3 = candidates[j, 0], candidates[j, 1], candidates[j, 2], candidates[j, 3]
                s, place = score[j], np.float32(j)
                for i in range(LANES):
                    t = c0 * w[i] + c1 * w[LANES + i] + c2 * w[2 * LANES + i] + c3 * w[3 * LANES + i]
                    value = np.float32(-1.0) if abs(t) > apart else s[i]
                    s[i] = value
                    better = value > w[4 * LANES + i]
                    w[4 * LANES + i] = value if better else w[4 * LANES + i]
                    w[5 * LANES + i] = place if better else w[5 * LANES + i]
            for i in range(width):
                of_row = chosen[block + i]
                of_row[k] = int(w[5 * LANES + i]) if w[4 * LANES + i] > 0.0 else of_row[0] if k > 0 else 0
                for d in range(4):
                    w[d * LANES + i] = candidates[of_row[k], d]


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
    n_rows, n_starts = end - begin, starts.shape[1]
    n = n_rows * n_starts
    refined = Refined(
        np.empty((n, 4)), np.empty((n, 3)), np.empty(n), np.empty(n, np.intp), np.empty(n, np.bool_)
    )  # fmt: skip
    reading = np.repeat(reading_of_row[begin:end], n_starts)
    refine(
        signal, reading, starts[begin:end].reshape(n, 4), model, 1.0, OPTIMUM_TOLERANCE, max_iterations, refined
    )  # fmt: skip
    for row in range(begin, end):
        _distinct(refined, (row - begin) * n_starts, keep_within, row, out)


@compiled
def _distinct(refined: Refined, first: int, keep_within: float, row: int, out: Ends) -> None:
    """Optima of a row, best first, without those that are known already."""
    n_starts = out.chi2.shape[1]
    counts = out.counts[row]
    kept = 0
    counts[1] = counts[2] = 0
    for k in range(first, first + n_starts):
        counts[1] += 0 if refined.converged[k] else 1
        counts[2] += refined.iterations[k]
    while True:
        best = -1
        for k in range(first, first + n_starts):
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
    counts[0] = kept
