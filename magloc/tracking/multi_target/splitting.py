"""A Gaussian that is too wide for readings that bend is split into three narrower ones, which rows then weigh."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from magloc.tracking.multi_target.measurement import JointRow
from magloc.tracking.multi_target.state import JointState
from magloc.tracking.multi_target.update_compiled import fill_bends

LARGEST_BEND = 0.5
"""By how many standard deviations of noise the readings may bend within one of the state."""
# Widest axes that are looked along.
_AXES = 6


def split(state: JointState, row: JointRow) -> list[tuple[float, JointState]]:
    """Weights and parts of a state, along the axis of its covariance on which a row's readings bend most.

    Of a standard normal density, two parts of weight 1/4 at ±1 and one of 1/2 at 0, all of variance 1/2, keep mean and
    variance. A state along none of whose axes they bend is its own only part.
    """
    d = state.n_seen
    sigma = np.sqrt(np.diagonal(state.P)[:d])
    variance, axes = np.linalg.eigh(state.P[:d, :d] / np.outer(sigma, sigma))
    root = np.sqrt(np.maximum(variance[-_AXES:], 0.0))
    errors = np.ascontiguousarray((sigma[:, None] * axes[:, -_AXES:] * root).T)
    bends = np.empty(len(errors))
    fill_bends(state.means, row.parts, errors, bends)
    axis = int(np.argmax(bends))
    if not bends[axis] > LARGEST_BEND:
        return [(1.0, state)]
    # What the whole state does where its seen part goes along the axis by a standard deviation.
    step = state.P[:, :d] @ (axes[:, axis - len(errors)] / (sigma * root[axis]))
    P = state.P - 0.5 * np.outer(step, step)
    return [(0.5, replace(state, P=P)), (0.25, state.moved_with(step, P)), (0.25, state.moved_with(-step, P))]
