"""TOML files: strict reading as typed structs, writing in one step, and errors that name the place.

Numbers with a fraction are read as Decimal, so that whoever converts a unit can do it without rounding.
"""

from __future__ import annotations

import difflib
import math
import re
import tomllib
from collections.abc import Collection, Iterator, Mapping
from decimal import Decimal
from os import PathLike
from typing import Any, ClassVar, TypeVar

import msgspec

from arrays.io.errors import InputError
from arrays.io.text import read_text

_Any = TypeVar("_Any")


def read_toml(path: str | PathLike[str], expected: str) -> dict[str, Any]:
    """Table of a TOML file, fractional numbers as Decimal.

    Parameters
    ----------
    path : path-like
    expected : str
        What the file should be, in words, for errors.

    Returns
    -------
    dict

    Raises
    ------
    InputError
        The file cannot be read, or is not TOML; the text names the line.
    """
    text = read_text(path, expected)
    try:
        return tomllib.loads(text, parse_float=Decimal)
    except tomllib.TOMLDecodeError as error:
        fault, _, where = str(error).rpartition(" (at ")
        place = re.match(r"line (\d+)", where)
        line = int(place[1]) if place else len(text.splitlines())  # else it is the end of the document
        raise InputError(f"{path}, line {line}: found what is not TOML ({_lower_first(fault)}).") from None
    except (ValueError, ArithmeticError):
        raise InputError(f"{path}: found a number out of range, expected one with fewer digits.") from None
    except RecursionError:
        raise InputError(f"{path}: found lists nested too deeply, expected a list of lists at most.") from None


def check_keys(place: str, table: Mapping[str, Any], known: Collection[str], within: str = "") -> None:
    """Refuse a table with a key that is not known, naming the nearest one that is.

    Parameters
    ----------
    place : str
        Name of the file, and of the table within it, for errors.
    table : mapping
    known : collection of str
        Keys that the table may have.
    within : str
        What the keys are shown with in front, such as ``"calibration."``.

    Raises
    ------
    InputError
        For the first unknown key.
    """
    for key in table:
        if key not in known:
            nearest = difflib.get_close_matches(key, sorted(known), n=1, cutoff=0.0)[0]
            shown = key if key and key.isprintable() else repr(key)
            raise InputError(
                f"{place}, key {within}{shown}: found an unknown key, expected a known one "
                f"(the nearest is {within}{nearest})."
            )


_TYPE_ERROR = re.compile(r"Expected `(?P<expected>[^`]+)`(?P<length> of length \d+)?, got `?(?P<found>[^`]+)`?")
_MISSING_ERROR = re.compile(r"Object missing required field `(?P<key>[^`]+)`")
_TYPES = {
    "array": "a list",
    "bool": "a truth value",
    "decimal": "a number",
    "float": "a number",
    "int": "a whole number",
    "null": "nothing",
    "object": "a table",
    "str": "text",
}


def converted(path: str, table: dict[str, Any], type_: type[_Any]) -> _Any:
    """A table as a struct of the right types.

    Parameters
    ----------
    path : str
        Name of the file, for errors.
    table : dict
        As :func:`read_toml` returns it, with decimal numbers.
    type_ : type
        The struct. Fields of type float take any number.

    Returns
    -------
    object
        Of that type.

    Raises
    ------
    InputError
        A key is missing, or its value has another type; the text names the key.
    """
    try:
        return msgspec.convert(table, type_, builtin_types=(Decimal,))
    except msgspec.ValidationError as error:
        text, _, where = str(error).partition(" - at `$.")
        place = place_of(path, table, where.rstrip("`"))
    missing = _MISSING_ERROR.fullmatch(text)
    if missing:
        raise InputError(f"{place}: found no key {missing['key']}, expected one.")
    wrong = _TYPE_ERROR.fullmatch(text)
    if not wrong:
        raise InputError(f"{place}: {_lower_first(text)}.")
    found = f"a list of length {wrong['found']}" if wrong["length"] else _type_in_words(wrong["found"])
    raise InputError(f"{place}: found {found}, expected {_type_in_words(wrong['expected'])}{wrong['length'] or ''}.")


def _type_in_words(types: str) -> str:
    names = set(types.split(" | ")) - {"null"} or {"null"}
    if names & {"decimal", "float"}:
        names.discard("int")
    return " or ".join(_TYPES.get(name, name) for name in sorted(names, reverse=True))


def place_of(path: str, table: Mapping[str, Any], where: str) -> str:
    """Where ``sensor[1].noise_nT`` is, in words: the sensor by its id, or by its number if that cannot be shown."""
    sensor = re.fullmatch(r"sensor\[(\d+)\]\.?(.*)", where)
    if sensor:
        index, where = int(sensor[1]), sensor[2]
        item = table["sensor"][index]
        name = item.get("id") if isinstance(item, dict) else None
        usable = isinstance(name, str) and name.isprintable() and name.strip()
        path = f"{path}, sensor {name}" if usable else f"{path}, sensor number {index + 1}"
    return f"{path}, key {where}" if where else path


def _lower_first(text: str) -> str:
    return text[:1].lower() + text[1:]


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
        As :func:`arrays.io.toml.read_toml` returns it.
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
