"""``make bench``: how fast, as ratios to peers that run in turn with ours, in one process on the same problems."""

from __future__ import annotations

import argparse
import sys
import time

from tests.bench import (
    attitude,
    bounds,
    complementary,
    fields,
    filters,
    fixes,
    inertial,
    maps,
    memory,
    mockup,
    recording,
    sources,
    stars,
)
from tests.bench.table import header, table
from tests.bench.timing import FULL, QUICK, Size

GROUPS = {
    "fields": fields,
    "fixes": fixes,
    "sources": sources,
    "filters": filters,
    "complementary": complementary,
    "inertial": inertial,
    "attitude": attitude,
    "maps": maps,
    "bounds": bounds,
    "mockup": mockup,
    "stars": stars,
    "recording": recording,
    "memory": memory,
}


def report(names: list[str], size: Size) -> str:
    """Header and table of some groups."""
    head = header()  # before our own work loads the machine
    groups = []
    for name in names:
        print(f"{name} ...", end="", file=sys.stderr, flush=True)
        began = time.perf_counter()
        groups.append((GROUPS[name].TITLE, list(GROUPS[name].rows(size))))
        print(f" {time.perf_counter() - began:.0f} s", file=sys.stderr, flush=True)
    return f"{head}\n\n{table(groups)}"


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench", description=__doc__)
    parser.add_argument("group", nargs="*", help=f"any of {', '.join(GROUPS)} (default: all)")
    parser.add_argument("--quick", action="store_true", help="fewer repeats and smaller samples")
    arguments = parser.parse_args()
    if unknown := set(arguments.group) - set(GROUPS):
        parser.error(f"group must be any of {', '.join(GROUPS)}; instead received {', '.join(sorted(unknown))}")
    print(report(arguments.group or list(GROUPS), QUICK if arguments.quick else FULL))
    return 0


if __name__ == "__main__":
    sys.exit(main())
