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


class SurveyScene:
    """Survey in a scene, with a choice of the target whose properties the panel shows.

    Parameters
    ----------
    server : viser.ViserServer
        The panels are added to the present container of its GUI.
    found : Survey

    Attributes
    ----------
    found : Survey
        Survey that is shown.
    entries : list
        Entries of the legend.
    points_m : ndarray, shape (k, 3)
        Points that the first view includes.
    folder : viser.GuiFolderHandle
        Folder of the chosen target.
    """

    def __init__(self, server: viser.ViserServer, found: Survey) -> None:
        self._scene, self.found = server.scene, found
        places = found.rows.decimate().place_m
        low, high = places.min(axis=0), places.max(axis=0)
        self._size_m = 0.04 * float(np.linalg.norm(high - low))
        linear, most = linear_and_most(1e9 * found.rows.decimate().anomaly_T)
        self._norm = SymLogNorm(linear, vmin=-most, vmax=most)
        ground = _ground(found.terrain, low[:2], high[:2])
        add_mesh(server.scene, "/ground", ground, _GROUND_COLOUR, flat=True, opacity=0.3)
        text = f"anomaly, linear up to {linear:.2g} nT, then logarithmic"
        self.entries: list[Entry] = [
            ColourScale.sample(text, f"{-most:.3g} nT", f"{most:.3g} nT", _colours),
            Swatch(_GROUND_COLOUR, "ground"),
        ]
        if len(found):
            self.entries += [
                Swatch(DIPOLE_COLOUR, "targets: arrows along the moments, and depths below the ground"),
                Swatch(REGION_COLOUR, "95 % ellipsoids of their positions"),
            ]
        self.points_m = np.vstack([places, ground.vertices, found.position_m])
        segments = line_segments(self._size_m * unit_circle())
        self._ring = add_lines(server.scene, "/chosen", segments, DIPOLE_COLOUR, 3.0, visible=False)
        self.folder = server.gui.add_folder("Target", visible=bool(len(found)))
        with self.folder:
            self.dropdown = server.gui.add_dropdown("Target", ("",), hint="The most significant is first.")
            self._panel = server.gui.add_html("")
        self.dropdown.on_update(lambda _: self._show_chosen())
        self._draw()

    @property
    def chosen(self) -> Target | None:
        """Target that the user chose, None if there is none."""
        return next((target for target in self.found if target.id == self.dropdown.value), None)

    def show(self, found: Survey) -> None:
        """Show another result of the same survey."""
        for target in self.found:
            self._scene.remove_by_name(f"/{target.id}")
            self._scene.remove_by_name(f"/{target.id}-text")
        if len(self.found):
            self._scene.remove_by_name("/depths")
            self._scene.remove_by_name("/ellipsoids")
        self.found = found
        self._draw()

    def _draw(self) -> None:
        scene, found, rows = self._scene, self.found, self.found.rows.decimate()
        add_points(scene, "/rows", rows.place_m, _colours(self._norm(1e9 * rows.anomaly_T)), 0.12 * self._size_m)
        for target in found:
            DipoleGlyph(scene, f"/{target.id}", self._size_m).show(target.position_m, target.moment_Am2)
            text = f"{target.id}: {target.depth_m:.2f} m"
            add_label(scene, f"/{target.id}-text", text, above(found.terrain, target.position_m), "bottom-center")
        if len(found):
            ends = np.stack([found.position_m, above(found.terrain, found.position_m)], axis=1)
            add_lines(scene, "/depths", ends, DIPOLE_COLOUR, 1.0)
            regions = join_surfaces(ellipsoid(target.position_m, target.covariance[:3, :3]) for target in found)
            add_mesh(scene, "/ellipsoids", regions, REGION_COLOUR, opacity=0.4)
        self.dropdown.options = tuple(target.id for target in found) or ("",)
        self._show_chosen()

    def _show_chosen(self) -> None:
        target = self.chosen
        self._ring.visible = target is not None
        self._panel.content = ""
        if target is not None:
            self._ring.position = above(self.found.terrain, target.position_m)
            self._panel.content = texts.panel_html(target_lines(target), warning=bool(target.flags))


def _ground(terrain: Terrain, low_m: FloatArray, high_m: FloatArray) -> Surface:
    """Return the ground in a rectangle."""
    n = 2 if terrain.is_flat else _GROUND_NODES
    xy = np.stack(np.meshgrid(*np.linspace(low_m, high_m, n).T, indexing="ij"), axis=-1).reshape(-1, 2)
    nodes = np.column_stack([xy, terrain.height_at(xy)])
    first = (n * np.arange(n - 1)[:, None] + np.arange(n - 1)).reshape(-1, 1)
    faces = first + np.array([[0, n, 1], [1, n, n + 1]])[:, None]
    return Surface(nodes.astype(np.float32), faces.reshape(-1, 3).astype(np.uint32))


def above(terrain: Terrain, position_m: FloatArray) -> FloatArray:
    """Return the places (..., 3) on the ground above positions (..., 3)."""
    return np.concatenate([position_m[..., :2], terrain.height_at(position_m[..., :2])[..., None]], axis=-1)


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
        f"{target.size_class}; fit: {target.fit_quality}",
        *([f"<b>{escape(', '.join(target.flags))}</b>"] if target.flags else []),
    ]


def _colours(shades: FloatArray) -> ByteArray:
    """Return the colours (n, 3) of shades from 0 to 1."""
    return np.asarray(255.0 * _SCALE(shades)[:, :3]).astype(np.uint8)
