"""``magloc calibrate --modulus-nT``: gains, angles and offsets of sensors that were turned in a uniform field."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from arrays.array_file import read_sensors, write_array
from arrays.io.errors import InputError
from magloc.calibration.modulus import EllipsoidCalibration, calibrated_in_modulus
from magloc.cli.framework import print_json
from magloc.cli.options import print_note
from magloc.readings import read_readings, without_saturated

# Of a gain from the array file: beyond it the modulus is in another unit.
_LARGEST_CHANGE = 3.0


def calibrate_by_turning(readings: Path, array: Path, modulus_nT: float, out: Path, *, json: bool, quiet: bool) -> None:
    """Calibrate every vector sensor of an array file, or its only one, and write the array file.

    Raises
    ------
    InputError
        The readings do not determine a sensor; nothing is written.
    """
    if not 0.0 < modulus_nT < np.inf:
        raise InputError(f"--modulus-nT: found {modulus_nT:g}, expected a positive number.")
    nominal = read_sensors(array)
    rows = without_saturated(read_readings(readings, nominal), nominal)
    try:
        calibrated, results = calibrated_in_modulus(nominal, rows.values_T, 1e-9 * modulus_nT)
    except ValueError as error:
        raise InputError(f"{array}: {str(error).removeprefix('Input ')}") from None
    for name, result in results.items():
        if not result.converged:
            raise InputError(f"{readings}: sensor {name} cannot be calibrated: {result.reason}; {out} is not written.")
    for before, sensor in zip(nominal.sensors, calibrated.sensors, strict=True):
        volumes = np.linalg.det([sensor.calibration.scale, before.calibration.scale])
        ratio = float(np.cbrt(volumes[0] / volumes[1]))
        if not 1.0 / _LARGEST_CHANGE < ratio < _LARGEST_CHANGE:
            raise InputError(
                f"--modulus-nT: found {modulus_nT:g}, which makes the gains of sensor {sensor.id} {ratio:.3g} times"
                f" those of {array}, expected the modulus in nT, or an array file with its gains; {out} is not written."
            )
    write_array(calibrated, out)
    if json:
        print_json({"out": str(out), "rows": len(rows), "sensors": [_entry(*item) for item in results.items()]})
    else:
        print("\n".join(_line(*item) for item in results.items()))
    if not (json or quiet):
        print_note("the modulus does not tell how a sensor is mounted: its rotation stays as in the array file")


def _deviations(result: EllipsoidCalibration) -> tuple[Any, Any]:
    sigma = np.sqrt(np.diagonal(result.covariance))
    return sigma[:3], sigma[3:]


def _entry(name: str, result: EllipsoidCalibration) -> dict[str, Any]:
    offset_sd, scale_sd = _deviations(result)
    return {
        "id": name,
        "scale": result.scale,
        "scale_sd": scale_sd,
        "offset_nT": 1e9 * result.offset_T,
        "offset_sd_nT": 1e9 * offset_sd,
        "chi2": result.chi2,
        "dof": result.dof,
        "iterations": result.iterations,
        "converged": result.converged,
    }


def _line(name: str, result: EllipsoidCalibration) -> str:
    offset_sd, scale_sd = _deviations(result)
    gains = " ".join(f"{value:.6f}" for value in np.diagonal(result.scale))
    offsets = " ".join(f"{1e9 * value:.1f}" for value in result.offset_T)
    return (
        f"{name}: gains {gains} (s {scale_sd.max():.1g}), offset {offsets} nT (s {1e9 * offset_sd.max():.2g}),"
        f" chi2 {result.chi2:.1f}/{result.dof}"
    )
