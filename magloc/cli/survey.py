"""``magloc survey``: static targets from sensors that move over ground."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

import arrays
import magloc
from arrays.io.errors import InputError, naming, naming_options
from arrays.io.outputs import refuse_file, refuse_one_for_two, refuse_unwritable, write_files
from magloc.cli.framework import CommonOptions, Flag, note, print_report
from magloc.cli.options import (
    KnownOptions,
    MapOptions,
    ambient_field,
    refuse_not_positive,
)

if TYPE_CHECKING:
    from magloc.surveying.results import Survey


@Parameter(name="*", group="Ground")
@dataclass(frozen=True)
class GroundOptions:
    """What is known of the ground.

    Parameters
    ----------
    ground_m : float
        Height of the ground in the world frame.
    shortest_geology_m : float
        Shortest wavelength in the field of the ground itself; what is smaller is taken for a target.
    false_per_hectare : float
        False targets in a hectare that noise may make, on average.
    body_length_m : float
        Longest edge of what may be buried: what a dipole leaves out of its field counts as noise. 0 for points.
    """

    ground_m: Annotated[float, Parameter(allow_leading_hyphen=True)] = 0.0
    shortest_geology_m: float = 15.0
    false_per_hectare: float = 0.1
    body_length_m: float = 0.0


def survey(
    readings: Annotated[list[Path], Parameter(negative_iterable="")],
    /,
    *,
    array: Path,
    known: KnownOptions = KnownOptions(),  # noqa: B008 - frozen
    base: Path | None = None,
    ground: GroundOptions = GroundOptions(),
    maps: MapOptions = MapOptions(),  # noqa: B008 - frozen
    scheduler: str | None = None,
    out: Path | None = None,
    html: Path | None = None,
    json: Flag = False,
    common: CommonOptions = CommonOptions(),  # noqa: B008 - frozen
) -> None:
    """Find targets at rest in the ground that sensors moved over.

    All rows count together, and as many targets are found as are significant. Readings need the pose of the array, and
    for scalar sensors the ambient field. The table has the most significant target first: ± xy is the longer half axis
    of the 95 % ellipse, χ² what would be lost without the target. Flags: "weak" = trust the depth interval and not the
    ellipse; "near" = another target is so near that one of the two may be spurious; "merged" = more than one, too near
    to be told apart; "edge" = at the rim of what was searched; "misfit" = errors are larger than is said. Sensors that
    stick, wild readings and late ones are named.

    Parameters
    ----------
    readings : list of Path
        Readings files (CSV), each later than the one before.
    array : Path
        Array file (TOML).
    known : KnownOptions
        What is known of the sensors, of the targets, in the world frame, and of the ambient field.
    base : Path
        Readings of a base station (CSV): time_s, at the clock of the readings, and base_nT, the modulus there. The
        ambient field varies as it does.
    ground : GroundOptions
        What is known of the ground.
    maps : MapOptions
        Files for maps of the world.
    scheduler : str
        Address of a dask scheduler (tcp://HOST:PORT) whose workers search the tiles of a large survey.
    out : Path
        Folder for targets.csv, residual.csv, reach.csv (the least moment seen), the map and the lines past the targets;
        of a large survey it keeps what is done, until all is: the same command goes on with one that was interrupted.
    html : Path
        Write the survey in three dimensions, lines, ground and targets, as one page that needs no server.
    json : bool
        Print one JSON object in place of the table.
    common : CommonOptions
        Common options.
    """
    maps.refuse(known.place)
    refuse_file(out, "--out")
    refuse_one_for_two({"--out": out, "--html": html, **maps.outputs})
    refuse_unwritable(html, "--html")
    refuse_not_positive(ground, "shortest_geology_m", "false_per_hectare")
    if not math.isfinite(ground.ground_m):
        raise InputError(f"--ground-m: found {ground.ground_m:g}, expected a finite number.")
    where = None if known.place is not None and known.date is None else known.where
    used = known.reduced(arrays.read_sensors(array), array)  # one is enough
    parts = [magloc.read_readings(path, used, sensors=known.ids, ordered=True) for path in readings]
    for path, part in zip(readings, parts, strict=True):
        maps.refuse_far(part, str(path))
    fields = [ambient_field(used, part, where) for part in parts]
    used, rows = fields[0][0], [replace(part, ambient_T=own) for part, (_, own) in zip(parts, fields, strict=True)]
    at_base = arrays.SensorArray((arrays.Sensor("base", "scalar", (0.0, 0.0, 0.0), 1e-10),))
    station = None if base is None else magloc.read_readings(base, at_base, ordered=True)
    named = naming(", ".join(map(str, readings)), array=str(array))
    with named, naming_options("ground_m", "base", "body_length_m", "scheduler"):
        found = magloc.survey(
            used,
            rows,
            base=station,
            prior=known.prior,
            ground_m=ground.ground_m,
            shortest_geology_m=ground.shortest_geology_m,
            false_per_hectare=ground.false_per_hectare,
            body_length_m=ground.body_length_m,
            scheduler=scheduler,
            unfinished=None if out is None else out / "tiles",
            progress=None if json else note,
        )
    maps.write(found, known.place)
    write_files(out, _files(found))
    if html is not None:
        magloc.view(None, found, html=html, title="survey")
    if json:
        from magloc.surveying.files import json_of_survey

        print_report(json_of_survey(found))
        return
    print(found.table())
    if found.pose_assumed:
        pose = found.array.pose
        size = "" if pose is None else f" {100.0 * pose.position_m:.2g} cm that last {pose.correlation_s:g} s"
        if pose is not None and pose.position_white_m:
            size += f", and {100.0 * pose.position_white_m:.2g} cm new in every row"
        note(f"nothing is stated of the pose's errors: as the rows show them{size}")


def _files(found: Survey) -> Iterator[tuple[str, Any]]:
    """Yield targets.csv, residual.csv, reach.csv, the map, and the lines past the targets."""
    from magloc.plots.profiles import survey_profiles
    from magloc.surveying.files import reach_columns, residual_columns

    yield "targets.csv", found.columns()
    yield "residual.csv", residual_columns(found)
    yield "reach.csv", reach_columns(found)
    yield "survey.png", found.plot()
    yield "profiles.png", survey_profiles(found)
