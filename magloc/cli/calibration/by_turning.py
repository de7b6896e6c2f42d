"""``magloc calibrate --modulus-nT``: gains, angles and offsets of sensors that were turned in a uniform field."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from arrays.io.errors import InputError
from magloc.calibration.modulus import EllipsoidCalibration
from magloc.calibration.results import TurningCalibration

# Of a gain from the array file: beyond it the modulus is in another unit.
_LARGEST_CHANGE = 3.0


NOTES = ["the modulus does not tell how a sensor is mounted: its rotation stays as in the array file"]


def check_modulus(modulus_nT: float) -> None:
    """Refuse what is no modulus."""
    if not 0.0 < modulus_nT < np.inf:
        raise InputError(f"--modulus-nT: found {modulus_nT:g}, expected a positive number.")


def check(result: TurningCalibration, readings: Path, array: Path, out: Path) -> None:
    """Refuse readings that do not determine a sensor, and a modulus that is in another unit."""
    for name, fit in result.fits.items():
        if not fit.converged:
            raise InputError(f"{readings}: sensor {name} cannot be calibrated: {fit.reason}; {out} is not written.")
    for before, sensor in zip(result.nominal.sensors, result.array.sensors, strict=True):
        volumes = np.linalg.det([sensor.calibration.scale, before.calibration.scale])
        ratio = float(np.cbrt(volumes[0] / volumes[1]))
        if not 1.0 / _LARGEST_CHANGE < ratio < _LARGEST_CHANGE:
            raise InputError(
                f"--modulus-nT: found {1e9 * float(result.modulus_T):g}, which makes the gains of sensor {sensor.id}"
                f" {ratio:.3g} times those of {array}, expected the modulus in nT, or an array file with its gains;"
                f" {out} is not written."
            )


def report(result: TurningCalibration, out: Path) -> dict[str, Any]:
    """What ``--json`` prints."""
    sensors = [_entry(*item) for item in result.fits.items()]
    return {"out": str(out), "rows": len(result.time_s), "sensors": sensors}


def lines(result: TurningCalibration) -> list[str]:
    """One line for every sensor."""
    return [_line(*item) for item in result.fits.items()]


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
