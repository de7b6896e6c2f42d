"""Compiled search for one dipole by variable projection.

The readable twin is :mod:`magloc.localization.search.single_source`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from arrays.typing import FloatArray
from magloc.compilation import compiled, runtime_int
from magloc.linalg_compiled import put, put_rows
from magloc.localization.fit.variable_projection_compiled import (
    CONVERGED,
    FAILED,
    OPTIMUM_TOLERANCE,
    refine,
    same_optimum,
)
from magloc.measurement.whitened_compiled import ModelRow, ModelRows, row_at


class Candidates(NamedTuple):
    """Candidates q (n, 4), their orthonormal whitened bases (c, 3 n) in single precision, least angle of two starts."""

    q: FloatArray
    bases: NDArray[np.float32]
    cos_apart: float


class Ends(NamedTuple):
    """Outputs of the search, (rows, starts, …): q, mu, χ², linearisations; counts (rows, 3).

    These are the optima kept, the starts that did not converge, and all linearisations.
    """

    q: FloatArray
    mu: FloatArray
    chi2: FloatArray
    iterations: NDArray[np.int64]
    counts: NDArray[np.int64]


@compiled
def _pick_starts(y: FloatArray, among: Candidates, starts: FloatArray) -> int:
    """Candidates that explain most of the energy of y, some angle apart on the sphere of homogeneous coordinates."""
    candidates, bases, cos_apart = among.q, among.bases, among.cos_apart
    n = candidates.shape[0]
    components = np.zeros(3 * n, np.float32)
    for c in range(y.size):
        t = np.float32(y[c])
        for i in range(3 * n):
            components[i] += t * bases[c, i]
    score = np.empty(n, np.float32)
    for i in range(n):
        score[i] = components[i] ** 2 + components[n + i] ** 2 + components[2 * n + i] ** 2
    for k in range(starts.shape[0]):
        best = 0
        for i in range(n):
            if score[i] > score[best]:
                best = i
        if score[best] < 0.0:
            return k
        put(starts[k], candidates[best])
        q0, q1, q2, q3 = starts[k]
        for i in range(n):
            t = candidates[i, 0] * q0 + candidates[i, 1] * q1 + candidates[i, 2] * q2 + candidates[i, 3] * q3
            if abs(t) > cos_apart:
                score[i] = -1.0
    return int(starts.shape[0])


@compiled
def _search_row(
    y: FloatArray,
    ranked: FloatArray,
    candidates: Candidates,
    first: FloatArray,
    keep_within: float,
    max_iterations: int,
    model: ModelRow,
    out: Ends,
    row: int,
) -> None:
    """Distinct optima of one row into its outputs, best first."""
    out_q, out_mu, out_chi2 = out.q[row], out.mu[row], out.chi2[row]
    out_iterations, counts = out.iterations[row], out.counts[row]
    n_starts, n_first = out_chi2.size, first.shape[0]
    starts = np.empty((n_starts, 4))
    moments = np.empty((n_starts, 3))
    chi2 = np.empty(n_starts)
    iterations = np.empty(n_starts, np.int64)
    put_rows(starts[:n_first], first)
    n = n_first + _pick_starts(ranked, candidates, starts[n_first:])
    found = runtime_int(0)
    counts[1] = counts[2] = 0
    for k in range(n):
        # The optima found so far fill the places of the starts that led to them.
        put(starts[found], starts[k])
        chi2[found], iterations[found], end = refine(
            starts[found], y, model, runtime_int(3), OPTIMUM_TOLERANCE, max_iterations,
            starts, chi2, found, moments[found],
        )  # fmt: skip
        counts[2] += iterations[found]
        if end == FAILED:
            counts[1] += 1
        elif end == CONVERGED:
            known = False
            for j in range(found):
                known = known or same_optimum(starts[found], chi2[found], starts[j], chi2[j])
            if not known:
                found += 1
    kept = 0
    best = math.inf
    while kept < found:
        k = 0
        for i in range(1, found):
            if chi2[i] < chi2[k]:
                k = i
        best = min(best, chi2[k])
        if chi2[k] > best + keep_within or chi2[k] == math.inf:
            break
        put(out_q[kept], starts[k])
        put(out_mu[kept], moments[k])
        out_chi2[kept], out_iterations[kept] = chi2[k], iterations[k]
        chi2[k] = math.inf
        kept += 1
    counts[0] = kept


@compiled
def search_rows(
    begin: int,
    end: int,
    y: FloatArray,
    ranked: FloatArray,
    reading_of_row: NDArray[np.intp],
    candidates: Candidates,
    first: FloatArray,
    keep_within: float,
    max_iterations: int,
    rows: ModelRows,
    out: Ends,
) -> None:
    """Distinct optima of rows begin to end, best first; for :func:`magloc.compilation.over_rows`.

    y (readings, c) are whitened readings, reading_of_row which of them a row has; ranked (readings, c) the same ones
    under the whitening of the candidates' bases, which ranks them as well; first (rows, f, 4) are starts of a row's
    own, refined before the best candidates.
    """
    for row in range(begin, end):
        r = reading_of_row[row]
        model = row_at(rows, row)
        _search_row(y[r], ranked[r], candidates, first[row], keep_within, max_iterations, model, out, row)
