"""``adcs loads``: fields and places of loads that switch on board."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import adcs
import arrays
from arrays.io.errors import naming
from arrays.io.outputs import refuse_unwritable
from magloc.cli.framework import Flag, QuietOptions, note, print_result, warn

if TYPE_CHECKING:
    from arrays.typing import FloatArray
    from magloc.localization.fit.results import Fix


def loads(
    readings: Path,
    /,
    *,
    array: Path,
    loads: str = "",
    window_s: float = 8.0,
    out: Path | None = None,
    json: Flag = False,
    common: QuietOptions = QuietOptions(),  # noqa: B008 - frozen
) -> None:
    """Find the fields of loads, magnets and torquers that switch on board, at each magnetometer.

    Each switch is a step in the readings, and the gyro measures how the satellite turns meanwhile. The command needs no
    model of the Earth's field. If states and readings have different clocks, a warning states the lag, and the fields
    are corrected for it. With three magnetometers or more the command also locates every load as a dipole, which
    identifies it and gives its torque. It subtracts the estimated field, not the dipole's.

    Parameters
    ----------
    readings : Path
        CSV file with time_s, the readings of the array's magnetometers, gyro_x_deg_s with y and z, and a column with
        the state of each load, such as 0 and 1, or its current.
    array : Path
        Array file (TOML) of the magnetometers, in body axes.
    loads : str
        Columns of the loads, separated by commas; by default all columns without a unit.
    window_s : float
        Time before and after a switch that is used [s].
    out : Path, optional
        CSV file to write: the same log without the fields of the loads.
    json : bool
        Print one JSON object, instead of the text.
    common : QuietOptions
        Common options.
    """
    from adcs.io.load_files import channel_columns, read_load_log
    from arrays.io.csv import write_columns

    refuse_unwritable(out, "--out", ".csv")
    sensors = arrays.read_array(array)
    log = read_load_log(readings, sensors, [name.strip() for name in loads.split(",") if name.strip()])
    with naming(str(readings)):
        own = adcs.find_own_fields(sensors, log.readings_T, log.time_s, log.gyro_rad_s, log.states, window_s=window_s)
    with naming(str(array)):
        located = own.located() if sensors.n_sensors >= _LEAST_SENSORS else {}
    warn(own.warnings)
    if out is not None:
        clean_nT = 1e9 * own.subtracted(log.readings_T, log.states, log.time_s)
        write_columns(log.columns | dict(zip(channel_columns(sensors), clean_nT.T, strict=True)), out)
        note(f"wrote {out}")
    print_result(report(own, located), lines(own, located), as_json=json)


_LEAST_SENSORS = 3


def report(own: adcs.OwnFields, located: dict[str, Fix]) -> dict[str, Any]:
    """Return the report that ``--json`` prints."""
    results = []
    for name, vectors, sigma, switches in zip(own.names, own.vectors_T, own.sigma_T, own.switches, strict=True):
        entry: dict[str, Any] = {
            "load": name,
            "switches": int(switches),
            "field_nT": dict(zip(own.array.ids, (1e9 * vectors).tolist(), strict=True)),
            "sigma_nT": dict(zip(own.array.ids, (1e9 * sigma).tolist(), strict=True)),
            "position_m": None,
            "moment_Am2": None,
            "covariance": None,
        }
        if name in located and located[name].solutions:
            best = located[name].best
            entry["position_m"], entry["moment_Am2"] = best.position_m.tolist(), best.moment_Am2.tolist()
            entry["covariance"] = best.covariance.tolist()
        results.append(entry)
    return {
        "results": results,
        "noise_nT": dict(zip(own.array.ids, (1e9 * own.noise_T).tolist(), strict=True)),
        "chi2_per_dof": own.chi2_per_dof,
        "lag_rows": own.lag.rows if own.lag.is_known else None,
        "lag_bounds_rows": [own.lag.least_rows, own.lag.most_rows] if own.lag.is_known else None,
        "lag_s": own.lag.seconds if own.lag.is_known else None,
        "warnings": list(own.warnings),
    }


def lines(own: adcs.OwnFields, located: dict[str, Fix]) -> list[str]:
    """Return the result as text."""
    import numpy as np

    noise = ", ".join(f"{name} {1e9 * one:.3g}" for name, one in zip(own.array.ids, own.noise_T, strict=True))
    lag = f"{own.lag.rows:g} rows, {own.lag.seconds:.3g} s" if own.lag.is_known else "not determined by these switches"
    text = [
        f"noise of the residuals [nT]: {noise}; χ² / numbers (1 if noise is as stated): {own.chi2_per_dof:.3g}",
        f"readings later than states by: {lag}",
    ]
    for name, vectors, sigma, switches in zip(own.names, own.vectors_T, own.sigma_T, own.switches, strict=True):
        text.append(f"{name}: {switches} switches")
        for sensor, field, deviation in zip(own.array.ids, vectors, sigma, strict=True):
            text.append(_line(f"field at {sensor} [nT]", 1e9 * field, 1e9 * deviation))
        if name not in located:
            continue
        if not located[name].solutions:
            text.append(f"  not located: {located[name].reason}")
            continue
        best = located[name].best
        deviations = np.sqrt(np.diagonal(best.covariance))
        text.append(_line("place [mm]", 1e3 * best.position_m, 1e3 * deviations[:3]))
        text.append(_line("moment [A·m²]", best.moment_Am2, deviations[3:]))
    return text


def _line(words: str, values: FloatArray, deviations: FloatArray) -> str:
    shown = ", ".join(f"{value:9.4g}" for value in values)
    return f"  {words:24s}{shown} (1σ {deviations.max():.2g})"
