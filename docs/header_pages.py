"""Page of the C++ headers for a microcontroller, made of their comments and of the declarations below these."""

from __future__ import annotations

import re
from pathlib import Path

HEADERS = (
    "adcs/attitude_filter.hpp",
    "adcs/satellite_filter.hpp",
    "adcs/satellite_config.hpp",
    "adcs/status.hpp",
    "magloc/tracker.hpp",
)
_TYPE = re.compile(r"^(?:template <[^\n]*>\n)?(?:struct|class|enum class|enum) (\w+)[^;{\n]*\{", re.MULTILINE)


def header_text(folder: Path, name: str) -> str:
    """Return the section of a header: what it says of itself, and each of its types."""
    source = (folder / name).read_text(encoding="utf-8")
    opening = re.match(r"(?://[^\n]*\n)+", source)
    lines = [f"## `{name}`", "", prose(opening[0] if opening else "")]
    for found in _TYPE.finditer(source):
        above = re.search(r"(?:^//[^\n]*\n)+\Z", source[: found.start()], re.MULTILINE)
        body = public_part(source[found.start() : end_of_block(source, found.end() - 1)])
        lines += [f"### `{found[1]}`", "", prose(above[0] if above else ""), "```c++", body, "```", ""]
    return "\n".join(lines)


def prose(comment: str) -> str:
    """Return a comment as Markdown; its indented lines are code."""
    return "\n".join(line.removeprefix("//").removeprefix(" ").rstrip() for line in comment.splitlines()) + "\n"


def end_of_block(source: str, begin: int) -> int:
    """Return the place behind the brace that closes the one at a place."""
    depth = 0
    for place in range(begin, len(source)):
        depth += {"{": 1, "}": -1}.get(source[place], 0)
        if not depth:
            return place + 1
    raise ValueError("expected a closing brace")


def public_part(text: str) -> str:
    """Return the declaration of a type without private members and without the bodies of its functions."""
    head, public, rest = text.partition("\n public:\n")
    if public:
        text = head[: head.index("{") + 1] + "\n public:\n" + rest.partition("\n private:\n")[0].rstrip("}") + "\n}"
    shown, place = "", 0
    for body in re.finditer(r"\)(?: const)?(?: noexcept)?(?: : [^;{]*(?:\{\})?[^;{]*)? \{", text):
        if body.start() < place:
            continue
        shown += (
            text[place : body.start()] + text[body.start() : body.end()].partition(" :")[0].removesuffix(" {") + ";"
        )
        place = end_of_block(text, body.end() - 1)
    return (shown + text[place:]).replace("\n\n}", "\n}") + ";"
