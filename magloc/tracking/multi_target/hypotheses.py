"""Hypotheses of what has happened to several sources: kept, narrowed where readings bend, fitted anew, and told.

A Gaussian that is too wide for readings that bend is split into three narrower ones, which rows then weigh; and while a
hypothesis is young, all of its rows are linearised together now and then (:mod:`.smoothing`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from arrays.typing import FloatArray
from magloc.tracking import row_filter
from magloc.tracking.multi_target.measurement import JointRow
from magloc.tracking.multi_target.smoothing import MOST_ROWS, YoungTrack
from magloc.tracking.multi_target.state import JointState
from magloc.tracking.sensor_health import SensorHealth

LARGEST_BEND = 0.5
"""By how many standard deviations of noise the readings may bend within one of the state."""
STRAIGHT = 2.0
"""By how many they may bend within one of the optimum of all rows of a young track together."""
REFITS = (3, 5, 8, 12, 18, 27, 40, 60, MOST_ROWS)
"""Rows since the last birth after which they are fitted together; behind the last of them a track is old."""
MERGED_GAP = 1.0 / 3.0
"""Standard deviation of a gap over the gap above which two sources are merged."""
# By how much all rows together may be less likely than one after the other were, as -2 ln.
_WORSE = 10.0
# Squared distance, in units of its covariance, below which two places may be of one source.
_ANOTHER_SIGMA2 = 25.0
# Farther than any two sources are apart.
_BEYOND_M = 1e6


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """One history of births, deaths and faults, and the state after it.

    Attributes
    ----------
    state : JointState
    ids : tuple of int
        Of the sources, by the rows in which they were born.
    health : SensorHealth
    score : float
        -2 ln of how likely it is, up to a constant.
    excess : ndarray, shape (2,)
        Mean excess of χ² over some last rows, and over more of them.
    judged : int
        Rows in which a restart is still judged, the last one counted; 0: it is believed.
    young : YoungTrack, optional
        The rows since its last birth, while they are fitted together now and then, and later the last ones.
    """

    state: JointState
    ids: tuple[int, ...]
    health: SensorHealth
    score: float = 0.0
    excess: FloatArray = field(default_factory=lambda: np.zeros(2))
    judged: int = 0
    young: YoungTrack | None = None

    def refitted(self, row: JointRow) -> Hypothesis:
        """The same with all of its young rows linearised together, if it is time to, and they have one optimum near.

        Where readings bend far within what is not known there, the optimum is no mean, and its curvature no variance.
        """
        young = self.young
        if young is None or not young.is_young or len(young.rows) not in REFITS:
            return self
        found = young.smoothed()
        if found is None or found.score > young.score + _WORSE or not is_straight(found.states[-1], row):
            return self
        return replace(self, state=found.states[-1], young=found, score=self.score + found.score - young.score)

    def narrowed(self, share: float, state: JointState) -> Hypothesis:
        """A part of it, of some weight."""
        if share == 1.0:
            return self
        young = self.young and replace(self.young, states=(*self.young.states[:-1], state))
        return replace(self, state=state, young=young, score=self.score - 2.0 * math.log(share))


def split(state: JointState, row: JointRow) -> list[tuple[float, JointState]]:
    """Return weights and parts of a state, along the axis of its covariance on which a row's readings bend most.

    Of a standard normal density, two parts of weight 1/4 at ±1 and one of 1/2 at 0, all of variance 1/2, keep mean and
    variance. A state along none of whose axes they bend is its own only part.
    """
    bends, directions = _bends(state, row)
    if not bends.size or not bends.max() > LARGEST_BEND:
        return [(1.0, state)]
    along = directions[np.argmax(bends)]
    return [(share, state.narrowed(along, 0.5, offset)) for share, offset in ((0.5, 0.0), (0.25, 1.0), (0.25, -1.0))]


def is_straight(state: JointState, row: JointRow) -> bool:
    """Return whether a row's readings hardly bend within a state's covariance."""
    return bool(_bends(state, row)[0].max(initial=0.0) <= STRAIGHT)


def _bends(state: JointState, row: JointRow) -> tuple[FloatArray, FloatArray]:
    """Return the bends (3 K,) of a row's readings, and one standard deviation (3 K, n) along each axis."""
    bends, directions = row_filter.bends(state.gaussians, row.kernel_rows, 1.0)
    return bends[0], directions[0]


def by_score(hypothesis: Hypothesis) -> float:
    """The likeliest first."""
    return hypothesis.score


def mates(best: Hypothesis, other: Hypothesis) -> dict[int, int]:
    """Which source of another hypothesis each of the best one's is: that of its name, or else the nearest one."""
    if other.ids == best.ids:
        return {k: k for k in range(len(best.ids))}
    apart_m = np.linalg.norm(best.state.position_m[:, None] - other.state.position_m, axis=-1)
    apart_m[np.equal.outer(best.ids, other.ids)] = -_BEYOND_M
    return {int(k): int(j) for k, j in zip(*linear_sum_assignment(apart_m), strict=True)}


def moments(
    states: list[JointState], weights: FloatArray, sources: list[int | None]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Position, moment and covariance of a source in a mixture of states, of those that have it."""
    parts = [(w, one, k) for w, one, k in zip(weights, states, sources, strict=True) if k is not None]
    if len(parts) == 1:
        ((_, one, k),) = parts
        return one.position_m[k], one.moment_Am2[k], one.covariances[k]
    x = np.array([np.concatenate([one.position_m[k], one.moment_Am2[k]]) for _, one, k in parts])
    share = np.array([weight for weight, _, _ in parts])
    share /= share.sum()
    mean = share @ x
    covariance = sum(part * one.covariances[k] for part, (_, one, k) in zip(share, parts, strict=True))
    return mean[:3], mean[3:], covariance + (share[:, None] * (x - mean)).T @ (x - mean)


def old_names(restart: Hypothesis, before: Hypothesis) -> tuple[int, ...]:
    """Names of a restart's sources: those of the nearest ones before it, where they may be the same.

    One that was taken for somewhere else is another source to whoever followed it.
    """
    offset = restart.state.position_m[:, None] - before.state.position_m
    P, Q = (one.state.covariances[:, :3, :3] for one in (restart, before))
    apart = np.vecdot(offset, np.linalg.solve(P[:, None] + Q, offset[..., None])[..., 0])
    names = list(restart.ids)
    for new, old in zip(*linear_sum_assignment(np.linalg.norm(offset, axis=-1)), strict=True):
        if apart[new, old] < _ANOTHER_SIGMA2:
            names[new] = before.ids[old]
    return tuple(names)


def merged_pairs(state: JointState) -> list[tuple[int, int]]:
    """Pairs of sources that are too near to each other for their gap to be known."""
    # A gap is no less certain than both places together.
    spread = np.sqrt(np.trace(state.covariances[:, :3, :3], axis1=1, axis2=2))
    apart_m = np.linalg.norm(state.position_m[:, None] - state.position_m, axis=-1)
    close = np.argwhere(np.triu(np.add.outer(spread, spread) > MERGED_GAP * apart_m, 1))
    pairs = []
    for first, second in close.tolist():
        distance, sigma = state.gap(first, second)
        if sigma > MERGED_GAP * distance:
            pairs.append((first, second))
    return pairs
