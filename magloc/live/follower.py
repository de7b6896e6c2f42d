"""A source followed through rows that come in, whatever they come as."""

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
from arrays.io.errors import InputError, check_not_negative
from magloc.ambient import Place, in_world_field, with_ambient_field
from magloc.live.rest import Background, refuse_rest
from magloc.live.rows import RowParser
from magloc.live.tally import Clock, Pace, Tally
from magloc.live.transports import STANDARD_INPUT, Stream, opened, sender_waits
from magloc.localization.fit.prior import NOTHING_KNOWN, SourcePrior
from magloc.measurement.differences import predicted_channels, suitable_dipole
from magloc.measurement.plausibility import FEWEST_ROWS, warn_of_array, warn_of_record
from magloc.measurement.pose import with_stated_pose
from magloc.measurement.rows import concatenate_readings
from magloc.readings import EXPECTED_HEADER, Readings, log_format, without_saturated
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
# Rows that may wait while several sources are followed before all but the newest are skipped.
_MOST_WAITING = 200
# Longest time that a row may have waited, where whoever sends does not: older ones are skipped.
_LONGEST_WAIT_S = 0.5
RESTING, STOPPED, SKIPPED = "rest: the background is taken", "stopped", "skipped: newer rows were waiting"
Source = str | Iterable["Readings | Mapping[str, float | None] | str"]


@dataclass(frozen=True, eq=False)
class LivePoint(TrackPoint):
    """What is known of the source at one instant, and of the stream that tells it.

    Attributes
    ----------
    time_s, position_m, moment_Am2, covariance, estimability, iterations
        As of every point of a track.
    nis, nis_dof, status, weight, rivals, centroid_m, radius_m, lag1, correction, dropped_sensors, mixture
        The same.
    row : Row
        Readings and pose that it was found from, without the background of a rest.
    latency_s : float
        From the arrival of the row to this answer.
    tally : Tally
        Of the whole stream, as it is now.
    sources : SourcesPoint, optional
        What is known of several sources, where they are followed: time and status are then all that the point itself
        says.

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


_OF_POINT = tuple(each.name for each in fields(TrackPoint))


class Follower:
    """Follows sources through a stream that may be stopped, started and tared meanwhile, from another thread too.

    Parameters
    ----------
    array : SensorArray
    motion : MotionModel or FreeMotion, optional
        By default :class:`magloc.RandomWalk` of 0.5 m/s and 5°/s; of several sources it is a
        :class:`magloc.FreeMotion`.
    sources : int or "auto", optional
        How many sources are followed in one filter, as by :class:`magloc.SourcesTracker`; by default one on its own.
    prior : SourcePrior
        Bounds for the fixes that start a track, in the array's frame.
    sensors : sequence of str, optional
        Ids of the array's sensors, where the stream has columns of others too.
    place : Place, optional
        Where and when the geomagnetic field is wanted.
    rest_s : float
        How long the array is at rest, without a source, before it is followed [s].

    Attributes
    ----------
    tally : Tally
        Of all rows so far.
    moves : bool
        Whether rows have the array's pose.

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
        motion: MotionModel | FreeMotion | None = None,
        *,
        sources: int | Literal["auto"] | None = None,
        prior: SourcePrior = NOTHING_KNOWN,
        sensors: Sequence[str] | None = None,
        place: Place | None = None,
        rest_s: float = 0.0,
    ) -> None:
        check_not_negative(rest_s=rest_s)
        self.array, self.prior, self.tally = array, prior, Tally()
        self._motion, self._sources = motion, sources
        if sources is not None or isinstance(motion, FreeMotion):
            self._new_tracker(array)  # whether the array can tell them
        self._sensors, self._place = sensors, place
        self._in_field: SensorArray | None = None
        self._tracker: Tracker | SourcesTracker | None = None
        self._clock = Clock(self.tally, self.restart)
        self._background: Background | None = None
        self._rest_rows: list[Row] = []
        self._rest_s = 0.0
        self._first_rows: list[Readings] = []
        self._first_points: list[TrackPoint] = []
        self._stopped = self.moves = False
        if rest_s:
            self.tare(rest_s)

    def tare(self, rest_s: float) -> None:
        """Take what the next seconds read as the background, and start anew behind them.

        Raises
        ------
        InputError
            The array moves, or has scalar sensors, whose readings are not linear in the field.
        """
        refuse_rest(self.array, moves=self.moves)
        self._rest_rows, self._rest_s = [], rest_s

    def stop(self) -> None:
        """Follow nothing until :meth:`start`; rows are still taken and counted."""
        self._stopped = True

    def start(self) -> None:
        """Follow again, from a new start."""
        self.restart()
        self._stopped = False

    def restart(self) -> None:
        """Begin a new track at the next row, and a rest that is not over anew."""
        self._tracker, self._rest_rows = None, []

    def follow(self, source: Source, *, replay_speed: float = 1.0) -> Generator[LivePoint]:
        """Points of all rows of a source, each as soon as it is known; as :func:`magloc.live.track`."""
        if not isinstance(source, str):
            yield from self._follow_rows(source)
            return
        waits = sender_waits(source)
        if not waits:
            self._load()
        with opened(source, replay_speed=replay_speed, form=log_format(self.array, self._sensors)) as stream:
            yield from self._follow_stream(stream, waits=waits, is_file=source != STANDARD_INPUT and waits)

    def _load(self) -> None:
        """Load what a track needs, by following a made source, while nobody waits yet."""
        values_T = predicted_channels(self.array, *suitable_dipole(self.array)) + self.array.channel_offset_T
        tracker = self._new_tracker(self.array)
        for i in range(_ROWS_TO_LOAD):
            _next_points(tracker, [Row(float(i), values_T)])

    def _new_tracker(self, array: SensorArray) -> Tracker | SourcesTracker:
        """A filter of what is to be followed."""
        motion = self._motion
        if self._sources is None:
            if isinstance(motion, FreeMotion):
                raise ValueError("Input motion must be a motion of one source where sources are not given.")
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
        for batch in stream.batches:
            self.tally.drop(batch.dropped, stream.name)
            for readings in parser.rows_of(batch.lines, batch.sender):
                stream.accept(batch.sender)
                yield from self._answers(readings, batch.arrived_s, pace)
            if parser.has_header_of(batch.sender):
                stream.accept(batch.sender)
        self._refuse_nothing(parser, stream.name)

    def _follow_rows(self, source: Iterable[Readings | Mapping[str, float | None] | str]) -> Generator[LivePoint]:
        parser = RowParser(self.array, "the rows", self.tally, self._sensors)
        for row in source:
            arrived = time.perf_counter()
            if isinstance(row, Readings):
                yield from self._answers(row, arrived)
                continue
            line = row.encode() if isinstance(row, str) else msgspec.json.encode(row)
            for readings in parser.rows_of([line]):
                yield from self._answers(readings, arrived)
        if self.tally.garbled:
            self._refuse_nothing(parser, "the rows")

    def _refuse_nothing(self, parser: RowParser, name: str) -> None:
        """Raise InputError at the end of a stream without a row."""
        if self.tally.rows:
            return
        if self.tally.garbled:
            fault = parser.fault.rstrip(".")
            raise InputError(f"{name}: found garbled lines alone ({self.tally.garbled}), expected rows ({fault}).")
        if parser.has_header:
            raise InputError(f"{name}, line 1: found a header without rows, expected a row below it.")
        raise InputError(f"{name}: found nothing, expected {EXPECTED_HEADER}.")

    def _answers(self, readings: Readings, arrived: float, pace: Pace | None = None) -> Generator[LivePoint]:
        """Answers to the rows that are new; with a pace those alone that can be followed in time."""
        new = np.array([self._clock.takes(time_s) for time_s in readings.time_s.tolist()], dtype=bool)
        rows = self._rows(readings[new]) if new.any() else []
        while rows:
            skipped = self.tally.skipped
            is_late = time.perf_counter() - arrived > _LONGEST_WAIT_S
            answers = self._next_answers(rows, waits=pace is None, is_late=is_late)
            if pace is not None:
                skipped = self.tally.skipped - skipped
                pace.count(len(answers) - skipped, skipped)
            for row, point in answers:
                latency_s = time.perf_counter() - arrived
                self.tally.latencies_s.append(latency_s)
                known: dict[str, Any]
                self.tally.tracked += bool(_known_sources(point))
                if isinstance(point, SourcesPoint):
                    of_all = {"nis": point.chi2, "nis_dof": point.dof, "dropped_sensors": point.dropped_sensors}
                    known = {"time_s": point.time_s, "status": point.status, "sources": point, **of_all}
                else:
                    known = {name: getattr(point, name) for name in _OF_POINT}
                self._doubt(point)
                yield LivePoint(**known, row=row, latency_s=latency_s, tally=self.tally)
            rows = rows[len(answers) :]

    def _rows(self, readings: Readings) -> list[Row]:
        """Rows in their ambient field, without what saturates."""
        if self._in_field is None:
            array, ambient_T = with_ambient_field(self.array, readings, self._place, gradient=False)
            if ambient_T is not None and readings.ambient_T is None and readings.array_rotation is not None:
                x, y, z = readings.array_rotation[0].apply(ambient_T[0]).tolist()
                array = replace(array, ambient_world_T=(x, y, z))
            self._in_field, self.moves = with_stated_pose(array, readings), readings.pose is not None
            if self._rest_s:
                refuse_rest(array, moves=self.moves)
            warn_of_array(self._in_field)
        used = in_world_field(without_saturated(readings, self._in_field), self._in_field)
        if sum(map(len, self._first_rows)) < FEWEST_ROWS:
            first = (self._first_rows or [readings])[0]
            if (first.pose is None, first.ambient_T is None) == (readings.pose is None, readings.ambient_T is None):
                self._first_rows.append(readings)
            if sum(map(len, self._first_rows)) >= FEWEST_ROWS:
                warn_of_record(self._in_field, concatenate_readings(self._first_rows))
        if self._in_field.pose is None:
            return list(rows_of(used))
        return [row for one in used for row in rows_of(one)]  # whose motion is that since the row before

    def _doubt(self, point: TrackPoint | SourcesPoint) -> None:
        """Warn once of moments that no object has, after as many points of a track as a record is judged by."""
        if len(self._first_points) < FEWEST_ROWS:
            tracks = _known_sources(point)[:1]
            self._first_points += tracks
            if tracks and len(self._first_points) == FEWEST_ROWS:
                warn_of_strengths(self._first_points)

    def _next_answers(
        self, rows: Sequence[Row], *, waits: bool, is_late: bool
    ) -> list[tuple[Row, TrackPoint | SourcesPoint]]:
        """The first of the rows, or some of them, with what is known of the source there."""
        if self._stopped:
            return self._without_track(rows, STOPPED)
        if self._rest_s and self._rests(rows[0]):
            return self._without_track(rows[:1], RESTING)
        if self._tracker is None:
            assert self._in_field is not None
            array = self._in_field if self._background is None else self._background.array(self._in_field)
            self._tracker = self._new_tracker(array)
        if isinstance(self._tracker, SourcesTracker):
            is_quick = len(rows) <= _MOST_WAITING  # where one is born, some wait
        else:
            is_quick = self._tracker.is_compiled
        if len(rows) > 1 and not waits and (is_late or not is_quick):
            self.tally.skipped += len(rows) - 1
            return self._without_track(rows[:-1], SKIPPED)
        if self._background is not None:
            rows = [self._background.subtracted(row) for row in rows]
        return list(zip(rows, _next_points(self._tracker, rows), strict=False))

    def _without_track(self, rows: Sequence[Row], status: str) -> list[tuple[Row, TrackPoint | SourcesPoint]]:
        """Rows of which nothing is asked."""
        if self._sources is None:
            return [(row, TrackPoint(row.time_s, status=status)) for row in rows]
        return [(row, SourcesPoint(row.time_s, (), status, math.nan, 0)) for row in rows]

    def _rests(self, row: Row) -> bool:
        """Whether a row belongs to the rest; the first one behind it makes the background of it."""
        rest = self._rest_rows
        if not rest or row.time_s - rest[0].time_s < self._rest_s:
            rest.append(row)
            return True
        self._background = Background.of(self.array, rest)
        self._rest_s = 0.0
        self.restart()
        return False


def _known_sources(point: TrackPoint | SourcesPoint) -> Sequence[TrackPoint]:
    """Sources that rows before tell of as well."""
    return [track for track in point.tracks if track.is_on_track]


def _next_points(tracker: Tracker | SourcesTracker, rows: Sequence[Row]) -> Sequence[TrackPoint | SourcesPoint]:
    """What is known at the first of the rows, or at some of them."""
    return [tracker.update(rows[0])] if isinstance(tracker, SourcesTracker) else tracker.advance(rows[:MOST_AT_ONCE])


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
    """Follow one source, or several, while their readings come in.

    Rows are CSV, whose first line is a header with the columns of a readings file, or JSON objects with these names.
    Those that are late, doubled or garbled are counted in the tally and left out; none ends the stream.

    Parameters
    ----------
    source : str or iterable
        ``"-"`` (standard input), ``"tcp://HOST:PORT"`` (to connect to), ``"udp://HOST:PORT"`` (to listen at),
        ``"serial:DEVICE@BAUD"`` (needs the extra ``serial``) or ``"replay:FILE"`` (a readings file in its own time); or
        rows: :class:`magloc.Readings`, mappings from the names of columns to numbers, or lines of text.
    array : SensorArray
    motion : MotionModel or FreeMotion, optional
        By default :class:`magloc.RandomWalk` of 0.5 m/s and 5°/s; of several sources it is a
        :class:`magloc.FreeMotion`.
    sources : int or "auto", optional
        How many sources are followed in one filter, as by :class:`magloc.SourcesTracker`: points then have them in
        `sources`. By default it is one on its own.
    prior : SourcePrior
        Bounds for the fixes that start a track, in the array's frame.
    rest_s : float
        For so long [s] the array is at rest and no source is near: what it reads then is taken off all later readings.
    replay_speed : float
        How much faster than in its own time a file is replayed.

    Yields
    ------
    LivePoint
        Of every row that is used, as soon as it is known: a :class:`TrackPoint` with its row, latency and tally.

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
