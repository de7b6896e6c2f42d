"""``magloc calibrate``: positions, gains, axes and offsets of an array's sensors from a source that moves past it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from arrays.io.arguments import Flag
from arrays.io.errors import InputError
from magloc.cli.framework import CommonOptions, print_json
from magloc.cli.options import print_note

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from arrays.array import SensorArray
    from magloc.calibration.array import CalibrationResult, Prior
    from magloc.readings import Readings
    from magloc.truth import Truth

    FloatArray = NDArray[np.float64]


# Gains beyond this many standard deviations of the prior are named.
_STRANGE = 4.0


@Parameter(name="*", group="What is known of the array")
@dataclass(frozen=True)
class PriorOptions:
    """How well the array file is known.

    Parameters
    ----------
    estimate : str
        What is estimated: some of positions, gains, axes, offsets, separated by commas. The rest is as in the array
        file.
    trust_position : str
        Ids of sensors, separated by commas, whose position in the array file is exact.
    trust_scale : str
        Ids of sensors whose gains and axes in the array file are exact.
    position_prior_mm : float
        Standard deviation of a position in the array file, along each axis.
    gain_prior : float
        That of a gain (0.2 = 20 %).
    axes_prior_deg : float
        That of the direction of a channel.
    offset_prior_nT : float
        That of an offset.
    """

    estimate: str = "positions,gains,axes,offsets"
    trust_position: str = ""
    trust_scale: str = ""
    position_prior_mm: float = 5.0
    gain_prior: float = 0.2
    axes_prior_deg: float = 3.0
    offset_prior_nT: Annotated[float, Parameter(name="--offset-prior-nT")] = 1e5


def calibrate(
    readings: Path,
    /,
    *,
    array: Path,
    out: Path,
    truth: Path | None = None,
    modulus_nT: Annotated[float | None, Parameter(name="--modulus-nT")] = None,
    height_m: float | None = None,
    moment: Literal["constant", "free"] | None = None,
    known: PriorOptions = PriorOptions(),
    figures: Path | None = None,
    json: Flag = False,
    common: CommonOptions = CommonOptions(),  # noqa: B008 - frozen
) -> None:
    """Calibrate vector sensors by a source that moves past them, or by turning them in a field of known modulus.

    With --truth the path of the source is known; without it, the path is found as well, and the array as a whole can be
    moved, turned and scaled unseen: there the array file decides, or the sensors that are trusted. What the readings do
    not tell is said. The table has what the calibration adds to the array file, with standard deviations.

    With --modulus-nT there is no source: every sensor, or a single one, was turned in a uniform field of that modulus.
    That tells the gains, the angles between the axes and the offsets of each sensor, not how it is mounted.

    Parameters
    ----------
    readings : Path
        Readings file (CSV).
    array : Path
        Array file (TOML) to start from. Its noise weights the readings; noise_fraction is worth setting when the source
        comes near.
    out : Path
        Array file to write. Nothing is written if the calibration fails.
    truth : Path
        Truth file (CSV); rows belong to the readings of the same time. A missing z_m is one unknown height for all
        rows. Moments, where it has them, are taken as known.
    modulus_nT : float
        Modulus of the uniform field that the sensors were turned in.
    height_m : float
        The z of a truth file without z_m.
    moment : {"constant", "free"}
        Whether the unknown moment of the source is constant, of a source that does not turn, or free in every row.
        Constant by default.
    known : PriorOptions
        What is known of the array.
    figures : Path
        Folder for figures and the data behind them: residuals before and after, and what the calibration changes.
    json : bool
        Print one JSON object in place of the table.
    common : CommonOptions
        Common options.
    """
    import numpy as np

    from arrays.array_file import read_array, read_sensors, write_array
    from arrays.io.outputs import refuse_file, refuse_unwritable
    from magloc.calibration.array import calibrate_on_path, self_calibrate
    from magloc.cli.calibrate_by_turning import calibrate_by_turning
    from magloc.readings import read_readings, without_saturated
    from magloc.truth import read_truth

    refuse_unwritable(out, "--out")
    if figures is not None:
        refuse_file(figures, "--figures")
    if modulus_nT is not None:
        if truth is not None:
            raise InputError("--modulus-nT: found it together with --truth, expected one of them.")
        if known != PriorOptions() or height_m is not None or moment is not None:
            raise InputError("--modulus-nT: found it together with an option for a moving source, expected none.")
        calibrate_by_turning(readings, array, modulus_nT, out, json=json, quiet=common.quiet)
        if figures is not None:
            from magloc.plots.calibration import write_turning_pictures

            nominal = read_sensors(array)
            rows = without_saturated(read_readings(readings, nominal), nominal)
            write_turning_pictures(nominal, read_sensors(out), rows, 1e-9 * modulus_nT, figures, quiet=common.quiet)
        return
    nominal = read_array(array)
    prior = _prior(known, nominal, array)
    rows = without_saturated(read_readings(readings, nominal), nominal)
    if truth is None and height_m is not None:
        raise InputError("--height-m: found no --truth, expected it because the height is that of its path.")
    attitude, readings_T = _world_from_array(rows), rows.values_T
    try:
        if truth is None:
            result = self_calibrate(
                nominal, readings_T, moment=moment or "constant", prior=prior, world_from_array=attitude
            )
        else:
            path = read_truth(truth)
            in_readings, in_truth = _matched(rows, path, readings, truth)
            unknown_height = not _has_height(path) and height_m is None
            attitude, readings_T = attitude[in_readings], readings_T[in_readings]
            result = calibrate_on_path(
                nominal,
                readings_T,
                _in_array_frame(rows, in_readings, path.position_m[in_truth], height_m, truth),
                moment_Am2=None if path.moment_Am2 is None or moment is not None else path.moment_Am2[in_truth],
                moment=moment or "constant",
                unknown_height=unknown_height,
                prior=prior,
                world_from_array=attitude,
            )
    except InputError:
        raise
    except np.linalg.LinAlgError:
        raise InputError(
            f"{readings}: found a source that the model cannot place (on a sensor, or at infinity), expected one that"
            " passes the sensors at a distance."
        ) from None
    except ValueError as error:
        raise InputError(f"{readings}: {str(error).removeprefix('Input ')}") from None
    if not result.converged:
        raise InputError(
            f"{readings}: the calibration did not converge within {result.iterations} iterations "
            f"(χ² {result.chi2_after:.4g}), expected readings that the array file, its noise and its priors describe; "
            f"{out} is not written."
        )
    write_array(result.array, out)
    if json:
        print_json(_report(result, len(rows), out))
    else:
        print("\n".join(_table(result)))
    if figures is not None:
        from magloc.plots.calibration import write_calibration_pictures

        write_calibration_pictures(nominal, readings_T, attitude, result, figures, quiet=common.quiet)
    if not (json or common.quiet):
        _print_summary(result, len(rows))
        _warn_of_strangers(result, prior)


def _prior(options: PriorOptions, array: SensorArray, path: Path) -> Prior:
    from magloc.calibration.array import QUANTITIES, Prior

    quantities = _listed(options.estimate)
    for name in quantities or [""]:
        if name not in QUANTITIES:
            raise InputError(f"--estimate: found {name!r}, expected some of {', '.join(QUANTITIES)}.")
    for option, ids in (("--trust-position", options.trust_position), ("--trust-scale", options.trust_scale)):
        for name in _listed(ids):
            if name not in array.ids:
                raise InputError(
                    f"{option}: found {name!r}, expected ids of sensors in {path}: {', '.join(array.ids)}."
                )
    for name in ("position_prior_mm", "gain_prior", "axes_prior_deg", "offset_prior_nT"):
        value = getattr(options, name)
        if not 0.0 < value < math.inf:
            raise InputError(f"--{name.replace('_', '-')}: found {value:g}, expected a positive number.")
    return Prior(
        position_m=options.position_prior_mm * 1e-3,
        gain=options.gain_prior,
        axes_rad=math.radians(options.axes_prior_deg),
        offset_T=options.offset_prior_nT * 1e-9,
        estimate=tuple(quantity for quantity in QUANTITIES if quantity in quantities),
        trusted_positions=tuple(_listed(options.trust_position)),
        trusted_scales=tuple(_listed(options.trust_scale)),
    )


def _listed(text: str) -> list[str]:
    return [name.strip() for name in text.split(",")] if text else []


def _world_from_array(readings: Readings) -> FloatArray:
    """Attitude of the array in every row (n, 3, 3); without a pose its axes are the world's."""
    import numpy as np

    if readings.array_rotation is None:
        return np.broadcast_to(np.eye(3), (len(readings), 3, 3))
    return readings.array_rotation.as_matrix()


def _matched(
    readings: Readings, truth: Truth, readings_path: Path, truth_path: Path
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows of the readings and of the truth that have the same time."""
    from magloc.truth import rows_of_same_time

    in_readings, in_truth = rows_of_same_time(readings, truth)
    if not in_readings.size:
        raise InputError(
            f"{truth_path}: found none of the times of {readings_path} ({readings.time_s.min():.15g} s to "
            f"{readings.time_s.max():.15g} s), expected rows with the same time_s."
        )
    return in_readings, in_truth


def _has_height(truth: Truth) -> bool:
    import numpy as np

    return bool(np.isfinite(truth.position_m[:, 2]).all())


def _in_array_frame(
    readings: Readings, rows: NDArray[np.intp], position_m: FloatArray, height_m: float | None, truth_path: Path
) -> FloatArray:
    """True positions in the array's frame, with a missing z set to the height, or to 0 if that is unknown."""
    import numpy as np

    position = position_m.copy()
    missing = np.isnan(position[:, 2])
    if height_m is not None and not missing.any():
        raise InputError(f"--height-m: found z_m in {truth_path}, expected a truth file without it.")
    position[missing, 2] = 0.0 if height_m is None else height_m
    if readings.array_position_m is None:
        return position
    world_from_array = _world_from_array(readings)[rows]
    result: FloatArray = np.einsum("tba,tb->ta", world_from_array, position - readings.array_position_m[rows])
    return result


def _report(result: CalibrationResult, n_rows: int, out: Path) -> dict[str, Any]:
    """What ``--json`` prints."""
    from magloc.calibration.model import AXES, GAINS, OFFSET, POSITION

    sensors = [
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
        for sensor, sd, rms in zip(
            result.array.sensors, result.standard_deviation, result.residual_rms_T.tolist(), strict=True
        )
    ]
    constant = bool((result.moment_Am2 == result.moment_Am2[0]).all())
    return {
        "out": str(out),
        "rows": n_rows,
        "rows_used": int(result.rows.sum()),
        "chi2_before": result.chi2_before,
        "dof_before": result.dof_before,
        "chi2_after": result.chi2_after,
        "dof_after": result.dof_after,
        "iterations": result.iterations,
        "converged": result.converged,
        "moment_Am2": result.moment_Am2[0] if constant else None,
        "sensors": sensors,
        "unobservable": [{"name": u.name, "information": u.information} for u in result.unobservable],
    }


def _table(result: CalibrationResult) -> list[str]:
    """What the calibration adds to every sensor, with the largest standard deviation of each group."""
    import numpy as np

    from magloc.calibration.model import AXES, GAINS, OFFSET, POSITION

    width = max(len("sensor"), *map(len, result.array.ids))
    lines = [
        f"{'sensor':<{width}}  {'position mm':>23} {'s':>6}  {'gain %':>20} {'s':>5}  {'axes °':>6} {'s':>5}"
        f"  {'offset µT':>26} {'s':>7}  {'rms nT':>10}"
    ]
    for sensor, change, sd, rms in zip(
        result.array.ids, result.change, result.standard_deviation, result.residual_rms_T, strict=True
    ):
        position = " ".join(f"{1e3 * value:7.3f}" for value in change[POSITION])
        gains = " ".join(f"{100 * value:6.2f}" for value in change[GAINS])
        offset = " ".join(f"{1e6 * value:8.3f}" for value in change[OFFSET])
        lines.append(
            f"{sensor:<{width}}  {position:>23} {1e3 * sd[POSITION].max():6.3f}"
            f"  {gains:>20} {100 * sd[GAINS].max():5.2f}"
            f"  {np.degrees(np.abs(change[AXES]).max()):6.2f} {np.degrees(sd[AXES].max()):5.2f}"
            f"  {offset:>26} {1e6 * sd[OFFSET].max():7.3f}  {1e9 * rms:10.1f}"
        )
    return lines


def _warn_of_strangers(result: CalibrationResult, prior: Prior) -> None:
    """Name the sensors whose gain is far from what the array file could be wrong by: dead, or of another kind."""
    import numpy as np

    from magloc.calibration.model import GAINS

    far = np.max(np.abs(result.change[:, GAINS]), axis=1) > _STRANGE * prior.gain
    names = [sensor for sensor, strange in zip(result.array.ids, far.tolist(), strict=True) if strange]
    if names:
        print_note(f"warning: gains far beyond --gain-prior, a dead or wrong sensor: {', '.join(names)}")


def _print_summary(result: CalibrationResult, n_rows: int) -> None:
    print_note(
        f"{int(result.rows.sum())} of {n_rows} rows used; χ² {result.chi2_before:.4g} with {result.dof_before:.0f} "
        f"degrees of freedom before, {result.chi2_after:.4g} with {result.dof_after:.0f} after"
    )
    if result.unobservable:
        names = "; ".join(direction.name for direction in result.unobservable)
        print_note(f"not told by the readings, as in the array file: {names}")
