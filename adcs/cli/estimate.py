"""``adcs estimate``: attitude from a user's own telemetry."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from cyclopts import Parameter

from adcs.cli.options import print_note
from adcs.io.scenario_files import AttitudeFile, changed, estimate_of, read_scenario
from adcs.kalman.bank import Estimate, Filter
from arrays.io.arguments import Flag
from arrays.io.errors import InputError, naming
from magloc.cli.framework import QuietOptions, print_json

if TYPE_CHECKING:
    from adcs.io.telemetry_files import TelemetryRecord
    from adcs.kalman.error_state import Estimates
from adcs.io.estimates import estimate_columns, values_in_units

_WORDS = {"st": "star tracker", "gyro": "gyro", "mag": "magnetometer", "sun": "Sun sensor"}


@Parameter(name="*")
@dataclass(frozen=True)
class EstimateOptions:
    """What replaces keys of the scenario file; by default nothing does.

    Parameters
    ----------
    sensors : str
        Sensors in use: any of st, gyro, mag and sun that observe attitude, in any order.
    states : str
        What is estimated besides attitude and rate: any of gyro-bias, field-bias and disturbance with commas, or none.
    filter : str
        As of `adcs run tabletsat`.
    """

    sensors: str | None = None
    states: str | None = None
    filter: Filter | None = None


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
    five minutes. `adcs run tabletsat --out DIR` writes an example: DIR/telemetry.csv with DIR/scenario.toml.

    Parameters
    ----------
    telemetry : Path
        CSV file: time_s, and any of star_qw, star_qx, star_qy, star_qz (inertial from body, scalar first), gyro_x_deg_s
        and so on, field_x_nT, sun_x, and the wheels' momentum wheels_x_Nms, in body axes. Empty cells and missing rows
        are missing readings.
    config : Path
        Scenario file (TOML) of the satellite; time_s counts from its orbit's start.
    options : EstimateOptions
        What differs from the scenario file.
    out : Path, optional
        Folder for estimates.csv and figures.
    json : bool
        Print one JSON object with one entry for every row.
    common : QuietOptions
        Common options.
    """
    from adcs.io.telemetry_files import read_telemetry
    from adcs.kalman.bank import estimated
    from adcs.kalman.diagnostics import warnings_of
    from arrays.io.outputs import make_folder, refuse_file

    if out is not None:
        refuse_file(out, "--out")
    file, chosen = _wanted(config, options)
    record = read_telemetry(telemetry, file)
    for name in chosen.settings.sensors.sensors.split("+"):
        if name not in record.sensors:
            raise InputError(
                f"{telemetry}: found no reading of the {_WORDS[name]}, expected some because the sensors in use are "
                f"{chosen.settings.sensors.sensors}."
            )
    record = _from_first_direction(record, chosen, str(telemetry))
    with naming(str(telemetry)):
        from adcs.kalman.initialisation import any_start

        start = any_start(record, chosen.settings)
    estimates = estimated(record, chosen, start)
    if not np.isfinite(estimates.q).all():
        raise InputError(f"{telemetry}: found readings that no attitude explains: the filter has failed.")
    columns = estimate_columns(record, estimates)
    warnings = list(warnings_of(record, estimates)[0])
    if not common.quiet:
        for text in warnings:
            print_note(f"warning: {text}")
    if out is not None:
        make_folder(out, "--out")
        _write(out, file, chosen, record, estimates, columns)
        if not common.quiet:
            print_note(f"wrote estimates.csv, estimates.png and consistency.png into {out}")
    if json:
        print_json({"results": _entries(columns, record.rows), "warnings": warnings})
    else:
        print("\n".join(summary_lines(chosen, record, estimates, columns)))


def _wanted(config: Path, options: EstimateOptions) -> tuple[AttitudeFile, Estimate]:
    from adcs.cli.options import ScenarioOptions

    replaced = ScenarioOptions(sensors=options.sensors, states=options.states, filter=options.filter)
    file = changed(read_scenario(str(config)), replaced.changes(None))
    return file, estimate_of(f"{config}, table estimate", file.estimate)


def _from_first_direction(record: TelemetryRecord, chosen: Estimate, place: str) -> TelemetryRecord:
    """The log from the first instant on that tells something of the attitude."""
    used, readings = chosen.settings.sensors, record.readings
    told = [
        values[0, :, 0]
        for values, wanted in (
            (readings.star, used.star),
            (readings.field_T, used.magnetometer),
            (readings.sun, used.sun),
        )
        if wanted
    ]
    known = ~np.isnan(np.stack(told)).all(axis=0)
    if chosen.filter == "reduced":
        known &= ~np.isnan(readings.gyro_rad_s[0, :, 0])
    rows = np.flatnonzero(known)
    if not rows.size:
        raise InputError(f"{place}: found no reading that tells the attitude, expected one of {used.sensors}.")
    return record.since(int(rows[0]))


def _entries(columns: dict[str, Any], rows: Any) -> list[dict[str, Any]]:
    """One entry for every row of the log."""
    names = list(columns)
    table = np.stack([columns[name] for name in names], axis=1)[rows]
    return [dict(zip(names, row, strict=True)) for row in table.tolist()]


def _write(
    out: Path,
    file: AttitudeFile,
    chosen: Estimate,
    record: TelemetryRecord,
    estimates: Estimates,
    columns: dict[str, Any],
) -> None:
    from adcs.kalman.results import sensor_gaps, sigma_in_units
    from adcs.plots.attitude import ConsistencyPicture, StatesPicture, consistency_figure, states_figure
    from arrays.io.csv import write_columns
    from magloc.plots import style

    write_columns({name: values[record.rows] for name, values in columns.items()}, out / "estimates.csv")
    title = f"{file.name}: {chosen.in_words}"
    gaps = sensor_gaps(record, chosen.settings.sensors)
    picture = StatesPicture(
        title,
        record.time_s,
        values_in_units(estimates)[0],
        sigma_in_units(estimates)[0],
        are_errors=False,
        gaps=gaps,
    )
    style.save(states_figure(picture), out / "estimates.png")
    size = chosen.settings.sensors.size
    consistency = ConsistencyPicture(title, record.time_s, None, None, None, size, estimates.nis)
    style.save(consistency_figure(consistency), out / "consistency.png")


def summary_lines(
    chosen: Estimate, record: TelemetryRecord, estimates: Estimates, columns: dict[str, Any]
) -> list[str]:
    """The result as text: what is known at the end, and how well readings fit.

    Parameters
    ----------
    chosen : Estimate
    record : TelemetryRecord
    estimates : Estimates
    columns : dict
        Of :func:`estimate_columns`.

    Returns
    -------
    list of str
    """
    lines = [f"{len(record.rows)} rows from {record.time_s[0]:g} to {record.time_s[-1]:g} s; {chosen.in_words}"]
    q = ", ".join(f"{columns[name][-1]:.6f}" for name in ("qw", "qx", "qy", "qz"))
    lines.append(f"attitude at the end, orbital from body (w, x, y, z)   {q}")
    for first, what, unit in (
        ("attitude_x_deg", "attitude, 1σ", "°"),
        ("rate_x_deg_s", "rate", "°/s"),
        ("gyro_bias_x_deg_s", "bias of the gyro", "°/s"),
        ("field_bias_x_nT", "bias of the magnetometer", "nT"),
        ("disturbance_x_s2", "disturbing acceleration", "1/s²"),
    ):
        names = [first.replace("_x_", f"_{axis}_") for axis in "xyz"]
        if f"sigma_{first}" not in columns:
            continue
        sigma = max(float(columns[f"sigma_{name}"][-1]) for name in names)
        if first in columns:
            values = ", ".join(f"{columns[name][-1]:.3g}" for name in names)
            lines.append(f"{what:27s}{values} {unit} (1σ {sigma:.2g})")
        else:
            lines.append(f"{what:27s}{sigma:.2g} {unit}")
    for name, numbers in (("star", 3), ("gyro", 3), ("field", 3), ("sun", 2)):
        if f"nis_{name}" in columns:
            nis = float(np.nanmean(columns[f"nis_{name}"])) / numbers
            lines.append(f"NIS of {name} / {numbers} (1 is consistent){'':3s}{nis:.3g}")
    return lines
