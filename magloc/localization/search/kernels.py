"""Compiled kernels of the search for one source: bases, choice of starts, optima.

The readable references are :mod:`magloc.localization.search.candidates` and ``tests/variable_projection.py``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from arrays.typing import FloatArray, IntArray
from magloc import core
from magloc.localization.fit.refinement import rows_a_block
from magloc.measurement.channels import problem
from magloc.measurement.whitened import WhitenedModel

SAME_COSINE, SAME_CHI2 = 0.99995, 0.01
"""Limits of the kernel for equal optima: cosine of the angle between positions (0.01 rad), and difference of χ²."""
_ROWS_TO_CHOOSE_FOR = 512


class LocalOptima(NamedTuple):
    """Distinct optima of rows, best first: q (rows, starts, 4), mu (…, 3), χ², iterations.

    NaN and 0 fill unused places. Counts (rows, 3) are the kept optima, the starts that did not converge, and all
    linearisations.
    """

    q: FloatArray
    mu: FloatArray
    chi2: FloatArray
    iterations: NDArray[np.int64]
    counts: NDArray[np.int64]


def candidate_bases(
    model: WhitenedModel, gain: FloatArray, columns: FloatArray, candidates: FloatArray
) -> NDArray[np.float32]:
    """Return orthonormal readings (C, 3, n) of the unit moments at candidates q (n, 4).

    Channels are linear with gains (C, 3), and columns (C, c) are projected out.
    """
    bases = np.empty((len(gain), 3, len(candidates)), dtype=np.float32)
    work = core.problem(
        "candidate_positions",
        channels=problem(model, gain[None], columns[None]),
        n_candidates=len(candidates),
        candidates=np.ascontiguousarray(candidates),
        bases=bases,
    )
    core.run("candidate_bases", work, len(candidates), block=rows_a_block(len(gain)))
    return bases


def choose_candidates(
    components: NDArray[np.float32], candidates: FloatArray, cosine: float, n_chosen: int
) -> NDArray[np.intp]:
    """Return the candidates (rows, n_chosen) that explain most of each row, best first, and some angle apart.

    Components (rows, 3, n) are taken from the rows along the bases of the candidates (n, 4). If too few candidates are
    left, the first one is repeated.
    """
    chosen = np.empty((len(components), n_chosen), dtype=np.int64)
    work = core.problem(
        "candidate_choice",
        n_candidates=len(candidates),
        n_chosen=n_chosen,
        cosine=cosine,
        candidates=candidates,
        components=components,
        chosen=chosen,
    )
    core.run("choose_candidates", work, len(components), block=_ROWS_TO_CHOOSE_FOR)
    return chosen


def search_optima(
    model: WhitenedModel,
    signals: FloatArray,
    row: IntArray,
    starts: FloatArray,
    moments: FloatArray | None,
    keep_within: float,
    max_iterations: int,
) -> LocalOptima:
    """Return the distinct optima that starts lead to.

    Parameters
    ----------
    model : WhitenedModel
    signals : ndarray, shape (b, C + k)
        Readings from :func:`magloc.measurement.channels.signals_of`; moduli are relative to that of the ambient field.
    row : ndarray of int, shape (n,)
        Row of readings for each set of starts.
    starts : ndarray, shape (n, s, 4)
        Start positions.
    moments : ndarray, shape (n, s, 3), optional
        Scaled moments about which moduli are first linearised.
    keep_within : float
        Largest rise of χ² above the best optimum for optima that are kept.
    max_iterations : int
        Largest number of linearisations from a start to near an optimum; three times as many are allowed from there.

    Returns
    -------
    Ends
    """
    shape = starts.shape[:2]
    out = LocalOptima(
        np.empty((*shape, 4)),
        np.empty((*shape, 3)),
        np.empty(shape),
        np.empty(shape, np.int64),
        np.empty((shape[0], 3), np.int64),
    )
    work = core.problem(
        "search",
        channels=model.channels,
        n_starts=shape[1],
        max_iterations=max_iterations,
        keep_within=keep_within,
        signals=signals,
        row=row,
        starts=np.ascontiguousarray(starts),
        start_moments=None if moments is None else np.ascontiguousarray(moments),
        **out._asdict(),
    )
    core.run("search_optima", work, shape[0], block=rows_a_block(3 * signals.shape[1]))
    return out
