"""The pictures of a calibration, and the data behind them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from arrays.sensor import SensorArray
from magloc import dipole
from magloc.calibration import CalibrationResult
from magloc.commands.common import print_note
from magloc.moving_source import AXES, AXIS_PAIRS, GAINS, OFFSET, POSITION
from magloc.output_files import Column, make_folder, write_columns
from magloc.plots import calibration_figure, save, turning_figure
from magloc.readings import Readings

FloatArray = NDArray[np.float64]

_T_IN_nT = 1e9


def write_calibration_pictures(
    nominal: SensorArray,
    readings_T: FloatArray,
    world_from_array: FloatArray,
    result: CalibrationResult,
    folder: Path,
    *,
    quiet: bool = False,
) -> None:
    """Write calibration.png, and the data behind it as calibration.csv.

    Parameters
    ----------
    nominal : SensorArray
    readings_T : ndarray, shape (n, C)
        What the calibration was given [T].
    world_from_array : ndarray, shape (n, 3, 3)
        Attitude of the array in every row.
    result : CalibrationResult
    folder : Path
        Made if it is not there.
    quiet : bool
        Do not name the files on stderr.

    Raises
    ------
    InputError
        The folder cannot be written.
    """
    make_folder(folder, "--figures")
    attitude = world_from_array[result.rows]
    moment = np.einsum("tba,tb->ta", attitude, np.broadcast_to(result.moment_Am2, (len(attitude), 3)))
    before, after = (
        residual_rms(array, readings_T[result.rows], result.position_m, moment) for array in (nominal, result.array)
    )
    axes = [f"axis_{'xyz'[channel]}_to_{'xyz'[component]}" for channel, component in AXIS_PAIRS]
    columns: dict[str, Column] = {
        "sensor": list(result.array.ids),
        "residual_rms_before_nT": _T_IN_nT * before,
        "residual_rms_after_nT": _T_IN_nT * after,
    }
    groups = (
        (POSITION, [f"position_{name}" for name in "xyz"], "mm", 1e3),
        (GAINS, [f"gain_{name}" for name in "xyz"], "percent", 1e2),
        (AXES, axes, "deg", float(np.degrees(1.0))),
        (OFFSET, [f"offset_{name}" for name in "xyz"], "nT", _T_IN_nT),
    )
    for place, names, unit, scale in groups:
        change, deviation = scale * result.change[:, place], scale * result.standard_deviation[:, place]
        columns |= dict(zip((f"change_of_{name}_{unit}" for name in names), change.T, strict=True))
        columns |= dict(zip((f"s_{name}_{unit}" for name in names), deviation.T, strict=True))
    write_columns(columns, folder / "calibration.csv")
    figure = calibration_figure(
        result.array.ids, before, after, result.change, result.standard_deviation, result.estimated
    )
    save(figure, folder / "calibration.png")
    if not quiet:
        print_note(f"wrote calibration.png and calibration.csv into {folder}/")


def write_turning_pictures(
    nominal: SensorArray,
    calibrated: SensorArray,
    rows: Readings,
    modulus_T: float,
    folder: Path,
    *,
    quiet: bool = False,
) -> None:
    """Write turning.png, and the data behind it as turning.csv: the moduli that sensors read while they are turned.

    Parameters
    ----------
    nominal, calibrated : SensorArray
    rows : Readings
    modulus_T : float
        Of the field [T].
    folder : Path
        Made if it is not there.
    quiet : bool
        Do not name the files on stderr.

    Raises
    ------
    InputError
        The folder cannot be written.
    """
    make_folder(folder, "--figures")
    vector = [i for i, sensor in enumerate(nominal.sensors) if sensor.kind == "vector"]
    ids = [nominal.ids[i] for i in vector]
    arrays = (nominal, calibrated)
    moduli = [np.linalg.norm(array.calibrated_field(rows.values_T)[:, vector], axis=-1) for array in arrays]
    columns: dict[str, Column] = {"time_s": rows.time_s}
    for i, name in enumerate(ids):
        for when, modulus in zip(("before", "after"), moduli, strict=True):
            columns[f"{name}_modulus_{when}_nT"] = _T_IN_nT * modulus[:, i]
    write_columns(columns, folder / "turning.csv")
    before, after = (np.sqrt(np.nanmean((modulus - modulus_T) ** 2, axis=0)) for modulus in moduli)
    gains, offsets = (
        np.array([getattr(array.sensors[i].calibration, name) for array in arrays for i in vector])
        for name in ("scale", "offset_T")
    )
    n = len(ids)
    diagonal = np.diagonal(gains, axis1=1, axis2=2)
    figure = turning_figure(ids, before, after, diagonal[n:] / diagonal[:n] - 1.0, offsets[n:] - offsets[:n])
    save(figure, folder / "turning.png")
    if not quiet:
        print_note(f"wrote turning.png and turning.csv into {folder}/")


def residual_rms(
    array: SensorArray, readings_T: FloatArray, position_m: FloatArray, moment_Am2: FloatArray
) -> FloatArray:
    """Root mean square of what a known source and the best common field leave of every sensor's readings.

    Parameters
    ----------
    array : SensorArray
        Vector sensors.
    readings_T : ndarray, shape (n, C)
        Raw readings [T]; NaN where missing.
    position_m, moment_Am2 : ndarray, shape (n, 3)
        Source in the array's frame.

    Returns
    -------
    ndarray, shape (N,)
        [T]
    """
    fields = dipole.field(array.positions, position_m[:, None], moment_Am2[:, None])
    residual = readings_T - array.readings_of(fields)
    noise, gain = array.channel_noise_T, array.channel_gain
    for i, of_row in enumerate(residual):
        known = np.isfinite(of_row)
        common, *_ = np.linalg.lstsq(gain[known] / noise[known, None], of_row[known] / noise[known], rcond=None)
        residual[i] = of_row - gain @ common
    squares = (residual**2).reshape(len(residual), -1, 3)
    counts = np.isfinite(squares).sum(axis=(0, 2))
    result: FloatArray = np.sqrt(np.nansum(squares, axis=(0, 2)) / np.maximum(counts, 1))
    return result
