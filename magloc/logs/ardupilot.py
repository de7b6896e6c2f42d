"""ArduPilot DataFlash logs (.BIN): messages whose formats the log states itself.

Source of the format: ArduPilot, libraries/AP_Logger, LogStructure.h. The messages of one kind have the same length, so
that NumPy decodes them together.
"""

from __future__ import annotations

import re
from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from arrays.io.errors import InputError
from arrays.io.text import read_bytes
from arrays.typing import FloatArray
from magloc.logs.channels import ROWS, Log, Topic
from magloc.logs.units import PLACE, LoggedUnit, logged_unit

_HEAD, _FORMAT_KIND = b"\xa3\x95", 0x80
_TYPES = {
    **{"b": "i1", "B": "u1", "M": "u1", "h": "<i2", "H": "<u2", "i": "<i4", "I": "<u4", "q": "<i8", "Q": "<u8"},
    **{"f": "<f4", "d": "<f8", "g": "<f2", "n": "S4", "N": "S16", "Z": "S64", "a": "(32,)<i2"},
    **{"c": "<i2", "C": "<u2", "e": "<i4", "E": "<u4", "L": "<i4"},
}
_SCALES = {"c": 1e-2, "C": 1e-2, "e": 1e-2, "E": 1e-2, "L": 1e-7}
_PLACES = ("deglatitude", "deglongitude")
_LABELS = {"gauss": "G", "degheading": "deg", "degc": "degC"}
_WITHOUT_UNITS = (
    (r"MAG\d?\.(Mag|Ofs|MO)[XYZ]", "mG"),
    (r"(IMU\d?|GYR\d?)\.Gyr[XYZ]", "rad/s"),
    (r"(IMU\d?|ACC\d?)\.Acc[XYZ]", "m/s2"),
    (r"ATT\.(Des)?(Roll|Pitch|Yaw)", "deg"),
    (r"(BAT|CURR)\d?\.Curr", "A"),
    (r"(BAT|CURR)\d?\.Volt", "V"),
)
_GPS_ZERO_S, _WEEK_S, _LEAP_S = 315_964_800.0, 604_800.0, 18.0  # leap seconds since 2017


@dataclass(frozen=True)
class MessageFormat:
    """Format of the messages of one kind.

    Attributes
    ----------
    name : str
    dtype : dtype
        Record of the fields behind the head of three bytes.
    letters : str
        Types of the fields.
    """

    name: str
    dtype: np.dtype[Any]
    letters: str


_FMT = MessageFormat(
    "FMT", np.dtype([("Type", "u1"), ("Length", "u1"), ("Name", "S4"), ("Format", "S16"), ("Columns", "S64")]), "BBnNZ"
)


@dataclass(frozen=True)
class _Index:
    """Formats by kind, places of the messages, and the number of damaged places."""

    formats: dict[int, MessageFormat]
    places: dict[int, array[int]] = field(default_factory=dict)
    damaged: int = 0


def read_dataflash(path: Path) -> Log:
    """Return the channels of a DataFlash log.

    Raises
    ------
    InputError
        The file has no messages of sensors.
    """
    data = read_bytes(path, "a DataFlash log")
    index = _index(data)
    bytes_ = np.frombuffer(data, np.uint8)
    tables = {of.name: _records(bytes_, index, kind) for kind, of in index.formats.items() if kind in index.places}
    letters = {of.name: of.letters for of in index.formats.values()}
    units = _stated_units(tables, index.formats)
    topics = [
        part
        for name, table in tables.items()
        if name not in ("FMT", "FMTU", "UNIT", "MULT", "PARM")
        for part in _topics(name, table, letters[name], units.get(name, {}))
    ]
    if not topics:
        raise InputError(f"{path}: found a DataFlash log without messages, expected logged sensors.")
    warnings = [f"{path}: {index.damaged} parts of the log are damaged or cut; the whole messages are read"]
    parameters = {_text(row["Name"]): float(row["Value"]) for row in _rows(tables, "PARM", Name="S", Value="f")}
    zero_s = _unix_zero_s(tables)
    return Log(str(path), "ArduPilot DataFlash", tuple(topics), parameters, zero_s, tuple(warnings[: index.damaged]))


def _index(data: bytes) -> _Index:
    """Return the places of all whole messages."""
    formats, damaged, at = {_FORMAT_KIND: _FMT}, 0, 0
    places: dict[int, array[int]] = {}
    lengths = [0] * 256
    lengths[_FORMAT_KIND] = _FMT.dtype.itemsize + 3
    while 0 <= at < len(data) - 2:
        kind = data[at + 2]
        end = at + lengths[kind]
        if data[at : at + 2] != _HEAD or end == at or end > len(data):
            is_padding = not data[at : at + 256].strip(b"\0\xff")  # of the last page
            at = data.find(_HEAD, at + 1)
            damaged += not is_padding
            continue
        places.setdefault(kind, array("q")).append(at)
        if kind == _FORMAT_KIND:
            stated = np.frombuffer(data, _FMT.dtype, 1, at + 3)[0]
            found = _format(stated)
            if found is not None:
                formats[int(stated["Type"])] = found
                lengths[int(stated["Type"])] = int(stated["Length"])
        at = end
    return _Index(formats, places, damaged)


def _format(stated: Any) -> MessageFormat | None:
    """Return the format of an FMT message; None if its fields do not fill its length."""
    letters, names = _text(stated["Format"]), _text(stated["Columns"]).split(",")
    if len(letters) != len(names) or not set(letters) <= _TYPES.keys() or len(set(names)) < len(names):
        return None
    dtype = np.dtype([(name, _TYPES[letter]) for name, letter in zip(names, letters, strict=True)])
    if dtype.itemsize + 3 != stated["Length"]:
        return None
    return MessageFormat(_text(stated["Name"]), dtype, letters)


def _text(value: bytes) -> str:
    return value.split(b"\0")[0].decode("latin-1")


def _records(data: NDArray[np.uint8], index: _Index, kind: int) -> NDArray[Any]:
    """Return the records (n,) of all messages of a kind."""
    dtype = index.formats[kind].dtype
    at = np.frombuffer(index.places[kind], np.int64) + 3
    return data[at[:, None] + np.arange(dtype.itemsize)].view(dtype)[:, 0]


def _stated_units(
    tables: dict[str, NDArray[Any]], formats: dict[int, MessageFormat]
) -> dict[str, dict[str, LoggedUnit | None]]:
    """Return the units by message and field that the log states; None marks the field with the instance."""
    labels = {chr(int(row["Id"]) % 256): _text(row["Label"]) for row in _rows(tables, "UNIT", Id="iu", Label="S")}
    sizes = {chr(int(row["Id"]) % 256): float(row["Mult"]) for row in _rows(tables, "MULT", Id="iu", Mult="f")}
    found: dict[str, dict[str, LoggedUnit | None]] = {}
    for row in _rows(tables, "FMTU", FmtType="iu", UnitIds="S", MultIds="S"):
        of = formats.get(int(row["FmtType"]))
        if of is None:
            continue
        own = found.setdefault(of.name, {})
        ids = zip(of.dtype.names or (), of.letters, _text(row["UnitIds"]), _text(row["MultIds"]), strict=False)
        for name, letter, unit, size in ids:
            if unit == "#":
                own[name] = None
            elif (label := labels.get(unit, "")) and label != "UNKNOWN":
                own[name] = _scaled(label, 1.0 if letter in _SCALES else sizes.get(size, 1.0) or 1.0)
    return found


def _rows(tables: dict[str, NDArray[Any]], name: str, **kinds: str) -> list[Any]:
    """Return the messages of a name; none unless they have fields of some kinds of numbers or text."""
    table = tables.get(name)
    known = {} if table is None else {of: table.dtype[of].kind for of in table.dtype.names or ()}
    return list(table) if table is not None and all(known.get(of, "-") in kind for of, kind in kinds.items()) else []


def _scaled(label: str, size: float) -> LoggedUnit:
    if label in _PLACES:
        return PLACE._replace(si_per_unit=size)
    one = logged_unit(_LABELS.get(label.lower(), label))
    return LoggedUnit(label if size == 1.0 else f"{size:g} {label}", one.si, one.si_per_unit * size)


def _topics(name: str, table: NDArray[Any], letters: str, units: dict[str, LoggedUnit | None]) -> Iterator[Topic]:
    """Yield the topics of a message: one for each instance."""
    names = table.dtype.names or ()
    stamp = next((of for of in ("TimeUS", "TimeMS") if of in names), None)
    instance = next((of for of, unit in units.items() if unit is None), "I" if "I" in names else None)
    numbers = [of for of, letter in zip(names, letters, strict=True) if letter not in "nNZa" and of != stamp]
    scales = {of: _SCALES[letter] for of, letter in zip(names, letters, strict=True) if letter in _SCALES}
    stated = {of: units.get(of) or _unit_without(f"{name}.{of}", scales.get(of) == _SCALES["L"]) for of in numbers}
    groups = np.zeros(len(table), np.int64) if instance is None else table[instance].astype(np.int64)
    for k in np.unique(groups):
        rows = table[groups == k]
        time_s = np.arange(float(len(rows))) if stamp is None else _seconds(rows[stamp], stamp)
        fields = {of: rows[of] * scales[of] if of in scales else rows[of] for of in numbers if of != instance}
        known = {of: unit for of, unit in stated.items() if unit is not None}
        yield Topic(f"{name}[{k}]" if k else name, time_s, fields, known, ROWS if stamp is None else "boot")


def _seconds(stamp: NDArray[Any], name: str) -> FloatArray:
    return np.asarray((1e-6 if name == "TimeUS" else 1e-3) * stamp.astype(np.float64))


def _unit_without(name: str, is_place: bool) -> LoggedUnit | None:
    """Return the unit of a field in a log that does not state units."""
    if is_place:
        return PLACE
    return next((logged_unit(unit) for pattern, unit in _WITHOUT_UNITS if re.fullmatch(pattern, name)), None)


def _unix_zero_s(tables: dict[str, NDArray[Any]]) -> float | None:
    """Return the time since 1970 at the start of the autopilot, by its receiver."""
    row = next((row for row in _rows(tables, "GPS", TimeUS="iu", GWk="iu", GMS="iu") if row["GWk"]), None)
    if row is None:
        return None
    gps_s = _WEEK_S * float(row["GWk"]) + 1e-3 * float(row["GMS"])
    return _GPS_ZERO_S + gps_s - _LEAP_S - 1e-6 * float(row["TimeUS"])
