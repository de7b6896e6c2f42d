"""Conversion of numbers of files to SI and back, by shifting the decimal point.

Without a multiplication 1.0 nT is exactly the number 1e-9, and every float survives writing and reading.
"""

from __future__ import annotations

from collections.abc import Iterable
from decimal import Context, Decimal
from typing import Any

from arrays.io.errors import InputError

Number = int | Decimal
"""Number of a file, as written."""
_SHIFT = Context(prec=1000, traps=[])
_OF_ENDINGS = {
    "_deg_s": "deg/s",
    "_m_s": "m/s",
    "_m_s2": "m/s2",
    "_s2": "1/s2",
    "_Am2": "A m2",
    "_nT": "nT",
    "_deg": "deg",
    "_percent": "percent",
    "_m": "m",
    "_s": "s",
}


def unit_of_column(name: str) -> str:
    """Return the unit at the end of a column's name; "1" without a unit."""
    return next((unit for ending, unit in _OF_ENDINGS.items() if name.endswith(ending)), "1")


def tesla(place: str, nanotesla: Number) -> float:
    """Return a field in T from a number in nT; `place` is for errors."""
    return scaled(place, nanotesla, -9)


def scaled(place: str, number: Number, exponent: int) -> float:
    """Return a number times a power of ten."""
    result = float(Decimal(number).scaleb(exponent, _SHIFT))
    if not abs(result) < float("inf"):
        raise InputError(f"{place}: found {number}, expected a finite number.")
    return result


def nanotesla_text(tesla: float | Iterable[Any]) -> str:
    """Return a field in T as a TOML float in nT, or fields as a TOML list."""
    return f"[{', '.join(map(nanotesla_text, tesla))}]" if isinstance(tesla, Iterable) else shifted_text(tesla, 9)


def shifted_text(value: float, exponent: int) -> str:
    """Return a number times a power of ten as a TOML float."""
    shifted = Decimal(repr(value)).scaleb(exponent, _SHIFT)
    text = f"{shifted:f}" if not shifted or -7 < shifted.adjusted() < 16 else str(shifted)
    return text if set(text) & set(".E") else f"{text}.0"
