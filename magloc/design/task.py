"""Design tasks: sensors, their volume, sources and criterion.

Built-in tasks are files beside this one. A task file (TOML)::

    format_version = 1              # optional
    name = "half-space-2m"          # optional, of the array too; by default that of the file

    [sensors]
    count = 4
    kind = "vector"                 # or "scalar"
    noise_nT = 1.0                  # 1 sigma, per axis and sample
    ambient_nT = [20e3, 0.0, -45e3] # for scalar sensors
    least_spacing_m = 0.05          # optional, 0 by default

    [volume]                        # allowed positions of the sensors
    shape = "ball"                  # ball, box, cylinder: solid; surface: on a mesh
    radius_m = 0.92                 # for a ball or a cylinder
    height_m = 0.5                  # for a cylinder along z; 0 is a disc
    size_m = [2.0, 1.0, 0.0]        # for a box along the axes; one or two zeros make a plate or a rod
    file = "hull.stl"               # for a surface: STL, OBJ or PLY in metres, beside the task file
    centre_m = [0.0, 0.0, 0.0]      # optional, not for a surface

    [sources]
    region = "half-space"           # shell, half-space, cap or box
    nearest_m = 2.0                 # distances from the origin, evenly distributed; not for a box
    farthest_m = 2.0
    towards = [1.0, 0.0, 0.0]       # axis of a half-space or a cap
    half_angle_deg = 30.0           # for a cap
    low_m = [3.0, -2.0, -2.0]       # corners of a box
    high_m = [5.0, 2.0, 2.0]
    moment_Am2 = 100.0              # modulus; directions are evenly distributed

    [criterion]                     # optional, of the standard deviation of the range (Cramér-Rao bound)
    quantity = "quantile"           # or "mean"
    level = 0.95                    # for a quantile

    [search]                        # optional
    starts = 16                     # shapes and random places
    refined = 4                     # best starts, which descend again on all sources
    sources = 16_384                # a power of two; the starts descend on an eighth of them
    iterations = 250                # at most, of a refined descent; a third of them for the starts
    judged = 40_000                 # independent sources for the comparison
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi, radians
from os import PathLike
from pathlib import Path
from typing import Annotated, Any, cast

import msgspec
import numpy as np

from arrays.array import SensorArray
from arrays.io.errors import InputError
from arrays.io.toml import (
    NOT_NEGATIVE,
    BuiltIn,
    File,
    NotNegative,
    Positive,
    RefusalError,
    Rule,
    Table,
    named_section,
    one_of,
    section_of,
)
from arrays.sensor import Sensor, SensorKind
from arrays.typing import FloatArray, Vector
from magloc.design.regions import Block, Cap, Criterion, Mean, Quantile, Region, around
from magloc.design.volumes import Ball, BoxVolume, Cylinder, Volume, read_surface

N_UNKNOWNS = 6
# Random numbers per source: three for its position, two for the direction of its moment.
N_DRAWN = 5
_ORIGIN = (0.0, 0.0, 0.0)
_LEAST = {"vector": 3, "scalar": 7}
_MOST_SENSORS = 64
_LARGEST = 1e9
_LEAST_LOG2, _MOST_LOG2 = 8, 20
_MOST_OF_ANYTHING = 10_000_000
_FILES = BuiltIn("magloc.design", "tasks", "task")


@dataclass(frozen=True)
class DesignSearch:
    """Effort of a search.

    Attributes
    ----------
    n_starts : int
        Shapes and random places to start from.
    n_refined : int
        Best of them, which descend again on the large sample.
    log2_small, log2_large : int
        Sizes of the samples, as powers of two: scrambled Sobol points.
    small_iterations, large_iterations : int
        Steps of a descent at most.
    n_judged : int
        Number of independent sources of the comparison.
    """

    n_starts: int = 16
    n_refined: int = 4
    log2_small: int = 11
    log2_large: int = 14
    small_iterations: int = 84
    large_iterations: int = 250
    n_judged: int = 40_000

    @property
    def n_steps(self) -> int:
        """Largest number of steps of all descents together."""
        return self.n_starts * self.small_iterations + self.n_refined * self.large_iterations


@dataclass(frozen=True, eq=False)
class DesignTask:
    """Task of a design: sensors, their volume, sources and criterion.

    Attributes
    ----------
    name : str
        Name of the task, and of the array.
    n_sensors : int
    kind : {"vector", "scalar"}
        Scalar sensors need an ambient field.
    noise_T : float
        Noise of every reading [T].
    volume : Volume
        Allowed positions of the sensors.
    region : Region
        Distribution of the sources.
    moment_Am2 : float
        Modulus of their moments, whose directions are evenly distributed.
    criterion : Criterion
        Criterion on the Cramér-Rao bound of the range, the distance from the sensors' centroid.
    ambient_T : tuple, shape (3,), optional
        Uniform ambient field [T].
    least_spacing_m : float
        Least distance of two sensors.
    search : DesignSearch
        Effort of the search.

    Raises
    ------
    ValueError
        The sensors give fewer than six differences, or are scalar without an ambient field.

    Examples
    --------
    >>> import magloc
    >>> task = magloc.DesignTask.read("half-space-2m")
    >>> task.n_sensors, task.kind
    (4, 'vector')
    """

    name: str
    n_sensors: int
    kind: SensorKind
    noise_T: float
    volume: Volume
    region: Region
    moment_Am2: float
    criterion: Criterion
    ambient_T: tuple[float, float, float] | None = None
    least_spacing_m: float = 0.0
    search: DesignSearch = DesignSearch()

    def __post_init__(self) -> None:
        n_differences = (self.n_sensors - 1) * (3 if self.kind == "vector" else 1)
        if n_differences < N_UNKNOWNS:
            least = 1 + N_UNKNOWNS // (3 if self.kind == "vector" else 1)
            raise ValueError(
                f"Input n_sensors must be at least {least} for {self.kind} sensors, whose differences have to give a"
                f" position and a moment; instead received {self.n_sensors}."
            )
        if self.kind == "scalar" and self.ambient_T is None:
            raise ValueError("Input ambient_T must be given for scalar sensors; instead received None.")

    @classmethod
    def read(cls, name_or_path: str | PathLike[str]) -> DesignTask:
        """Read a task: a built-in name, such as "half-space-2m", or a TOML file.

        Raises
        ------
        InputError
            The file cannot be read or does not describe a task; the text says where and why.
        """
        return read_task(str(name_or_path))

    def array(self, positions: FloatArray, name: str | None = None) -> SensorArray:
        """Return the array of the task's sensors at positions (n, 3) [m]."""
        sensors = (
            Sensor(f"s{i}", self.kind, tuple(place), self.noise_T) for i, place in enumerate(positions.tolist(), 1)
        )
        return SensorArray(tuple(sensors), self.name if name is None else name, ambient_T=self.ambient_T)

    def sources(self, cube: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return positions [m] and moments [A·m²], (n, 3), for points (n, 5) of the unit cube."""
        moments = around(np.array([0.0, 0.0, 1.0]), 1.0 - 2.0 * cube[:, 3:4], cube[:, 4:5])
        return self.region.positions(cube[:, :3]), self.moment_Am2 * moments


class _Sensors(Table, kw_only=True):
    count: int
    kind: Annotated[str, one_of(_LEAST)] = "vector"
    noise_nT: Positive = 1.0
    ambient_nT: Vector | None = None
    least_spacing_m: NotNegative = 0.0

    def check(self) -> None:
        least = _LEAST[self.kind]
        if not least <= self.count <= _MOST_SENSORS:
            raise RefusalError(
                "count",
                f"found {self.count}, expected {least} to {_MOST_SENSORS} {self.kind} sensors,"
                " which give the six differences that a position and a moment need",
            )
        if self.kind == "scalar" and not any(self.ambient_nT or ()):
            raise RefusalError("ambient_nT", "found none, expected the ambient field of scalar sensors")


class _Ball(Table, kw_only=True):
    shape: str
    radius_m: Positive
    centre_m: Vector = _ORIGIN

    def volume(self, folder: Path) -> Volume:
        return Ball(self.centre_m, self.radius_m)


class _Box(Table, kw_only=True):
    shape: str
    size_m: Annotated[Vector, NOT_NEGATIVE]
    centre_m: Vector = _ORIGIN

    def volume(self, folder: Path) -> Volume:
        return BoxVolume(self.centre_m, self.size_m)


class _Cylinder(Table, kw_only=True):
    shape: str
    radius_m: NotNegative
    height_m: NotNegative
    centre_m: Vector = _ORIGIN

    def volume(self, folder: Path) -> Volume:
        return Cylinder(self.centre_m, self.radius_m, self.height_m)


class _Surface(Table, kw_only=True):
    shape: str
    file: str

    def volume(self, folder: Path) -> Volume:
        return read_surface(folder / self.file)


class _Shell(Table, kw_only=True):
    region: str
    moment_Am2: Positive
    nearest_m: Positive
    farthest_m: Positive

    def check(self) -> None:
        if not self.nearest_m <= self.farthest_m < _LARGEST:
            expected = f"nearest_m = {self.nearest_m:g} or more"
            raise RefusalError("farthest_m", f"found {self.farthest_m:g}, expected {expected}")

    def sources(self) -> Region:
        return Cap(self.nearest_m, self.farthest_m)


class _HalfSpace(_Shell, kw_only=True):
    towards: Vector

    def check(self) -> None:
        super().check()
        if not any(self.towards):
            raise RefusalError("towards", "found zero, expected a direction")

    def sources(self) -> Region:
        return Cap(self.nearest_m, self.farthest_m, self.towards, 0.5 * pi)


class _Cap(_HalfSpace, kw_only=True):
    half_angle_deg: Annotated[Positive, Rule(lambda value: value <= 180.0, "180 or less")]

    def sources(self) -> Region:
        return Cap(self.nearest_m, self.farthest_m, self.towards, radians(self.half_angle_deg))


class _Block(Table, kw_only=True):
    region: str
    moment_Am2: Positive
    low_m: Vector
    high_m: Vector

    def check(self) -> None:
        if not all(low <= high for low, high in zip(self.low_m, self.high_m, strict=True)):
            raise RefusalError("high_m", "found a number below that of low_m, expected a box")

    def sources(self) -> Region:
        return Block(self.low_m, self.high_m)


_BELOW_ONE = Rule(
    lambda value: 0.0 < value < 1.0,
    "a number between 0 and 1; the worst case, 1, is infinite for four vector sensors",
)


class CriterionTable(Table, kw_only=True):
    """Table of the criterion."""

    quantity: Annotated[str, one_of(("quantile", "mean"), "quantile or mean")] = "quantile"
    level: Annotated[float, _BELOW_ONE] = 0.95

    def criterion(self) -> Criterion:
        """Return the criterion of the table."""
        return Mean() if self.quantity == "mean" else Quantile(self.level)


def at_least(least: int) -> Rule:
    """Return the rule of a large integer with a lower limit."""
    return Rule(lambda value: least <= value <= _MOST_OF_ANYTHING, f"{least} to {_MOST_OF_ANYTHING}")


class StartsTable(Table, kw_only=True):
    """Numbers of starts of a search."""

    starts: int = DesignSearch.n_starts
    refined: int = DesignSearch.n_refined

    def check(self) -> None:
        """Refuse impossible numbers."""
        if not 1 <= self.refined <= self.starts <= 10_000:
            raise RefusalError(
                "",
                f"found {self.refined} refined of {self.starts} starts, expected 1 or more refined, and no more than"
                " starts",
            )


class _Search(StartsTable, kw_only=True):
    sources: int = 2**DesignSearch.log2_large
    iterations: Annotated[int, at_least(1)] = DesignSearch.large_iterations
    judged: Annotated[int, at_least(1000)] = DesignSearch.n_judged

    def check(self) -> None:
        super().check()
        if not (_LEAST_LOG2 <= self.log2 <= _MOST_LOG2 and self.sources == 1 << self.log2):
            expected = f"a power of two from {1 << _LEAST_LOG2} to {1 << _MOST_LOG2}"
            raise RefusalError("sources", f"found {self.sources}, expected {expected}")

    @property
    def log2(self) -> int:
        """Binary logarithm of the number of sources."""
        return self.sources.bit_length() - 1


class _TaskFile(File, kw_only=True):
    sensors: _Sensors
    volume: dict[str, Any]
    sources: dict[str, Any]
    criterion: CriterionTable = msgspec.field(default_factory=CriterionTable)
    search: _Search = msgspec.field(default_factory=_Search)
    name: str | None = None


_VOLUMES: dict[str, Any] = {"ball": _Ball, "box": _Box, "cylinder": _Cylinder, "surface": _Surface}
_REGIONS: dict[str, Any] = {"shell": _Shell, "half-space": _HalfSpace, "cap": _Cap, "box": _Block}


def read_task(name_or_path: str) -> DesignTask:
    """Read a task: see :meth:`magloc.design.task.DesignTask.read`."""
    path, table = _FILES.read(name_or_path)
    file = section_of(path, table, _TaskFile)
    sensors, search = file.sensors, file.search
    ambient = sensors.ambient_nT
    sources = named_section(f"{path}, table sources", file.sources, "region", _REGIONS)
    return DesignTask(
        name=file.name or Path(path).stem,
        n_sensors=sensors.count,
        kind=cast(SensorKind, sensors.kind),
        noise_T=sensors.noise_nT / 1e9,
        volume=volume_of_table(f"{path}, table volume", file.volume, Path(path).parent),
        region=sources.sources(),
        moment_Am2=sources.moment_Am2,
        criterion=file.criterion.criterion(),
        ambient_T=None if ambient is None else (ambient[0] / 1e9, ambient[1] / 1e9, ambient[2] / 1e9),
        least_spacing_m=sensors.least_spacing_m,
        search=DesignSearch(
            n_starts=search.starts,
            n_refined=search.refined,
            log2_small=search.log2 - 3,
            log2_large=search.log2,
            small_iterations=-(-search.iterations // 3),
            large_iterations=search.iterations,
            n_judged=search.judged,
        ),
    )


def volume_of_table(place: str, table: dict[str, Any], folder: Path) -> Volume:
    """Return the volume of a table; `place` is for errors, `folder` that of a mesh."""
    volume: Volume = named_section(place, table, "shape", _VOLUMES).volume(folder)
    reach = float(np.abs(volume.centre).max()) + volume.radius
    if not (volume.radius > 0.0 and reach < _LARGEST):
        raise InputError(f"{place}: found a volume that holds one point only or is too large, expected room to design.")
    return volume
