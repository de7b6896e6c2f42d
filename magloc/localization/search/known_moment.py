"""Starts for a known moment: best candidates, with moments by the secular equation."""

from __future__ import annotations

import numpy as np

from arrays.typing import FloatArray
from magloc.localization.search.candidates import distinct_best, rows_of_equal_gain
from magloc.measurement.known_moment import KnownMoment
from magloc.measurement.whitened import WhitenedModel

# Relative σ of the modulus by the pitch of the grid: at a candidate beside the source another moment fits best.
_PITCH = 0.3


def starts_of_known_moment(
    problem: WhitenedModel,
    known: KnownMoment,
    residual: FloatArray,
    candidates: FloatArray,
    n_starts: int,
    apart_rad: float,
) -> tuple[FloatArray, FloatArray]:
    """Return starts q (b, 2 n, 4) and μ (b, 2 n, 3) of one source for whitened readings (b, C) above the ambient field.

    Every candidate has two moments: the best one, and its mirror image across the axis about which the readings have
    least information; it explains nearly as much. Channels are linearised about the ambient field.
    """
    gain = problem.linear_gain(np.zeros_like(problem.ambient))
    wide = known.widen(_PITCH)
    unit = problem.moment(candidates, np.ones((len(candidates), 3)))[:, 0]
    q, mu = np.empty((len(residual), n_starts, 4)), np.empty((len(residual), 2 * n_starts, 3))
    for rows in rows_of_equal_gain(gain):
        at = problem.rows(np.full(len(candidates), rows[0]))
        jacobian = at.moment_jacobian(candidates[:, None], np.broadcast_to(gain[rows[0]], at.gain.shape))
        information = jacobian.transpose(0, 2, 1) @ jacobian
        pull = np.einsum("ncj,bc->bnj", jacobian, residual[rows], optimize=True)
        best = wide.best_moments(information, pull, unit)
        cost = np.einsum("bni,nij,bnj->bn", best, information, best, optimize=True) - 2.0 * np.sum(best * pull, axis=-1)
        cost += np.sum(wide.residual((best * unit[:, None])[:, :, None]) ** 2, axis=-1)
        chosen = distinct_best(cost.max(axis=1, keepdims=True) - cost, candidates, n_starts, apart_rad)
        q[rows] = candidates[chosen]
        moments = np.take_along_axis(best, chosen[..., None], axis=1)
        least = np.linalg.eigh(information)[1][..., 0][chosen]
        mirrored = moments - 2.0 * np.sum(moments * least, axis=-1, keepdims=True) * least
        mu[rows] = np.concatenate([moments, mirrored], axis=1)
    return np.concatenate([q, q], axis=1), mu
