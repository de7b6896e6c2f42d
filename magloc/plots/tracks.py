"""Figures of tracks: paths with uncertainties, and the consistency of the covariance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from arrays.io.outputs import write_files
from arrays.typing import FloatArray, IntArray
from magloc.chi_square import square_columns
from magloc.plots import style
from magloc.tracking.files import columns_of_track, states_of
from magloc.tracking.results import TrackPoint, TrackResult, on_track, track_column

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

    from magloc.bodies.poses import BodyPoses


def write_track_figures(
    points: Sequence[TrackPoint],
    truth_m: FloatArray | None,
    folder: Path,
    *,
    nees: tuple[FloatArray, IntArray] | None = None,
    bound_m: FloatArray | None = None,
    array_m: FloatArray | None = None,
) -> None:
    """Write track.png and consistency.png of one source, and track.csv with their data.

    ``truth_m`` (n, 3): true positions [m], NaN where unknown. ``folder``: it is created if necessary. ``nees`` (n,):
    normalised estimation error squared of every row, and its degrees of freedom. ``bound_m`` (n,): posterior Cramér-Rao
    bound of the distance from the truth [m]. ``array_m`` (n, 3): origin of the array's frame in every row [m]. Raises
    InputError if the folder cannot be written.
    """
    columns = columns_of_track(points, array_m)
    status = columns.pop("status")
    if truth_m is not None:
        columns |= style.truth_columns(truth_m)
    if nees is not None:
        columns |= square_columns("nees", *nees)
    if bound_m is not None:
        columns["bound_m"] = bound_m
    figures = {
        "track.png": track_figure(points, truth_m, array_m),
        "consistency.png": consistency_figure(points, truth_m, nees, bound_m),
    }
    write_files(folder, [*figures.items(), ("track.csv", columns | {"status": status})])


# Least and largest height of the plan, and its width [in].
_PLAN_IN = (1.2, 3.4, 6.2)
# Least ratio of the plan's sides.
_NARROWEST = 0.2
# Least span of a coordinate's axis relative to the plan's width: a source at rest must not get ticks of 1 µm.
_LEAST_HEIGHT = 0.01
# Okabe and Ito, for colour-blind readers; the first colour is for estimates.
_SOURCE_COLOURS = (style.ESTIMATE, style.ORANGE, style.GREEN, style.PURPLE, style.SKY_BLUE)


def track_figure(
    points: Sequence[TrackPoint], truth_m: FloatArray | None = None, array_m: FloatArray | None = None
) -> Figure:
    """Draw a track from above with 95 % ellipses, and its state over time with 95 % bands.

    Parameters
    ----------
    points : sequence of TrackPoint
        Points of all rows, as `points` of a :class:`magloc.Track`.
    truth_m : ndarray, shape (n, 3), optional
        True positions [m], NaN where unknown.
    array_m : ndarray, shape (n, 3), optional
        Origin of the array's frame in every row [m]; by default the array is at the origin.

    Returns
    -------
    matplotlib.figure.Figure
        Figure; :func:`save` writes it to a file.

    Examples
    --------
    >>> import magloc
    >>> diver = magloc.datasets.load("diver")
    >>> track = magloc.track(diver.array, diver.readings[90:])
    >>> figure = magloc.plots.track(track.points, diver.truth.position_m[90:])
    """
    return _tracks_figure({"track": points}, truth_m, array_m)


def sources_figure(result: TrackResult, array_m: FloatArray | None = None) -> Figure:
    """Draw tracks of several sources from above, and their coordinates and moments over time.

    Parameters
    ----------
    result : TrackResult
        A result of :attr:`magloc.SourcesTrack.as_result`, or one read from a file.
    array_m : ndarray, shape (n, 3), optional
        Origin of the array's frame in every row [m]; by default the array is at the origin.

    Returns
    -------
    matplotlib.figure.Figure
        Figure; :func:`save` writes it to a file.

    Examples
    --------
    >>> import magloc
    >>> board = magloc.datasets.load("board")
    >>> track = magloc.track_sources(board.array, board.readings[:20], sources=1)
    >>> figure = magloc.plots.source_tracks(track.as_result)
    """
    names = [f"source {id}" for id in result.ids] or ["track"]
    return _tracks_figure(dict(zip(names, result.tracks, strict=True)), None, array_m)


def _tracks_figure(
    tracks: Mapping[str, Sequence[TrackPoint]], truth_m: FloatArray | None, array_m: FloatArray | None
) -> Figure:
    """Draw tracks by the names of their sources; the truth has a single source."""
    tracks = {name: on_track(points) for name, points in tracks.items()}
    columns = {name: states_of(points) for name, points in tracks.items()}
    tracked = np.any([np.isfinite(position[:, 0]) for _, position, _, _ in columns.values()], axis=0)
    origin_m = np.zeros((1, 3)) if array_m is None else array_m
    extent = [position for _, position, _, _ in columns.values()] + ([] if truth_m is None else [truth_m])
    across, up = (style.axis_limits([part[:, i] for part in extent], [origin_m[:, i]]) for i in (0, 1))
    widest = max(across[1] - across[0], up[1] - up[0])
    across, up = (_widen(_NARROWEST * widest, *limits) for limits in (across, up))
    unit, per_m = style.axis_unit(widest)
    plan_in = min(max(_PLAN_IN[2] * (up[1] - up[0]) / (across[1] - across[0]), _PLAN_IN[0]), _PLAN_IN[1])
    figure = style.new_figure(plan_in + 4.2)
    grid = figure.add_gridspec(3, 2, height_ratios=[plan_in + 0.5, 1.4, 1.4])
    plan = figure.add_subplot(grid[0, :])
    _draw_plan(plan, tracks, truth_m, origin_m, unit, per_m)
    plan.set_xlim(per_m * across[0], per_m * across[1])
    plan.set_ylim(per_m * up[0], per_m * up[1])
    first: Axes | None = None
    for i, name in enumerate("xyz"):
        ax = figure.add_subplot(grid[1 + i // 2, i % 2], sharex=first)
        first = ax if first is None else first
        for source, (time, position, _, covariance) in columns.items():
            sigma = np.sqrt(covariance[:, i, i])
            _draw_band(ax, time, per_m * position[:, i], per_m * sigma, source, _source_colour(columns, source))
        style.shade_gaps(ax, time, tracked, "not tracked")
        if truth_m is not None:
            ax.plot(time, per_m * truth_m[:, i], color=style.TRUTH, lw=0.8, ls="--", label="truth")
        low, high = style.axis_limits([part[:, i] for part in extent], margin=0.15)
        ax.set_ylim(*(per_m * end for end in _widen(_LEAST_HEIGHT * widest, low, high)))
        style.label_axes(ax, "time [s]", f"{name} [{unit}]")
    strength = figure.add_subplot(grid[2, 1], sharex=first)
    ends: list[FloatArray] = []
    for source, (time, _, moment, covariance) in columns.items():
        modulus = np.linalg.norm(moment, axis=1)
        along = moment / np.where(modulus > 0.0, modulus, np.nan)[:, None]
        spread = np.sqrt(np.einsum("ni,nij,nj->n", along, covariance[:, 3:, 3:], along))
        _draw_band(strength, time, modulus, spread, source, _source_colour(columns, source))
        ends += [modulus - style.SIGMAS_95 * spread, modulus + style.SIGMAS_95 * spread]
    style.shade_gaps(strength, time, tracked, "not tracked")
    strength.set_ylim(style.axis_limits(ends, share=0.95))
    style.label_axes(strength, "time [s]", "moment [A·m²]")
    entries: dict[str, Artist] = {}
    for ax in (plan, strength if first is None else first):
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    style.add_legend(
        figure,
        handles=entries.values(),
        labels=entries.keys(),
        loc="outside upper center",
        ncols=8,
        columnspacing=1.2,
        handletextpad=0.5,
    )
    return figure


def consistency_figure(
    points: Sequence[TrackPoint],
    truth_m: FloatArray | None = None,
    nees: tuple[FloatArray, IntArray] | None = None,
    bound_m: FloatArray | None = None,
) -> Figure:
    """Draw the consistency of a track: errors, NEES, NIS and the estimability of the state.

    Parameters
    ----------
    points : sequence of TrackPoint
        Points of all rows, as `points` of a :class:`magloc.Track`.
    truth_m : ndarray, shape (n, 3), optional
        True positions [m], NaN where unknown; errors and NEES need them.
    nees : tuple of ndarray, shape (n,), optional
        Normalised estimation error squared of every row and its degrees of freedom.
    bound_m : ndarray, shape (n,), optional
        Posterior Cramér-Rao bound of the distance from the truth [m].

    Returns
    -------
    matplotlib.figure.Figure
        Figure; :func:`save` writes it to a file.

    Examples
    --------
    >>> import magloc
    >>> diver = magloc.datasets.load("diver")
    >>> track = magloc.track(diver.array, diver.readings[90:])
    >>> figure = magloc.plots.consistency(track.points)
    """
    time, position, _, covariance = states_of(points)
    n_panels = 5 if truth_m is not None and nees is not None else 3
    figure = style.new_figure(1.35 * n_panels + 0.3)
    axes = list(figure.subplots(n_panels, 1, sharex=True))
    if truth_m is not None and nees is not None:
        _draw_errors(axes[0], time, position - truth_m, covariance, bound_m)
        style.draw_chi_square(axes[1], time, *nees, "NEES")
    tracked = np.array([point.is_on_track for point in points])
    nis = np.array([point.nis for point in points])
    nis_dof = np.array([point.nis_dof for point in points])
    style.draw_chi_square(axes[-3], time, nis, nis_dof, "NIS")
    estimability = track_column(points, "estimability", 6)
    for ax, first, what in ((axes[-2], 0, "position"), (axes[-1], 3, "moment")):
        for i, (name, colour, _, line) in enumerate(style.COMPONENTS):
            label = name if first == 0 else f"m{name}"
            ax.plot(time, estimability[:, first + i], color=colour, ls=line, lw=1.0, label=label)
        ax.set_ylim(-0.03, 1.03)
        style.label_axes(ax, "time [s]", f"estimability\nof the {what} [1]")
        style.add_legend(ax)
    axes[-2].set_title("what the readings taught: 1 - σ / σ without any of them", fontsize=style.FONT_SIZE, loc="left")
    for ax in axes:
        style.shade_gaps(ax, time, tracked, "not tracked")
        if ax is not axes[-1]:
            ax.set_xlabel("")
    return figure


def plot_poses(poses: BodyPoses) -> Figure:
    """Draw position and rotation vector of a body over time, with their 95 % bands."""
    figure = style.new_figure(5.2)
    upper, lower = figure.subplots(2, 1, sharex=True)
    sigma = np.sqrt(np.diagonal(poses.covariance[:, 0], axis1=1, axis2=2))
    turn = np.where(poses.solved[:, None], poses.rotation.as_rotvec(), np.nan)
    for i, (axis, colour, *_) in enumerate(style.COMPONENTS):
        _draw_band(upper, poses.time_s, 1e3 * poses.position_m[:, 0, i], 1e3 * sigma[:, i], axis, colour)
        _draw_band(lower, poses.time_s, np.degrees(turn[:, i]), np.degrees(sigma[:, 3 + i]), axis, colour)
    for ax, name in ((upper, "position [mm]"), (lower, "rotation vector [°]")):
        style.shade_gaps(ax, poses.time_s, poses.solved, "no pose")
        style.label_axes(ax, "time [s]", name)
    handles, labels = upper.get_legend_handles_labels()
    entries = dict(zip(labels, handles, strict=True))
    figure.legend(entries.values(), entries.keys(), loc="outside upper center", ncols=len(entries))
    return figure


def _widen(width: float, low: float, high: float) -> tuple[float, float]:
    """Return limits that are at least this wide, with the same centre."""
    missing = max(0.0, width - (high - low))
    return low - 0.5 * missing, high + 0.5 * missing


def _draw_plan(
    ax: Axes,
    tracks: Mapping[str, Sequence[TrackPoint]],
    truth_m: FloatArray | None,
    origin_m: FloatArray,
    unit: str,
    per_m: float,
) -> None:
    """Draw the tracks and the array from above."""
    if truth_m is not None:
        style.draw_truth(ax, per_m * truth_m[:, 0], per_m * truth_m[:, 1])
    edges = {} if len(tracks) == 1 else {source: {"edgecolor": _source_colour(tracks, source)} for source in tracks}
    for source, points in tracks.items():
        _, position, _, covariance = states_of(points)
        shown = per_m * position
        ax.plot(shown[:, 0], shown[:, 1], color=_source_colour(tracks, source), lw=1.2, label=source, zorder=2.2)
        for i in style.thin(np.flatnonzero(np.isfinite(position[:, 0]))):
            edge = edges.get(source, {})
            ax.add_patch(style.ellipse95(shown[i, :2], per_m**2 * covariance[i, :2, :2], label="95 % ellipses", **edge))
        starts = [i for i, point in enumerate(points) if point.status == "acquired"]
        if starts:
            ax.plot(shown[starts, 0], shown[starts, 1], "o", ms=4.5, mfc="none", mec=style.BLACK, label="track begins")
    origin = per_m * origin_m
    if len(origin) > 1:
        ax.plot(origin[:, 0], origin[:, 1], color=style.GREY, lw=1.0, ls="-.", label="path of the array")
    ax.plot(origin[-1, 0], origin[-1, 1], "^", color="white", mec=style.BLACK, ms=6, ls="none", label="array")
    ax.set_aspect("equal", adjustable="box")
    style.label_axes(ax, f"x [{unit}]", f"y [{unit}]", "from above")


def _draw_band(ax: Axes, time: FloatArray, value: FloatArray, sigma: FloatArray, name: str, colour: str) -> None:
    """Draw a quantity over time with its 95 % band."""
    low, high = value - style.SIGMAS_95 * sigma, value + style.SIGMAS_95 * sigma
    ax.fill_between(time, low, high, color=colour, alpha=0.25, lw=0.0, label="95 % band")
    ax.plot(time, value, color=colour, lw=1.0, label=name)


def _source_colour(tracks: Mapping[str, object], source: str) -> str:
    """Return the colour of a source."""
    return _SOURCE_COLOURS[list(tracks).index(source) % len(_SOURCE_COLOURS)]


def _draw_errors(
    ax: Axes, time: FloatArray, error_m: FloatArray, covariance: FloatArray, bound_m: FloatArray | None
) -> None:
    """Draw the distance from the truth, in its known coordinates, and its standard deviation."""
    known = np.isfinite(error_m)
    distance = np.sqrt(np.where(known, error_m**2, 0.0).sum(axis=1))
    distance[~known.any(axis=1)] = np.nan
    variances = np.diagonal(covariance, axis1=1, axis2=2)[:, :3]
    expected = np.sqrt(np.where(known, variances, 0.0).sum(axis=1))
    expected[~known.any(axis=1)] = np.nan
    style.set_log_scale(ax, [distance, expected])
    ax.plot(time, distance, ".", color=style.ESTIMATE, ms=3, label="error")
    ax.plot(time, expected, color=style.ORANGE, lw=1.2, label="σ that the track states")
    if bound_m is not None:
        possible = np.where(np.isfinite(bound_m), bound_m, np.nan)
        ax.plot(time, possible, color=style.BLACK, ls="--", lw=0.9, label="posterior Cramér-Rao bound")
    style.label_axes(ax, "time [s]", "distance from\nthe truth [m]", "error")
    style.add_legend(ax)
