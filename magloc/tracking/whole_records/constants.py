r"""Whether a track that counts its mounting as exact has a mounting that is not.

The record is fitted once more with constant errors of the pose as unknowns c of unit prior variance. Were they zero,
what is found of them would be spread by :math:`P - P^2`, with their covariance P after all rows: a Wald test.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.special import chdtrc, ndtri

from arrays.pose import PoseUncertainty
from magloc.localization.uncertainty.range_interval import relative_range_sigma
from magloc.tracking.acquisition import START_RANGE_ERROR
from magloc.tracking.motion import N_SOURCE
from magloc.tracking.results import Row, TrackPoint
from magloc.tracking.tracker import Tracker
from magloc.tracking.whole_records.background import settled_steps

_LEAST_KNOWN = 1e-6
"""A direction of the constants counts of which the rows tell a variance of more."""


def constants_score(tracker: Tracker, rows: Sequence[Row], points: Sequence[TrackPoint]) -> float:
    """How far beyond zero a lever arm and a mounting are that count as exact, as a standard normal number.

    NaN where they do not, or where the rows of the last track do not settle. Its first rows do not count, until the
    range is known: states from which nothing settles.
    """
    stated = tracker.array.pose
    if stated is None or stated.position_constant_m or stated.attitude_constant_rad:
        return math.nan
    usual = PoseUncertainty()
    constants = {key: getattr(usual, key) for key in ("position_constant_m", "attitude_constant_rad")}
    wider = Tracker(replace(tracker.array, pose=replace(stated, **constants)), tracker.motion)
    known = [i for i, point in enumerate(points) if point.is_on_track]
    if not known:
        return math.nan
    begin = max(i for i in known if points[i].status == "acquired" or i == known[0])
    rest = np.zeros(wider.motion.n_states - N_SOURCE + wider.n_errors)
    used = [(rows[i], points[i]) for i in known if i >= begin and _is_placed(points[i])]
    if not used:
        return math.nan
    states = [np.concatenate([point.position_m, point.moment_Am2, rest]) for _, point in used]
    steps = settled_steps(wider, [row for row, _ in used], states)
    if steps is None:
        return math.nan
    errors = wider.pose_errors
    is_constant = np.concatenate([np.zeros(rest.size + N_SOURCE - errors.n_states, dtype=bool), errors.of_mounting])
    found, root = steps[-1].x[is_constant], steps[-1].S[is_constant]
    left, axes = np.linalg.eigh(root @ root.T)
    spread = left * (1.0 - left)
    told = spread > _LEAST_KNOWN
    if not told.any():
        return math.nan
    square = float(np.sum((axes.T @ found)[told] ** 2 / spread[told]))
    return float(min(-ndtri(max(chdtrc(int(told.sum()), square), 1e-300)), 37.0))


def _is_placed(point: TrackPoint) -> bool:
    """Whether the range is known so well that the source is Gaussian in Cartesian coordinates."""
    if point.covariance is None or point.position_m is None or point.centroid_m is None:
        return False
    return bool(relative_range_sigma(point.covariance, point.position_m - point.centroid_m) <= START_RANGE_ERROR)
