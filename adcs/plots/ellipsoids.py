"""Figure of the roll/yaw satellite: guaranteed sets and ellipses of the Kalman filter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from adcs.ellipsoids.roll_yaw import ROLL, YAW, KalmanTrack, SetTrack
from arrays.typing import FloatArray

_SET, _KALMAN, _TRUTH = "#0072b2", "#d55e00", "black"
_INSTANTS = 4
_SET_SHADES = LinearSegmentedColormap.from_list("set", ["#ffffff", _SET, "#00304d"])
_KALMAN_SHADES = LinearSegmentedColormap.from_list("kalman", ["#ffffff", _KALMAN, "#7a3600"])
# It models the constant shift of the gyro as white noise.
_KALMAN_LABEL = "Kalman filter (white noise), 3σ"


@dataclass(frozen=True, eq=False)
class RollYawPicture:
    """Data of the figure."""

    title: str
    time_s: FloatArray  # (n_steps + 1,)
    states_rad: FloatArray  # (n_runs, n_steps + 1, 2): true (roll, yaw)
    track: SetTrack  # sets of the same runs
    kalman: KalmanTrack  # of the first run
    in_loop: bool  # whether the satellite is in its attitude loop
    jump_s: float | None = None  # time from which the readings are worse than their bound


def roll_yaw_figure(picture: RollYawPicture) -> Figure:
    """Draw the sets in the plane of roll and yaw, and the yaw errors of the runs.

    The last panel shows the attitude of a satellite in its attitude loop, or else the bound.
    """
    figure = Figure(figsize=(13.0, 7.6), layout="constrained")
    grid = figure.add_gridspec(3, 2, width_ratios=[1.0, 1.15])
    plane, error = figure.add_subplot(grid[:, 0]), figure.add_subplot(grid[0, 1])
    runs = figure.add_subplot(grid[1, 1], sharex=error)
    last = figure.add_subplot(grid[2, 1], sharex=error)
    _draw_sets(plane, picture)
    _draw_first_run(error, picture)
    _draw_runs(runs, picture)
    if picture.in_loop:
        _draw_attitude(last, picture)
    else:
        _draw_bounds(last, picture)
    for ax in (error, runs):
        ax.tick_params(labelbottom=False)
    for ax in (error, runs, last):
        ax.grid(alpha=0.3)
        ax.set_xlim(picture.time_s[0], picture.time_s[-1])
        if picture.jump_s is not None:
            ax.axvline(picture.jump_s, color="grey", lw=1.0, ls=":")
    last.set_xlabel("time [s]")
    figure.suptitle(picture.title)
    return figure


def ellipse_outline(centre: FloatArray, shape: FloatArray, n_points: int = 181) -> FloatArray:
    """Return points around an ellipse, even a degenerate one, shape (n_points, 2)."""
    eigenvalue, eigenvector = np.linalg.eigh(shape)
    angle = np.linspace(0.0, 2.0 * np.pi, n_points)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return centre + circle @ (eigenvector * np.sqrt(np.maximum(eigenvalue, 0.0))).T


def _draw_sets(ax: Axes, picture: RollYawPicture) -> None:
    n_steps = len(picture.time_s) - 1
    instants = [n_steps * i // _INSTANTS for i in range(_INSTANTS + 1)]
    shades = np.linspace(0.3, 1.0, len(instants))
    handles = []
    drawn = []
    for shade, i in zip(shades, instants, strict=True):
        truth = picture.states_rad[0, i]
        guaranteed = np.degrees(ellipse_outline(picture.track.centres[0, i] - truth, picture.track.shapes[0, i]))
        kalman = np.degrees(ellipse_outline(picture.kalman.means[i] - truth, 9.0 * picture.kalman.covariances[i]))
        ax.fill(*guaranteed.T, color=_SET, alpha=0.06)
        blue, orange = _SET_SHADES(shade), _KALMAN_SHADES(shade)
        label = f"{picture.time_s[i]:.0f} s"
        handles += ax.plot(*guaranteed.T, color=blue, lw=1.7, label=label)
        ax.plot(*kalman.T, color=orange, lw=1.5, ls="--")
        drawn.append(np.concatenate([guaranteed, kalman, [[0.0, 0.0]]]))
    ax.plot(0.0, 0.0, "+", color=_TRUTH, ms=12, mew=1.5, zorder=5)
    ax.axhline(0.0, color="grey", lw=0.5)
    ax.axvline(0.0, color="grey", lw=0.5)
    # The first set is within the limits only if the later ones stay visible beside it.
    later, first = np.concatenate(drawn[1:]), drawn[0]
    low, high = later.min(axis=0), later.max(axis=0)
    if (np.ptp(first, axis=0) < 8.0 * (high - low)).all():
        low, high = np.minimum(low, first.min(axis=0)), np.maximum(high, first.max(axis=0))
    margin = 0.05 * (high - low)
    ax.set_xlim(low[0] - margin[0], high[0] + margin[0])
    ax.set_ylim(low[1] - margin[1], high[1] + 5.0 * margin[1])  # room for the legend
    handles += [
        Line2D([], [], color=_KALMAN, lw=1.5, ls="--", label=_KALMAN_LABEL),
        Line2D([], [], color=_TRUTH, marker="+", ms=10, ls="", label="truth"),
    ]
    ax.legend(handles=handles, loc="upper left", frameon=False, ncols=2, fontsize=9, title="guaranteed set")
    ax.set(xlabel="roll minus true roll [°]", ylabel="yaw minus true yaw [°]", title="first run, darker is later")


def _draw_first_run(ax: Axes, picture: RollYawPicture) -> None:
    truth = picture.states_rad[0, :, YAW]
    centre = np.degrees(picture.track.centres[0, :, YAW] - truth)
    half_width = np.degrees(picture.track.yaw_half_widths[0])
    mean = np.degrees(picture.kalman.means[:, YAW] - truth)
    sigma = np.degrees(np.sqrt(picture.kalman.covariances[:, YAW, YAW]))
    ax.fill_between(picture.time_s, centre - half_width, centre + half_width, color=_SET, alpha=0.15, lw=0)
    ax.plot(picture.time_s, centre, color=_SET, lw=1.2, label="guaranteed set")
    ax.fill_between(picture.time_s, mean - 3.0 * sigma, mean + 3.0 * sigma, color=_KALMAN, alpha=0.25, lw=0)
    ax.plot(picture.time_s, mean, color=_KALMAN, lw=1.2, ls="--", label=_KALMAN_LABEL)
    ax.axhline(0.0, color=_TRUTH, lw=0.8)
    outside = float(np.mean(np.abs(mean) > 3.0 * sigma))
    ax.set(ylabel="yaw error [°]")
    ax.set_title(f"first run: truth beyond the Kalman filter's 3σ: {outside:.0%} of the time", fontsize=10)
    low, high = ax.get_ylim()
    ax.set_ylim(low, high + 0.2 * (high - low))
    ax.legend(loc="upper right", frameon=False, fontsize=8, ncols=2)


def _draw_runs(ax: Axes, picture: RollYawPicture) -> None:
    error = np.degrees(np.abs(picture.track.centres - picture.states_rad)[..., YAW])
    n_runs = len(error)
    ax.plot(picture.time_s, np.degrees(picture.track.yaw_half_widths.mean(axis=0)), color=_SET, lw=1.6)
    ax.plot(picture.time_s, error.max(axis=0), color="grey", lw=1.0, ls=":")
    ax.plot(picture.time_s, np.percentile(error, 95.0, axis=0), color="grey", lw=1.0, ls="--")
    ax.plot(picture.time_s, error.mean(axis=0), color=_TRUTH, lw=1.2)
    labels = ("guaranteed half-width, mean", "largest error", "95 %", "mean error")
    ax.legend(ax.get_lines(), labels, loc="upper right", frameon=False, fontsize=8, ncols=2)
    ax.set(ylabel="|yaw error| [°]", title=f"{n_runs} runs" if n_runs > 1 else "one run")
    ax.set_ylim(0.0, 1.3 * ax.get_ylim()[1])
    ax.title.set_fontsize(10)


def _draw_bounds(ax: Axes, picture: RollYawPicture) -> None:
    roll = np.degrees(np.sqrt(picture.track.shapes[..., ROLL, ROLL]))
    bounds = np.degrees(picture.track.bounds)
    ax.plot(picture.time_s, bounds.mean(axis=0), color=_TRUTH, lw=1.2, label="bound c in force, mean")
    ax.fill_between(
        picture.time_s, bounds.min(axis=0), bounds.max(axis=0), color=_TRUTH, alpha=0.15, lw=0, label="of all runs"
    )
    ax.plot(picture.time_s, roll.mean(axis=0), color=_SET, lw=1.2, label="guaranteed half-width of roll, mean")
    ax.legend(loc="upper right", frameon=False, fontsize=8, ncols=3)
    ax.set(ylabel="roll [°]")
    # The first sets are much wider.
    settled = roll[:, roll.shape[1] // 4 :]
    ax.set_ylim(0.0, 1.4 * max(float(bounds.max()), float(settled.max())))


def _draw_attitude(ax: Axes, picture: RollYawPicture) -> None:
    roll, yaw = np.degrees(picture.states_rad[0]).T
    ax.plot(picture.time_s, yaw, color="#009e73", lw=1.2, label="yaw")
    ax.plot(picture.time_s, roll, color="#cc79a7", lw=1.0, label="roll")
    ax.axhline(0.0, color="grey", lw=0.5)
    ax.legend(loc="upper right", frameon=False, fontsize=8, ncols=2)
    ax.set(ylabel="true attitude [°]")
    ax.set_title("first run: where the satellite points", fontsize=10)
