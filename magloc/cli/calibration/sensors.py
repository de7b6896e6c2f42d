"""Options and tables of an array's sensors that all kinds of calibration share."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

import magloc
from arrays.io.errors import InputError
from arrays.io.tables import align
from magloc.cli.options import refuse_not_positive

if TYPE_CHECKING:
    from arrays.array import SensorArray
    from magloc.calibration.array import CalibrationPrior
    from magloc.calibration.bodies.results import BodyCalibration
    from magloc.calibration.results import Calibration, SourceCalibration, TurningCalibration


@Parameter(name="*", group="What is known of the array")
@dataclass(frozen=True)
class PriorOptions:
    """Accuracy of the array file before the calibration.

    Parameters
    ----------
    estimate : str
        Quantities to estimate: some of positions, gains, axes, offsets, separated by commas. The others
        stay as in the array file.
    trust_position : str
        Ids of sensors, separated by commas, whose positions in the array file are exact.
    trust_scale : str
        Ids of sensors, separated by commas, whose gains and axes in the array file are exact.
    position_prior_mm : float
        Standard deviation of a position in the array file, per axis [mm]; by default 5, with --body 0.5.
    gain_prior : float
        Standard deviation of a gain in the array file (0.2 = 20 %).
    axes_prior_deg : float
        Standard deviation of the direction of a channel [°].
    offset_prior_nT : float
        Standard deviation of an offset [nT].
    """

    estimate: str = "positions,gains,axes,offsets"
    trust_position: str = ""
    trust_scale: str = ""
    position_prior_mm: float | None = None
    gain_prior: float = 0.2
    axes_prior_deg: float = 3.0
    offset_prior_nT: Annotated[float, Parameter(name="--offset-prior-nT")] = 1e5


def sensor_prior(options: PriorOptions, array: SensorArray, path: Path, position_mm: float = 5.0) -> CalibrationPrior:
    """Return the prior that the options state; `position_mm` where they state no position."""
    from magloc.calibration.array import QUANTITIES

    quantities = names_of(options.estimate)
    for name in quantities or [""]:
        if name not in QUANTITIES:
            raise InputError(f"--estimate: found {name!r}, expected some of {', '.join(QUANTITIES)}.")
    for option, ids in (("--trust-position", options.trust_position), ("--trust-scale", options.trust_scale)):
        for name in names_of(ids):
            if name not in array.ids:
                raise InputError(
                    f"{option}: found {name!r}, expected ids of sensors in {path}: {', '.join(array.ids)}."
                )
    refuse_not_positive(options, "position_prior_mm", "gain_prior", "axes_prior_deg", "offset_prior_nT")
    return magloc.CalibrationPrior(
        position_m=1e-3 * (position_mm if options.position_prior_mm is None else options.position_prior_mm),
        gain=options.gain_prior,
        axes_rad=math.radians(options.axes_prior_deg),
        offset_T=options.offset_prior_nT * 1e-9,
        estimate=tuple(quantity for quantity in QUANTITIES if quantity in quantities),
        trusted_positions=tuple(names_of(options.trust_position)),
        trusted_scales=tuple(names_of(options.trust_scale)),
    )


def names_of(text: str) -> list[str]:
    """Return the names in a text, separated by commas."""
    return [name.strip() for name in text.split(",")] if text else []


def fit_entries(result: SourceCalibration | BodyCalibration, n_rows: int) -> dict[str, Any]:
    """Return rows, χ² and iterations of a fit to `n_rows` rows, as ``--json`` prints them."""
    return {
        "rows": n_rows,
        "rows_used": int(result.rows.sum()),
        "chi2_before": result.chi2_before,
        "dof_before": result.dof_before,
        "chi2_after": result.chi2,
        "dof_after": result.dof,
        "iterations": result.iterations,
        "converged": result.converged,
    }


def fit_notes(result: SourceCalibration | BodyCalibration, n_rows: int, nominal: str) -> list[str]:
    """Return notes on rows and χ² of a fit to `n_rows` rows, and on the directions that stay as in `nominal`."""
    notes = [
        f"{int(result.rows.sum())} of {n_rows} rows used; χ² {result.chi2_before:.4g} with {result.dof_before:.0f} "
        f"degrees of freedom before, {result.chi2:.4g} with {result.dof:.0f} after"
    ]
    if result.unobservable:
        names = "; ".join(direction.name for direction in result.unobservable)
        notes.append(f"not determined by the readings, kept as in {nominal}: {names}")
    return notes


def sensor_entries(result: SourceCalibration | BodyCalibration) -> list[dict[str, Any]]:
    """Return the sensors that ``--json`` prints."""
    from magloc.calibration.sensors import AXES, GAINS, OFFSET, POSITION

    return [
        {
            "id": sensor.id,
            "position_m": sensor.position_m,
            "position_sd_m": sd[POSITION],
            "scale": sensor.calibration.scale,
            "gain_sd": sd[GAINS],
            "axes_sd_rad": sd[AXES],
            "offset_nT": [1e9 * offset for offset in sensor.calibration.offset_T],
            "offset_sd_nT": 1e9 * sd[OFFSET],
            "residual_rms_nT": 1e9 * rms,
        }
        for sensor, sd, rms in zip(result.array.sensors, result.sigma, result.residual_rms_T.tolist(), strict=True)
    ]


def unobservable_entries(result: Calibration) -> list[dict[str, Any]]:
    """Return the directions that the readings do not determine, as ``--json`` prints them."""
    return [{"name": each.name, "information": each.information, "prior": each.prior} for each in result.unobservable]


def sensor_table(result: SourceCalibration | BodyCalibration) -> list[str]:
    """Return the changes of every sensor, with the largest standard deviation of each group."""
    import numpy as np

    from magloc.calibration.sensors import AXES, GAINS, OFFSET, POSITION
    from magloc.cli.calibration import by_turning as turning

    rows = [["sensor", "position mm", "s", "gain %", "s", "axes °", "s", "offset µT", "s", "rms nT", ""]]
    for sensor, change, sd, rms in zip(
        result.array.ids, result.change, result.sigma, result.residual_rms_T, strict=True
    ):
        cells = [
            *turning.values_by_sigma(1e3 * change[POSITION], 1e3 * sd[POSITION]),
            *turning.values_by_sigma(100.0 * change[GAINS], 100.0 * sd[GAINS]),
            *turning.values_by_sigma(np.degrees(np.abs(change[AXES]).max(keepdims=True)), np.degrees(sd[AXES])),
            *turning.values_by_sigma(1e6 * change[OFFSET], 1e6 * sd[OFFSET]),
        ]
        rows.append([sensor, *cells, f"{1e9 * rms:.1f}", ""])
    return align(rows, left=1)


def calibration_files(result: SourceCalibration | TurningCalibration | BodyCalibration) -> Iterator[tuple[str, Any]]:
    """Yield the figure of a calibration, and the data behind it."""
    from magloc.calibration.results import TurningCalibration
    from magloc.plots.calibrations import columns_of_calibration

    name = "turning" if isinstance(result, TurningCalibration) else "calibration"
    yield f"{name}.png", result.plot()
    yield f"{name}.csv", columns_of_calibration(result)
