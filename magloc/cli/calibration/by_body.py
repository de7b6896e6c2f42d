"""``magloc calibrate --body``: the magnets of a body together with the sensors of an array."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cyclopts import Parameter

import arrays
from arrays.io.errors import InputError, naming
from arrays.io.outputs import refuse_one_for_two, refuse_unwritable, write_files
from arrays.io.tables import align
from magloc.cli.calibration.sensors import (
    PriorOptions,
    calibration_files,
    fit_entries,
    fit_notes,
    sensor_entries,
    sensor_prior,
    sensor_table,
    unobservable_entries,
)
from magloc.cli.framework import Flag, note, print_result, refuse_outside
from magloc.cli.options import array_of_several, refuse_not_positive

if TYPE_CHECKING:
    from magloc.calibration.bodies.results import BodyCalibration, PoseErrors

_POSITION_MM = 0.5
_EXCESS = 3.0  # χ²/dof: 1.7 times the stated noise
_CHECK = "Check the noise of the array file, and the positions, the order qx, qy, qz, qw and the errors of --truth"


@Parameter(name="*", group="Body of several magnets")
@dataclass(frozen=True)
class BodyOptions:
    """Body whose magnets are calibrated together with the sensors.

    Parameters
    ----------
    body : Path
        Body file (TOML) to start from. Uncertainties in it and in the array file are the prior.
    out_body : Path
        Body file to write.
    free_rows : bool
        Use rows without a pose in --truth too, and estimate their poses.
    magnet_position_prior_mm : float
        Standard deviation of a magnet's position, per axis, where the body file states none [mm].
    magnet_strength_prior : float
        Standard deviation of a magnet's strength, where the body file states none (0.1 = 10 %).
    magnet_direction_prior_deg : float
        Standard deviation of a magnet's direction, where the body file states none [°].
    """

    body: Path | None = None
    out_body: Path | None = None
    free_rows: Flag = False
    magnet_position_prior_mm: float = _POSITION_MM
    magnet_strength_prior: float = 0.1
    magnet_direction_prior_deg: float = 3.0


@dataclass(frozen=True)
class CalibratedFiles:
    """Files of a calibration: nominal array, calibrated array, truth, and folder of figures."""

    array: Path
    out: Path | None
    truth: Path | None
    figures: Path | None


def calibrate_body(
    readings: Path, files: CalibratedFiles, known: PriorOptions, options: BodyOptions, *, as_json: bool
) -> None:
    """Calibrate, print the result and write the files."""
    import magloc
    from magloc.bodies.body_file import read_body, write_body
    from magloc.readings import read_readings
    from magloc.truth import read_truth

    if options.body is None:
        raise InputError("--body: found none, expected the body file that the other options of a body refer to.")
    if options.free_rows and files.truth is None:
        raise InputError("--free-rows: found no --truth; without it all rows are free.")
    refuse_one_for_two({"--out": files.out, "--out-body": options.out_body})
    refuse_unwritable(options.out_body, "--out-body")
    refuse_not_positive(options, "magnet_position_prior_mm", "magnet_strength_prior", "magnet_direction_prior_deg")
    refuse_outside(0.0, 1.0, "at most 1", magnet_strength_prior=options.magnet_strength_prior)
    nominal, body = array_of_several(files.array), read_body(options.body)
    prior = sensor_prior(known, nominal, files.array, _POSITION_MM)
    rows = read_readings(readings, nominal)
    truth = None if files.truth is None else read_truth(files.truth)
    with naming(str(readings), array=str(files.array), truth=str(files.truth), body=str(options.body)):
        result = magloc.calibrate_body(
            nominal,
            body,
            rows,
            truth=truth,
            prior=prior,
            body_prior=magloc.BodyPrior(
                1e-3 * options.magnet_position_prior_mm,
                options.magnet_strength_prior,
                math.radians(options.magnet_direction_prior_deg),
            ),
            free_rows=options.free_rows,
        )
    _check(result, readings)
    if files.out is not None:
        arrays.write_array(files.out, result.array)
    if options.out_body is not None:
        write_body(options.out_body, result.body)
    print_result(_report(result, len(rows), files.out, options.out_body), _lines(result), as_json=as_json)
    write_files(files.figures, calibration_files(result), "--figures")
    notes = [*_notes(result, len(rows)), *_notes_on_files(files.out, options.out_body)]
    for line in [] if as_json else notes:
        note(line)


def _check(result: BodyCalibration, readings: Path) -> None:
    if not result.converged:
        raise InputError(
            f"{readings}: the calibration did not converge within {result.iterations} iterations "
            f"(χ² {result.chi2:.4g}), expected readings that fit the files and their priors; nothing is written. "
            f"{_CHECK}."
        )


def _report(result: BodyCalibration, n_rows: int, out: Path | None, out_body: Path | None) -> dict[str, Any]:
    """Return the report that ``--json`` prints."""
    from magloc.calibration.bodies.model import DIRECTION, PLACE, STRENGTH

    magnets = [
        {
            "id": magnet.id,
            "position_m": magnet.position_m,
            "position_sd_m": sd[PLACE],
            "moment_Am2": magnet.moment_Am2,
            "strength_sd": float(sd[STRENGTH][0]),
            "direction_sd_rad": sd[DIRECTION],
        }
        for magnet, sd in zip(result.body.magnets, result.magnet_sigma, strict=True)
    ]
    return {
        "out": None if out is None else str(out),
        "out_body": None if out_body is None else str(out_body),
        **fit_entries(result, n_rows),
        "sensors": sensor_entries(result),
        "magnets": magnets,
        "unobservable": unobservable_entries(result),
        "far_from_prior": result.far_from_prior,
        "cross_validation": None if result.cross_validation is None else result.cross_validation.json,
    }


def _lines(result: BodyCalibration) -> list[str]:
    """Return the changes of every sensor and magnet, with the largest standard deviation of each group."""
    import numpy as np

    from magloc.calibration.bodies.model import DIRECTION, PLACE, STRENGTH
    from magloc.cli.calibration.by_turning import values_by_sigma

    rows = [["magnet", "position mm", "s", "strength %", "s", "direction °", "s", ""]]
    for name, change, sd in zip(result.body.ids, result.magnet_change, result.magnet_sigma, strict=True):
        cells = [
            *values_by_sigma(1e3 * change[PLACE], 1e3 * sd[PLACE]),
            *values_by_sigma(100.0 * change[STRENGTH], 100.0 * sd[STRENGTH]),
            *values_by_sigma(np.degrees(change[DIRECTION]), np.degrees(sd[DIRECTION])),
        ]
        rows.append([name, *cells, ""])
    return [*sensor_table(result), "", *align(rows, left=1)]


def _notes(result: BodyCalibration, n_rows: int) -> list[str]:
    """Return notes on rows and χ², on undetermined directions, and on held-out rows."""
    notes = fit_notes(result, n_rows, "the files")
    if result.cross_validation is not None:
        notes.append(_validation_note(result.cross_validation))
    if result.far_from_prior:
        names = ", ".join(result.far_from_prior)
        notes.append(f"warning: changes far beyond the stated tolerances, dead, exchanged or reversed: {names}")
    excess = result.chi2 / max(1.0, result.dof)
    if excess > _EXCESS:
        notes.append(
            f"warning: χ² is {excess:.2g} times its degrees of freedom, expected about 1; do not use this calibration. "
            f"{_CHECK}"
        )
    return notes


def _notes_on_files(out: Path | None, out_body: Path | None) -> list[str]:
    """Return a note on the calibrated files that no option writes."""
    missing = [name for name, path in (("--out-array", out), ("--out-body", out_body)) if path is None]
    if not missing:
        return []
    if len(missing) == 2:
        return ["note: no file is written; --out-array FILE and --out-body FILE write the calibrated array and body"]
    what = missing[0].removeprefix("--out-")
    return [f"warning: the calibrated {what} is not written; array and body belong together: add {missing[0]} FILE"]


def _validation_note(errors: PoseErrors) -> str:
    """Return a note on the errors in rows that the calibration did not use."""
    text = f"cross-validation: rows held out of the calibration have χ² {errors.chi2:.4g} with {errors.dof:.0f} dof"
    if not errors.error_m.size:
        return text
    entries = errors.json
    median_mm, worst_mm = 1e3 * entries["median_m"], 1e3 * entries["worst_m"]
    median_deg, worst_deg = math.degrees(entries["median_rad"]), math.degrees(entries["worst_rad"])
    return (
        f"{text}, and are located to {median_mm:.3g} mm and {median_deg:.3g}° (median), {worst_mm:.3g} mm and"
        f" {worst_deg:.3g}° (worst)"
    )
