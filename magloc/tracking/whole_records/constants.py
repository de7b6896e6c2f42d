r"""Test of a mounting, or of the ambient field of moduli, that counts as exact.

The record is fitted again with their constant errors as unknowns c of unit prior variance. If the true errors are zero,
the estimate has the covariance :math:`P - P^2`, with the posterior covariance P: a Wald test.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
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
"""Least variance of the estimate in a direction of the constants that is used."""
_USUAL_AMBIENT_T = 300e-9
"""Usual error of an ambient field that counts as exact: crust and storms cause some 100 nT."""


class ConstantsTest(NamedTuple):
    """Standard normal statistics of constants that count as exact; NaN for others.

    Attributes
    ----------
    mounting : float
        Statistic of lever arm and mounting.
    field : float
        Statistic of the ambient field of moduli.
    field_factor : float
        Ratio of the rms error of the last row to its standard deviation, for the usual error of that field.
    """

    mounting: float = math.nan
    field: float = math.nan
    field_factor: float = math.nan


def constants_test(tracker: Tracker, rows: Sequence[Row], points: Sequence[TrackPoint]) -> ConstantsTest:
    """Return the test of a track, NaN if nothing counts as exact or without convergence.

    Rows of the last track before the range is known are not used, because the fit would not converge.
    """
    array = _with_constants(tracker.array)
    used = [] if array is tracker.array else placed_rows(points)
    if not used:
        return ConstantsTest()
    wider = Tracker(array, tracker.motion, background=tracker.background)
    rest = np.zeros(wider.motion.n_states - N_SOURCE + wider.n_errors)
    states = [np.concatenate([row.source, rest]) for row in used]
    steps = iterate_steps(wider, [rows[row.index] for row in used], states)
    if steps is None:
        return ConstantsTest()
    errors, own = wider.pose_errors, tracker.pose_errors
    at = slice(wider.motion.n_states, wider.motion.n_states + errors.n_states)
    of_errors = steps[-1].x[at], steps[-1].S[at]
    mounting = math.nan if own.is_of_mounting.any() else _score(*of_errors, errors.is_of_mounting)
    if own.is_of_field.any() or not errors.is_of_field.any():
        return ConstantsTest(mounting)
    factor = neglected_error_factor(used[-1].covariance, steps[-1].S, of_errors[1][errors.is_of_field])
    return ConstantsTest(mounting, _score(*of_errors, errors.is_of_field), factor)


def _with_constants(array: SensorArray) -> SensorArray:
    """Return the array with usual errors for all that counts as exact; unchanged if there is nothing."""
    pose, usual = array.pose, PoseUncertainty()
    if pose is not None and not pose.position_constant_m and not pose.attitude_constant_rad:
        constants = {key: getattr(usual, key) for key in ("position_constant_m", "attitude_constant_rad")}
        array = replace(array, pose=replace(pose, **constants))
    if array.channel_is_scalar.any() and not array.ambient_uncertainty_T:
        array = replace(array, ambient_uncertainty_T=_USUAL_AMBIENT_T)
    return array


def _score(x: FloatArray, S: FloatArray, which: BoolArray) -> float:
    """Return the Wald statistic of states of unit prior variance, NaN if undetermined.

    The states have the estimate x and the posterior covariance S Sᵀ.
    """
    estimate, root = x[which], S[which]
    posterior, axes = np.linalg.eigh(root @ root.T)
    variance = posterior * (1.0 - posterior)
    known = variance > _LEAST_KNOWN
    if not known.any():
        return math.nan
    square = float(np.sum((axes.T @ estimate)[known] ** 2 / variance[known]))
    return float(min(-ndtri(max(chdtrc(int(known.sum()), square), 1e-300)), 37.0))


def neglected_error_factor(claimed: FloatArray, S: FloatArray, errors: FloatArray) -> float:
    """Return the ratio of the rms error of a source to its standard deviation, if errors count as zero.

    The source has the covariance `claimed` (6, 6) then. With errors of unit variance as states, S (n, n) is the root of
    the covariance of all states, and `errors` (k, n) are its rows of these errors.
    """
    shift = S[:N_SOURCE] @ np.linalg.pinv(errors)
    return float(error_factor(claimed, shift @ shift.T))


@dataclass(frozen=True, eq=False)
class PlacedRow:
    """Index of a row whose source is a Cartesian Gaussian, with mean (6,) and covariance (6, 6)."""

    index: int
    source: FloatArray
    covariance: FloatArray


def placed_rows(points: Sequence[TrackPoint]) -> list[PlacedRow]:
    """Return the rows of the last track in which the source is a single Gaussian in Cartesian coordinates."""
    known = [i for i, point in enumerate(points) if point.is_on_track]
    begin = max((i for i in known if points[i].status == "acquired" or i == known[0]), default=0)
    found = (_placed_row(i, points[i]) for i in known if i >= begin)
    return [row for row in found if row is not None]


def _placed_row(index: int, point: TrackPoint) -> PlacedRow | None:
    """Return a row whose source is a Cartesian Gaussian, otherwise None."""
    if point.covariance is None or point.position_m is None or point.moment_Am2 is None or point.centroid_m is None:
        return None
    if not relative_range_sigma(point.covariance, point.position_m - point.centroid_m) <= START_RANGE_ERROR:
        return None
    return PlacedRow(index, np.concatenate([point.position_m, point.moment_Am2]), point.covariance)
