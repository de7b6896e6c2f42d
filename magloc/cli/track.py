"""``magloc track``: a source, or several, through the rows of a file or a stream."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal  # noqa: F401 - of an inherited option

from cyclopts import Parameter

import magloc
from arrays.io.errors import InputError, naming
from arrays.io.outputs import refuse_file, refuse_one_for_two, write_files
from arrays.typing import Vector
from magloc.cli.framework import CommonOptions, Flag, note, print_json_list, print_report, progress, warn
from magloc.cli.moments.known_path import (
    PathErrorOptions,
    TrackOutputs,
    print_consistency,
    refuse_bounds,
    write_moment_tracks,
)
from magloc.cli.moments.magnet import MagnetOptions
from magloc.cli.options import (
    STREAM,
    KnownOptions,
    MapOptions,
    MotionOptions,
    in_ambient_field,
    naming_place,
    refuse_not_positive,
)

if TYPE_CHECKING:
    from arrays.array import SensorArray
    from magloc.ambient import Place
    from magloc.readings import Readings
    from magloc.signature.moment_track import MomentTrack
    from magloc.signature.path import ObjectPath
    from magloc.tracking.multi_target.track import SourcesTrack
    from magloc.tracking.results import TrackPoint
    from magloc.tracking.track import Track


# Channels of two vector sensors: too few for the six numbers of a source in one row.
_FEW_CHANNELS = 6
_STATE_OFFSETS = "; state offset_uncertainty_nT in the array file, use --rest-s, or calibrate the array"
_USE_SURVEY = "magloc survey finds sources at rest that few sensors move past"


@Parameter(name="*", group="Motion")
@dataclass(frozen=True)
class PathOptions(MotionOptions):
    """Model of the motion, or a known path.

    Parameters
    ----------
    sources : str
        Track several moving sources in one filter: the largest number of sources, or "auto" for as many as the readings
        support, at most five. Speeds and turn rates are then estimated too. A sensor that fails is excluded and named.
    speed_m_s : float
        Typical speed of the source along each axis [m/s].
    turn_deg_s : float
        Typical rate at which the moment turns [°/s]; 5 by default, 100 with --sources.
    motion : {"unknown", "wandering", "turn"}
        unknown: position and moment are random walks; a step is the speed, or the rate, times the interval of two rows.
        wandering: speed and turn rate are estimated too, with the correlation time --correlation-s. turn: a steady turn
        about the vertical. By default unknown; wandering with --smooth, --detrend or --high-pass-hz.
    correlation_s : float
        Correlation time of the speed, for wandering [s]; by default the time of one turn at the typical rate, 1.5 with
        --sources.
    position : tuple of 3 floats
        Known position of a source at rest [m], in the frame of the results; only its moment is estimated. Give it
        several times for several sources.
    object_path : Path
        Path file (CSV) of the source: time_s,x_m,y_m,z_m and optionally its attitude qx,qy,qz,qw, in the frame of the
        results. Only the moment is estimated; it turns with the attitude. Rows outside the path are ignored.
    error : PathErrorOptions
        Errors of a known path.
    magnet : MagnetOptions
        Shape of a magnet.
    body : Path
        Body file (TOML) of a rigid body of two or more magnets; its pose is tracked, in the array's frame. Typical
        speed, rotation rate and correlation time are 0.1 m/s, 115°/s and 0.2 s by default.
    """

    position: list[Vector] | None = None
    object_path: Path | None = None
    error: PathErrorOptions = field(default_factory=PathErrorOptions)
    magnet: MagnetOptions = field(default_factory=MagnetOptions)
    body: Path | None = None

    def known_path(self) -> ObjectPath | list[Vector] | None:
        """Return the known path or positions; None if the position is to be estimated."""
        if self.position is None and self.object_path is None:
            if self.error != PathErrorOptions():
                raise InputError("--path-sigma-m: found neither --position nor --object-path, expected one of them.")
            return None
        if self.position is not None and self.object_path is not None:
            raise InputError("--position: found together with --object-path, expected one of them.")
        if self.position is not None and len(self.position) > 1 and self.error != PathErrorOptions():
            raise InputError("--path-sigma-m: found several places of --position, expected one.")
        if self.motion not in (None, "unknown"):
            raise InputError(f"--motion: found {self.motion} with a known position, expected unknown.")
        return self.position if self.object_path is None else magloc.read_object_path(self.object_path)


@Parameter(name="*", group="Conditioning of the readings")
@dataclass(frozen=True)
class ConditioningOptions:
    """Processing of the readings before tracking; not for a stream.

    Parameters
    ----------
    rest_s : float
        Duration of a rest without a source at the beginning [s]. Its mean is subtracted from all readings. Only for
        vector sensors of an array that does not move.
    detrend : bool
        Subtract the mean of every channel, and estimate a linear trend with the source.
    high_pass_hz : float
        Estimate an offset and a drift of every channel; the drift equals the noise at this frequency [Hz].
    mains_hz : float
        Frequency to remove, with its harmonics [Hz], such as 50.
    window_s : float
        Length of the windows to average [s]; by default rows are not averaged.
    """

    rest_s: float | None = None
    detrend: Flag = False
    high_pass_hz: float | None = None
    mains_hz: float | None = None
    window_s: float | None = None

    def apply(self, rows: Readings, array: SensorArray, path: Path) -> tuple[Readings, SensorArray]:
        """Return the processed readings without saturated ones, and the array with their noise."""
        from magloc.averages import window_averages, window_averaging_array
        from magloc.readings import without_saturated

        refuse_not_positive(self, "window_s", "rest_s")
        rows = without_saturated(rows, array)
        try:
            if self.rest_s is not None:
                array, rows = magloc.subtract_rest(array, rows, self.rest_s)
            if self.detrend:
                rows = rows.detrended()
            if self.high_pass_hz is not None:
                rows = rows.high_passed(self.high_pass_hz)
            if self.mains_hz is not None:
                rows = rows.without_hum(self.mains_hz)
        except InputError as error:
            raise InputError(f"{path}: {error}") from None
        if self.window_s is None:
            return rows, array
        return window_averages(rows, self.window_s), window_averaging_array(array, rows, self.window_s)


def track(
    readings: Annotated[Path, Parameter(allow_leading_hyphen=True)],
    /,
    *,
    array: Path,
    truth: Path | None = None,
    smooth: Flag = False,
    json: Flag = False,
    jsonl: Flag = False,
    known: KnownOptions = KnownOptions(),  # noqa: B008 - frozen
    maps: MapOptions = MapOptions(),  # noqa: B008 - frozen
    out: Path | None = None,
    motion: PathOptions = PathOptions(),
    conditioning: ConditioningOptions = ConditioningOptions(),
    common: CommonOptions = CommonOptions(),  # noqa: B008 - frozen
) -> None:
    """Track one source, or several, through time.

    A track starts without a guess from the first row that shows a source, and every row updates it. It ends where three
    rows in succession contradict it, or where the position is no longer known; then it starts again. Rows without a
    track are null. With --position or --object-path the position is known, and only the moment is estimated.

    Parameters
    ----------
    readings : Path
        Readings file (CSV), or - for rows on standard input; then every row gives one JSON line at once.
    array : Path
        Array file (TOML).
    truth : Path
        Truth file (CSV). Prints errors, NEES, NIS with its 99 % bounds, and the Cramér-Rao bound over the motions that
        the options allow; for a source that moves less the error may be smaller.
    smooth : bool
        Also use later rows (fixed-interval smoother).
    json : bool
        Print one JSON object instead of the table.
    jsonl : bool
        Print one JSON line for every row, as soon as it is known.
    known : KnownOptions
        Prior knowledge of the sensors, of the source when a track starts, and of the ambient field.
    maps : MapOptions
        Files for maps of the world: one point for a source at rest, otherwise the track.
    out : Path
        Folder for figures and their data: the track with its 95 % ellipses, and its consistency; with --sources the
        track alone, with a row for every source.
    motion : PathOptions
        Model of the motion, or a known path.
    conditioning : ConditioningOptions
        Processing of the readings before tracking.
    common : CommonOptions
        Common options.
    """
    from magloc.measurement.magnet import array_near

    if json and jsonl:
        raise InputError("--json: found together with --jsonl, expected one of them.")
    refuse_file(out, "--out")
    refuse_one_for_two({"--out": out, **maps.outputs})
    if motion.body is not None:
        from magloc.cli.moments.body_poses import refuse_with_body, track_with_body

        single = {"--smooth": smooth, "--truth": truth, "--position": motion.position, **maps.outputs}
        refuse_with_body(single | {"--object-path": motion.object_path, "--magnet": motion.magnet.kind})
        track_with_body(readings, array, motion.body, known, motion, conditioning, as_json=json, jsonl=jsonl, out=out)
        return
    maps.refuse(known.place)
    outputs = TrackOutputs(json, jsonl, maps, out, truth)
    # A place without a date is for the maps only.
    where = None if known.place is not None and known.date is None else known.where
    used = known.array(array)
    known = replace(known, place=known.map_origin(used))
    on_background = conditioning.detrend or conditioning.high_pass_hz is not None
    model = motion.model(lasting=smooth or on_background)
    path = motion.known_path()
    magnet = motion.magnet.shape(sources=motion.sources, position=motion.position, object_path=motion.object_path)
    if path is not None:
        refuse_bounds(known)
    number = motion.number
    if number is not None:
        others = {"--smooth": smooth or None, "--truth": truth, "--position": path, **maps.outputs}
        for option in (name for name, value in others.items() if value is not None):
            raise InputError(f"{option}: found together with --sources, expected one of them.")
    named = naming(str(array), readings=str(readings), time_s=str(readings), sources=f"--sources {motion.sources}")
    if str(readings) == STREAM:
        whole = smooth or json or maps != MapOptions() or any(option is not None for option in (truth, out, path))
        if whole or conditioning != ConditioningOptions():
            raise InputError("READINGS -: found an option that needs the whole record, expected a stream of --jsonl.")
        with named:
            _stream(array_near(used, magnet), known, motion, where)
        return
    rows = magloc.read_readings(readings, used, sensors=known.ids, ordered=True)
    maps.refuse_far(rows, str(readings))
    rows, used = conditioning.apply(rows, used, readings)
    used, rows = in_ambient_field(used, rows, where)
    if path is not None:
        with named:
            found = _moments(used, rows, path, motion, smooth=smooth)
        write_moment_tracks(found, readings, known, outputs)
        return
    few = used.n_channels <= _FEW_CHANNELS and rows.array_rotation is not None
    if number is not None and on_background:
        raise InputError("--sources: found together with --detrend or --high-pass-hz, expected one of them.")
    if number is None and few:
        note(_USE_SURVEY)
    with progress(len(rows), "rows") as advance, named:
        alike: Any = {"prior": known.prior, "progress": advance, "told": motion.print_entry if jsonl else None}
        if number is None:
            one = magloc.track(used, rows, motion=model, smooth=smooth, magnet=magnet, **alike)
        else:
            several = magloc.track_sources(used, rows, sources=number, motion=motion.model_of_several(), **alike)
    if number is None:
        _write_track(one, str(readings), known, outputs, f"; {_USE_SURVEY}" if few else "")
    else:
        _write_sources(several, str(readings), outputs, single=number == 1)


def _moments(
    array: SensorArray, rows: Readings, path: ObjectPath | list[Vector], motion: PathOptions, *, smooth: bool
) -> tuple[MomentTrack, ...]:
    """Track the moment of one source on a known path, or of several at known positions."""
    if isinstance(path, list) and len(path) > 1:
        return magloc.track_moments(array, rows, path, turn_rad_s=motion.turn_rad_s, smooth=smooth)
    return (
        magloc.track_moment(
            array,
            rows,
            path[0] if isinstance(path, list) else path,
            turn_rad_s=motion.turn_rad_s,
            path_error=motion.error.path_error(),
            smooth=smooth,
        ),
    )


def _write_track(found: Track, name: str, known: KnownOptions, outputs: TrackOutputs, hint: str) -> None:
    """Print a track and write the outputs; `hint` ends the error where there is no track."""
    from magloc.localization.fit.table import legend
    from magloc.tracking.files import json_of_track
    from magloc.tracking.sensor_health import OFFSETS
    from magloc.truth import cause_of_disagreement

    json, jsonl = outputs.json, outputs.jsonl
    is_found, result = any(point.is_on_track for point in found), None
    if is_found:
        if outputs.truth is not None:
            truth = magloc.read_truth(outputs.truth)
            result = found.consistency(truth)
            warn(filter(None, [cause_of_disagreement(truth, found.time_s, found.position_m)]))
        outputs.maps.write(found, known.place)
    if is_found and outputs.out is not None:
        from magloc.plots.tracks import write_track_figures

        write_track_figures(
            found,
            None if result is None else result.true_position_m,
            outputs.out,
            nees=None if result is None else (result.nees, result.nees_dof),
            bound_m=None if result is None else result.bound_m,
            array_m=found.readings.array_position_m,
        )
    if json:
        print_report(json_of_track(found, result) | {"innovations": found.innovations.json})
    elif not jsonl:
        print(found.table())
    if not is_found:
        wants_files = outputs.truth is not None or outputs.out is not None or outputs.maps != MapOptions()
        if not wants_files and _is_undetermined(found):
            return
        raise _no_track(name, found.status, hint or _STATE_OFFSETS * (OFFSETS in found.status))
    if result is not None and not json:
        print_consistency(result.lines(), jsonl=jsonl)
    if not (json or jsonl):
        for line in [f"{found.tracked.sum()} of {len(found)} rows tracked", *legend([found.table()])]:
            note(line)
    _note_dropped({name for names in found.dropped_sensors for name in names})
    if jsonl:
        for line in filter(None, (found.innovations.reason, found.innovations.caution)):
            note(line)


def _write_sources(found: SourcesTrack, name: str, outputs: TrackOutputs, *, single: bool) -> None:
    """Print the tracks of several sources, and write the outputs."""
    from magloc.tracking.files import json_entry

    if outputs.json:
        print_json_list("results", (json_entry(point, single=single) for point in found))
    if not found.ids:
        raise _no_track(name, {point.status for point in found})
    if outputs.out is not None:
        write_files(outputs.out, [("track.png", found.plot()), ("track.csv", found.columns())])
    if not (outputs.json or outputs.jsonl):
        print(found.table())
        tracked = sum(bool(point.tracks) for point in found)
        note(f"{tracked} of {len(found)} rows with a source, {len(found.ids)} sources in all")
    misfits = sum(point.status == "misfit" for point in found)
    if misfits:
        note(f"{misfits} of {len(found)} rows are explained by no sources, faults or losses: status misfit")
    _note_dropped(found.dropped_sensors)


def _note_dropped(names: Iterable[str]) -> None:
    """Print the sensors that some rows do not use."""
    if names := sorted(names):
        note(f"sensors excluded from some rows: {', '.join(names)}")


def _is_undetermined(found: Iterable[TrackPoint]) -> bool:
    """Return whether rows show a source without determining its position, and warn of it."""
    from magloc.tracking.results import UNDETERMINED

    rows = sum(point.status == UNDETERMINED for point in found)
    if rows:
        text = f"warning: {rows} rows show a source but do not determine its position: see the standard deviations"
        note(text, always=True)
    return rows > 0


def _no_track(readings: str, statuses: Iterable[str], hint: str = "") -> InputError:
    reasons = "; ".join(sorted(set(statuses))[:3])
    return InputError(f"{readings}: found no row where a source can be tracked ({reasons}){hint}.")


def _stream(array: SensorArray, known: KnownOptions, motion: PathOptions, where: Place | None) -> None:
    """Print one line for every row of standard input; refuse at its end a stream without a track."""
    from magloc.tracking.results import UNDETERMINED

    follower = motion.follower(array, known, where)
    statuses: set[str] = set()
    with naming_place():
        for point in follower.follow(STREAM):
            motion.print_entry(point)
            statuses.add(point.status)
    if follower.tally.faults:
        note(str(follower.tally), always=True)
    if not follower.tally.tracked and UNDETERMINED not in statuses:
        raise _no_track("standard input", statuses)
