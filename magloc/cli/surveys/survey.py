"""``magloc survey``: targets at rest from sensors that move over ground."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

import arrays
import magloc
from arrays.io.errors import InputError, naming, naming_options
from arrays.io.outputs import refuse_file, refuse_one_for_two, refuse_unwritable, write_files
from arrays.typing import Vector
from magloc.cli.framework import CommonOptions, Flag, note, print_report
from magloc.cli.options import (
    KnownOptions,
    LogOptions,
    MapOptions,
    Port,
    in_ambient_field,
    refuse_not_positive,
)
from magloc.cli.surveys.ground import SurfaceOptions
from magloc.cli.view import write_or_serve

if TYPE_CHECKING:
    from magloc.deliverables.map_frame import MapFrame
    from magloc.surveying.results import Survey


@Parameter(name="*", group="Ground")
@dataclass(frozen=True)
class GroundOptions(SurfaceOptions):
    """Properties of the ground.

    Parameters
    ----------
    shortest_geology_m : float
        Shortest wavelength in the field of the ground itself [m]; smaller anomalies are targets.
    false_per_hectare : float
        Allowed mean number of false targets per hectare.
    body_length_m : float
        Longest edge of a target [m]. The part of its field that a dipole does not describe counts as noise. 0 for
        point sources.
    """

    shortest_geology_m: float = 15.0
    false_per_hectare: float = 0.1
    body_length_m: float = 0.0


@Parameter(name="*", group="Review")
@dataclass(frozen=True)
class ReviewOptions:
    """Review of the targets.

    Parameters
    ----------
    decisions : Path
        Log of decisions about targets and rows (decisions.jsonl of an earlier review) to apply after the search.
    html : Path
        HTML file to write: lines, ground and targets in three dimensions, as one page that needs no server.
    view : bool
        Serve a page to review the targets, until Ctrl-C. It saves into the folder of --out.
    port : int
        Port of the server; the next free one if it is in use.
    open : bool
        Open the page in the browser.
    """

    decisions: Path | None = None
    html: Path | None = None
    view: Flag = False
    port: Port = 8080
    open: Flag = False


def survey(
    readings: Annotated[list[Path], Parameter(negative_iterable="")],
    /,
    *,
    log: LogOptions = LogOptions(),  # noqa: B008 - frozen
    known: KnownOptions = KnownOptions(),  # noqa: B008 - frozen
    base: Path | None = None,
    ground: GroundOptions = GroundOptions(),
    maps: MapOptions = MapOptions(),  # noqa: B008 - frozen
    crs: str | None = None,
    scheduler: str | None = None,
    out: Path | None = None,
    review: ReviewOptions = ReviewOptions(),
    json: Flag = False,
    common: CommonOptions = CommonOptions(),  # noqa: B008 - frozen
) -> None:
    """Find targets at rest in the ground that sensors moved over.

    Uses all rows together, and finds all significant targets. Readings need the pose of the array, and for scalar
    sensors the ambient field. The table lists the most significant target first: ± xy is the longer half axis of the
    95 % ellipse, χ² the increase without the target. Flags: "weak" = trust the depth interval, not the ellipse; "near"
    = another target is so near that one of the two may be spurious; "merged" = several targets, too near to be
    separated; "edge" = at the edge of the searched area; "misfit" = errors are larger than stated. The command names
    sensors that stick, wild readings and late readings.

    Parameters
    ----------
    readings : list of Path
        Readings files (CSV), in order of time.
    log : LogOptions
        Sensors and columns of the readings: --array or --instrument.
    known : KnownOptions
        Prior knowledge of the sensors, of the targets (in the world frame), and of the ambient field.
    base : Path
        Readings of a base station (CSV): time_s, on the clock of the readings, and base_nT, the modulus. Its variation
        is that of the ambient field.
    ground : GroundOptions
        Properties of the ground.
    maps : MapOptions
        Files for maps of the world.
    crs : str
        Coordinate system of the files for maps, such as EPSG:32633; by default that of the log, or else WGS 84. It
        needs places on the Earth: --place, or a log with coordinates.
    scheduler : str
        Address of a dask scheduler (tcp://HOST:PORT), whose workers then search the tiles of a large survey.
    out : Path
        Folder for targets.csv, residual.csv, reach.csv (the smallest moment that is found), a map, profiles past the
        targets, and decisions.jsonl of a review. With positions on the Earth also for targets.gpkg, .geojson and .kml,
        field.tif, residual.tif, lines.xyz and a report. It also holds the finished tiles of a large survey; the same
        command continues an interrupted survey.
    review : ReviewOptions
        Review of the targets.
    json : bool
        Print one JSON object instead of the table.
    common : CommonOptions
        Common options.
    """
    from magloc.surveying.review.decisions import read_decisions

    refuse_file(out, "--out")
    refuse_one_for_two({"--out": out, "--html": review.html, **maps.outputs})
    refuse_unwritable(review.html, "--html")
    if review.view and (out is None or json):
        raise InputError("--view: found no --out, or --json, expected a folder to save to, and no --json.")
    refuse_not_positive(ground, "shortest_geology_m", "false_per_hectare")
    ground.refuse()
    chosen = known.select(log.sensors(readings[0]), log.name)
    decisions = [] if review.decisions is None else read_decisions(review.decisions)
    used, known = known.on_earth(chosen, readings[0])
    _note_ground(chosen, used, ground)
    maps.refuse(known.place)
    where = None if known.place is not None and known.date is None else known.where
    frame = _map_frame(used, known.place, crs)
    parts = [magloc.read_readings(path, used, sensors=known.ids, ordered=True) for path in readings]
    surface, parts, origin = ground.below(readings, parts, used, known.place)
    if origin is not None and origin != known.place:
        note(f"note: the origin is on the ground, at a height of {origin[2]:.2f} m")
        known, frame = replace(known, place=origin), _map_frame(used, origin, crs)
        where = where and known.where
    for path, part in zip(readings, parts, strict=True):
        maps.refuse_far(part, str(path), always=out is not None and frame is not None)
    fields = [in_ambient_field(used, part, where) for part in parts]
    used, rows = fields[0][0], [own for _, own in fields]
    at_base = arrays.SensorArray((arrays.Sensor("base", "scalar", (0.0, 0.0, 0.0), 1e-10),))
    station = None if base is None else magloc.read_readings(base, at_base, ordered=True)
    named = naming(", ".join(map(str, readings)), array=log.name)
    with named, naming_options("ground_m", "base", "body_length_m", "scheduler"):
        found = magloc.survey(
            used,
            rows,
            base=station,
            prior=known.prior,
            ground_m=surface,
            shortest_geology_m=ground.shortest_geology_m,
            false_per_hectare=ground.false_per_hectare,
            body_length_m=ground.body_length_m,
            scheduler=scheduler,
            unfinished=None if out is None else out / "tiles",
            progress=None if json else note,
        )
    if review.decisions is not None:
        with naming(str(review.decisions)):
            found = magloc.Review(found).replay(decisions, None if json else note).found

    def write(found: Survey) -> str:
        maps.write(found, known.place)
        _write(out, _files(found, frame, ", ".join(path.name for path in readings), ground))
        return f"saved in {out}"

    write(found)
    if review.html is not None:
        magloc.view(None, found, html=review.html, title="survey")
    if json:
        from magloc.surveying.files import json_of_survey

        print_report(json_of_survey(found) | _json_of_map(found, frame))
        return
    print(found.table())
    _note_pose(found)
    if review.view:
        from magloc.viewer.view import view_survey

        write_or_serve(lambda port: view_survey(found, write, open=review.open, port=port), [], review.port)


def _note_pose(found: Survey) -> None:
    """Name the errors of the pose that were estimated."""
    if found.pose_assumed:
        pose = found.array.pose
        size = "" if pose is None else f" {100.0 * pose.position_m:.2g} cm that last {pose.correlation_s:g} s"
        if pose is not None and pose.position_white_m:
            size += f", and {100.0 * pose.position_white_m:.2g} cm new in every row"
        note(f"the array file states no errors of the pose; estimated from the rows:{size}")


def _map_frame(array: arrays.SensorArray, origin: Vector | None, crs: str | None) -> MapFrame | None:
    """Return the coordinate system of maps: as asked for, or that of the log, or WGS 84; None without an origin."""
    from magloc.deliverables.map_frame import WGS84, MapFrame

    if origin is None:
        if crs is not None:
            raise InputError("--crs: found no place on the Earth, expected --place or a log with coordinates.")
        return None
    own = None if array.columns is None else array.columns.crs
    with naming("--crs" if crs is not None else "--place"):
        return MapFrame(origin, crs if crs is not None else own or WGS84)


def _note_ground(given: arrays.SensorArray, used: arrays.SensorArray, ground: GroundOptions) -> None:
    """Print a note if the stated height of the ground is measured from the first place of the log."""
    is_stated = given.columns == used.columns or used.columns is None or used.columns.above_ground
    if is_stated or ground.terrain is not None:
        return
    note(f"note: --ground-m is measured from the height of that place, negative below it: found {ground.ground_m:g} m")


def _json_of_map(found: Survey, frame: MapFrame | None) -> dict[str, Any]:
    """Return the origin and the coordinate system of the map, and the targets' coordinates in it."""
    from magloc.deliverables.files import map_columns

    if frame is None:
        return {}
    columns = {name: list(values) for name, values in map_columns(found, frame).items()}
    places = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
    targets = [entry | place for entry, place in zip(found.entries, places, strict=True)]
    return {"origin": list(frame.origin), "crs": frame.label, "targets": targets}


def _write(out: Path | None, files: Iterator[tuple[str, Any]]) -> None:
    """Write files into a folder, and name those of an earlier survey that stay."""
    from magloc.deliverables.files import MAP_FILES

    if out is None:
        return
    before = {name: _changed_ns(out / name) for name in ("decisions.jsonl", *MAP_FILES)}
    write_files(out, files)
    if older := [name for name, at in before.items() if at is not None and _changed_ns(out / name) == at]:
        note(f"note: {', '.join(older)} in {out} {'are' if len(older) > 1 else 'is'} of an earlier run")


def _changed_ns(path: Path) -> int | None:
    """Return the time of the last change of a file [ns], None if it does not exist."""
    return path.stat().st_mtime_ns if path.exists() else None


def _files(found: Survey, frame: MapFrame | None, title: str, ground: GroundOptions) -> Iterator[tuple[str, Any]]:
    """Yield targets.csv, residual.csv, reach.csv, the map, the lines past the targets, and files for a client's map."""
    from magloc.deliverables.files import map_columns, survey_files
    from magloc.plots.profiles import survey_profiles
    from magloc.surveying.files import reach_columns, residual_columns
    from magloc.surveying.review.decisions import decision_lines

    yield "targets.csv", found.columns() | ({} if frame is None else map_columns(found, frame))
    yield "residual.csv", residual_columns(found)
    yield "reach.csv", reach_columns(found)
    if found.decisions:
        yield "decisions.jsonl", decision_lines(found.decisions)
    maps, profiles = found.plot(), survey_profiles(found)
    yield "survey.png", maps
    yield "profiles.png", profiles
    if frame is not None:
        assumptions = {
            "field of the ground": f"wavelengths above {ground.shortest_geology_m:g} m",
            "false targets": f"{ground.false_per_hectare:g} in a hectare on average",
            "size of targets": f"{ground.body_length_m:g} m" if ground.body_length_m else "points",
        }
        yield from survey_files(found, frame, title, assumptions, (maps, profiles))
