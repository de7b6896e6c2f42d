"""Where a track starts: from the fix of one row, or of several rows while the source is as good as at rest."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from arrays.array import SensorArray
from arrays.differences import decorrelated_differences
from arrays.typing import FloatArray
from magloc.levels import CONTRADICTION, DISAGREEMENT
from magloc.localization.fit.prior import SourcePrior
from magloc.localization.fit.results import Fix, Solution
from magloc.localization.locator import Locator, fit_at_rest
from magloc.localization.uncertainty.ambiguity import weights
from magloc.localization.uncertainty.range_interval import relative_range_sigma
from magloc.measurement.pose import PoseErrors, pose_covariance
from magloc.measurement.rows import check_magnitudes
from magloc.tracking.motion import N_SOURCE
from magloc.tracking.results import Row

START_RANGE_ERROR = 0.03
"""Standard deviation of the range over the range that a start may have: beyond it the posterior is no Gaussian in
Cartesian coordinates."""
CONFIRMED_RANGE_ERROR = 2.0 * START_RANGE_ERROR
"""The same for the row after one that could start a track, where that is not beyond doubt. The first row that falls
below a limit is one whose noise makes it look certain; the next one has noise of its own, and starts the track."""
STACKED_POSITION_ERROR = 0.01
"""Standard deviation of the whole position over the range, for a start from several rows of which one alone does not
determine the source: the prediction is then Gaussian in Cartesian coordinates, so that it must be as good as linear."""
_BEYOND_DOUBT = 0.5 * START_RANGE_ERROR
# Another solution within this Δχ² forbids a start.
_RIVAL_WITHIN = 9.0
# Rows that together may determine a source at rest: how far back, how many, how often it is tried.
_WINDOW_ROWS = 64
_STACKED_ROWS = 16
_TRY_EVERY = 4
# A source is as good as at rest while it moves by less than this share of its range.
_AT_REST = 0.01


@dataclass(frozen=True, eq=False)
class Start:
    """Where a track starts.

    Attributes
    ----------
    solution : Solution
        In the world frame; its weight is that among all solutions and, where there is one, after the prediction.
    rows : sequence of Row
        The readings that it was found from, in the order of time.
    rivals : tuple of Solution
        The other solutions that explain these readings.
    """

    solution: Solution
    rows: Sequence[Row]
    rivals: tuple[Solution, ...] = ()


class Acquisition:
    """Looks for a source, row by row; `of_last_row` is what the last row says on its own, in the world frame."""

    def __init__(self, array: SensorArray, prior: SourcePrior, speed_m_s: float) -> None:
        check_magnitudes(array)
        self.array = array
        self.speed_m_s = speed_m_s
        self.of_last_row = Fix(())
        self._pose_errors = PoseErrors.of(array.pose)
        self._locator: Locator | None = None
        if decorrelated_differences(array).n_differences >= N_SOURCE:
            self._locator = Locator(array, prior=prior, body_length_m=0.0, exclude_faulty=False)
        self.forget()

    def forget(self) -> None:
        """Start to look anew."""
        self._recent: deque[Row] = deque(maxlen=_WINDOW_ROWS)
        self._n_rows = 0
        self._proposed: Solution | None = None
        self._confirmable: Solution | None = None

    def start(self, row: Row, near: tuple[FloatArray, FloatArray] | None = None) -> tuple[Start | None, str]:
        """A start with one more row, the nearest one to a prediction (x, S) if there is one, or why there is none."""
        reason, fix = "not acquired: one row does not determine the source", Fix(())
        self.of_last_row = fix
        if self._locator is not None:
            fix = self._locator.fit(row.readings_T, row.ambient_T)
            centroid = row.origin_m + row.R_world_from_array @ self.array.centroid
            last, self._confirmable = self._confirmable, None
            limit = START_RANGE_ERROR if last is None else CONFIRMED_RANGE_ERROR
            self.of_last_row = _in_world(fix, row)
            found = self.of_last_row if near is None else _after(self.of_last_row, *near)
            solution, reason = _certain_solution(found, centroid, limit, alone=near is None)
            if solution is not None:
                range_error = relative_range_sigma(solution.covariance, solution.position_m - centroid)
                solution_here = self._in_doubt_of_pose(solution, row)
                if _agree(last, solution_here) or range_error < _BEYOND_DOUBT or near is not None:
                    return Start(solution, [row], found.solutions[1:]), ""
                if range_error < START_RANGE_ERROR:
                    self._confirmable = solution_here
                reason = "not acquired: the next row is to confirm the source"
        start = self._start_from_recent(row, fix)
        return start, reason if start is None else ""

    def _in_doubt_of_pose(self, solution: Solution, row: Row) -> Solution:
        """A solution in the world with what errors of the row's pose add to its covariance."""
        pose = row.pose(np.array(self._pose_errors.uncertainty.lever_arm_m))
        source = np.concatenate([solution.position_m, solution.moment_Am2])
        added = pose_covariance(self._pose_errors, pose, pose.in_array(source), row.pose_sigma)
        return replace(solution, covariance=solution.covariance + added)

    def _start_from_recent(self, row: Row, alone: Fix) -> Start | None:
        """A start from the latest rows together, while the source is as good as at rest in them.

        That is a matter of its characteristic speed, and of how far away it is; where the array itself moves and one
        row says nothing of that (`alone` is its fix), it is tried.
        """
        self._recent.append(row)
        self._n_rows += 1
        if self._n_rows % _TRY_EVERY:
            return None
        recent = list(self._recent)
        if alone.solutions:
            centroid = row.R_world_from_array @ self.array.centroid
            range_m = float(np.linalg.norm(row.R_world_from_array @ alone.solutions[0].position_m - centroid))
            time_s = _AT_REST * range_m / self.speed_m_s
            recent = [earlier for earlier in recent if row.time_s - earlier.time_s <= time_s]
        elif np.ptp([earlier.origin_m for earlier in recent], axis=0).max() <= self.array.circumradius:
            return None
        if len(recent) < 2:
            return None
        chosen = recent[:: -max(1, len(recent) // _STACKED_ROWS)]
        known = [earlier.ambient_T for earlier in chosen if earlier.ambient_T is not None]
        errors, lever_arm_m = self._pose_errors, np.array(self._pose_errors.uncertainty.lever_arm_m)
        fix = fit_at_rest(
            self.array,
            np.stack([earlier.readings_T for earlier in chosen]),
            np.stack([earlier.origin_m for earlier in chosen]),
            np.stack([earlier.R_world_from_array for earlier in chosen]),
            np.stack(known) if len(known) == len(chosen) else None,
            poses=errors.of_rows(
                self.array,
                np.array([earlier.time_s for earlier in chosen]),
                [earlier.pose(lever_arm_m) for earlier in chosen],
                [earlier.pose_sigma for earlier in chosen],
            ),
        )
        centroid = row.origin_m + row.R_world_from_array @ self.array.centroid
        before, self._proposed = self._proposed, _certain_solution(fix, centroid, START_RANGE_ERROR)[0]
        if self._proposed is None or not _agree(before, self._proposed):
            return None
        return Start(self._proposed, chosen[::-1], fix.solutions[1:])


def _in_world(fix: Fix, row: Row) -> Fix:
    """A fix of one row in the world frame."""
    R, R6 = row.R_world_from_array, np.kron(np.eye(2), row.R_world_from_array)
    solutions = []
    for solution in fix.solutions:
        covariance = R6 @ solution.covariance @ R6.T
        source = replace(
            solution.source,
            position_m=row.origin_m + R @ solution.position_m,
            moment_Am2=R @ solution.moment_Am2,
            covariance=covariance,
        )
        solutions.append(replace(solution, sources=(source,), covariance=covariance))
    return replace(fix, solutions=tuple(solutions))


def _after(fix: Fix, x: FloatArray, S: FloatArray) -> Fix:
    """A fix after a prediction, state and square root of its covariance: ranked and weighted by both."""
    if not fix.solutions:
        return fix
    inverse = np.linalg.pinv(S[:3] @ S[:3].T)
    offsets = [solution.position_m - x[:3] for solution in fix.solutions]
    cost = np.array([s.chi2 + float(o @ inverse @ o) for s, o in zip(fix.solutions, offsets, strict=True)])
    # What is known beforehand is the prediction here, not that nothing is known of the scale.
    weight = weights(cost, np.zeros(len(cost))).tolist()
    order = np.argsort(cost, kind="stable").tolist()
    return replace(fix, solutions=tuple(replace(fix.solutions[i], weight=weight[i]) for i in order))


def _certain_solution(
    fix: Fix, centroid: FloatArray, largest_range_error: float, *, alone: bool = True
) -> tuple[Solution | None, str]:
    """The first solution, that a track starts from, or why it does not; `alone`: no other one may fit alike."""
    if not fix.solutions:
        return None, f"not acquired: {fix.reason}"
    best = fix.solutions[0]
    if best.dof > 0 and best.chi2 > chdtri(best.dof, CONTRADICTION):
        return None, "not acquired: no dipole fits the readings"
    if not best.range_observable:
        return None, "not acquired: the range is not observable"
    if relative_range_sigma(best.covariance, best.position_m - centroid) > largest_range_error:
        return None, "not acquired: the range is not certain enough"
    if alone and any(solution.chi2 < best.chi2 + _RIVAL_WITHIN for solution in fix.solutions[1:]):
        return None, "not acquired: several solutions fit alike"
    return best, ""


def _agree(before: Solution | None, after: Solution) -> bool:
    """Whether two successive proposals for a start are one: a wrong basin seldom stays where it is as rows come in."""
    if before is None:
        return False
    offset = after.position_m - before.position_m
    both = before.covariance[:3, :3] + after.covariance[:3, :3]
    return bool(offset @ np.linalg.solve(both, offset) < chdtri(3, DISAGREEMENT))
