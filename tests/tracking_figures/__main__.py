"""Run the scenarios, and store their figures or compare them with the stored ones.

    python -m tests.tracking_figures --jobs 2
    python -m tests.tracking_figures --compare --only weaving ship

The first stores the figures of the code as it is, of the scenarios that run; the others keep theirs.
"""

from __future__ import annotations

import argparse
import logging
import os
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from fnmatch import fnmatch

from arrays.io.tables import align
from tests.tracking_figures.figures import Comparison, Figures, compare
from tests.tracking_figures.scenarios import QUICK, SCENARIOS, read_stored, store


def main() -> int:
    """Run what the command line names; 1 if a figure is worse."""
    parser = argparse.ArgumentParser(prog="python -m tests.tracking_figures", description=__doc__.partition("\n")[0])
    parser.add_argument("--compare", action="store_true", help="print old and new figures, and store nothing")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="these scenarios; * stands for any characters")
    parser.add_argument("--quick", action="store_true", help="those of make test")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--list", action="store_true", help="print names and seeds")
    given = parser.parse_args()
    patterns = given.only or (QUICK if given.quick else ["*"])
    names = [name for name in SCENARIOS if any(fnmatch(name, pattern) for pattern in patterns)]
    if not names:
        parser.error(f"--only: found no scenario of {', '.join(patterns)}")
    if given.list:
        print("\n".join(f"{name}: seeds {SCENARIOS[name].seeds}" for name in names))
        return 0
    old = read_stored() if given.compare or len(names) < len(SCENARIOS) else {}
    new: dict[str, Figures] = {}
    begin = time.perf_counter()
    for name, figures in figures_of(names, given.jobs):
        new[name] = figures
        print(f"{len(new)} of {len(names)}, {time.perf_counter() - begin:.0f} s: {name}", file=sys.stderr, flush=True)
    if not given.compare:
        store(old | new)
        return 0
    return int(print_comparisons({name: compare(old[name], new[name]) for name in names if name in old}, old, new))


def figures_of(names: Sequence[str], jobs: int) -> Iterator[tuple[str, Figures]]:
    """Names and figures, as they come."""
    if jobs == 1:
        yield from map(_figures, names)
        return
    with ProcessPoolExecutor(jobs) as pool:
        for one in as_completed([pool.submit(_figures, name) for name in names]):
            yield one.result()


def _figures(name: str) -> tuple[str, Figures]:
    logging.getLogger("magloc").setLevel(logging.ERROR)
    return name, SCENARIOS[name].figures()


def print_comparisons(
    comparisons: dict[str, list[Comparison]], old: dict[str, Figures], new: dict[str, Figures]
) -> bool:
    """Print a table of all figures, and whether one of them is worse."""
    rows = [["scenario", "figure", "old", "new", "allowed", ""]]
    for name, of_name in comparisons.items():
        for i, one in enumerate(of_name):
            rows.append([name * (i == 0), one.name, _cell(one.old), _cell(one.new), one.limit, "WORSE" * one.worse])
        rows.append(["", "cpu", _cell(old[name].cpu), _cell(new[name].cpu), "", ""])
    print("\n".join(align(rows)))
    worse = sum(one.worse for of_name in comparisons.values() for one in of_name)
    cpu = [sum(figures[name].cpu for name in comparisons) for figures in (old, new)]
    print(f"{worse} figures of {len(comparisons)} scenarios are worse; processor time {cpu[1] / cpu[0]:.2f} of the old")
    return worse > 0


def _cell(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    return "; ".join(value) if isinstance(value, tuple) else str(value)


if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    sys.exit(main())
