"""Tracking of a body of several magnets while its rows come in."""

from __future__ import annotations

import time
from collections.abc import Generator, Sequence

import numpy as np

from magloc.ambient import Place, in_world_field, with_ambient_field
from magloc.bodies.filter import BodyTracker
from magloc.bodies.track import BodyTrack
from magloc.live.rows import RowParser, rows_of_stream
from magloc.live.tally import Clock, Tally
from magloc.live.transports import STANDARD_INPUT, open_stream, sender_waits
from magloc.readings import log_format, without_saturated


def follow_body(
    tracker: BodyTracker,
    source: str,
    tally: Tally,
    *,
    sensors: Sequence[str] | None = None,
    place: Place | None = None,
    replay_speed: float = 1.0,
) -> Generator[tuple[BodyTrack, float]]:
    """Yield the tracks of new rows of a stream, and the time at which they arrived; see :func:`magloc.live.track`.

    Late, doubled and garbled rows are counted in the tally and skipped.
    """
    array, waits = tracker.array, sender_waits(source)
    clock = Clock(tally, tracker.restart)
    with open_stream(source, replay_speed=replay_speed, form=log_format(array, sensors)) as stream:
        parser = RowParser(array, stream.name, tally, sensors, is_file=source != STANDARD_INPUT and waits)
        for readings, arrival_s in rows_of_stream(stream, parser, tally):
            new = np.array([clock.accepts(time_s) for time_s in readings.time_s.tolist()], dtype=bool)
            if not new.any():
                continue
            rows = without_saturated(readings[new], array)
            _, ambient_T = with_ambient_field(array, rows, place, gradient=False)
            rows = in_world_field(rows, array)
            track = tracker.follow(rows.values_T, rows.time_s, rows.ambient_T if ambient_T is None else ambient_T)
            tally.tracked += int(track.solved.sum())
            tally.latencies_s += [time.perf_counter() - arrival_s] * len(track)
            yield track, arrival_s
