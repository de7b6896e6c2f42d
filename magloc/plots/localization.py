"""Figures of the fixes of rows: positions with uncertainties, χ², and residuals of every sensor."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from arrays.array import SensorArray
from arrays.io.outputs import write_files
from magloc.localization.fit.export import FixColumns, columns_of_fixes, distances_from_truth, fix_columns
from magloc.localization.fit.fixes import Fixes
from magloc.localization.residuals import fix_residuals
from magloc.plots import style
from magloc.readings import Readings

if TYPE_CHECKING:
    from matplotlib.axes import Axes
from arrays.typing import FloatArray


def fixes(
    fixes: Fixes, array: SensorArray | None = None, readings: Readings | None = None, truth_m: FloatArray | None = None
) -> Figure:
    """Draw fixes in three planes with 95 % ellipses, their standard deviations and their χ².

    A fix with an unobservable range has a line instead of an ellipse: the 95 % interval of its range from the array. An
    open interval ends in an arrow. The line needs the array.

    Parameters
    ----------
    fixes : Fixes
        Result of :func:`magloc.locate`.
    array : SensorArray, optional
        Array of the fixes.
    readings : Readings, optional
        Readings of the fixes, for the poses of a moving array.
    truth_m : ndarray, shape (n, 3), optional
        True positions in the frame of the fixes [m], NaN where unknown.

    Returns
    -------
    matplotlib.figure.Figure
        Figure; :func:`save` writes it to a file.

    Examples
    --------
    >>> import magloc
    >>> board = magloc.datasets.load("board")
    >>> fixes = magloc.locate(board.array, board.readings[:10])
    >>> figure = magloc.plots.fixes(fixes, board.array)
    """
    sensors_m = np.zeros((len(fixes), 0, 3)) if array is None else _sensor_positions(fixes, array, readings)
    return fix_figure(fix_columns(fixes), sensors_m, truth_m)


def residuals(array: SensorArray, readings: Readings, fixes: Fixes, *, ambient_T: FloatArray | None = None) -> Figure:
    """Draw the residuals of every channel in standard deviations of its noise.

    Thick bars contain half of the rows, thin bars nine tenths. Pure noise has nine tenths of its values in the grey
    band.

    Parameters
    ----------
    array : SensorArray
        Array of the readings, with the noise of its sensors.
    readings : Readings
        Readings of the fixes.
    fixes : Fixes
        Fixes in the frame of the array or of the world.
    ambient_T : ndarray, shape (n, 3), optional
        Ambient field of every row in the array's frame [T]; by default that of the array.

    Returns
    -------
    matplotlib.figure.Figure
        Figure; :func:`save` writes it to a file.

    Examples
    --------
    >>> import magloc
    >>> board = magloc.datasets.load("board")
    >>> fixes = magloc.locate(board.array, board.readings[:10])
    >>> figure = magloc.plots.residuals(board.array, board.readings[:10], fixes)
    """
    sigmas = _residual_sigmas(array, readings, fixes, ambient_T)
    return residual_figure(sigmas, array.channel_names, array.ids, array.channel_sensor)


def write_fix_figures(
    rows: Readings,
    array: SensorArray,
    fixes: Fixes,
    ambient_T: FloatArray | None,
    truth_m: FloatArray | None,
    folder: Path,
) -> None:
    """Write fixes.png and residuals.png, and their data as fixes.csv and residuals.csv."""
    sigmas = _residual_sigmas(array, rows, fixes, ambient_T)
    names = (f"{name}_residual_sigmas" for name in array.channel_names)
    files = {
        "fixes.png": fix_figure(fix_columns(fixes), _sensor_positions(fixes, array, rows), truth_m),
        "fixes.csv": columns_of_fixes(fixes, truth_m),
        "residuals.png": residual_figure(sigmas, array.channel_names, array.ids, array.channel_sensor),
        "residuals.csv": {"time_s": rows.time_s, **dict(zip(names, sigmas.T, strict=True))},
    }
    write_files(folder, files.items())


def _residual_sigmas(array: SensorArray, rows: Readings, fixes: Fixes, ambient_T: FloatArray | None) -> FloatArray:
    """Return the residuals (n, C) of fixes in either frame, in standard deviations of the noise."""
    if fixes.frame == "world" and rows.pose is not None:
        back = rows.pose[1].inv()
        fixes = fixes.moved(-back.apply(rows.pose[0]), back, frame="array")
    return fix_residuals(array, rows.values_T, fixes, ambient_T)


def _sensor_positions(fixes: Fixes, array: SensorArray, rows: Readings | None) -> FloatArray:
    """Return the positions of the sensors in every row (n, N, 3), in the frame of the fixes [m]."""
    pose = None if rows is None else rows.pose
    if pose is None:
        return np.broadcast_to(array.positions, (len(fixes), *array.positions.shape))
    return np.einsum("nab,sb->nsa", pose[1].as_matrix(), array.positions) + pose[0][:, None]


_PLANES = ((0, 1), (0, 2), (1, 2))
# End of an open interval of the range, relative to the range of the fix.
_OPEN = 3.0
# Quantiles of the bars, and the outer one of a standard normal distribution.
_HALF, _MOST = (0.25, 0.75), (0.05, 0.95)
_MOST_OF_NOISE = 1.6448536269514722


def fix_figure(columns: FixColumns, sensors_m: FloatArray, truth_m: FloatArray | None = None) -> Figure:
    """Draw the columns of fixes with sensors (n, N, 3) and truth (n, 3) in their frame [m]."""
    parts = [columns.position_m] + ([] if truth_m is None else [truth_m])
    limits = [style.axis_limits([part[:, i] for part in parts], [sensors_m[..., i]]) for i in range(3)]
    half_m = 0.5 * max(high - low for low, high in limits)
    unit, per_m = style.axis_unit(2.0 * half_m)
    figure = style.new_figure(6.2)
    grid = figure.add_gridspec(3, 3, height_ratios=[1.75, 1.0, 1.0])
    for k, plane in enumerate(_PLANES):
        ax = figure.add_subplot(grid[0, k])
        _draw_plane(ax, columns, sensors_m, truth_m, plane, per_m)
        # All three planes have the same scale.
        across, up = (0.5 * per_m * sum(limits[i]) for i in plane)
        ax.set_xlim(across - per_m * half_m, across + per_m * half_m)
        ax.set_ylim(up - per_m * half_m, up + per_m * half_m)
        ax.set_aspect("equal", adjustable="box")
        style.label_axes(ax, f"{'xyz'[plane[0]]} [{unit}]", f"{'xyz'[plane[1]]} [{unit}]")
        if k == 0:
            style.add_legend(figure, handles=ax.get_legend_handles_labels()[0], loc="outside upper center", ncols=6)
    spread = figure.add_subplot(grid[1, :])
    if (columns.covariance[:, :3, :3] > 0.0).any():
        _draw_certainty(spread, columns, truth_m)
    else:
        _draw_moments(spread, columns)
    squares = figure.add_subplot(grid[2, :], sharex=spread)
    one = columns.first
    style.draw_chi_square(squares, columns.time_s[one], columns.chi2[one], columns.dof[one], "χ²")
    spread.tick_params(labelbottom=False)
    return figure


def residual_figure(
    residuals: FloatArray, channel_names: Sequence[str], sensor_ids: Sequence[str], channel_sensor: NDArray[np.int64]
) -> Figure:
    """Draw the residuals (n, C) of every channel, NaN where a reading is missing or not used."""
    few = len(sensor_ids) <= style.FEW_SENSORS
    figure = style.new_figure(3.0)
    ax = figure.subplots()
    ax.axhspan(-_MOST_OF_NOISE, _MOST_OF_NOISE, color=style.LIGHT_GREY, lw=0.0, label="nine tenths of the stated noise")
    ax.axhline(0.0, color=style.GREY, lw=0.6)
    labelled: set[str] = set()
    bars = [np.array([-2.0, 2.0])]
    for c, name in enumerate(channel_names):
        sensor = int(channel_sensor[c])
        channels = np.flatnonzero(channel_sensor == sensor)
        k = int(np.flatnonzero(channels == c)[0])
        component, colour, marker, _ = style.COMPONENTS[k]
        label = "modulus" if len(channels) == 1 else component
        place = sensor + 0.26 * (k - 0.5 * (len(channels) - 1))
        values = residuals[np.isfinite(residuals[:, c]), c]
        if not values.size:
            continue
        half, most = np.quantile(values, _HALF), np.quantile(values, _MOST)
        bars.append(most)
        ax.vlines(place, *most, color=colour, lw=0.7, gid=f"{name} most")
        ax.vlines(place, *half, color=colour, lw=3.0 if few else 1.8, gid=f"{name} half")
        ax.plot(
            place, float(np.median(values)), marker, color="white", mec=colour, mew=0.7, ms=4 if few else 2.4,
            ls="none", label="_" if label in labelled else label,
        )  # fmt: skip
        labelled.add(label)
    ax.set_ylim(style.axis_limits(bars[1:], bars[:1]))
    style.label_axes(ax, "sensor", "residual / σ of the noise [1]", "half and nine tenths of the rows")
    style.label_sensors(ax, sensor_ids)
    ax.grid(visible=False, axis="x")
    style.add_legend(ax)
    return figure


def _draw_plane(
    ax: Axes,
    columns: FixColumns,
    sensors_m: FloatArray,
    truth_m: FloatArray | None,
    plane: tuple[int, int],
    per_m: float,
) -> None:
    """Draw fixes, sensors and truth as seen along one axis."""
    a, b = plane
    position, sensors = per_m * columns.position_m, per_m * sensors_m
    solved = np.flatnonzero(np.isfinite(position[:, 0]))
    size = style.marker_size(len(solved))
    known = columns.range_observable & (columns.covariance[:, 0, 0] > 0.0)
    label = "95 % ellipses"
    for k in style.thin(solved[known[solved]]):
        block = per_m**2 * columns.covariance[k][np.ix_(plane, plane)]
        ax.add_patch(style.ellipse95(position[k, [a, b]], block, label=label))
        label = "_"
    label = "95 % of the range"
    unknown = ~columns.range_observable[solved] & np.isfinite(columns.range95_m[solved, 0]) & bool(sensors.size)
    for k in style.thin(solved[unknown]):
        centroid = sensors[columns.row[k]].mean(axis=0)
        offset = position[k] - centroid
        distance = float(np.linalg.norm(offset))
        low, high = per_m * columns.range95_m[k]
        ends = [centroid + offset * (end / distance) for end in (low, min(high, _OPEN * distance))]
        line = np.array(ends)[:, [a, b]]
        ax.plot(line[:, 0], line[:, 1], color=style.ORANGE, lw=0.7, zorder=1.8, label=label)
        label = "_"
        if high > _OPEN * distance:
            ax.annotate(
                "", xy=tuple(line[1]), xytext=tuple(line[0]),
                arrowprops={"arrowstyle": "->", "color": style.ORANGE, "lw": 0.7, "mutation_scale": 6},
            )  # fmt: skip
    if truth_m is not None:
        style.draw_truth(ax, per_m * truth_m[:, a], per_m * truth_m[:, b])
    ax.plot(position[solved, a], position[solved, b], ".", color=style.ESTIMATE, ms=size, label="fixes", zorder=2.2)
    if not sensors.size:
        return
    if np.ptp(sensors.mean(axis=1), axis=0).max() > 0.0:
        ax.plot(*sensors.mean(axis=1)[:, [a, b]].T, color=style.GREY, lw=1.0, ls="-.", label="path of the array")
    ax.plot(*sensors[-1][:, [a, b]].T, "^", color="white", mec=style.BLACK, ms=4, mew=0.6, label="sensors", zorder=2.6)


def _draw_certainty(ax: Axes, columns: FixColumns, truth_m: FloatArray | None) -> None:
    """Draw the standard deviation of every source's position, and its distance from the truth."""
    sigma_m = np.sqrt(np.trace(columns.covariance[:, :3, :3], axis1=1, axis2=2))
    error_m = np.full_like(sigma_m, np.nan) if truth_m is None else distances_from_truth(columns, truth_m)
    both = np.concatenate([sigma_m, error_m])
    unit, per_m = style.axis_unit(float(np.max(both[np.isfinite(both)], initial=0.0)) or 1.0)
    sigma, error = per_m * sigma_m, per_m * error_m
    style.set_log_scale(ax, [sigma, error])
    style.label_axes(ax, "", f"distance [{unit}]", "certainty" if truth_m is None else "error and certainty")
    size = style.marker_size(len(sigma))
    if truth_m is not None:
        ax.plot(columns.time_s, error, ".", color=style.ESTIMATE, ms=size, label="error")
    positive, observable = sigma > 0.0, columns.range_observable
    for rows, mark, colour, label in (
        (positive & observable, "_", style.ORANGE, "σ (Cramér-Rao bound at the fix)"),
        (positive & ~observable, "x", style.BLACK, "σ where the range is unknown"),
    ):
        if rows.any():
            ax.plot(columns.time_s[rows], sigma[rows], mark, color=colour, ms=size, mew=1.0, label=label)
    style.add_legend(ax)


def _draw_moments(ax: Axes, columns: FixColumns) -> None:
    """Draw the moments of sources at a known position, with 95 % intervals."""
    modulus = np.linalg.norm(columns.moment_Am2, axis=1)
    along = columns.moment_Am2 / np.where(modulus > 0.0, modulus, np.nan)[:, None]
    sigma = np.sqrt(np.einsum("ki,kij,kj->k", along, columns.covariance[:, 3:, 3:], along))
    ax.errorbar(
        columns.time_s, modulus, style.SIGMAS_95 * sigma, fmt=".", ms=style.marker_size(len(sigma)),
        color=style.ESTIMATE, ecolor=style.ORANGE, elinewidth=0.8, label="moment, 95 % intervals",
    )  # fmt: skip
    style.label_axes(ax, "", "moment [A·m²]", "the moment of a source whose place is known")
    style.add_legend(ax)
