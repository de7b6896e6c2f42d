"""Scenario files of simulations, and the built-in ones beside this file.

``diver.toml`` documents every key; :mod:`sims.magnetics.scenario_tables` has their types and bounds.
"""

from __future__ import annotations

import datetime
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path as FilePath
from typing import Any

import msgspec
import numpy as np

from arrays.array import SensorArray
from arrays.array_file import array_of_table, read_array
from arrays.io.errors import InputError, naming
from arrays.io.toml import BuiltIn, in_si, named_section, section_of
from magloc.signature.path import PathError
from sims.magnetics.ground import Geology, Targets
from sims.magnetics.paths import Attitude, Path, Steered, Vector
from sims.magnetics.scenario import Carrier, MagneticScenario, Matrix, Missing, Platform, Pulsation, Source
from sims.magnetics.scenario_tables import (
    PATH_TABLES,
    AmbientTable,
    CarrierTable,
    FileTable,
    GeologyTable,
    PlatformTable,
    PulsationTable,
    SensorsTable,
    SourceTable,
)
from sims.magnetics.sensors import SENSOR_KINDS, SensorModel, model_of

_SYMMETRY_RTOL = 1e-9
_QUALITY_KEYS = ("noise_nT", "saturation_nT", "misalignment_mrad", "gain_uncertainty")
_FILES = BuiltIn("sims.magnetics", "scenarios", "scenario")
built_in_scenarios = _FILES.names


def read_scenario(name_or_path: str) -> MagneticScenario:
    """Read a scenario of a simulation.

    ``name_or_path``: a built-in scenario's name, or a TOML file; ``diver.toml`` beside this module documents the
    keys. Raises InputError: the file cannot be read or does not describe a scenario; the text says where and why.
    """
    path, table = _FILES.read(name_or_path)
    file = section_of(path, table, FileTable)
    array, models = _array_and_models(path, file)
    with naming(path):
        return MagneticScenario(
            array=array,
            models=models,
            duration_s=file.duration_s,
            rate_Hz=file.rate_Hz,
            carrier=_carrier(f"{path}, table carrier", file.carrier),
            sources=tuple(_source(f"{path}, source {i}", table) for i, table in enumerate(file.source, start=1)),
            ambient_T=None if file.ambient is None else _ambient(f"{path}, table ambient", file.ambient),
            pulsations=tuple(map(_pulsation, file.pulsation)),
            platform=_platform(file.platform),
            missing=Missing(file.missing.dropout, tuple(file.missing.gaps_s)),
            pose=None if file.pose is None else file.pose.uncertainty(f"{path}, table pose"),
            targets=None if file.targets is None else Targets(**msgspec.structs.asdict(file.targets)),
            geology=None if file.geology is None else _geology(file.geology),
            name=FilePath(path).stem if file.name is None else file.name,
        )


def _array_and_models(path: str, file: FileTable) -> tuple[SensorArray, tuple[SensorModel, ...]]:
    common = file.sensors
    # A sensor's table inherits missing keys from the table of all sensors, unless it is another kind.
    single = {name: own if own.kind is not None else _merged(common, own) for name, own in common.of.items()}
    if isinstance(file.array, str):
        array = read_array(FilePath(path).parent / file.array)
    else:
        table = _complete(f"{path}, table array", file.array, common, single)
        array = array_of_table(f"{path}, table array", table)
    for key in ("ambient_T", "ambient_gradient_T_m"):
        if getattr(array, key) is not None:
            raise InputError(f"{path}, table array: found an ambient field, expected it in the table ambient.")
    for name in single:
        if name not in array.ids:
            expected = f"one of {', '.join(array.ids)}"
            raise InputError(f"{path}, table sensors.of.{name}: found no such sensor, expected {expected}.")
    models = []
    for sensor in array.sensors:
        settings = single.get(sensor.id, common)
        base = model_of(sensor, file.rate_Hz) if settings.kind is None else SENSOR_KINDS[settings.kind]
        models.append(_overridden(base, settings, file.rate_Hz))
    return array, tuple(models)


def _merged(common: SensorsTable, own: SensorsTable) -> SensorsTable:
    values = {key: getattr(own, key) for key in SensorsTable.__struct_fields__ if getattr(own, key) is not None}
    for key, other in (("noise_nT", "noise_nT_rtHz"), ("noise_nT_rtHz", "noise_nT")):
        if key in values:
            values[other] = None
    return msgspec.structs.replace(common, **values)


def _complete(
    place: str, table: dict[str, Any], common: SensorsTable, single: dict[str, SensorsTable]
) -> dict[str, Any]:
    """Add the properties of sensor kinds to an array's table; their models replace the noise later."""
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
                    f"{place}, key {key}: found although the sensors are of the kind {settings.kind}, "
                    "expected only keys that differ from that kind in the table sensors."
                )
        reads = SENSOR_KINDS[settings.kind].reads
        if item.get("kind", reads) != reads:
            raise InputError(
                f"{place}, key kind: found {item['kind']!r}, expected {reads} "
                f"because the sensors are of the kind {settings.kind}, or no such key."
            )
        filled.append({**item, "kind": reads, "noise_nT": 1})
    return {**table, "sensor": filled} if one_by_one else filled[0]


def _overridden(model: SensorModel, settings: SensorsTable, rate_Hz: float) -> SensorModel:
    values = {}
    for key in SensorsTable.__struct_fields__:
        name, exponent = in_si(key)
        if getattr(settings, key) is not None and name in SensorModel.__dataclass_fields__:
            values[name] = getattr(settings, key) / 10.0**exponent
    changed = replace(model, **values)
    return changed if settings.noise_nT is None else changed.with_sigma(settings.noise_nT / 1e9, rate_Hz)


def _carrier(place: str, table: CarrierTable) -> Carrier:
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
    section = named_section(place, table, "kind", PATH_TABLES)
    with naming(place):
        path: Path = section.path()
    return path


def _source(place: str, table: SourceTable) -> Source:
    polarisability = _matrix(f"{place}, key polarisability_m3", table.polarisability_m3)
    if not (any(table.moment_Am2) or np.any(polarisability)):
        raise InputError(f"{place}: found neither moment_Am2 nor polarisability_m3, expected one of them.")
    error = PathError(
        table.path_sigma_m,
        table.path_correlation_s,
        math.radians(table.attitude_sigma_deg),
        table.attitude_correlation_s,
    )
    carrier, radius_m, length_m = _carrier(place, table), table.radius_m, table.body_length_m
    return Source(carrier, table.moment_Am2, polarisability, radius_m, error, table.from_s, table.until_s, length_m)


def _matrix(place: str, value: float | list[float | list[float]]) -> Matrix:
    """Return a symmetric matrix from a number, three numbers or three rows."""
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


def _ambient(place: str, table: AmbientTable) -> Vector:
    if table.place is None:
        return _vector(lambda value: value / 1e9, table.field_nT)
    from magloc.fields.geomagnetic import MODELS, field_enu

    if table.model not in MODELS:
        raise InputError(f"{place}, key model: found {table.model!r}, expected one of {', '.join(MODELS)}.")
    with naming(place):
        date = datetime.datetime.fromisoformat(str(table.date))
        return _vector(float, field_enu(*table.place, date, table.model))


def _pulsation(table: PulsationTable) -> Pulsation:
    norm = math.hypot(*table.direction)
    return Pulsation(_vector(lambda value: value / norm * table.amplitude_nT / 1e9, table.direction), table.period_s)


def _platform(table: PlatformTable) -> Platform:
    return Platform(
        table.position_m, table.moment_Am2, table.frequency_Hz, table.noise_nT / 1e9, table.induced, table.eddy_s
    )


def _geology(table: GeologyTable) -> Geology:
    return Geology(table.field_nT / 1e9, table.shortest_m, table.longest_m)


def _vector(function: Callable[[float], float], values: Any) -> Vector:
    x, y, z = (float(function(value)) for value in values)
    return (x, y, z)
