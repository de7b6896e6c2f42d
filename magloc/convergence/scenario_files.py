"""Scenario files of maps, and the built-in ones beside this file."""

from __future__ import annotations

from dataclasses import fields, replace
from importlib import resources
from pathlib import Path
from typing import Any

import msgspec

from arrays.array import SensorArray
from arrays.array_file import array_of_table, read_array
from arrays.io.errors import InputError
from arrays.io.toml import check_keys, converted, read_toml
from magloc.convergence.filters import FILTERS, Filter
from magloc.convergence.over_sources import SourcesScenario
from magloc.convergence.over_starts import StartsScenario

FORMAT_VERSION = 1
_Vector = tuple[float, float, float]


class _Source(msgspec.Struct, kw_only=True):
    position_m: _Vector
    moment_Am2: _Vector


class _Sources(msgspec.Struct, kw_only=True):
    half_width_m: float = SourcesScenario.half_width_m
    nearest_m: float = SourcesScenario.nearest_m
    farthest_m: float = SourcesScenario.farthest_m
    moment_Am2: float = SourcesScenario.moment_Am2


class _File(msgspec.Struct, kw_only=True):
    array: dict[str, Any] | str
    source: _Source | None = None
    sources: _Sources = msgspec.field(default_factory=_Sources)
    format_version: int = FORMAT_VERSION
    method: str = "repeated"
    half_width_m: float = StartsScenario.half_width_m


def _table_of(method: Filter) -> type[msgspec.Struct]:
    """The table of a filter: its fields, tolerances in nT."""
    return msgspec.defstruct(
        f"_{type(method).__name__}",
        [(_key(name), type(value), value) for name, value in vars(method).items()],
        kw_only=True,
    )


def _key(name: str) -> str:
    return f"{name.removesuffix('_T')}_nT" if name.endswith("_T") else name


_FILTER_TABLES = {name: _table_of(method) for name, method in FILTERS.items()}
_FileWithFilters: Any = msgspec.defstruct(
    "_FileWithFilters",
    [(name, table, msgspec.field(default_factory=table)) for name, table in _FILTER_TABLES.items()],
    bases=(_File,),
    kw_only=True,
)


def built_in_scenarios() -> tuple[str, ...]:
    """Names of the scenarios that come with the package."""
    files = (resources.files("magloc.convergence") / "scenarios").iterdir()
    return tuple(sorted(Path(file.name).stem for file in files if file.name.endswith(".toml")))


def read_starts_scenario(
    name_or_path: str, *, method: str | None = None, noise_seed: int | None = None
) -> StartsScenario:
    """Scenario of a map over starts.

    Parameters
    ----------
    name_or_path : str
        A built-in scenario's name, or a TOML file; ``paper.toml`` beside this module documents every key.
    method : str, optional
        In place of the file's method: a key of :data:`magloc.convergence.filters.FILTERS`.
    noise_seed : int, optional
        See :class:`magloc.convergence.over_starts.StartsScenario`.

    Returns
    -------
    StartsScenario

    Raises
    ------
    InputError
        The file cannot be read or does not describe a scenario; the text says where and why.
    """
    path, table, file = _read(name_or_path)
    chosen = file.method if method is None else method
    if chosen not in FILTERS:
        raise InputError(f"{path}, key method: found {chosen!r}, expected one of {', '.join(FILTERS)}.")
    _check_positive(path, "half_width_m", file.half_width_m)
    if file.source is None:
        raise InputError(f"{path}: found no key source, expected one.")
    _check_positive(path, "source.position_m", 1.0 + max(map(abs, file.source.position_m)))
    if not any(file.source.moment_Am2):
        raise InputError(f"{path}, key source.moment_Am2: found zero, expected a moment.")
    _check_positive(path, "source.moment_Am2", max(map(abs, file.source.moment_Am2)))
    return StartsScenario(
        array=_array(path, file.array),
        position_m=file.source.position_m,
        moment_Am2=file.source.moment_Am2,
        half_width_m=file.half_width_m,
        method=_filter(FILTERS[chosen], getattr(file, chosen), table.get(chosen, {})),
        noise_seed=noise_seed,
    )


def read_sources_scenario(name_or_path: str, *, seed: int = 0) -> SourcesScenario:
    """Scenario of a map over sources: a scenario file's array, and its table ``sources`` if it has one.

    Parameters
    ----------
    name_or_path : str
        As for :func:`read_starts_scenario`.
    seed : int
        See :class:`magloc.convergence.over_sources.SourcesScenario`.

    Returns
    -------
    SourcesScenario

    Raises
    ------
    InputError
        As for :func:`read_starts_scenario`.
    """
    path, _, file = _read(name_or_path)
    sources = file.sources
    for key in ("half_width_m", "farthest_m", "moment_Am2"):
        _check_positive(path, f"sources.{key}", getattr(sources, key))
    if not 0.0 <= sources.nearest_m < sources.farthest_m:
        raise InputError(
            f"{path}, key sources.nearest_m: found {sources.nearest_m:g}, "
            f"expected zero or more, and less than farthest_m = {sources.farthest_m:g}."
        )
    return SourcesScenario(
        array=_array(path, file.array),
        half_width_m=sources.half_width_m,
        nearest_m=sources.nearest_m,
        farthest_m=sources.farthest_m,
        moment_Am2=sources.moment_Am2,
        seed=seed,
    )


def _read(name_or_path: str) -> tuple[str, dict[str, Any], Any]:
    """Path, table and checked types of a scenario file."""
    path = name_or_path
    if name_or_path in built_in_scenarios():
        path = str(resources.files("magloc.convergence") / "scenarios" / f"{name_or_path}.toml")
    expected = f"a scenario file, or one of the built-in scenarios {', '.join(built_in_scenarios())}"
    table = read_toml(path, expected)
    check_keys(path, table, _FileWithFilters.__struct_fields__)
    tables: dict[str, type[msgspec.Struct]] = {"source": _Source, "sources": _Sources, **_FILTER_TABLES}
    for key, struct in tables.items():
        if isinstance(table.get(key), dict):
            check_keys(path, table[key], struct.__struct_fields__, within=f"{key}.")
    file = converted(path, table, _FileWithFilters)
    if file.format_version != FORMAT_VERSION:
        raise InputError(f"{path}, key format_version: found {file.format_version}, expected {FORMAT_VERSION}.")
    for name, struct in _FILTER_TABLES.items():
        for key in struct.__struct_fields__:
            value = getattr(getattr(file, name), key)
            if not isinstance(value, bool):
                _check_positive(path, f"{name}.{key}", value)
    return path, table, file


def _filter(default: Filter, table: Any, given: dict[str, Any]) -> Filter:
    """A filter with the settings that its table gives."""
    values = {}
    for name in (field.name for field in fields(default)):  # type: ignore[arg-type]
        if _key(name) in given:
            value = getattr(table, _key(name))
            values[name] = value / 1e9 if name.endswith("_T") else value
    return replace(default, **values)  # type: ignore[type-var]


def _array(path: str, array: dict[str, Any] | str) -> SensorArray:
    if isinstance(array, str):
        return read_array(Path(path).parent / array)
    return array_of_table(f"{path}, table array", array)


def _check_positive(path: str, key: str, value: float) -> None:
    if not 0.0 < value < float("inf"):
        raise InputError(f"{path}, key {key}: found {value:g}, expected a positive number.")
    if not 1e-12 <= value <= 1e12:
        raise InputError(f"{path}, key {key}: found {value:g}, expected a number between 1e-12 and 1e12.")
