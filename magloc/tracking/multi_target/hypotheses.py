"""One hypothesis of births, deaths and faults: its state, score, sources' ids, and how two are compared.

:mod:`.explanations` finds the events that may have happened in a row; the tracker extends and prunes hypotheses.

A Gaussian over which readings are nonlinear is split into three narrower ones, which later rows weigh. All rows of a
young hypothesis are fitted together at growing intervals (:mod:`.smoothing`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from arrays.typing import FloatArray
from magloc.chi_square import normalised_square
from magloc.tracking import row_filter
from magloc.tracking.chart.mixture import mixture_moments
from magloc.tracking.multi_target.measurement import JointRow
from magloc.tracking.multi_target.smoothing import MOST_ROWS, YoungTrack
from magloc.tracking.multi_target.state import JointState
from magloc.tracking.row_filter import LARGEST_BEND
from magloc.tracking.sensor_health import SensorHealth

STRAIGHT = 2.0
"""Largest nonlinearity within one σ of a refit of all rows of a young track."""
REFITS = (3, 5, 8, 12, 18, 27, 40, 60, MOST_ROWS)
"""Numbers of rows since the last birth after which they are refitted; after the last one a track is old."""
MERGED_GAP = 1.0 / 3.0
"""Largest standard deviation of a distance between two sources over the distance; with more they are merged."""
# Largest increase of the score by a refit over that of successive updates.
_WORSE = 10.0
# Squared Mahalanobis distance below which two places may be of one source.
_ANOTHER_SIGMA2 = 25.0
# A distance larger than that of any two sources.
_BEYOND_M = 1e6


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """One history of births, deaths and faults, and the state after it.

    Attributes
    ----------
    state : JointState
    ids : tuple of int
        Ids of the sources, by the rows of their birth.
    health : SensorHealth
    score : float
        -2 ln of the posterior probability, up to a constant.
    excess : ndarray, shape (2,)
        Mean excess of χ² over recent rows, with a short and a long memory.
    probation : int
        Number of rows for which a restart is still on probation; 0 after it is accepted.
    young : YoungTrack, optional
        Rows since the last birth while the hypothesis is young, later the last rows.
    """

    state: JointState
    ids: tuple[int, ...]
    health: SensorHealth
    score: float = 0.0
    excess: FloatArray = field(default_factory=lambda: np.zeros(2))
    probation: int = 0
    young: YoungTrack | None = None

    def refit(self, row: JointRow) -> Hypothesis:
        """Refit all young rows together if due, and return the hypothesis.

        A refit is rejected if readings are strongly nonlinear over its covariance, because then the optimum is not the
        mean, and its curvature does not give the variance.
        """
        young = self.young
        if young is None or not young.is_young or len(young.rows) not in REFITS:
            return self
        found = young.smooth()
        if found is None or found.score > young.score + _WORSE or not is_straight(found.states[-1], row):
            return self
        return replace(self, state=found.states[-1], young=found, score=self.score + found.score - young.score)

    def take_part(self, share: float, state: JointState) -> Hypothesis:
        """Return the part of the hypothesis with another state, with a share of its weight."""
        if share == 1.0:
            return self
        young = self.young and replace(self.young, states=(*self.young.states[:-1], state))
        return replace(self, state=state, young=young, score=self.score - 2.0 * math.log(share))


def split(state: JointState, row: JointRow) -> list[tuple[float, JointState]]:
    """Split a state along the axis on which a row's readings are most nonlinear.

    Return weights and parts. For a standard normal density, parts at -1, 0 and 1 with the weights 1/4, 1/2 and 1/4 and
    the variance 1/2 have the same mean and variance. A state over which readings are nearly linear is not split.
    """
    bends, directions = _bends(state, row)
    if not bends.size or not bends.max() > LARGEST_BEND:
        return [(1.0, state)]
    along = directions[np.argmax(bends)]
    return [(share, state.narrow(along, 0.5, offset)) for share, offset in ((0.5, 0.0), (0.25, 1.0), (0.25, -1.0))]


def is_straight(state: JointState, row: JointRow) -> bool:
    """Return True if a row's readings are nearly linear within a state's covariance."""
    return bool(_bends(state, row)[0].max(initial=0.0) <= STRAIGHT)


def _bends(state: JointState, row: JointRow) -> tuple[FloatArray, FloatArray]:
    """Return the nonlinearity (6 K,) of a row's readings, and one σ (6 K, n) along each axis."""
    bends, directions = row_filter.bends(state.gaussians, row.kernel_rows, 1.0)
    return bends[0], directions[0]


def by_score(hypothesis: Hypothesis) -> float:
    """Return the score, as the sort key of the likeliest first."""
    return hypothesis.score


def match_sources(best: Hypothesis, other: Hypothesis) -> dict[int, int]:
    """Match the sources of two hypotheses by their ids, otherwise by distance."""
    if other.ids == best.ids:
        return {k: k for k in range(len(best.ids))}
    apart_m = np.linalg.norm(best.state.position_m[:, None] - other.state.position_m, axis=-1)
    apart_m[np.equal.outer(best.ids, other.ids)] = -_BEYOND_M
    return {int(k): int(j) for k, j in zip(*linear_sum_assignment(apart_m), strict=True)}


def moments_of_source(
    states: list[JointState], weights: FloatArray, sources: list[int | None]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return position, moment and covariance of a source in a mixture of states."""
    parts = [(w, one, k) for w, one, k in zip(weights, states, sources, strict=True) if k is not None]
    if len(parts) == 1:
        ((_, one, k),) = parts
        return one.position_m[k], one.moment_Am2[k], one.covariances[k]
    x = np.array([np.concatenate([one.position_m[k], one.moment_Am2[k]]) for _, one, k in parts])
    share = np.array([weight for weight, _, _ in parts])
    of_parts = np.stack([one.covariances[k] for _, one, k in parts])
    mean, covariance = mixture_moments(share / share.sum(), x, of_parts)
    return mean[:3], mean[3:], covariance


def inherit_ids(restart: Hypothesis, before: Hypothesis) -> tuple[int, ...]:
    """Return the ids of a restart's sources, from the nearest earlier ones that may be the same.

    A source at another place gets a new id.
    """
    offset = restart.state.position_m[:, None] - before.state.position_m
    P, Q = (one.state.covariances[:, :3, :3] for one in (restart, before))
    apart = normalised_square(offset, P[:, None] + Q)
    ids = list(restart.ids)
    for new, old in zip(*linear_sum_assignment(np.linalg.norm(offset, axis=-1)), strict=True):
        if apart[new, old] < _ANOTHER_SIGMA2:
            ids[new] = before.ids[old]
    return tuple(ids)


def merged_pairs(state: JointState) -> list[tuple[int, int]]:
    """Return the pairs of sources whose distance is uncertain."""
    # The sum of both position errors bounds the error of the distance, so that most pairs need no more.
    spread = np.sqrt(np.trace(state.covariances[:, :3, :3], axis1=1, axis2=2))
    apart_m = np.linalg.norm(state.position_m[:, None] - state.position_m, axis=-1)
    close = np.argwhere(np.triu(np.add.outer(spread, spread) > MERGED_GAP * apart_m, 1))
    pairs = []
    for first, second in close.tolist():
        distance, sigma = state.gap(first, second)
        if sigma > MERGED_GAP * distance:
            pairs.append((first, second))
    return pairs
