"""Survey in a scene: rows coloured by their anomaly, and targets with ellipsoids below the ground."""

from __future__ import annotations

from html import escape

import numpy as np
import viser
from matplotlib import colormaps
from matplotlib.colors import SymLogNorm

from arrays.typing import ByteArray, FloatArray
from magloc.surveying.results import Survey, Target, linear_and_most
from magloc.terrain.surface import Terrain
from magloc.viewer.pages import texts
from magloc.viewer.scene.glyphs import (
    DIPOLE_COLOUR,
    REGION_COLOUR,
    DipoleGlyph,
    add_label,
    add_lines,
    add_mesh,
    add_points,
    length_text,
)
from magloc.viewer.scene.legend import ColourScale, Entry, Swatch
from magloc.viewer.scene.shapes import Surface, ellipsoid, join_surfaces, line_segments, unit_circle

_SCALE = colormaps["RdBu_r"]
_GROUND_COLOUR = (150, 120, 90)
_GROUND_NODES = 50  # along each side of uneven ground


def add_survey(server: viser.ViserServer, found: Survey) -> tuple[list[Entry], FloatArray]:
    """Add a survey to a scene; return entries of the legend, and points (k, 3) to show."""
    scene = server.scene
    rows = found.rows.decimate()
    places, anomaly_nT = rows.place_m, 1e9 * rows.anomaly_T
    linear, most = linear_and_most(anomaly_nT)
    low, high = places.min(axis=0), places.max(axis=0)
    size = 0.04 * float(np.linalg.norm(high - low))
    add_points(scene, "/rows", places, _colours(SymLogNorm(linear, vmin=-most, vmax=most)(anomaly_nT)), 0.12 * size)
    ground = _ground(found.terrain, low[:2], high[:2])
    add_mesh(scene, "/ground", ground, _GROUND_COLOUR, flat=True, opacity=0.3)
    text = f"anomaly, linear up to {linear:.2g} nT, then logarithmic"
    entries: list[Entry] = [
        ColourScale.sample(text, f"{-most:.3g} nT", f"{most:.3g} nT", _colours),
        Swatch(_GROUND_COLOUR, "ground"),
    ]
    if len(found):
        for target in found:
            DipoleGlyph(scene, f"/{target.id}", size).show(target.position_m, target.moment_Am2)
            text = f"{target.id}: {target.depth_m:.2f} m"
            add_label(scene, f"/{target.id}-text", text, _above(found.terrain, target.position_m), "bottom-center")
        ends = np.stack([found.position_m, _above(found.terrain, found.position_m)], axis=1)
        add_lines(scene, "/depths", ends, DIPOLE_COLOUR, 1.0)
        regions = join_surfaces(ellipsoid(target.position_m, target.covariance[:3, :3]) for target in found)
        add_mesh(scene, "/ellipsoids", regions, REGION_COLOUR, opacity=0.4)
        entries.append(
            Swatch(DIPOLE_COLOUR, f"{len(found)} targets: arrows along the moments, and depths below the ground")
        )
        entries.append(Swatch(REGION_COLOUR, "95 % ellipsoids of their positions"))
        _add_targets(server, found, size)
    return entries, np.vstack([places, ground.vertices, found.position_m])


def _ground(terrain: Terrain, low_m: FloatArray, high_m: FloatArray) -> Surface:
    """Return the ground in a rectangle."""
    n = 2 if terrain.is_flat else _GROUND_NODES
    xy = np.stack(np.meshgrid(*np.linspace(low_m, high_m, n).T, indexing="ij"), axis=-1).reshape(-1, 2)
    nodes = np.column_stack([xy, terrain.height_at(xy)])
    first = (n * np.arange(n - 1)[:, None] + np.arange(n - 1)).reshape(-1, 1)
    faces = first + np.array([[0, n, 1], [1, n, n + 1]])[:, None]
    return Surface(nodes.astype(np.float32), faces.reshape(-1, 3).astype(np.uint32))


def _above(terrain: Terrain, position_m: FloatArray) -> FloatArray:
    """Return the places (..., 3) on the ground above positions (..., 3)."""
    return np.concatenate([position_m[..., :2], terrain.height_at(position_m[..., :2])[..., None]], axis=-1)


def _add_targets(server: viser.ViserServer, found: Survey, size_m: float) -> None:
    """Add a selection of the target, which gets a ring on the ground, and its text."""
    gui, targets = server.gui, {target.id: target for target in found}
    ring = add_lines(server.scene, "/chosen", line_segments(size_m * unit_circle()), DIPOLE_COLOUR, 3.0)
    with gui.add_folder("Target"):
        dropdown = gui.add_dropdown("Target", tuple(targets), hint="The most significant is first.")
        panel = gui.add_html("")

    def show(_: object = None) -> None:
        target = targets[dropdown.value]
        ring.position = _above(found.terrain, target.position_m)
        panel.content = texts.panel_html(target_lines(target), warning=bool(target.flags))

    dropdown.on_update(show)
    show()


def target_lines(target: Target) -> list[str]:
    """Return the properties of a target as lines of HTML."""
    low, high = target.depth_interval95_m
    iron = " to ".join(texts.number_text(mass, 2) for mass in target.iron_kg)
    return [
        f"<b>{escape(target.id)}</b> at {texts.position_text(target.position_m)}",
        f"depth {length_text(target.depth_m)}: {length_text(low)} to {length_text(high)} (95 %)",
        f"95 % ellipse {length_text(target.ellipse95[0])} × {length_text(target.ellipse95[1])} (half axes)",
        f"moment {texts.number_text(target.strength_Am2, 3)} A·m²; iron: {iron} kg",
        f"χ² {texts.number_text(target.significance, 3)} is lost without it",
        *([f"<b>{escape(', '.join(target.flags))}</b>"] if target.flags else []),
    ]


def _colours(shades: FloatArray) -> ByteArray:
    """Return the colours (n, 3) of shades from 0 to 1."""
    return np.asarray(255.0 * _SCALE(shades)[:, :3]).astype(np.uint8)
