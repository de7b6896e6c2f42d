"""What goes into a track row by row, and what comes out of it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from arrays.typing import FloatArray
from magloc.localization.fit.results import EVERYWHERE, Intervals, Solution, is_observable_set
from magloc.localization.uncertainty.ambiguity import LARGEST_GAUSSIAN_SIGMA, relative_sigma
from magloc.localization.uncertainty.range_interval import gaussian_ranges, union
from magloc.readings import Readings
from magloc.tracking.chart.mixture import Mixture


@dataclass(frozen=True, eq=False)
class Row:
    """Readings at one instant.

    Attributes
    ----------
    time_s : float
    readings_T : ndarray, shape (C,)
        Raw readings, NaN where missing.
    origin_m, R_world_from_array : ndarray, shapes (3,) and (3, 3)
        Pose of the array.
    ambient_T : ndarray, shape (3,), optional
        Ambient field in the array's frame, in place of the array's own.
    """

    time_s: float
    readings_T: FloatArray
    origin_m: FloatArray = field(default_factory=lambda: np.zeros(3))
    R_world_from_array: FloatArray = field(default_factory=lambda: np.eye(3))
    ambient_T: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class TrackPoint:
    """What is known of the source at one instant; None where it is not tracked.

    Attributes
    ----------
    time_s : float
    position_m, moment_Am2 : ndarray, shape (3,)
    covariance : ndarray, shape (6, 6)
        Of (position, moment).
    estimability : ndarray, shape (6,)
        What the readings taught of every component since the track began: 1 - σ / σ without any of them.
    iterations : int
        Linearisations.
    nis : float
        Normalised innovation squared, and `nis_dof` its degrees of freedom. NaN for rows that the track started from.
    status : str
        "tracked", "acquired" (a new track started here), "predicted" (no readings), "outlier" (readings that contradict
        the track, not used), or why there is no track.
    weight : float
        How likely the track is the right one of all solutions that explained the readings which it started from; rows
        that it explains since then only make it more likely. NaN without a track.
    rivals : tuple of Solution
        Where a track starts, the other solutions of these readings; where there is none, all solutions of the row.
    centroid_m : ndarray, shape (3,), optional
        Of the sensors, where the range is counted from.
    radius_m : float
        Largest distance of a sensor from it.
    mixture : Mixture, optional
        All that is known of position and moment, in the coordinates in which it is Gaussian; None of a track that is
        read from a file.
    """

    time_s: float
    position_m: FloatArray | None = None
    moment_Am2: FloatArray | None = None
    covariance: FloatArray | None = None
    estimability: FloatArray | None = None
    iterations: int = 0
    nis: float = math.nan
    nis_dof: int = 0
    status: str = ""
    weight: float = math.nan
    rivals: tuple[Solution, ...] = ()
    centroid_m: FloatArray | None = None
    radius_m: float = math.nan
    mixture: Mixture | None = None

    @property
    def range_interval_m(self) -> Intervals | None:
        """95 % set of the distance from the sensors' centroid [m], None where the sensors are not known.

        Of a track it is :func:`magloc.localization.uncertainty.range_interval.gaussian_ranges` of its covariance;
        without one it is that of the row alone, or every range where the row says nothing.
        """
        if self.mixture is not None:
            return self.mixture.range_interval_m()
        if self.position_m is None or self.covariance is None:
            return self.rivals[0].range_interval_m if self.rivals else EVERYWHERE
        if self.centroid_m is None:
            return None
        ends = gaussian_ranges(self.covariance, self.position_m - self.centroid_m, self.radius_m)
        return union([ends.tolist()])

    @property
    def range_observable(self) -> bool:
        """Whether that set is closed, and its ends differ by a factor of two at most."""
        return is_observable_set(self.range_interval_m or EVERYWHERE)

    @property
    def gaussian(self) -> bool:
        """Whether the standard deviations are so small that the covariance describes the uncertainty."""
        if self.position_m is None or self.moment_Am2 is None or self.covariance is None or self.centroid_m is None:
            return False
        sigma = relative_sigma(self.covariance, self.position_m - self.centroid_m, self.moment_Am2)
        return bool(sigma <= LARGEST_GAUSSIAN_SIGMA)


@dataclass(frozen=True, eq=False)
class Step:
    """One step of a track, for smoothing.

    Attributes
    ----------
    row : int
        Which row it belongs to.
    known : Mixture
        After the row's readings, as one Gaussian.
    prediction : Mixture, optional
        Before them; None at the first step of a track.
    transition : ndarray, shape (N, N), optional
        That led there, in the charts about the two states.
    """

    row: int
    known: Mixture
    prediction: Mixture | None = None
    transition: FloatArray | None = None


def rows_of(readings: Readings) -> Iterator[Row]:
    """Rows of readings for a tracker."""
    rotations = None if readings.pose is None else readings.pose[1].as_matrix()
    for i, time in enumerate(readings.time_s.tolist()):
        row = Row(time, readings.values_T[i], ambient_T=None if readings.ambient_T is None else readings.ambient_T[i])
        if readings.array_position_m is not None and rotations is not None:
            row = replace(row, origin_m=readings.array_position_m[i], R_world_from_array=rotations[i])
        yield row


def stacked(points: Sequence[TrackPoint], name: str, *shape: int) -> FloatArray:
    """A column of a track (n, ...), NaN where there is no track."""
    empty = np.full(shape, np.nan)
    values = [empty if value is None else value for value in (getattr(point, name) for point in points)]
    return np.array(values, dtype=np.float64).reshape(len(points), *shape)


@dataclass(frozen=True, eq=False)
class TrackResult:
    """A track, or a truth.

    Attributes
    ----------
    points : tuple of TrackPoint
        With one at least that has a position. A truth has no covariances.
    is_truth : bool
    """

    points: tuple[TrackPoint, ...]
    is_truth: bool
