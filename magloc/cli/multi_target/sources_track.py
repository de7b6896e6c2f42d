"""Option ``--sources``: several sources followed in one filter, through a file or a stream."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from cyclopts import Parameter

import magloc
from arrays.io.errors import InputError, naming, own_sentence
from magloc.cli.framework import print_json, print_json_list, progress
from magloc.cli.options import MotionOptions, number_of_sources, print_note, refuse_not_positive

if TYPE_CHECKING:
    from arrays.array import SensorArray
    from magloc.ambient import Place
    from magloc.live.follower import Follower
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

    def follower(
        self, array: SensorArray, sensors: list[str] | None, place: Place | None = None, rest_s: float = 0.0
    ) -> Follower:
        """Who follows these sources through a stream."""
        from magloc.live.follower import Follower

        with self.named():
            return Follower(
                array,
                self.motion,
                sources=self.sources,
                prior=self.prior,
                sensors=sensors,
                place=place,
                rest_s=rest_s,
            )

    @contextmanager
    def named(self) -> Iterator[None]:
        """What an array cannot tell is said of the option."""
        try:
            yield
        except ValueError as error:
            sentence = own_sentence(error)
            if not sentence.startswith("sources"):
                raise
            raise InputError(f"--sources {self.sources}: {sentence}") from None

    def printed(self, point: SourcesPoint, **more: float) -> SourcesPoint:
        """The point, after its line is printed."""
        from magloc.tracking.multi_target.results import json_of_sources

        print_json(json_of_sources(point, single=self.sources == 1) | more)
        sys.stdout.flush()
        return point


@Parameter(name="*", group="Motion")
@dataclass(frozen=True)
class SourcesOptions(MotionOptions):
    """What is known of the motion of one source, or of several.

    Parameters
    ----------
    sources : str
        Follow several moving sources in one filter: at most so many, or "auto": as many as the readings support, five
        at most. Speeds and rates of turn are then estimated too, and a sensor that dies is left out and named.
    speed_m_s : float
        Characteristic speed of the source along each axis.
    turn_deg_s : float
        Characteristic rate at which its moment turns; 5 by default, of several sources 100.
    motion : {"unknown", "wandering", "turn"}
        unknown: position and moment are random walks, by the speed and the rate times the interval in every row.
        wandering: speed and turn rate are estimated too, and forgotten in --correlation-s. turn: a steady turn about
        the vertical. By default unknown.
    correlation_s : float
        How long a speed lasts, for wandering; by default as long as a turn at the characteristic rate. Of several
        sources 1.5 by default.
    """

    sources: str | None = None

    def several(self, prior: SourcePrior) -> SourcesWanted | None:
        """What several sources are asked for; None: one source is followed on its own."""
        if self.sources is None:
            return None
        if self.motion is not None:
            raise InputError(f"--motion: found {self.motion} together with --sources, expected one of them.")
        refuse_not_positive(self, "speed_m_s", "turn_deg_s", "correlation_s")
        motion = magloc.FreeMotion(speed_m_s=self.speed_m_s)
        if self.turn_deg_s is not None:
            motion = replace(motion, turn_rad_s=math.radians(self.turn_deg_s))
        if self.correlation_s is not None:
            motion = replace(motion, correlation_s=self.correlation_s)
        return SourcesWanted(number_of_sources(self.sources), motion, prior)


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
    from magloc.tracking.multi_target.results import json_of_sources

    json, jsonl, quiet = outputs.json, outputs.jsonl, outputs.quiet
    if rows.background:
        raise InputError("--sources: found it together with --detrend or --high-pass-hz, expected one of them.")
    with progress(len(rows), "rows", quiet=quiet) as advance, naming(name, array="--array"), wanted.named():
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
        print_json_list("results", (json_of_sources(point, single=wanted.sources == 1) for point in found))
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
    follower, last = wanted.follower(array, sensors), None
    for point in follower.follow("-"):
        assert point.sources is not None
        known = wanted.printed(point.sources)
        last = known if known.tracks or last is None else last
    if follower.tally.faults:
        print_note(str(follower.tally))
    if last is not None and not last.tracks:
        raise no_source("standard input", [last])


def no_source(readings: str, points: Iterable[SourcesPoint]) -> InputError:
    """What is said where no row has a source."""
    reasons = "; ".join(sorted({point.status for point in points}))
    return InputError(f"{readings}: found no row where a source can be tracked ({reasons}).")
