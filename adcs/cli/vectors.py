"""``adcs vectors``: attitude of every row from field and Sun alone."""

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
    """Compute the attitude of every row with magnetometer and Sun sensor, each row on its own.

    --out writes vectors.csv; --json has one entry for every such row.

    Parameters
    ----------
    telemetry : Path
        Telemetry, as for `adcs estimate`.
    config : Path
        Scenario file, as for `adcs estimate`; its orbit, the noise of both sensors and its table log are used.
    method : str
        Least squares of both vectors ("quest"), or the Sun exactly and the field for the rotation about it ("triad").
    allow_old_elements : bool
        Also accept two-line elements 30 days or more from their epoch.
    report : ReportOptions
        Outputs.
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
