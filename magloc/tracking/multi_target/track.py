"""Follow several moving sources through the rows of readings."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

from numpy.typing import ArrayLike

from arrays.array import SensorArray
from arrays.io.csv import Column
from magloc.localization.fit.prior import NOTHING_KNOWN, SourcePrior
from magloc.measurement.plausibility import usable_readings
from magloc.readings import Readings
from magloc.tracking.files import columns_of_track
from magloc.tracking.multi_target.motion import FreeMotion
from magloc.tracking.multi_target.tracker import SourcesTracker
from magloc.tracking.results import SourcesPoint, TrackPoint, TrackResult, warn_of_strengths
from magloc.tracking.rows import rows_of
from magloc.tracking.track import TrackColumns, TrackRows, collect_points


@dataclass(frozen=True, eq=False, repr=False)
class SourceTrack(TrackColumns):
    """One of several sources through time: columns, NaN where it is not tracked."""

    points: tuple[TrackPoint, ...]
    readings: Readings
    id: int


@dataclass(frozen=True, eq=False, repr=False)
class SourcesTrack(TrackRows[SourcesPoint]):
    """Several sources through time: all of them in a row, or one of them through all rows.

    Attributes
    ----------
    points : tuple of SourcesPoint
        One for each row.
    readings : Readings
        Readings that were used.

    Examples
    --------
    >>> import magloc
    >>> board = magloc.datasets.load("board")
    >>> track = magloc.track_sources(board.array, board.readings[:20], sources=2)
    >>> track.ids, len(track), track[-1].status  # gains that are not exact leave more than noise
    ((1,), 20, 'doubtful')
    >>> track.of(1).position_m[-1].round(2)
    array([ 0.05, -0.03,  0.1 ])
    """

    points: tuple[SourcesPoint, ...]
    readings: Readings

    @cached_property
    def ids(self) -> tuple[int, ...]:
        """Ids of all sources, in the order in which they were first reported."""
        return tuple(sorted({track.id for point in self for track in point.tracks}))

    @property
    def dropped_sensors(self) -> tuple[str, ...]:
        """Sensors that are excluded from at least one row."""
        return tuple(sorted({name for point in self for name in point.dropped_sensors}))

    def of(self, id: int) -> SourceTrack:
        """Return one source through all rows.

        Raises
        ------
        KeyError
            No source has that id.
        """
        if id not in self.ids:
            raise KeyError(f"Input id must be one of {self.ids}; instead received {id}.")
        points = []
        for point in self:
            own = [track for track in point.tracks if track.id == id]
            points.append(own[0] if own else TrackPoint(point.time_s, status=point.status))
        return SourceTrack(tuple(points), self.readings, id)

    def columns(self) -> dict[str, Column]:
        """Return the columns of track.csv: a row for each source of each row."""
        known = [track for point in self for track in point.tracks]
        return columns_of_track(known, ids=[track.id for track in known])

    @property
    def as_result(self) -> TrackResult:
        """Tracks of all sources, for pictures and the viewer."""
        tracks = [self.of(id).points for id in self.ids] or [tuple(TrackPoint(point.time_s) for point in self)]
        ids = self.ids if len(tracks) > 1 else ()
        return TrackResult(tracks[0], is_truth=False, ids=ids, others=tuple(tracks[1:]))


def track_sources(
    array: SensorArray,
    readings: Readings | ArrayLike,
    *,
    sources: int | Literal["auto"] = "auto",
    motion: FreeMotion = FreeMotion(),  # noqa: B008 - frozen
    prior: SourcePrior = NOTHING_KNOWN,
    progress: Callable[[int], None] | None = None,
    told: Callable[[SourcesPoint], object] | None = None,
) -> SourcesTrack:
    """Follow several moving sources through the rows of readings, in one joint filter.

    Each reading is a sum over all sources, so that there is no data association; crossing sources are distinguished by
    their motion. A source is added if the readings support another, and removed if they support one fewer. A sensor
    that fails is reported, and excluded until it recovers.

    Parameters
    ----------
    array : SensorArray
        Array of vector sensors.
    readings : Readings or array_like, shape (n, C)
        Raw readings [T], NaN where missing, in the order of time. Those that saturate are not used.
    sources : int or "auto"
        Largest number of sources; "auto": five, or as many as the array can determine. More than five are searched for
        in the first row, as by :func:`locate`, which takes seconds.
    motion : FreeMotion
        Motion of each source.
    prior : SourcePrior
        Bounds of every source in the array's frame, and its strength, if known.
    progress : callable, optional
        Called with the number of rows finished since the last call.
    told : callable, optional
        Called with the point of each row at once.

    Returns
    -------
    SourcesTrack
        In the world frame if the readings have the array's pose, otherwise in the array's frame.

    Raises
    ------
    ValueError
        Time does not increase from row to row, the readings have a background, or the array has a scalar sensor or
        cannot determine that many sources.

    Examples
    --------
    >>> import magloc
    >>> board = magloc.datasets.load("board")
    >>> track = magloc.track_sources(board.array, board.readings[:30])
    >>> track.ids, len(track)
    ((1,), 30)
    """
    used = usable_readings(array, readings)
    if used.background or used.motion is not None:
        raise ValueError("Input readings must have neither a background nor measured velocities for several sources.")
    tracker = SourcesTracker(array, sources=sources, motion=motion, prior=prior)

    def follow() -> Iterator[SourcesPoint]:
        for row in rows_of(used):
            yield tracker.update(row)
            if progress is not None:
                progress(1)

    points = collect_points(follow(), told)
    warn_of_strengths(track for point in points for track in point.tracks)
    return SourcesTrack(points, used)
