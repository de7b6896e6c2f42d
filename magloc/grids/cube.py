"""Common parts of maps over a cube of points, computed box by box.

A map (:class:`CubeMap`) declares its variables and computes the values of any box of its points. Other modules decide
where it is computed (here, or on other machines: :mod:`magloc.grids.cluster`), and where the values go
(:func:`in_memory`, or a store on disk: :mod:`magloc.grids.store`).
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from functools import partial
from importlib.metadata import version
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from arrays.array import SensorArray
from arrays.array_file import array_toml
from arrays.io.closing import delay_signals
from arrays.io.errors import check_positive
from arrays.typing import FloatArray

if TYPE_CHECKING:
    import xarray as xr

Values = Mapping[str, NDArray[Any]]
DIMENSIONS = ("x", "y", "z")
# An interruption discards an unfinished box, and waits for one part of it.
_BOX_S, _PARTS = 1.0, 3
_EDGES = (8, 64)
_COUNTED = 64  # points along the edges of the parts that are counted at once


class Box(NamedTuple):
    """A box of the cube's points.

    Attributes
    ----------
    place : tuple of 3 ints
        Index of the box among the boxes that tile the cube.
    region : tuple of 3 slices
        Indices of its points along x, y, z.
    """

    place: tuple[int, int, int]
    region: tuple[slice, slice, slice]

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of points along x, y, z."""
        x, y, z = (part.stop - part.start for part in self.region)
        return x, y, z

    @property
    def size(self) -> int:
        """Number of points."""
        x, y, z = self.shape
        return x * y * z

    def points(self, axis: FloatArray) -> FloatArray:
        """Return points (n, 3) in the order of the flattened box; the cube's axis is the same along x, y and z."""
        return np.stack(np.meshgrid(*(axis[part] for part in self.region), indexing="ij"), axis=-1).reshape(-1, 3)


class Variable(NamedTuple):
    """Type of one variable of a map, and its CF attributes."""

    dtype: Any
    attributes: Mapping[str, Any]

    @property
    def not_done(self) -> Any:
        """Value of points that are not computed yet: NaN or the smallest integer, which is never a result."""
        return np.nan if np.issubdtype(self.dtype, np.floating) else int(np.iinfo(self.dtype).min)


@dataclass(frozen=True)
class Tally:
    """Counts of a map's values for its summary; the tallies of boxes add up to the cube's.

    Attributes
    ----------
    counts : Counter
        Number of points of every kind, and ``iterations``, the sum over all points.
    iterations_of_converged : Counter
        Number of converged points by their number of iterations.
    """

    counts: Counter[str] = field(default_factory=Counter)
    iterations_of_converged: Counter[int] = field(default_factory=Counter)

    @classmethod
    def of(cls, points: Mapping[str, NDArray[np.bool_]], iterations: NDArray[Any]) -> Tally:
        """Return the tally of masks of the points of every kind, which include "converged"."""
        counts = Counter({name: int(mask.sum()) for name, mask in points.items()})
        counts["iterations"] = int(iterations.sum(dtype=np.int64))
        values, times = np.unique(iterations[points["converged"]], return_counts=True)
        return cls(counts, Counter(dict(zip(values.tolist(), times.tolist(), strict=True))))

    def __add__(self, other: Tally) -> Tally:
        return Tally(self.counts + other.counts, self.iterations_of_converged + other.iterations_of_converged)

    def fraction(self, part: str, whole: str) -> float:
        """Return the share of the points of kind `whole` that are also of kind `part`; NaN if there are none."""
        return self.counts[part] / self.counts[whole] if self.counts[whole] else float("nan")

    def median_iterations(self) -> float:
        """Return the median number of iterations of the converged points; NaN if there are none."""
        if not self.iterations_of_converged:
            return float("nan")
        values, counts = np.array(sorted(self.iterations_of_converged.items())).T
        last_of_value = np.cumsum(counts)
        middle = [(last_of_value[-1] - 1) // 2, last_of_value[-1] // 2]
        return float(values[np.searchsorted(last_of_value, middle, side="right")].mean())


@dataclass(frozen=True)
class Summary:
    """Counts of a whole map.

    Attributes
    ----------
    starts, converged : int
        Number of computed points, and of those that converged.
    fraction : float
        Share of points that converged.
    median_iterations : float
        Median number of iterations of the points that converged; NaN if there are none.
    iterations_total : int
        Number of iterations of all points.
    seconds : float
        Duration of the computation alone, summed over all machines.
    """

    starts: int
    converged: int
    fraction: float
    median_iterations: float
    iterations_total: int
    seconds: float


def common_counts(dataset: xr.Dataset, tally: Tally) -> dict[str, Any]:
    """Return the fields of a :class:`Summary` from a map and its tally of "starts", "converged" and "iterations"."""
    return {
        "starts": tally.counts["starts"],
        "converged": tally.counts["converged"],
        "fraction": tally.fraction("converged", "starts"),
        "median_iterations": tally.median_iterations(),
        "iterations_total": tally.counts["iterations"],
        "seconds": float(dataset.attrs["seconds"]),
    }


def described(title: str, array: SensorArray) -> dict[str, Any]:
    """Return the attributes that every dataset about an array has."""
    source = f"magloc {version('magloc')}"
    return {"Conventions": "CF-1.10", "title": title, "source": source, "array": array_toml(array)}


def flags(statuses: type[IntEnum]) -> dict[str, Any]:
    """Return the CF attributes of a variable that holds a status."""
    values = np.array([status.value for status in statuses], dtype=np.int8)
    return {"flag_values": values, "flag_meanings": " ".join(status.name.lower() for status in statuses)}


@dataclass(frozen=True, eq=False)
class CubeMap(ABC):
    """Map over a cube of points around an array; it is sent to other processes, so its pickle must be small.

    Attributes
    ----------
    scenario
        Scenario with an ``array``, and the ``half_width_m`` of the cube.
    grid : int
        Number of points along every axis, at least 2.
    title, point : str
        Title of the map, and the noun for a point.
    variables : mapping
        Variables over the cube; at least one has integers.
    """

    scenario: Any
    grid: int

    title: ClassVar[str]
    point: ClassVar[str] = "source"
    variables: ClassVar[Mapping[str, Variable]]

    def __post_init__(self) -> None:
        if self.grid < 2:
            raise ValueError(f"Input grid must be at least 2; instead received {self.grid}.")

    @property
    def edge(self) -> int:
        """Number of points along the edges of a box, which takes about a second."""
        smallest, largest = _EDGES
        return min(max(smallest, int(np.cbrt(_BOX_S / self.point_s))), largest)

    @property
    def axis(self) -> FloatArray:
        """Coordinates [m] along every axis, shape (grid,)."""
        return np.linspace(-self.scenario.half_width_m, self.scenario.half_width_m, self.grid)

    @property
    def attributes(self) -> dict[str, Any]:
        """Attributes that determine the values: two maps with equal attributes are the same."""
        cube = {"grid": self.grid, "half_width_m": self.scenario.half_width_m}
        return {**described(self.title, self.scenario.array), **cube, **self.settings}

    @property
    def findings(self) -> Mapping[str, Any]:
        """Further attributes, which follow from the others."""
        return {"centroid_m": self.scenario.array.centroid}

    def values(self, box: Box) -> Values:
        """Return the values of every variable in the shape of the box.

        They depend neither on the choice of boxes nor on the number of threads.
        """
        flat = self.values_at(box)
        return {
            name: np.asarray(flat[name]).reshape(box.shape).astype(variable.dtype, copy=False)
            for name, variable in self.variables.items()
        }

    @property
    @abstractmethod
    def point_s(self) -> float:
        """Approximate time of one core for a slow point [s]."""

    @property
    @abstractmethod
    def settings(self) -> Mapping[str, Any]:
        """Settings that determine the values, apart from the array and the cube."""

    @abstractmethod
    def values_at(self, box: Box) -> Mapping[str, Any]:
        """Return the values of every variable at the points of a box, in their order."""


class Chunk(NamedTuple):
    """Values of one box, and the duration of their computation."""

    box: Box
    values: Values
    seconds: float


def boxes(cube: CubeMap) -> Iterator[Box]:
    """Yield the boxes that tile a cube."""
    return tiles(cube.grid, cube.edge)


def tiles(grid: int, edge: int) -> Iterator[Box]:
    """Yield boxes with `edge` points along their edges that tile a cube."""
    parts = [slice(i, min(i + edge, grid)) for i in range(0, grid, edge)]
    n = len(parts)
    for i, j, k in np.ndindex(n, n, n):
        yield Box((i, j, k), (parts[i], parts[j], parts[k]))


def computed(cube: CubeMap, box: Box) -> Chunk:
    """Compute the values of one box and measure the time; Ctrl-C waits for a part of the box."""
    began = time.perf_counter()
    x, y, z = box.region
    layers = -(-(x.stop - x.start) // _PARTS)
    parts: list[Values] = []
    for begin in range(x.start, x.stop, layers):
        with delay_signals():
            parts.append(cube.values(Box(box.place, (slice(begin, min(begin + layers, x.stop)), y, z))))
    values = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return Chunk(box, values, time.perf_counter() - began)


def coordinates(cube: CubeMap) -> dict[str, tuple[FloatArray, dict[str, str]]]:
    """Return the coordinates of a cube's points along every dimension, with CF attributes."""
    return {
        name: (cube.axis, {"long_name": f"{cube.point} {name}, array frame", "units": "m", "axis": name.upper()})
        for name in DIMENSIONS
    }


def check_half_width(edge_m: float) -> float:
    """Return half of a cube's edge; raise ValueError for an invalid edge."""
    check_positive(edge_m=edge_m)
    return 0.5 * edge_m


def tallied(dataset: xr.Dataset, names: Sequence[str], tally: Callable[[Values], Tally]) -> Tally:
    """Tally some variables of a map part by part, so that the map need not fit into memory."""
    total = Tally()
    for box in tiles(dataset.sizes[DIMENSIONS[0]], _COUNTED):
        part = dataset[list(names)].isel(dict(zip(DIMENSIONS, box.region, strict=True)))
        total += tally({name: part[name].to_numpy() for name in names})
    return total


def in_memory(
    cube: CubeMap, progress: Callable[[int], None] | None = None, chunks: Iterable[Chunk] | None = None
) -> xr.Dataset:
    """Return all values of a map over (x, y, z), from chunks or computed here, with attributes and ``seconds``."""
    import xarray as xr

    shape = (cube.grid,) * 3
    whole = {name: np.full(shape, variable.not_done, variable.dtype) for name, variable in cube.variables.items()}
    seconds = 0.0
    for chunk in map(partial(computed, cube), boxes(cube)) if chunks is None else chunks:
        for name, values in chunk.values.items():
            whole[name][chunk.box.region] = values
        seconds += chunk.seconds
        if progress is not None:
            progress(chunk.box.size)
    return xr.Dataset(
        {name: (DIMENSIONS, whole[name], dict(variable.attributes)) for name, variable in cube.variables.items()},
        coords={name: (name, axis, attributes) for name, (axis, attributes) in coordinates(cube).items()},
        attrs={**cube.attributes, **cube.findings, "seconds": seconds},
    )
