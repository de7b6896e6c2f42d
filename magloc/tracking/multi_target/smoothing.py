"""All rows of a young joint track together, linearised where they are after all.

A filter linearises every row where its prediction stood, and while little is known that is far from where the sources
are: it becomes too sure of itself. Gauss and Newton's iteration over all rows since the last birth is a filter and a
smoother along the last trajectory, until that stays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from arrays.typing import FloatArray
from magloc import core
from magloc.tracking.multi_target.measurement import JointRow, rows_problem
from magloc.tracking.multi_target.motion import stepped
from magloc.tracking.multi_target.state import N_OF_SOURCE, JointState

MOST_ROWS = 90
"""Rows that are kept of a track."""
# Passes, and the change of the last state, in its standard deviations, below which the trajectory stays.
_MOST_PASSES = 12
_TOLERANCE = 0.1
# Longest step of ln |m| or of a moment's direction in a pass.
_LONGEST = 0.5


@dataclass(frozen=True, eq=False)
class YoungTrack:
    """Rows since the number of sources changed, or the last ones.

    Attributes
    ----------
    prior : JointState
        Before the first of them.
    rows : tuple of (JointRow, ndarray)
        And the motion's step that led to each.
    states : tuple of JointState
        After each of them, as far as it is known.
    score : float
        -2 ln of how likely the rows are, as successive updates have it, while it is young.
    is_young : bool
        Whether they are all rows since the number changed.
    """

    prior: JointState
    rows: tuple[tuple[JointRow, FloatArray], ...] = ()
    states: tuple[JointState, ...] = ()
    score: float = 0.0
    is_young: bool = True

    def after(self, row: JointRow, step: FloatArray, state: JointState, score: float) -> YoungTrack:
        """After one more row; where that are too many the older half is dropped."""
        if len(self.rows) == MOST_ROWS:
            n = MOST_ROWS // 2
            prior = stepped(self.states[n - 1], self.rows[n][1])
            return YoungTrack(prior, self.rows[n:], self.states[n:], is_young=False).after(row, step, state, score)
        return replace(self, rows=(*self.rows, (row, step)), states=(*self.states, state), score=self.score + score)

    def joined(self, prior: JointState) -> YoungTrack:
        """The same rows with the last sources of another prior all along, which rest there."""
        new = slice(self.prior.n_sources, None)
        means = prior.position_m[new], prior.moment_Am2[new]
        states = tuple(state.with_sources(*means, np.zeros((N_OF_SOURCE, N_OF_SOURCE))) for state in self.states)
        return YoungTrack(prior, self.rows, states)

    def smoothed(self) -> YoungTrack | None:
        """The same with all rows linearised along the trajectory that they lead to; None where there is no such."""
        track, rows = _stacked(self.states), [row for row, _ in self.rows]
        given = rows_problem(
            np.stack([row.z for row in rows]),
            np.stack([row.gain for row in rows]),
            np.stack([row.positions_m for row in rows]),
            rows[0].channel_sensor,
        )
        steps, n = np.stack([step for _, step in self.rows]), len(self.prior.P)
        offsets, last, likelihood = np.empty((len(rows), n)), np.empty((n, n)), np.empty(2)
        for _ in range(_MOST_PASSES):
            work = core.problem(
                "joint_smoothing",
                trajectory=track.problem,
                prior=self.prior.problem,
                rows=given,
                steps=steps,
                offsets=offsets,
                last=last,
                likelihood=likelihood,
            )
            core.run("joint_smooth", work, 1, block=1)
            if not (np.isfinite(likelihood[0]) and np.isfinite(offsets).all() and np.isfinite(last).all()):
                return None
            turns = offsets[:, : 6 * self.prior.n_sources].reshape(len(offsets), -1, 6)[:, :, 3:]
            share = min(1.0, _LONGEST / max(float(np.abs(turns).max(initial=0.0)), 1e-300))
            change = np.abs(share * offsets[-1]) / np.sqrt(np.diagonal(last))
            track = track.moved(share * offsets)
            if share == 1.0 and float(change.max(initial=0.0)) < _TOLERANCE:
                states = tuple(JointState(*means, last) for means in zip(*_means(track), strict=True))
                return replace(self, states=states, score=float(likelihood.sum()))
        return None


def _means(state: JointState) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the means of a state."""
    return state.position_m, state.moment_Am2, state.velocity_m_s, state.rate_rad_s, state.common_T


def _stacked(states: Sequence[JointState]) -> JointState:
    """A trajectory, with the covariance at its end."""
    parts = [np.stack(part) for part in zip(*(_means(state) for state in states), strict=True)]
    return JointState(parts[0], parts[1], parts[2], parts[3], parts[4], states[-1].P)
