"""Figures of calibrations: changes of the array, and residuals of the readings."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from arrays.io.csv import Column
from magloc.calibration.bodies.results import BodyCalibration
from magloc.calibration.results import SourceCalibration, TurningCalibration
from magloc.calibration.sensors import AXES, AXIS_PAIRS, GAINS, OFFSET, POSITION
from magloc.plots import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
from arrays.typing import FloatArray

_T_IN_nT = 1e9


def calibration(result: SourceCalibration | BodyCalibration | TurningCalibration) -> Figure:
    """Draw a calibration.

    Parameters
    ----------
    result : Calibration
        Calibration by a source on a path, or by turning the array.

    Returns
    -------
    matplotlib.figure.Figure
        Figure; :func:`save` writes it to a file.

    Examples
    --------
    >>> import magloc
    >>> board = magloc.datasets.load("board")
    >>> prior = magloc.CalibrationPrior(estimate=("offsets",), offset_T=1e-6)
    >>> rows = board.readings[::10]
    >>> calibration = magloc.calibrate(board.array, rows, truth=board.truth, prior=prior)
    >>> figure = magloc.plots.calibration(calibration)
    """
    return turning_figure(result) if isinstance(result, TurningCalibration) else calibration_figure(result)


def columns_of_calibration(result: SourceCalibration | BodyCalibration | TurningCalibration) -> dict[str, Column]:
    """Return the data of the figure as columns."""
    return turning_columns(result) if isinstance(result, TurningCalibration) else calibration_columns(result)


def calibration_columns(result: SourceCalibration | BodyCalibration) -> dict[str, Column]:
    """Return the data of :func:`calibration_figure` as columns."""
    before, after = result.rms_T
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
        change, deviation = scale * result.change[:, place], scale * result.sigma[:, place]
        columns |= dict(zip((f"change_of_{name}_{unit}" for name in names), change.T, strict=True))
        columns |= dict(zip((f"s_{name}_{unit}" for name in names), deviation.T, strict=True))
    return columns


def turning_columns(result: TurningCalibration) -> dict[str, Column]:
    """Return the moduli of the sensors before and after the calibration as columns."""
    columns: dict[str, Column] = {"time_s": result.time_s}
    for i, name in enumerate(result.fits):
        for when, modulus in zip(("before", "after"), result.moduli_T, strict=True):
            columns[f"{name}_modulus_{when}_nT"] = _T_IN_nT * modulus[:, i]
    return columns


_GROUPS = (
    (POSITION, 1e3, "position [mm]"),
    (GAINS, 1e2, "gain [%]"),
    (AXES, 180.0 / np.pi, "axes [°]"),
    (OFFSET, 1e6, "offset [µT]"),
)


def calibration_figure(result: SourceCalibration | BodyCalibration) -> Figure:
    """Draw the residuals of every sensor before and after, and the changes of the array file.

    Estimated positions, gains, axes and offsets have a panel each. The bars are 95 % intervals.
    """
    ids, estimated = result.array.ids, result.estimated
    groups = [(place, scale, label) for place, scale, label in _GROUPS if estimated[:, place].any()]
    figure = style.new_figure(1.5 + 1.35 * len(groups))
    axes = np.atleast_1d(figure.subplots(1 + len(groups), 1, sharex=True))
    _draw_before_after(axes[0], *result.rms_T, "residual rms [nT]", "what is left of the readings")
    for ax, (place, scale, label) in zip(axes[1:], groups, strict=True):
        values = scale * np.where(estimated[:, place], result.change[:, place], np.nan)
        spread = scale * style.SIGMAS_95 * result.sigma[:, place]
        _draw_values(ax, values, spread)
        style.label_axes(ax, "", f"change of\n{label}")
    if groups:
        axes[1].set_title("what the calibration changes, 95 % intervals", fontsize=style.FONT_SIZE, loc="left")
        style.add_legend(axes[1])
    style.label_sensors(axes[-1], ids)
    return figure


def turning_figure(result: TurningCalibration) -> Figure:
    """Draw the rms error of every sensor's modulus, and the changes of gains and offsets."""
    ids = list(result.fits)
    modulus_T = np.broadcast_to(result.modulus_T, len(result.time_s))[:, None]
    first, last = (np.sqrt(np.nanmean((read - modulus_T) ** 2, axis=0)) for read in result.moduli_T)
    before, after = (
        [sensor.calibration for sensor in array.sensors if sensor.id in result.fits]
        for array in (result.nominal, result.array)
    )
    gains = [np.diagonal([one.scale for one in state], axis1=1, axis2=2) for state in (before, after)]
    offset_change_T = np.subtract([one.offset_T for one in after], [one.offset_T for one in before])
    figure = style.new_figure(4.2)
    axes = figure.subplots(3, 1, sharex=True)
    _draw_before_after(axes[0], first, last, "rms of the\nmodulus [nT]", "modulus read minus the field's")
    for ax, values, label in (
        (axes[1], 1e2 * (gains[1] / gains[0] - 1.0), "gain [%]"),
        (axes[2], 1e6 * offset_change_T, "offset [µT]"),
    ):
        _draw_values(ax, values, np.full_like(values, np.nan))
        style.label_axes(ax, "", f"change of\n{label}")
    axes[1].set_title("what the calibration changes", fontsize=style.FONT_SIZE, loc="left")
    style.add_legend(axes[1])
    style.label_sensors(axes[-1], ids)
    return figure


def _draw_before_after(ax: Axes, before_T: FloatArray, after_T: FloatArray, label: str, title: str) -> None:
    sensors = np.arange(len(before_T))
    style.set_log_scale(ax, [1e9 * before_T, 1e9 * after_T])
    ax.vlines(sensors, 1e9 * before_T, 1e9 * after_T, color=style.GREY, lw=0.6, zorder=1.5)
    ax.plot(sensors, 1e9 * before_T, "o", ms=3.5, mfc="white", mec=style.BLACK, label="before")
    ax.plot(sensors, 1e9 * after_T, "s", ms=3.5, color=style.BLUE, label="after")
    style.label_axes(ax, "", label, title)
    style.add_legend(ax)


def _draw_values(ax: Axes, values: FloatArray, spread: FloatArray) -> None:
    """Draw three components (n, 3) of every sensor, or its six angles, two for each channel."""
    per_component = values.shape[1] // 3
    step, thin = (0.22, 0.0) if per_component == 1 else (0.13, 1.0)
    for k in range(values.shape[1]):
        name, colour, marker, _ = style.COMPONENTS[k // per_component]
        places = np.arange(len(values)) + step * (k - 0.5 * (values.shape[1] - 1))
        ax.errorbar(
            places, values[:, k], spread[:, k], fmt=marker, color=colour, ms=2.8 - 0.6 * thin, mfc="white",
            mew=0.8 - 0.1 * thin, elinewidth=0.8 - 0.2 * thin, label="_" if k % per_component else name,
        )  # fmt: skip
    ax.axhline(0.0, color=style.GREY, lw=0.6, zorder=1.2)
