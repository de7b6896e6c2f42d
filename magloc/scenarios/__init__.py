"""Scenario files of convergence maps, and the built-in ones beside this file."""

from __future__ import annotations

from importlib import resources
from pathlib import Path
from typing import Any

import msgspec

from arrays.errors import InputError
from arrays.files import array_of_table, read_array
from arrays.sensor import SensorArray
from arrays.toml import check_keys, converted, read_toml
from magloc.convergence import Filter, IekfFilter, RepeatedFilter, StartsScenario

FORMAT_VERSION = 1
METHODS = ("repeated", "iekf")

_Vector = tuple[float, float, float]


class _Source(msgspec.Struct, kw_only=True):
    position_m: _Vector
    moment_Am2: _Vector


class _Repeated(msgspec.Struct, kw_only=True):
    position_step_m: float = RepeatedFilter.position_step_m
    moment_step_Am2: float = RepeatedFilter.moment_step_Am2
    noise_inflation: float = RepeatedFilter.noise_inflation
    relinearise_every_scalar: bool = RepeatedFilter.relinearise_every_scalar
    tolerance_nT: float = RepeatedFilter.tolerance_T * 1e9
    max_iterations: int = RepeatedFilter.max_iterations


class _Iekf(msgspec.Struct, kw_only=True):
    position_sigma_m: float = IekfFilter.position_sigma_m
    moment_sigma_Am2: float = IekfFilter.moment_sigma_Am2
    tolerance_nT: float = IekfFilter.tolerance_T * 1e9
    max_iterations: int = IekfFilter.max_iterations


class _File(msgspec.Struct, kw_only=True):
    array: dict[str, Any] | str
    source: _Source
    format_version: int = FORMAT_VERSION
    method: str = "repeated"
    half_width_m: float = StartsScenario.half_width_m
    repeated: _Repeated = msgspec.field(default_factory=_Repeated)
    iekf: _Iekf = msgspec.field(default_factory=_Iekf)


def built_in_scenarios() -> tuple[str, ...]:
    """Names of the scenarios that come with the package."""
    files = resources.files(__name__).iterdir()
    return tuple(sorted(Path(file.name).stem for file in files if file.name.endswith(".toml")))


def read_starts_scenario(
    name_or_path: str, *, method: str | None = None, noise_seed: int | None = None
) -> StartsScenario:
    """Scenario of a convergence map over starts.

    Parameters
    ----------
    name_or_path : str
        A built-in scenario's name, or a TOML file; ``paper.toml`` beside this module documents every key.
    method : str, optional
        In place of the file's method: "repeated" or "iekf".
    noise_seed : int, optional
        See :class:`magloc.convergence.StartsScenario`.

    Returns
    -------
    StartsScenario

    Raises
    ------
    InputError
        The file cannot be read or does not describe a scenario; the text says where and why.
    """
    path = name_or_path
    if name_or_path in built_in_scenarios():
        path = str(resources.files(__name__) / f"{name_or_path}.toml")
    expected = f"a scenario file, or one of the built-in scenarios {', '.join(built_in_scenarios())}"
    table = read_toml(path, expected)
    check_keys(path, table, _File.__struct_fields__)
    for key, struct in (("source", _Source), ("repeated", _Repeated), ("iekf", _Iekf)):
        if isinstance(table.get(key), dict):
            check_keys(path, table[key], struct.__struct_fields__, within=f"{key}.")
    file = converted(path, table, _File)
    if file.format_version != FORMAT_VERSION:
        raise InputError(f"{path}, key format_version: found {file.format_version}, expected {FORMAT_VERSION}.")
    filters: dict[str, Filter] = {"repeated": _repeated(file.repeated), "iekf": _iekf(file.iekf)}
    chosen = file.method if method is None else method
    if chosen not in filters:
        raise InputError(f"{path}, key method: found {chosen!r}, expected one of {', '.join(filters)}.")
    _check_positive(path, "half_width_m", file.half_width_m)
    for section in (file.repeated, file.iekf):
        for key in section.__struct_fields__:
            if key != "relinearise_every_scalar":
                _check_positive(path, f"{type(section).__name__.strip('_').lower()}.{key}", getattr(section, key))
    if not any(file.source.moment_Am2):
        raise InputError(f"{path}, key source.moment_Am2: found zero, expected a moment.")
    return StartsScenario(
        array=_array(path, file.array),
        position_m=file.source.position_m,
        moment_Am2=file.source.moment_Am2,
        half_width_m=file.half_width_m,
        method=filters[chosen],
        noise_seed=noise_seed,
    )


def _repeated(table: _Repeated) -> RepeatedFilter:
    return RepeatedFilter(
        position_step_m=table.position_step_m,
        moment_step_Am2=table.moment_step_Am2,
        noise_inflation=table.noise_inflation,
        relinearise_every_scalar=table.relinearise_every_scalar,
        tolerance_T=table.tolerance_nT / 1e9,
        max_iterations=table.max_iterations,
    )


def _iekf(table: _Iekf) -> IekfFilter:
    return IekfFilter(
        position_sigma_m=table.position_sigma_m,
        moment_sigma_Am2=table.moment_sigma_Am2,
        tolerance_T=table.tolerance_nT / 1e9,
        max_iterations=table.max_iterations,
    )


def _array(path: str, array: dict[str, Any] | str) -> SensorArray:
    if isinstance(array, str):
        return read_array(Path(path).parent / array)
    return array_of_table(f"{path}, table array", array)


def _check_positive(path: str, key: str, value: float) -> None:
    if not 0.0 < value < float("inf"):
        raise InputError(f"{path}, key {key}: found {value:g}, expected a positive number.")
