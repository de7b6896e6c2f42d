"""``magloc calibrate``: positions, gains, axes and offsets of an array's sensors."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

import arrays
import magloc
from arrays.io.errors import InputError, naming
from arrays.io.outputs import refuse_file, refuse_unwritable, write_files
from magloc.cli.calibration.by_body import BodyOptions, CalibratedFiles, calibrate_body
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
from magloc.cli.framework import CommonOptions, Flag, note, print_result, warn
from magloc.cli.options import array_of_several

if TYPE_CHECKING:
    from arrays.array import SensorArray
    from magloc.calibration.array import CalibrationPrior
    from magloc.calibration.cross_validation import CrossValidation
    from magloc.calibration.results import SourceCalibration
    from magloc.readings import Readings
    from magloc.truth import Truth


# Standard deviations of the prior beyond which a gain is reported.
_STRANGE = 4.0
_TURNED = 3.0  # χ²/dof: 1.7 times the stated noise
_ALIKE = 0.1  # largest difference of gains that have one cause
_COMPARED = 300  # largest number of rows that are located to compare the truth with


def calibrate(
    readings: Path,
    /,
    *,
    array: Path,
    out: Annotated[Path | None, Parameter(name=("--out", "--out-array"))] = None,
    truth: Path | None = None,
    modulus_nT: Annotated[str | None, Parameter(name="--modulus-nT", allow_leading_hyphen=True)] = None,
    height_m: float | None = None,
    moment: Literal["constant", "free"] | None = None,
    known: PriorOptions = PriorOptions(),  # noqa: B008 - frozen
    of_body: BodyOptions = BodyOptions(),  # noqa: B008 - frozen
    figures: Path | None = None,
    json: Flag = False,
    common: CommonOptions = CommonOptions(),  # noqa: B008 - frozen
) -> None:
    """Calibrate vector sensors by a source that moves past them, or by turning them in a field of known modulus.

    With --truth the path of the source is known. Without it the path is estimated too; then the readings do not show
    where the array as a whole stands, how it is turned and its scale, which come from the array file or from trusted
    sensors. The command reports what the readings do not determine. The table lists the changes to the array file, with
    standard deviations.

    With --modulus-nT there is no source: every sensor was turned in a uniform field of that modulus. This determines
    the gains, the angles between the axes and the offsets of each sensor, but not how it is mounted.

    With --body a rigid body of several magnets moves near the sensors, and its magnets are estimated too. Its poses are
    those of --truth, unknown, or both (--free-rows).

    Parameters
    ----------
    readings : Path
        Readings file (CSV).
    array : Path
        Array file (TOML) to start from. Its noise weights the readings. Set noise_fraction when the source comes near.
    out : Path
        Array file to write; it may be omitted with --body only. Nothing is written if the calibration fails.
    truth : Path
        Truth file (CSV) of the source. Its rows belong to the readings of the same time. Without z_m one height is
        estimated for all rows. Moments in it are taken as known; with axis_x, axis_y, axis_z one strength is estimated.
        sigma_m is the error of its positions. Rows are held out in turn to test the calibration on others.
        With --body it has the attitude qx, qy, qz, qw too, and sigma_deg is its error.
    modulus_nT : str
        Modulus of the uniform field in which the sensors were turned [nT]: a number, or a CSV file with time_s and
        modulus_nT, such as that of a base station, which is interpolated linearly.
    height_m : float
        Height of the source for a truth file without z_m [m].
    moment : {"constant", "free"}
        Model of an unknown moment: constant, for a source that does not turn, or free in every row. By default
        constant.
    known : PriorOptions
        Accuracy of the array file.
    of_body : BodyOptions
        Body of several magnets.
    figures : Path
        Folder for figures and their data: residuals before and after, and the changes of the calibration.
    json : bool
        Print one JSON object instead of the table.
    common : CommonOptions
        Common options.
    """
    from magloc.calibration.results import TurningCalibration
    from magloc.cli.calibration import by_turning as turning
    from magloc.readings import read_readings, without_saturated

    refuse_unwritable(out, "--out")
    refuse_file(figures, "--figures")
    if of_body != BodyOptions():
        if modulus_nT is not None or height_m is not None or moment is not None:
            raise InputError("--body: found together with --modulus-nT, --height-m or --moment, expected none of them.")
        calibrate_body(readings, CalibratedFiles(array, out, truth, figures), known, of_body, as_json=json)
        return
    if out is None:
        raise InputError("--out: found none, expected the array file to write.")
    if modulus_nT is not None:
        if truth is not None:
            raise InputError("--modulus-nT: found together with --truth, expected one of them.")
        if known != PriorOptions() or height_m is not None or moment is not None:
            raise InputError("--modulus-nT: found together with an option for a moving source, expected none.")
        nominal = arrays.read_sensors(array)
        rows = read_readings(readings, nominal)
        with naming(str(array), readings=str(readings)):
            result = magloc.calibrate(nominal, rows, modulus_T=turning.modulus_of(modulus_nT, rows))
    else:
        nominal = array_of_several(array)
        prior = sensor_prior(known, nominal, array)
        rows = read_readings(readings, nominal)
        path = _path(rows, truth, height_m, readings)
        _compare_with_fixes(nominal, rows, path)
        with naming(str(readings), array=str(array), truth=str(truth)):
            used, validation = _validated(nominal, without_saturated(rows, nominal), path, moment, prior)
            result = magloc.calibrate(used, rows, truth=path, moment=moment, prior=prior)
    if isinstance(result, TurningCalibration):
        turning.check(result, readings, array, out)
        report, lines, notes = turning.report(result, out), turning.lines(result), turning.notes(result)
    else:
        _check_converged(result, readings, out)
        report, lines, notes = _report(result, len(rows), out), sensor_table(result), _notes(result, len(rows), prior)
        if moment is None and (path is None or (path.moment_Am2 is None and path.axis is None)):
            notes += _turn_notes(result)
        report["cross_validation"] = None
        if validation is not None:
            background = None if used is nominal else "subtracted"
            report["cross_validation"] = {**validation.json, "background": background}
            notes += _validation_notes(validation, background)
    arrays.write_array(out, result.array)
    print_result(report, lines, as_json=json)
    write_files(figures, calibration_files(result), "--figures")
    for line in [] if json else notes:
        note(line)


def _validated(
    array: SensorArray,
    rows: Readings,
    path: Truth | None,
    moment: Literal["constant", "free"] | None,
    prior: CalibrationPrior,
) -> tuple[SensorArray, CrossValidation | None]:
    """Return the array to calibrate and, on a known path, the cross-validation."""
    from magloc.calibration.cross_validation import choose_common_field

    return (array, None) if path is None else choose_common_field(array, rows, path, moment=moment, prior=prior)


def _validation_notes(validation: CrossValidation, background: str | None) -> list[str]:
    """Return notes on the errors in rows that the calibration did not use."""
    numbers = validation.json
    if not numbers["rows"]:
        return ["cross-validation: no row that was held out can be located; the calibration fits no other rows"]
    median, p90, worst = (1e3 * numbers[name] for name in ("median_m", "p90_m", "worst_m"))
    notes = [
        f"cross-validation: rows held out of the calibration are located to {median:.3g} mm (median), {p90:.3g} mm"
        f" (90 %), {worst:.3g} mm (worst)"
    ]
    if background is not None:
        notes.append(
            "the offsets contain the background of the array at rest; held-out rows are located better if the array"
            " file states a small common field, so it states one: calibrate again when the array moves"
        )
    return notes


def _check_converged(result: SourceCalibration, readings: Path, out: Path) -> None:
    from magloc.cli.calibration.by_turning import overflow

    if not result.converged:
        raise InputError(
            f"{readings}: the calibration did not converge within {result.iterations} iterations "
            f"(χ² {result.chi2:.4g}), expected readings that fit the array file and its noise"
            f"{overflow(result.readings_T)}; {out} is not written."
        )


def _path(readings: Readings, path: Path | None, height_m: float | None, readings_path: Path) -> Truth | None:
    """Read the path of the source; a missing z becomes the height, if one is given."""
    import numpy as np

    from magloc.truth import read_truth, rows_of_same_time

    if path is None:
        if height_m is not None:
            raise InputError("--height-m: found no --truth, expected it because the height belongs to its path.")
        return None
    truth = read_truth(path)
    if not rows_of_same_time(readings, truth)[0].size:
        raise InputError(
            f"{path}: found none of the times of {readings_path} ({readings.time_s.min():.15g} s to "
            f"{readings.time_s.max():.15g} s), expected rows with the same time_s."
        )
    if height_m is None:
        return truth
    missing = np.isnan(truth.position_m)
    if not missing.any():
        raise InputError(f"--height-m: found z_m in {path}, expected a truth file without it.")
    return replace(truth, position_m=np.where(missing, height_m, truth.position_m))


def _compare_with_fixes(array: SensorArray, rows: Readings, path: Truth | None) -> None:
    """Warn where fixes with the array as it is show that the clock or the frame of the truth is another."""
    import numpy as np

    from magloc.truth import cause_of_disagreement

    if path is None or np.isnan(path.position_m).any():
        return
    few = rows[np.linspace(0, len(rows) - 1, min(len(rows), _COMPARED)).astype(np.intp)]
    with suppress(ValueError):
        fixes = magloc.locate(array, few, body_length_m=0.0, exclude_faulty=False)
        warn(filter(None, [cause_of_disagreement(path, fixes.time_s, fixes.position_m)]))


def _report(result: SourceCalibration, n_rows: int, out: Path) -> dict[str, Any]:
    """Return the report that ``--json`` prints."""
    constant = bool((result.moment_Am2 == result.moment_Am2[0]).all())
    return {
        "out": str(out),
        **fit_entries(result, n_rows),
        "moment_Am2": result.moment_Am2[0] if constant else None,
        "sensors": sensor_entries(result),
        "unobservable": unobservable_entries(result),
    }


def _turn_notes(result: SourceCalibration) -> list[str]:
    """Return a warning if the readings contradict the moment that is taken for constant."""
    excess = result.chi2 / max(1.0, result.dof)
    if excess < _TURNED:
        return []
    return [
        f"warning: χ² is {excess:.2g} times its degrees of freedom, expected about 1, with a moment that is constant;"
        " do not use this calibration. If the source turned, take --moment free, or a --truth with its moments"
    ]


def _notes(result: SourceCalibration, n_rows: int, prior: CalibrationPrior) -> list[str]:
    """Return notes on rows and χ², on undetermined directions, and on sensors with absurd gains."""
    import numpy as np

    from magloc.calibration.sensors import GAINS

    notes = fit_notes(result, n_rows, "the array file")
    far = np.max(np.abs(result.change[:, GAINS]), axis=1) > _STRANGE * prior.gain
    strangers = [sensor for sensor, strange in zip(result.array.ids, far.tolist(), strict=True) if strange]
    gains = 1.0 + result.change[:, GAINS]
    common = float(np.median(gains))
    if strangers and np.mean(np.abs(gains - common) < _ALIKE * abs(common)) > 0.5 and abs(common - 1.0) > 2.0 * _ALIKE:
        notes.append(
            f"warning: the gains of most sensors are about {common:.2g} times those of the array file:"
            f" the moments in the truth file or the unit of the readings are probably wrong by {common:.2g}, because"
            " faulty sensors would differ from each other"
        )
    elif strangers:
        notes.append(f"warning: gains far beyond --gain-prior, a dead or wrong sensor: {', '.join(strangers)}")
    return notes
