"""``adcs vectors``: attitude of every row of a log from field and Sun alone."""

from __future__ import annotations

from pathlib import Path

import adcs
from adcs.cli.options import tell
from adcs.satellite.wahba import VectorMethod
from arrays.io.errors import naming
from arrays.io.outputs import make_folder, refuse_file
from magloc.cli.framework import Flag, QuietOptions, print_result


def vectors(
    telemetry: Path,
    /,
    *,
    config: Path,
    method: VectorMethod = "quest",
    allow_old_elements: Flag = False,
    out: Path | None = None,
    json: Flag = False,
    common: QuietOptions = QuietOptions(),  # noqa: B008 - frozen
) -> None:
    """Attitude of every row that has magnetometer and Sun sensor, each row on its own: TRIAD, or Wahba's problem.

    Parameters
    ----------
    telemetry : Path
        Log, as of `adcs estimate`.
    config : Path
        Scenario file, as of `adcs estimate`: its orbit, the noise of both sensors, its table log.
    method : str
        Least squares of both vectors ("quest"), or the Sun exactly and the field for the turn around it ("triad").
    allow_old_elements : bool
        Take two-line elements 30 days or more from their epoch too.
    out : Path, optional
        Folder for vectors.csv.
    json : bool
        Print one JSON object with one entry for every such row.
    common : QuietOptions
        Common options.
    """
    from adcs.io.estimates import estimate_columns, rows_of, summary_lines
    from arrays.io.csv import write_columns

    refuse_file(out, "--out")
    scenario = adcs.read_scenario(str(config), allow_old_elements=allow_old_elements)
    record = adcs.read_telemetry(telemetry, scenario.step_s, layout=scenario.log)
    with naming(str(telemetry)):
        track = adcs.vector_attitude(record, scenario.satellite, method=method)
    columns = estimate_columns(track)
    if out is not None:
        make_folder(out, "--out")
        write_columns(columns, out / "vectors.csv")
        tell(common, f"wrote vectors.csv into {out}")
    print_result({"results": rows_of(columns)}, summary_lines(track), as_json=json)
