"""``adcs estimate``: attitude from a user's own telemetry."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import adcs
from adcs.cli.options import EstimateOptions, tell, warn
from arrays.io.errors import naming
from arrays.io.outputs import make_folder, refuse_file
from magloc.cli.framework import Flag, QuietOptions, print_result

if TYPE_CHECKING:
    from adcs.io.scenario_files import AttitudeFile


def estimate(
    telemetry: Path,
    /,
    *,
    config: Path,
    options: EstimateOptions = EstimateOptions(),
    out: Path | None = None,
    json: Flag = False,
    common: QuietOptions = QuietOptions(),  # noqa: B008 - frozen
) -> None:
    """Estimate attitude and rate from telemetry, with the filters of `adcs run`.

    The filter starts from the first readings; where they leave a turn open, from the turn that fits the readings of
    five minutes, or fifty of a magnetometer alone. `adcs run tabletsat --out DIR` writes an example: DIR/telemetry.csv
    with DIR/scenario.toml.

    Parameters
    ----------
    telemetry : Path
        CSV file: time_s, and any of star_qw, star_qx, star_qy, star_qz (inertial from body, scalar first), gyro_x_deg_s
        and so on, field_x_nT, sun_x, the wheels' momentum wheels_x_Nms and the moment commanded torquers_x_Am2, in body
        axes. Empty cells and missing rows are missing readings. Or an attitude ephemeris message of the CCSDS (.aem).
    config : Path
        Scenario file (TOML) of the satellite; time_s counts from its orbit's start. Its table log names other columns,
        UTC times, units, axes and conventions of quaternions.
    options : EstimateOptions
        What differs from the scenario file.
    out : Path, optional
        Folder for estimates.csv, the same as messages (attitude.aem, orbit.oem), and figures.
    json : bool
        Print one JSON object with one entry for every row.
    common : QuietOptions
        Common options.
    """
    from adcs.io.estimates import estimate_columns, rows_of, summary_lines

    refuse_file(out, "--out")
    scenario = adcs.read_scenario(str(config), allow_old_elements=options.allow_old_elements)
    scenario = scenario.changed({"estimate": options.estimate(scenario.estimate.states)})
    settings = scenario.estimator(f"{config}, table estimate")
    record = read_log(telemetry, scenario)
    with naming(str(telemetry)):
        track = adcs.estimate(record, scenario.satellite, sensors=settings)
    columns = estimate_columns(track)
    warn(common, track.warnings)
    if out is not None:
        make_folder(out, "--out")
        _write(out, scenario.name, track, columns)
        utc = adcs.frames.instants(scenario.satellite.start, track.time_s[track.rows])
        adcs.write_aem(out / "attitude.aem", utc, track.rotation[track.rows].as_quat())
        adcs.write_oem(out / "orbit.oem", utc, *scenario.satellite.orbit.position_velocity_eci(utc))
        tell(common, f"wrote estimates.csv, attitude.aem, orbit.oem, estimates.png and consistency.png into {out}")
    result = {"results": rows_of(columns), "warnings": [*scenario.warnings, *track.warnings]}
    print_result(result, summary_lines(track), as_json=json)


def read_log(path: Path, scenario: AttitudeFile) -> adcs.Telemetry:
    """Log of a table, or of an attitude ephemeris message."""
    if path.suffix.lower() != ".aem":
        return adcs.read_telemetry(path, scenario.step_s, layout=scenario.log)
    utc, q = adcs.read_aem(path)
    with naming(str(path)):
        return adcs.Telemetry((utc - scenario.satellite.start) / np.timedelta64(1, "s"), star=q, step_s=scenario.step_s)


def _write(out: Path, name: str, track: adcs.AttitudeTrack, columns: dict[str, Any]) -> None:
    from adcs.plots.attitude import nis_figure, track_figure
    from arrays.io.csv import write_columns
    from magloc.plots import style

    write_columns(columns, out / "estimates.csv")
    style.save(track_figure(track, name), out / "estimates.png")
    style.save(nis_figure(track, name), out / "consistency.png")
