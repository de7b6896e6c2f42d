"""Ground below a survey: a plane, or a surface of heights on a grid."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.interpolate import LinearNDInterpolator
from scipy.ndimage import distance_transform_edt, map_coordinates, spline_filter
from scipy.spatial import KDTree

from arrays.typing import FloatArray
from magloc.readings import Readings

_MOST_NODES = 1_000_000
_MOST_MISSING = 2.0  # nodes of a grid per known one
_RIM = 8  # nodes beyond the edges, so that a slope goes on there
_OFF_NODE = 1e-3  # of the grid's step
_LEAST_UNKNOWN = 1e-6  # weight of nodes without a height
_NODES_PER_SPACING = 2.0  # of the data between which a cubic spline through the nodes interpolates


@dataclass(frozen=True, eq=False)
class Terrain:
    """Height of the ground in the world frame: a plane by default, or a cubic spline through the nodes of a grid.

    Beyond its edges the surface continues with the height of the nearest node.

    Attributes
    ----------
    height_m : float
        Height of the plane, or the median height of the surface [m].
    relief_m : ndarray, shape (nx, ny), optional
        Heights of the nodes above ``height_m``; x increases along the first axis, y along the second one.
    corner_m : tuple of 2 floats
        x and y of the first node.
    cell_m : float
        Distance between nodes.
    name : str
        Source of the heights.
    sigma_m : float
        Standard deviation of the heights below the sensors; intervals of depths include it.

    Raises
    ------
    ValueError
        ``sigma_m`` is negative or not finite.

    Examples
    --------
    >>> import magloc
    >>> hill = magloc.Terrain.from_points([[0, 0, 0], [10, 0, 0], [0, 10, 2], [10, 10, 2]])
    >>> hill.height_at([[5.0, 2.5], [5.0, 10.0]]).round(3).tolist()
    [0.5, 2.0]
    """

    height_m: float = 0.0
    relief_m: FloatArray | None = None
    corner_m: tuple[float, float] = (0.0, 0.0)
    cell_m: float = 1.0
    name: str = ""
    sigma_m: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.sigma_m < math.inf:
            raise ValueError(f"Input sigma_m must be zero or a positive number; instead received {self.sigma_m}.")

    @classmethod
    def from_points(cls, place_m: FloatArray, name: str = "") -> Terrain:
        """Return the surface through points (n, 3): smooth if they form a grid, otherwise linear between neighbours.

        Raises
        ------
        ValueError
            There are fewer than three points, or all lie on one line.
        """
        place_m = np.asarray(place_m, dtype=np.float64)
        xy = place_m[:, :2]
        return cls.sample(interpolate_points(place_m), xy.min(axis=0), xy.max(axis=0), point_spacing(xy), name)

    @classmethod
    def sample(
        cls,
        heights: Callable[[FloatArray], FloatArray],
        low_m: FloatArray,
        high_m: FloatArray,
        spacing_m: float,
        name: str = "",
    ) -> Terrain:
        """Return the surface of a function of places (n, 2) in a rectangle; NaN becomes the nearest height.

        ``spacing_m``: distance between the points that the function interpolates.
        """
        cell_m = max(spacing_m / _NODES_PER_SPACING, math.sqrt(float(np.prod(high_m - low_m)) / _MOST_NODES))
        axes = [
            low + cell_m * np.arange(math.ceil(high / cell_m - low / cell_m) + 1)
            for low, high in zip(low_m, high_m, strict=True)
        ]
        nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        values = _fill(heights(nodes.reshape(-1, 2)).reshape(nodes.shape[:2]))
        middle = float(np.median(values))
        return cls(middle, values - middle, (float(low_m[0]), float(low_m[1])), cell_m, name)

    @cached_property
    def _spline(self) -> FloatArray:
        assert self.relief_m is not None
        return _spline_coefficients(self.relief_m)

    @property
    def is_flat(self) -> bool:
        """True for a plane."""
        return self.relief_m is None

    def relief_at(self, xy_m: FloatArray) -> FloatArray:
        """Return heights above ``height_m`` at places (..., 2)."""
        xy_m = np.asarray(xy_m, dtype=np.float64)
        if self.relief_m is None:
            return np.zeros(xy_m.shape[:-1])
        last = np.array(self.relief_m.shape) - 1
        nodes = np.clip((xy_m - self.corner_m) / self.cell_m, 0, last).reshape(-1, 2).T
        return _evaluate(self._spline, nodes).reshape(xy_m.shape[:-1])

    def height_at(self, xy_m: FloatArray) -> FloatArray:
        """Return heights at places (..., 2)."""
        return self.height_m + self.relief_at(xy_m)

    def slope_at(self, xy_m: FloatArray) -> FloatArray:
        """Return the derivatives of the height by x and y (..., 2), as differences over two cells."""
        steps = self.cell_m * np.eye(2)
        rises = [self.relief_at(xy_m + step) - self.relief_at(xy_m - step) for step in steps]
        return np.stack(rises, axis=-1) / (2.0 * self.cell_m)

    def flatten(self, place_m: FloatArray) -> FloatArray:
        """Return places (..., 3) with heights minus the relief: there the ground is the plane at ``height_m``."""
        return self._shift(place_m, -1.0)

    def drape(self, place_m: FloatArray) -> FloatArray:
        """Return places (..., 3) with the relief added to their heights, the inverse of :meth:`flatten`."""
        return self._shift(place_m, 1.0)

    def _shift(self, place_m: FloatArray, sign: float) -> FloatArray:
        if self.relief_m is None:
            return place_m
        relief = sign * self.relief_at(place_m[..., :2])
        return np.concatenate([place_m[..., :2], (place_m[..., 2] + relief)[..., None]], axis=-1)

    def depth_of(self, place_m: FloatArray) -> FloatArray:
        """Return depths of places (..., 3) below the ground."""
        return np.asarray(self.height_m - self.flatten(place_m)[..., 2])

    def raise_by(self, height_m: float) -> Terrain:
        """Return the terrain with all heights raised."""
        return replace(self, height_m=self.height_m + height_m)

    def place_above(self, readings: Readings) -> Readings:
        """Return readings whose heights are above the ground with their heights in the world frame."""
        place = readings.array_position_m
        if place is None:
            return readings
        return replace(readings, array_position_m=self.drape(place + np.array([0.0, 0.0, self.height_m])))

    def crop(self, low_m: FloatArray, high_m: FloatArray) -> Terrain:
        """Return the part of the surface that determines heights in a rectangle."""
        if self.relief_m is None:
            return self
        nodes = (np.stack([low_m, high_m]) - self.corner_m) / self.cell_m
        last = np.array(self.relief_m.shape) - 1
        first, end = np.clip([np.floor(nodes[0]), np.ceil(nodes[1])], 0, last).astype(np.intp)
        corner = np.array(self.corner_m) + self.cell_m * first
        part = self.relief_m[first[0] : end[0] + 1, first[1] : end[1] + 1]
        return replace(self, relief_m=part.copy(), corner_m=(float(corner[0]), float(corner[1])))


FLAT = Terrain()
"""Ground at a height of zero in the world frame."""


def interpolate_points(place_m: FloatArray) -> Callable[[FloatArray], FloatArray]:
    """Return a function of places (n, 2) that gives the height, NaN outside points (m, 3).

    It is a cubic spline if the points form a grid along the axes, otherwise linear between neighbours.
    """
    if len(place_m) < 3 or np.linalg.matrix_rank(place_m[:, :2] - place_m[:, :2].mean(axis=0), rtol=1e-9) < 2:
        received = f"{len(place_m)} on one line"
        raise ValueError(f"Input terrain must have points that cover an area; instead received {received}.")
    first, xy = place_m[:, :2].min(axis=0), place_m[:, :2]
    step = np.array([np.median(np.diff(np.unique(axis))) for axis in xy.T])
    node = np.round((xy - first) / step).astype(np.intp)
    shape = tuple((node.max(axis=0) + 1).tolist())
    if math.prod(shape) > _MOST_MISSING * len(xy) or (np.abs(xy - first - step * node) > _OFF_NODE * step).any():
        between = LinearNDInterpolator(xy, place_m[:, 2])
        return lambda at: np.asarray(between(at))
    values = np.full(shape, np.nan)
    values[tuple(node.T)] = place_m[:, 2]
    heights = interpolate_nodes(values)
    return lambda at: heights(((at - first) / step).T)


def interpolate_nodes(values: FloatArray) -> Callable[[FloatArray], FloatArray]:
    """Return a function of indices (2, n): a cubic spline through the nodes, NaN next to nodes without a value."""
    unknown = np.isnan(values).astype(np.float64)
    spline = _spline_coefficients(_fill(values))

    def at_indices(at: FloatArray) -> FloatArray:
        found = _evaluate(spline, at)
        found[map_coordinates(unknown, at, order=1, mode="constant", cval=1.0) > _LEAST_UNKNOWN] = np.nan
        return found

    return at_indices


def _spline_coefficients(values: FloatArray) -> FloatArray:
    """Return the coefficients of a cubic spline through nodes, which continues straight beyond its edges."""
    return np.asarray(spline_filter(np.pad(values, _RIM, mode="reflect", reflect_type="odd"), mode="mirror"))


def _evaluate(spline: FloatArray, at: FloatArray) -> FloatArray:
    """Return the values (n,) of a spline at indices (2, n) of its nodes."""
    return np.asarray(map_coordinates(spline, at + _RIM, mode="mirror", prefilter=False))


def _fill(values: FloatArray) -> FloatArray:
    """Return values (nx, ny) with the nearest one instead of NaN."""
    nearest = distance_transform_edt(np.isnan(values), return_distances=False, return_indices=True)
    return np.asarray(values[tuple(nearest)])


def point_spacing(xy_m: FloatArray) -> float:
    """Return the usual distance of points (n, 2) from their nearest neighbours."""
    apart = np.asarray(KDTree(xy_m).query(xy_m, 2)[0])
    return float(np.median(apart[:, 1]))
