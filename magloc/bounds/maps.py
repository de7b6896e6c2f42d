"""Maps of Cramér-Rao bounds: accuracy of a source at places around an array.

The places are a cube around the array (:class:`BoundMap`), or planes through its centroid; for spheres see
:mod:`magloc.bounds.spheres`. Every bound has four variables: ``sigma_range`` is for the given moment; ``_median``,
``_q95`` (95 % quantile) and ``_worst`` are over sampled directions of a moment of that size. The worst of all
directions may be infinite: docs/theory/cramer-rao-bounds.md.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from functools import cached_property
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from arrays.array import SensorArray
from arrays.geometries import tetrahedron
from arrays.io.errors import check_positive
from arrays.typing import FloatArray
from magloc.bounds.over_moments import sigma_table, spread_over
from magloc.directions import moments_on_sphere
from magloc.fields.multipole import check_body_length
from magloc.grids.computed import computed_map
from magloc.grids.cube import Box, CubeMap, Tally, Values, Variable, check_half_width, described, flags, tallied
from magloc.measurement.rows import check_magnitudes

if TYPE_CHECKING:
    import xarray as xr


CASES_IN_WORDS = {
    "": "for the given moment",
    "_median": "median over the directions of the moment",
    "_q95": "95 % quantile over the directions of the moment",
    "_worst": "worst of the sampled directions of the moment",
}
"""Meaning of each ending of the variables."""
CASES = tuple(CASES_IN_WORDS)
"""Endings of the variables: the given moment, and the statistics over the directions of the moment."""
PLANES = ("xy", "xz", "yz")
_UNITS = {"range": "m", "bearing": "rad", "position": "m"}
_TITLE = "Cramer-Rao bounds of a magnetic dipole"


class AccuracyReach(IntEnum):
    """Cases of the share of moments whose range has the required accuracy."""

    UNDEFINED = -1
    FEW = 0
    HALF = 1
    MOST = 2
    ALL_SAMPLED = 3


@dataclass(frozen=True)
class BoundScenario:
    """An array and a source for maps of bounds.

    Attributes
    ----------
    array : SensorArray
        Array of any sensors.
    moment_Am2 : tuple of 3 floats
        Moment of the source; moments of other directions have the same size.
    half_width_m : float
        The cube and the planes reach from -half_width to +half_width along every axis, around the array's centroid.
    accuracy_m : float
        Required σ of the range.
    n_moments : int
        Directions of the moment.
    ambient_uncertainty_T, known_moment_sigma_Am2 : float
        See :func:`magloc.bounds.crlb.cramer_rao_bounds`.
    body_length_m : float, optional
        Length of the source; by default a quarter of its distance near the array. 0 for a point.

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
    known_moment_sigma_Am2: float = np.inf
    body_length_m: float | None = None

    def __post_init__(self) -> None:
        check_body_length(self.body_length_m)
        check_magnitudes(self.array)
        check_positive(half_width_m=self.half_width_m, accuracy_m=self.accuracy_m)
        if np.shape(self.moment_Am2) != (3,) or not 0.0 < np.linalg.norm(self.moment_Am2) < np.inf:
            raise ValueError(f"Input moment_Am2 must be 3 numbers, not all zero; instead received {self.moment_Am2}.")
        if self.n_moments < 1:
            raise ValueError(f"Input n_moments must be at least 1; instead received {self.n_moments}.")

    @cached_property
    def moments_Am2(self) -> FloatArray:
        """Moments of the given size in every direction, shape (n_moments, 3)."""
        size, half = float(np.linalg.norm(self.moment_Am2)), not self.array.channel_is_scalar.any()
        return moments_on_sphere(size, self.n_moments, half=half)

    @property
    def uncertainties(self) -> dict[str, Any]:
        """Uncertainties apart from the array's, as arguments of bounds."""
        names = ("ambient_uncertainty_T", "known_moment_sigma_Am2", "body_length_m")
        return {name: getattr(self, name) for name in names}

    @property
    def settings(self) -> dict[str, Any]:
        """Settings that determine the bounds apart from the array, for a dataset."""
        known = {"known_moment_sigma_Am2": self.known_moment_sigma_Am2}
        return {
            "moment_Am2": np.asarray(self.moment_Am2, dtype=np.float64),
            "n_moments": self.n_moments,
            "accuracy_m": self.accuracy_m,
            "ambient_uncertainty_nT": 1e9 * self.ambient_uncertainty_T,
            **(known if self.known_moment_sigma_Am2 < np.inf else {}),
            **({} if self.body_length_m is None else {"body_length_m": self.body_length_m}),
        }

    @property
    def attributes(self) -> dict[str, Any]:
        """Attributes of a dataset, with the array."""
        return {**described(_TITLE, self.array), **self.settings}


def bounds_at(scenario: BoundScenario, positions_m: ArrayLike) -> dict[str, FloatArray]:
    """Return σ of range, bearing and position at (..., 3) [m], for each of :data:`CASES`."""
    positions = np.asarray(positions_m, dtype=np.float64)
    moments = np.vstack([scenario.moment_Am2, scenario.moments_Am2])
    table = sigma_table(scenario.array, positions.reshape(-1, 3), moments, **scenario.uncertainties)
    values = {}
    for name, sigma in zip(_UNITS, table, strict=True):
        spread = spread_over(sigma[:, 1:])
        for case, of_case in zip(CASES, (sigma[:, 0], spread.median, spread.q95, spread.worst), strict=True):
            values[f"sigma_{name}{case}"] = of_case.reshape(positions.shape[:-1])
    return values


VARIABLES: dict[str, Variable] = {
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
            **flags(AccuracyReach),
        },
    )
}


@dataclass(frozen=True, eq=False)
class BoundMap(CubeMap):
    """Bounds of a cube of sources."""

    title = _TITLE
    variables = VARIABLES

    scenario: BoundScenario

    @property
    def point_s(self) -> float:
        """Approximate time of one core for a point with all moments [s]."""
        return (1e-5 if self.scenario.body_length_m else 3e-7) * self.scenario.n_moments

    @property
    def settings(self) -> Mapping[str, Any]:
        """Moment, and required accuracy."""
        return self.scenario.settings

    def values_at(self, box: Box) -> Mapping[str, Any]:
        """Return the bounds of the sources of a box."""
        sigma = bounds_at(self.scenario, self.scenario.array.centroid + box.points(self.axis))
        return {**sigma, "reached": _accuracy_reach(sigma, self.scenario.accuracy_m)}


@dataclass(frozen=True)
class BoundsSummary:
    """Counts of a cube of bounds.

    Attributes
    ----------
    points, accurate : int
        Points that have a bound, and those of them with the required accuracy for 95 % of the moments.
    fraction : float
        Share of the latter.
    seconds : float
        Duration of the computation, the sum of all machines.
    """

    points: int
    accurate: int
    fraction: float
    seconds: float


def bound_map(
    array: SensorArray,
    moment_Am2: tuple[float, float, float],
    *,
    edge_m: float = 2.0 * BoundScenario.half_width_m,
    n: int = 41,
    accuracy_m: float = BoundScenario.accuracy_m,
    n_moments: int = BoundScenario.n_moments,
    ambient_uncertainty_T: float = 0.0,
    known_moment_sigma_Am2: float = np.inf,
    body_length_m: float | None = None,
    out: str | PathLike[str] | None = None,
    scheduler: str | None = None,
    progress: Callable[[int], None] | None = None,
) -> xr.Dataset:
    """Compute Cramér-Rao bounds of sources in a cube around an array.

    Parameters
    ----------
    array : SensorArray
        Array with its noise and uncertainties.
    moment_Am2 : tuple of 3 floats
        Moment of the source; moments of other directions have the same size [A·m²].
    edge_m : float
        Edge of the cube, which is centred on the array's centroid [m].
    n : int
        Sources along every axis, at least 2.
    accuracy_m : float
        Required standard deviation of the range [m].
    n_moments : int
        Directions of the moment.
    ambient_uncertainty_T, known_moment_sigma_Am2 : float
        See :func:`magloc.bounds.crlb.cramer_rao_bounds`.
    body_length_m : float, optional
        Length of every source; the deviation of its field from a dipole counts as noise. By default a quarter of its
        distance near the array, as in :func:`magloc.locate`; 0 for points.
    out : path-like, optional
        Folder of a zarr store for the map. Finished parts that it has are not computed again.
    scheduler : str, optional
        Address of a dask scheduler, whose workers compute the map.
    progress : callable, optional
        Called with the number of sources finished since the last call.

    Returns
    -------
    xarray.Dataset
        Dimensions are the source's (x, y, z) relative to the centroid [m]. Variables are as in :func:`bounds_at`,
        and ``reached``: for which moments σ of the range is as small as required.

    Raises
    ------
    ValueError
        An input is out of range.

    Examples
    --------
    >>> import arrays
    >>> import magloc
    >>> array = arrays.tetrahedron(1.5)
    >>> bounds = magloc.bound_map(array, (0.0, 0.0, 100.0), n=5, n_moments=5)
    >>> sorted(bounds.sizes)
    ['x', 'y', 'z']
    """
    mx, my, mz = np.asarray(moment_Am2, dtype=np.float64).tolist()
    half_width_m = check_half_width(edge_m)
    uncertain = (ambient_uncertainty_T, known_moment_sigma_Am2, body_length_m)
    scenario = BoundScenario(array, (mx, my, mz), half_width_m, accuracy_m, n_moments, *uncertain)
    return computed_map(BoundMap(scenario, n), out, scheduler, progress)


def summary(dataset: xr.Dataset) -> BoundsSummary:
    """Return the counts of a map by :func:`bound_map`, which need not fit into memory."""
    tally = tallied(dataset, ("reached",), _tally)
    accurate, points = tally.counts["accurate"], tally.counts["points"]
    return BoundsSummary(points, accurate, tally.fraction("accurate", "points"), float(dataset.attrs["seconds"]))


def _tally(values: Values) -> Tally:
    reached = values["reached"]
    counts = {"points": reached != AccuracyReach.UNDEFINED, "accurate": reached >= AccuracyReach.MOST}
    return Tally(Counter({name: int(mask.sum()) for name, mask in counts.items()}))


def bound_slices(scenario: BoundScenario, grid: int = 121) -> xr.Dataset:
    """Compute bounds on the planes xy, xz and yz through the array's centroid.

    There are `grid` points along either axis.

    Dimensions are (plane, up, across) with the axes of :data:`PLANES`, across first, relative to the centroid [m].
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
        {name: (dimensions, sigma, dict(VARIABLES[name].attributes)) for name, sigma in values.items()},
        coords={
            "plane": ("plane", list(PLANES), {"long_name": "axes of the plane, across and up"}),
            "across": ("across", axis, {"long_name": "first axis, from the centroid", "units": "m"}),
            "up": ("up", axis, {"long_name": "second axis, from the centroid", "units": "m"}),
        },
        attrs={**scenario.attributes, "centroid_m": scenario.array.centroid},
    )


def _accuracy_reach(sigma: Mapping[str, FloatArray], accuracy_m: float) -> Any:
    undefined = np.isnan(sigma["sigma_range"])
    count = sum((sigma[f"sigma_range{case}"] <= accuracy_m).astype(np.int8) for case in CASES[1:])
    return np.where(undefined, AccuracyReach.UNDEFINED, count)
