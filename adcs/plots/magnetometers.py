"""Figures of magnetometers on board: fields of the satellite's loads, and the calibration in orbit."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from adcs.satellite.magnetometer_calibration import NAMES, MagnetometerCalibration
from adcs.satellite.own_fields import OwnFields
from magloc.plots import style

_T_IN_nT = 1e9
_PANEL_IN, _MARGIN_IN = 1.3, 0.7


def own_fields_figure(own: OwnFields) -> Figure:
    """Draw the field of every load at every magnetometer with ±3σ, a panel for each load."""
    figure = style.new_figure(_PANEL_IN * len(own.names) + _MARGIN_IN)
    places = np.arange(own.array.n_sensors)
    axes = figure.subplots(len(own.names), 1, sharex=True, squeeze=False)[:, 0]
    loads = zip(axes, own.names, _T_IN_nT * own.vectors_T, _T_IN_nT * own.sigma_T, own.switches, strict=True)
    for ax, name, vectors, sigma, switches in loads:
        for i, (component, colour, marker, _) in enumerate(style.COMPONENTS):
            bars = {"fmt": marker, "color": colour, "ms": 4.0, "lw": 0.9, "capsize": 2.0, "label": component}
            ax.errorbar(places + 0.2 * (i - 1), vectors[:, i], 3.0 * sigma[:, i], **bars)
        ax.axhline(0.0, color=style.GREY, lw=0.5)
        style.label_axes(ax, "", "field [nT]", f"{name}: {switches} switches")
    style.add_legend(axes[0])
    style.label_sensors(axes[-1], own.array.ids)
    style.add_title(figure, "What loads add to the magnetometers, body axes, ±3σ")
    return figure


def magnetometer_figure(result: MagnetometerCalibration) -> Figure:
    """Draw the residuals of the rows, and the parameters in standard deviations of their prior.

    A parameter with an error bar as long as the prior's is not observable.
    """
    figure = style.new_figure(4.6)
    left, numbers = figure.subplots(2, 1)
    residual_nT = _T_IN_nT * result.residual_T.reshape(len(result.residual_T), -1)
    one = (("modulus", style.BLACK, "o", "-"),)
    for values, (name, colour, _, _) in zip(
        residual_nT.T, one if residual_nT.shape[1] == 1 else style.COMPONENTS, strict=True
    ):
        left.plot(values, ".", ms=2.0, color=colour, label=name)
    rms = f"rms {_T_IN_nT * result.rms_T:.0f} nT, {_T_IN_nT * result.raw_rms_T:.0f} nT without calibration"
    style.label_axes(left, "row", "field less the model [nT]", rms)
    style.add_legend(left, markerscale=3.0)
    prior = result.prior.deviations
    known = prior > 0.0
    change = np.concatenate([result.bias_T, result.gain.ravel(), [result.time_shift_s]])[known] / prior[known]
    numbers.axhspan(-1.0, 1.0, color=style.LIGHT_GREY, lw=0.0, label="±σ of the prior")
    bars = {"fmt": "o", "color": style.BLUE, "ms": 4.0, "lw": 0.9, "capsize": 2.0, "label": "found, ±σ"}
    numbers.errorbar(np.arange(known.sum()), change, result.sigma[known] / prior[known], **bars)
    style.label_axes(numbers, "", "change / σ of the prior [1]")
    names = [name.replace("_", " ") for name, shown in zip(NAMES, known, strict=True) if shown]
    numbers.set_xticks(np.arange(len(names)), names, rotation=90.0)
    style.add_legend(numbers)
    style.add_title(figure, "Calibration of a magnetometer")
    return figure
