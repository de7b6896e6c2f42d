"""``magloc track``: one source followed through the rows of a readings file, or of a stream."""

from __future__ import annotations

import math
import sys
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from arrays.io.arguments import Flag
from arrays.io.errors import InputError
from arrays.typing import Vector
from magloc.cli.framework import CommonOptions, print_json, progress
from magloc.cli.options import print_note

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from arrays.array import SensorArray
    from magloc.ambient import Place
    from magloc.readings import Readings
    from magloc.tracking.consistency import Consistency
    from magloc.tracking.motion import MotionModel
    from magloc.tracking.results import TrackPoint
    from magloc.tracking.tracker import Tracker


STREAM = "-"


@Parameter(name="*", group="Motion")
@dataclass(frozen=True)
class MotionOptions:
    """What is known of the motion.

    Parameters
    ----------
    speed_m_s : float
        Characteristic speed of the source along each axis.
    turn_deg_s : float
        Characteristic rate at which its moment turns.
    motion : {"unknown", "wandering", "turn"}
        unknown: position and moment are random walks, by the speed and the rate times the interval in every row.
        wandering: speed and turn rate are estimated too, and forgotten in --correlation-s. turn: a steady turn about
        the vertical. By default unknown, and with --smooth wandering.
    correlation_s : float
        How long a speed lasts, for wandering; by default as long as a turn at the characteristic rate.
    """

    speed_m_s: float = 0.5
    turn_deg_s: float = 5.0
    motion: Literal["unknown", "wandering", "turn"] | None = None
    correlation_s: float | None = None


@Parameter(name="*", group="Conditioning of the readings")
@dataclass(frozen=True)
class ConditioningOptions:
    """What is done to the readings first, in this order; not for a stream.

    Parameters
    ----------
    detrend : bool
        Take a straight line out of every channel.
    high_pass_hz : float
        Take out what changes more slowly.
    mains_hz : float
        Take out this frequency and its harmonics.
    window_s : float
        Average windows of this length.
    """

    detrend: Flag = False
    high_pass_hz: float | None = None
    mains_hz: float | None = None
    window_s: float | None = None


def track(
    readings: Annotated[Path, Parameter(allow_leading_hyphen=True)],
    /,
    *,
    array: Path,
    truth: Path | None = None,
    smooth: Flag = False,
    json: Flag = False,
    jsonl: Flag = False,
    sensors: str | None = None,
    region: str | None = None,
    max_moment_Am2: Annotated[float | None, Parameter(name="--max-moment-Am2")] = None,
    place: Vector | None = None,
    date: str | None = None,
    geomagnetic_model: str | None = None,
    geojson: Path | None = None,
    out: Path | None = None,
    motion: MotionOptions = MotionOptions(),
    conditioning: ConditioningOptions = ConditioningOptions(),
    common: CommonOptions = CommonOptions(),  # noqa: B008 - frozen
) -> None:
    """Follow one source through time.

    The track starts by itself from the first row whose fix is certain, is updated by every row, and ends where the
    readings contradict it three times in a row or its range is no longer known; then it starts anew. Rows where the
    source is not tracked are null.

    Parameters
    ----------
    readings : Path
        Readings file (CSV), or - for rows on standard input; then every row is answered by one JSON line at once.
    array : Path
        Array file (TOML).
    truth : Path
        Truth file (CSV): errors, NEES and NIS with their 99 % bounds, and the least error that is possible on average
        over the motions that the options allow: a source that moves less may be found better.
    smooth : bool
        Use later rows too (fixed-interval smoother).
    json : bool
        Print one JSON object in place of the table.
    jsonl : bool
        Print one JSON line for every row, as soon as it is known.
    sensors : str
        Ids of the sensors to use, separated by commas; columns of others are ignored. All by default.
    region, max_moment_Am2
        What is known of the source when a track starts, as in locate.
    place : tuple of 3 floats
        Latitude, longitude [deg] and height [m] of the origin of the world frame, which is east, north, up.
    date : str
        When, for the ambient field of scalar sensors at that place.
    geomagnetic_model : str
        IGRF-14 or WMM2025.
    geojson : Path
        Write the track as a GeoJSON file; needs --place.
    out : Path
        Folder for the picture of the track with its 95 % ellipses and the data behind it.
    motion : MotionOptions
        What is known of the motion.
    conditioning : ConditioningOptions
        What is done to the readings first.
    common : CommonOptions
        Common options.
    """
    import numpy as np

    from arrays.array_file import read_array
    from arrays.io.outputs import refuse_file, refuse_one_for_two, refuse_unwritable
    from magloc.cli.locate import prior_of, subset_of
    from magloc.cli.options import place_of_options
    from magloc.cli.tables import report
    from magloc.readings import read_readings, without_saturated
    from magloc.tracking.batch import track_record
    from magloc.tracking.consistency import consistency, nees_of_rows
    from magloc.tracking.files import geojson_text
    from magloc.tracking.posterior_bound import posterior_bound, smoothing_bound
    from magloc.tracking.results import rows_of
    from magloc.tracking.smoother import smoothed
    from magloc.tracking.tracker import Tracker
    from magloc.truth import read_truth, truth_of_rows

    if json and jsonl:
        raise InputError("--json: found it together with --jsonl, expected one of them.")
    if out is not None:
        refuse_file(out, "--out")
    if geojson is not None and place is None:
        raise InputError("--geojson: found no --place, expected the origin of the world frame with it.")
    refuse_one_for_two({"--out": out, "--geojson": geojson})
    if geojson is not None:
        refuse_unwritable(geojson, "--geojson")
    where = None if place is not None and date is None else place_of_options(place, date, geomagnetic_model)
    ids = None if sensors is None else [name.strip() for name in sensors.split(",")]
    used = subset_of(read_array(array), ids, array)
    model = _motion(motion, smooth=smooth)
    prior = prior_of(region, max_moment_Am2)
    if str(readings) == STREAM:
        whole = smooth or json or any(option is not None for option in (truth, out, geojson))
        if whole or conditioning != ConditioningOptions():
            raise InputError("READINGS -: found an option that needs the whole record, expected a stream of --jsonl.")
        _stream(used, ids, model, prior, where)
        return
    rows = without_saturated(read_readings(readings, used, sensors=ids, ordered=True), used)
    rows, used = _conditioned(rows, used, conditioning, readings)
    used, ambient_T = _ambient(used, rows, where)
    try:
        tracker = Tracker(used, model, prior=prior, keep_steps=smooth)
    except ValueError as error:
        raise InputError(f"{array}: {str(error).removeprefix('Input ')}") from None
    records = list(rows_of(rows.time_s, rows.values_T, rows.array_position_m, rows.array_rotation, ambient_T))
    points: list[TrackPoint] = []
    with progress(len(records), "rows", quiet=common.quiet) as advance:
        if jsonl and not smooth:
            for point in tracker.run(records, advance):
                points.append(point)
                _print_line(point)
        else:
            points = track_record(tracker, records, advance)
    if smooth:
        points = smoothed(points, tracker.steps)
    if not any(point.position_m is not None for point in points):
        _print_points(points, None, json=json, jsonl=jsonl, printed=jsonl and not smooth)
        raise _no_track(str(readings), {point.status for point in points})
    result = truth_position = bound = nees = None
    if truth is not None:
        truth_position, moment = truth_of_rows(rows, read_truth(truth), truth)
        complete = moment is not None and bool(np.isfinite(truth_position).all() and np.isfinite(moment).all())
        if complete and moment is not None:
            # Later rows make less error possible.
            bound_of = smoothing_bound if smooth else posterior_bound
            bound = bound_of(tracker, records, truth_position, moment)
        result = consistency(points, tracker, records, truth_position, moment, bound)
        if out is not None:
            nees = nees_of_rows(points, tracker, records, truth_position, moment)
    if geojson is not None and place is not None:
        from arrays.io.text import write_text

        write_text(geojson_text(points, place), geojson)
    if out is not None:
        from magloc.plots.tracks import write_picture

        write_picture(
            points,
            truth_position,
            out,
            nees=nees,
            bound_m=bound,
            array_m=rows.array_position_m,
            quiet=common.quiet,
        )
    _print_points(points, result, json=json, jsonl=jsonl, printed=jsonl and not smooth)
    if result is not None and not json:
        print("\n".join(report(result)), file=sys.stderr if jsonl else sys.stdout)
    if not (json or jsonl or common.quiet):
        tracked = sum(point.position_m is not None for point in points)
        print_note(f"{tracked} of {len(points)} rows tracked")


def _motion(options: MotionOptions, *, smooth: bool) -> MotionModel:
    from magloc.tracking.motion import CoordinatedTurn, OrnsteinUhlenbeck, RandomWalk

    for name in ("speed_m_s", "turn_deg_s", "correlation_s"):
        value = getattr(options, name)
        if value is not None and not 0.0 < value < math.inf:
            raise InputError(f"--{name.replace('_', '-')}: found {value:g}, expected a positive number.")
    turn = math.radians(options.turn_deg_s)
    name = options.motion or ("wandering" if smooth else "unknown")
    if name == "unknown":
        return RandomWalk(options.speed_m_s, turn)
    if name == "wandering":
        return OrnsteinUhlenbeck(options.speed_m_s, turn, options.correlation_s)
    return CoordinatedTurn(options.speed_m_s, turn)


def _conditioned(
    rows: Readings, array: SensorArray, options: ConditioningOptions, path: Path
) -> tuple[Readings, SensorArray]:
    from magloc.averages import window_averages, window_averaging_array

    if options.window_s is not None and not 0.0 < options.window_s < math.inf:
        raise InputError(f"--window-s: found {options.window_s:g}, expected a positive number.")
    try:
        if options.detrend:
            rows = rows.detrended()
        if options.high_pass_hz is not None:
            rows = rows.high_passed(options.high_pass_hz)
        if options.mains_hz is not None:
            rows = rows.without_hum(options.mains_hz)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    if options.window_s is not None:
        averaged = window_averages(rows, options.window_s)
        return averaged, window_averaging_array(array, rows, options.window_s)
    return rows, array


def _ambient(array: SensorArray, rows: Readings, where: Place | None) -> tuple[SensorArray, NDArray[np.float64] | None]:
    from magloc.ambient import with_ambient_field

    return with_ambient_field(array, rows, where, gradient=False)


def _print_points(
    points: Sequence[TrackPoint], result: Consistency | None, *, json: bool, jsonl: bool, printed: bool
) -> None:
    """Print a finished track as it is asked for, unless its lines are `printed` already."""
    from magloc.cli.tables import track_table
    from magloc.tracking.files import json_entry

    if json:
        entries = {"results": [json_entry(point) for point in points]}
        print_json(entries if result is None else {**entries, "consistency": result})
    elif not jsonl:
        print("\n".join(track_table(points)))
    elif not printed:
        for point in points:
            _print_line(point)


def _no_track(readings: str, statuses: Collection[str]) -> InputError:
    reasons = "; ".join(sorted(statuses)[:3])
    return InputError(f"{readings}: found no row where a source can be tracked ({reasons}).")


def _print_line(point: TrackPoint) -> None:
    from magloc.tracking.files import json_entry

    print_json(json_entry(point))
    sys.stdout.flush()


def _stream(array: SensorArray, ids: list[str] | None, model: MotionModel, prior: object, where: Place | None) -> None:
    """Answer every row of standard input by one line; none that is tracked is an InputError at its end."""
    from magloc.readings import readings_of_text, without_saturated
    from magloc.tracking.results import rows_of
    from magloc.tracking.tracker import Tracker

    lines = _lines_of_stdin()
    header = next(lines, None)
    if header is None:
        raise InputError("standard input: found nothing, expected a header with time_s and the sensors' columns.")
    tracker: Tracker | None = None
    statuses: set[str] = set()
    is_tracked = False
    last = -math.inf
    for number, line in enumerate(lines, start=2):
        if not line.strip():
            continue
        rows = without_saturated(
            readings_of_text(f"{header}\n{line}", "standard input", array, sensors=ids, first_line=number), array
        )
        time = float(rows.time_s[0])
        if time <= last:
            raise InputError(
                f"standard input, line {number}, column time_s: found {time:.15g} after {last:.15g}, expected time to"
                " increase from row to row."
            )
        last = time
        array_here, ambient = _ambient(array, rows, where)
        if tracker is None:
            tracker = Tracker(array_here, model, prior=prior)  # type: ignore[arg-type]
        (row,) = rows_of(rows.time_s, rows.values_T, rows.array_position_m, rows.array_rotation, ambient)
        point = tracker.advance(row)
        _print_line(point)
        statuses.add(point.status)
        is_tracked = is_tracked or point.position_m is not None
    if not statuses:
        raise InputError("standard input, line 1: found a header without rows, expected a row below it.")
    if not is_tracked:
        raise _no_track("standard input", statuses)


def _lines_of_stdin() -> Iterator[str]:
    while line := sys.stdin.readline():
        yield line.rstrip("\r\n")
