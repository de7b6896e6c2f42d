"""Every number that a file or an option takes, in turn at the ends of what a number can be."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from tests.fuzz.cases import LINES, commands

EXTREMES = ("1e30", "1e-30", "0", "-1", "nan", "inf")
# A number of a TOML file, not one in its comments, its strings or its names.
_NUMBER = re.compile(r"(?<![\w.\"'-])[-+]?\d[\d_]*(?:\.\d+)?(?:[eE][-+]?\d+)?(?![\w.\"':-])")
_OTHERS = ("format_version",)


class Extreme(NamedTuple):
    """One number of one command's line."""

    command: str
    words: tuple[str, ...]
    file: str  # that is written anew, if any
    at: slice
    value: str


def extremes(files: Path) -> Iterator[Extreme]:
    """Each number of each TOML file that a command reads, and each of its options."""
    known = dict(commands())
    for command, lines in LINES.items():
        seen = set()
        for line in lines:
            words = tuple(line.split())
            for file in words:
                if file.endswith(".toml") and (files / file).is_file() and file not in seen:
                    seen.add(file)
                    for at in numbers_of((files / file).read_text(encoding="utf-8")):
                        yield from (Extreme(command, words, file, at, value) for value in EXTREMES)
        words = tuple(lines[0].split())
        for option in known[command]:
            yield from (Extreme(command, (*words, option, value), "", slice(0), value) for value in EXTREMES)


def numbers_of(text: str) -> Iterator[slice]:
    """Where the numbers of a TOML file stand."""
    begin = 0
    for line in text.splitlines(keepends=True):
        code = line.split("#")[0]
        if not code.strip().startswith(_OTHERS):
            yield from (
                slice(begin + one.start(), begin + one.end()) for one in _NUMBER.finditer(code, max(code.find("="), 0))
            )
        begin += len(line)
