"""Glyphs of a viser scene: arrays, dipoles, surfaces, lines and labels.

A glyph is created once and then moved, so that a drag needs only a few small messages. Sizes follow the extent of the
scene, so that arrays of 3 cm and of 30 m look alike.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Literal

import numpy as np
import viser
from numpy.typing import ArrayLike, NDArray

from arrays.array import SensorArray
from arrays.meshes import glyph_size, sensor_mesh
from arrays.sensor import Sensor, SensorKind
from arrays.typing import ByteArray, FloatArray
from magloc.viewer.scene.shapes import (
    NOTHING,
    Surface,
    dipole_body,
    field_lines,
    frame_edges,
    line_segments,
)

Colour = tuple[int, int, int]
LabelAnchor = Literal["bottom-center", "center-left", "center-right"]
# Okabe and Ito, for colour-blind readers.
DIPOLE_COLOUR: Colour = (213, 94, 0)
FIT_COLOUR: Colour = (0, 114, 178)
FIELD_LINE_COLOUR: Colour = (230, 159, 0)
TRACK_COLOUR: Colour = (0, 114, 178)
REGION_COLOUR: Colour = (86, 180, 233)
OTHER_COLOUR: Colour = (204, 121, 167)
ARROW_COLOUR: Colour = (0, 158, 115)
UNDETECTED_COLOUR: Colour = (165, 165, 165)
UNUSED_COLOUR: Colour = (200, 30, 60)
_EDGE_COLOUR: Colour = (150, 156, 165)


def round_length(length_m: float) -> float:
    """Return the largest of …, 0.1, 0.2, 0.5, 1, 2, 5, … up to a length [m]."""
    decade = 10.0 ** np.floor(np.log10(length_m))
    steps = decade * np.array([1.0, 2.0, 5.0])
    return float(steps[steps <= length_m * (1.0 + 1e-9)][-1])


def length_unit(length_m: float) -> tuple[str, float]:
    """Return a suitable unit for a length, and the length of the unit [m]."""
    for unit, metres, least in (("km", 1e3, 1e3), ("m", 1.0, 0.1), ("cm", 1e-2, 1e-2)):
        if abs(length_m) >= least * (1.0 - 1e-9):
            return unit, metres
    return "mm", 1e-3


def length_text(length_m: float) -> str:
    """Return a length with a suitable unit, such as ``5 mm``, ``0.5 m`` or ``2 km``."""
    unit, metres = length_unit(length_m or 1.0)
    return f"{length_m / metres:.3g} {unit}"


def add_lines(
    scene: viser.SceneApi,
    name: str,
    segments_m: FloatArray,
    colour: Colour | ByteArray,
    width: float,
    *,
    visible: bool = True,
) -> viser.LineSegmentsHandle:
    """Add lines (k, 2, 3) with a constant width on the screen."""
    return scene.add_line_segments(name, segments_m, colour, thickness=width, thickness_units="screen", visible=visible)


def show_segments(lines: viser.LineSegmentsHandle, segments_m: FloatArray) -> None:
    """Replace the segments (k, 2, 3) of lines, and hide the lines if there are none."""
    lines.visible = bool(len(segments_m))
    if len(segments_m):
        lines.points = segments_m.astype(np.float32)


def add_mesh(
    scene: viser.SceneApi, name: str, surface: Surface, colour: Colour, *, flat: bool = False, opacity: float = 1.0
) -> viser.MeshHandle:
    """Add a mesh without shadows; a translucent one shows both sides."""
    vertices, faces = surface
    return scene.add_mesh_simple(
        name,
        vertices,
        faces,
        color=colour,
        flat_shading=flat,
        opacity=opacity if opacity < 1.0 else None,
        side="double" if opacity < 1.0 else "front",
        cast_shadow=False,
        receive_shadow=False,
    )


def add_points(
    scene: viser.SceneApi, name: str, points_m: FloatArray, colours: Colour | ByteArray, size_m: float
) -> viser.PointCloudHandle:
    """Add round points (n, 3) of one colour or of one colour each."""
    return scene.add_point_cloud(
        name, points_m.astype(np.float32), colours, point_size=size_m, point_shape="circle", precision="float32"
    )


class ArrayGlyphs:
    """Array in a scene: sensors with axes and ids, bars between them, and the axes of the array.

    Parameters
    ----------
    scene : viser.SceneApi
    array : SensorArray

    Attributes
    ----------
    array : SensorArray
        Array in its present form.
    size_m : float
        Size of the sensors' glyphs [m].
    frame : viser.FrameHandle
        Frame of the array and parent of all other nodes.
    labels : dict of str to viser.LabelHandle
        Labels by the ids of the sensors.
    """

    def __init__(self, scene: viser.SceneApi, array: SensorArray) -> None:
        name = "/array"
        self.array = array
        self._scene = scene
        self.size_m = _glyph_size(array)
        self.frame = scene.add_frame(name, show_axes=False)
        axes_length = max(0.55 * array.circumradius, 1.5 * self.size_m) if array.n_sensors > 1 else 2.5 * self.size_m
        scene.add_frame(
            f"{name}/axes", axes_length=axes_length, axes_radius=0.012 * axes_length, origin_radius=0.03 * axes_length
        )
        edges = frame_edges(array.positions)
        self._edges = scene.add_line_segments(f"{name}/bars", edges, _EDGE_COLOUR, thickness=0.08 * self.size_m)
        kinds: tuple[SensorKind, ...] = ("vector", "scalar")
        self._kinds = {kind: [i for i, sensor in enumerate(array.sensors) if sensor.kind == kind] for kind in kinds}
        self._unused_marks: viser.PointCloudHandle | None = None
        self._glyphs = {
            kind: scene.add_batched_meshes_trimesh(
                f"{name}/{kind}-sensors",
                sensor_mesh(Sensor("glyph", kind, (0.0, 0.0, 0.0), 1e-9), self.size_m),
                _sensor_attitudes(array)[members],
                array.positions[members],
                lod="off",
                cast_shadow=False,
                receive_shadow=False,
            )
            for kind, members in self._kinds.items()
            if members
        }
        self.labels = {
            sensor.id: _add_scene_label(scene, f"{name}/ids/{i}", sensor.id, self._label_place(i), 0.5 * self.size_m)
            for i, sensor in enumerate(array.sensors)
        }

    def set_pose(self, position_m: ArrayLike, rotation_xyzw: ArrayLike) -> None:
        """Move the array.

        Parameters
        ----------
        position_m : array-like, shape (3,)
            Position of the array's origin [m].
        rotation_xyzw : array-like, shape (4,)
            Rotation from the array's frame.
        """
        self.frame.position = np.asarray(position_m, dtype=np.float64)
        self.frame.wxyz = np.roll(np.asarray(rotation_xyzw, dtype=np.float64), 1)

    def mark_unused(self, sensor_ids: Collection[str]) -> None:
        """Mark the sensors that are not used, and no others."""
        places = self.array.positions[[sensor.id in sensor_ids for sensor in self.array.sensors]]
        if len(places) and self._unused_marks is None:
            name, size = f"{self.frame.name}/not-used", 2.6 * self.size_m
            self._unused_marks = add_points(self._scene, name, places, UNUSED_COLOUR, size)
        if self._unused_marks is not None:
            self._unused_marks.visible = bool(len(places))
            if len(places):
                self._unused_marks.points = places.astype(np.float32)

    def set_array(self, array: SensorArray) -> None:
        """Show the same sensors at other positions.

        Parameters
        ----------
        array : SensorArray
            Array with the same ids and kinds in the same order.
        """
        self.array = array
        wxyz = _sensor_attitudes(array)
        for kind, glyphs in self._glyphs.items():
            members = self._kinds[kind]
            glyphs.batched_positions = array.positions[members].astype(np.float32)
            glyphs.batched_wxyzs = wxyz[members].astype(np.float32)
        self._edges.points = frame_edges(array.positions).astype(np.float32)
        for i, label in enumerate(self.labels.values()):
            label.position = self._label_place(i)

    def label_array(self, text: str) -> None:
        """Replace the ids of the sensors, which would not be legible, by one label."""
        for label in self.labels.values():
            label.visible = False
        place = self.array.centroid + np.array([0.0, 0.0, 1.3 * self.array.circumradius])
        add_label(self._scene, f"{self.frame.name}/name", text, place)

    def _label_place(self, i: int) -> FloatArray:
        return self.array.positions[i] + np.array([0.0, 0.0, 1.15 * self.size_m])


class DipoleGlyph:
    """Dipole in a scene: body, arrow along the moment, field lines and label.

    Parameters
    ----------
    scene : viser.SceneApi
    name : str
        Name of the parent node.
    size_m : float
        Length of the arrow [m].
    colour : tuple of 3 ints
        Colour of body and arrow.
    reach_m : float, optional
        Reach of the field lines [m]; by default there are none.
    label : str
        Text beside the tip.
    thickness_m : float, optional
        See :func:`~magloc.viewer.scene.shapes.dipole_body`.

    Attributes
    ----------
    frame : viser.FrameHandle
        Frame at the source, with the z axis along the moment.
    body : viser.MeshHandle
    field_lines : viser.LineSegmentsHandle, optional
    """

    def __init__(
        self,
        scene: viser.SceneApi,
        name: str,
        size_m: float,
        colour: Colour = DIPOLE_COLOUR,
        reach_m: float | None = None,
        label: str = "",
        thickness_m: float | None = None,
    ) -> None:
        # The moment is along the z axis of the frame, so that a turn of the frame turns all of it.
        self.frame = scene.add_frame(name, show_axes=False, visible=False)
        self.body = add_mesh(scene, f"{name}/body", dipole_body(size_m, thickness_m), colour)
        self.field_lines: viser.LineSegmentsHandle | None = None
        if reach_m is not None:
            segments = line_segments(field_lines(np.zeros(3), np.array([0.0, 0.0, 1.0]), reach_m))
            self.field_lines = add_lines(scene, f"{name}/field-lines", segments, FIELD_LINE_COLOUR, 1.3)
        if label:
            # The label is beside the tip, because the arrow of a control may be beyond it.
            add_label(scene, f"{name}/text", label, np.array([0.0, 0.0, 0.9 * size_m]), "center-right")
        self._is_enabled = True
        self._is_defined = False

    @property
    def visible(self) -> bool:
        """Whether the dipole is shown while it is defined."""
        return self._is_enabled

    @visible.setter
    def visible(self, is_enabled: bool) -> None:
        self._is_enabled = is_enabled
        self.frame.visible = is_enabled and self._is_defined

    def show(self, position_m: ArrayLike, moment_Am2: ArrayLike) -> None:
        """Move the dipole; it is hidden while a number is not finite, or the moment is zero.

        Parameters
        ----------
        position_m, moment_Am2 : array-like, shape (3,)
            Position [m] and moment [A·m²].
        """
        position, moment = np.asarray(position_m, dtype=np.float64), np.asarray(moment_Am2, dtype=np.float64)
        strength = float(np.linalg.norm(moment))
        self._is_defined = bool(np.isfinite(position).all() and np.isfinite(strength) and strength > 0.0)
        if self._is_defined:
            self.frame.position = position
            self.frame.wxyz = rotation_from_z(moment / strength)
        self.visible = self._is_enabled


class SurfaceGlyph:
    """Translucent surface in a scene, of variable shape.

    Parameters
    ----------
    scene : viser.SceneApi
    name : str
    colour : tuple of 3 ints
    opacity : float
    """

    def __init__(self, scene: viser.SceneApi, name: str, colour: Colour = REGION_COLOUR, opacity: float = 0.35) -> None:
        self._scene, self._name, self._colour, self._opacity = scene, name, colour, opacity
        self._faces: NDArray[np.int64] = NOTHING.faces
        self._is_enabled = True
        self.mesh: viser.MeshHandle | None = None

    @property
    def visible(self) -> bool:
        """Whether the surface is shown while it has faces."""
        return self._is_enabled

    @visible.setter
    def visible(self, is_enabled: bool) -> None:
        self._is_enabled = is_enabled
        if self.mesh is not None:
            self.mesh.visible = is_enabled and bool(len(self._faces))

    def show(self, surface: Surface | None) -> None:
        """Change the shape.

        Parameters
        ----------
        surface : Surface, optional
            None, or a surface without faces, hides the glyph.
        """
        shown = NOTHING if surface is None else surface
        if len(shown.faces):
            if self.mesh is not None and shown.faces is self._faces:
                self.mesh.vertices = shown.vertices.astype(np.float32)
            else:
                # A new node replaces the old one, because vertices and faces have to change together.
                self.mesh = add_mesh(self._scene, self._name, shown, self._colour, opacity=self._opacity)
        self._faces = shown.faces
        self.visible = self._is_enabled


def add_label(
    scene: viser.SceneApi, name: str, text: str, place_m: ArrayLike, anchor: LabelAnchor = "bottom-center"
) -> viser.LabelHandle:
    """Add a text with a constant size on the screen, anchored at a place (3,) [m]."""
    place = np.asarray(place_m, dtype=np.float64)
    return scene.add_label(name, text, position=place, anchor=anchor)


def _add_scene_label(
    scene: viser.SceneApi, name: str, text: str, place: FloatArray, height_m: float
) -> viser.LabelHandle:
    return scene.add_label(
        name, text, position=place, font_size_mode="scene", font_scene_height=height_m, anchor="bottom-center"
    )


def _glyph_size(array: SensorArray) -> float:
    """Return the size of the sensors' glyphs, visible even in a large array."""
    if array.n_sensors == 1:
        return 0.1
    return float(np.clip(glyph_size(array), 0.04 * array.circumradius, 0.2 * array.circumradius))


def _sensor_attitudes(array: SensorArray) -> FloatArray:
    return np.roll(np.array([sensor.rotation_xyzw for sensor in array.sensors]), 1, axis=-1)


def rotation_from_z(direction: FloatArray) -> FloatArray:
    """Return the shortest rotation of the z axis to a unit vector, as a unit quaternion wxyz."""
    x, y, z = direction
    if z < -1.0 + 1e-12:
        return np.array([0.0, 1.0, 0.0, 0.0])
    quaternion = np.array([1.0 + z, -y, x, 0.0])
    return quaternion / np.linalg.norm(quaternion)
