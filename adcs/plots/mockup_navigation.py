"""Figures of runs of the table-top satellite: zeros of the accelerometer, and fusion of late fixes.

:func:`zeros_figure` corresponds to figures 13 to 18 of the source, :func:`fusion_figure` to figures 21 to 24.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from adcs.mockup.navigation.fixes import FixOutcome, FixRecord
from adcs.mockup.navigation.strapdown import ImuRecord, PlanarTrack, wrapped
from magloc.plots import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
from arrays.typing import BoolArray, FloatArray

_AXES = (("X", style.BLUE, "-", "o"), ("Y", style.ORANGE, "--", "s"))
_BODY_AXES = (("x", style.BLUE, "-"), ("y", style.ORANGE, "-"))
_METHOD_LINES = ((style.ORANGE, "-"), ("#009e73", "-"), (style.BLUE, "-"), (style.GREY, "-"), (style.BLACK, "--"))
_BLOCK_S = 1.0
_MOST_POINTS = 4000
_FEW_FIXES = 60
# For normal errors these limits are at 3.6 standard deviations.
_SHARE, _MARGIN = 0.9, 0.6


def zeros_figure(
    title: str,
    imu: ImuRecord,
    fixes: FixRecord,
    before: PlanarTrack,
    after: PlanarTrack,
    position_before_mm: float,
    position_after_mm: float,
) -> Figure:
    """Draw readings, heading, velocities, and positions before and after the fit of the zeros."""
    figure = style.new_figure(6.6)
    axes = figure.subplots(3, 2, sharex=True)
    rows = _stride(len(imu))
    for column, (name, colour, line) in enumerate(_BODY_AXES):
        readings = imu.acceleration_m_s2[rows, column]
        axes[0, 0].plot(imu.time_s[rows], readings, line, color=colour, lw=0.6, label=f"body {name}", zorder=2 - column)
    style.label_axes(axes[0, 0], "", "acceleration [m/s²]", "accelerometer")
    style.add_legend(axes[0, 0])
    axes[0, 1].plot(imu.time_s[rows], np.degrees(imu.rate_rad_s[rows]), color=style.BLUE, lw=0.8)
    style.label_axes(axes[0, 1], "", "rate [°/s]", "gyro")
    _draw_heading(axes[1, 0], imu, fixes, after)
    _draw_velocities(axes[1, 1], after, fixes)
    style.label_axes(axes[1, 1], "", "velocity [m/s]", "velocity after the fit")
    limits = style.axis_limits([before.position_m, after.position_m, fixes.position_m], share=1.0)
    for ax, track, text in (
        (axes[2, 0], before, f"position before the fit: {position_before_mm:.0f} mm rms"),
        (axes[2, 1], after, f"position after it: {position_after_mm:.2g} mm rms"),
    ):
        _draw_positions(ax, track, fixes)
        ax.set_ylim(*limits)
        style.label_axes(ax, "time [s]", "position [m]", text)
    for ax in axes.flat:
        ax.set_xlim(imu.begin_s, imu.end_s)
    handles, labels = axes[2, 0].get_legend_handles_labels()
    style.add_legend(figure, handles=handles, labels=labels, loc="outside lower center", ncols=4)
    style.add_title(figure, title)
    return figure


def _draw_heading(ax: Axes, imu: ImuRecord, fixes: FixRecord, after: PlanarTrack) -> None:
    rows = _stride(len(after))
    ax.plot(after.time_s[rows], np.degrees(after.heading_rad[rows]), color=style.BLUE, label="gyro")
    late = fixes.arrival_s <= imu.end_s
    arrival_s, exposure_s = fixes.arrival_s[late], fixes.time_s[late]
    continuous = np.interp(exposure_s, after.time_s, after.heading_rad)
    heading = continuous + wrapped(fixes.heading_rad[late] - continuous)
    ax.plot(
        arrival_s,
        np.degrees(heading),
        ".--",
        color=style.ORANGE,
        lw=0.8,
        ms=_marker_size(len(heading)),
        label="camera, on arrival",
    )
    style.label_axes(ax, "", "heading [°]", "heading")
    style.add_legend(ax)


@dataclass(frozen=True, eq=False)
class FusionPicture:
    """Data of one run of one method."""

    title: str
    truth: PlanarTrack  # at the times of the track
    track: PlanarTrack
    fixes: FixRecord  # fixes that arrived within the run
    outcomes: tuple[FixOutcome, ...]  # of the fixes
    sigma_m: FloatArray | None = None  # (n, 2): standard deviations of the position by the method
    sigma_rad: FloatArray | None = None  # (n,): standard deviations of the heading by the method
    begin_s: float = 10.0  # errors before this time do not count for the limits

    @property
    def used(self) -> BoolArray:
        """Whether each fix was used, shape (k,)."""
        return np.array([outcome is not FixOutcome.REJECTED for outcome in self.outcomes], dtype=np.bool_)


def fusion_figure(picture: FusionPicture) -> Figure:
    """Draw fused velocity and position, and their differences from undelayed fixes."""
    figure = style.new_figure(6.2)
    velocity, position, position_error, velocity_error = figure.subplots(4, 1, sharex=True)
    track = picture.track
    rows = _stride(len(track))
    for column, (name, colour, line, _) in enumerate(_AXES):
        for ax, values in ((velocity, track.velocity_m_s), (position, track.position_m)):
            ax.plot(track.time_s[rows], values[rows, column], line, color=colour, lw=1.0, label=name)
    style.label_axes(velocity, "", "velocity [m/s]", "fused velocity")
    style.label_axes(position, "", "position [m]", "fused position")
    fixes = picture.fixes.rows(picture.used).in_time_order() if picture.used.any() else picture.fixes
    differences_mm = 1e3 * (track.at(fixes.time_s).position_m - fixes.position_m)
    _draw_differences(position_error, fixes.time_s, differences_mm, picture.begin_s, "no fixes")
    style.label_axes(position_error, "", "difference [mm]", "fused position less the camera's, undelayed")
    middle_s, mean = _camera_velocity(fixes)
    differences_mm_s = 1e3 * (track.at(middle_s).velocity_m_s - mean)
    _draw_differences(velocity_error, middle_s, differences_mm_s, picture.begin_s, "no two fixes")
    style.label_axes(velocity_error, "time [s]", "difference [mm/s]", "fused velocity less that of two fixes in a row")
    for ax in (velocity, position, position_error, velocity_error):
        style.add_legend(ax)
    velocity_error.set_xlim(min(0.0, float(track.time_s[0])), float(track.time_s[-1]))
    style.add_title(figure, picture.title)
    return figure


def errors_figure(picture: FusionPicture) -> Figure:
    """Draw the path in the plane, and the errors with the ±3σ of the method."""
    figure = style.new_figure(4.6)
    panels = figure.subplot_mosaic([["path", "x"], ["path", "y"], ["path", "phi"]], width_ratios=[1.1, 1.0])
    _draw_path(panels["path"], picture)
    track, truth = picture.track, picture.truth
    error_mm = 1e3 * (track.position_m - truth.position_m)
    late = track.time_s >= picture.begin_s
    for column, name in enumerate(("x", "y")):
        sigma = None if picture.sigma_m is None else 1e3 * picture.sigma_m[:, column]
        _draw_error(panels[name], track.time_s, error_mm[:, column], sigma, late)
        style.label_axes(panels[name], "", "error [mm]", f"error of {name.upper()}")
        panels[name].tick_params(labelbottom=False)
    turn = np.degrees(wrapped(track.heading_rad - truth.heading_rad))
    sigma = None if picture.sigma_rad is None else np.degrees(picture.sigma_rad)
    _draw_error(panels["phi"], track.time_s, turn, sigma, late)
    style.label_axes(panels["phi"], "time [s]", "error [°]", "error of the heading")
    for name in ("x", "y", "phi"):
        panels[name].set_xlim(0.0, float(track.time_s[-1]))
    handles, labels = panels["phi"].get_legend_handles_labels()
    more = panels["path"].get_legend_handles_labels()
    style.add_legend(figure, handles=more[0] + handles, labels=more[1] + labels, loc="outside lower center", ncols=6)
    style.add_title(figure, picture.title)
    return figure


def methods_figure(lines: Sequence[tuple[str, FloatArray, FloatArray]], begin_s: float) -> Figure:
    """Draw the position errors of several methods over time."""
    figure = style.new_figure(3.9)
    ax = figure.add_subplot()
    shown = []
    for (name, time_s, error_mm), (colour, line) in zip(lines, itertools.cycle(_METHOD_LINES), strict=False):
        each = max(1, round(_BLOCK_S / float(time_s[1] - time_s[0])))
        n = len(time_s) // each * each
        largest = error_mm[:n].reshape(-1, each).max(axis=1)
        middle_s = time_s[:n].reshape(-1, each).mean(axis=1)
        ax.plot(middle_s, largest, line, color=colour, lw=1.1, label=name)
        shown.append(largest[middle_s >= begin_s])
    style.set_log_scale(ax, shown)
    ax.axvspan(0.0, begin_s, color=style.LIGHT_GREY, alpha=0.5, lw=0.0)
    ax.set_xlim(0.0, max(float(time_s[-1]) for _, time_s, _ in lines))
    style.label_axes(
        ax,
        "time [s]",
        "error of position [mm]",
        "one drive by all methods: largest error in each second; grey does not count",
    )
    handles, labels = ax.get_legend_handles_labels()
    style.add_legend(figure, handles=handles, labels=labels, loc="outside lower center", ncols=3)
    return figure


def _draw_path(ax: Axes, picture: FusionPicture) -> None:
    rows = _stride(len(picture.track))
    used = picture.used
    fixes_m = picture.fixes.position_m
    ax.plot(*picture.track.position_m[rows].T, color=style.BLUE, lw=1.3, label="estimate", zorder=2.2)
    ax.plot(*picture.truth.position_m[rows].T, "--", color=style.TRUTH, lw=0.7, label="truth", zorder=2.4)
    if used.any():
        ax.plot(*fixes_m[used].T, ".", color=style.ORANGE, ms=3.0, label="fixes", zorder=2.1)
    if not used.all():
        ax.plot(*fixes_m[~used].T, "x", color=style.BLACK, ms=4.0, mew=0.8, label="rejected fixes", zorder=2.6)
    ax.plot(*picture.truth.position_m[0], "o", color=style.TRUTH, ms=5.0, mfc="white", label="start", zorder=2.7)
    ax.set_aspect("equal")
    # The limits follow the truth, because a method with false fixes can leave the table.
    for limit, axis in ((ax.set_xlim, 0), (ax.set_ylim, 1)):
        limit(*style.axis_limits([picture.track.position_m[:, axis]], [picture.truth.position_m[:, axis]], margin=0.15))
    style.label_axes(ax, "X [m]", "Y [m]", "path on the table")


def _draw_error(ax: Axes, time_s: FloatArray, error: FloatArray, sigma: FloatArray | None, late: BoolArray) -> None:
    rows = _stride(len(time_s))
    always = []
    if sigma is not None:
        ax.fill_between(
            time_s[rows], -3.0 * sigma[rows], 3.0 * sigma[rows], color=style.LIGHT_GREY, lw=0.0, label="±3σ"
        )
        always = [3.0 * sigma[late], -3.0 * sigma[late]]
    ax.plot(time_s[rows], error[rows], color=style.BLUE, lw=0.8, label="error")
    ax.axhline(0.0, color=style.GREY, lw=0.5, zorder=1.5)
    ax.set_ylim(*style.axis_limits([error[late]], always, share=1.0))


def _draw_positions(ax: Axes, track: PlanarTrack, fixes: FixRecord) -> None:
    rows = _stride(len(track))
    for column, (name, colour, line, mark) in enumerate(_AXES):
        ax.plot(
            track.time_s[rows], track.position_m[rows, column], line, color=colour, lw=1.1, label=f"{name}, samples"
        )
        ax.plot(
            fixes.time_s, fixes.position_m[:, column], mark, color=colour, ms=_marker_size(len(fixes)), mfc="white",
            mew=0.7, label=f"{name}, camera",
        )  # fmt: skip


def _draw_velocities(ax: Axes, track: PlanarTrack, fixes: FixRecord) -> None:
    rows = _stride(len(track))
    middle_s, mean = _camera_velocity(fixes.in_time_order())
    for column, (_, colour, line, mark) in enumerate(_AXES):
        ax.plot(track.time_s[rows], track.velocity_m_s[rows, column], line, color=colour, lw=1.1)
        ax.plot(middle_s, mean[:, column], mark, color=colour, ms=_marker_size(len(middle_s)), mfc="white", mew=0.7)


def _draw_reason(ax: Axes, reason: str) -> None:
    ax.text(0.5, 0.5, reason, transform=ax.transAxes, ha="center", va="center", color=style.GREY)
    ax.set_yticks([])


def _draw_differences(ax: Axes, time_s: FloatArray, values: FloatArray, begin_s: float, reason: str) -> None:
    if not len(time_s):
        _draw_reason(ax, reason)
        return
    late = time_s >= begin_s
    shown = [values[late] if late.any() else values]
    # All values are within the limits, unless a few are far from the others.
    (inner_low, inner_high), (low, high) = (
        style.axis_limits(shown, share=_SHARE, margin=_MARGIN),
        style.axis_limits(shown, share=1.0),
    )
    low, high = max(low, inner_low), min(high, inner_high)
    for column, (name, colour, _, mark) in enumerate(_AXES):
        ax.plot(time_s, np.clip(values[:, column], low, high), mark, color=colour, ms=2.0, mew=0.0, label=name)
    outside = int(np.any((values < low) | (values > high), axis=1).sum())
    if outside:
        ax.text(
            0.995, 0.93, f"{outside} beyond the limits, at the edge", transform=ax.transAxes, ha="right", va="top",
            fontsize=style.SMALL_FONT_SIZE,
        )  # fmt: skip
    ax.axhline(0.0, color=style.GREY, lw=0.5, zorder=1.5)
    ax.set_ylim(low, high)


def _camera_velocity(fixes: FixRecord) -> tuple[FloatArray, FloatArray]:
    """Return the times between successive fixes, and the mean velocities there."""
    step_s = np.diff(fixes.time_s)
    positive = step_s > 0.0
    mean = (np.diff(fixes.position_m, axis=0)[positive].T / step_s[positive]).T
    return 0.5 * (fixes.time_s[1:] + fixes.time_s[:-1])[positive], mean


def _stride(n: int) -> slice:
    """Return the slice that leaves as many rows as a figure can show."""
    return slice(None, None, max(1, n // _MOST_POINTS))


def _marker_size(n: int) -> float:
    return 4.0 if n <= _FEW_FIXES else 2.0
