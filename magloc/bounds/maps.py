"""Maps of Cramér-Rao bounds: where around an array, and how far from it, can a source be told how well?

One source is put everywhere: with a moment that is given, and with a moment of that size in every direction. Every
bound comes as four variables, ``sigma_range`` for the given moment, and over the directions its ``_median``, the value
``_q95`` that 95 % of them stay below, and the ``_worst`` of those sampled (that of all may be infinite: see
:mod:`magloc.bounds.crlb`).

Three maps: a cube around the array (:class:`BoundMap`, box by box, so that its memory does not grow with it), planes
through its centroid, and spheres about it with the reach in every direction.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from functools import cached_property
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from arrays.array import SensorArray
from arrays.geometries import tetrahedron
from arrays.typing import FloatArray
from magloc.bounds.over_moments import moment_directions, table_and_spreads
from magloc.grids.cube import Box, MapSummary, Tally, Values, Variable, in_memory

if TYPE_CHECKING:
    import xarray as xr


CASES_IN_WORDS = {
    "": "for the given moment",
    "_median": "median over the directions of the moment",
    "_q95": "95 % quantile over the directions of the moment",
    "_worst": "worst of the sampled directions of the moment",
}
"""What each ending of the variables stands for."""
CASES = tuple(CASES_IN_WORDS)
"""Endings of the variables: the given moment, and the statistics over the directions of the moment."""
ANGLES = ("elevation", "azimuth")
"""Dimensions of a sphere."""
PLANES = ("xy", "xz", "yz")
_UNITS = {"range": "m", "bearing": "rad", "position": "m"}
_EDGE = 32
# Distances, in circumradii, at which the reach is looked for before it is refined, and their ratio.
_NEAREST, _STEP = 1.1, 1.12
_FARTHEST = 1e6
_REFINEMENTS = 2
_ALL_DONE = 8  # distances without a single direction in reach, after which no farther ones are tried


class Reached(IntEnum):
    """For which moments the range is as accurate as required."""

    UNDEFINED = -1
    FEW = 0
    HALF = 1
    MOST = 2
    ALL_SAMPLED = 3


@dataclass(frozen=True)
class BoundScenario:
    """An array, and the source that it is to see.

    Attributes
    ----------
    array : SensorArray
        Of any sensors.
    moment_Am2 : tuple of 3 floats
        Moment of the source; its size is that of the moments of other directions, too.
    half_width_m : float
        The cube and the planes reach from -half_width to +half_width along every axis, around the array's centroid.
    accuracy_m : float
        Required σ of the range.
    n_moments : int
        Directions of the moment.
    ambient_uncertainty_T : float
        See :func:`magloc.bounds.crlb.bounds_of`.

    Raises
    ------
    ValueError
        A length is not positive, the moment is zero, or there are no directions.
    """

    array: SensorArray = field(default_factory=lambda: tetrahedron(1.5, noise_T=1e-9))
    moment_Am2: tuple[float, float, float] = (100.0, 0.0, 0.0)
    half_width_m: float = 20.0
    accuracy_m: float = 0.5
    n_moments: int = 50
    ambient_uncertainty_T: float = 0.0

    def __post_init__(self) -> None:
        for name in ("half_width_m", "accuracy_m"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise ValueError(f"Input {name} must be positive; instead received {getattr(self, name)}.")
        if np.shape(self.moment_Am2) != (3,) or not 0.0 < np.linalg.norm(self.moment_Am2) < np.inf:
            raise ValueError(f"Input moment_Am2 must be 3 numbers, not all zero; instead received {self.moment_Am2}.")
        if self.n_moments < 1:
            raise ValueError(f"Input n_moments must be at least 1; instead received {self.n_moments}.")

    @cached_property
    def moments_Am2(self) -> FloatArray:
        """Moments of the given size in every direction, shape (n_moments, 3)."""
        return float(np.linalg.norm(self.moment_Am2)) * moment_directions(self.array, self.n_moments)

    @property
    def attributes(self) -> dict[str, Any]:
        """What determines the bounds, for a dataset."""
        from arrays.array_file import array_toml

        return {
            "Conventions": "CF-1.10",
            "title": "Cramer-Rao bounds of a magnetic dipole",
            "source": f"magloc {version('magloc')}",
            "array": array_toml(self.array),
            "moment_Am2": np.asarray(self.moment_Am2, dtype=np.float64),
            "n_moments": self.n_moments,
            "accuracy_m": self.accuracy_m,
            "ambient_uncertainty_nT": 1e9 * self.ambient_uncertainty_T,
        }


def bounds_at(scenario: BoundScenario, positions_m: ArrayLike) -> dict[str, FloatArray]:
    """All bounds of a map.

    Parameters
    ----------
    scenario : BoundScenario
    positions_m : array_like, shape (..., 3)
        In the array's frame [m].

    Returns
    -------
    dict
        ``sigma_range``, ``sigma_bearing``, ``sigma_position`` with each of :data:`CASES`, shape (...) [m or rad].
    """
    positions = np.asarray(positions_m, dtype=np.float64)
    flat = positions.reshape(-1, 3)
    given, spreads = table_and_spreads(
        scenario.array,
        flat,
        [scenario.moment_Am2],
        scenario.moments_Am2,
        ambient_uncertainty_T=scenario.ambient_uncertainty_T,
    )
    values = {}
    for name, one, spread in zip(_UNITS, given, spreads, strict=True):
        for case, sigma in zip(CASES, (one[:, 0], spread.median, spread.q95, spread.worst), strict=True):
            values[f"sigma_{name}{case}"] = sigma.reshape(positions.shape[:-1])
    return values


@dataclass(frozen=True)
class BoundMapSummary(MapSummary):
    """Counts of a cube, which knows neither halves nor iterations.

    ``starts`` are the points that have a bound, ``converged`` those with the required accuracy for 95 % of the moments.
    """


@dataclass(frozen=True, eq=False)
class BoundMap:
    """Bounds over a cube of sources, as :class:`magloc.grids.cube.CubeMap`.

    Raises
    ------
    ValueError
        The grid is less than 2.
    """

    scenario: BoundScenario
    grid: int

    def __post_init__(self) -> None:
        if self.grid < 2:
            raise ValueError(f"Input grid must be at least 2; instead received {self.grid}.")

    @property
    def edge(self) -> int:
        """Points along the edges of a box."""
        return _EDGE

    @property
    def axis(self) -> FloatArray:
        """Coordinates of the sources relative to the array's centroid [m], shape (grid,)."""
        return np.linspace(-self.scenario.half_width_m, self.scenario.half_width_m, self.grid)

    @property
    def point(self) -> str:
        """What a point is."""
        return "source"

    @property
    def variables(self) -> Mapping[str, Variable]:
        """Variables over the cube."""
        return _VARIABLES

    @property
    def attributes(self) -> Mapping[str, Any]:
        """All that determines the map."""
        return {**self.scenario.attributes, "grid": self.grid, "half_width_m": self.scenario.half_width_m}

    @property
    def findings(self) -> Mapping[str, Any]:
        """Where the cube is."""
        return {"centroid_m": self.scenario.array.centroid}

    def warm_up(self) -> None:
        """Compile, or load what was compiled."""
        array = self.scenario.array
        bounds_at(self.scenario, array.centroid + 3.0 * array.circumradius * np.eye(3)[:1])

    def values(self, box: Box) -> Values:
        """Bounds of the sources of a box."""
        sigma = bounds_at(self.scenario, self.scenario.array.centroid + box.points(self.axis))
        values = {**sigma, "reached": _reached(sigma, self.scenario.accuracy_m)}
        return {name: values[name].reshape(box.shape).astype(_VARIABLES[name].dtype) for name in _VARIABLES}

    def tally(self, values: Values) -> Tally:
        """Counts of a part's values."""
        reached = values["reached"]
        counts = {"points": reached != Reached.UNDEFINED, "accurate": reached >= Reached.MOST}
        return Tally(Counter({name: int(mask.sum()) for name, mask in counts.items()}))

    def summary(self, tally: Tally, seconds: float) -> BoundMapSummary:
        """Summary of the whole cube."""
        return BoundMapSummary(
            starts=tally.counts["points"],
            converged=tally.counts["accurate"],
            fraction=tally.fraction("accurate", "points"),
            front_fraction=float("nan"),
            back_fraction=float("nan"),
            median_iterations=float("nan"),
            iterations_total=0,
            seconds=seconds,
        )


def bound_map(scenario: BoundScenario, grid: int = 41, progress: Callable[[int], None] | None = None) -> xr.Dataset:
    """Bounds of sources in a cube around the array.

    Parameters
    ----------
    scenario : BoundScenario
    grid : int
        Sources along every axis, at least 2. For maps that do not fit into memory see :mod:`magloc.grids.store`.
    progress : callable, optional
        Called with the number of sources finished since the last call.

    Returns
    -------
    xarray.Dataset
        Over the source's (x, y, z) relative to the centroid [m]: the variables of :func:`bounds_at`, and ``reached``:
        for which moments σ of the range is as small as required.

    Raises
    ------
    ValueError
        The grid is less than 2.
    """
    return in_memory(BoundMap(scenario, grid), progress)


def bound_slices(scenario: BoundScenario, grid: int = 121) -> xr.Dataset:
    """Bounds on the planes xy, xz and yz through the array's centroid.

    Parameters
    ----------
    scenario : BoundScenario
    grid : int
        Points along either axis, at least 2.

    Returns
    -------
    xarray.Dataset
        Over (plane, up, across) with the axes of :data:`PLANES`, across first, relative to the centroid [m].

    Raises
    ------
    ValueError
        The grid is less than 2.
    """
    import xarray as xr

    if grid < 2:
        raise ValueError(f"Input grid must be at least 2; instead received {grid}.")
    axis = np.linspace(-scenario.half_width_m, scenario.half_width_m, grid)
    up, across = np.meshgrid(axis, axis, indexing="ij")
    places = np.zeros((len(PLANES), grid, grid, 3))
    for place, plane in zip(places, PLANES, strict=True):
        place[..., "xyz".index(plane[0])] = across
        place[..., "xyz".index(plane[1])] = up
    values = bounds_at(scenario, scenario.array.centroid + places)
    dimensions = ("plane", "up", "across")
    return xr.Dataset(
        {name: (dimensions, sigma, dict(_VARIABLES[name].attributes)) for name, sigma in values.items()},
        coords={
            "plane": ("plane", list(PLANES), {"long_name": "axes of the plane, across and up"}),
            "across": ("across", axis, {"long_name": "first axis, from the centroid", "units": "m"}),
            "up": ("up", axis, {"long_name": "second axis, from the centroid", "units": "m"}),
        },
        attrs={**scenario.attributes, "centroid_m": scenario.array.centroid},
    )


def bound_spheres(scenario: BoundScenario, ranges_m: Sequence[float], step_deg: float = 5.0) -> xr.Dataset:
    """Bounds on spheres about the array's centroid, and the reach in every direction.

    Parameters
    ----------
    scenario : BoundScenario
    ranges_m : sequence of float
        Radii of the spheres [m].
    step_deg : float
        Between directions along either angle, a part of 90.

    Returns
    -------
    xarray.Dataset
        Over (range, elevation, azimuth) the variables of :func:`bounds_at`; over (elevation, azimuth) the reach
        ``accuracy_range`` with each of :data:`CASES`, see :func:`accuracy_ranges`. Azimuth counts from +x to +y,
        elevation from the x-y plane to +z.

    Raises
    ------
    ValueError
        A range is not positive, or 90 is no multiple of the step.
    """
    import xarray as xr

    ranges = np.asarray(ranges_m, dtype=np.float64)
    if ranges.ndim != 1 or not np.all((ranges > 0.0) & np.isfinite(ranges)):
        raise ValueError(f"Input ranges_m must be positive numbers; instead received {list(ranges_m)}.")
    n = round(90.0 / step_deg) if step_deg > 0.0 else 0
    if n < 1 or abs(n * step_deg - 90.0) > 1e-9:
        raise ValueError(f"Input step_deg must divide 90; instead received {step_deg}.")
    elevation, azimuth = np.linspace(-90.0, 90.0, 2 * n + 1), np.linspace(-180.0, 180.0, 4 * n + 1)
    directions = sphere_grid(elevation, azimuth)
    sphere = bounds_at(scenario, scenario.array.centroid + ranges[:, None, None, None] * directions)
    reach = accuracy_ranges(scenario, directions.reshape(-1, 3))
    return xr.Dataset(
        {name: (("range", *ANGLES), sigma, dict(_VARIABLES[name].attributes)) for name, sigma in sphere.items()}
        | {
            f"accuracy_range{case}": (ANGLES, reach[:, i].reshape(directions.shape[:-1]), _reach_attributes(case))
            for i, case in enumerate(CASES)
        },
        coords={
            "range": ("range", ranges, {"long_name": "distance from the centroid", "units": "m"}),
            "elevation": ("elevation", elevation, {"long_name": "from the x-y plane to +z", "units": "degree"}),
            "azimuth": ("azimuth", azimuth, {"long_name": "from +x to +y", "units": "degree"}),
        },
        attrs={**scenario.attributes, "centroid_m": scenario.array.centroid},
    )


def accuracy_ranges(scenario: BoundScenario, directions: ArrayLike) -> FloatArray:
    """Reach in some directions: the largest distance at which σ of the range is as small as required.

    It is looked for at distances from 1.1 circumradii on, each 12 % more than the one before, and interpolated to a
    part in 10⁴; what happens between two of them that are both in reach is not seen.

    Parameters
    ----------
    scenario : BoundScenario
    directions : array_like, shape (D, 3)
        Unit vectors from the centroid.

    Returns
    -------
    ndarray, shape (D, 4)
        For each of :data:`CASES` [m]; 0 where no distance will do.
    """
    directions = np.asarray(directions, dtype=np.float64)
    centroid, nearest = scenario.array.centroid, _NEAREST * scenario.array.circumradius

    def excess(distance_m: FloatArray) -> FloatArray:
        """Logarithm of σ over what is required, shape (D, 4): far away straight over that of the distance."""
        sigma = bounds_at(scenario, centroid + distance_m[:, None] * directions)
        of_cases = np.stack([sigma[f"sigma_range{case}"] for case in CASES], axis=-1)
        return np.log(of_cases / scenario.accuracy_m)

    shape = (len(directions), len(CASES))
    low, at_low, high, at_high = np.zeros(shape), np.zeros(shape), np.full(shape, nearest), np.full(shape, np.inf)
    distance, before, misses = nearest, np.zeros(shape, dtype=np.bool_), 0
    while misses < _ALL_DONE and distance < _FARTHEST * nearest:
        value = excess(np.full(len(directions), distance))
        inside = value <= 0.0
        leaves = before & ~inside
        low, at_low = np.where(inside, distance, low), np.where(inside, value, at_low)
        high, at_high = np.where(leaves, distance, high), np.where(leaves, value, at_high)
        misses = 0 if inside.any() else misses + 1
        before, distance = inside, distance * _STEP
    for _ in range(_REFINEMENTS):
        middle = _crossing(low, at_low, high, at_high)
        value = np.stack([excess(np.maximum(middle[:, i], nearest))[:, i] for i in range(len(CASES))], axis=-1)
        inside = value <= 0.0
        low, at_low = np.where(inside, middle, low), np.where(inside, value, at_low)
        high, at_high = np.where(inside, high, middle), np.where(inside, at_high, value)
    return _crossing(low, at_low, high, at_high)


def _crossing(low: FloatArray, at_low: FloatArray, high: FloatArray, at_high: FloatArray) -> FloatArray:
    """Where a line through both ends, over the logarithm of the distance, is zero; zero where low is."""
    present = low > 0.0
    rise = np.where(present, at_high - at_low, 1.0)
    share = np.where(np.isfinite(rise) & (rise > 0.0), -at_low / np.where(rise > 0.0, rise, 1.0), 0.0)
    ratio = np.where(present, high, 1.0) / np.where(present, low, 1.0)
    result: FloatArray = low * ratio ** np.clip(share, 0.0, 1.0)
    return result


def sphere_grid(elevation_deg: FloatArray, azimuth_deg: FloatArray) -> FloatArray:
    """Unit vectors (elevations, azimuths, 3) of angles [°]."""
    e, a = np.meshgrid(np.radians(elevation_deg), np.radians(azimuth_deg), indexing="ij")
    return np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=-1)


def _reached(sigma: Mapping[str, FloatArray], accuracy_m: float) -> Any:
    undefined = np.isnan(sigma["sigma_range"])
    count = sum((sigma[f"sigma_range{case}"] <= accuracy_m).astype(np.int8) for case in CASES[1:])
    return np.where(undefined, Reached.UNDEFINED, count)


def _reach_attributes(case: str) -> dict[str, str]:
    return {
        "long_name": f"largest distance with the required accuracy of the range, {CASES_IN_WORDS[case]}",
        "units": "m",
    }


_VARIABLES: dict[str, Variable] = {
    f"sigma_{name}{case}": Variable(
        np.float64,
        {"long_name": f"Cramer-Rao bound of the {name}, standard deviation, {CASES_IN_WORDS[case]}", "units": unit},
    )
    for name, unit in _UNITS.items()
    for case in CASES
} | {
    "reached": Variable(
        np.int8,
        {
            "long_name": "for which directions of the moment the range is as accurate as required",
            "flag_values": np.array([s.value for s in Reached], dtype=np.int8),
            "flag_meanings": " ".join(s.name.lower() for s in Reached),
        },
    )
}
