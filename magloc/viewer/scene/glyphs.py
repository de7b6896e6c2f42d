"""What is put into a viser scene: arrays, dipoles, uncertainty, tracks and texts.

Every glyph is made once and then moved, so that a drag costs a few small messages. Sizes follow from the scene's
extent, so that an array of 3 cm and one of 30 m look alike.
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
# Okabe and Ito: told apart by colour-blind readers too.
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
    """The nearest of …, 0.1, 0.2, 0.5, 1, 2, 5, … below a length [m]."""
    decade = 10.0 ** np.floor(np.log10(length_m))
    steps = decade * np.array([1.0, 2.0, 5.0])
    return float(steps[steps <= length_m * (1.0 + 1e-9)][-1])


def length_unit(length_m: float) -> tuple[str, float]:
    """The unit that suits a length, and how long it is [m]."""
    for unit, metres, least in (("km", 1e3, 1e3), ("m", 1.0, 0.1), ("cm", 1e-2, 1e-2)):
        if abs(length_m) >= least * (1.0 - 1e-9):
            return unit, metres
    return "mm", 1e-3


def length_text(length_m: float) -> str:
    """A length with the unit that suits it, such as ``5 mm``, ``0.5 m`` or ``2 km``."""
    # Not a figure more than it takes, and no exponent.
    unit, metres = length_unit(length_m or 1.0)
    return f"{length_m / metres:.3g} {unit}"


def screen_lines(
    scene: viser.SceneApi,
    name: str,
    segments_m: FloatArray,
    colour: Colour | ByteArray,
    width: float,
    *,
    visible: bool = True,
) -> viser.LineSegmentsHandle:
    """Lines (k, 2, 3) that are as wide on the screen from near as from far."""
    return scene.add_line_segments(name, segments_m, colour, thickness=width, thickness_units="screen", visible=visible)


def solid(
    scene: viser.SceneApi, name: str, surface: Surface, colour: Colour, *, flat: bool = False, opacity: float = 1.0
) -> viser.MeshHandle:
    """A mesh that neither casts nor shows shadows; both sides are seen of one that is translucent."""
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


def dots(
    scene: viser.SceneApi, name: str, points_m: FloatArray, colours: Colour | ByteArray, size_m: float
) -> viser.PointCloudHandle:
    """Round points (n, 3) of one colour, or one each."""
    return scene.add_point_cloud(
        name, points_m.astype(np.float32), colours, point_size=size_m, point_shape="circle", precision="float32"
    )


class ArrayGlyphs:
    """An array in a scene: sensors with their axes, bars between them, their ids, and the array's own axes.

    Parameters
    ----------
    scene : viser.SceneApi
    array : SensorArray
    name : str
        Of the node that holds it all.

    Attributes
    ----------
    array : SensorArray
        As it is shown.
    size_m : float
        Of the glyphs.
    frame : viser.FrameHandle
        The array's frame, to which everything else belongs.
    labels : dict of str to viser.LabelHandle
        By id of the sensor.
    """

    def __init__(self, scene: viser.SceneApi, array: SensorArray, name: str = "/array") -> None:
        self.array = array
        self._scene = scene
        self.size_m = _size_of_glyphs(array)
        self.frame = scene.add_frame(name, show_axes=False)
        axes_length = max(0.55 * array.circumradius, 1.5 * self.size_m) if array.n_sensors > 1 else 2.5 * self.size_m
        self.axes = scene.add_frame(
            f"{name}/axes", axes_length=axes_length, axes_radius=0.012 * axes_length, origin_radius=0.03 * axes_length
        )
        edges = frame_edges(array.positions)
        self._edges = scene.add_line_segments(f"{name}/bars", edges, _EDGE_COLOUR, thickness=0.08 * self.size_m)
        kinds: tuple[SensorKind, ...] = ("vector", "scalar")
        self._kinds = {kind: [i for i, sensor in enumerate(array.sensors) if sensor.kind == kind] for kind in kinds}
        self._marks: viser.PointCloudHandle | None = None
        self._glyphs = {
            kind: scene.add_batched_meshes_trimesh(
                f"{name}/{kind}-sensors",
                sensor_mesh(Sensor("glyph", kind, (0.0, 0.0, 0.0), 1e-9), self.size_m),
                _wxyz_of_sensors(array)[members],
                array.positions[members],
                lod="off",
                cast_shadow=False,
                receive_shadow=False,
            )
            for kind, members in self._kinds.items()
            if members
        }
        self.labels = {
            sensor.id: _label(scene, f"{name}/ids/{i}", sensor.id, self._label_place(i), 0.5 * self.size_m)
            for i, sensor in enumerate(array.sensors)
        }

    def set_pose(self, position_m: ArrayLike, rotation_xyzw: ArrayLike) -> None:
        """Move the array.

        Parameters
        ----------
        position_m : array-like, shape (3,)
            Of the array's origin [m].
        rotation_xyzw : array-like, shape (4,)
            From the array's frame.
        """
        self.frame.position = np.asarray(position_m, dtype=np.float64)
        self.frame.wxyz = np.roll(np.asarray(rotation_xyzw, dtype=np.float64), 1)

    def mark(self, sensor_ids: Collection[str]) -> None:
        """Mark sensors that are not used, and no others."""
        places = self.array.positions[[sensor.id in sensor_ids for sensor in self.array.sensors]]
        if len(places) and self._marks is None:
            name, size = f"{self.frame.name}/not-used", 2.6 * self.size_m
            self._marks = dots(self._scene, name, places, UNUSED_COLOUR, size)
        if self._marks is not None:
            self._marks.visible = bool(len(places))
            if len(places):
                self._marks.points = places.astype(np.float32)

    def set_array(self, array: SensorArray) -> None:
        """Show the same sensors at other places.

        Parameters
        ----------
        array : SensorArray
            With the same ids and kinds, in the same order.
        """
        self.array = array
        wxyz = _wxyz_of_sensors(array)
        for kind, glyphs in self._glyphs.items():
            members = self._kinds[kind]
            glyphs.batched_positions = array.positions[members].astype(np.float32)
            glyphs.batched_wxyzs = wxyz[members].astype(np.float32)
        self._edges.points = frame_edges(array.positions).astype(np.float32)
        for i, label in enumerate(self.labels.values()):
            label.position = self._label_place(i)

    def name_as_a_whole(self, text: str) -> None:
        """One text for the array in place of the ids of its sensors, where these would be too small to be read."""
        for label in self.labels.values():
            label.visible = False
        place = self.array.centroid + np.array([0.0, 0.0, 1.3 * self.array.circumradius])
        screen_label(self._scene, f"{self.frame.name}/name", text, place)

    def _label_place(self, i: int) -> FloatArray:
        return self.array.positions[i] + np.array([0.0, 0.0, 1.15 * self.size_m])


class DipoleGlyph:
    """A dipole in a scene: body, arrow along the moment, field lines, and a text.

    Parameters
    ----------
    scene : viser.SceneApi
    name : str
        Of the node that holds it all.
    size_m : float
        Length of the arrow.
    colour : tuple of 3 ints
        Of body and arrow.
    reach_m : float, optional
        Of the field lines; by default there are none.
    label : str
        Text beside the tip.
    thickness_m : float, optional
        As in :func:`~magloc.viewer.scene.shapes.dipole_body`.

    Attributes
    ----------
    frame : viser.FrameHandle
        At the source, its z axis along the moment.
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
        # The moment is the frame's z axis: a turn of the frame turns all that belongs to it.
        self.frame = scene.add_frame(name, show_axes=False, visible=False)
        self.body = solid(scene, f"{name}/body", dipole_body(size_m, thickness_m), colour)
        self.field_lines: viser.LineSegmentsHandle | None = None
        if reach_m is not None:
            segments = line_segments(field_lines(np.zeros(3), np.array([0.0, 0.0, 1.0]), reach_m))
            self.field_lines = screen_lines(scene, f"{name}/field-lines", segments, FIELD_LINE_COLOUR, 1.3)
        if label:
            # Beside the tip, beyond which there may be the arrow of a control.
            screen_label(scene, f"{name}/text", label, np.array([0.0, 0.0, 0.9 * size_m]), "center-right")
        self._wanted = True
        self._defined = False

    @property
    def visible(self) -> bool:
        """Whether it may be seen."""
        return self._wanted

    @visible.setter
    def visible(self, wanted: bool) -> None:
        self._wanted = wanted
        self.frame.visible = wanted and self._defined

    def show(self, position_m: ArrayLike, moment_Am2: ArrayLike) -> None:
        """Move it; it is not seen while a number of it is not finite, or there is no moment.

        Parameters
        ----------
        position_m, moment_Am2 : array-like, shape (3,)
            [m], [A·m²].
        """
        position, moment = np.asarray(position_m, dtype=np.float64), np.asarray(moment_Am2, dtype=np.float64)
        strength = float(np.linalg.norm(moment))
        self._defined = bool(np.isfinite(position).all() and np.isfinite(strength) and strength > 0.0)
        if self._defined:
            self.frame.position = position
            self.frame.wxyz = turned_to(moment / strength)
        self.visible = self._wanted


class SurfaceGlyph:
    """A translucent surface in a scene that changes its shape.

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
        self._wanted = True
        self.mesh: viser.MeshHandle | None = None

    @property
    def visible(self) -> bool:
        """Whether it may be seen."""
        return self._wanted

    @visible.setter
    def visible(self, wanted: bool) -> None:
        self._wanted = wanted
        if self.mesh is not None:
            self.mesh.visible = wanted and bool(len(self._faces))

    def show(self, surface: Surface | None) -> None:
        """Change the shape.

        Parameters
        ----------
        surface : Surface, optional
            None, or one without faces, is not seen.
        """
        shown = NOTHING if surface is None else surface
        if len(shown.faces):
            if self.mesh is not None and shown.faces is self._faces:
                self.mesh.vertices = shown.vertices.astype(np.float32)
            else:
                # Vertices and faces have to change together: the node is replaced.
                self.mesh = solid(self._scene, self._name, shown, self._colour, opacity=self._opacity)
        self._faces = shown.faces
        self.visible = self._wanted


def screen_label(
    scene: viser.SceneApi, name: str, text: str, place_m: ArrayLike, anchor: LabelAnchor = "bottom-center"
) -> viser.LabelHandle:
    """A text that is as large on the screen from near as from far, with its anchor at a place (3,) [m]."""
    place = np.asarray(place_m, dtype=np.float64)
    return scene.add_label(name, text, position=place, anchor=anchor)


def _label(scene: viser.SceneApi, name: str, text: str, place: FloatArray, height_m: float) -> viser.LabelHandle:
    return scene.add_label(
        name, text, position=place, font_size_mode="scene", font_scene_height=height_m, anchor="bottom-center"
    )


def _size_of_glyphs(array: SensorArray) -> float:
    """As :func:`arrays.meshes.glyph_size`, but no dots in a large array with two sensors close together."""
    if array.n_sensors == 1:
        return 0.1
    return float(np.clip(glyph_size(array), 0.04 * array.circumradius, 0.2 * array.circumradius))


def _wxyz_of_sensors(array: SensorArray) -> FloatArray:
    return np.roll(np.array([sensor.rotation_xyzw for sensor in array.sensors]), 1, axis=-1)


def turned_to(direction: FloatArray) -> FloatArray:
    """The shortest turn of the z axis to a unit vector, as a unit quaternion wxyz."""
    x, y, z = direction
    if z < -1.0 + 1e-12:
        return np.array([0.0, 1.0, 0.0, 0.0])
    quaternion = np.array([1.0 + z, -y, x, 0.0])
    return quaternion / np.linalg.norm(quaternion)
