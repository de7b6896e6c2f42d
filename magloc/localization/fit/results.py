"""What a fix is: the solutions of one set of readings, and what is known of the source beforehand."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from arrays.typing import FloatArray
from magloc.readings import Readings

DISTINCT_WITHIN = 20.0
# Mean square of whitened differences below which they are rounding errors rather than noise.
SILENT = 1e-9


@dataclass(frozen=True, eq=False)
class Solution:
    """One optimum of the likelihood.

    Attributes
    ----------
    position_m : ndarray, shape (3,)
        Source in the array's frame [m].
    moment_Am2 : ndarray, shape (3,)
        Its moment [A·m²].
    covariance : ndarray, shape (6, 6)
        Of (position, moment): the inverse information at the solution. Where the range is not observable it is widened
        along the range until it is as long as `range_interval95_m`
        (:func:`magloc.localization.uncertainty.ambiguity.widened`).
    chi2 : float
        Sum of squared residuals of the decorrelated differences over their variances.
    dof : int
        Differences minus unknowns.
    iterations : int
        Linearisations that led here.
    converged : bool
        Whether the iteration ended at an optimum; no other solutions are listed.
    range_observable : bool
        Whether a source is detected, the 95 % set of ranges is closed, and its ends differ by a factor of two at most.
    range_interval95_m : tuple of (low, high)
        The 95 % set of the distance from the sensors' centroid [m], all solutions together: it is a property of the
        readings, and the same for all their solutions (:mod:`magloc.localization.uncertainty.range_interval`). In
        ascending order; high is None where it is open.
    weight : float
        How likely the solution is among those of the fix; they add up to one
        (:func:`magloc.localization.uncertainty.ambiguity.weights`).
    gaussian : bool
        Whether the covariance describes the uncertainty: the range is observable in one interval, no other solution has
        a weight to speak of, the standard deviations of position and moment are small against the range and the moment
        (:data:`magloc.localization.uncertainty.ambiguity.LARGEST_GAUSSIAN_SIGMA`), and χ² is one of noise and rises as
        that of a Gaussian does (:func:`magloc.localization.uncertainty.covariance.covariance_is_valid`).
    """

    position_m: FloatArray
    moment_Am2: FloatArray
    covariance: FloatArray
    chi2: float
    dof: int
    iterations: int
    converged: bool
    range_observable: bool
    range_interval95_m: tuple[tuple[float, float | None], ...]
    weight: float = 1.0
    gaussian: bool = False


@dataclass(frozen=True, eq=False)
class Fix:
    """Every distinct solution of one set of readings, best χ² first.

    Attributes
    ----------
    solutions : tuple of Solution
        Empty if the readings cannot be solved.
    reason : str
        Why there is no solution; empty if there is one.
    failed_starts : int
        Starts of the search that ended without an optimum.
    dropped : tuple of str
        Ids of sensors that contradict all others, and were left out.
    detected : bool
        Whether the readings stand out of noise, which alone makes them do so in one of a thousand rows. Where they do
        not, or cannot be tested, the solutions are fits of noise and nothing is known of the range.
    """

    solutions: tuple[Solution, ...]
    reason: str = ""
    failed_starts: int = 0
    dropped: tuple[str, ...] = ()
    detected: bool = True


@dataclass(frozen=True, eq=False)
class Source:
    """One of several sources of a :class:`JointSolution`.

    Attributes
    ----------
    position_m, moment_Am2 : ndarray, shape (3,)
        [m], array's frame; [A·m²].
    covariance : ndarray, shape (6, 6)
        Of its position and moment, all other sources being unknown too.
    range_observable : bool
    range_interval95_m : tuple of (low, high)
        As in :class:`Solution` for a single source. Of several sources each has its own: where the profile χ² over its
        range, all else fitted anew, stays within 3.84 of this solution.
    gaussian : bool
        As in :class:`Solution`.
    merged : bool
        Whether it stands for two sources that the array does not tell apart.
    """

    position_m: FloatArray
    moment_Am2: FloatArray
    covariance: FloatArray
    range_observable: bool
    range_interval95_m: tuple[tuple[float, float | None], ...]
    merged: bool = False
    gaussian: bool = False


@dataclass(frozen=True, eq=False)
class JointSolution:
    """Several sources that together explain the readings.

    Attributes
    ----------
    sources : tuple of Source
    covariance : ndarray, shape (6 K, 6 K)
        Of (position, moment) of the first source, then of the second, and so on.
    chi2, dof, iterations, converged, weight
        As in :class:`Solution`.
    """

    sources: tuple[Source, ...]
    covariance: FloatArray
    chi2: float
    dof: int
    iterations: int
    converged: bool = True
    weight: float = 1.0


@dataclass(frozen=True, eq=False)
class JointFix:
    """Every distinct solution with the chosen number of sources, best χ² first.

    Attributes
    ----------
    solutions : tuple of JointSolution
        Empty if the readings cannot be solved.
    reason : str
        Why there is no solution, or why it has fewer sources than were asked for; empty otherwise.
    dropped : tuple of str
        Ids of sensors that contradict all others, and were left out.
    detected : bool
        As in :class:`Fix`.
    """

    solutions: tuple[JointSolution, ...]
    reason: str = ""
    dropped: tuple[str, ...] = ()
    detected: bool = True


def open_ended(low: float, high: float) -> tuple[float, float | None]:
    """An interval whose upper end may be open."""
    return low, high if math.isfinite(high) else None


def is_observable(low: float, high: float) -> bool:
    """Whether an interval of the range is closed and its ends differ by a factor of two at most."""
    return low > 0.0 and high <= 2.0 * low


AnyFix = Fix | JointFix
AnySource = TypeVar("AnySource", Solution, Source)


def in_world(fix: AnyFix, readings: Readings, row: int) -> AnyFix:
    """A fix in the world frame if the array's pose is known."""
    if readings.array_position_m is None or readings.array_rotation_xyzw is None:
        return fix
    origin, R = readings.array_position_m[row], Rotation.from_quat(readings.array_rotation_xyzw[row]).as_matrix()

    def turned(covariance: FloatArray) -> FloatArray:
        R_all = np.kron(np.eye(len(covariance) // 3), R)
        return R_all @ covariance @ R_all.T

    def moved(found: AnySource) -> AnySource:
        return replace(
            found,
            position_m=origin + R @ found.position_m,
            moment_Am2=R @ found.moment_Am2,
            covariance=turned(found.covariance),
        )

    if isinstance(fix, Fix):
        return replace(fix, solutions=tuple(moved(solution) for solution in fix.solutions))
    solutions = (
        replace(
            solution,
            sources=tuple(moved(source) for source in solution.sources),
            covariance=turned(solution.covariance),
        )
        for solution in fix.solutions
    )
    return replace(fix, solutions=tuple(solutions))
