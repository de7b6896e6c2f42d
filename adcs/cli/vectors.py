"""``adcs vectors``: attitude of every row of a log from field and Sun alone."""

from __future__ import annotations

from pathlib import Path

import adcs
from adcs.cli.options import ReportOptions
from adcs.satellite.wahba import VectorMethod
from arrays.io.errors import naming
from magloc.cli.framework import Flag


def vectors(
    telemetry: Path,
    /,
    *,
    config: Path,
    method: VectorMethod = "quest",
    allow_old_elements: Flag = False,
    report: ReportOptions = ReportOptions(),  # noqa: B008 - frozen
) -> None:
    """Attitude of every row that has magnetometer and Sun sensor, each row on its own: TRIAD, or Wahba's problem.

    --out writes vectors.csv; --json has one entry for every such row.

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
    report : ReportOptions
        Where the result goes.
    """
    from adcs.io.estimates import rows_of, summary_lines

    report.check()
    scenario = adcs.read_scenario(str(config), allow_old_elements=allow_old_elements)
    record = adcs.read_telemetry(telemetry, scenario.step_s, layout=scenario.log)
    with naming(str(telemetry)):
        track = adcs.vector_attitude(record, scenario.satellite, method=method)
    columns = track.columns()
    report.write([("vectors.csv", columns)])
    report.print({"results": rows_of(columns)}, summary_lines(track))
