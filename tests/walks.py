"""Write docs/development/walks.md: the files that one row passes, in the order of a debugger.

python -m tests.walks
"""

from __future__ import annotations

import ast
import os
import sys
from collections.abc import Callable, Set
from itertools import groupby
from pathlib import Path
from types import FrameType
from typing import NamedTuple

import adcs
import magloc

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs/development/walks.md"
_PACKAGES = ("adcs", "arrays", "magloc", "sims")
_CORE = "magloc/core/__init__.py"
_GUARD = "arrays/blas_threads.py"  # acts only where linear algebra has several threads
_MOST_NAMES = 3  # functions and kernels that a line of the page names
_HEAD = """# Walks: the path of one row

The files that one row passes, in the order in which a debugger enters them, with the first functions that run there.
Imports, caches and the guard of linear algebra's threads are not part of a walk. Files without a sentence are
explained in an earlier walk. `python -m tests.walks` writes this page.
"""


class Walk(NamedTuple):
    """Functions that ran, by file in the order of the first call, and how often the file changed."""

    functions: dict[str, list[str]]
    switches: int


def _locate() -> Callable[[], object]:
    board = magloc.datasets.load("board")
    return lambda: magloc.locate(board.array, board.readings[:1])


def _track() -> Callable[[], object]:
    board = magloc.datasets.load("board")
    row = next(iter(board.readings))
    motion = magloc.RandomWalk(speed_m_s=0.1, turn_rad_s=0.02)
    return lambda: magloc.Tracker(board.array, motion).update(row)


def _estimate() -> Callable[[], object]:
    log = adcs.datasets.load("satellite")
    return lambda: adcs.estimate(log.telemetry, log.satellite, sensors="mag+sun")


WALKS = {
    "One row through `magloc.locate`": _locate,
    "The first row of a track, `magloc.Tracker.update`": _track,
    "A telemetry log through `adcs.estimate`": _estimate,
}


def walk(call: Callable[[], object]) -> Walk:
    """Return the path of a call whose imports and caches are warm."""
    call()
    functions: dict[str, list[str]] = {}
    switches, last = 0, ""

    def profile(frame: FrameType, event: str, _: object) -> None:
        nonlocal switches, last
        file = os.path.relpath(frame.f_code.co_filename, ROOT).replace(os.sep, "/")
        if event != "call" or file == _GUARD or file.partition("/")[0] not in _PACKAGES:
            return
        name = frame.f_code.co_qualname
        if file == _CORE and name == "run":
            name = f"kernel {frame.f_locals['kernel']}"
        names = functions.setdefault(file, [])
        if "<" not in name and name not in names:
            names.append(name)
        switches += last not in ("", file)
        last = file

    sys.setprofile(profile)
    try:
        call()
    finally:
        sys.setprofile(None)
    return Walk(functions, switches)


def page() -> str:
    """Return the text of the page."""
    text, known = _HEAD, set[str]()
    for title, make in WALKS.items():
        path = walk(make())
        text += f"\n## {title}\n\n{_lines(path, known)}"
        known |= path.functions.keys()
    return text


def _lines(path: Walk, known: Set[str]) -> str:
    """Return a numbered line of each file, and one line of successive files that an earlier walk explains."""
    lines = [f"{len(path.functions)} files, {path.switches} switches between files.\n\n"]
    for is_known, group in groupby(path.functions.items(), lambda item: item[0] in known):
        items = list(group)
        described = [", ".join(f"`{file}`" for file, _ in items)] if is_known else [_line(*item) for item in items]
        lines += [f"{i}. {line}\n" for i, line in enumerate(described, len(lines))]
    return "".join(lines)


def _line(file: str, names: list[str]) -> str:
    shown = [name for name in names if name.startswith("kernel ")] or names
    more = " …" if len(shown) > _MOST_NAMES else ""
    summary = (ast.get_docstring(ast.parse((ROOT / file).read_text("utf-8"))) or "").partition("\n")[0]
    listed = ", ".join(f"`{name}`" for name in shown[:_MOST_NAMES])
    return f"`{file}`: {summary}" + (f" {listed}{more}" if listed else "")


if __name__ == "__main__":
    if "--print" in sys.argv:
        sys.stdout.buffer.write(page().encode())
    else:
        PAGE.write_text(page(), "utf-8")
        print(PAGE)
