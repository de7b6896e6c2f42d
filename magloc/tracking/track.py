"""Follow one source through the rows of readings; results of tracks."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, TypeVar, overload

import numpy as np
from numpy.typing import ArrayLike

from arrays.array import SensorArray
from arrays.io.csv import Column
from arrays.io.lazy import by_name
from arrays.io.results import Result
from arrays.typing import BoolArray, FloatArray, IntArray, Vector
from magloc.fields.shapes import Shape
from magloc.localization.fit.prior import NOTHING_KNOWN, SourcePrior
from magloc.localization.fit.results import EVERYWHERE, Intervals
from magloc.measurement.nuisances import BackgroundDrift
from magloc.measurement.plausibility import usable_readings
from magloc.measurement.pose import with_stated_pose
from magloc.readings import Readings
from magloc.tracking.consistency import Consistency, InnovationTest, consistency, innovation_test
from magloc.tracking.files import QUANTITIES, columns_of_track, geojson_of_track, kml_of_track, lines_of_track
from magloc.tracking.motion import MotionModel, OrnsteinUhlenbeck, RandomWalk, known_motions
from magloc.tracking.results import SourcesPoint, TrackPoint, TrackResult, track_column, warn_of_strengths
from magloc.tracking.rows import Row, rows_of
from magloc.tracking.settled import MOST_AT_ONCE
from magloc.tracking.tracker import Tracker
from magloc.tracking.whole_records.background import track_on_background
from magloc.tracking.whole_records.body_errors import body_factor
from magloc.tracking.whole_records.constants import constants_test
from magloc.tracking.whole_records.posterior_bound import posterior_bound
from magloc.tracking.whole_records.smoother import smooth_points
from magloc.truth import Truth, truth_of_rows

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SPEED_M_S = 0.5
"""Default characteristic speed of a source."""
TURN_RAD_S = math.radians(5.0)
"""Default characteristic rate of turn of its moment."""


_Row = TypeVar("_Row", TrackPoint, SourcesPoint)


class TrackRows(Result, Sequence[_Row]):
    """Rows of a tracked record: a sequence of points with one source or several."""

    command = "track"

    points: tuple[_Row, ...]
    readings: Readings

    def __len__(self) -> int:
        return len(self.points)

    @overload
    def __getitem__(self, row: int) -> _Row: ...
    @overload
    def __getitem__(self, row: slice) -> tuple[_Row, ...]: ...
    def __getitem__(self, row: int | slice) -> _Row | tuple[_Row, ...]:
        return self.points[row]

    @property
    def frame(self) -> Literal["array", "world"]:
        """Frame of positions, moments and covariances."""
        return "array" if self.readings.array_position_m is None else "world"

    @property
    def time_s(self) -> FloatArray:
        """Instants (n,) [s]."""
        return self.readings.time_s

    @property
    @abstractmethod
    def as_result(self) -> TrackResult:
        """Tracks of all sources, for pictures and the viewer."""

    def plot(self) -> Figure:
        """Draw the tracks from above with 95 % ellipses, and coordinates and strengths over time."""
        return by_name("magloc.plots.tracks:sources_figure")(self.as_result, self.readings.array_position_m)

    def lines(self, most: int | None = None) -> list[str]:
        """Return the lines of the table, of at most `most` rows."""
        return lines_of_track(self, most=most)


class TrackColumns(TrackRows[TrackPoint]):
    """Columns of one source through a record, NaN where it is not tracked."""

    quantities = QUANTITIES

    def columns(self) -> dict[str, Column]:
        """Return the columns of track.csv."""
        return columns_of_track(self, self.readings.array_position_m)

    @cached_property
    def position_m(self) -> FloatArray:
        """Positions (n, 3) [m]."""
        return track_column(self, "position_m", 3)

    @cached_property
    def moment_Am2(self) -> FloatArray:
        """Moments (n, 3) [A·m²]."""
        return track_column(self, "moment_Am2", 3)

    @cached_property
    def covariance(self) -> FloatArray:
        """Covariances (n, 6, 6) of position and moment."""
        return track_column(self, "covariance", 6, 6)

    @cached_property
    def estimability(self) -> FloatArray:
        """Estimability (n, 6): 1 - σ / σ₀, where σ₀ is the standard deviation without any readings."""
        return track_column(self, "estimability", 6)

    @cached_property
    def nis(self) -> FloatArray:
        """Normalised innovations squared (n,)."""
        return track_column(self, "nis")

    @cached_property
    def nis_dof(self) -> IntArray:
        """Degrees of freedom of `nis` (n,)."""
        return np.array([point.nis_dof for point in self], dtype=np.intp)

    @cached_property
    def weight(self) -> FloatArray:
        """Probability that the track is the right one (n,)."""
        return track_column(self, "weight")

    @property
    def range_interval_m(self) -> list[Intervals]:
        """95 % set of the distance from the sensors' centroid [m] for each row."""
        return [point.range_interval_m or EVERYWHERE for point in self]

    @property
    def status(self) -> list[str]:
        """Use of each row, or the reason why there is no track."""
        return [point.status for point in self]

    @property
    def dropped_sensors(self) -> list[tuple[str, ...]]:
        """Sensors excluded from each row because they contradict the others."""
        return [point.dropped_sensors for point in self]

    @property
    def tracked(self) -> BoolArray:
        """Rows (n,) that a track answers; false where only the row itself does."""
        return np.array([point.is_on_track for point in self], dtype=bool)

    @property
    def as_result(self) -> TrackResult:
        """Track of the source, for pictures and the viewer."""
        return TrackResult(self.points, is_truth=False)

    def to_geojson(self, place: Vector) -> dict[str, Any]:
        """Return a GeoJSON FeatureCollection of the track.

        A source at rest is one point. A moving source has a point for each row, and a line for each unbroken part.

        A source is at rest if no row differs from the best known one by more than their uncertainties together. Its
        point and its σ are from the best row.

        Parameters
        ----------
        place : tuple of 3 floats
            Latitude, longitude [deg] and height [m] of the origin of the track's frame, which is east, north, up.

        Returns
        -------
        dict
            Coordinates are longitude, latitude [deg] and height above the ellipsoid [m], as RFC 7946 has them.
        """
        return geojson_of_track(self, place)

    def to_kml(self, place: Vector) -> str:
        """Return the track as KML: a placemark of a source at rest, otherwise a line and its ends.

        Parameters
        ----------
        place : tuple of 3 floats
            As for :meth:`to_geojson`.
        """
        return kml_of_track(self, place)


@dataclass(frozen=True, eq=False, repr=False)
class Track(TrackColumns):
    """One source through time: columns by name, and a :class:`TrackPoint` by index.

    Columns are NaN where the source is not tracked.

    Attributes
    ----------
    points : tuple of TrackPoint
        One for each row.
    readings : Readings
        Readings that were used.
    tracker : Tracker
        Filter that found the points.
    is_smoothed : bool
        Whether later rows were used too.

    Examples
    --------
    >>> import magloc
    >>> diver = magloc.datasets.load("diver")
    >>> track = magloc.track(diver.array, diver.readings[90:])
    >>> int(track.tracked.sum()), len(track), track.status[-1], track.frame
    (51, 51, 'tracked', 'world')
    """

    points: tuple[TrackPoint, ...]
    readings: Readings
    tracker: Tracker
    is_smoothed: bool = False

    @cached_property
    def _rows(self) -> list[Row]:
        return list(rows_of(self.readings))

    @cached_property
    def innovations(self) -> InnovationTest:
        """Test of the readings against the stated sensors, pose and motion."""
        test = innovation_test(self)
        if self.readings.motion is not None:  # the tests below lack its steps
            return test
        exact = constants_test(self.tracker, self._rows, self.points)
        return replace(
            test,
            z_constants=exact.mounting,
            z_ambient=exact.field,
            ambient_factor=exact.field_factor,
            body_factor=body_factor(self.tracker, self._rows, self.points),
        )

    def table(self) -> str:
        """Return the table that ``magloc track`` prints, with warnings about the track."""
        test = self.innovations
        return "\n".join([super().table(), *filter(None, (test.reason, test.caution))])

    def consistency(self, truth: Truth) -> Consistency:
        """Return errors against a truth, NEES, NIS, and the posterior Cramér-Rao bound.

        Raises
        ------
        InputError
            The truth has no time of the readings.
        """
        true = truth_of_rows(self.readings, truth)
        position_m, moment_Am2 = true.position_m, true.moment_Am2
        bound = None
        # The bound is for a constant motion model.
        known = self.readings.motion is None
        if known and moment_Am2 is not None and np.isfinite(position_m).all() and np.isfinite(moment_Am2).all():
            # Later rows lower the bound.
            with suppress(np.linalg.LinAlgError), np.errstate(over="ignore", divide="ignore", invalid="ignore"):
                bound = posterior_bound(self.tracker, self._rows, position_m, moment_Am2, smooth=self.is_smoothed)
            if bound is not None and np.isnan(bound).any():  # overflow at the truth
                bound = None
        return consistency(self, self.tracker, self._rows, position_m, moment_Am2, bound, true.sigma_m)


def track(
    array: SensorArray,
    readings: Readings | ArrayLike,
    *,
    motion: MotionModel | None = None,
    smooth: bool = False,
    prior: SourcePrior = NOTHING_KNOWN,
    magnet: Shape | None = None,
    progress: Callable[[int], None] | None = None,
    told: Callable[[TrackPoint], object] | None = None,
) -> Track:
    """Follow one source through the rows of readings.

    The track starts by itself from the first row that shows a source, and each row updates it. It ends if three rows
    in succession contradict it, or if the place is no longer known. Then a new track starts.

    Parameters
    ----------
    array : SensorArray
        Array with the positions, noise and calibration of its sensors.
    readings : Readings or array_like, shape (n, C)
        Raw readings [T], NaN where missing, in the order of time. Saturated readings are not used.
    motion : MotionModel, optional
        Motion of the source. By default :class:`magloc.RandomWalk` of 0.5 m/s and 5°/s; with `smooth`, or readings with
        a background, :class:`magloc.OrnsteinUhlenbeck` of the same. With measured velocities and rates, a random walk
        of the unmeasured rest.
    smooth : bool
        Use later rows too (fixed-interval smoother).
    prior : SourcePrior
        Bounds of the source where a track starts, and its known moment, in the array's frame.
    magnet : Shape, optional
        Shape of the source, as for :class:`Tracker`.
    progress : callable, optional
        Called with the number of rows finished since the last call.
    told : callable, optional
        Called with the point of each row: at once, or at the end if later rows are used.

    Returns
    -------
    Track
        In the world frame if the readings have the array's pose, otherwise in the array's frame.

    Raises
    ------
    ValueError
        Time does not increase from row to row, or the array has too few sensors for the prior.

    Examples
    --------
    >>> import magloc
    >>> diver = magloc.datasets.load("diver")
    >>> motion = magloc.RandomWalk(speed_m_s=1e-3, turn_rad_s=1e-3)
    >>> track = magloc.track(diver.array, diver.readings[90:], motion=motion)
    >>> round(float(track.position_m[-1, 2]), 1)
    -0.6
    """
    used = usable_readings(array, readings)
    if motion is None:
        lasting = (smooth or used.background) and used.motion is None
        motion = (OrnsteinUhlenbeck if lasting else RandomWalk)(SPEED_M_S, TURN_RAD_S)
    background = BackgroundDrift.of(used.background, used.time_s)
    tracker = Tracker(
        with_stated_pose(array, used), motion, prior=prior, magnet=magnet, keep_steps=smooth, background=background
    )
    if background is not None:
        if used.motion is not None:
            raise ValueError("Input readings must have measured velocities and rates or a background, not both.")
        points = collect_points(track_on_background(tracker, used, smooth=smooth, progress=progress), told)
    elif smooth:
        points = collect_points(smooth_points(list(_follow(tracker, used, motion, progress)), tracker.steps), told)
    else:
        points = collect_points(_follow(tracker, used, motion, progress), told)
    warn_of_strengths(points)
    return Track(points, used, tracker, smooth)


def collect_points(points: Iterable[_Row], told: Callable[[_Row], object] | None) -> tuple[_Row, ...]:
    """Report each point of a record, and return all of them."""
    found = []
    for point in points:
        found.append(point)
        if told is not None:
            told(point)
    return tuple(found)


def _follow(
    tracker: Tracker,
    readings: Readings,
    unmeasured: MotionModel,
    progress: Callable[[int], None] | None,
) -> Iterator[TrackPoint]:
    """Yield the points of a record as they are found; set a measured motion before each row."""
    rows, motions = list(rows_of(readings)), None
    if readings.motion is not None:
        if not isinstance(unmeasured, RandomWalk):
            raise ValueError(
                "Input motion must be a RandomWalk, which models the unmeasured rest, where readings have measured"
                f" velocities or rates; instead received {type(unmeasured).__name__}."
            )
        motions = known_motions(readings.motion, unmeasured)
    done = 0
    while done < len(rows):
        if motions is not None:
            tracker.motion = motions[done]
        points = tracker.advance(rows[done : done + MOST_AT_ONCE])
        yield from points
        done += len(points)
        if progress is not None:
            progress(len(points))
