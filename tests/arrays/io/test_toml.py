"""The strict reader of TOML: nested tables, rules beside the types, and where an error says that it is."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import msgspec
import pytest

from arrays.io.errors import InputError
from arrays.io.toml import (
    MAY_BE_INFINITE,
    NOT_NEGATIVE,
    BuiltIn,
    File,
    Positive,
    RefusalError,
    Table,
    date_such_as,
    named_section,
    one_of,
    read_toml,
    section_of,
)


class Inner(Table, kw_only=True):
    size_m: Positive
    kind: Annotated[str, one_of(("round", "flat"))] = "round"
    of: dict[str, Inner] = msgspec.field(default_factory=dict)

    def check(self) -> None:
        if self.kind == "flat" and self.size_m > 10.0:
            raise RefusalError("size_m", "found it above 10, expected less of what is flat")


class Named(Table, kw_only=True):
    id: str
    weight: Annotated[float, NOT_NEGATIVE, MAY_BE_INFINITE] = 0.0


class Short(Table, kw_only=True):
    is_inline = True

    offset_m: tuple[float, float]


class Everything(File, kw_only=True):
    inner: Inner | None = None
    several: list[Inner] = msgspec.field(default_factory=list)
    named: list[Named] = msgspec.field(default_factory=list)
    short: Short | None = None
    day: Annotated[str, date_such_as("a date such as 2026-11-21")] | None = None
    sizes_m: list[Positive] = msgspec.field(default_factory=list)


def read(folder: Path, text: str) -> Everything:
    path = folder / "file.toml"
    path.write_text(text, encoding="utf-8")
    return section_of("file.toml", read_toml(path, "a file"), Everything)


def test_values(tmp_path: Path) -> None:
    text = """
        day = 2026-11-21
        sizes_m = [1, 2.5]
        [inner]
        size_m = 0.5
        of = { a = { size_m = 3 } }
        [[several]]
        size_m = 1
        kind = "flat"
        [[named]]
        id = "x"
        weight = inf
        [short]
        offset_m = [1, -2]
    """
    file = read(tmp_path, text)
    assert file == Everything(
        day="2026-11-21",
        sizes_m=[1.0, 2.5],
        inner=Inner(size_m=0.5, of={"a": Inner(size_m=3.0)}),
        several=[Inner(size_m=1.0, kind="flat")],
        named=[Named(id="x", weight=float("inf"))],
        short=Short(offset_m=(1.0, -2.0)),
    )
    assert file.format_version == 1


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("format_version = 2", "file.toml, key format_version: found 2, expected 1."),
        ("inner = 3", "file.toml, key inner: found a whole number, expected a table."),
        ("inner = {}", "file.toml, table inner: found no key size_m, expected one."),
        ("inner = {size_m = 0.0}", "file.toml, table inner, key size_m: found 0, expected a positive number."),
        ("inner = {size_m = nan}", "file.toml, table inner, key size_m: found nan, expected a finite number."),
        ("inner = {size_m = inf}", "file.toml, table inner, key size_m: found inf, expected a finite number."),
        (
            "inner = {size_m = 1, kind = 'oval'}",
            "file.toml, table inner, key kind: found 'oval', expected one of round, flat.",
        ),
        (
            "inner = {size_m = 11, kind = 'flat'}",
            "file.toml, table inner, key size_m: found it above 10, expected less of what is flat.",
        ),
        (
            "inner = {size_m = 1, of = {a = {size = 2}}}",
            "file.toml, table inner.of.a, key size: found an unknown key, expected a known one (the nearest is si",
        ),
        ("[several]", "file.toml, key several: found a table, expected a list."),
        ("[[several]]\nsize_m = 1\n[[several]]", "file.toml, several 2: found no key size_m, expected one."),
        ("several = [1]", "file.toml, several 1: found a whole number, expected a table."),
        ("named = [{id = 'x', weight = -1}]", "file.toml, named x, key weight: found -1, expected a number that"),
        ("named = [{weight = 1}]", "file.toml, named number 1: found no key id, expected one."),
        ("named = [{id = 'x', weight = -inf}]", "file.toml, named x, key weight: found -inf, expected a fini"),
        ("short = {}", "file.toml, key short: found no key offset_m, expected one."),
        ("short = {offset_m = [1]}", "file.toml, key short.offset_m: found a list of length 1, expected a list of le"),
        (
            "short = {offset = [1]}",
            "file.toml, key short.offset: found an unknown key, expected a known one (the nearest is short.offset_m).",
        ),
        ("day = 'soon'", "file.toml, key day: found 'soon', expected a date such as 2026-11-21."),
        ("day = 3", "file.toml, key day: found a whole number, expected text."),
        ("sizes_m = [1, 0]", "file.toml, key sizes_m: found 0, expected a positive number."),
        ("sizes_m = [1, 'a']", "file.toml, key sizes_m[1]: found text, expected a number."),
    ],
)
def test_refusals(tmp_path: Path, text: str, sentence: str) -> None:
    with pytest.raises(InputError) as error:
        read(tmp_path, text)
    assert str(error.value).startswith(sentence)


@pytest.mark.parametrize(
    ("table", "sentence"),
    [
        ({}, "here: found no key kind, expected one of short."),
        ({"kind": 1}, "here, key kind: found 1, expected one of short."),
        ({"kind": "long"}, "here, key kind: found 'long', expected one of short."),
    ],
)
def test_tables_by_name(table: dict[str, Any], sentence: str) -> None:
    with pytest.raises(InputError) as error:
        named_section("here", table, "kind", {"short": Short})
    assert str(error.value) == sentence


def test_built_in_files_and_others(tmp_path: Path) -> None:
    files = BuiltIn("adcs", "scenarios", "scenario")
    assert "tabletsat" in files.names()
    path, table = files.read("tabletsat")
    assert (Path(path), table["orbit"]["altitude_km"] > 0) == (files.path("tabletsat"), True)
    own = tmp_path / "own.toml"
    own.write_text("a = 1\n", encoding="utf-8")
    assert files.read(str(own)) == (str(own), {"a": 1})
    with pytest.raises(InputError, match="none does not exist, expected a scenario file, or one of the built-in scen"):
        files.read("none")


def test_an_integer_beyond_all_floats_is_refused(tmp_path):
    with pytest.raises(InputError, match="format_version: found inf, expected 1"):
        read(tmp_path, f"format_version = 1{'0' * 400}")
