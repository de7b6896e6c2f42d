"""``make bench``: how fast, as ratios measured in one run wherever there is a peer."""

from __future__ import annotations

import os
import platform
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numba
import numpy as np

from arrays.files import read_array
from magloc.locate import Locator
from magloc.readings import read_readings


def best_of(repeats: int, function: Callable[[], object]) -> float:
    """Shortest duration [s] of some calls, after one that is not counted."""
    function()
    durations = []
    for _ in range(repeats):
        begin = time.perf_counter()
        function()
        durations.append(time.perf_counter() - begin)
    return min(durations)


def recording() -> None:
    """All rows of the recording of a magnet over thirty magnetometers."""
    folder = Path(os.environ.get("MAGLOC_DATA", "../shared/data")) / "magnet-array"
    if not folder.is_dir():
        print("magnet-array: skipped, the recording is not there (set MAGLOC_DATA)")
        return
    array = read_array(folder / "array.toml")
    readings = read_readings(folder / "readings.csv", array).values_T
    locator = Locator(array)
    seconds = best_of(3, lambda: locator.fit_rows(readings))
    print(
        f"magnet-array: {len(readings)} rows of 30 sensors in {seconds:.2f} s ({1e6 * seconds / len(readings):.0f} µs)"
    )


def main() -> int:
    """Print the table."""
    print(f"{platform.processor() or platform.machine()}, {numba.get_num_threads()} threads, numpy {np.__version__}")
    recording()
    return 0


if __name__ == "__main__":
    sys.exit(main())
