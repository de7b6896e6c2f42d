"""Strict reader of TOML files into typed structs, with errors that name file, table and key.

A kind of file is a :class:`File` with a field for every key, units in the names. Tables are fields of type
:class:`Table`, or lists or dicts of it. Rules beside the type restrict a value (``radius_m: Positive``,
``kind: Annotated[str, one_of(KINDS)]``); :meth:`Table.check` tests relations between keys. Numbers with a fraction are
read as Decimal, so that units convert without rounding.
"""

from __future__ import annotations

import datetime
import difflib
import json
import math
import re
import tomllib
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from decimal import Decimal
from functools import cache
from os import PathLike
from pathlib import Path
from typing import Annotated, Any, ClassVar, TypeVar, get_args, get_origin, get_type_hints

import msgspec

from arrays.io.errors import LARGEST, InputError
from arrays.io.text import read_text

FORMAT_VERSION = 1
_Any = TypeVar("_Any")


@dataclass(frozen=True)
class Rule:
    """Rule for a text, or for every number of a value; numbers are finite unless it allows more."""

    holds: Callable[[Any], bool]
    expected: str
    may_be_infinite: bool = False
    is_date: bool = False


def date_such_as(example: str) -> Rule:
    """Return the rule of a date, with or without quotation marks, which is read as text."""
    return Rule(_is_date, example, is_date=True)


def _is_date(text: str) -> bool:
    try:
        datetime.datetime.fromisoformat(text)
    except ValueError:
        return False
    return True


def one_of(names: Collection[str], expected: str = "") -> Rule:
    """Return the rule of a text that is one of some names."""
    return Rule(lambda value: value in names, expected or f"one of {', '.join(names)}")


POSITIVE = Rule(lambda value: value > 0, "a positive number")
NOT_NEGATIVE = Rule(lambda value: value >= 0, "a number that is not negative")
MAY_BE_INFINITE = Rule(lambda _: True, "", may_be_infinite=True)
_VERSION = Rule(lambda value: value == FORMAT_VERSION, str(FORMAT_VERSION))
Positive = Annotated[float, POSITIVE]
Rate = Annotated[float, Rule(lambda value: value >= 1.0 / LARGEST, f"a positive rate, {1.0 / LARGEST:g} at least")]
"""Positive number by which times can be divided."""
NotNegative = Annotated[float, NOT_NEGATIVE]


class RefusalError(ValueError):
    """Invalid value of a key or table: the key or "", and a sentence with found and expected."""


class Table(msgspec.Struct, kw_only=True):
    """Table of a file."""

    is_inline: ClassVar[bool] = False
    """True if errors name its keys ``table.key`` of the file."""

    floats_may_be_infinite: ClassVar[bool] = False
    """True if the user of the floats refuses infinite ones."""

    def check(self) -> None:
        """Raise a :class:`RefusalError` if its values contradict each other."""


class File(Table, kw_only=True):
    """Complete file."""

    format_version: Annotated[int, _VERSION] = FORMAT_VERSION


AnyTable = TypeVar("AnyTable", bound=Table)


@dataclass(frozen=True)
class BuiltIn:
    """Built-in files of one kind, in a folder of a package."""

    package: str
    folder: str
    called: str
    ending: str = ".toml"

    def names(self) -> tuple[str, ...]:
        """Return the names of the files."""
        return tuple(sorted(path.name.removesuffix(self.ending) for path in self._folder().glob(f"*{self.ending}")))

    def path(self, name: str) -> Path:
        """Return the path of the file of a name."""
        return self._folder() / f"{name}{self.ending}"

    def chosen(self, name: str) -> Path:
        """Return the path of the file of a name; refuse unknown names."""
        if name not in self.names():
            raise InputError(f"Input name must be one of {', '.join(self.names())}; instead received {name!r}.")
        return self.path(name)

    def _folder(self) -> Path:
        from importlib import resources  # slow to import, and an array's file does not need it

        return Path(str(resources.files(self.package) / self.folder))

    def read(self, name_or_path: str) -> tuple[str, dict[str, Any]]:
        """Return path and table of a built-in file or of a user's file."""
        names = self.names()
        path = str(self.path(name_or_path)) if name_or_path in names else name_or_path
        return path, read_toml(path, f"a {self.called} file, or one of the built-in {self.called}s {', '.join(names)}")


def read_toml(path: str | PathLike[str], expected: str) -> dict[str, Any]:
    """Read the table of a TOML file, fractions as Decimal; `expected` describes it in errors."""
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


def in_si(key: str) -> tuple[str, int]:
    """Return the SI name of a key, and the power of ten of its unit: 9 for nT, 3 for mrad."""
    exponent = 9 if "nT" in key else 3 if "mrad" in key else 0
    return key.replace("nT", "T").replace("mrad", "rad"), exponent


def check_keys(place: str, table: Mapping[str, Any], known: Collection[str], what: str = "key") -> None:
    """Refuse unknown keys of a table; the error has the nearest known key."""
    for key in table:
        if key not in known:
            nearest = difflib.get_close_matches(key, sorted(known), n=1, cutoff=0.0)[0]
            shown = key if key and key.isprintable() else repr(key)
            where, near = key_place(place, shown, what), f"{_within(place)}{nearest}"
            raise InputError(f"{where}: found an unknown {what}, expected a known one (the nearest is {near}).")


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


def key_place(place: str, key: str, what: str = "key") -> str:
    """Return the place of a key, for an error; a place that ends with a dot is an inline table."""
    return f"{place}{key}" if place.endswith(".") else f"{place}, {what} {key}"


def _within(place: str) -> str:
    return place.rpartition("key ")[2] if place.endswith(".") else ""


def section_of(place: str, table: dict[str, Any], struct: type[AnyTable]) -> AnyTable:
    """Return the struct of a table from :func:`read_toml`, with the tables in it."""
    fields = _fields(struct)
    check_keys(place, table, fields)
    read = {key: _with_tables(place, struct, key, value, fields[key][1]) for key, value in table.items()}
    for key, value in table.items():
        if isinstance(value, datetime.date) and any(rule.is_date for rule in fields[key][0]):
            read[key] = value.isoformat()
    result = _convert(place, read, struct)
    for key, (rules, _) in fields.items():
        for value in _values(getattr(result, key)):
            if not (struct.floats_may_be_infinite and isinstance(value, float)):
                _check_value(key_place(place, key), value, rules)
    try:
        result.check()
    except RefusalError as refusal:
        key, sentence = refusal.args
        raise InputError(f"{key_place(place, key) if key else place}: {sentence}.") from None
    return result


def named_section(place: str, table: dict[str, Any], key: str, structs: Mapping[str, type[AnyTable]]) -> AnyTable:
    """Return a table as the struct that a key of it names."""
    if key not in table:
        raise InputError(f"{place}: found no key {key}, expected one of {', '.join(structs)}.")
    name = table[key]
    if not isinstance(name, str) or name not in structs:
        raise InputError(f"{place}, key {key}: found {name!r}, expected one of {', '.join(structs)}.")
    return section_of(place, table, structs[name])


def _check_value(where: str, value: Any, rules: tuple[Rule, ...]) -> None:
    # A Decimal may be finite and beyond every float, because its unit changes later.
    is_finite = (
        value.is_finite() if isinstance(value, Decimal) else isinstance(value, int | str) or math.isfinite(value)
    )
    if not is_finite and not (value == math.inf and any(rule.may_be_infinite for rule in rules)):
        raise InputError(f"{where}: found {value}, expected a finite number.")
    if isinstance(value, float) and LARGEST < abs(value) < math.inf:
        raise InputError(f"{where}: found {value:g}, expected a number of {LARGEST:g} at most.")
    for rule in rules:
        if not rule.holds(value):
            if isinstance(value, int) and value.bit_length() > 1000:
                value = math.inf if value > 0 else -math.inf
            found = repr(value) if isinstance(value, str) else f"{value:g}"
            raise InputError(f"{where}: found {found}, expected {rule.expected}.")


def _values(value: Any) -> Iterator[float | str | Decimal]:
    """Yield the texts and numbers of a value."""
    if isinstance(value, int | float | str | Decimal):
        yield value
    elif isinstance(value, list | tuple):
        for item in value:
            yield from _values(item)


@cache
def _fields(struct: type[Table]) -> dict[str, tuple[tuple[Rule, ...], Any]]:
    """Return the rules of every key, and the type of its value if it contains tables."""
    hints = get_type_hints(struct, include_extras=True)
    return {key: (tuple(_extras(hints[key], Rule)), _with_tables_in(hints[key])) for key in struct.__struct_fields__}


def _extras(hint: Any, kind: type[_Any]) -> Iterator[_Any]:
    """Yield the annotations of a type and of its alternatives."""
    if get_origin(hint) is Annotated:
        yield from (extra for extra in hint.__metadata__ if isinstance(extra, kind))
    elif get_origin(hint) is not dict:
        for argument in get_args(hint):
            yield from _extras(argument, kind)


def _with_tables_in(hint: Any) -> Any:
    """Return a table type, or a list or dict of one, among the alternatives of a type."""
    if (isinstance(hint, type) and issubclass(hint, Table)) or get_origin(hint) in (list, dict):
        return hint if get_origin(hint) is None or _with_tables_in(get_args(hint)[-1]) else None
    return next(filter(None, map(_with_tables_in, get_args(hint))), None)


def _with_tables(place: str, struct: type[Table], key: str, value: Any, type_: Any) -> Any:
    """Return a value with structs instead of its tables; a later check refuses other types."""
    container = get_origin(type_) or type_
    if container is list and isinstance(value, list):
        (table,) = get_args(type_)
        return [_item(item_place(place, key, i, item, table), item, table) for i, item in enumerate(value)]
    if type_ is None or container is list or not isinstance(value, dict):
        return value
    inside = f"{place}, table {key}" if issubclass(struct, File) else f"{place}.{key}"
    if container is dict:
        return {name: _item(f"{inside}.{name}", item, get_args(type_)[1]) for name, item in value.items()}
    return section_of(f"{key_place(place, key)}." if type_.is_inline else inside, value, type_)


def _item(place: str, item: Any, table: type[AnyTable]) -> AnyTable:
    return section_of(place, _convert(place, item, dict), table)


def item_place(place: str, key: str, i: int, item: Any, table: type[Table]) -> str:
    """Return the place of a table in a list, for an error: its id or its number."""
    if "id" not in table.__struct_fields__:
        return f"{place}, {key} {i + 1}"
    name = item.get("id") if isinstance(item, dict) else None
    usable = isinstance(name, str) and name.isprintable() and name.strip()
    return f"{place}, {key} {name}" if usable else f"{place}, {key} number {i + 1}"


def _convert(place: str, table: Any, type_: type[_Any]) -> _Any:
    """Return a table as a struct of the right types."""
    try:
        return msgspec.convert(table, type_, builtin_types=(Decimal,))
    except msgspec.ValidationError as error:
        text, _, where = str(error).partition(" - at `$.")
    missing = _MISSING_ERROR.fullmatch(text)
    if missing:
        raise InputError(f"{place.removesuffix('.')}: found no key {missing['key']}, expected one.")
    if where:
        place = key_place(place, where.rstrip("`"))
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


def _lower_first(text: str) -> str:
    return text[:1].lower() + text[1:]


def toml_value(value: Any) -> str:
    """Return a value as TOML text: a text, a date, a number, a truth value, or a list of them."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, datetime.date):
        value = value.isoformat()
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(toml_value, value)) + "]"
    return str(value) if math.isfinite(value) else f"{float(value)}"
