"""Figures of the camera under the sky of LEDs: one frame, statistics of many frames, and a drive.

:func:`drive_figure` corresponds to figures 8 to 10 of the source.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

from adcs.mockup.vision.camera import Camera, Pose, footprint
from adcs.mockup.vision.paper_matcher import CameraFix
from adcs.stars.identification import NoFix
from magloc.plots import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
from arrays.typing import BoolArray, ByteArray, FloatArray, IntArray

_FOUND = "#009e73"
_NONE = style.ORANGE
_FALSE = "#d55e00"
_PER_SIDE = 12
_BRIGHT_DN = 120


def frame_figure(
    title: str, image: ByteArray, stars_px: FloatArray, fix: CameraFix | NoFix, lights_m: FloatArray, camera: Camera
) -> Figure:
    """Draw a frame with its stars (f, 2), and the ceiling with lights (n, 2) and footprint."""
    figure = style.new_figure(3.4)
    frame, ceiling = figure.subplots(1, 2)
    stars = fix.stars if isinstance(fix, CameraFix) else np.empty((0, 2), dtype=np.intp)
    identified = np.isin(np.arange(len(stars_px)), stars[:, 0])
    # Half of the range shows the faint lights too.
    frame.imshow(image, cmap="gray", vmin=0, vmax=_BRIGHT_DN)
    for rows, colour, mark, name in (
        (identified, _FOUND, "o", "identified"),
        (~identified, _NONE, "s", "not identified"),
    ):
        if rows.any():
            frame.plot(*stars_px[rows].T, mark, color=colour, mfc="none", ms=9.0, mew=1.0, label=name)
    for star, light in stars:
        x, y = stars_px[star]
        inside = x < 0.9 * image.shape[1]
        frame.text(
            x + (12.0 if inside else -12.0), y, str(light), color="white", fontsize=5.5, va="center",
            ha="left" if inside else "right",
        )  # fmt: skip
    frame.set_xlim(-0.5, image.shape[1] - 0.5)
    frame.set_ylim(image.shape[0] - 0.5, -0.5)
    style.label_axes(frame, "column [px]", "row [px]", "frame, with numbers of the lights")
    frame.grid(visible=False)
    ceiling.plot(*lights_m.T, ".", color=style.PALE_GREY, ms=3.0)
    if isinstance(fix, CameraFix):
        ceiling.plot(*lights_m[stars[:, 1]].T, "o", color=_FOUND, ms=4.0)
        draw_footprint(ceiling, camera, fix)
        x, y = 1e3 * fix.position_m
        text = f"ceiling: X {x:.1f} mm, Y {y:.1f} mm,\nheading {np.degrees(fix.heading_rad):.2f}°"
    else:
        text = f"ceiling; no fix: {fix.reason}"
    ceiling.set_aspect("equal")
    style.label_axes(ceiling, "X [m]", "Y [m]", text)
    handles, labels = frame.get_legend_handles_labels()
    if handles:
        style.add_legend(figure, handles=handles, labels=labels, loc="outside lower center", ncols=2)
    style.add_title(figure, title)
    return figure


def draw_footprint(ax: Axes, camera: Camera, fix: CameraFix) -> None:
    """Draw the camera's footprint on the ceiling, its position and its heading."""
    x, y = fix.position_m.tolist()
    pose = Pose(x, y, fix.heading_rad)
    outline = footprint(camera, pose, _PER_SIDE)
    ax.plot(*np.concatenate([outline, outline[:1]]).T, color=style.BLUE, lw=1.0)
    length = 0.22 * camera.footprint_m[0]
    tip = (x + length * math.cos(fix.heading_rad), y + length * math.sin(fix.heading_rad))
    ax.annotate("", tip, (x, y), arrowprops={"arrowstyle": "->", "color": style.BLUE, "lw": 1.3})
    ax.plot(x, y, "o", color=style.BLUE, ms=4.0)


@dataclass(frozen=True, eq=False)
class SkyPicture:
    """Outcomes of many frames.

    ``good``, ``false`` (p,): whether a frame gave a fix near the truth, or another fix.
    """

    title: str
    lights_m: FloatArray  # (n, 2)
    places_m: FloatArray  # (p, 2): true positions of the camera
    errors_mm: FloatArray  # (p,): NaN without a fix
    good: BoolArray
    false: BoolArray
    n_stars: IntArray  # (p,): stars found in the frame


def sky_figure(picture: SkyPicture) -> Figure:
    """Draw the places of the fixes, their errors, and their outcomes by the number of stars."""
    figure = style.new_figure(3.7)
    panels = figure.subplot_mosaic([["map", "errors"], ["map", "stars"]], width_ratios=[1.35, 1.0])
    _draw_outcomes(panels["map"], picture)
    _draw_error_distribution(panels["errors"], picture)
    _draw_star_counts(panels["stars"], picture)
    style.add_title(figure, picture.title)
    return figure


def _draw_outcomes(ax: Axes, picture: SkyPicture) -> None:
    ax.plot(*picture.lights_m.T, ".", color=style.PALE_GREY, ms=2.5, label="lights")
    groups = (
        ("good fix", picture.good, _FOUND, "o", 3.5),
        ("no fix", ~(picture.good | picture.false), _NONE, "s", 4.5),
        ("false fix", picture.false, _FALSE, "X", 7.0),
    )
    for name, rows, colour, mark, size in groups:
        if rows.any():
            ax.plot(*picture.places_m[rows].T, mark, color=colour, ms=size, mew=0.3, label=f"{name}: {rows.sum()}")
    ax.set_aspect("equal")
    style.label_axes(ax, "X [m]", "Y [m]", "places of the camera")
    style.add_legend(ax, loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=4, columnspacing=1.0, handletextpad=0.3)


def _draw_error_distribution(ax: Axes, picture: SkyPicture) -> None:
    errors = np.sort(picture.errors_mm[picture.good])
    n = len(picture.good)
    if errors.size:
        share = 100.0 * np.arange(1, errors.size + 1) / n
        ax.step(errors, share, where="post", color=style.BLUE, lw=1.2)
        ax.set_xscale("log")
        ax.xaxis.set_major_locator(LogLocator(10.0, (1.0, 2.0, 5.0), numticks=9))
        ax.xaxis.set_minor_formatter(NullFormatter())
        ax.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
        rms = float(np.sqrt(np.mean(errors**2)))
        ax.axvline(rms, color=style.BLACK, lw=0.7, ls="--", label=f"rms {rms:.2g} mm")
    ax.set_ylim(0.0, 104.0)
    style.label_axes(ax, "error of position [mm]", "frames below [%]", "good fixes")
    style.add_legend(ax)


def _draw_star_counts(ax: Axes, picture: SkyPicture) -> None:
    counts = np.arange(picture.n_stars.min(), picture.n_stars.max() + 1)
    below = np.zeros(len(counts))
    groups = (
        ("good", picture.good, _FOUND),
        ("none", ~(picture.good | picture.false), _NONE),
        ("false", picture.false, _FALSE),
    )
    for name, rows, colour in groups:
        numbers = np.array([np.sum(rows & (picture.n_stars == count)) for count in counts], dtype=np.float64)
        if numbers.any():
            ax.bar(counts, numbers, bottom=below, width=0.85, color=colour, label=name)
        below += numbers
    ax.yaxis.set_major_locator(MaxNLocator(5, integer=True))
    ax.xaxis.set_major_locator(MaxNLocator(8, integer=True))
    style.label_axes(ax, "stars found in the frame", "frames", "fixes by stars")
    style.add_legend(ax)


def drive_figure(
    title: str,
    lights_m: FloatArray,
    truth_m: FloatArray,
    fixes_m: FloatArray,
    rest_s: FloatArray,
    rest_m: FloatArray,
    rest_truth_m: FloatArray,
) -> Figure:
    """Draw the fixes of a drive along the perimeter, and X and Y at rest.

    ``truth_m``, ``fixes_m`` (p, 2): true and fixed positions of the frames of the drive, NaN without a fix. ``rest_s``
    (r,), ``rest_m`` (r, 2), ``rest_truth_m`` (2,): times, fixes and true position at rest.
    """
    figure = style.new_figure(3.7)
    panels = figure.subplot_mosaic([["path", "X"], ["path", "Y"]], width_ratios=[1.35, 1.0])
    path = panels["path"]
    has_fix = np.isfinite(fixes_m).all(axis=1)
    path.plot(*lights_m.T, ".", color=style.LIGHT_GREY, ms=2.5, label="lights", zorder=1.5)
    style.draw_truth(path, *truth_m.T)
    path.plot(*fixes_m[has_fix].T, ".", color=style.BLUE, ms=4.0, label="fixes")
    if not has_fix.all():
        path.plot(*truth_m[~has_fix].T, "s", color=_NONE, ms=4.5, mfc="none", label=f"no fix: {int((~has_fix).sum())}")
    path.set_aspect("equal")
    path.locator_params(axis="x", nbins=5)
    distance_mm = 1e3 * np.linalg.norm((fixes_m - truth_m)[has_fix], axis=1)
    text = f": {np.sqrt(np.mean(distance_mm**2)):.2g} mm rms" if distance_mm.size else ""
    style.label_axes(path, "X [m]", "Y [m]", f"perimeter drive{text}")
    style.add_legend(
        path, loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=4, columnspacing=1.0, handletextpad=0.5
    )
    for column, name in enumerate("XY"):
        ax = panels[name]
        error_mm = 1e3 * (rest_m[:, column] - rest_truth_m[column])
        known = np.isfinite(error_mm)
        ax.plot(rest_s[known], error_mm[known], ".-", color=style.BLUE, lw=0.6, ms=3.0)
        ax.axhline(0.0, color=style.TRUTH, lw=0.7, ls="--")
        spread = f": σ {np.std(error_mm[known]):.2g} mm" if known.any() else ""
        middle = f"{rest_truth_m[column]:.4f} m"
        style.label_axes(
            ax, "time [s]" if name == "Y" else "", f"{name} less\n{middle} [mm]", f"{name} at rest{spread}"
        )
    style.add_title(figure, title)
    return figure
