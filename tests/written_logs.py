"""Logs in the binary formats of autopilots, written from columns; the packages that read them are the oracles."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence

import numpy as np

Columns = Mapping[str, object]
"""Columns (n,) or (n, k) of a message by their names; the dtype states the type."""
_TYPES = {"f4": "float", "f8": "double", "u8": "uint64_t", "u4": "uint32_t", "i4": "int32_t", "u1": "uint8_t"}


def _message(kind: str, body: bytes) -> bytes:
    return struct.pack("<HB", len(body), ord(kind)) + body


def ulog(
    topics: Sequence[tuple[str, int, Columns]],
    parameters: Mapping[str, float] | None = None,
    *,
    ordered: bool = True,
) -> bytes:
    """Return a ULog file of topics with their instance and columns, of which the first is ``timestamp`` [us]."""
    out = [b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0)]
    arrays = [(name, k, {field: np.asarray(of) for field, of in columns.items()}) for name, k, columns in topics]
    for name, columns in {name: columns for name, _, columns in arrays}.items():
        fields = [
            f"{_TYPES[of.dtype.str[1:]]}{f'[{of.shape[1]}]' if of.ndim == 2 else ''} {field}"
            for field, of in columns.items()
        ]
        out.append(_message("F", f"{name}:{';'.join(fields)};".encode()))
    for name, value in (parameters or {}).items():
        key = f"float {name}".encode()
        out.append(_message("P", bytes([len(key)]) + key + struct.pack("<f", value)))
    for i, (name, k, _) in enumerate(arrays):
        out.append(_message("A", struct.pack("<BH", k, i) + name.encode()))
    rows = []
    for i, (_, _, columns) in enumerate(arrays):
        dtype = np.dtype([(field, of.dtype, of.shape[1:]) for field, of in columns.items()])
        table = np.zeros(len(columns["timestamp"]), dtype)
        for field, of in columns.items():
            table[field] = of
        rows += [(row["timestamp"], _message("D", struct.pack("<H", i) + row.tobytes())) for row in table]
    if ordered:
        rows.sort(key=lambda row: row[0])
    return b"".join([*out, *(body for _, body in rows)])


_LETTERS = {
    "u8": "Q",
    "u1": "B",
    "u2": "H",
    "u4": "I",
    "i4": "i",
    "i2": "h",
    "f4": "f",
    "f8": "d",
    "S16": "N",
    "S64": "Z",
}
_UNITS = {
    "s": "s",
    "-": "",
    "G": "Gauss",
    "E": "rad/s",
    "o": "m/s/s",
    "d": "deg",
    "D": "deglatitude",
    "U": "deglongitude",
}
_SIZES = {"-": 0.0, "F": 1e-6, "C": 1e-3, "0": 1.0, "G": 1e-7}


def dataflash(messages: Sequence[tuple[str, Columns, str, str]], *, units: bool = True) -> bytes:
    """Return a DataFlash log of messages: name, columns (the first TimeUS), ids of units and of multipliers.

    Columns of integers whose unit is D or U get the type L.
    """
    kinds: dict[str, int] = {}
    out: list[bytes] = []

    def state(name: str, letters: str, columns: str, size: int) -> None:
        kinds[name] = 0x80 if name == "FMT" else 100 + len(kinds)
        body = struct.pack("<BB4s16s64s", kinds[name], size + 3, name.encode(), letters.encode(), columns.encode())
        out.append(b"\xa3\x95\x80" + body)

    def add(name: str, body: bytes) -> None:
        out.append(b"\xa3\x95" + bytes([kinds[name]]) + body)

    state("FMT", "BBnNZ", "Type,Length,Name,Format,Columns", 86)
    if units:
        state("UNIT", "QbZ", "TimeUS,Id,Label", 73)
        state("MULT", "Qbd", "TimeUS,Id,Mult", 17)
        state("FMTU", "QBNN", "TimeUS,FmtType,UnitIds,MultIds", 41)
        for key, label in _UNITS.items():
            add("UNIT", struct.pack("<Qb64s", 0, ord(key), label.encode()))
        for key, size in _SIZES.items():
            add("MULT", struct.pack("<Qbd", 0, ord(key), size))
    rows: list[tuple[int, bytes]] = []
    for name, columns, ids, sizes in messages:
        arrays = {field: np.asarray(of) for field, of in columns.items()}
        types = [_LETTERS[of.dtype.str[1:]] for of in arrays.values()]
        types = ["L" if unit in "DU" else letter for unit, letter in zip(ids, types, strict=True)]
        dtype = np.dtype([(field, of.dtype) for field, of in arrays.items()])
        state(name, "".join(types), ",".join(arrays), dtype.itemsize)
        if units:
            add("FMTU", struct.pack("<QB16s16s", 0, kinds[name], ids.encode(), sizes.encode()))
        table = np.zeros(len(arrays["TimeUS"]), dtype)
        for field, of in arrays.items():
            table[field] = of
        head = b"\xa3\x95" + bytes([kinds[name]])
        rows += [(int(row["TimeUS"]), head + row.tobytes()) for row in table]
    return b"".join([*out, *(body for _, body in sorted(rows, key=lambda row: row[0]))])
