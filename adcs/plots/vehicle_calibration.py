"""Figure of the calibration of a vehicle's magnetometers."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from adcs.log_calibration.calibrate import LogCalibration
from magloc.plots import style

_PANEL_IN, _MARGIN_IN = 1.9, 0.6
_MOST_POINTS = 4000


def log_calibration_figure(found: LogCalibration) -> Figure:
    """Draw the modulus of each magnetometer before and after its calibration; shades are excluded parts.

    Without any error the modulus equals the Earth's field, the dashed line.
    """
    estimate = found.fit.estimate
    data, M = estimate.problem.inertial, len(estimate.rows)
    figure = style.new_figure(_PANEL_IN * M + _MARGIN_IN)
    panels = figure.subplots(M, 1, sharex=True, squeeze=False)[:, 0]
    for m, (ax, series) in enumerate(zip(panels, estimate.problem.magnetometers, strict=True)):
        rows = estimate.sensor_rows(m, all_rows=True)
        thin = slice(None, None, max(1, len(rows.which) // _MOST_POINTS))
        time_s = series.time_s[rows.which] - data.time_s[0]
        raw = np.linalg.norm(series.values[rows.which], axis=1)
        corrected = np.linalg.norm(found.corrected_T(m), axis=1)
        ax.plot(time_s[thin], raw[thin], color=style.GREY, lw=0.7, label="as read")
        ax.plot(time_s[thin], 1e6 * corrected[thin], color=style.ESTIMATE, lw=0.7, label="calibrated")
        ax.axhline(np.linalg.norm(estimate.field_uT[0]), color=style.BLACK, lw=0.7, ls="--", label="Earth")
        edges = data.time_s[data.knots] - data.time_s[0]
        for k in np.flatnonzero(found.fit.disturbed[m]):
            ax.axvspan(edges[k], edges[k + 1], color=style.LIGHT_GREY, lw=0.0)
        style.label_axes(ax, "time [s]" if m == M - 1 else "", "modulus [µT]", series.name)
    style.add_legend(panels[0], ncols=3)
    style.add_title(figure, "Modulus of the field, before and after the calibration")
    return figure
