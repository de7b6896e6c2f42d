"""``magloc calibrate --modulus-nT``: gains, angles and offsets of sensors turned in a field."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from arrays.array import SensorArray
from arrays.io.csv import read_table
from arrays.io.errors import InputError
from arrays.io.tables import by_sigma
from arrays.typing import FloatArray
from magloc.calibration.modulus import EllipsoidCalibration, wild_limit_T
from magloc.calibration.results import TurningCalibration
from magloc.readings import Readings

# Largest factor between a gain and that of the array file: beyond it the modulus has another unit.
_LARGEST_CHANGE = 3.0


def modulus_of(given: str, readings: Readings) -> float | FloatArray:
    """Return the modulus [T] of the option: a number, or that of every row from a file."""
    try:
        modulus_nT = float(given)
    except ValueError:
        return _modulus_through_time(Path(given), readings.time_s)
    if not 0.0 < modulus_nT < np.inf:
        raise InputError(f"--modulus-nT: found {modulus_nT:g}, expected a positive number.")
    return 1e-9 * modulus_nT


def _modulus_through_time(path: Path, time_s: FloatArray) -> FloatArray:
    """Return the modulus at some times, interpolated between the rows of a file."""
    table = read_table(path, "a header with time_s and modulus_nT, or a number for --modulus-nT")
    columns = ("time_s", "modulus_nT")
    for name in columns:
        table.require(name, columns)
    table.refuse_unknown(columns)
    known_s = table.times()
    order = np.argsort(known_s)
    known_s, modulus_nT = known_s[order], table.complete(columns[1:])[order, 0]
    if not (modulus_nT > 0.0).all():
        raise InputError(f"{path}: found a modulus_nT of {modulus_nT.min():g}, expected positive numbers.")
    low, high = time_s.min(), time_s.max()
    if not known_s[0] <= low <= high <= known_s[-1]:
        raise InputError(
            f"{path}: found moduli from {known_s[0]:.15g} s to {known_s[-1]:.15g} s, expected them for all readings,"
            f" {low:.15g} s to {high:.15g} s."
        )
    return np.asarray(1e-9 * np.interp(time_s, known_s, modulus_nT))


def notes(result: TurningCalibration) -> list[str]:
    """Return notes on what the modulus does not determine, and on sensors that it does not fit."""
    texts = ["the modulus does not determine how a sensor is mounted: its rotation stays as in the array file"]
    for name, fit in result.fits.items():
        if fit.misfit:
            ratio = fit.chi2 / fit.dof
            texts.append(
                f"warning: sensor {name} does not fit (χ² {ratio:.3g} times what its noise explains): more noise, a"
                f" field that changes, or iron near it; standard deviations are at least {np.sqrt(ratio):.2g} times as"
                " large"
            )
    return texts


def check(result: TurningCalibration, readings: Path, array: Path, out: Path) -> None:
    """Refuse readings that do not determine a sensor, and a modulus in another unit."""
    for name, fit in result.fits.items():
        if not fit.converged:
            fault = f"sensor {name} cannot be calibrated: {fit.reason}{overflow(result.readings_T)}"
            raise InputError(f"{readings}: {fault}; {out} is not written.")
    check_gains(result.nominal, result.array, float(np.median(result.modulus_T)), array, out)


def check_gains(nominal: SensorArray, calibrated: SensorArray, modulus_T: float, array: Path, out: Path) -> None:
    """Refuse gains far from those of the array file."""
    for before, sensor in zip(nominal.sensors, calibrated.sensors, strict=True):
        volumes = np.linalg.det([sensor.calibration.scale, before.calibration.scale])
        ratio = float(np.cbrt(volumes[0] / volumes[1]))
        if not 1.0 / _LARGEST_CHANGE < ratio < _LARGEST_CHANGE:
            raise InputError(
                f"--modulus-nT: found {1e9 * modulus_T:g}, which makes the gains of sensor"
                f" {sensor.id} {ratio:.3g} times those of {array}, expected the modulus in nT, or an array file with"
                f" its gains; {out} is not written."
            )


def overflow(readings_T: FloatArray) -> str:
    """Return a sentence on readings far larger than nearly all others; empty if there are none."""
    size, most = np.abs(readings_T[np.isfinite(readings_T)]), wild_limit_T(readings_T)
    n = int((size > most).sum())
    if not n:
        return ""
    return (
        f". {n} of {size.size} readings are beyond {1e9 * most:.3g} nT: leave overflow values and"
        " dummies empty, or state saturation_nT"
    )


def report(result: TurningCalibration, out: Path) -> dict[str, Any]:
    """Return the report that ``--json`` prints."""
    sensors = [_entry(*item) for item in result.fits.items()]
    return {"out": str(out), "rows": len(result.time_s), "sensors": sensors}


def lines(result: TurningCalibration) -> list[str]:
    """Return one line for every sensor."""
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
        "misfit": result.misfit,
    }


def _line(name: str, result: EllipsoidCalibration) -> str:
    offset_sd, scale_sd = _deviations(result)
    gains, gain_sd = values_by_sigma(np.diagonal(result.scale), scale_sd)
    offsets, offset_nT = values_by_sigma(1e9 * result.offset_T, 1e9 * offset_sd)
    goodness = f"chi2 {result.chi2:.1f}/{result.dof}"
    return f"{name}: gains {gains} (s {gain_sd}), offset {offsets} nT (s {offset_nT}), {goodness}"


def values_by_sigma(values: FloatArray, sigma: FloatArray) -> tuple[str, str]:
    """Return values and the largest of their standard deviations, rounded to its digits."""
    largest = float(np.max(sigma))
    cells = [by_sigma(value, largest) for value in values.tolist()]
    return " ".join(value for value, _ in cells), cells[0][1]
