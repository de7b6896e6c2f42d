"""``adcs calibrate``: calibration of a magnetometer by the field along the orbit."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from cyclopts import Parameter

import adcs
from adcs.satellite.magnetometer_calibration import NAMES, Attitude, MagnetometerCalibration
from arrays.io.errors import naming, naming_options
from arrays.io.outputs import refuse_unwritable
from arrays.io.tables import by_sigma
from magloc.cli.framework import Flag, QuietOptions, note, print_result, warn

_UNITS = {"bias": (1e9, "nT"), "gain": (100.0, "percent"), "time": (1.0, "s")}
_MISFIT = 5.0


def calibrate(
    telemetry: Path,
    /,
    *,
    config: Path,
    attitude: Attitude = "none",
    time_shift_s: Annotated[float, Parameter(name="--time-shift-s")] = 10.0,
    allow_old_elements: Flag = False,
    out: Path | None = None,
    json: Flag = False,
    common: QuietOptions = QuietOptions(),  # noqa: B008 - frozen
) -> None:
    """Calibrate the magnetometer of a log by the field along the orbit.

    Estimates gains, axes and bias, and the time shift of the positions. The command names what the log does not
    determine. The scenario file states the prior: noise_nT of the magnetometer, and field_bias_nT, field_gain,
    field_axes_deg, field_model_error_nT (150 for 0) and field_model_correlation_s of the table estimate.

    Parameters
    ----------
    telemetry : Path
        Telemetry (CSV), as for `adcs estimate`.
    config : Path
        Scenario file (TOML) of the satellite. time_s is in seconds from the start of its orbit.
    attitude : str
        Attitude of the satellite: unknown ("none"), so that only the modulus of each row counts and the mounting of the
        sensor stays unknown, or constant and unknown in the orbital frame ("orbital").
    time_shift_s : float
        Standard deviation of the time shift between positions and readings [s]; 0 for none.
    allow_old_elements : bool
        Also accept two-line elements 30 days or more from their epoch.
    out : Path, optional
        CSV file to write: the log with calibrated readings.
    json : bool
        Print one JSON object, instead of the text.
    common : QuietOptions
        Common options.
    """
    from adcs.kalman.error_state import FIELD_ERROR_T

    refuse_unwritable(out, "--out", ".csv")
    scenario = adcs.read_scenario(str(config), allow_old_elements=allow_old_elements)
    with naming(str(config)), naming_options("time_shift_s"):
        prior = adcs.MagnetometerPrior(
            noise_T=scenario.satellite.magnetometer.sigma_T,
            bias_T=1e-9 * scenario.estimate.field_bias_nT,
            gain=scenario.estimate.field_gain,
            axes_rad=math.radians(scenario.estimate.field_axes_deg),
            field_error_T=1e-9 * scenario.estimate.field_model_error_nT or FIELD_ERROR_T,
            field_correlation_s=scenario.estimate.field_model_correlation_s,
            time_shift_s=time_shift_s,
        )
    log = adcs.read_telemetry(telemetry, scenario.step_s, layout=scenario.log)
    with naming(str(telemetry)):
        result = adcs.calibrate_magnetometer(log, scenario.satellite, prior=prior, attitude=attitude)
    if out is not None:
        _write(out, log, result)
        note(f"wrote {out}")
    warn(warnings_of(result))
    told = {"warnings": [*scenario.warnings, *warnings_of(result)]}
    print_result(report(result) | told, lines(result, attitude), as_json=json)


def warnings_of(result: MagnetometerCalibration) -> list[str]:
    """Return warnings on what the log does not determine, and on what does not fit."""
    texts = []
    if result.undetermined:
        texts.append(
            f"this log does not determine {', '.join(result.undetermined)}: the prior stays, with its deviation"
        )
    if result.misfit > _MISFIT:
        ratio = math.sqrt(result.chi2 / result.dof)
        texts.append(
            f"residuals are {ratio:.1f} times what noise and errors of the model explain: deviations are too small"
        )
    left_out = len(result.used) - int(result.used.sum())
    if left_out:
        texts.append(f"{left_out} rows are missing or too far off, and are not used")
    return texts


def report(result: MagnetometerCalibration) -> dict[str, Any]:
    """Return the report that ``--json`` prints."""
    values = np.concatenate([result.bias_T, result.gain.ravel(), [result.time_shift_s]])
    numbers: dict[str, Any] = {}
    for name, value, sigma in zip(NAMES, values, result.sigma, strict=True):
        scale, unit = _UNITS[name.split("_")[0]]
        column = f"{name}_{unit}"
        numbers |= {column: scale * float(value), f"sigma_{column}": scale * float(sigma)}
    return {
        **numbers,
        "rms_nT": 1e9 * result.rms_T,
        "raw_rms_nT": 1e9 * result.raw_rms_T,
        "chi2": result.chi2,
        "dof": result.dof,
        "rows": len(result.used),
        "rows_used": int(result.used.sum()),
        "undetermined": list(result.undetermined),
    }


def lines(result: MagnetometerCalibration, attitude: Attitude) -> list[str]:
    """Return the result as text."""
    what = "modulus" if attitude == "none" else "component, constant attitude in the orbital frame"
    sigma = result.sigma

    def row(values: Any, deviations: Any, scale: float) -> str:
        pairs = (by_sigma(scale * float(v), scale * float(s)) for v, s in zip(values, deviations, strict=True))
        return ", ".join(f"{v} (1σ {s})" for v, s in pairs)

    return [
        f"{result.used.sum()} of {len(result.used)} rows; rms of the {what}: "
        f"{1e9 * result.raw_rms_T:.4g} nT before, {1e9 * result.rms_T:.4g} nT after",
        f"{'bias, x y z [nT]':27s}{row(result.bias_T, sigma[:3], 1e9)}",
        *(
            f"{f'D, row {axis} [%]':27s}{row(result.gain[i], sigma[3 + 3 * i : 6 + 3 * i], 100.0)}"
            for i, axis in enumerate("xyz")
        ),
        f"{'time shift [s]':27s}{row([result.time_shift_s], sigma[12:], 1.0)}",
        f"{'χ² / rows (1 is consistent)':27s} {result.chi2 / result.dof:.3g}",
    ]


def _write(out: Path, log: adcs.Telemetry, result: MagnetometerCalibration) -> None:
    from adcs.io.telemetry_files import telemetry_columns
    from arrays.io.csv import write_columns

    columns = telemetry_columns(log)
    field_nT = 1e9 * result.applied(log.field_T)
    columns |= {f"field_{axis}_nT": field_nT[:, i] for i, axis in enumerate("xyz")}
    write_columns(columns, out)
