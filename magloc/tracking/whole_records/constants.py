r"""Whether a track that counts its mounting, or the ambient field of its moduli, as exact has one that is not.

The record is fitted once more with their constant errors as unknowns c of unit prior variance. Were they zero, what is
found of them would be spread by :math:`P - P^2`, with their covariance P after all rows: a Wald test.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.special import chdtrc, ndtri

from arrays.array import SensorArray
from arrays.pose import PoseUncertainty
from arrays.typing import BoolArray, FloatArray
from magloc.chi_square import error_factor
from magloc.localization.uncertainty.range_interval import relative_range_sigma
from magloc.tracking.acquisition import START_RANGE_ERROR
from magloc.tracking.motion import N_SOURCE
from magloc.tracking.results import TrackPoint
from magloc.tracking.rows import Row
from magloc.tracking.tracker import Tracker
from magloc.tracking.whole_records.background import iterate_steps

_LEAST_KNOWN = 1e-6
"""A direction of the constants counts of which the rows tell a variance of more."""
_USUAL_AMBIENT_T = 300e-9
"""Of an ambient field that is called exact: crust and storms make it wrong by some 100 nT."""


class ConstantsTest(NamedTuple):
    """How far beyond zero constants are that count as exact, as standard normal numbers; NaN of what does not.

    Those of lever arm and mounting, and those of the ambient field of moduli; and how many times their standard
    deviations errors of the last row would be, rms, if it were as wrong as it may be.
    """

    mounting: float = math.nan
    field: float = math.nan
    field_factor: float = math.nan


def constants_test(tracker: Tracker, rows: Sequence[Row], points: Sequence[TrackPoint]) -> ConstantsTest:
    """The test of a track; of NaN where nothing counts as exact, or where the rows of the last track do not settle.

    Its first rows do not count, until the range is known: states from which nothing settles.
    """
    array = _with_constants(tracker.array)
    used = [] if array is tracker.array else placed_rows(points)
    if not used:
        return ConstantsTest()
    wider = Tracker(array, tracker.motion, background=tracker.background)
    rest = np.zeros(wider.motion.n_states - N_SOURCE + wider.n_errors)
    states = [np.concatenate([points[i].position_m, points[i].moment_Am2, rest]) for i, _ in used]
    steps = iterate_steps(wider, [rows[i] for i, _ in used], states)
    if steps is None:
        return ConstantsTest()
    errors, own = wider.pose_errors, tracker.pose_errors
    at = slice(wider.motion.n_states, wider.motion.n_states + errors.n_states)
    of_errors = steps[-1].x[at], steps[-1].S[at]
    mounting = math.nan if own.of_mounting.any() else _score(*of_errors, errors.of_mounting)
    if own.of_field.any() or not errors.of_field.any():
        return ConstantsTest(mounting)
    claimed, source, field = used[-1][1], steps[-1].S[:N_SOURCE], of_errors[1][errors.of_field]
    shift = source @ np.linalg.pinv(field)  # of the source by errors of unit variance that are taken for zero
    return ConstantsTest(mounting, _score(*of_errors, errors.of_field), float(error_factor(claimed, shift @ shift.T)))


def _with_constants(array: SensorArray) -> SensorArray:
    """The array where what counts as exact has its usual errors; itself where nothing does."""
    pose, usual = array.pose, PoseUncertainty()
    if pose is not None and not pose.position_constant_m and not pose.attitude_constant_rad:
        constants = {key: getattr(usual, key) for key in ("position_constant_m", "attitude_constant_rad")}
        array = replace(array, pose=replace(pose, **constants))
    if array.channel_is_scalar.any() and not array.ambient_uncertainty_T:
        array = replace(array, ambient_uncertainty_T=_USUAL_AMBIENT_T)
    return array


def _score(x: FloatArray, S: FloatArray, which: BoolArray) -> float:
    """Of some states of unit prior variance, found with a covariance S Sᵀ; NaN where the rows tell nothing of them."""
    found, root = x[which], S[which]
    left, axes = np.linalg.eigh(root @ root.T)
    spread = left * (1.0 - left)
    told = spread > _LEAST_KNOWN
    if not told.any():
        return math.nan
    square = float(np.sum((axes.T @ found)[told] ** 2 / spread[told]))
    return float(min(-ndtri(max(chdtrc(int(told.sum()), square), 1e-300)), 37.0))


def placed_rows(points: Sequence[TrackPoint]) -> list[tuple[int, FloatArray]]:
    """Rows of the last track that know the range so well that P (6, 6) is Cartesian, and P."""
    known = [i for i, point in enumerate(points) if point.is_on_track]
    begin = max((i for i in known if points[i].status == "acquired" or i == known[0]), default=0)
    return [(i, P) for i in known if i >= begin and (P := _placed_covariance(points[i])) is not None]


def _placed_covariance(point: TrackPoint) -> FloatArray | None:
    """Of a source whose range is known so well that it is Gaussian in Cartesian coordinates, None of another."""
    if point.covariance is None or point.position_m is None or point.centroid_m is None:
        return None
    error = relative_range_sigma(point.covariance, point.position_m - point.centroid_m)
    return point.covariance if error <= START_RANGE_ERROR else None
