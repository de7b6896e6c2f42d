"""Points of tracks of one source or several, and the steps of the filter."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from arrays.typing import BoolArray, FloatArray
from magloc.localization.fit.results import EVERYWHERE, Intervals, Solution, intervals_of, is_observable_set
from magloc.localization.uncertainty.ambiguity import LARGEST_GAUSSIAN_SIGMA, relative_sigma
from magloc.localization.uncertainty.range_interval import gaussian_ranges
from magloc.measurement.plausibility import warn_of_moments
from magloc.tracking.chart.mixture import Mixture
from magloc.tracking.motion import N_SOURCE

UNDETERMINED = "undetermined"
"""Status of a row before a track that shows a source and does not determine it; the point is by all rows so far."""


@dataclass(frozen=True, eq=False)
class Innovation:
    """Whitened innovations (k,) of a row, its available channels (C,), and the correction."""

    available: BoolArray
    whitened: FloatArray
    correction: float = math.nan

    def statistics(self, before: Innovation | None) -> dict[str, Any]:
        """Return NIS, degrees of freedom, correction, and product with the innovation before."""
        same = before is not None and np.array_equal(before.available, self.available)
        return {
            "nis": float(self.whitened @ self.whitened),
            "nis_dof": self.whitened.size,
            "correction": self.correction,
            "lag1": float(self.whitened @ before.whitened) if before is not None and same else math.nan,
        }


@dataclass(frozen=True, eq=False)
class TrackPoint:
    """State of the source at one instant; None where it is not tracked.

    Attributes
    ----------
    time_s : float
    position_m, moment_Am2 : ndarray, shape (3,)
    covariance : ndarray, shape (6, 6)
        Covariance of (position, moment).
    estimability : ndarray, shape (6,)
        1 - σ / σ₀ of each number, where σ₀ is its standard deviation without any readings.
    iterations : int
        Number of linearisations.
    nis : float
        Normalised innovation squared, and `nis_dof` its degrees of freedom. NaN for rows that the track started from.
    status : str
        "tracked", "acquired" (a new track starts here), "predicted" (no readings), "outlier" (readings that contradict
        the track and are not used), "undetermined" (no track yet: rows of few readings answered together), or the
        reason why there is no track.
    weight : float
        Probability of the place among all that explain the readings so far. NaN without a track.
    rivals : tuple of Solution
        Other solutions of the rows, if a track starts from several rows.
    centroid_m : ndarray, shape (3,), optional
        Centroid of the sensors, from which the range is measured.
    radius_m : float
        Largest distance of a sensor from it.
    lag1 : float
        Product of the whitened innovations of this row and the one before: mean zero and variance `nis_dof` for a right
        model. NaN if the row before has none, or other channels.
    correction : float
        Squared correction of the prediction by the readings, in its standard deviations, minus its mean: zero on
        average for a right model, and less if predictions are better than their covariance. NaN without a prediction,
        and if errors of sensors or pose are states.
    dropped_sensors : tuple of str
        Sensors excluded because they contradict the others.
    mixture : Mixture, optional
        Gaussian mixture of position and moment; None for a track that is read from a file.
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
    lag1: float = math.nan
    correction: float = math.nan
    mixture: Mixture | None = None
    dropped_sensors: tuple[str, ...] = ()

    @property
    def tracks(self) -> tuple[TrackPoint, ...]:
        """The source as a tuple, empty without a position; as :attr:`SourcesPoint.tracks`."""
        return () if self.position_m is None else (self,)

    @property
    def is_on_track(self) -> bool:
        """True if a track answers the row, and not the row alone."""
        return self.position_m is not None and self.status != UNDETERMINED

    @cached_property
    def range_interval_m(self) -> Intervals | None:
        """95 % set of the distance from the sensors' centroid [m], None without sensors.

        Quantiles of the mixture; without one,
        :func:`magloc.localization.uncertainty.range_interval.gaussian_ranges` of the covariance. Without a track, every
        range.
        """
        if self.mixture is not None:
            return self.mixture.range_interval_m()
        if self.position_m is None or self.covariance is None:
            return EVERYWHERE
        if self.centroid_m is None:
            return None
        ends = gaussian_ranges(self.covariance, self.position_m - self.centroid_m, self.radius_m)
        return intervals_of(ends[None])

    @property
    def range_observable(self) -> bool:
        """True if the range set is closed and its ends differ by a factor of two at most."""
        return is_observable_set(self.range_interval_m or EVERYWHERE)

    @property
    def gaussian(self) -> bool:
        """True if standard deviations are small enough for the covariance to be meaningful."""
        if self.position_m is None or self.moment_Am2 is None or self.covariance is None or self.centroid_m is None:
            return False
        sigma = relative_sigma(self.covariance, self.position_m - self.centroid_m, self.moment_Am2)
        return bool(sigma <= LARGEST_GAUSSIAN_SIGMA)


@dataclass(frozen=True, eq=False)
class SourcePoint(TrackPoint):
    """One of several sources at one instant.

    Attributes
    ----------
    id : int
        Number of the source, the same in all rows.
    merged : bool
        True if the gap to another source is less certain than a third of it. Names and places are then a guess.
    """

    position_m: FloatArray
    moment_Am2: FloatArray
    covariance: FloatArray
    id: int = 0
    merged: bool = False


@dataclass(frozen=True, eq=False)
class SourcesPoint:
    """State of all sources at one instant.

    Attributes
    ----------
    time_s : float
    tracks : tuple of SourcePoint
        In the order of their ids.
    status : str
        "tracked"; "no source"; "no readings"; "misfit": no births, losses or faults explain the readings, and the
        tracks are predictions; "doubtful": χ² of the last rows together is beyond noise, or was in one of the last 25
        rows, and another explanation is sought.
    chi2 : float
        χ² of the row given its prediction.
    dof : int
        Number of its readings.
    dropped_sensors : tuple of str
        Sensors that are excluded.
    """

    time_s: float
    tracks: tuple[SourcePoint, ...]
    status: str
    chi2: float
    dof: int
    dropped_sensors: tuple[str, ...] = ()


def estimability(variance: FloatArray, open_loop: FloatArray) -> FloatArray:
    """Return the estimability 1 - σ / σ₀ from the variances with and without readings."""
    return 1.0 - np.sqrt(np.minimum(variance / open_loop, 1.0))


def point_of_mixture(time_s: float, mixture: Mixture, open_loop: FloatArray) -> TrackPoint:
    """Return the point of a mixture; open_loop (n,) are the variances without any readings."""
    source = mixture.source_marginal()
    mean, covariance = source.moments()
    return TrackPoint(
        time_s,
        mean[:3],
        mean[3:],
        covariance,
        estimability(np.diagonal(covariance), open_loop[:N_SOURCE]),
        weight=float(source.weight.max()),
        centroid_m=source.centroid_m,
        radius_m=source.radius_m,
        mixture=source,
    )


@dataclass(frozen=True, eq=False)
class Prediction:
    """Predicted state, root of its covariance, transition matrix, and root of the step's noise."""

    x: FloatArray
    S: FloatArray
    F: FloatArray
    S_q: FloatArray


@dataclass(frozen=True, eq=False)
class Step:
    """One step of a filter, as the smoother needs it.

    Attributes
    ----------
    row : int
        Index of the row.
    prediction : Prediction, optional
        Prediction from the step before; None at the first step of a track.
    x, S : ndarray
        State and square root of its covariance after the row's readings.
    """

    row: int
    prediction: Prediction | None
    x: FloatArray
    S: FloatArray


def on_track(points: Sequence[TrackPoint]) -> Sequence[TrackPoint]:
    """Return the points, empty where no track answers the row."""
    return [point if point.is_on_track else TrackPoint(point.time_s, status=point.status) for point in points]


def warn_of_strengths(points: Iterable[TrackPoint]) -> None:
    """Warn if most points of a track have a moment that no object at their distance has."""
    known = [point for point in points if point.is_on_track and point.centroid_m is not None]
    if known:
        places, moments, centroids = (
            track_column(known, name, 3) for name in ("position_m", "moment_Am2", "centroid_m")
        )
        warn_of_moments(np.linalg.norm(places - centroids, axis=1), moments)


def track_column(points: Sequence[TrackPoint], name: str, *shape: int) -> FloatArray:
    """Return a column of a track (n, ...), NaN where there is no track."""
    empty = np.full(shape, np.nan)
    values = [empty if value is None else value for value in (getattr(point, name) for point in points)]
    return np.array(values, dtype=np.float64).reshape(len(points), *shape)


@dataclass(frozen=True, eq=False)
class TrackResult:
    """Tracks of one source or several, or a truth, for pictures and the viewer.

    Attributes
    ----------
    points : tuple of TrackPoint
        Points of the first source. A truth has no covariances.
    is_truth : bool
    ids : tuple of int
        Ids of several sources; empty for one source.
    others : tuple of tuple of TrackPoint
        Points of the further sources, in the same rows.
    kind : str
        Word for a source.
    """

    points: tuple[TrackPoint, ...]
    is_truth: bool
    ids: tuple[int, ...] = ()
    others: tuple[tuple[TrackPoint, ...], ...] = ()
    kind: str = "source"

    @property
    def tracks(self) -> tuple[tuple[TrackPoint, ...], ...]:
        """Points of each source; at least one row of one source has a position."""
        return (self.points, *self.others)
