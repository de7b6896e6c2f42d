"""Tracking of sources while their rows come in."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Generator, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal

import msgspec
import numpy as np

from arrays.array import SensorArray
from arrays.io.errors import check_not_negative
from magloc.ambient import Place, in_world_field, with_ambient_field
from magloc.bodies.body import MagnetBody
from magloc.bodies.filter import BodyTracker
from magloc.bodies.track import BodyMotion
from magloc.live import body as bodies
from magloc.live.rest import RestBackground, check_rest
from magloc.live.rows import RowParser, rows_of_stream
from magloc.live.tally import Clock, Pace, Tally
from magloc.live.transports import STANDARD_INPUT, Stream, open_stream, sender_waits
from magloc.localization.fit.prior import NOTHING_KNOWN, SourcePrior
from magloc.measurement.differences import predicted_channels, suitable_dipole
from magloc.measurement.plausibility import FEWEST_ROWS, warn_of_array, warn_of_record
from magloc.measurement.pose import with_stated_pose
from magloc.measurement.rows import concatenate_readings
from magloc.readings import Readings, log_format, without_saturated
from magloc.tracking.motion import MotionModel, RandomWalk
from magloc.tracking.multi_target.motion import FreeMotion
from magloc.tracking.multi_target.tracker import SourcesTracker
from magloc.tracking.results import SourcesPoint, TrackPoint, warn_of_strengths
from magloc.tracking.rows import Row, rows_of
from magloc.tracking.settled import MOST_AT_ONCE
from magloc.tracking.track import SPEED_M_S, TURN_RAD_S
from magloc.tracking.tracker import Tracker

_LOG = logging.getLogger(__name__)
_ROWS_TO_LOAD = 3
# Rows that may wait while several sources are tracked; above this number all but the newest are skipped.
_MOST_WAITING = 200
# Older rows are skipped where the sender does not wait.
_LONGEST_WAIT_S = 0.5
RESTING, STOPPED, SKIPPED = "rest: the background is taken", "stopped", "skipped: newer rows were waiting"
AnyTracker = Tracker | SourcesTracker | BodyTracker
Source = str | Iterable["Readings | Mapping[str, float | None] | str"]


@dataclass(frozen=True, eq=False)
class LivePoint(TrackPoint):
    """State of the source at one instant, with the row and the counts of the stream.

    Attributes
    ----------
    time_s, position_m, moment_Am2, covariance, estimability, iterations
        See :class:`TrackPoint`.
    nis, nis_dof, status, weight, rivals, centroid_m, radius_m, lag1, correction, dropped_sensors, mixture
        See :class:`TrackPoint`.
    row : Row
        Readings and pose of the row, minus the background of a rest.
    latency_s : float
        Time from the arrival of the row to this point [s].
    tally : Tally
        Counts of the whole stream so far.
    sources : SourcesPoint, optional
        States of several sources, or of a body, if they are tracked. The point itself then has no state,
        only the time, the status, the NIS and the dropped sensors.

    Examples
    --------
    >>> import magloc
    >>> diver = magloc.datasets.load("diver")
    >>> first = next(iter(magloc.live.track(diver.readings, diver.array)))
    >>> first.status, first.row.time_s
    ('not acquired: no signal stands out of noise', 0.0)
    """

    row: Row = field(kw_only=True)
    latency_s: float = field(kw_only=True)
    tally: Tally = field(kw_only=True)
    sources: SourcesPoint | None = None


_POINT_FIELDS = tuple(each.name for each in fields(TrackPoint))


class Follower:
    """Tracker of sources in a stream. Any thread may stop, start and tare it meanwhile.

    Parameters
    ----------
    array : SensorArray
        Array with the positions, noise and calibration of its sensors.
    motion : MotionModel, FreeMotion or BodyMotion, optional
        Motion of the source; by default :class:`magloc.RandomWalk` of 0.5 m/s and 5°/s. Several sources need a
        :class:`magloc.FreeMotion`, a body needs a :class:`magloc.bodies.track.BodyMotion`.
    sources : int or "auto", optional
        Number of sources in one filter, as for :class:`magloc.SourcesTracker`; by default a filter of one source.
    prior : SourcePrior
        Bounds for the fixes that start a track, in the array's frame.
    sensors : sequence of str, optional
        Ids of the sensors that are used; other columns of the stream are ignored.
    place : Place, optional
        Place and date of the geomagnetic field.
    rest_s : float
        Duration of the rest, without a source near, before tracking begins [s].
    body : MagnetBody, optional
        Body of several magnets to track, in the array's frame; points then have a
        :class:`magloc.live.body.BodyPoint` in `sources`.

    Attributes
    ----------
    tally : Tally
        Counts of all rows so far.
    moves : bool
        Whether the rows have poses of the array.

    Examples
    --------
    >>> import magloc
    >>> diver = magloc.datasets.load("diver")
    >>> follower = magloc.live.Follower(diver.array, magloc.RandomWalk(1e-3, 1e-3))
    >>> points = list(follower.follow(diver.readings[90:]))
    >>> follower.tally.rows, points[-1].status
    (51, 'tracked')
    """

    def __init__(
        self,
        array: SensorArray,
        motion: MotionModel | FreeMotion | BodyMotion | None = None,
        *,
        sources: int | Literal["auto"] | None = None,
        prior: SourcePrior = NOTHING_KNOWN,
        sensors: Sequence[str] | None = None,
        place: Place | None = None,
        rest_s: float = 0.0,
        body: MagnetBody | None = None,
    ) -> None:
        check_not_negative(rest_s=rest_s)
        self.array, self.prior, self.tally = array, prior, Tally()
        self._motion, self._sources, self._body = motion, sources, body
        if sources is not None or body is not None or isinstance(motion, FreeMotion):
            self._new_tracker(array)  # raises an error for an array that cannot resolve the sources
        self._sensors, self._place = sensors, place
        self._in_field: SensorArray | None = None
        self._tracker: AnyTracker | None = None
        self._clock = Clock(self.tally, self.restart)
        self._background: RestBackground | None = None
        self._rest_rows: list[Row] = []
        self._rest_s = 0.0
        self._first_rows: list[Readings] = []
        self._first_points: list[TrackPoint] = []
        self._stopped = self.moves = False
        if rest_s:
            self.tare(rest_s)

    def tare(self, rest_s: float) -> None:
        """Take the mean of the next seconds as the background, and restart the track after them.

        Raises
        ------
        InputError
            The array moves, or has scalar sensors, whose readings are not linear in the field.
        """
        check_rest(self.array, moves=self.moves)
        self._rest_rows, self._rest_s = [], rest_s

    def stop(self) -> None:
        """Stop tracking until :meth:`start`; rows are still counted."""
        self._stopped = True

    def start(self) -> None:
        """Restart tracking with a new track."""
        self.restart()
        self._stopped = False

    def restart(self) -> None:
        """Begin a new track at the next row, and repeat a rest that is not over."""
        self._rest_rows = []
        if isinstance(self._tracker, BodyTracker):
            self._tracker.restart()  # what it has learnt of lasting errors stays
        else:
            self._tracker = None

    def follow(self, source: Source, *, replay_speed: float = 1.0) -> Generator[LivePoint]:
        """Yield a point for every row of a source; see :func:`magloc.live.track`."""
        if not isinstance(source, str):
            yield from self._follow_rows(source)
            return
        waits = sender_waits(source)
        if not waits:
            self._load()
        with open_stream(source, replay_speed=replay_speed, form=log_format(self.array, self._sensors)) as stream:
            yield from self._follow_stream(stream, waits=waits, is_file=source != STANDARD_INPUT and waits)

    def _load(self) -> None:
        """Track a simulated source, so that all modules are loaded before the first row."""
        values_T = predicted_channels(self.array, *suitable_dipole(self.array)) + self.array.channel_offset_T
        tracker = self._new_tracker(self.array)
        for i in range(_ROWS_TO_LOAD):
            _next_points(tracker, [Row(float(i), values_T)])

    def _new_tracker(self, array: SensorArray) -> AnyTracker:
        """Return a new filter for the sources."""
        motion = self._motion
        if self._body is not None:
            if not isinstance(motion, BodyMotion | None) or self._sources is not None:
                raise ValueError(
                    "Input motion must be a BodyMotion, without sources, for a body; instead received"
                    f" {motion} and sources={self._sources}."
                )
            return BodyTracker(array, self._body, motion)
        if self._sources is None:
            if isinstance(motion, FreeMotion | BodyMotion):
                raise ValueError(
                    "Input motion must be a motion of one source where sources are not given; instead received"
                    f" {motion}."
                )
            return Tracker(array, RandomWalk(SPEED_M_S, TURN_RAD_S) if motion is None else motion, prior=self.prior)
        motion = FreeMotion() if motion is None else motion
        if not isinstance(motion, FreeMotion):
            raise ValueError(f"Input motion must be a FreeMotion for several sources; instead received {motion}.")
        return SourcesTracker(array, sources=self._sources, motion=motion, prior=self.prior)

    def _follow_stream(self, stream: Stream, *, waits: bool, is_file: bool = False) -> Generator[LivePoint]:
        parser = RowParser(self.array, stream.name, self.tally, self._sensors, is_file=is_file)
        pace = None if waits else Pace(stream.name)
        if not waits:
            _LOG.info(f"{stream.name}: waiting for rows")
        for readings, arrival_s in rows_of_stream(stream, parser, self.tally):
            yield from self._track_rows(readings, arrival_s, pace)

    def _follow_rows(self, source: Iterable[Readings | Mapping[str, float | None] | str]) -> Generator[LivePoint]:
        parser = RowParser(self.array, "the rows", self.tally, self._sensors)
        for row in source:
            arrival_s = time.perf_counter()
            if isinstance(row, Readings):
                yield from self._track_rows(row, arrival_s)
                continue
            line = row.encode() if isinstance(row, str) else msgspec.json.encode(row)
            for readings in parser.parse([line]):
                yield from self._track_rows(readings, arrival_s)
        if self.tally.garbled:
            parser.check_not_empty()

    def _track_rows(self, readings: Readings, arrival_s: float, pace: Pace | None = None) -> Generator[LivePoint]:
        """Yield the points of new rows; with a pace, skip rows that cannot be tracked in time."""
        new = np.array([self._clock.accepts(time_s) for time_s in readings.time_s.tolist()], dtype=bool)
        rows = self._prepare(readings[new]) if new.any() else []
        while rows:
            skipped = self.tally.skipped
            is_late = time.perf_counter() - arrival_s > _LONGEST_WAIT_S
            points = self._track_next(rows, waits=pace is None, is_late=is_late)
            if pace is not None:
                skipped = self.tally.skipped - skipped
                pace.count(len(points) - skipped, skipped)
            for row, point in points:
                latency_s = time.perf_counter() - arrival_s
                self.tally.latencies_s.append(latency_s)
                state: dict[str, Any]
                self.tally.tracked += bool(_established_tracks(point))
                if isinstance(point, SourcesPoint):
                    joint = {"nis": point.chi2, "nis_dof": point.dof, "dropped_sensors": point.dropped_sensors}
                    state = {"time_s": point.time_s, "status": point.status, "sources": point, **joint}
                else:
                    state = {name: getattr(point, name) for name in _POINT_FIELDS}
                self._check_strengths(point)
                yield LivePoint(**state, row=row, latency_s=latency_s, tally=self.tally)
            rows = rows[len(points) :]

    def _prepare(self, readings: Readings) -> list[Row]:
        """Return the rows in their ambient field, without saturated readings."""
        if self._in_field is None:
            array, ambient_T = with_ambient_field(self.array, readings, self._place, gradient=False)
            if ambient_T is not None and readings.ambient_T is None and readings.array_rotation is not None:
                x, y, z = readings.array_rotation[0].apply(ambient_T[0]).tolist()
                array = replace(array, ambient_world_T=(x, y, z))
            self._in_field, self.moves = with_stated_pose(array, readings), readings.pose is not None
            if self._body is not None:  # its pose is in the array's frame
                self._in_field = replace(array, pose=None)
            if self._rest_s:
                check_rest(array, moves=self.moves)
            warn_of_array(self._in_field)
        used = in_world_field(without_saturated(readings, self._in_field), self._in_field)
        if sum(map(len, self._first_rows)) < FEWEST_ROWS:
            first = (self._first_rows or [readings])[0]
            if (first.pose is None, first.ambient_T is None) == (readings.pose is None, readings.ambient_T is None):
                self._first_rows.append(readings)
            if sum(map(len, self._first_rows)) >= FEWEST_ROWS:
                warn_of_record(self._in_field, concatenate_readings(self._first_rows))
        if self._body is not None:
            used = replace(used, array_position_m=None, array_rotation=None, pose_sigma=None)
        if self._in_field.pose is None:
            return list(rows_of(used))
        return [row for one in used for row in rows_of(one)]  # the motion of a row is that since the previous one

    def _check_strengths(self, point: TrackPoint | SourcesPoint) -> None:
        """Warn once of implausible moments, after the first points of a track."""
        if len(self._first_points) < FEWEST_ROWS:
            tracks = _established_tracks(point)[:1]
            self._first_points += tracks
            if tracks and len(self._first_points) == FEWEST_ROWS:
                warn_of_strengths(self._first_points)

    def _track_next(
        self, rows: Sequence[Row], *, waits: bool, is_late: bool
    ) -> list[tuple[Row, TrackPoint | SourcesPoint]]:
        """Track the first row, or the first few, and return them with their points."""
        if self._stopped:
            return self._without_track(rows, STOPPED)
        if self._rest_s and self._take_rest(rows[0]):
            return self._without_track(rows[:1], RESTING)
        if self._tracker is None:
            assert self._in_field is not None
            array = (
                self._in_field if self._background is None else self._background.with_offset_uncertainty(self._in_field)
            )
            self._tracker = self._new_tracker(array)
        if isinstance(self._tracker, SourcesTracker):
            is_quick = len(rows) <= _MOST_WAITING  # some rows wait while a new track starts
        else:
            is_quick = self._tracker.is_compiled
        if len(rows) > 1 and not waits and (is_late or not is_quick):
            self.tally.skipped += len(rows) - 1
            return self._without_track(rows[:-1], SKIPPED)
        if self._background is not None:
            rows = [self._background.subtract_from(row) for row in rows]
        return list(zip(rows, _next_points(self._tracker, rows), strict=False))

    def _without_track(self, rows: Sequence[Row], status: str) -> list[tuple[Row, TrackPoint | SourcesPoint]]:
        """Return rows with points that have only a status."""
        if self._body is not None:
            return list(zip(rows, bodies.without_pose(self._body, rows, status), strict=True))
        if self._sources is None:
            return [(row, TrackPoint(row.time_s, status=status)) for row in rows]
        return [(row, SourcesPoint(row.time_s, (), status, math.nan, 0)) for row in rows]

    def _take_rest(self, row: Row) -> bool:
        """Return whether a row belongs to the rest; the first row after it sets the background."""
        rest = self._rest_rows
        if not rest or row.time_s - rest[0].time_s < self._rest_s:
            rest.append(row)
            return True
        self._background = RestBackground.from_rows(self.array, rest)
        self._rest_s = 0.0
        self.restart()
        self._tracker = None  # the offsets have other uncertainties
        return False


def _established_tracks(point: TrackPoint | SourcesPoint) -> Sequence[TrackPoint]:
    """Return the sources that earlier rows confirm."""
    return [track for track in point.tracks if track.is_on_track]


def _next_points(tracker: AnyTracker, rows: Sequence[Row]) -> Sequence[TrackPoint | SourcesPoint]:
    """Update the tracker with the first row, or with the first few, and return their points."""
    if isinstance(tracker, SourcesTracker):
        return [tracker.update(rows[0])]
    rows = rows[:MOST_AT_ONCE]
    return bodies.advance(tracker, rows) if isinstance(tracker, BodyTracker) else tracker.advance(rows)


def track(
    source: Source,
    array: SensorArray,
    *,
    motion: MotionModel | FreeMotion | None = None,
    sources: int | Literal["auto"] | None = None,
    prior: SourcePrior = NOTHING_KNOWN,
    rest_s: float = 0.0,
    replay_speed: float = 1.0,
) -> Generator[LivePoint]:
    """Track one source, or several, while their readings come in.

    Rows are CSV below a header with the columns of a readings file, or JSON objects with these names. Late, doubled and
    garbled rows are counted in the tally and skipped; they never end the stream.

    Parameters
    ----------
    source : str or iterable
        ``"-"`` (standard input), ``"tcp://HOST:PORT"`` (to connect to), ``"udp://HOST:PORT"`` (to listen at),
        ``"serial:DEVICE@BAUD"`` (needs the extra ``serial``) or ``"replay:FILE"`` (a readings file at the times of its
        rows); or rows: :class:`magloc.Readings`, mappings from the names of columns to numbers, or lines of text.
    array : SensorArray
        Array with the positions, noise and calibration of its sensors.
    motion : MotionModel or FreeMotion, optional
        Motion of the source; by default :class:`magloc.RandomWalk` of 0.5 m/s and 5°/s. Several sources need a
        :class:`magloc.FreeMotion`.
    sources : int or "auto", optional
        Number of sources in one filter, as for :class:`magloc.SourcesTracker`; points then have them in `sources`. By
        default a filter of one source.
    prior : SourcePrior
        Bounds for the fixes that start a track, in the array's frame.
    rest_s : float
        Duration of a rest at the beginning, without a source near; its mean is subtracted from all later readings [s].
    replay_speed : float
        Speed of the replay of a file, relative to the times of its rows.

    Yields
    ------
    LivePoint
        A :class:`TrackPoint` with row, latency and tally, for every row that is used.

    Raises
    ------
    InputError
        The source cannot be opened, ends without a row, or has the columns of another array.

    Examples
    --------
    >>> import magloc
    >>> diver = magloc.datasets.load("diver")
    >>> motion = magloc.RandomWalk(speed_m_s=1e-3, turn_rad_s=1e-3)
    >>> for point in magloc.live.track(diver.readings[90:], diver.array, motion=motion):
    ...     pass
    >>> point.status, round(float(point.position_m[2]), 1), point.tally.lost
    ('tracked', -0.6, 0)
    """
    follower = Follower(array, motion, sources=sources, prior=prior, rest_s=rest_s)
    return follower.follow(source, replay_speed=replay_speed)
