"""Results of a fix: solutions and their sources."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtrc

from arrays.typing import FloatArray
from magloc.levels import MISFIT

if TYPE_CHECKING:
    from magloc.localization.fit.fixes import Fixes

Intervals = tuple[tuple[float, float | None], ...]
EVERYWHERE: Intervals = ((0.0, None),)
"""Set of ranges of a row without information on the range."""
# Rise of χ² within which another optimum counts as a solution too.
DISTINCT_WITHIN = 20.0


@dataclass(frozen=True, eq=False, repr=False)
class Source:
    """Magnetic dipole and its uncertainty.

    Attributes
    ----------
    position_m : ndarray, shape (3,)
        Position in the frame of its fix [m].
    moment_Am2 : ndarray, shape (3,)
        Moment [A·m²].
    covariance : ndarray, shape (6, 6), optional
        Covariance of (position, moment) with all other sources unknown, or (3, 3) of the moment if the position is
        known. None for a source that is not the result of a fix. If the range is not observable, the covariance is
        widened along the range until it covers `range_interval_m`.
    range_interval_m : tuple of (low, high)
        Intervals of the 95 % set of the distance from the sensors' centroid [m], in ascending order; high is None for
        an open interval. With one source the set covers all solutions of the readings. With several sources each has
        its own set, in which the profile χ² over its range is within 3.84 of the solution.
    gaussian : bool
        True if the covariance describes the uncertainty: the range is observable in one interval, no other solution has
        a noticeable weight, σ of position and moment are small, and χ² agrees with noise and rises like a parabola.
    merged : bool
        True if the source represents two that the array cannot separate.

    Examples
    --------
    >>> import magloc
    >>> magloc.Source([0.1, 0.0, 0.2], [0.0, 0.0, 1.0])
    Source(position_m=[0.1, 0. , 0.2], moment_Am2=[0., 0., 1.])
    """

    position_m: FloatArray
    moment_Am2: FloatArray
    covariance: FloatArray | None = None
    range_interval_m: Intervals = EVERYWHERE
    gaussian: bool = False
    merged: bool = False

    def __post_init__(self) -> None:
        for name in ("position_m", "moment_Am2"):
            value = np.asarray(getattr(self, name), dtype=np.float64)
            if value.shape != (3,):
                raise ValueError(f"Input {name} must have shape (3,); instead received {value.tolist()}.")
            object.__setattr__(self, name, value)

    @property
    def range_observable(self) -> bool:
        """True if the 95 % set of ranges is closed, with ends within a factor of two."""
        return is_observable_set(self.range_interval_m)

    def __repr__(self) -> str:
        position, moment = (
            np.array2string(value, precision=4, separator=", ") for value in (self.position_m, self.moment_Am2)
        )
        return f"Source(position_m={position}, moment_Am2={moment})"


@dataclass(frozen=True, eq=False, repr=False)
class Solution:
    """One optimum of the likelihood: sources that together explain the readings.

    Attributes
    ----------
    sources : tuple of Source
    covariance : ndarray, shape (6 K, 6 K)
        Covariance of (position, moment) of the first source, then the second, and so on; (3 K, 3 K) of the moments if
        the positions are known.
    chi2 : float
        Sum of squared residuals of the decorrelated differences over their variances.
    dof : int
        Number of differences minus number of unknowns.
    weight : float
        Probability of the solution among those of the fix; the weights add up to one.
    iterations : int
        Number of linearisations.
    known_chi2 : float
        χ² of the differences between fitted and known moments; not part of `chi2`.
    n_known : int
        Number of known components or moduli of the moments.

    Examples
    --------
    >>> import magloc
    >>> board = magloc.datasets.load("board")
    >>> solution = magloc.locate(board.array, board.readings[:1])[0].best
    >>> solution.weight, solution.dof, solution.covariance.shape
    (1.0, 81, (6, 6))
    """

    sources: tuple[Source, ...]
    covariance: FloatArray
    chi2: float
    dof: int
    weight: float = 1.0
    iterations: int = 0
    known_chi2: float = 0.0
    n_known: int = 0

    @property
    def misfit(self) -> bool:
        """True if χ², known moments included, is far beyond noise."""
        return bool(is_misfit(self.chi2 + self.known_chi2, self.dof + self.n_known))

    @property
    def source(self) -> Source:
        """Only source; raises ValueError if there are several."""
        if len(self.sources) != 1:
            raise ValueError(f"The solution has {len(self.sources)} sources: see its attribute sources.")
        return self.sources[0]

    @property
    def position_m(self) -> FloatArray:
        """Position (3,) of the only source [m]."""
        return self.source.position_m

    @property
    def moment_Am2(self) -> FloatArray:
        """Moment (3,) of the only source [A·m²]."""
        return self.source.moment_Am2

    @property
    def range_interval_m(self) -> Intervals:
        """95 % set of the range of the only source [m]."""
        return self.source.range_interval_m

    @property
    def range_observable(self) -> bool:
        """True if the range of the only source is known."""
        return self.source.range_observable

    @property
    def gaussian(self) -> bool:
        """True if the covariance of the only source describes its uncertainty."""
        return self.source.gaussian

    def __repr__(self) -> str:
        return f"Solution({list(self.sources)}, chi2/dof={self.chi2:.3g}/{self.dof}, weight={self.weight:.2f})"


@dataclass(frozen=True, eq=False, repr=False)
class Fix:
    """Distinct solutions of one set of readings.

    Attributes
    ----------
    solutions : tuple of Solution
        Solutions, best χ² first; empty if the readings have none.
    reason : str
        Reason why there is no solution, or why it has fewer sources than requested; empty otherwise.
    detected : bool
        True if the readings exceed noise, with one false alarm in a thousand rows. Otherwise, or if there is no test,
        the solutions are fits of noise and nothing is known of the range.
    dropped_sensors : tuple of str
        Ids of sensors that contradict all others, and were excluded.
    saturated_channels : tuple of str
        Names of the channels without a reading because they saturate.
    too_near : bool
        True if the source is too near, or too large, for a dipole.
    failed_starts : int
        Number of starts of the search that ended without an optimum.
    time_s : float
    body_length_m : float
        Stated or assumed length of the object [m]; 0 for a point.
    of_rows : tuple of Fixes and int, optional
        Fixes that contain this one, and its row.

    Examples
    --------
    >>> import magloc
    >>> board = magloc.datasets.load("board")
    >>> fix = magloc.locate(board.array, board.readings[:1])[0]
    >>> fix.detected, fix.misfit, len(fix.solutions)
    (True, False, 1)
    """

    solutions: tuple[Solution, ...]
    reason: str = ""
    detected: bool = True
    dropped_sensors: tuple[str, ...] = ()
    saturated_channels: tuple[str, ...] = ()
    too_near: bool = False
    failed_starts: int = 0
    time_s: float = math.nan
    body_length_m: float = 0.0
    of_rows: tuple[Fixes, int] | None = None

    @property
    def body_factor(self) -> float:
        """Factor by which rms errors would exceed their standard deviations for a body instead of a point.

        The body is as long as a quarter of its distance. The factor is 1 if it does not matter or a length is stated.
        """
        return 1.0 if self.of_rows is None else float(self.of_rows[0].body_factor[self.of_rows[1]])

    @property
    def best(self) -> Solution:
        """Solution with the largest weight; raises ValueError with the reason if there is none."""
        if not self.solutions:
            raise ValueError(f"The readings have no solution: {self.reason}.")
        return max(self.solutions, key=lambda solution: solution.weight)

    @property
    def misfit(self) -> bool:
        """True if χ² is far beyond noise, so that neither position nor σ can be trusted."""
        return bool(self.solutions) and self.solutions[0].misfit

    def __repr__(self) -> str:
        if not self.solutions:
            return f"Fix(no solution: {self.reason})"
        others = len(self.solutions) - 1
        more = f" and {others} other solution{'s' if others > 1 else ''}" if others else ""
        return f"Fix({self.best!r}{more}{'' if self.detected else ', not detected'})"


def values_of(of: object, keys: Iterable[str]) -> dict[str, Any]:
    """Return attributes of a source, a solution or a point of a track by their keys in JSON."""
    return {key: getattr(of, key.replace("interval95", "interval")) for key in keys}


def is_misfit(chi2: ArrayLike, dof: ArrayLike) -> Any:
    """Return whether χ² (...) is far beyond noise."""
    return (np.asarray(dof) > 0) & (chdtrc(np.maximum(dof, 1), chi2) < MISFIT)


def is_observable(low: Any, high: Any) -> Any:
    """Return whether range intervals (...) are closed, with ends within a factor of two."""
    return (low > 0.0) & (high <= 2.0 * low)


def open_ended(low: float, high: float) -> tuple[float, float | None]:
    """Return an interval, with None for an infinite upper end."""
    return low, high if math.isfinite(high) else None


def span(intervals: Intervals) -> tuple[float, float]:
    """Return the least and largest range of a set; NaN if it is empty."""
    if not intervals:
        return math.nan, math.nan
    high = intervals[-1][1]
    return intervals[0][0], math.inf if high is None else high


def intervals_of(ranges: FloatArray) -> Intervals:
    """Return a set of ranges (i, 2) as pairs; NaN pads it."""
    return tuple(open_ended(low, high) for low, high in ranges.tolist() if not math.isnan(low))


def spans(ranges: FloatArray) -> FloatArray:
    """Return the least and largest range (..., 2) of sets (..., i, 2); NaN if empty."""
    return np.stack([ranges[..., 0, 0], np.fmax.reduce(ranges[..., 1], axis=-1)], axis=-1)


def is_observable_set(intervals: Intervals) -> bool:
    """Return whether a set of ranges is closed, with ends within a factor of two."""
    return bool(is_observable(*span(intervals)))
