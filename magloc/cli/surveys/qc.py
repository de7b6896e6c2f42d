"""``magloc qc``: quality of a field log."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

import magloc
from arrays.io.errors import naming
from arrays.io.outputs import refuse_file, write_files
from arrays.typing import Vector
from magloc.cli.framework import Flag, QuietOptions, print_report
from magloc.cli.options import KnownOptions, LogOptions, in_ambient_field
from magloc.cli.surveys.ground import SurfaceOptions


def qc(
    readings: Annotated[list[Path], Parameter(negative_iterable="")],
    /,
    *,
    log: LogOptions = LogOptions(),  # noqa: B008 - frozen
    surface: SurfaceOptions = SurfaceOptions(),  # noqa: B008 - frozen
    sensors: str | None = None,
    place: Vector | None = None,
    date: str | None = None,
    out: Path | None = None,
    json: Flag = False,
    common: QuietOptions = QuietOptions(),  # noqa: B008 - frozen
) -> None:
    """Check the quality of a field log before a survey.

    The table lists rate, jitter, gaps, lines, speed, height, spacing and coverage. For every sensor it lists the noise
    (from the fourth difference), missing, stuck and wild readings, and the heading error. The lag between readings and
    poses needs a target that lines pass both ways. A remark names a fault.

    Parameters
    ----------
    readings : list of Path
        Readings files (CSV), in order of time.
    log : LogOptions
        Sensors and columns of the readings: --array or --instrument.
    surface : SurfaceOptions
        Surface of the ground.
    sensors : str
        Ids of the sensors to check, separated by commas. By default all.
    place : tuple of 3 floats
        Latitude, longitude [deg] and height [m] of the origin of the world frame. With --date scalar sensors get the
        ambient field from it, which the lag needs.
    date : str
        Date of the readings, such as 2026-11-21; needs a place.
    out : Path
        Folder for qc.csv, the table, and qc.png: lines by their height, strips between them, speed, and noise.
    json : bool
        Print one JSON object instead of the table.
    common : QuietOptions
        Common options.
    """
    refuse_file(out, "--out")
    surface.refuse()
    known = KnownOptions(sensors=sensors, place=place, date=date)
    used, known = known.on_earth(known.select(log.sensors(readings[0]), log.name), readings[0])
    where = None if known.place is None or known.date is None else known.where
    parts = [magloc.read_readings(path, used, sensors=known.ids, ordered=True) for path in readings]
    ground, parts, _ = surface.below(readings, parts, used, known.place)
    fields = [in_ambient_field(used, part, where) for part in parts]
    with naming(", ".join(map(str, readings)), array=log.name):
        quality = magloc.check_quality(fields[0][0], [rows for _, rows in fields], ground_m=ground)
    write_files(out, _files(quality) if out is not None else ())
    if json:
        print_report(quality.entries)
        return
    print(quality.table())


def _files(quality: magloc.Quality) -> list[tuple[str, object]]:
    return [("qc.csv", quality.columns()), ("qc.png", quality.plot())]
