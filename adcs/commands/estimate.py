"""``adcs estimate``: attitude from a user's own telemetry."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from cyclopts import Parameter

from adcs.commands.common import Flag, QuietOptions, print_json, print_note
from adcs.scenario_files import AttitudeFile, Estimate, changed, estimate_of, naming, read_scenario
from adcs.scenario_tables import Filter
from arrays.errors import InputError

if TYPE_CHECKING:
    from adcs.multiplicative import Estimates
    from adcs.telemetry import TelemetryRecord

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
    from adcs.commands.attitude_runs import estimated
    from adcs.problems import warnings_of
    from adcs.telemetry import read_telemetry
    from magloc.output_files import make_folder, refuse_file

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
        from adcs.start import any_start

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
    from adcs.commands.run_tabletsat import ScenarioOptions

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


def estimate_columns(record: TelemetryRecord, estimates: Estimates) -> dict[str, Any]:
    """Columns of estimates.csv, at all instants.

    Parameters
    ----------
    record : TelemetryRecord
    estimates : Estimates

    Returns
    -------
    dict of str to ndarray, shape (n,)
        ``qw`` to ``qz`` is the attitude, orbital from body, ``eci_qw`` to ``eci_qz`` inertial from body.
    """
    from adcs import quaternion
    from adcs.commands.attitude_files import STATE_COLUMNS, sigma_in_units
    from adcs.telemetry import orbital_from_eci

    used = estimates.settings.sensors
    q = estimates.q[0]
    inertial = quaternion.multiply(quaternion.conjugate(orbital_from_eci(record.environment)[0]), q)
    columns: dict[str, Any] = {"time_s": record.time_s}
    columns |= dict(zip(("qw", "qx", "qy", "qz"), q.T, strict=True))
    columns |= dict(zip(("eci_qw", "eci_qx", "eci_qy", "eci_qz"), inertial.T, strict=True))
    values = values_in_units(estimates)[0].T
    sigma = sigma_in_units(estimates)[0].T
    there = [True, True, *(state in used.states for state in ("gyro-bias", "field-bias", "disturbance"))]
    for i, name in enumerate(STATE_COLUMNS):
        if there[i // 3]:
            if i >= 3:
                columns[name] = values[i]
            columns[f"sigma_{name}"] = sigma[i]
    for name, nis in zip(("star", "gyro", "field", "sun"), estimates.nis[0].T, strict=True):
        if not np.isnan(nis).all():
            columns[f"nis_{name}"] = nis
    return columns


def values_in_units(estimates: Estimates) -> Any:
    """Estimates (1, n, 15): attitude as rotation vector from the orbital frame [°], and the states in files' units."""
    from adcs import quaternion

    used = estimates.settings.sensors
    parts = [
        np.degrees(quaternion.log(estimates.q)),
        np.degrees(estimates.w),
        np.degrees(estimates.gyro_bias_rad_s) if used.gyro_bias else np.full_like(estimates.w, np.nan),
        1e9 * estimates.field_bias_T if used.field_bias else np.full_like(estimates.w, np.nan),
        estimates.disturbance_s2 if used.disturbance else np.full_like(estimates.w, np.nan),
    ]
    return np.concatenate(parts, axis=-1)


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
    from adcs.commands.attitude_files import sensor_gaps, sigma_in_units
    from adcs.plots.attitude_figures import ConsistencyPicture, StatesPicture, consistency_figure, states_figure
    from magloc.output_files import write_columns
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
