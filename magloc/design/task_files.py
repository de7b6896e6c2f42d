"""Task files of ``magloc design``, and the built-in ones beside this file.

A task file (TOML)::

    format_version = 1              # optional
    name = "half-space-2m"          # optional, of the array too; by default that of the file

    [sensors]
    count = 4
    kind = "vector"                 # or "scalar"
    noise_nT = 1.0                  # 1 sigma, per axis and sample
    ambient_nT = [20e3, 0.0, -45e3] # of scalar sensors
    least_spacing_m = 0.05          # optional, 0 by default

    [volume]                        # where sensors may stand
    shape = "ball"                  # ball, box, cylinder: solid; surface: on a mesh
    radius_m = 0.92                 # of a ball or a cylinder
    height_m = 0.5                  # of a cylinder, which stands along z; 0 is a disc
    size_m = [2.0, 1.0, 0.0]        # of a box along the axes; one or two zeros make a plate or a rod
    file = "hull.stl"               # of a surface: STL, OBJ or PLY in metres, beside the task file
    centre_m = [0.0, 0.0, 0.0]      # optional, not for a surface

    [sources]
    region = "half-space"           # shell, half-space, cap or box
    nearest_m = 2.0                 # distances from the origin, evenly distributed; not for a box
    farthest_m = 2.0
    towards = [1.0, 0.0, 0.0]       # axis of a half-space or a cap
    half_angle_deg = 30.0           # of a cap
    low_m = [3.0, -2.0, -2.0]       # corners of a box
    high_m = [5.0, 2.0, 2.0]
    moment_Am2 = 100.0              # modulus; directions are evenly distributed

    [criterion]                     # optional, of the standard deviation of the range (Cramér-Rao bound)
    quantity = "quantile"           # or "mean"
    level = 0.95                    # of a quantile

    [search]                        # optional
    starts = 16                     # shapes and random places
    refined = 4                     # of them, which descend again on all sources
    sources = 16_384                # a power of two; the starts descend on an eighth of them
    iterations = 250                # of a descent, at most; a third of them of the starts
    judged = 40_000                 # independent sources that the result is judged on
"""

from __future__ import annotations

from importlib import resources
from math import pi, radians
from pathlib import Path
from typing import Any, ClassVar, cast

import msgspec
import numpy as np

from arrays.io.errors import InputError
from arrays.io.toml import Table, check_keys, converted, read_toml, section_of
from arrays.sensor import SensorKind
from magloc.design.task import Block, Cap, Criterion, DesignSearch, DesignTask, Mean, Quantile, Region
from magloc.design.volumes import Ball, Box, Cylinder, Volume, read_surface

FORMAT_VERSION = 1
_Vector = tuple[float, float, float]
_ORIGIN = (0.0, 0.0, 0.0)
_LEAST = {"vector": 3, "scalar": 7}
_MOST_SENSORS = 64
_LARGEST = 1e9
_LEAST_LOG2, _MOST_LOG2 = 8, 20
_MOST_OF_ANYTHING = 10_000_000


class _Sensors(Table, kw_only=True):
    positive: ClassVar[frozenset[str]] = frozenset({"noise_nT"})
    not_negative: ClassVar[frozenset[str]] = frozenset({"least_spacing_m"})

    count: int
    kind: str = "vector"
    noise_nT: float = 1.0
    ambient_nT: _Vector | None = None
    least_spacing_m: float = 0.0


class _Ball(Table, kw_only=True):
    positive: ClassVar[frozenset[str]] = frozenset({"radius_m"})

    shape: str
    radius_m: float
    centre_m: _Vector = _ORIGIN


class _Box(Table, kw_only=True):
    not_negative: ClassVar[frozenset[str]] = frozenset({"size_m"})

    shape: str
    size_m: _Vector
    centre_m: _Vector = _ORIGIN


class _Cylinder(Table, kw_only=True):
    not_negative: ClassVar[frozenset[str]] = frozenset({"radius_m", "height_m"})

    shape: str
    radius_m: float
    height_m: float
    centre_m: _Vector = _ORIGIN


class _Surface(Table, kw_only=True):
    shape: str
    file: str


class _Shell(Table, kw_only=True):
    positive: ClassVar[frozenset[str]] = frozenset({"nearest_m", "farthest_m", "moment_Am2"})

    region: str
    nearest_m: float
    farthest_m: float
    moment_Am2: float


class _HalfSpace(_Shell, kw_only=True):
    towards: _Vector


class _Cap(_HalfSpace, kw_only=True):
    positive: ClassVar[frozenset[str]] = _Shell.positive | {"half_angle_deg"}

    half_angle_deg: float


class _Block(Table, kw_only=True):
    positive: ClassVar[frozenset[str]] = frozenset({"moment_Am2"})

    region: str
    low_m: _Vector
    high_m: _Vector
    moment_Am2: float


class _Criterion(Table, kw_only=True):
    quantity: str = "quantile"
    level: float = 0.95


class _Search(Table, kw_only=True):
    starts: int = DesignSearch.n_starts
    refined: int = DesignSearch.n_refined
    sources: int = 2**DesignSearch.log2_large
    iterations: int = DesignSearch.large_iterations
    judged: int = DesignSearch.n_judged


class _File(msgspec.Struct, kw_only=True):
    sensors: dict[str, Any]
    volume: dict[str, Any]
    sources: dict[str, Any]
    criterion: dict[str, Any] = msgspec.field(default_factory=dict)
    search: dict[str, Any] = msgspec.field(default_factory=dict)
    name: str | None = None
    format_version: int = FORMAT_VERSION


_VOLUMES: dict[str, type[Table]] = {"ball": _Ball, "box": _Box, "cylinder": _Cylinder, "surface": _Surface}
_REGIONS: dict[str, type[Table]] = {"shell": _Shell, "half-space": _HalfSpace, "cap": _Cap, "box": _Block}


def built_in_tasks() -> tuple[str, ...]:
    """Names of the tasks that come with the package."""
    files = (resources.files("magloc.design") / "tasks").iterdir()
    return tuple(sorted(Path(file.name).stem for file in files if file.name.endswith(".toml")))


def read_task(name_or_path: str) -> DesignTask:
    """Task of a built-in name or a TOML file: :meth:`magloc.design.task.DesignTask.read`."""
    path = name_or_path
    if name_or_path in built_in_tasks():
        path = str(resources.files("magloc.design") / "tasks" / f"{name_or_path}.toml")
    table = read_toml(path, f"a task file, or one of the built-in tasks {', '.join(built_in_tasks())}")
    check_keys(path, table, _File.__struct_fields__)
    file = converted(path, table, _File)
    if file.format_version != FORMAT_VERSION:
        raise InputError(f"{path}, key format_version: found {file.format_version}, expected {FORMAT_VERSION}.")
    sensors = _sensors(f"{path}, table sensors", file.sensors)
    region, moment = _region(f"{path}, table sources", file.sources)
    ambient = sensors.ambient_nT
    return DesignTask(
        name=file.name or Path(path).stem,
        n_sensors=sensors.count,
        kind=cast(SensorKind, sensors.kind),
        noise_T=sensors.noise_nT / 1e9,
        volume=_volume(f"{path}, table volume", file.volume, Path(path).parent),
        region=region,
        moment_Am2=moment,
        criterion=_criterion(f"{path}, table criterion", file.criterion),
        ambient_T=None if ambient is None else (ambient[0] / 1e9, ambient[1] / 1e9, ambient[2] / 1e9),
        least_spacing_m=sensors.least_spacing_m,
        search=_search(f"{path}, table search", file.search),
    )


def _sensors(place: str, table: dict[str, Any]) -> _Sensors:
    sensors = section_of(place, table, _Sensors)
    if sensors.kind not in _LEAST:
        raise InputError(f"{place}, key kind: found {sensors.kind!r}, expected one of {', '.join(_LEAST)}.")
    least = _LEAST[sensors.kind]
    if not least <= sensors.count <= _MOST_SENSORS:
        raise InputError(
            f"{place}, key count: found {sensors.count}, expected {least} to {_MOST_SENSORS} {sensors.kind} sensors,"
            " which give the six differences that a position and a moment take."
        )
    if sensors.kind == "scalar" and not any(sensors.ambient_nT or ()):
        raise InputError(f"{place}, key ambient_nT: found none, expected the ambient field of scalar sensors.")
    return sensors


def _volume(place: str, table: dict[str, Any], folder: Path) -> Volume:
    shape = section_of(place, table, _named(place, table, "shape", _VOLUMES))
    volume: Volume
    if isinstance(shape, _Ball):
        volume = Ball(shape.centre_m, shape.radius_m)
    elif isinstance(shape, _Box):
        volume = Box(shape.centre_m, shape.size_m)
    elif isinstance(shape, _Cylinder):
        volume = Cylinder(shape.centre_m, shape.radius_m, shape.height_m)
    else:
        volume = read_surface(folder / cast(_Surface, shape).file)
    reach = float(np.abs(volume.centre).max()) + volume.radius
    if not (volume.radius > 0.0 and reach < _LARGEST):
        raise InputError(f"{place}: found a volume that holds one point only or is too large, expected room to design.")
    return volume


def _region(place: str, table: dict[str, Any]) -> tuple[Region, float]:
    """Region of the sources, and the modulus of their moments [A·m²]."""
    region = section_of(place, table, _named(place, table, "region", _REGIONS))
    if isinstance(region, _Block):
        if not all(low <= high for low, high in zip(region.low_m, region.high_m, strict=True)):
            raise InputError(f"{place}, key high_m: found a number below that of low_m, expected a box.")
        return Block(region.low_m, region.high_m), region.moment_Am2
    shell = cast(_Shell, region)
    if not shell.nearest_m <= shell.farthest_m < _LARGEST:
        raise InputError(
            f"{place}, key farthest_m: found {shell.farthest_m:g}, expected nearest_m = {shell.nearest_m:g} or more."
        )
    if not isinstance(shell, _HalfSpace):
        return Cap(shell.nearest_m, shell.farthest_m), shell.moment_Am2
    if not any(shell.towards):
        raise InputError(f"{place}, key towards: found zero, expected a direction.")
    half_angle = 0.5 * pi
    if isinstance(shell, _Cap):
        if shell.half_angle_deg > 180.0:
            raise InputError(f"{place}, key half_angle_deg: found {shell.half_angle_deg:g}, expected 180 or less.")
        half_angle = radians(shell.half_angle_deg)
    return Cap(shell.nearest_m, shell.farthest_m, shell.towards, half_angle), shell.moment_Am2


def _criterion(place: str, table: dict[str, Any]) -> Criterion:
    criterion = section_of(place, table, _Criterion)
    if criterion.quantity not in ("quantile", "mean"):
        raise InputError(f"{place}, key quantity: found {criterion.quantity!r}, expected quantile or mean.")
    if not 0.0 < criterion.level < 1.0:
        raise InputError(
            f"{place}, key level: found {criterion.level:g}, expected a number between 0 and 1; the worst case, 1, is"
            " infinite for four vector sensors."
        )
    return Mean() if criterion.quantity == "mean" else Quantile(criterion.level)


def _search(place: str, table: dict[str, Any]) -> DesignSearch:
    search = section_of(place, table, _Search)
    if not 1 <= search.refined <= search.starts <= 10_000:
        raise InputError(
            f"{place}: found {search.refined} refined of {search.starts} starts, expected 1 or more refined, and no"
            " more than starts."
        )
    log2 = search.sources.bit_length() - 1
    if not (_LEAST_LOG2 <= log2 <= _MOST_LOG2 and search.sources == 1 << log2):
        raise InputError(
            f"{place}, key sources: found {search.sources}, expected a power of two from {1 << _LEAST_LOG2} to"
            f" {1 << _MOST_LOG2}."
        )
    for key, least in (("iterations", 1), ("judged", 1000)):
        if not least <= getattr(search, key) <= _MOST_OF_ANYTHING:
            raise InputError(
                f"{place}, key {key}: found {getattr(search, key)}, expected {least} to {_MOST_OF_ANYTHING}."
            )
    return DesignSearch(
        n_starts=search.starts,
        n_refined=search.refined,
        log2_small=log2 - 3,
        log2_large=log2,
        small_iterations=-(-search.iterations // 3),
        large_iterations=search.iterations,
        n_judged=search.judged,
    )


def _named(place: str, table: dict[str, Any], key: str, structs: dict[str, type[Table]]) -> type[Table]:
    """The struct that a table names under a key."""
    if key not in table:
        raise InputError(f"{place}: found no key {key}, expected one of {', '.join(structs)}.")
    name = table[key]
    if not isinstance(name, str) or name not in structs:
        raise InputError(f"{place}, key {key}: found {name!r}, expected one of {', '.join(structs)}.")
    return structs[name]
