r"""Geometry of the glyphs: field lines, uncertainty regions, iso-surfaces and frames, independent of the viewer.

All lengths are in metres, in the frame of the arguments. A shape with numbers that are not finite is :data:`NOTHING`.
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
from magloc.navigation.rotations import unit_across

IntArray = NDArray[np.int64]
CHI2_95 = {2: 5.991464547107979, 3: 7.814727903251179}
"""95 % quantiles of χ², by degrees of freedom."""
_AROUND, _ALONG = 24, 33  # points of a range region
_CIRCLE_POINTS = 48
_LEAST_RANGE = 0.02  # of a range region, relative to its range
_SAME_LENGTH_RTOL = 1e-6


class Surface(NamedTuple):
    """Triangulated surface.

    Attributes
    ----------
    vertices : ndarray, shape (n, 3)
        Positions of the vertices [m].
    faces : ndarray of int, shape (k, 3)
        Vertices of every triangle, counter-clockwise as seen from outside.
    """

    vertices: FloatArray
    faces: IntArray


NOTHING = Surface(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64))


def join_surfaces(surfaces: Iterable[Surface]) -> Surface:
    """Join several surfaces into one."""
    vertices, faces = [NOTHING.vertices], [NOTHING.faces]
    before = 0
    for surface in surfaces:
        vertices.append(surface.vertices)
        faces.append(surface.faces + before)
        before += len(surface.vertices)
    return Surface(np.concatenate(vertices), np.concatenate(faces))


def surface_of(*meshes: trimesh.Trimesh) -> Surface:
    """Return meshes as one surface."""
    return join_surfaces(Surface(np.array(mesh.vertices), np.array(mesh.faces, dtype=np.int64)) for mesh in meshes)


def fan(rim_m: FloatArray) -> Surface:
    """Return the triangles between the origin and a closed rim (n, 3)."""
    n = len(rim_m)
    faces = np.array([[0, i + 1, (i + 1) % n + 1] for i in range(n)])
    return Surface(np.concatenate([np.zeros((1, 3)), rim_m]), faces)


def dipole_body(size_m: float, thickness_m: float | None = None) -> Surface:
    """Return the body of a dipole: a ball at the origin, and an arrow along z.

    ``size_m``: length of the arrow [m]. ``thickness_m``: diameter of the ball, to which shaft and head are
    proportional; by default about a quarter of the length [m].
    """
    # The meshes have the length 1, because the library merges vertices by an absolute tolerance.
    thickness = 0.26 if thickness_m is None else thickness_m / size_m
    neck = 1.0 - 1.23 * thickness
    head = trimesh.creation.cone(0.46 * thickness, 1.0 - neck, sections=24)
    head.apply_translation([0.0, 0.0, neck])
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.5 * thickness)
    shaft = trimesh.creation.cylinder(0.17 * thickness, sections=16, segment=[[0.0, 0.0, 0.0], [0.0, 0.0, neck]])
    body = surface_of(ball, shaft, head)
    return Surface(size_m * body.vertices, body.faces)


def box_edges(corner_m: ArrayLike, opposite_m: ArrayLike) -> FloatArray:
    """Return the edges (12, 2, 3) of a box between two opposite corners (3,) [m]."""
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
    r"""Return field lines of a dipole, :math:`r = L \sin^2 θ` with θ from the moment.

    ``position_m``, ``moment_Am2`` (3,): position [m] and moment [A·m²]. ``reach_m``: largest L, at which the outermost
    lines cross the equator [m]. ``shells``: number of values of L, which grow as the squares of 1, 2, 3, ….
    ``meridians``: number of half-planes, evenly around the moment. ``points``: number of points of a line, evenly in θ,
    from the source back to the source. Returns (shells · meridians, points, 3) [m]; NaN without a moment.
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
    """Return the finite segments (k, 2, 3) of polylines (..., n, 3) [m]."""
    points = np.asarray(lines, dtype=np.float64)
    segments = np.stack([points[..., :-1, :], points[..., 1:, :]], axis=-2).reshape(-1, 2, 3)
    return segments[np.isfinite(segments).all(axis=(1, 2))]


def unit_circle() -> FloatArray:
    """Return points (n + 1, 3) of the unit circle around z; the last one repeats the first."""
    angle = 2.0 * np.pi * np.arange(_CIRCLE_POINTS + 1) / _CIRCLE_POINTS
    return np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)


def frame_edges(positions_m: ArrayLike) -> FloatArray:
    """Return bars between sensors: each pair without a third sensor that is nearer to both.

    This relative neighbourhood graph has the edges of a tetrahedron, a square, a cube or a grid. It connects any array.

    Parameters
    ----------
    positions_m : array-like, shape (n, 3)
        Positions of the sensors [m].

    Returns
    -------
    ndarray, shape (bars, 2, 3)
        Ends of the bars [m].

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
    is_bar = nearest_third >= (1.0 - _SAME_LENGTH_RTOL) * distance[first, second]
    return np.stack([positions[first[is_bar]], positions[second[is_bar]]], axis=1)


def ellipsoid(centre_m: ArrayLike, covariance_m2: ArrayLike) -> Surface:
    """Return the 95 % ellipsoid of a position (χ² with three degrees of freedom).

    ``centre_m`` (3,): position [m]. ``covariance_m2`` (3, 3): covariance [m²].
    """
    centre, covariance = np.asarray(centre_m, dtype=np.float64), np.asarray(covariance_m2, dtype=np.float64)
    if not (np.isfinite(centre).all() and np.isfinite(covariance).all()):
        return NOTHING
    unit, faces = _unit_sphere()
    values, vectors = np.linalg.eigh(covariance)
    # The symmetric root is no reflection, so that the faces stay oriented outwards.
    root = (vectors * np.sqrt(CHI2_95[3] * np.clip(values, 0.0, None))) @ vectors.T
    return Surface(centre + unit @ root, faces)


def ellipsoid_axes(covariance_m2: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return rotations and semi-axes of 95 % ellipsoids that share one mesh.

    ``covariance_m2`` (..., 3, 3): finite covariances [m²]. Returns the proper rotations from the axes of the ellipsoids
    (..., 3, 3), and the semi-axes (..., 3) [m].
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
    r"""Return the 95 % region of a source with an unobservable range: a long tube.

    The tube may be bent. It contains every range r of the interval, with the 95 % ellipse of the direction given that
    range. The estimates of direction and 1/r are jointly Gaussian to a far better approximation than the position. With
    the covariance C of two angles t and :math:`w = 1/r`,

    .. math:: t \mid w \sim N\left(C_{tw} (w - w_0) / C_{ww},\; C_{tt} - C_{tw} C_{wt} / C_{ww}\right).

    ``position_m`` (3,): estimate [m]. ``covariance_m2`` (3, 3): covariance of the position, by linearisation [m²].
    ``centroid_m`` (3,): origin of the range [m]. ``interval_m``: 95 % interval of the range [m]; high is None if it is
    open. ``farthest_m``: end of an open interval, at least twice the estimated range [m]. Returns a closed surface.
    """
    centroid, covariance = np.asarray(centroid_m, dtype=np.float64), np.asarray(covariance_m2, dtype=np.float64)
    offset = np.asarray(position_m, dtype=np.float64) - centroid
    r0 = float(np.linalg.norm(offset))
    if not (np.isfinite(offset).all() and np.isfinite(covariance).all() and r0 > 0.0):
        return NOTHING
    low, high = interval_m
    high = max(farthest_m, 2.0 * r0) if high is None else high
    low = max(low, _LEAST_RANGE * min(r0, high))
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
    # The last point of a ring is its centre. The end rings are repeated, so that their edges look sharp.
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
    """Return the 95 % region of a source: an ellipsoid, or a tube for an unobservable range.

    ``position_m`` (3,): estimate [m]. ``covariance`` (k, k): covariance of the position, or of more with the position
    first [m²]. ``centroid_m`` (3,): centroid of the sensors [m]. ``range_interval_m``: see
    :class:`magloc.localization.fit.results.Solution`. ``farthest_m``: end of an open interval [m].
    """
    covariance_m2 = np.asarray(covariance, dtype=np.float64)[:3, :3]
    if range_observable:
        return ellipsoid(position_m, covariance_m2)
    return join_surfaces(
        range_region(position_m, covariance_m2, centroid_m, interval, farthest_m) for interval in range_interval_m
    )


def iso_surface(axis_m: ArrayLike, values: ArrayLike, level: float) -> Surface:
    """Return the closed surface around the points with values up to a level (marching cubes).

    ``axis_m`` (n,): evenly spaced coordinates of the points, the same along all axes [m]. ``values`` (n, n, n):
    positive values; NaN is above every level. ``level``: positive. The surface is half a spacing beyond points at the
    border of the cube. Returns :data:`NOTHING` if no value is low enough.
    """
    with of_extra("view", "a surface"):
        from skimage.measure import marching_cubes

    axis, cube = np.asarray(axis_m, dtype=np.float64), np.asarray(values, dtype=np.float64)
    inside = cube <= level
    if not inside.any():
        return NOTHING
    # The depth has symmetric limits, so that the surface is half way between a point inside and one without a value.
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
    """Return the faces of the rings along a tube, and of two more rings that close its ends."""
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
    """Return right-handed unit axes as rows (3, 3), the last along a vector."""
    with np.errstate(invalid="ignore", divide="ignore"):
        along = vector / np.linalg.norm(vector)
    across = unit_across(along)
    return np.stack([across, np.cross(along, across), along])
