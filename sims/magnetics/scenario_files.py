"""Scenario files of simulations, and the built-in ones beside this file.

``diver.toml`` documents every key; :mod:`sims.magnetics.scenario_tables` has their types and bounds.
"""

from __future__ import annotations

import datetime
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from importlib import resources
from pathlib import Path as FilePath
from typing import Any

import msgspec
import numpy as np

from arrays.array import SensorArray
from arrays.array_file import array_of_table, read_array
from arrays.io.errors import InputError
from arrays.io.toml import read_toml, section_of
from sims.magnetics.paths import Attitude, Path, Steered, Vector
from sims.magnetics.scenario import Carrier, MagneticScenario, Matrix, Missing, Platform, Pulsation, Source
from sims.magnetics.scenario_tables import (
    FORMAT_VERSION,
    PATH_TABLES,
    AmbientTable,
    CarrierTable,
    FileTable,
    MissingTable,
    PlatformTable,
    PulsationTable,
    SensorsTable,
    SourceTable,
)
from sims.magnetics.sensors import SENSOR_KINDS, SensorModel, model_of

_UNIT_QUATERNION_ATOL = 1e-6
_SYMMETRY_RTOL = 1e-9
_QUALITY_KEYS = ("noise_nT", "saturation_nT", "misalignment_mrad", "gain_uncertainty")


def built_in_scenarios() -> tuple[str, ...]:
    """Names of the scenarios that come with the package."""
    files = (resources.files("sims.magnetics") / "scenarios").iterdir()
    return tuple(sorted(FilePath(file.name).stem for file in files if file.name.endswith(".toml")))


def read_scenario(name_or_path: str) -> MagneticScenario:
    """Scenario of a simulation.

    Parameters
    ----------
    name_or_path : str
        A built-in scenario's name, or a TOML file; ``diver.toml`` beside this module documents the keys.

    Returns
    -------
    MagneticScenario

    Raises
    ------
    InputError
        The file cannot be read or does not describe a scenario; the text says where and why.
    """
    path = name_or_path
    if name_or_path in built_in_scenarios():
        path = str(resources.files("sims.magnetics") / "scenarios" / f"{name_or_path}.toml")
    expected = f"a scenario file, or one of the built-in scenarios {', '.join(built_in_scenarios())}"
    file = section_of(path, read_toml(path, expected), FileTable)
    if file.format_version != FORMAT_VERSION:
        raise InputError(f"{path}, key format_version: found {file.format_version}, expected {FORMAT_VERSION}.")
    array, models = _array_and_models(path, file)
    with _naming(path):
        return MagneticScenario(
            array=array,
            models=models,
            duration_s=file.duration_s,
            rate_Hz=file.rate_Hz,
            carrier=_carrier(
                f"{path}, table carrier", section_of(f"{path}, table carrier", file.carrier, CarrierTable)
            ),
            sources=tuple(_source(f"{path}, source {i}", table) for i, table in enumerate(file.source, start=1)),
            ambient_T=None if file.ambient is None else _ambient(f"{path}, table ambient", file.ambient),
            pulsations=tuple(
                _pulsation(f"{path}, pulsation {i}", table) for i, table in enumerate(file.pulsation, start=1)
            ),
            platform=_platform(f"{path}, table platform", file.platform),
            missing=_missing(f"{path}, table missing", file.missing),
            name=FilePath(path).stem if file.name is None else file.name,
        )


def _array_and_models(path: str, file: FileTable) -> tuple[SensorArray, tuple[SensorModel, ...]]:
    place = f"{path}, table sensors"
    common = _sensors(place, file.sensors)
    single = {name: _sensors(f"{place}.of.{name}", table) for name, table in common.of.items()}
    # What one sensor's table does not give is that of all sensors, unless it is another kind.
    single = {name: own if own.kind is not None else _merged(common, own) for name, own in single.items()}
    if isinstance(file.array, str):
        array = read_array(FilePath(path).parent / file.array)
    else:
        table = _completed(f"{path}, table array", file.array, common, single)
        array = array_of_table(f"{path}, table array", table)
    for key in ("ambient_T", "ambient_gradient_T_m"):
        if getattr(array, key) is not None:
            raise InputError(f"{path}, table array: found an ambient field, expected it in the table ambient.")
    for name in single:
        if name not in array.ids:
            raise InputError(f"{place}.of.{name}: found no such sensor, expected one of {', '.join(array.ids)}.")
    models = []
    for sensor in array.sensors:
        settings = single.get(sensor.id, common)
        base = model_of(sensor, file.rate_Hz) if settings.kind is None else SENSOR_KINDS[settings.kind]
        models.append(_overridden(base, settings, file.rate_Hz))
    return array, tuple(models)


def _sensors(place: str, table: dict[str, Any]) -> SensorsTable:
    settings = section_of(place, table, SensorsTable)
    if settings.kind is not None and settings.kind not in SENSOR_KINDS:
        raise InputError(f"{place}, key kind: found {settings.kind!r}, expected one of {', '.join(SENSOR_KINDS)}.")
    if settings.noise_nT is not None and settings.noise_nT_rtHz is not None:
        raise InputError(f"{place}, keys noise_nT and noise_nT_rtHz: found both, expected one of them.")
    if settings.gain_error is not None and settings.gain_error >= 1.0:
        raise InputError(f"{place}, key gain_error: found {settings.gain_error:g}, expected a number below 1.")
    if settings.misalignment_mrad is not None and settings.misalignment_mrad >= 1000.0:
        raise InputError(
            f"{place}, key misalignment_mrad: found {settings.misalignment_mrad:g}, expected a number below 1000."
        )
    return settings


def _merged(common: SensorsTable, own: SensorsTable) -> SensorsTable:
    values = {key: getattr(own, key) for key in SensorsTable.__struct_fields__ if getattr(own, key) is not None}
    for key, other in (("noise_nT", "noise_nT_rtHz"), ("noise_nT_rtHz", "noise_nT")):
        if key in values:
            values[other] = None
    return msgspec.structs.replace(common, **values)


def _completed(
    place: str, table: dict[str, Any], common: SensorsTable, single: dict[str, SensorsTable]
) -> dict[str, Any]:
    """An array's table with what the kinds of its sensors say; their models replace the noise later."""
    one_by_one = isinstance(table.get("sensor"), list)
    tables = table["sensor"] if one_by_one else [table]
    filled = []
    for item in tables:
        settings = common
        if isinstance(item, dict):
            settings = single.get(str(item.get("id")), common) if one_by_one else common
        if not isinstance(item, dict) or settings.kind is None:
            filled.append(item)
            continue
        for key in _QUALITY_KEYS:
            if key in item:
                raise InputError(
                    f"{place}, key {key}: found it although the sensors are of the kind {settings.kind}, "
                    "expected what differs from that kind in the table sensors."
                )
        reads = SENSOR_KINDS[settings.kind].reads
        if item.get("kind", reads) != reads:
            raise InputError(
                f"{place}, key kind: found {item['kind']!r}, expected {reads} "
                f"because the sensors are of the kind {settings.kind}, or no such key."
            )
        filled.append({**item, "kind": reads, "noise_nT": 1})
    return {**table, "sensor": filled} if one_by_one else filled[0]


_OVERRIDES: dict[str, tuple[str, float]] = {
    "noise_nT_rtHz": ("noise_T_rtHz", 1e9),
    "corner_Hz": ("corner_Hz", 1.0),
    "bandwidth_Hz": ("bandwidth_Hz", 1.0),
    "range_nT": ("range_T", 1e9),
    "resolution_nT": ("resolution_T", 1e9),
    "misalignment_mrad": ("misalignment_rad", 1e3),
    "gain_error": ("gain_error", 1.0),
    "drift_nT_rth": ("drift_T_rth", 1e9),
    "offset_error_nT": ("offset_error_T", 1e9),
}


def _overridden(model: SensorModel, settings: SensorsTable, rate_Hz: float) -> SensorModel:
    values = {
        name: getattr(settings, key) / unit
        for key, (name, unit) in _OVERRIDES.items()
        if getattr(settings, key) is not None
    }
    changed = replace(model, **values)
    return changed if settings.noise_nT is None else changed.with_sigma(settings.noise_nT / 1e9, rate_Hz)


def _carrier(place: str, table: CarrierTable) -> Carrier:
    if table.attitude not in ("fixed", "course"):
        raise InputError(f"{place}, key attitude: found {table.attitude!r}, expected fixed or course.")
    norm = math.hypot(*table.rotation_xyzw)
    if abs(norm - 1.0) > _UNIT_QUATERNION_ATOL:
        raise InputError(f"{place}, key rotation_xyzw: found a quaternion of norm {norm:.6g}, expected norm 1.")
    period = table.wobble_period_s
    attitude = Attitude(
        follows_course=table.attitude == "course",
        mount_xyzw=table.rotation_xyzw,
        rate_rad_s=_vector(math.radians, table.rate_deg_s),
        wobble_rad=_vector(math.radians, table.wobble_deg),
        wobble_period_s=period if isinstance(period, tuple) else (period, period, period),
    )
    return Carrier(_path(f"{place}.path", table.path), attitude)


def _path(place: str, table: dict[str, Any]) -> Path:
    if not table:
        return Steered()
    kind = table.get("kind")
    if not isinstance(kind, str) or kind not in PATH_TABLES:
        found = "no key kind" if kind is None else f"kind = {kind!r}"
        raise InputError(f"{place}: found {found}, expected one of the kinds {', '.join(PATH_TABLES)}.")
    section = section_of(place, table, PATH_TABLES[kind])
    with _naming(place):
        path: Path = section.path()
    return path


def _source(place: str, table: dict[str, Any]) -> Source:
    section = section_of(place, table, SourceTable)
    polarisability = _matrix(f"{place}, key polarisability_m3", section.polarisability_m3)
    if not (any(section.moment_Am2) or np.any(polarisability)):
        raise InputError(f"{place}: found neither moment_Am2 nor polarisability_m3, expected one of them.")
    return Source(_carrier(place, section), section.moment_Am2, polarisability, section.radius_m)


def _matrix(place: str, value: float | list[float | list[float]]) -> Matrix:
    """A symmetric matrix from a number, three numbers or three rows."""
    try:
        numbers = np.array(value, dtype=np.float64)
    except ValueError:
        numbers = np.empty(0)
    if numbers.shape not in ((), (3,), (3, 3)):
        raise InputError(f"{place}: found {value}, expected a number, 3 numbers or a 3×3 matrix.")
    matrix = numbers if numbers.ndim == 2 else np.diag(np.broadcast_to(numbers, 3))
    if np.abs(matrix - matrix.T).max() > _SYMMETRY_RTOL * np.abs(matrix).max():
        raise InputError(f"{place}: found {value}, expected a symmetric matrix.")
    return _rows(matrix)


def _rows(matrix: np.ndarray[Any, Any]) -> Matrix:
    x, y, z = (_vector(float, row) for row in matrix)
    return (x, y, z)


def _ambient(place: str, table: dict[str, Any]) -> Vector:
    if isinstance(table.get("date"), datetime.date):  # TOML has dates of its own
        table = {**table, "date": table["date"].isoformat()}
    section = section_of(place, table, AmbientTable)
    if (section.field_nT is None) == (section.place is None):
        found = "neither field_nT nor place" if section.place is None else "both field_nT and place"
        raise InputError(f"{place}: found {found}, expected one of them.")
    if section.field_nT is not None:
        return _vector(lambda value: value / 1e9, section.field_nT)
    if section.date is None or section.place is None:
        raise InputError(f"{place}: found no key date, expected one because there is a place.")
    from magloc.fields.geomagnetic import MODELS, field_enu

    if section.model not in MODELS:
        raise InputError(f"{place}, key model: found {section.model!r}, expected one of {', '.join(MODELS)}.")
    try:
        date = datetime.datetime.fromisoformat(section.date)
    except ValueError:
        raise InputError(f"{place}, key date: found {section.date!r}, expected a date such as 2026-11-21.") from None
    with _naming(place):
        return _vector(float, field_enu(*section.place, date, section.model))


def _pulsation(place: str, table: dict[str, Any]) -> Pulsation:
    section = section_of(place, table, PulsationTable)
    norm = math.hypot(*section.direction)
    if norm == 0.0:
        raise InputError(f"{place}, key direction: found zero, expected a direction.")
    return Pulsation(
        _vector(lambda value: value / norm * section.amplitude_nT / 1e9, section.direction), section.period_s
    )


def _platform(place: str, table: dict[str, Any]) -> Platform:
    section = section_of(place, table, PlatformTable)
    return Platform(section.position_m, section.moment_Am2, section.frequency_Hz, section.noise_nT / 1e9)


def _missing(place: str, table: dict[str, Any]) -> Missing:
    section = section_of(place, table, MissingTable)
    if section.dropout >= 1.0:
        raise InputError(f"{place}, key dropout: found {section.dropout:g}, expected a probability below 1.")
    for start, end in section.gaps_s:
        if not start < end:
            raise InputError(f"{place}, key gaps_s: found [{start:g}, {end:g}], expected an end after its start.")
    return Missing(section.dropout, tuple(section.gaps_s))


def _vector(function: Callable[[float], float], values: Any) -> Vector:
    x, y, z = (float(function(value)) for value in values)
    return (x, y, z)


@contextmanager
def _naming(place: str) -> Iterator[None]:
    """Turn what the library refuses into bad input at a place of the file."""
    try:
        yield
    except InputError:
        raise
    except ValueError as error:
        raise InputError(f"{place}: {str(error).removeprefix('Input ').removeprefix('Inputs ')}") from None
