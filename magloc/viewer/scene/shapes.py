r"""Shapes of what is seen: field lines, uncertainty, iso-surfaces, frames. Pure geometry, nothing of a viewer.

All lengths are in metres, in whichever frame the arguments are. What cannot be drawn, because a number of it is not
finite, is :data:`NOTHING`.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from functools import cache
from typing import NamedTuple

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.distance import cdist

from arrays.io.errors import of_extra
from arrays.typing import FloatArray

IntArray = NDArray[np.int64]
CHI2_95 = {2: 5.991464547107979, 3: 7.814727903251179}
"""95 % quantiles of χ², by degrees of freedom."""
_AROUND, _ALONG = 24, 33  # points of a range region
_OF_CIRCLE = 48
_NEAREST_OF_RANGE = 0.02
_SAME_LENGTH_RTOL = 1e-6


class Surface(NamedTuple):
    """A triangulated surface.

    Attributes
    ----------
    vertices : ndarray, shape (n, 3)
        [m].
    faces : ndarray of int, shape (k, 3)
        Vertices of every triangle, counter-clockwise seen from outside.
    """

    vertices: FloatArray
    faces: IntArray


NOTHING = Surface(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64))


def joined(surfaces: Iterable[Surface]) -> Surface:
    """Several surfaces as one."""
    vertices, faces = [NOTHING.vertices], [NOTHING.faces]
    before = 0
    for surface in surfaces:
        vertices.append(surface.vertices)
        faces.append(surface.faces + before)
        before += len(surface.vertices)
    return Surface(np.concatenate(vertices), np.concatenate(faces))


def surface_of(*meshes: trimesh.Trimesh) -> Surface:
    """Meshes as one surface."""
    return joined(Surface(np.array(mesh.vertices), np.array(mesh.faces, dtype=np.int64)) for mesh in meshes)


def dipole_body(size_m: float, thickness_m: float | None = None) -> Surface:
    """A ball at the origin and an arrow from it along z, which stand for a dipole.

    ``size_m``: length of the arrow [m]. ``thickness_m``: diameter of the ball, by which the arrow's shaft and head
    are sized too; by default a quarter of the length, about [m].
    """
    # Made of the length 1: the library merges vertices by an absolute tolerance, in whole numbers.
    thickness = 0.26 if thickness_m is None else thickness_m / size_m
    neck = 1.0 - 1.23 * thickness
    head = trimesh.creation.cone(0.46 * thickness, 1.0 - neck, sections=24)
    head.apply_translation([0.0, 0.0, neck])
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.5 * thickness)
    shaft = trimesh.creation.cylinder(0.17 * thickness, sections=16, segment=[[0.0, 0.0, 0.0], [0.0, 0.0, neck]])
    body = surface_of(ball, shaft, head)
    return Surface(size_m * body.vertices, body.faces)


def box_edges(corner_m: ArrayLike, opposite_m: ArrayLike) -> FloatArray:
    """The twelve edges of a box between two opposite corners.

    ``corner_m``, ``opposite_m`` (3,): [m]. Returns (12, 2, 3): [m].
    """
    ends = np.array([corner_m, opposite_m], dtype=np.float64)
    corners = np.array(list(itertools.product(*ends.T)))
    along_one_axis = [(a, b) for a, b in itertools.combinations(corners, 2) if np.count_nonzero(a != b) == 1]
    return np.array(along_one_axis)


def field_lines(
    position_m: ArrayLike,
    moment_Am2: ArrayLike,
    reach_m: float,
    *,
    shells: int = 3,
    meridians: int = 6,
    points: int = 49,
) -> FloatArray:
    r"""Field lines of one dipole: :math:`r = L \sin^2 θ` with θ from the moment, in planes through it.

    ``position_m``, ``moment_Am2`` (3,): source [m] and moment [A·m²]. ``reach_m``: largest L: where the outermost
    lines cross the equator of the dipole [m]. ``shells``: different L, which grow as the square of 1, 2, 3, ….
    ``meridians``: planes' halves, evenly around the moment. ``points``: on every line, evenly in θ, from the source
    back to the source. Returns (shells · meridians, points, 3): [m]; NaN where there is no moment.
    """
    axes = _axes_along(np.asarray(moment_Am2, dtype=np.float64))
    theta = np.linspace(0.0, np.pi, points)
    length = reach_m * (np.arange(1, shells + 1) / shells) ** 2
    azimuth = 2.0 * np.pi * np.arange(meridians) / meridians
    r = length[:, None, None] * np.sin(theta) ** 2
    across = (r * np.sin(theta))[..., None] * (
        np.cos(azimuth)[:, None, None] * axes[0] + np.sin(azimuth)[:, None, None] * axes[1]
    )
    along = (r * np.cos(theta))[..., None] * axes[2]
    return np.asarray(position_m, dtype=np.float64) + (across + along).reshape(-1, points, 3)


def line_segments(lines: ArrayLike) -> FloatArray:
    """Polylines as separate segments, without those that have an end which is not finite.

    ``lines`` (..., n, 3): [m]. Returns (segments, 2, 3): [m].
    """
    points = np.asarray(lines, dtype=np.float64)
    segments = np.stack([points[..., :-1, :], points[..., 1:, :]], axis=-2).reshape(-1, 2, 3)
    return segments[np.isfinite(segments).all(axis=(1, 2))]


def unit_circle() -> FloatArray:
    """Points (n + 1, 3) of a circle around the z axis, of radius 1, the first one again at the end."""
    angle = 2.0 * np.pi * np.arange(_OF_CIRCLE + 1) / _OF_CIRCLE
    return np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)


def frame_edges(positions_m: ArrayLike) -> FloatArray:
    """Bars between sensors: each pair that has no third sensor nearer to both (relative neighbourhood graph).

    The edges of a tetrahedron, a square, a cube or a grid; any array is held together.

    Parameters
    ----------
    positions_m : array-like, shape (n, 3)
        [m].

    Returns
    -------
    ndarray, shape (bars, 2, 3)
        [m].

    References
    ----------
    G. T. Toussaint, "The relative neighbourhood graph of a finite planar set", Pattern Recognition 12 (1980).
    """
    positions = np.asarray(positions_m, dtype=np.float64)
    distance = cdist(positions, positions)
    first, second = np.triu_indices(len(positions), 1)
    nearest_third = np.array(
        [
            np.min(np.delete(np.maximum(distance[i], distance[j]), [i, j]), initial=np.inf)
            for i, j in zip(first, second, strict=True)
        ]
    )
    kept = nearest_third >= (1.0 - _SAME_LENGTH_RTOL) * distance[first, second]
    return np.stack([positions[first[kept]], positions[second[kept]]], axis=1)


def ellipsoid(centre_m: ArrayLike, covariance_m2: ArrayLike) -> Surface:
    """95 % ellipsoid of a position (χ² of three degrees of freedom).

    ``centre_m`` (3,): [m]. ``covariance_m2`` (3, 3): [m²].
    """
    centre, covariance = np.asarray(centre_m, dtype=np.float64), np.asarray(covariance_m2, dtype=np.float64)
    if not (np.isfinite(centre).all() and np.isfinite(covariance).all()):
        return NOTHING
    unit, faces = _unit_sphere()
    values, vectors = np.linalg.eigh(covariance)
    # The symmetric root, which does not mirror: outside stays outside.
    root = (vectors * np.sqrt(CHI2_95[3] * np.clip(values, 0.0, None))) @ vectors.T
    return Surface(centre + unit @ root, faces)


def ellipsoid_axes(covariance_m2: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Rotations and semi-axes of 95 % ellipsoids, for many that share one mesh.

    ``covariance_m2`` (..., 3, 3): [m²], finite. Returns the rotation from the axes of the ellipsoid
    (..., 3, 3), proper, and the semi-axes (..., 3) [m].
    """
    values, vectors = np.linalg.eigh(np.asarray(covariance_m2, dtype=np.float64))
    vectors[..., 0] *= np.sign(np.linalg.det(vectors))[..., None]
    return vectors, np.sqrt(CHI2_95[3] * np.clip(values, 0.0, None))


def range_region(
    position_m: ArrayLike,
    covariance_m2: ArrayLike,
    centroid_m: ArrayLike,
    interval_m: tuple[float, float | None],
    farthest_m: float,
) -> Surface:
    r"""Where a source may be whose range is not observable: long, and bent where range and direction go together.

    It has every range r of the interval, and at each the 95 % ellipse of the direction given that range. The estimates
    of direction and 1/r are taken as jointly Gaussian, which holds far better than for the position: with the
    covariance C of two angles t and :math:`w = 1/r`,

    .. math:: t \mid w \sim N\left(C_{tw} (w - w_0) / C_{ww},\; C_{tt} - C_{tw} C_{wt} / C_{ww}\right).

    ``position_m`` (3,): estimate [m]. ``covariance_m2`` (3, 3): of the position, by linearisation [m²].
    ``centroid_m`` (3,): where the range is counted from [m]. ``interval_m``: 95 % interval of the range [m]; high
    is None where it is open. ``farthest_m``: where an open interval is cut [m]; at twice the estimated range at
    least. Returns: closed.
    """
    centroid, covariance = np.asarray(centroid_m, dtype=np.float64), np.asarray(covariance_m2, dtype=np.float64)
    offset = np.asarray(position_m, dtype=np.float64) - centroid
    r0 = float(np.linalg.norm(offset))
    if not (np.isfinite(offset).all() and np.isfinite(covariance).all() and r0 > 0.0):
        return NOTHING
    low, high = interval_m
    high = max(farthest_m, 2.0 * r0) if high is None else high
    low = max(low, _NEAREST_OF_RANGE * min(r0, high))
    axes = _axes_along(offset)
    # δt = e·δp / r0 for the two axes e across, δw = -u·δp / r0².
    to_angles = np.stack([axes[0] / r0, axes[1] / r0, -axes[2] / r0**2])
    C = to_angles @ covariance @ to_angles.T
    slope = C[:2, 2] / C[2, 2] if C[2, 2] > 0.0 else np.zeros(2)
    values, vectors = np.linalg.eigh(C[:2, :2] - np.outer(slope, C[:2, 2]))
    root = vectors * np.sqrt(CHI2_95[2] * np.clip(values, 0.0, None))
    if np.linalg.det(root) < 0.0:
        root[:, 0] *= -1.0
    r = np.geomspace(low, high, _ALONG)
    around = 2.0 * np.pi * np.arange(_AROUND) / _AROUND
    rim = np.stack([np.cos(around), np.sin(around)], axis=-1) @ root.T
    middle = (1.0 / r - 1.0 / r0)[:, None] * slope
    # The last point of every ring is its middle; the rings of the ends come twice, so that their edges look sharp.
    angles = np.concatenate([middle[:, None] + rim, middle[:, None]], axis=1)
    direction = angles @ axes[:2] + axes[2]
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    rings = centroid + r[:, None, None] * direction
    return Surface(np.concatenate([rings, rings[[0, -1]]]).reshape(-1, 3), _tube_faces())


def uncertainty(
    position_m: ArrayLike,
    covariance: ArrayLike,
    centroid_m: ArrayLike,
    *,
    range_observable: bool,
    range_interval_m: Iterable[tuple[float, float | None]],
    farthest_m: float,
) -> Surface:
    """Where the source of a fix may be: the 95 % ellipsoid if its range is observable, else the long region.

    ``position_m`` (3,): [m]. ``covariance`` (k, k): of the position, or with the position first [m²].
    ``centroid_m`` (3,): of the sensors [m]. ``range_interval_m``: as in
    :class:`magloc.localization.fit.results.Solution`. ``farthest_m``: where an open interval is cut [m].
    """
    of_position = np.asarray(covariance, dtype=np.float64)[:3, :3]
    if range_observable:
        return ellipsoid(position_m, of_position)
    return joined(
        range_region(position_m, of_position, centroid_m, interval, farthest_m) for interval in range_interval_m
    )


def iso_surface(axis_m: ArrayLike, values: ArrayLike, level: float) -> Surface:
    """Closed surface around those points of a cube whose value is at most a level (marching cubes).

    ``axis_m`` (n,): evenly spaced coordinates of the points, the same along all axes [m]. ``values`` (n, n, n):
    positive; NaN is above every level. ``level``: positive. Returns: half a spacing beyond the points where they
    are at the border of the cube; :data:`NOTHING` if no value is low enough.
    """
    with of_extra("view", "a surface"):
        from skimage.measure import marching_cubes

    axis, cube = np.asarray(axis_m, dtype=np.float64), np.asarray(values, dtype=np.float64)
    inside = cube <= level
    if not inside.any():
        return NOTHING
    # Between a point inside and one that has no value the surface stands half way: the depth is cut off symmetrically.
    depth = np.clip(np.where(np.isfinite(cube), level - cube, -np.inf) / level, -0.5, 0.5)
    depth = np.where(inside, np.maximum(depth, 1e-3), np.minimum(depth, -1e-3))
    spacing = float(axis[1] - axis[0])
    vertices, faces, _, _ = marching_cubes(  # type: ignore[no-untyped-call]
        np.pad(depth, 1, constant_values=-0.5), level=0.0, spacing=(spacing,) * 3, gradient_direction="ascent"
    )
    return Surface(vertices + (axis[0] - spacing), faces.astype(np.int64))


@cache
def _unit_sphere() -> Surface:
    return surface_of(trimesh.creation.icosphere(subdivisions=3))


@cache
def _tube_faces() -> IntArray:
    """Faces of rings stacked along a tube, outwards, and of the two rings after them that close its ends."""
    ring = _AROUND + 1
    i = np.arange(_AROUND)
    j = (i + 1) % _AROUND
    faces = [
        k * ring + triangle
        for k in range(_ALONG - 1)
        for triangle in (np.stack([i, j, j + ring], axis=-1), np.stack([i, j + ring, i + ring], axis=-1))
    ]
    middle = np.full_like(i, _AROUND)
    near, far = _ALONG * ring, (_ALONG + 1) * ring
    faces += [near + np.stack([middle, j, i], axis=-1), far + np.stack([middle, i, j], axis=-1)]
    return np.concatenate(faces).astype(np.int64)


def _axes_along(vector: FloatArray) -> FloatArray:
    """Right-handed unit axes (3, 3), one a row, the last along a vector; NaN if it has no direction."""
    with np.errstate(invalid="ignore", divide="ignore"):
        along = vector / np.linalg.norm(vector)
    across = np.cross(along, np.eye(3)[np.argmin(np.abs(along))])
    across /= np.linalg.norm(across)
    return np.stack([across, np.cross(along, across), along])
