"""Refit of all rows of a young joint track together.

A filter linearises each row at its prediction, which is far from the sources while they are uncertain, so that it
becomes overconfident. A Gauss-Newton iteration over all rows since the last birth is a filter and a smoother linearised
along the last trajectory, repeated until it converges.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from arrays.typing import FloatArray
from magloc.tracking import row_filter
from magloc.tracking.coordinates import Chart
from magloc.tracking.multi_target.measurement import JointRow, stack_joint_rows
from magloc.tracking.multi_target.motion import predict_state, steps_problem
from magloc.tracking.multi_target.state import N_COMMON, N_OF_SOURCE, N_SEEN, JointState, chart_at
from magloc.tracking.row_filter import Gaussians

MOST_ROWS = 90
"""Largest number of rows of a track."""
# Largest number of passes, and change of the last state, in its standard deviations, at convergence.
_MOST_PASSES = 20
_TOLERANCE = 0.05
# Passes after which a track is given up if its score exceeds the best one by the second number.
_LEAST_PASSES, _HOPELESS = 4, 60.0
# Largest step of the log-range, the direction, and the moment over its size in a pass.
_LONGEST = 0.5
# Least step length over that of Gauss-Newton.
_SHORTEST = 0.1


@dataclass(frozen=True, eq=False)
class YoungTrack:
    """Rows since the number of sources changed, or the last ones.

    Attributes
    ----------
    prior : JointState
        State before the first row.
    rows : tuple of (JointRow, ndarray)
        Rows, and the step of the motion to each.
    states : tuple of JointState
        Estimate after each row.
    score : float
        -2 ln of the likelihood of the rows by successive updates, while the track is young.
    is_young : bool
        Whether the rows are all since the number of sources changed.
    """

    prior: JointState
    rows: tuple[tuple[JointRow, FloatArray], ...] = ()
    states: tuple[JointState, ...] = ()
    score: float = 0.0
    is_young: bool = True

    def after(self, row: JointRow, step: FloatArray, state: JointState, score: float) -> YoungTrack:
        """Return the track after one more row; drop the older half if there are too many rows."""
        if len(self.rows) == MOST_ROWS:
            n = MOST_ROWS // 2
            first, to_first = self.rows[n]
            prior = predict_state(self.states[n - 1], to_first, first)
            return YoungTrack(prior, self.rows[n:], self.states[n:], is_young=False).after(row, step, state, score)
        return replace(self, rows=(*self.rows, (row, step)), states=(*self.states, state), score=self.score + score)

    def add_sources(self, prior: JointState) -> YoungTrack:
        """Return the track with further sources of another prior at rest in all rows."""
        new = slice(self.prior.n_sources, None)
        known = np.zeros((prior.n_sources - self.prior.n_sources, N_OF_SOURCE, N_OF_SOURCE))
        states = (state.with_sources(prior.position_m[new], prior.moment_Am2[new], known) for state in self.states)
        return YoungTrack(prior, self.rows, tuple(states))

    def smooth(self, most: int = _MOST_PASSES, limit: float = math.inf) -> YoungTrack | None:
        """Smooth with rows linearised along the smoothed trajectory; None without convergence.

        The iteration stops after `most` passes, and early if the score stays far above `limit`.
        """
        rows = stack_joint_rows([row for row, _ in self.rows])
        steps = steps_problem(np.stack([step for _, step in self.rows]))
        centroids = np.stack([row.centroid_m for row, _ in self.rows])
        track, best = np.stack([state.sources for state in self.states]), limit
        share, last = 1.0, np.zeros(track[-1].size)
        for passes in range(most):
            chart = chart_at(track, centroids[:, None], self.prior.radius_m)
            with np.errstate(all="ignore"):  # a trajectory may lead out of double precision
                prior = self._prior_about(chart.take(np.array(0)))
                found = row_filter.smooth(track.reshape(1, len(track), -1), prior, steps, rows)
            offsets, S = found.offsets.reshape(track.shape), found.last.S[0]
            if not (np.isfinite(found.log_evidence[0]) and np.isfinite(offsets).all() and np.isfinite(S).all()):
                return None
            score = -2.0 * float(found.log_evidence[0])
            best = min(best, score)
            if passes >= _LEAST_PASSES and score > best + _HOPELESS:
                return None
            sizes = np.abs(offsets[..., :N_SEEN])
            sizes[..., 3:] /= np.maximum(np.linalg.norm(track[..., 3:N_SEEN], axis=-1, keepdims=True), 1e-300)
            length = min(1.0, _LONGEST / max(float(sizes.max(initial=0.0)), 1e-300))
            before, last = last, offsets[-1].ravel() / np.linalg.norm(S[:-N_COMMON], axis=1)
            # Barzilai and Borwein's length: steps that lead back are made shorter.
            bent = float(before @ (before - last))
            share = min(max(share * float(before @ before) / bent, _SHORTEST), 1.0) if bent > 0.0 else 1.0
            track = chart.retract(share * length * offsets)
            if float(np.abs(last).max(initial=0.0)) < _TOLERANCE:
                return replace(self, states=self._states(track, found.last), score=score)
        return None

    def _prior_about(self, chart: Chart) -> Gaussians:
        """Return the prior as offsets from states (K, 12), in the charts about these."""
        e = self.prior.chart.coordinates(chart.x)
        turn = chart.inverse_jacobian() @ self.prior.chart.linearise(e)[1]
        n, S = e.size, self.prior.S.copy()
        S[:n] = (turn @ S[:n].reshape(*e.shape, len(S))).reshape(n, len(S))
        offset = np.concatenate([-(turn @ e[..., None]).ravel(), self.prior.common_T])
        return replace(self.prior.gaussians, x=offset[None], S=S[None])

    def _states(self, track: FloatArray, last: Gaussians) -> tuple[JointState, ...]:
        """Return the states of a trajectory (m, K, 12), with common field and covariance of its end."""
        common_T = last.x[0, -N_COMMON:]
        return tuple(
            replace(state, x=np.concatenate([sources.ravel(), common_T]), S=last.S[0])
            for state, sources in zip(self.states, track, strict=True)
        )
