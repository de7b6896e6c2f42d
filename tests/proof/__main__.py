"""Run ours and the others on the recordings, and write the page's tables anew."""

from __future__ import annotations

import argparse
import datetime
import sys
import time
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from tests.conftest import folder_of_data
from tests.proof import (
    PAGE,
    REPOSITORY,
    Part,
    Row,
    Rows,
    Size,
    better_peers,
    block,
    merge_rows,
    rows_of,
    table,
    table_lines,
    with_block,
)
from tests.proof.parts import PARTS
from tests.proof.picture import draw

QUICK = Size(every=5, starts=4)
DISTRIBUTIONS = {"tetra3": "cedar-solve"}
"""Packages whose name on PyPI is another."""


def report(text: str, end: str = "\n") -> None:
    print(text, end=end, file=sys.stderr, flush=True)


def rows(name: str, of_tool: Rows, data: Path, size: Size) -> Iterator[Row]:
    """Rows of one tool; none, with a message, where it is not installed."""
    began = time.perf_counter()
    report(f"  {name} ...", end="")
    try:
        yield from of_tool(data, size)
    except ModuleNotFoundError as error:
        report(f" skipped: {error.name} is not installed")
    else:
        report(f" {time.perf_counter() - began:.0f} s")


def versions(part: Part) -> str:
    """Return the versions of the tools of a part that are installed."""
    found = []
    for package in part.peers:
        name = DISTRIBUTIONS.get(package, package)
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            continue
    return ", ".join(found)


def run(page: str, part: Part, data: Path, size: Size, *, peers: bool) -> str:
    """Return the page with the fresh rows of a part."""
    tools = {"ours": part.ours} | (dict(part.peers) if peers else {})
    fresh = [list(row.cells) for name, of_tool in tools.items() for row in rows(name, of_tool, data, size)]
    stated = f"Wrong: {part.wrong}. Measured {datetime.date.today()}: `make proof ONLY={part.name}`; {versions(part)}."
    return with_block(page, part.name, table(part, merge_rows(fresh, rows_of(block(page, part.name))), stated))


def with_summary(page: str) -> str:
    """Return the page with a fresh list of where others are better."""
    heading = ["recording", "data", "other tool", "its figures (ours)"]
    return with_block(page, "better", "\n".join(table_lines(heading, better_peers(page, PARTS))))


def main() -> int:
    """Write the page, part by part, so that Ctrl-C loses the part that runs and no other."""
    parser = argparse.ArgumentParser(prog="python -m tests.proof", description=__doc__)
    parser.add_argument("part", nargs="*", help=f"any of {', '.join(part.name for part in PARTS)} (default: all)")
    parser.add_argument("--quick", action="store_true", help="a fifth of the rows, four random starts; writes no page")
    parser.add_argument("--ours", action="store_true", help="our rows alone")
    parser.add_argument(
        "--page", type=Path, default=PAGE, help="page whose tables are replaced (default: that of the site)"
    )
    given = parser.parse_args()
    if unknown := set(given.part) - {part.name for part in PARTS}:
        parser.error(
            f"part must be any of {', '.join(part.name for part in PARTS)}; "
            f"instead received {', '.join(sorted(unknown))}"
        )
    data, page = folder_of_data(), given.page.read_text(encoding="utf-8")
    if data is None:
        report("skipped: neither MAGLOC_DATA nor ../shared/data is a folder")
        return 0
    for part in PARTS:
        if given.part and part.name not in given.part:
            continue
        report(part.name)
        if not (data / part.name).is_dir():
            report(f"  skipped: {data / part.name} is not there")
            continue
        page = run(page, part, data, QUICK if given.quick else Size(), peers=not given.ours)
        print(block(page, part.name).strip(), flush=True)
        if not given.quick:
            page = with_summary(page)
            given.page.write_text(page, encoding="utf-8")
    if not given.quick and given.page == PAGE:
        draw(page, REPOSITORY / "docs" / "same-data.png")
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        report("\nstopped; the page has the parts that were done")
        sys.exit(130)
