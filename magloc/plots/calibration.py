"""What a calibration adds to an array, and what it leaves of the readings."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from arrays.array import SensorArray
from arrays.io.csv import Column, write_columns
from arrays.io.outputs import make_folder
from magloc.calibration.array import CalibrationResult
from magloc.calibration.model import AXES, AXIS_PAIRS, GAINS, OFFSET, POSITION
from magloc.fields import dipole
from magloc.plots import style
from magloc.plots.style import save
from magloc.readings import Readings

if TYPE_CHECKING:
    from matplotlib.axes import Axes
from arrays.typing import BoolArray, FloatArray

_LOG = logging.getLogger(__name__)

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
        _LOG.info(f"wrote calibration.png and calibration.csv into {folder}/")


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
        _LOG.info(f"wrote turning.png and turning.csv into {folder}/")


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


_FEW_SENSORS = 10
_MOST_NAMED_SENSORS = 60
_GROUPS = (
    (POSITION, 1e3, "position [mm]"),
    (GAINS, 1e2, "gain [%]"),
    (AXES, 180.0 / np.pi, "axes [°]"),
    (OFFSET, 1e6, "offset [µT]"),
)


def calibration_figure(
    ids: Sequence[str],
    rms_before_T: FloatArray,
    rms_after_T: FloatArray,
    change: FloatArray,
    standard_deviation: FloatArray,
    estimated: BoolArray,
) -> Figure:
    """Residuals of every sensor before and after, and what the calibration adds to the array file.

    Parameters
    ----------
    ids : sequence of str
        Of the N sensors.
    rms_before_T, rms_after_T : ndarray, shape (N,)
        Root mean square residual [T].
    change, standard_deviation, estimated : ndarray, shape (N, 15)
        As in :class:`magloc.calibration.array.CalibrationResult`.

    Returns
    -------
    matplotlib.figure.Figure
        With a panel for each of positions, gains, axes and offsets that is estimated; bars are 95 % intervals.
    """
    groups = [(place, scale, label) for place, scale, label in _GROUPS if estimated[:, place].any()]
    figure = style.new_figure(1.5 + 1.35 * len(groups))
    axes = np.atleast_1d(figure.subplots(1 + len(groups), 1, sharex=True))
    sensors = np.arange(len(ids))
    _before_and_after(axes[0], rms_before_T, rms_after_T, "residual rms [nT]", "what is left of the readings")
    for ax, (place, scale, label) in zip(axes[1:], groups, strict=True):
        values = scale * np.where(estimated[:, place], change[:, place], np.nan)
        spread = scale * style.SIGMAS_95 * standard_deviation[:, place]
        if place == AXES:
            _angles(ax, sensors, values, spread)
        else:
            _components(ax, sensors, values, spread)
        ax.axhline(0.0, color=style.GREY, lw=0.6, zorder=1.2)
        style.dress(ax, "", f"change of\n{label}")
    if groups:
        axes[1].set_title("what the calibration changes, 95 % intervals", fontsize=style.LETTERS, loc="left")
        style.legend(axes[1])
    _name_sensors(axes[-1], ids)
    return figure


def turning_figure(
    ids: Sequence[str],
    rms_before_T: FloatArray,
    rms_after_T: FloatArray,
    gain_change: FloatArray,
    offset_change_T: FloatArray,
) -> Figure:
    """How far the modulus that a sensor reads while it is turned is from that of the field, before and after.

    Parameters
    ----------
    ids : sequence of str
        Of the N sensors.
    rms_before_T, rms_after_T : ndarray, shape (N,)
        Root mean square of modulus read minus modulus of the field [T].
    gain_change, offset_change_T : ndarray, shape (N, 3)
        What the calibration adds to the array file: relative gains, offsets [T].

    Returns
    -------
    matplotlib.figure.Figure
    """
    figure = style.new_figure(4.2)
    axes = figure.subplots(3, 1, sharex=True)
    _before_and_after(axes[0], rms_before_T, rms_after_T, "rms of the\nmodulus [nT]", "modulus read minus the field's")
    for ax, values, label in (
        (axes[1], 1e2 * gain_change, "gain [%]"),
        (axes[2], 1e6 * offset_change_T, "offset [µT]"),
    ):
        _components(ax, np.arange(len(ids)), values, np.full_like(values, np.nan))
        ax.axhline(0.0, color=style.GREY, lw=0.6, zorder=1.2)
        style.dress(ax, "", f"change of\n{label}")
    axes[1].set_title("what the calibration changes", fontsize=style.LETTERS, loc="left")
    style.legend(axes[1])
    _name_sensors(axes[-1], ids)
    return figure


def _before_and_after(ax: Axes, before_T: FloatArray, after_T: FloatArray, label: str, title: str) -> None:
    sensors = np.arange(len(before_T))
    style.logarithmic(ax, [1e9 * before_T, 1e9 * after_T])
    ax.vlines(sensors, 1e9 * before_T, 1e9 * after_T, color=style.GREY, lw=0.6, zorder=1.5)
    ax.plot(sensors, 1e9 * before_T, "o", ms=3.5, mfc="white", mec=style.BLACK, label="before")
    ax.plot(sensors, 1e9 * after_T, "s", ms=3.5, color=style.BLUE, label="after")
    style.dress(ax, "", label, title)
    style.legend(ax)


def _components(ax: Axes, sensors: NDArray[np.intp], values: FloatArray, spread: FloatArray) -> None:
    for k, (name, colour, marker, _) in enumerate(style.COMPONENTS):
        ax.errorbar(
            sensors + 0.22 * (k - 1), values[:, k], spread[:, k], fmt=marker, color=colour, ms=2.8, mfc="white",
            mew=0.8, elinewidth=0.8, label=name,
        )  # fmt: skip


def _angles(ax: Axes, sensors: NDArray[np.intp], values: FloatArray, spread: FloatArray) -> None:
    """Six angles of every sensor: two for each channel."""
    for k in range(values.shape[1]):
        name, colour, marker, _ = style.COMPONENTS[k // 2]
        ax.errorbar(
            sensors + 0.13 * (k - 2.5), values[:, k], spread[:, k], fmt=marker, color=colour, ms=2.2, mfc="white",
            mew=0.7, elinewidth=0.6, label=name if k % 2 == 0 else "_",
        )  # fmt: skip


def _name_sensors(ax: Axes, ids: Sequence[str]) -> None:
    shown = range(0, len(ids), -(-len(ids) // _MOST_NAMED_SENSORS))
    ax.set_xlabel("sensor", fontsize=style.LETTERS)
    ax.set_xlim(-0.7, len(ids) - 0.3)
    ax.set_xticks(list(shown), [ids[i] for i in shown], rotation=0.0 if len(ids) <= _FEW_SENSORS else 90.0)
