"""``adcs estimate``: attitude and rate from telemetry."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import adcs
from adcs.cli.options import EstimateOptions, ReportOptions
from arrays.io.errors import naming
from magloc.cli.framework import warn

if TYPE_CHECKING:
    from adcs.io.scenario_files import AttitudeFile


def estimate(
    telemetry: Path,
    /,
    *,
    config: Path,
    options: EstimateOptions = EstimateOptions(),
    report: ReportOptions = ReportOptions(),  # noqa: B008 - frozen
) -> None:
    """Estimate attitude and rate from telemetry, with the filters of `adcs run`.

    The filter starts from the first readings. If these do not determine the attitude, it starts from the attitude that
    fits the readings of five minutes, or of fifty minutes with a magnetometer alone. `adcs run tabletsat --out DIR`
    writes an example: DIR/telemetry.csv and DIR/scenario.toml. --out writes estimates.csv, CCSDS messages
    (attitude.aem, orbit.oem) and figures. --json has one entry for every row.

    Parameters
    ----------
    telemetry : Path
        CSV file with time_s and any of star_qw, star_qx, star_qy, star_qz (inertial from body, scalar first),
        gyro_x_deg_s, field_x_nT, sun_x, the momentum of the wheels wheels_x_Nms and the commanded moment
        torquers_x_Am2, with y and z, in body axes. Empty cells and missing rows are missing readings. Or an attitude
        ephemeris message of the CCSDS (.aem).
    config : Path
        Scenario file (TOML) of the satellite. time_s is from the start of its orbit. Its table log states other
        names of columns, UTC times, units, axes and conventions of quaternions.
    options : EstimateOptions
        Values that replace those of the scenario file.
    report : ReportOptions
        Outputs.
    """
    from adcs.io.estimates import rows_of, summary_lines

    report.check()
    scenario = adcs.read_scenario(str(config), allow_old_elements=options.allow_old_elements)
    scenario = scenario.changed({"estimate": options.estimate(scenario.estimate.states)})
    settings = scenario.estimator(f"{config}, table estimate")
    record = read_log(telemetry, scenario)
    with naming(str(telemetry)):
        track = adcs.estimate(record, scenario.satellite, sensors=settings)
    warn(track.warnings)
    report.write(_files(track, scenario))
    result = {"results": rows_of(track.columns()), "warnings": [*scenario.warnings, *track.warnings]}
    report.print(result, summary_lines(track))


def read_log(path: Path, scenario: AttitudeFile) -> adcs.Telemetry:
    """Read telemetry from a table or from an attitude ephemeris message."""
    if path.suffix.lower() != ".aem":
        return adcs.read_telemetry(path, scenario.step_s, layout=scenario.log)
    utc, q = adcs.read_aem(path)
    with naming(str(path)):
        return adcs.Telemetry((utc - scenario.satellite.start) / np.timedelta64(1, "s"), star=q, step_s=scenario.step_s)


def _files(track: adcs.AttitudeTrack, scenario: AttitudeFile) -> Iterator[tuple[str, Any]]:
    """Yield the estimates as a table, as messages and as figures."""
    from adcs.plots.attitude import attitude_figure, nis_figure

    yield "estimates.csv", track.columns()
    utc = adcs.frames.instants(scenario.satellite.start, track.time_s[track.rows])
    yield "attitude.aem", lambda path: adcs.write_aem(path, utc, track.rotation[track.rows].as_quat())
    yield "orbit.oem", lambda path: adcs.write_oem(path, utc, *scenario.satellite.orbit.position_velocity_eci(utc))
    yield "estimates.png", attitude_figure(track, scenario.name)
    yield "consistency.png", nis_figure(track, scenario.name)
