"""Compiled fits of dipoles from starts: damped Gauss-Newton, moments eliminated.

:func:`magloc.localization.fit.gauss_newton.damped_gauss_newton` is the readable reference.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from arrays.typing import BoolArray, FloatArray, IntArray
from magloc import core
from magloc.measurement.channels import signals_of
from magloc.measurement.whitened import WhitenedModel

MOST_SOURCES = 4
"""Largest number of sources that the kernels fit together."""
OPTIMUM_TOLERANCE = 1e-10
"""Predicted decrease of χ² below which one source is at an optimum: its position is then within 1e-5 σ of it."""
RELATIVE_TOLERANCE = 1e-14
_CHANNELS_A_BLOCK = 100_000


class Refinements(NamedTuple):
    """Results of n refinements of K sources.

    The items are q (n, K, 4), scaled moments (n, K, 3), χ² (n,), numbers of linearisations (n,), and which converged.
    Refinements that would not fall below a useful χ² are stopped early.
    """

    q: FloatArray
    mu: FloatArray
    chi2: FloatArray
    iterations: IntArray
    converged: NDArray[np.bool_]


def refine_starts(
    model: WhitenedModel,
    y: FloatArray,
    q: FloatArray,
    mu: FloatArray | None = None,
    *,
    free: BoolArray | None = None,
    max_iterations: int = 100,
    tolerance: float = OPTIMUM_TOLERANCE,
    relative_tolerance: float = RELATIVE_TOLERANCE,
    too_high: FloatArray | None = None,
) -> Refinements:
    """
    Refine one start for each row of whitened readings.

    Parameters
    ----------
    model : WhitenedModel
    y : ndarray, shape (b, C)
        Whitened readings; moduli are relative to that of the ambient field.
    q : ndarray, shape (b, K, 4)
        Start positions. K is at most :data:`MOST_SOURCES`, and 1 with moduli.
    mu : ndarray, shape (b, K, 3), optional
        Moments about which moduli are first linearised; zero by default.
    free : ndarray of bool, shape (K, 3), optional
        True where a source may move along each of its tangents: two change its direction, one its range. By default all
        are free.
    max_iterations : int
        Largest number of linearisations.
    tolerance, relative_tolerance : float
        Predicted decrease of χ² below which a state is an optimum, absolute and relative to χ².
    too_high : ndarray, shape (b,), optional
        χ² above which a fit is not useful.

    Returns
    -------
    Refined
    """
    n, n_sources = q.shape[:2]
    channels = model.channels
    out = Refinements(
        np.empty((n, n_sources, 4)), np.empty((n, n_sources, 3)), np.empty(n), np.empty(n, np.int64), np.empty(n, bool)
    )
    work = core.problem(
        "refinement",
        channels=channels,
        n_sources=n_sources,
        max_iterations=max_iterations,
        tolerance=tolerance,
        relative_tolerance=relative_tolerance,
        signals=signals_of(model, y),
        row=np.arange(n),
        start=np.ascontiguousarray(q),
        start_moment=None if mu is None else np.ascontiguousarray(mu),
        too_high=None if too_high is None else np.ascontiguousarray(too_high),
        free=None if free is None else np.ascontiguousarray(free).view(np.uint8),
        q=out.q,
        mu=out.mu,
        chi2=out.chi2,
        iterations=out.iterations,
        converged=out.converged.view(np.uint8),
    )
    core.run("refine", work, n, block=rows_a_block(n_sources * n_sources * channels.struct.n_channels))
    return out


def rows_a_block(n_channels: int) -> int:
    """Return how many rows of so many channels take a few milliseconds."""
    return 64 + _CHANNELS_A_BLOCK // n_channels
