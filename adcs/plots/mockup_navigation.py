"""Figures of the table-top satellite's runs: zeros of the accelerometer, and fusion of late fixes.

:func:`zeros_figure` has what figures 13 to 18 of the source show, :func:`fusion_figure` what 21 to 24 do.
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
# Of normal errors, 90 % and 0.6 times their width on either side are 3.6 standard deviations.
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
    """Readings, heading, velocities, and positions without and with the zeros found, with their rms errors."""
    figure = style.new_figure(6.6)
    axes = figure.subplots(3, 2, sharex=True)
    keep = _thinned(len(imu))
    for column, (name, colour, line) in enumerate(_BODY_AXES):
        readings = imu.acceleration_m_s2[keep, column]
        axes[0, 0].plot(imu.time_s[keep], readings, line, color=colour, lw=0.6, label=f"body {name}", zorder=2 - column)
    style.dress(axes[0, 0], "", "acceleration [m/s²]", "accelerometer")
    style.legend(axes[0, 0])
    axes[0, 1].plot(imu.time_s[keep], np.degrees(imu.rate_rad_s[keep]), color=style.BLUE, lw=0.8)
    style.dress(axes[0, 1], "", "rate [°/s]", "gyro")
    _heading(axes[1, 0], imu, fixes, after)
    _velocities(axes[1, 1], after, fixes)
    style.dress(axes[1, 1], "", "velocity [m/s]", "velocity after the fit")
    limits = style.limits_of([before.position_m, after.position_m, fixes.position_m], share=1.0)
    for ax, track, text in (
        (axes[2, 0], before, f"position before the fit: {position_before_mm:.0f} mm rms"),
        (axes[2, 1], after, f"position after it: {position_after_mm:.2g} mm rms"),
    ):
        _positions(ax, track, fixes)
        ax.set_ylim(*limits)
        style.dress(ax, "time [s]", "position [m]", text)
    for ax in axes.flat:
        ax.set_xlim(imu.begin_s, imu.end_s)
    handles, labels = axes[2, 0].get_legend_handles_labels()
    style.legend(figure, handles=handles, labels=labels, loc="outside lower center", ncols=4)
    style.headline(figure, title)
    return figure


def _heading(ax: Axes, imu: ImuRecord, fixes: FixRecord, after: PlanarTrack) -> None:
    keep = _thinned(len(after))
    ax.plot(after.time_s[keep], np.degrees(after.heading_rad[keep]), color=style.BLUE, label="gyro")
    late = fixes.arrival_s <= imu.end_s
    arrival_s, exposure_s = fixes.arrival_s[late], fixes.time_s[late]
    full = np.interp(exposure_s, after.time_s, after.heading_rad)
    seen = full + wrapped(fixes.heading_rad[late] - full)
    ax.plot(
        arrival_s, np.degrees(seen), ".--", color=style.ORANGE, lw=0.8, ms=_dot(len(seen)), label="camera, on arrival"
    )
    style.dress(ax, "", "heading [°]", "heading")
    style.legend(ax)


@dataclass(frozen=True, eq=False)
class FusionPicture:
    """One run of one method."""

    title: str
    truth: PlanarTrack  # at the same instants
    track: PlanarTrack  # at the same instants
    fixes: FixRecord  # those that arrived within the run
    outcomes: tuple[FixOutcome, ...]  # what became of them
    sigma_m: FloatArray | None = None  # (n, 2): what the method believes of its errors
    sigma_rad: FloatArray | None = None  # (n,): what the method believes of its errors
    begin_s: float = 10.0  # what is before it does not count, and is left out of the limits

    @property
    def used(self) -> BoolArray:
        """Fixes that were not rejected, shape (k,)."""
        return np.array([outcome is not FixOutcome.REJECTED for outcome in self.outcomes], dtype=np.bool_)


def fusion_figure(picture: FusionPicture) -> Figure:
    """Fused velocity and position, and both less the camera's undelayed ones."""
    figure = style.new_figure(6.2)
    velocity, position, apart, slower = figure.subplots(4, 1, sharex=True)
    track = picture.track
    keep = _thinned(len(track))
    for column, (name, colour, line, _) in enumerate(_AXES):
        for ax, values in ((velocity, track.velocity_m_s), (position, track.position_m)):
            ax.plot(track.time_s[keep], values[keep, column], line, color=colour, lw=1.0, label=name)
    style.dress(velocity, "", "velocity [m/s]", "fused velocity")
    style.dress(position, "", "position [m]", "fused position")
    fixes = picture.fixes.rows(picture.used).in_time_order() if picture.used.any() else picture.fixes
    _differences(
        apart, fixes.time_s, 1e3 * (track.at(fixes.time_s).position_m - fixes.position_m), picture.begin_s, "no fixes"
    )
    style.dress(apart, "", "difference [mm]", "fused position less the camera's, undelayed")
    middle_s, mean = _camera_velocity(fixes)
    less = 1e3 * (track.at(middle_s).velocity_m_s - mean)
    _differences(slower, middle_s, less, picture.begin_s, "no two fixes")
    style.dress(slower, "time [s]", "difference [mm/s]", "fused velocity less that of two fixes in a row")
    for ax in (velocity, position, apart, slower):
        style.legend(ax)
    slower.set_xlim(min(0.0, float(track.time_s[0])), float(track.time_s[-1]))
    style.headline(figure, picture.title)
    return figure


def errors_figure(picture: FusionPicture) -> Figure:
    """The path in the plane, and errors against the truth with what the method believes of them."""
    figure = style.new_figure(4.6)
    panels = figure.subplot_mosaic([["path", "x"], ["path", "y"], ["path", "phi"]], width_ratios=[1.1, 1.0])
    _path(panels["path"], picture)
    track, truth = picture.track, picture.truth
    apart = 1e3 * (track.position_m - truth.position_m)
    late = track.time_s >= picture.begin_s
    for column, name in enumerate(("x", "y")):
        sigma = None if picture.sigma_m is None else 1e3 * picture.sigma_m[:, column]
        _error(panels[name], track.time_s, apart[:, column], sigma, late)
        style.dress(panels[name], "", "error [mm]", f"error of {name.upper()}")
        panels[name].tick_params(labelbottom=False)
    turn = np.degrees(wrapped(track.heading_rad - truth.heading_rad))
    sigma = None if picture.sigma_rad is None else np.degrees(picture.sigma_rad)
    _error(panels["phi"], track.time_s, turn, sigma, late)
    style.dress(panels["phi"], "time [s]", "error [°]", "error of the heading")
    for name in ("x", "y", "phi"):
        panels[name].set_xlim(0.0, float(track.time_s[-1]))
    handles, labels = panels["phi"].get_legend_handles_labels()
    more = panels["path"].get_legend_handles_labels()
    style.legend(figure, handles=more[0] + handles, labels=more[1] + labels, loc="outside lower center", ncols=6)
    style.headline(figure, picture.title)
    return figure


def methods_figure(lines: Sequence[tuple[str, FloatArray, FloatArray]], begin_s: float) -> Figure:
    """Errors of position of several methods through time."""
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
    style.logarithmic(ax, shown)
    ax.axvspan(0.0, begin_s, color=style.LIGHT_GREY, alpha=0.5, lw=0.0)
    ax.set_xlim(0.0, max(float(time_s[-1]) for _, time_s, _ in lines))
    style.dress(
        ax,
        "time [s]",
        "error of position [mm]",
        "one drive by all methods: largest error in each second; grey does not count",
    )
    handles, labels = ax.get_legend_handles_labels()
    style.legend(figure, handles=handles, labels=labels, loc="outside lower center", ncols=3)
    return figure


def _path(ax: Axes, picture: FusionPicture) -> None:
    keep = _thinned(len(picture.track))
    used = picture.used
    seen = picture.fixes.position_m
    ax.plot(*picture.track.position_m[keep].T, color=style.BLUE, lw=1.3, label="estimate", zorder=2.2)
    ax.plot(*picture.truth.position_m[keep].T, "--", color=style.TRUTH, lw=0.7, label="truth", zorder=2.4)
    if used.any():
        ax.plot(*seen[used].T, ".", color=style.ORANGE, ms=3.0, label="fixes", zorder=2.1)
    if not used.all():
        ax.plot(*seen[~used].T, "x", color=style.BLACK, ms=4.0, mew=0.8, label="rejected fixes", zorder=2.6)
    ax.plot(*picture.truth.position_m[0], "o", color=style.TRUTH, ms=5.0, mfc="white", label="start", zorder=2.7)
    ax.set_aspect("equal")
    # A method that follows false fixes leaves the table.
    for limit, axis in ((ax.set_xlim, 0), (ax.set_ylim, 1)):
        limit(*style.limits_of([picture.track.position_m[:, axis]], [picture.truth.position_m[:, axis]], margin=0.15))
    style.dress(ax, "X [m]", "Y [m]", "path on the table")


def _error(ax: Axes, time_s: FloatArray, error: FloatArray, sigma: FloatArray | None, late: BoolArray) -> None:
    keep = _thinned(len(time_s))
    always = []
    if sigma is not None:
        ax.fill_between(
            time_s[keep], -3.0 * sigma[keep], 3.0 * sigma[keep], color=style.LIGHT_GREY, lw=0.0, label="±3σ"
        )
        always = [3.0 * sigma[late], -3.0 * sigma[late]]
    ax.plot(time_s[keep], error[keep], color=style.BLUE, lw=0.8, label="error")
    ax.axhline(0.0, color=style.GREY, lw=0.5, zorder=1.5)
    ax.set_ylim(*style.limits_of([error[late]], always, share=1.0))


def _positions(ax: Axes, track: PlanarTrack, fixes: FixRecord) -> None:
    keep = _thinned(len(track))
    for column, (name, colour, line, mark) in enumerate(_AXES):
        ax.plot(
            track.time_s[keep], track.position_m[keep, column], line, color=colour, lw=1.1, label=f"{name}, samples"
        )
        ax.plot(
            fixes.time_s, fixes.position_m[:, column], mark, color=colour, ms=_dot(len(fixes)), mfc="white", mew=0.7,
            label=f"{name}, camera",
        )  # fmt: skip


def _velocities(ax: Axes, track: PlanarTrack, fixes: FixRecord) -> None:
    keep = _thinned(len(track))
    middle_s, mean = _camera_velocity(fixes.in_time_order())
    for column, (_, colour, line, mark) in enumerate(_AXES):
        ax.plot(track.time_s[keep], track.velocity_m_s[keep, column], line, color=colour, lw=1.1)
        ax.plot(middle_s, mean[:, column], mark, color=colour, ms=_dot(len(middle_s)), mfc="white", mew=0.7)


def _nothing(ax: Axes, why: str) -> None:
    ax.text(0.5, 0.5, why, transform=ax.transAxes, ha="center", va="center", color=style.GREY)
    ax.set_yticks([])


def _differences(ax: Axes, time_s: FloatArray, values: FloatArray, begin_s: float, without: str) -> None:
    if not len(time_s):
        _nothing(ax, without)
        return
    late = time_s >= begin_s
    shown = [values[late] if late.any() else values]
    # All of them, unless few are far from the others.
    (inner_low, inner_high), (low, high) = (
        style.limits_of(shown, share=_SHARE, margin=_MARGIN),
        style.limits_of(shown, share=1.0),
    )
    low, high = max(low, inner_low), min(high, inner_high)
    for column, (name, colour, _, mark) in enumerate(_AXES):
        ax.plot(time_s, np.clip(values[:, column], low, high), mark, color=colour, ms=2.0, mew=0.0, label=name)
    outside = int(np.any((values < low) | (values > high), axis=1).sum())
    if outside:
        ax.text(
            0.995, 0.93, f"{outside} beyond the limits, at the edge", transform=ax.transAxes, ha="right", va="top",
            fontsize=style.SMALL_LETTERS,
        )  # fmt: skip
    ax.axhline(0.0, color=style.GREY, lw=0.5, zorder=1.5)
    ax.set_ylim(low, high)


def _camera_velocity(fixes: FixRecord) -> tuple[FloatArray, FloatArray]:
    """Velocity between fixes in a row, and the middles between them, which it belongs to."""
    step_s = np.diff(fixes.time_s)
    apart = step_s > 0.0
    mean = (np.diff(fixes.position_m, axis=0)[apart].T / step_s[apart]).T
    return 0.5 * (fixes.time_s[1:] + fixes.time_s[:-1])[apart], mean


def _thinned(n: int) -> slice:
    return slice(None, None, max(1, n // _MOST_POINTS))


def _dot(n: int) -> float:
    return 4.0 if n <= _FEW_FIXES else 2.0
