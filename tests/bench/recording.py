"""Fixes of a recording of a magnet over thirty magnetometers; there is no peer."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from arrays.array_file import read_array
from magloc import core
from magloc.readings import read_readings
from tests.bench.table import Row
from tests.bench.timing import Contestant, Size, interleaved
from tests.plain_locator import plain_locator

TITLE = "recording: fixes of a magnet over 30 vector sensors"


def rows(size: Size) -> Iterator[Row]:
    """Skipped with a notice if the recording is not there."""
    folder = Path(os.environ.get("MAGLOC_DATA", "../shared/data")) / "magnet-array"
    if not folder.is_dir():
        yield Row("a fix", note="skipped: the recording is not there (set MAGLOC_DATA)")
        return
    array = read_array(folder / "array.toml")
    readings = read_readings(folder / "readings.csv", array).values_T[: size.rows]
    locator = plain_locator(array, body_length_m=0.0)
    threads = core.threads()
    contestants = {n: Contestant(lambda: locator.fit_rows(readings), n, len(readings)) for n in {1, threads}}
    for n, timing in sorted(interleaved(contestants, size.rounds).items()):
        yield Row(f"a fix, {n} thr.", timing, note=f"{1.0 / timing.best:,.0f} rows per second, {len(readings):,} rows")
