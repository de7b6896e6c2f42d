"""Scenario files of maps, and the built-in scenarios."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import msgspec

from arrays.array import SensorArray
from arrays.array_file import array_of_table, read_array
from arrays.io.errors import InputError, naming
from arrays.io.toml import POSITIVE, BuiltIn, File, NotNegative, RefusalError, Rule, Table, in_si, one_of, section_of
from arrays.typing import Vector
from magloc.convergence.filters import FILTERS, Filter, settings
from magloc.convergence.over_sources import SourcesScenario
from magloc.convergence.over_starts import StartsScenario

_FILES = BuiltIn("magloc.convergence", "scenarios", "scenario")
built_in_scenarios = _FILES.names
_SENSIBLE = Rule(lambda value: 1e-12 <= value <= 1e12, "a number between 1e-12 and 1e12")
_Positive = Annotated[float, POSITIVE, _SENSIBLE]


class _Source(Table, kw_only=True):
    is_inline = True

    position_m: Vector
    moment_Am2: Vector

    def check(self) -> None:
        if not any(self.moment_Am2):
            raise RefusalError("moment_Am2", "found zero, expected a moment")
        for key, value in (
            ("position_m", 1.0 + max(map(abs, self.position_m))),
            ("moment_Am2", max(map(abs, self.moment_Am2))),
        ):
            if not _SENSIBLE.holds(value):
                raise RefusalError(key, f"found {value:g}, expected {_SENSIBLE.expected}")


class _Sources(Table, kw_only=True):
    is_inline = True

    half_width_m: _Positive = SourcesScenario.half_width_m
    nearest_m: float = SourcesScenario.nearest_m
    farthest_m: _Positive = SourcesScenario.farthest_m
    moment_Am2: _Positive = SourcesScenario.moment_Am2
    known_moment_sigma_Am2: _Positive | None = None
    body_length_m: NotNegative | None = None

    def check(self) -> None:
        if not 0.0 <= self.nearest_m < self.farthest_m:
            expected = f"zero or more, and less than farthest_m = {self.farthest_m:g}"
            raise RefusalError("nearest_m", f"found {self.nearest_m:g}, expected {expected}")


class _ScenarioFile(File, kw_only=True):
    array: dict[str, Any] | str
    source: _Source | None = None
    sources: _Sources = msgspec.field(default_factory=_Sources)
    method: Annotated[str, one_of(FILTERS)] = "repeated"
    half_width_m: _Positive = StartsScenario.half_width_m


def _table_of(method: Filter) -> type[msgspec.Struct]:
    """Return the table of a filter: its fields, tolerances in nT."""
    fields = [
        (_key(name), Annotated[type(value), POSITIVE, _SENSIBLE] if not isinstance(value, bool) else bool, value)
        for name, value in settings(method).items()
    ]
    inline = {"is_inline": True}
    return msgspec.defstruct(f"_{type(method).__name__}", fields, bases=(Table,), namespace=inline, kw_only=True)


def _key(name: str) -> str:
    return f"{name.removesuffix('_T')}_nT" if name.endswith("_T") else name


_FileWithFilters: Any = msgspec.defstruct(
    "_FileWithFilters",
    [
        (name, table, msgspec.field(default_factory=table))
        for name, table in ((name, _table_of(method)) for name, method in FILTERS.items())
    ],
    bases=(_ScenarioFile,),
    kw_only=True,
)


def read_starts_scenario(
    name_or_path: str, *, method: str | None = None, noise_seed: int | None = None
) -> StartsScenario:
    """Read the scenario of a map over starts: a built-in name or a TOML file.

    `method` and `noise_seed` replace those of the file.
    """
    path, table, file = _read(name_or_path)
    chosen = file.method if method is None else method
    if chosen not in FILTERS:
        raise InputError(f"{path}, key method: found {chosen!r}, expected one of {', '.join(FILTERS)}.")
    if file.source is None:
        raise InputError(f"{path}: found no key source, expected one.")
    return StartsScenario(
        array=_array(path, file.array),
        position_m=file.source.position_m,
        moment_Am2=file.source.moment_Am2,
        half_width_m=file.half_width_m,
        method=_filter(FILTERS[chosen], getattr(file, chosen), table.get(chosen, {})),
        noise_seed=noise_seed,
    )


def read_sources_scenario(name_or_path: str, *, seed: int = 0) -> SourcesScenario:
    """Read the scenario of a map over sources: array, and table ``sources`` if there is one."""
    path, _, file = _read(name_or_path)
    given = {key: value for key in _Sources.__struct_fields__ if (value := getattr(file.sources, key)) is not None}
    with naming(path):
        return SourcesScenario(array=_array(path, file.array), seed=seed, **given)


def _read(name_or_path: str) -> tuple[str, dict[str, Any], Any]:
    """Return path, table and checked values of a scenario file."""
    path, table = _FILES.read(name_or_path)
    return path, table, section_of(path, table, _FileWithFilters)


def _filter(default: Filter, table: Any, given: dict[str, Any]) -> Filter:
    """Return a filter with the settings of its table."""
    values = {}
    for key in given:
        name, exponent = in_si(key)
        value = getattr(table, key)
        values[name] = value / 10.0**exponent if exponent else value
    return replace(default, **values)  # type: ignore[type-var]


def _array(path: str, array: dict[str, Any] | str) -> SensorArray:
    if isinstance(array, str):
        return read_array(Path(path).parent / array)
    return array_of_table(f"{path}, table array", array)
