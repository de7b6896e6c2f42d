"""A survey in a scene: rows coloured by their anomaly, and below the ground its targets with their ellipsoids."""

from __future__ import annotations

from html import escape

import numpy as np
import viser
from matplotlib import colormaps
from matplotlib.colors import SymLogNorm

from arrays.typing import ByteArray, FloatArray
from magloc.surveying.results import Survey, Target, linear_and_most
from magloc.viewer.pages import words
from magloc.viewer.scene.glyphs import (
    DIPOLE_COLOUR,
    REGION_COLOUR,
    DipoleGlyph,
    dots,
    length_text,
    screen_label,
    screen_lines,
    solid,
)
from magloc.viewer.scene.legend import ColourScale, Entry, Swatch
from magloc.viewer.scene.shapes import Surface, ellipsoid, joined, line_segments, unit_circle

_SCALE = colormaps["RdBu_r"]
_GROUND_COLOUR = (150, 120, 90)
_SHADES = 9


def add_survey(server: viser.ViserServer, found: Survey) -> tuple[list[Entry], FloatArray]:
    """Rows, ground and targets in a scene; lines of the legend, and points (k, 3) that should be in view."""
    scene = server.scene
    rows = found.rows.decimate()
    places, anomaly_nT = rows.place_m, 1e9 * rows.anomaly_T
    linear, most = linear_and_most(anomaly_nT)
    low, high = places.min(axis=0), places.max(axis=0)
    size = 0.04 * float(np.linalg.norm(high - low))
    dots(scene, "/rows", places, _colours(SymLogNorm(linear, vmin=-most, vmax=most)(anomaly_nT)), 0.12 * size)
    corners = np.array([[x, y, found.ground_m] for x in (low[0], high[0]) for y in (low[1], high[1])])
    ground = Surface(corners.astype(np.float32), np.array([[0, 2, 1], [1, 2, 3]], dtype=np.uint32))
    solid(scene, "/ground", ground, _GROUND_COLOUR, flat=True, opacity=0.3)
    scale = tuple((int(r), int(g), int(b)) for r, g, b in _colours(np.linspace(0.0, 1.0, _SHADES)))
    entries: list[Entry] = [
        ColourScale(
            f"anomaly, linear up to {linear:.2g} nT, then logarithmic",
            f"{-most:.3g} nT",
            f"{most:.3g} nT",
            scale,
        ),
        Swatch(_GROUND_COLOUR, "ground"),
    ]
    if len(found):
        for target in found:
            DipoleGlyph(scene, f"/{target.id}", size).show(target.position_m, target.moment_Am2)
            above = np.array([*target.position_m[:2], found.ground_m])
            screen_label(scene, f"/{target.id}-text", f"{target.id}: {target.depth_m:.2f} m", above, "bottom-center")
        ends = np.stack([found.position_m, found.position_m * [1.0, 1.0, 0.0] + [0.0, 0.0, found.ground_m]], axis=1)
        screen_lines(scene, "/depths", ends, DIPOLE_COLOUR, 1.0)
        regions = joined(ellipsoid(target.position_m, target.covariance[:3, :3]) for target in found)
        solid(scene, "/ellipsoids", regions, REGION_COLOUR, opacity=0.4)
        entries.append(
            Swatch(DIPOLE_COLOUR, f"{len(found)} targets: arrows along the moments, and depths below the ground")
        )
        entries.append(Swatch(REGION_COLOUR, "95 % ellipsoids of their positions"))
        _add_targets(server, found, size)
    return entries, np.vstack([places, corners, found.position_m])


def _add_targets(server: viser.ViserServer, found: Survey, size_m: float) -> None:
    """A choice of the target, which gets a ring on the ground, and what is known of it."""
    gui, of_id = server.gui, {target.id: target for target in found}
    ring = screen_lines(server.scene, "/chosen", line_segments(size_m * unit_circle()), DIPOLE_COLOUR, 3.0)
    with gui.add_folder("Target"):
        dropdown = gui.add_dropdown("Target", tuple(of_id), hint="The most significant is first.")
        panel = gui.add_html("")

    def show(_: object = None) -> None:
        target = of_id[dropdown.value]
        ring.position = np.array([*target.position_m[:2], found.ground_m])
        panel.content = words.panel(target_lines(target), warning=bool(target.flags))

    dropdown.on_update(show)
    show()


def target_lines(target: Target) -> list[str]:
    """What is known of a target, as lines of HTML."""
    low, high = target.depth_interval95_m
    iron = " to ".join(words.plain(mass, 2) for mass in target.iron_kg)
    return [
        f"<b>{escape(target.id)}</b> at {words.place(target.position_m)}",
        f"depth {length_text(target.depth_m)}: {length_text(low)} to {length_text(high)} (95 %)",
        f"95 % ellipse {length_text(target.ellipse95[0])} × {length_text(target.ellipse95[1])} (half axes)",
        f"moment {words.plain(target.strength_Am2, 3)} A·m²; iron: {iron} kg",
        f"χ² {words.plain(target.significance, 3)} is lost without it",
        *([f"<b>{escape(', '.join(target.flags))}</b>"] if target.flags else []),
    ]


def _colours(shades: FloatArray) -> ByteArray:
    """Colours (n, 3) of shades from 0 to 1."""
    return np.asarray(255.0 * _SCALE(shades)[:, :3]).astype(np.uint8)
