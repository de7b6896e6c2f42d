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
