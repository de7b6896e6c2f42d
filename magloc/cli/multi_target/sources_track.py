"""``magloc track --sources``: several sources followed in one filter, through a file or a stream."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import magloc
from arrays.io.errors import InputError, naming
from magloc.cli.framework import print_json, progress
from magloc.cli.options import print_note

if TYPE_CHECKING:
    from arrays.array import SensorArray
    from magloc.localization.fit.prior import SourcePrior
    from magloc.readings import Readings
    from magloc.tracking.multi_target.motion import FreeMotion
    from magloc.tracking.multi_target.results import SourcesPoint


@dataclass(frozen=True)
class SourcesWanted:
    """What is to be followed, and what is known of it."""

    sources: int | Literal["auto"]
    motion: FreeMotion
    prior: SourcePrior

    def tracker(self, array: SensorArray) -> magloc.SourcesTracker:
        """A filter of these sources."""
        with self.named():
            return magloc.SourcesTracker(array, sources=self.sources, motion=self.motion, prior=self.prior)

    @contextmanager
    def named(self) -> Iterator[None]:
        """What an array cannot tell is said of the option."""
        try:
            yield
        except ValueError as error:
            sentence = str(error).removeprefix("Input ")
            if not sentence.startswith("sources"):
                raise
            raise InputError(f"--sources {self.sources}: {sentence}") from None

    def printed(self, point: SourcesPoint) -> SourcesPoint:
        """The point, after its line is printed."""
        from magloc.tracking.multi_target.files import json_of_sources

        print_json(json_of_sources(point, single=self.sources == 1))
        sys.stdout.flush()
        return point


@dataclass(frozen=True)
class SourcesOutputs:
    """What is written and printed of the tracks."""

    out: Path | None
    json: bool
    jsonl: bool
    quiet: bool


def follow_sources(
    array: SensorArray, rows: Readings, wanted: SourcesWanted, name: str, outputs: SourcesOutputs
) -> None:
    """Follow sources through a file of readings; none in any row is an InputError."""
    from magloc.tracking.multi_target.files import json_of_sources

    json, jsonl, quiet = outputs.json, outputs.jsonl, outputs.quiet
    if rows.background:
        raise InputError("--sources: found it together with --detrend or --high-pass-hz, expected one of them.")
    with progress(len(rows), "rows", quiet=quiet) as advance, naming(name), wanted.named():
        found = magloc.track_sources(
            array,
            rows,
            sources=wanted.sources,
            motion=wanted.motion,
            prior=wanted.prior,
            progress=advance,
            told=wanted.printed if jsonl else None,
        )
    if json:
        print_json({"results": [json_of_sources(point, single=wanted.sources == 1) for point in found]})
    if not found.ids:
        raise no_source(name, found)
    if outputs.out is not None:
        from magloc.plots.tracks import write_sources

        write_sources(found.as_result, outputs.out, rows.array_position_m)
    if not json and not jsonl:
        print(found.table())
    if not (json or jsonl or quiet):
        tracked = sum(bool(point.tracks) for point in found)
        print_note(f"{tracked} of {len(found)} rows with a source, {len(found.ids)} sources in all")
    misfits = sum(point.status == "misfit" for point in found)
    if misfits and not quiet:
        print_note(f"{misfits} of {len(found)} rows are explained by no sources, faults or losses: status misfit")
    if found.dropped_sensors and not quiet:
        print_note(f"sensors left out of some rows: {', '.join(found.dropped_sensors)}")


def stream_sources(array: SensorArray, sensors: list[str] | None, wanted: SourcesWanted) -> None:
    """Answer every row of standard input by one line; none with a source is an InputError at its end."""
    from magloc.live.rows import RowParser
    from magloc.live.tally import Clock, Tally
    from magloc.live.transports import opened

    tracker, tally = wanted.tracker(array), Tally()
    points: list[SourcesPoint] = []

    def restart() -> None:
        nonlocal tracker
        tracker = wanted.tracker(array)

    clock = Clock(tally, restart)
    with opened("-") as stream:
        parser = RowParser(array, stream.name, tally, sensors)
        for lines in stream.lines:
            for readings in parser.rows_of(lines):
                for i, time_s in enumerate(readings.time_s.tolist()):
                    if clock.takes(time_s):
                        point = wanted.printed(tracker.update(readings[i]))
                        points = [point] if point.tracks or not points else points
    if tally.faults:
        print_note(str(tally))
    if not points:
        raise InputError("standard input: found no rows, expected a header with time_s and rows below it.")
    if not points[0].tracks:
        raise no_source("standard input", points)


def no_source(readings: str, points: Iterable[SourcesPoint]) -> InputError:
    """What is said where no row has a source."""
    reasons = "; ".join(sorted({point.status for point in points}))
    return InputError(f"{readings}: found no row where a source can be tracked ({reasons}).")
