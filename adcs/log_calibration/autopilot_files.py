"""Calibrations as parameters of PX4 and ArduPilot.

PX4 (Magnetometer.hpp) corrects a reading r in gauss to R S (r + P c - o), with the mounting R, a symmetric S and the
power P: throttle, or current in kA. ArduPilot (AP_Compass_Backend.cpp) turns r into body axes, in milligauss, and
corrects it to S (r + o) + P c with the current P in A.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.linalg import polar

from adcs.log_calibration.calibrate import LogCalibration
from adcs.log_calibration.record import VehicleLog
from adcs.log_calibration.rotations import nearest_rotation, rotation_matrices
from adcs.log_calibration.terms import is_throttle
from arrays.array_file import write_array
from arrays.io.errors import InputError
from arrays.io.text import write_text
from arrays.typing import FloatArray

_GAUSS, _MILLIGAUSS, _KILOAMPERE = 1e4, 1e7, 1e3
_FLOAT, _INT = 9, 6
_PAIRS = (("X", 0, 1), ("Y", 0, 2), ("Z", 1, 2))
_MOST_COMPASSES = {"px4": 4, "ardupilot": 3}
Parameters = dict[str, float | int]


def px4_parameters(found: LogCalibration) -> Parameters:
    """Return parameters of PX4 for the terms that the log determines."""
    values: Parameters = {}
    for m, series in enumerate(found.log.magnetometers[: _MOST_COMPASSES["px4"]]):
        begin = f"CAL_MAG{m}_"
        number, _ = nearest_rotation(found.fit.mountings[m].T)
        if series.device_id:
            values[f"{begin}ID"] = series.device_id
        if number:
            values[f"{begin}ROT"] = number
        inverse = np.linalg.inv(found.matrix(m))
        _, symmetric = polar(rotation_matrices()[number].T @ inverse)
        if found.is_determined(series.name, "offset"):
            values |= _axes(f"{begin}{{}}OFF", _GAUSS * found.offset_T(m))
        if found.is_determined(series.name, "scale", "soft iron"):
            values |= _axes(f"{begin}{{}}SCALE", np.diagonal(symmetric))
            values |= {f"{begin}{axis}ODIAG": float(symmetric[i, j]) for axis, i, j in _PAIRS}
        if (power := _power(found, m)) is not None:
            kind, field_T = power
            unit = _KILOAMPERE if kind == 2 else 1.0
            values["CAL_MAG_COMP_TYP"] = kind
            values |= _axes(f"{begin}{{}}COMP", -_GAUSS * unit * field_T)
    return values


def ardupilot_parameters(found: LogCalibration) -> Parameters:
    """Return parameters of ArduPilot for the terms that the log determines."""
    values: Parameters = {}
    for m, series in enumerate(found.log.magnetometers[: _MOST_COMPASSES["ardupilot"]]):
        which = "" if m == 0 else str(m + 1)
        number, _ = nearest_rotation(found.fit.mountings[m].T)
        if series.device_id:
            values[f"COMPASS_DEV_ID{which}"] = series.device_id
        if number:
            values[f"COMPASS_ORIENT{which}"] = number
        inverse = np.linalg.inv(found.matrix(m))
        turn = rotation_matrices()[number]
        _, symmetric = polar(inverse @ turn.T, side="left")
        if found.is_determined(series.name, "offset"):
            values |= _axes(f"COMPASS_OFS{which}_{{}}", -_MILLIGAUSS * (turn @ found.offset_T(m)))
        if found.is_determined(series.name, "scale", "soft iron"):
            values |= _axes(f"COMPASS_DIA{which}_{{}}", np.diagonal(symmetric))
            values |= {f"COMPASS_ODI{which}_{axis}": float(symmetric[i, j]) for axis, i, j in _PAIRS}
        if (power := _power(found, m)) is not None:
            kind, field_T = power
            values["COMPASS_MOTCT"] = kind
            values |= _axes(f"COMPASS_MOT{which}_{{}}", -_MILLIGAUSS * (inverse @ field_T))
    return values


def _power(found: LogCalibration, m: int) -> tuple[int, FloatArray] | None:
    """Return 1 for a throttle or 2 for a current, and its field in sensor axes; None if it is not determined."""
    if len(found.log.currents) != 1 or not found.is_determined(found.log.magnetometers[m].name, "current"):
        return None
    return (1 if is_throttle(found.log.currents[0].name) else 2), found.current_T(m)[0]


def _axes(name: str, values: FloatArray) -> Parameters:
    return {name.format(axis): float(value) for axis, value in zip("XYZ", values, strict=True)}


def axes_warning(found: LogCalibration) -> str:
    """Return a sentence if z of the log's axes points up, where autopilots have forward, right, down."""
    if found.fit.estimate.problem.inertial.acceleration_m_s2[:, 2].mean() < 0.0:
        return ""
    return (
        "axes of the log: found z upwards, expected the autopilot's (forward, right, down); state a mounting in the"
        " layout (--config), or the parameters have other axes"
    )


def _write_px4(found: LogCalibration, path: Path) -> None:
    """Write a parameter file as QGroundControl loads it."""
    lines = ["# Onboard parameters for Vehicle 1", "# Vehicle-Id Component-Id Name Value Type"]
    for name, value in px4_parameters(found).items():
        lines.append(f"1\t1\t{name}\t{_number(value)}\t{_INT if isinstance(value, int) else _FLOAT}")
    write_text("\n".join(lines) + "\n", path)


def _write_ardupilot(found: LogCalibration, path: Path) -> None:
    """Write a parameter file as Mission Planner and MAVProxy load it."""
    write_text("".join(f"{name},{_number(value)}\n" for name, value in ardupilot_parameters(found).items()), path)


def _write_array(found: LogCalibration, path: Path) -> None:
    write_array(path, found.array())


def _number(value: float) -> str:
    return str(value) if isinstance(value, int) else f"{value:.7g}"


WRITERS: dict[str, Callable[[LogCalibration, Path], None]] = {
    ".toml": _write_array,
    ".params": _write_px4,
    ".param": _write_ardupilot,
    ".parm": _write_ardupilot,
}


def refuse_unplaced(path: Path, log: VehicleLog) -> None:
    """Refuse an array file for several magnetometers: a log does not state their places."""
    if path.suffix.lower() == ".toml" and len(log.magnetometers) > 1:
        found = f"found {len(log.magnetometers)} magnetometers, whose places the log does not state"
        raise InputError(
            f"--out: {found}, expected .params (PX4), .param or .parm (ArduPilot) instead of an array file."
        )


def writer_of(path: Path) -> Callable[[LogCalibration, Path], None]:
    """Return the writer of a file by its suffix."""
    if path.suffix.lower() not in WRITERS:
        expected = ".toml (array file), .params (PX4), .param or .parm (ArduPilot)"
        raise InputError(f"--out: found {path.name}, expected a name that ends in {expected}.")
    return WRITERS[path.suffix.lower()]
