"""Meshes of arrays.

A vector sensor is a cube with three rods along its own axes, red x, green y, blue z; a scalar sensor is a sphere.
Glyphs are sized by the spacing of the sensors, so that an array of 3 cm and one of 30 m look alike.
"""

from __future__ import annotations

from typing import cast

import numpy as np
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation

from arrays.array import SensorArray
from arrays.io.errors import of_extra
from arrays.sensor import Sensor
from arrays.typing import FloatArray

with of_extra("view", "the mesh of an array"):
    import trimesh

BODY_COLOUR = (90, 96, 105, 255)
AXIS_COLOURS = ((214, 66, 62, 255), (68, 160, 71, 255), (52, 101, 204, 255))
# Lengths over the glyph's size, which is the length of its rods.
_CUBE_SIDE = 0.6
_ROD_RADIUS = 0.08
_SPHERE_RADIUS = 0.4
_SIZE_OF_SPACING = 0.4  # rods of neighbours that point at each other keep a gap of a fifth
_SAME_PLACE_RTOL = 1e-9


def glyph_size(array: SensorArray) -> float:
    """Return the size of glyphs [m]: 0.4 of the least distance between two sensors."""
    distances = pdist(array.positions)
    return _SIZE_OF_SPACING * float(distances[distances > _SAME_PLACE_RTOL * array.circumradius].min())


def sensor_mesh(sensor: Sensor, size_m: float) -> trimesh.Trimesh:
    """Return the watertight glyph of a sensor in the array's frame [m]; its rods reach `size_m`."""
    glyph = _glyph(sensor, size_m)
    glyph.apply_transform(_pose(sensor))
    return glyph


def mesh_of(array: SensorArray, size_m: float | None = None) -> trimesh.Trimesh:
    """Return all sensors of an array as one mesh.

    Parameters
    ----------
    array : SensorArray
        Array whose sensors are drawn at their positions.
    size_m : float, optional
        Size of the glyphs [m], :func:`glyph_size` by default.

    Returns
    -------
    trimesh.Trimesh
        Watertight mesh in the array's frame [m].

    Examples
    --------
    >>> import arrays
    >>> arrays.mesh_of(arrays.tetrahedron(1.5)).is_watertight
    True
    """
    size = glyph_size(array) if size_m is None else size_m
    return _join([sensor_mesh(sensor, size) for sensor in array.sensors])


def _glyph(sensor: Sensor, size_m: float) -> trimesh.Trimesh:
    """Return the mesh of a sensor in its own axes."""
    if not 0.0 < size_m < np.inf:
        raise ValueError(f"Input size_m must be a positive finite number; instead received {size_m}.")
    if sensor.kind == "scalar":
        radius = _SPHERE_RADIUS * size_m
        return trimesh.creation.icosphere(subdivisions=3, radius=radius, face_colors=BODY_COLOUR)
    body = trimesh.creation.box(extents=[_CUBE_SIDE * size_m] * 3, face_colors=BODY_COLOUR)
    return _join([body, *(_rod(axis, size_m) for axis in range(3))])


def _rod(axis: int, size_m: float) -> trimesh.Trimesh:
    """Return a rod from the origin along an axis."""
    segment = np.array([np.zeros(3), size_m * np.eye(3)[axis]])
    radius = _ROD_RADIUS * size_m
    rod: trimesh.Trimesh = trimesh.creation.cylinder(
        radius, sections=16, segment=segment, face_colors=AXIS_COLOURS[axis]
    )
    return rod


def _join(meshes: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    return cast(trimesh.Trimesh, trimesh.util.concatenate(meshes))


def _pose(sensor: Sensor) -> FloatArray:
    """Return the homogeneous transform from a sensor's axes to the array's frame, shape (4, 4)."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(sensor.rotation_xyzw).as_matrix()
    pose[:3, 3] = sensor.position_m
    return pose
