"""Figure of the attitude of an inertial unit: angles, standard deviations, and times of a disturbed field."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from adcs import quaternion
from adcs.complementary.filters import LEFT_OUT, SUBTRACTED
from adcs.complementary.orientation_errors import error_angles
from adcs.satellite.attitude_track import AttitudeTrack
from arrays.typing import FloatArray
from magloc.plots import style

_MOST_POINTS = 4000
_GAP_STEPS = 20.0  # usual steps; no line crosses a longer gap


def inertial_figure(
    track: AttitudeTrack, name: str, q_true: FloatArray | None = None, compared: str = "error"
) -> Figure:
    """Draw yaw, pitch and roll, and σ of heading and tilt, with errors by a truth (n, 4), or what else is compared."""
    every = slice(None, None, max(1, len(track) // _MOST_POINTS))
    time_s = track.time_s[every]
    steps_s = np.diff(time_s, prepend=time_s[0])
    is_gap = steps_s > _GAP_STEPS * np.median(steps_s)
    figure = style.new_figure(5.2)
    above, heading, tilt = figure.subplots(3, 1, sharex=True, height_ratios=[3, 2, 2])
    angles = quaternion.to_rotation(track.q[every]).as_euler("ZYX", degrees=True)
    for values, word, (_, colour, _, line) in zip(angles.T, ("yaw", "pitch", "roll"), style.COMPONENTS, strict=True):
        is_wrap = np.abs(np.diff(values, prepend=values[0])) > 180.0
        above.plot(time_s, np.where(is_wrap | is_gap, np.nan, values), color=colour, ls=line, lw=0.9, label=word)
    style.label_axes(above, "", "angle [°]", "east, north, up from body: yaw, pitch, roll")
    sigma = np.degrees(track.sigma["level"][every])
    errors = None if q_true is None else [np.degrees(e) for e in error_angles(track.q[every], q_true[every])[1:]]
    for i, (ax, word, values) in enumerate(
        ((heading, "heading", sigma[:, 2]), (tilt, "tilt", np.hypot(sigma[:, 0], sigma[:, 1])))
    ):
        if errors is not None:
            shown = (errors[i] + 180.0) % 360.0 - 180.0
            ax.plot(time_s, np.where(is_gap, np.nan, np.abs(shown)), color=style.BLUE, lw=0.7, label=compared)
        ax.plot(time_s, np.where(is_gap, np.nan, values), color=style.ORANGE, lw=1.1, ls="--", label="σ")
        ax.set_ylim(bottom=0.0)
        style.label_axes(ax, "", f"{word} [°]")
        style.add_legend(ax)
    for ax in (above, heading):
        style.shade_gaps(ax, time_s, ~track.degraded[LEFT_OUT][every], LEFT_OUT)
        whole_height = {"transform": ax.get_xaxis_transform(), "color": style.PALE_GREY, "alpha": 0.35, "lw": 0.0}
        subtracted = track.degraded[SUBTRACTED][every]
        ax.fill_between(
            time_s, 0.0, 1.0, where=subtracted, label=SUBTRACTED if subtracted.any() else "_", **whole_height
        )
    style.add_legend(above, ncols=5)
    tilt.set_xlabel("time [s]", fontsize=style.FONT_SIZE)
    tilt.set_xlim(time_s[0], time_s[-1])
    style.add_title(figure, f"{name}: {track.title}")
    return figure
