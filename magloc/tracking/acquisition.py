"""Where a track starts whose rows do not determine a source one by one: from several rows, as if it were at rest."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from arrays.array import SensorArray
from arrays.typing import FloatArray
from magloc.levels import CONTRADICTION, DISAGREEMENT
from magloc.localization.fit.prior import SourcePrior
from magloc.localization.fit.results import Fix, Solution
from magloc.localization.locator import fit_at_rest
from magloc.localization.uncertainty.range_interval import relative_range_sigma
from magloc.measurement.nuisances import ambient_in_array, with_eddies_as_offsets
from magloc.measurement.pose import PoseErrors
from magloc.tracking.results import Row

START_RANGE_ERROR = 0.03
"""Standard deviation of the range over the range that a start may have: beyond it the posterior is no Gaussian in
Cartesian coordinates."""
STACKED_POSITION_ERROR = 0.01
"""Standard deviation of the whole position over the range, for a start from several rows of which one alone does not
determine the source: the prediction is then Gaussian in Cartesian coordinates, so that it must be as good as linear."""
# Another solution within this Δχ² forbids a start.
_RIVAL_WITHIN = 9.0
# Rows that together may determine a source at rest: how far back, how many, how often it is tried.
_WINDOW_ROWS = 64
_STACKED_ROWS = 16
_TRY_EVERY = 4
# Of the error that a start may have, as all rows so far tell it: with more of it none is tried.
_MOST_HOPEFUL = 1.2


@dataclass(frozen=True, eq=False)
class Start:
    """Where a track starts.

    Attributes
    ----------
    solution : Solution
        In the world frame; its weight is that among all solutions.
    rows : sequence of Row
        All that were kept, in the order of time: a few of them found it, what they leave open the others tell.
    rivals : tuple of Solution
        The other solutions that explain these readings.
    """

    solution: Solution
    rows: Sequence[Row]
    rivals: tuple[Solution, ...] = ()


class Acquisition:
    """Looks for a source in the latest rows together, of which one alone does not determine it."""

    def __init__(self, array: SensorArray, prior: SourcePrior) -> None:
        self.array = array
        # Bounds, and three numbers, are known in the axes of an array that moves.
        modulus = prior.known_moment_Am2 if isinstance(prior.known_moment_Am2, float | int) else None
        sigma_Am2 = None if modulus is None else prior.known_moment_sigma_Am2
        self._prior = SourcePrior(known_moment_Am2=modulus, known_moment_sigma_Am2=sigma_Am2)
        self._pose_errors = PoseErrors.of_array(array)
        self.forget()

    def forget(self) -> None:
        """Start to look anew."""
        self._recent: deque[Row] = deque(maxlen=_WINDOW_ROWS)
        self._n_rows = 0
        self._proposed: Solution | None = None

    def start(self, row: Row, position_error: float = 0.0) -> Start | None:
        """A start with one more row, where the array moves enough for it, and the source is as good as at rest.

        `position_error`: standard deviation of the position over the range, as far as it is known otherwise.
        """
        self._recent.append(row)
        self._n_rows += 1
        recent = list(self._recent)
        if self._n_rows % _TRY_EVERY or len(recent) < 2 or position_error > _MOST_HOPEFUL * STACKED_POSITION_ERROR:
            return None
        if np.ptp([earlier.origin_m for earlier in recent], axis=0).max() <= self.array.circumradius:
            return None
        chosen = recent[:: -max(1, len(recent) // _STACKED_ROWS)]
        known = [earlier.ambient_T for earlier in chosen if earlier.ambient_T is not None]
        errors, lever_arm_m = self._pose_errors, np.array(self._pose_errors.uncertainty.lever_arm_m)
        fix = fit_at_rest(
            self._array_of(chosen),
            np.stack([earlier.readings_T for earlier in chosen]),
            np.stack([earlier.origin_m for earlier in chosen]),
            np.stack([earlier.R_world_from_array for earlier in chosen]),
            np.stack(known) if len(known) == len(chosen) else None,
            prior=self._prior,
            poses=errors.of_rows(
                self.array,
                np.array([earlier.time_s for earlier in chosen]),
                [earlier.pose(lever_arm_m) for earlier in chosen],
                [earlier.pose_sigma for earlier in chosen],
            ),
        )
        centroid = row.origin_m + row.R_world_from_array @ self.array.centroid
        before, self._proposed = self._proposed, _certain_solution(fix, centroid)
        if self._proposed is None or not _agree(before, self._proposed):
            return None
        return Start(self._proposed, recent, fix.solutions[1:])

    def _array_of(self, rows: Sequence[Row]) -> SensorArray:
        """The array where eddy currents are errors of its offsets."""
        if not any(sensor.eddy_uncertainty_s for sensor in self.array.sensors):
            return self.array
        ambient_T = [ambient_in_array(self.array, row.readings_T, row.ambient_T) for row in rows]
        rates = [row.pose(np.zeros(3)).rate_rad_s for row in rows]
        return with_eddies_as_offsets(self.array, np.stack(ambient_T), np.stack(rates))


def _certain_solution(fix: Fix, centroid: FloatArray) -> Solution | None:
    """The first solution, if a track may start from it and no other one fits alike."""
    if not fix.solutions:
        return None
    best = fix.solutions[0]
    fits = best.dof <= 0 or best.chi2 <= chdtri(best.dof, CONTRADICTION)
    certain = relative_range_sigma(best.covariance, best.position_m - centroid) <= START_RANGE_ERROR
    alone = all(solution.chi2 >= best.chi2 + _RIVAL_WITHIN for solution in fix.solutions[1:])
    return best if fits and best.range_observable and certain and alone else None


def _agree(before: Solution | None, after: Solution) -> bool:
    """Whether two successive proposals for a start are one: a wrong basin seldom stays where it is as rows come in."""
    if before is None:
        return False
    offset = after.position_m - before.position_m
    both = before.covariance[:3, :3] + after.covariance[:3, :3]
    return bool(offset @ np.linalg.solve(both, offset) < chdtri(3, DISAGREEMENT))
