"""First view of a scene: extent, floor, lights and camera."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
import viser
from numpy.typing import ArrayLike

from arrays.typing import FloatArray
from magloc.viewer.scene.glyphs import round_length

FIELD_OF_VIEW_RAD = np.radians(40.0)
"""Vertical field of view of the first camera."""
# The first camera looks from the front right, from above.
_TOWARDS_CAMERA = np.array([0.55, -0.72, 0.42])
_ASPECT = 1.0  # of the scene beside the panel, less the labels to its right
PHONE_WIDTH = 1.4
"""Width that a narrow page sees, relative to the height of the first view: its labels need more room."""
_MARGIN = 1.12
_CELLS_PER_RADIUS = 4.0
_FLOOR_RADII = 3.0
_BELOW_RADII = 0.05
# Visible on white, and not too bright on a dark page.
_FLOOR_COLOUR, _FLOOR_LINE = (150, 155, 160), 0.45
# Intensities of the ambient light and of four side lights; the light from above has 3.
_AMBIENT = 1.6
_SIDE = 1.3


class Extent(NamedTuple):
    """Points that should be in view.

    Attributes
    ----------
    centre_m : ndarray, shape (3,)
        Centre of the points' bounding box, around which the camera turns [m].
    radius_m : float
        Radius of the ball around the centre that contains the points, positive [m].
    points_m : ndarray, shape (k, 3)
        The points [m].
    """

    centre_m: FloatArray
    radius_m: float
    points_m: FloatArray


class Floor(NamedTuple):
    """Height of the floor, and side of its squares."""

    height_m: float
    cell_m: float


def extent_of(*points_m: ArrayLike) -> Extent:
    """Return the extent of points, with a radius of 1 m for a single place or none.

    ``*points_m`` (..., 3): points [m]; those that are not finite are ignored.
    """
    points = np.concatenate([np.asarray(part, dtype=np.float64).reshape(-1, 3) for part in points_m])
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        points = np.zeros((1, 3))
    centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
    radius = float(np.linalg.norm(points - centre, axis=1).max())
    if radius > 0.0:
        return Extent(centre, radius, points)
    return Extent(centre, 1.0, corners_of(centre, 1.0 / np.sqrt(3.0)))


def corners_of(centre_m: ArrayLike, half_side_m: float) -> FloatArray:
    """Return the corners of a cube, shape (8, 3) [m]."""
    signs = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    return np.asarray(centre_m, dtype=np.float64) + half_side_m * signs


def set_up_scene(server: viser.ViserServer, extent: Extent) -> Floor:
    """Set up direction, lights, floor and first camera of a scene of an extent."""
    scene, centre, radius = server.scene, extent.centre_m, extent.radius_m
    scene.set_up_direction("+z")
    scene.world_axes.visible = False
    _add_lights(scene)
    cell = round_length(radius / _CELLS_PER_RADIUS * 1.5)
    side = 2.0 * np.ceil(_FLOOR_RADII * radius / cell) * cell
    middle = np.round(centre[:2] / cell) * cell
    lowest = float(extent.points_m[:, 2].min())
    height = float(np.floor((lowest - _BELOW_RADII * radius) / cell) * cell)
    scene.add_grid(
        "/floor",
        width=side,
        height=side,
        cell_size=cell,
        section_size=5.0 * cell,
        cell_thickness=_FLOOR_LINE,
        section_thickness=2.0 * _FLOOR_LINE,
        cell_color=_FLOOR_COLOUR,
        section_color=_FLOOR_COLOUR,
        shadow_opacity=0.0,
        fade_distance=20.0 * radius,
        position=(middle[0], middle[1], height),
    )
    aim_camera(server, extent)
    return Floor(height, cell)


def _add_lights(scene: viser.SceneApi) -> None:
    """Add light from above and from all sides, so that no side is black."""
    # Shadows of neighbouring objects would be confusing.
    scene.configure_default_lights(enabled=True, cast_shadow=False)
    # The default environment map takes several seconds on a machine without a graphics card.
    scene.configure_environment_map(hdri=None)
    scene.add_light_ambient("/lights/everywhere", intensity=_AMBIENT)
    x, y, z = _TOWARDS_CAMERA.tolist()
    for i, side in enumerate(((x, y, z), (-x, -y, z), (y, -x, z), (-y, x, z))):
        scene.add_light_directional(f"/lights/side-{i}", intensity=_SIDE, position=side)


def aim_camera(server: viser.ViserServer, extent: Extent) -> None:
    """Set the first camera, also that of "Reset View", so that all points are just in view."""
    back = _TOWARDS_CAMERA / np.linalg.norm(_TOWARDS_CAMERA)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(back, right), back])
    across, up, towards = axes @ (extent.points_m - extent.centre_m).T
    # A point is in view if its distance from the axis is within the field of view at its depth.
    tangent = np.tan(0.5 * FIELD_OF_VIEW_RAD) / _MARGIN
    distance = np.max(towards + np.maximum(np.abs(up) / tangent, np.abs(across) / (_ASPECT * tangent)))
    camera = server.initial_camera
    camera.fov = float(FIELD_OF_VIEW_RAD)
    camera.position = extent.centre_m + max(float(distance), 0.5 * extent.radius_m) * back
    camera.look_at = extent.centre_m
    camera.near = 0.01 * extent.radius_m
    camera.far = 200.0 * extent.radius_m
