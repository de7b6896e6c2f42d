"""What a calibration adds to an array, and what it leaves of the readings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from magloc.moving_source import AXES, GAINS, OFFSET, POSITION
from magloc.plots import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

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
        As in :class:`magloc.calibration.CalibrationResult`.

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
