"""The TOML file of an array.

Either a geometry by name (:data:`arrays.geometries.GEOMETRIES`) with its size, or the sensors one by one::

    name = "tetrahedron-1.5"        # optional
    geometry = "tetrahedron"
    edge_m = 1.5
    kind = "vector"                 # or "scalar"
    noise_nT = 1.0
    saturation_nT = 100_000.0       # optional, readings that reach it are no measurements
    misalignment_mrad = 1.0         # optional, unknown small rotation of a vector sensor's axes, 1 sigma per axis
    gain_uncertainty = 0.001        # optional, relative, 1 sigma per axis
    offset_uncertainty_nT = 0.5     # optional, unknown field fixed to the array, 1 sigma per axis
    flicker_nT = 0.01               # optional, 1/f noise: 1 sigma in every decade of frequency
    drift_nT_rth = 0.1              # optional, random walk of the offset: 1 sigma after an hour
    induced_uncertainty = 1e-4      # optional, induced field of the carrier over the ambient field: 1 sigma
    eddy_uncertainty_s = 1e-4       # optional, field of eddy currents over the ambient field's derivative

    [[sensor]]                      # instead of geometry, its size, and the keys from kind to eddy_uncertainty_s
    id = "s1"
    kind = "vector"
    position_m = [0.0, 0.0, 0.918]  # array frame
    rotation_xyzw = [0, 0, 0, 1]    # optional, sensor axes -> array frame; or, in its place,
    ypr_deg = [90.0, 0.0, 0.0]      # yaw, pitch, roll: turns about z, then the new y, then the new x
    noise_nT = 1.0
    saturation_nT = 100_000.0       # this and the following optional, as above
    misalignment_mrad = 1.0
    gain_uncertainty = 0.001
    offset_uncertainty_nT = 0.5
    flicker_nT = 0.01
    drift_nT_rth = 0.1
    induced_uncertainty = 1e-4
    eddy_uncertainty_s = 1e-4
    noise_fraction = 0.01           # optional, instead of the array's
    [sensor.calibration]            # optional, reading = scale · (field in sensor axes) + offset
    scale = 1.0                     # a number, 3 numbers or a 3×3 matrix
    offset_nT = [0.0, 0.0, 0.0]     # one number for a scalar sensor

    [defaults]                      # optional, values for every [[sensor]] without its own
    kind = "vector"                 # any key of a sensor but id, position and calibration
    noise_nT = 1.0

Both may have ``noise_fraction``, ``common_field_nT`` or, in its place, ``background = "subtracted"`` (a background was
subtracted from the readings: :data:`BACKGROUND_CHANGE_T`), ``ambient_nT = [x, y, z]`` or ``ambient_world_nT``, the
gradient of that field ``ambient_gradient_nT_m = [[…], […], […]]`` (symmetric and traceless),
``ambient_uncertainty_nT``, ``ambient_uncertainty_white_nT``, ``format_version = 1``, and the tables ``[pose]`` and
``[columns]``; see :class:`arrays.array.SensorArray` for what they mean.
"""

from __future__ import annotations

import json
import math
from dataclasses import replace
from os import PathLike
from typing import Annotated, Any, ClassVar

import msgspec

from arrays.array import SensorArray
from arrays.columns import ColumnsTable, columns_toml
from arrays.geometries import GEOMETRIES
from arrays.io.errors import InputError, naming
from arrays.io.text import write_text
from arrays.io.toml import (
    FORMAT_VERSION,
    NOT_NEGATIVE,
    POSITIVE,
    File,
    Rule,
    Table,
    check_keys,
    in_si,
    item_place,
    one_of,
    read_toml,
    section_of,
)
from arrays.io.units import Number, nanotesla_text, scaled, shifted_text, tesla
from arrays.pose import PoseTable, pose_toml
from arrays.sensor import Calibration, Sensor
from arrays.typing import Vector

BACKGROUND_CHANGE_T = 3e-7
"""Standard deviation per axis of the common field after a background was subtracted: a hundredth of the Earth's field.

It covers what the field changes within hours and what currents in a building add.
"""
_DEFAULTS, _TURNS = "defaults", ("rotation_xyzw", "ypr_deg")
_NOT_TURNED = (0.0, 0.0, 0.0, 1.0)
_NotNegative = Annotated[Number, NOT_NEGATIVE]
_NumberVector = tuple[Number, Number, Number]
_FIELD_KEYS: tuple[str, ...] = ("common_field_nT", "ambient_nT", "ambient_world_nT", "ambient_gradient_nT_m")
_FIELD_KEYS += ("ambient_uncertainty_nT", "ambient_uncertainty_white_nT")


class _Header(File, kw_only=True):
    floats_may_be_infinite: ClassVar[bool] = True

    name: str | None = None
    noise_fraction: float = 0.0
    common_field_nT: _NotNegative | None = None
    background: Annotated[str, one_of(("subtracted",))] | None = None
    ambient_nT: _NumberVector | None = None
    ambient_world_nT: _NumberVector | None = None
    ambient_gradient_nT_m: tuple[_NumberVector, _NumberVector, _NumberVector] | None = None
    ambient_uncertainty_nT: _NotNegative = 0
    ambient_uncertainty_white_nT: _NotNegative = 0
    pose: PoseTable | None = None
    columns: ColumnsTable | None = None


class _Quality(Table, kw_only=True):
    floats_may_be_infinite: ClassVar[bool] = True

    noise_nT: Annotated[Number, POSITIVE]
    saturation_nT: Annotated[Number, POSITIVE] | None = None
    misalignment_mrad: Annotated[Number, Rule(lambda value: 0 <= value < 1000, "a number from 0 to below 1000")] = 0
    gain_uncertainty: float = 0.0
    offset_uncertainty_nT: _NotNegative = 0
    flicker_nT: _NotNegative = 0
    drift_nT_rth: _NotNegative = 0
    induced_uncertainty: _NotNegative = 0
    eddy_uncertainty_s: _NotNegative = 0


class _GeometryFile(_Header, kw_only=True):
    geometry: str
    kind: str


class _CalibrationTable(Table, kw_only=True):
    is_inline: ClassVar[bool] = True
    floats_may_be_infinite: ClassVar[bool] = True

    scale: float | list[float | list[float]] = 1.0
    offset_nT: Number | list[Number] | None = None


class _SensorTable(_Quality, kw_only=True):
    id: str
    kind: str
    position_m: Vector
    rotation_xyzw: tuple[float, float, float, float] | None = None
    ypr_deg: Vector | None = None
    noise_fraction: Annotated[float, NOT_NEGATIVE] | None = None
    calibration: _CalibrationTable = msgspec.field(default_factory=_CalibrationTable)


class _SensorsFile(_Header, kw_only=True):
    sensor: list[_SensorTable]


def read_array(path: str | PathLike[str]) -> SensorArray:
    """Read an array from its TOML file.

    Parameters
    ----------
    path : str or path-like
        Array file (TOML), with lengths in m and fields in nT.

    Returns
    -------
    SensorArray
        Array; without a name in the file, a geometry has the name of its shape.

    Raises
    ------
    InputError
        The file cannot be read or describes no array; the text states the place and the reason.

    Examples
    --------
    >>> import arrays
    >>> arrays.write_array("array.toml", arrays.square(0.4))
    >>> arrays.read_array("array.toml") == arrays.square(0.4)
    True
    """
    array = read_sensors(path)
    if array.n_sensors < 2 and array.common_field_T is None:
        raise InputError(f"{path}: sensors must be at least 2, or 1 with a common_field_nT; instead received 1.")
    return array


def read_sensors(path: str | PathLike[str]) -> SensorArray:
    """Read an array as :func:`read_array`, or a single sensor, for a calibration.

    Parameters
    ----------
    path : str or path-like
        Array file (TOML).

    Returns
    -------
    SensorArray
        Array of the file, of one sensor or more.

    Examples
    --------
    >>> import arrays
    >>> one = arrays.SensorArray([arrays.Sensor("s1", "vector", (0.0, 0.0, 0.0), 1e-9)])
    >>> arrays.write_array("sensor.toml", one)
    >>> arrays.read_sensors("sensor.toml").ids
    ('s1',)
    """
    return array_of_table(str(path), read_toml(path, "a TOML file of an array"))


def array_of_table(place: str, table: dict[str, Any]) -> SensorArray:
    """Return an array from the keys of an array file; `place` is for errors."""
    if not table:
        raise InputError(f"{place} is empty, expected an array: a geometry with its size, or [[sensor]] tables.")
    if "geometry" in table and "sensor" in table:
        raise InputError(f"{place}, keys geometry and sensor: found both, expected one of them.")
    if "geometry" in table:
        return _array_of_geometry(place, table)
    if "sensor" in table:
        return _array_of_sensors(place, _with_defaults(place, table))
    check_keys(place, table, {*_keys(_GeometryFile), *_keys(_Quality), *_keys(_SensorsFile), *_size_keys(), _DEFAULTS})
    raise InputError(f"{place}: found neither the key geometry nor [[sensor]] tables, expected one of them.")


def write_array(path: str | PathLike[str], array: SensorArray) -> None:
    """Write an array's TOML file, from which :func:`read_array` makes an equal array.

    Parameters
    ----------
    path : path-like
        File to write; an existing file is replaced in one step.
    array : SensorArray
        Array; its sensors are written one by one, with their calibration.

    Raises
    ------
    OSError
        The file cannot be written.

    Examples
    --------
    >>> import arrays
    >>> arrays.write_array("board.toml", arrays.grid(2, 2, 0.05))
    """
    write_text(array_toml(array), path)


def array_toml(array: SensorArray) -> str:
    """Return the text of an array's TOML file, sensor by sensor.

    Parameters
    ----------
    array : SensorArray
        Array; its sensors are written one by one, with their calibration.

    Returns
    -------
    str
        Text that :func:`read_array` reads.

    Examples
    --------
    >>> import arrays
    >>> print(arrays.array_toml(arrays.axial(0.5, "scalar")).splitlines()[1])
    name = "axial"
    """
    lines = [f"format_version = {FORMAT_VERSION}"]
    if array.name:
        lines.append(f"name = {_toml_string(array.name)}")
    if array.noise_fraction:
        lines.append(f"noise_fraction = {array.noise_fraction!r}")
    for key in _FIELD_KEYS:
        name = in_si(key)[0]
        if getattr(array, name) != SensorArray.__dataclass_fields__[name].default:
            lines.append(f"{key} = {nanotesla_text(getattr(array, name))}")
    if array.pose is not None:
        lines += pose_toml(array.pose)
    if array.columns is not None:
        lines += columns_toml(array.columns)
    for sensor in array.sensors:
        lines += ["", "[[sensor]]", f"id = {_toml_string(sensor.id)}", f'kind = "{sensor.kind}"']
        lines.append(f"position_m = {list(sensor.position_m)}")
        if sensor.rotation_xyzw != _NOT_TURNED:
            lines.append(f"rotation_xyzw = {list(sensor.rotation_xyzw)}")
        for key in _keys(_Quality):
            name, exponent = in_si(key)
            value = getattr(sensor, name)
            if value:
                lines.append(f"{key} = {shifted_text(value, exponent) if exponent else repr(value)}")
        if sensor.noise_fraction is not None:
            lines.append(f"noise_fraction = {sensor.noise_fraction!r}")
        if sensor.calibration != Calibration.of(sensor.kind):
            offsets = sensor.calibration.offset_T
            offset = nanotesla_text(offsets if sensor.kind == "vector" else offsets[0])
            lines += ["[sensor.calibration]", f"scale = {_shortest_scale(sensor.calibration)}"]
            lines.append(f"offset_nT = {offset}")
    return "\n".join(lines) + "\n"


def _array_of_geometry(path: str, table: dict[str, Any]) -> SensorArray:
    name = table["geometry"]
    if not isinstance(name, str) or name not in GEOMETRIES:
        raise InputError(f"{path}, key geometry: found {name!r}, expected one of {', '.join(GEOMETRIES)}.")
    make, size_key = GEOMETRIES[name]
    foreign = next((key for key in table if key in _size_keys() and key != size_key), None)
    if foreign is not None:
        raise InputError(f"{path}, key {foreign}: found the size of another geometry, expected {size_key} of a {name}.")
    check_keys(path, table, {*_keys(_GeometryFile), *_keys(_Quality), size_key})
    if size_key not in table:
        raise InputError(f"{path}: found no key {size_key}, expected the size of the {name}.")
    sized: Any = msgspec.defstruct("_Sized", [(size_key, float)], bases=(_GeometryFile,), kw_only=True)
    of_sensors = {key: value for key, value in table.items() if key in _keys(_Quality)}
    file = section_of(path, {key: value for key, value in table.items() if key not in of_sensors}, sized)
    quality = _quality(path, section_of(path, of_sensors, _Quality))
    with naming(path):
        array = make(getattr(file, size_key), file.kind, quality["noise_T"])
        array = replace(array, sensors=tuple(replace(sensor, **quality) for sensor in array.sensors))
    return _with_header(path, array, file)


def _with_defaults(path: str, table: dict[str, Any]) -> dict[str, Any]:
    """Return the table of an array, with the values of its table defaults in every sensor."""
    defaults, sensors = table.get(_DEFAULTS), table["sensor"]
    if defaults is None or not isinstance(sensors, list):
        return table
    if not isinstance(defaults, dict):
        raise InputError(f"{path}, key {_DEFAULTS}: found a value, expected a table.")
    check_keys(f"{path}, table {_DEFAULTS}", defaults, {"kind", *_TURNS, "noise_fraction", *_keys(_Quality)})
    others = {key: value for key, value in table.items() if key != _DEFAULTS}
    return {
        **others,
        "sensor": [_merge_defaults(defaults, sensor) if isinstance(sensor, dict) else sensor for sensor in sensors],
    }


def _merge_defaults(defaults: dict[str, Any], sensor: dict[str, Any]) -> dict[str, Any]:
    """Return a sensor's keys and defaults; its own rotation replaces both kinds of default rotation."""
    has_rotation = not sensor.keys().isdisjoint(_TURNS)
    return {key: value for key, value in defaults.items() if not (has_rotation and key in _TURNS)} | sensor


def _array_of_sensors(path: str, table: dict[str, Any]) -> SensorArray:
    misplaced = next((key for key in ("kind", *_keys(_Quality)) if key in table), None)
    if misplaced is not None:
        raise InputError(f"{path}, key {misplaced}: found at the top, expected in each [[sensor]] table.")
    file = section_of(path, table, _SensorsFile)
    tables = zip(table["sensor"], file.sensor, strict=True)
    sensors = tuple(
        _sensor(item_place(path, "sensor", i, raw, _SensorTable), sensor) for i, (raw, sensor) in enumerate(tables)
    )
    with naming(path):
        array = SensorArray(sensors)
    return _with_header(path, array, file)


def _sensor(place: str, table: _SensorTable) -> Sensor:
    quality = _quality(place, table)
    with naming(place):
        sensor = Sensor(
            id=table.id,
            kind=table.kind,  # type: ignore[arg-type]  # checked there
            position_m=table.position_m,
            rotation_xyzw=_rotation(place, table),
            noise_fraction=table.noise_fraction,
            **quality,
        )
    offset_nT: list[Number] = [0] * sensor.n_channels
    if table.calibration.offset_nT is not None:
        given = table.calibration.offset_nT
        offset_nT = given if isinstance(given, list) else [given]
    key = f"{place}, key calibration.offset_nT"
    if len(offset_nT) != sensor.n_channels:
        raise InputError(
            f"{key}: found {_count(len(offset_nT))}, expected {_count(sensor.n_channels)} for a {sensor.kind} sensor."
        )
    with naming(place):
        calibration = Calibration.of(sensor.kind, table.calibration.scale, [tesla(key, x) for x in offset_nT])
    return replace(sensor, calibration=calibration)


def _rotation(place: str, table: _SensorTable) -> tuple[float, float, float, float]:
    """Return the quaternion of a sensor's axes in the array's frame."""
    if table.ypr_deg is None:
        return table.rotation_xyzw or _NOT_TURNED
    if table.rotation_xyzw is not None:
        raise InputError(f"{place}, key ypr_deg: found together with rotation_xyzw, expected one of them.")
    if not all(map(math.isfinite, table.ypr_deg)):
        raise InputError(f"{place}, key ypr_deg: found an infinite number, expected finite numbers.")
    (cz, sz), (cy, sy), (cx, sx) = ((math.cos(a), math.sin(a)) for a in (math.radians(x) / 2 for x in table.ypr_deg))
    return (
        sx * cy * cz - cx * sy * sz,
        cx * sy * cz + sx * cy * sz,
        cx * cy * sz - sx * sy * cz,
        cx * cy * cz + sx * sy * sz,
    )


def _with_header(path: str, array: SensorArray, header: _Header) -> SensorArray:
    of_field = {in_si(key)[0]: _in_tesla(f"{path}, key {key}", getattr(header, key)) for key in _FIELD_KEYS}
    if header.background is not None:
        if header.common_field_nT is not None:
            raise InputError(f"{path}, key background: found it together with common_field_nT, expected one of them.")
        of_field["common_field_T"] = BACKGROUND_CHANGE_T
    name = array.name if header.name is None else header.name
    pose = None if header.pose is None else header.pose.uncertainty(f"{path}, table pose")
    channels = {of.id: of.channel_names for of in array.sensors}
    columns = None if header.columns is None else header.columns.columns(path, channels)
    with naming(path):
        return SensorArray(array.sensors, name, header.noise_fraction, pose=pose, columns=columns, **of_field)


def _quality(place: str, table: _Quality) -> dict[str, Any]:
    """Return noise and errors of a sensor, as arguments of Sensor."""
    result = {}
    for key in _keys(_Quality):
        name, exponent = in_si(key)
        value = getattr(table, key)
        result[name] = scaled(f"{place}, key {key}", value, -exponent) if exponent and value is not None else value
    return result


def _in_tesla(place: str, nanotesla: Any) -> Any:
    """Return a field, or a tuple of fields, in T; None stays."""
    if isinstance(nanotesla, tuple):
        return tuple(_in_tesla(place, each) for each in nanotesla)
    return None if nanotesla is None else tesla(place, nanotesla)


def _shortest_scale(calibration: Calibration) -> float | list[float] | list[list[float]]:
    """Return the scale as a number, 3 numbers or the matrix."""
    rows = [list(row) for row in calibration.scale]
    diagonal = [row[i] for i, row in enumerate(rows)]
    if any(x for i, row in enumerate(rows) for j, x in enumerate(row) if i != j):
        return rows
    return diagonal[0] if len(set(diagonal)) == 1 else diagonal


def _toml_string(text: str) -> str:
    """Return a TOML string; for printable text the escapes of TOML and JSON agree."""
    return json.dumps(text, ensure_ascii=False)


def _keys(struct: type[msgspec.Struct]) -> tuple[str, ...]:
    return struct.__struct_fields__


def _size_keys() -> set[str]:
    return {geometry.size_key for geometry in GEOMETRIES.values()}


def _count(n: int) -> str:
    return "1 number" if n == 1 else f"{n} numbers"
