"""Tables of TOML files as typed structs: known keys, right types, numbers within their bounds."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, ClassVar, TypeVar

import msgspec

from arrays.errors import InputError
from arrays.toml import check_keys, converted


class Table(msgspec.Struct, kw_only=True):
    """A table of a file; numbers are finite unless they are named here."""

    positive: ClassVar[frozenset[str]] = frozenset()
    not_negative: ClassVar[frozenset[str]] = frozenset()
    may_be_infinite: ClassVar[frozenset[str]] = frozenset()


AnyTable = TypeVar("AnyTable", bound=Table)


def section_of(place: str, table: dict[str, Any], struct: type[AnyTable]) -> AnyTable:
    """A table of the file with known keys of the right types and numbers within their bounds.

    Parameters
    ----------
    place : str
        Name of the file, and of the table within it, for errors.
    table : dict
        As :func:`arrays.toml.read_toml` returns it.
    struct : type
        What it should be.

    Returns
    -------
    Table
        Of that type.

    Raises
    ------
    InputError
        It is not; the text says where and why.
    """
    check_keys(place, table, struct.__struct_fields__)
    result = converted(place, table, struct)
    for key in struct.__struct_fields__:
        for number in _numbers(getattr(result, key)):
            if not (math.isfinite(number) or (number == math.inf and key in struct.may_be_infinite)):
                raise InputError(f"{place}, key {key}: found {number}, expected a finite number.")
            if key in struct.positive and not number > 0.0:
                raise InputError(f"{place}, key {key}: found {number:g}, expected a positive number.")
            if key in struct.not_negative and not number >= 0.0:
                raise InputError(f"{place}, key {key}: found {number:g}, expected a number that is not negative.")
    return result


def _numbers(value: Any) -> Iterator[float]:
    if isinstance(value, int | float):
        yield value
    elif isinstance(value, list | tuple):
        for item in value:
            yield from _numbers(item)
