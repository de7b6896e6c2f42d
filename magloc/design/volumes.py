"""Volumes for the sensors of a design: solid bodies, or the surface of a mesh."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np
from scipy.cluster.vq import kmeans2
from scipy.optimize import brentq
from scipy.spatial import cKDTree
from scipy.spatial.distance import pdist

from arrays.io.errors import InputError, of_extra
from arrays.typing import FloatArray

if TYPE_CHECKING:
    import trimesh

MESH_FORMATS = ("stl", "obj", "ply")
_N_EVEN, _N_EVEN_TRIES, _EVEN_RTOL = 4096, 32, 1e-9


class Volume(Protocol):
    """Set of allowed sensor positions."""

    @property
    def centre(self) -> FloatArray:
        """Centre of the enclosing ball, shape (3,) [m]."""

    @property
    def radius(self) -> float:
        """Radius of the enclosing ball [m]."""

    def nearest(self, points: FloatArray) -> FloatArray:
        """Return the points of the set nearest to points (n, 3) [m]."""

    def random(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Return uniformly distributed points of the set, (n, 3) [m]."""


@dataclass(frozen=True)
class _Solid:
    """Base of solid bodies."""

    centre_m: tuple[float, float, float]

    @property
    def centre(self) -> FloatArray:
        """Centre [m]."""
        return np.array(self.centre_m)


@dataclass(frozen=True)
class Ball(_Solid):
    """A solid ball.

    Attributes
    ----------
    centre_m : tuple, shape (3,)
    """

    radius_m: float

    @property
    def radius(self) -> float:
        """Radius [m]."""
        return self.radius_m

    def nearest(self, points: FloatArray) -> FloatArray:
        """Return the points of the ball nearest to points (n, 3) [m]."""
        offset = points - self.centre
        length = np.linalg.norm(offset, axis=-1, keepdims=True)
        return self.centre + offset * np.minimum(1.0, self.radius_m / np.maximum(length, 1e-300))

    def random(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Return uniformly distributed points (n, 3) [m]."""
        direction = rng.normal(size=(n, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        return self.centre + self.radius_m * np.cbrt(rng.uniform(size=(n, 1))) * direction


@dataclass(frozen=True)
class BoxVolume(_Solid):
    """A solid box along the axes.

    Attributes
    ----------
    centre_m : tuple, shape (3,)
    size_m : tuple, shape (3,)
        Full lengths; a plate has a zero among them.
    """

    size_m: tuple[float, float, float]

    @property
    def radius(self) -> float:
        """Half of the diagonal [m]."""
        return 0.5 * float(np.linalg.norm(self.size_m))

    def nearest(self, points: FloatArray) -> FloatArray:
        """Return the points of the box nearest to points (n, 3) [m]."""
        half = 0.5 * np.array(self.size_m)
        return np.clip(points, self.centre - half, self.centre + half)

    def random(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Return uniformly distributed points (n, 3) [m]."""
        return self.centre + rng.uniform(-0.5, 0.5, (n, 3)) * np.array(self.size_m)


@dataclass(frozen=True)
class Cylinder(_Solid):
    """A solid cylinder along z.

    Attributes
    ----------
    centre_m : tuple, shape (3,)
    radius_m, height_m : float
        A disc has the height zero, a rod the radius zero.
    """

    radius_m: float
    height_m: float

    @property
    def radius(self) -> float:
        """Distance of the rims from the centre [m]."""
        return float(np.hypot(self.radius_m, 0.5 * self.height_m))

    def nearest(self, points: FloatArray) -> FloatArray:
        """Return the points of the cylinder nearest to points (n, 3) [m]."""
        offset = points - self.centre
        across = np.linalg.norm(offset[..., :2], axis=-1, keepdims=True)
        in_plane = offset[..., :2] * np.minimum(1.0, self.radius_m / np.maximum(across, 1e-300))
        height = np.clip(offset[..., 2:], -0.5 * self.height_m, 0.5 * self.height_m)
        return self.centre + np.concatenate([in_plane, height], axis=-1)

    def random(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Return uniformly distributed points (n, 3) [m]."""
        across, angle = self.radius_m * np.sqrt(rng.uniform(size=n)), rng.uniform(0.0, 2.0 * np.pi, n)
        height = self.height_m * rng.uniform(-0.5, 0.5, n)
        return self.centre + np.stack([across * np.cos(angle), across * np.sin(angle), height], axis=1)


@dataclass(frozen=True, eq=False)
class MeshSurface:
    """Surface of a triangle mesh.

    Attributes
    ----------
    mesh : trimesh.Trimesh
        Mesh in metres, in the array's frame.
    """

    mesh: trimesh.Trimesh

    @cached_property
    def _enclosing_ball(self) -> tuple[FloatArray, float]:
        from trimesh import nsphere

        centre, radius = nsphere.minimum_nsphere(self.mesh)  # type: ignore[no-untyped-call]
        return np.asarray(centre, dtype=np.float64), float(radius)

    @property
    def centre(self) -> FloatArray:
        """Centre of the smallest enclosing ball [m]."""
        return self._enclosing_ball[0]

    @property
    def radius(self) -> float:
        """Radius of the smallest enclosing ball [m]."""
        return self._enclosing_ball[1]

    @cached_property
    def _triangles(self) -> tuple[FloatArray, cKDTree, float]:
        """Corners (f, 3, 3), a tree of their centroids, and the largest distance between both."""
        corners = np.asarray(self.mesh.triangles, dtype=np.float64)
        centroids = corners.mean(axis=1)
        largest = np.linalg.norm(corners - centroids[:, None], axis=-1).max()
        return corners, cKDTree(centroids), float(largest)

    def nearest(self, points: FloatArray) -> FloatArray:
        """Return the points of the surface nearest to points (n, 3) [m]."""
        from trimesh import triangles

        corners, tree, largest = self._triangles
        # The nearest triangle's centroid is at most the largest triangle farther than the nearest centroid.
        reach = tree.query(points)[0] + largest
        found = np.empty_like(points)
        for i, faces in enumerate(tree.query_ball_point(points, reach * (1.0 + 1e-9))):
            here = np.tile(points[i], (len(faces), 1))
            on_each = triangles.closest_point(corners[faces], here)  # type: ignore[no-untyped-call]
            found[i] = on_each[np.argmin(np.linalg.norm(on_each - points[i], axis=1))]
        return found

    def random(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Return uniformly distributed points (n, 3) [m]."""
        corners = self._triangles[0]
        area = np.asarray(self.mesh.area_faces)
        a, b, c = np.moveaxis(corners[rng.choice(len(corners), size=n, p=area / area.sum())], 1, 0)
        s, t = np.sqrt(rng.uniform(size=(n, 1))), rng.uniform(size=(n, 1))
        return (1.0 - s) * a + s * (1.0 - t) * b + s * t * c


def read_surface(path: str | PathLike[str]) -> MeshSurface:
    """Read the surface of an STL, OBJ or PLY file with numbers in metres."""
    expected = f"a mesh ({', '.join(MESH_FORMATS).upper()})"
    if Path(path).suffix.lower().lstrip(".") not in MESH_FORMATS:
        raise InputError(f"{path}: found the name of another kind of file, expected {expected}.")
    if not Path(path).is_file():
        raise InputError(f"{path} does not exist, expected {expected}.")
    with of_extra("view", "the surface of a mesh"):
        from trimesh import load_mesh
    try:
        mesh = load_mesh(str(path), process=True)
    except Exception as error:  # every reader raises different errors
        raise InputError(f"{path}: found no mesh ({str(error).rstrip('.')}), expected {expected}.") from None
    faces = np.asarray(getattr(mesh, "faces", ()))
    if not faces.size or not np.isfinite(mesh.triangles).all() or not mesh.area > 0.0:
        raise InputError(f"{path}: found no triangles with an area, expected {expected}.")
    return MeshSurface(mesh)


def even_grid(volume: Volume, n: int, rng: np.random.Generator) -> FloatArray:
    """Return points (n, 3) [m] spread evenly over a volume, out to its rim.

    Candidates are the means of n equal parts (Lloyd's centroidal Voronoi cells, by k-means of random points, the best
    of several), stretched from the centre as far as all stay inside, or moved to the nearest points of a surface. In a
    box the lattices of n points are candidates too. The result is the candidate with the largest least spacing.
    """
    spread = _stretch(volume, _middles(volume.random(_N_EVEN, rng), n, rng))
    lattices = _lattices(volume, n) if isinstance(volume, BoxVolume) else []
    return max([*lattices, spread], key=lambda points: float(pdist(points).min()))


def _middles(points: FloatArray, n: int, rng: np.random.Generator) -> FloatArray:
    """Return means (n, 3) of the parts of points (k, 3) with the least sum of squares."""
    tries = [kmeans2(points, n, minit="++", rng=rng) for _ in range(_N_EVEN_TRIES)]
    middles, _ = min(tries, key=lambda tried: float(np.sum((points - tried[0][tried[1]]) ** 2)))
    return np.asarray(middles)


def _stretch(volume: Volume, points: FloatArray) -> FloatArray:
    """Stretch points (n, 3) from the centre by the largest factor that keeps all inside."""

    def outside(factor: float) -> float:
        moved = volume.centre + factor * (points - volume.centre)
        return float(np.abs(volume.nearest(moved) - moved).max()) - _EVEN_RTOL * volume.radius

    factor = 1.0
    if outside(1.0) < 0.0:
        most = volume.radius / float(np.linalg.norm(points - volume.centre, axis=1).max())
        factor = float(brentq(outside, 1.0, 2.0 * most, xtol=_EVEN_RTOL))
    return volume.nearest(volume.centre + factor * (points - volume.centre))


def _lattices(box: BoxVolume, n: int) -> list[FloatArray]:
    """Return all lattices of n points that reach the faces of a box.

    One layer lies in its middle.
    """
    counts = [(i, j, n // (i * j)) for i in range(1, n + 1) for j in range(1, n // i + 1) if n % (i * j) == 0]
    ends = 0.5 * np.array(box.size_m)
    lattices = []
    for count in counts:
        axes = [np.linspace(-end, end, k) if k > 1 else np.zeros(1) for end, k in zip(ends, count, strict=True)]
        lattices.append(box.centre + np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3))
    return lattices
