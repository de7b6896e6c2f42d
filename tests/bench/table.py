"""The table of ``python -m tests.bench``: one row for every comparison."""

from __future__ import annotations

import datetime
import os
import platform
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from magloc import core
from tests.bench.timing import Timing, version_of

PEERS = ("scipy", "choclo", "harmonica", "magpylib", "filterpy", "stonesoup")
COLUMNS = ("what", "ours", "peer", "ratio", "note")
LEGEND = (
    "Times: the best of all rounds, and how far their median lies above it. Ratio: the peer's time over ours, round by",
    "round, the median and the range; above 1 ours is the faster.",
)


@dataclass(frozen=True)
class Row:
    """One comparison. Without a peer's name there is nothing to compare with; without its timing it is not here."""

    what: str
    ours: Timing | None = None
    peer: str = ""
    peers: Timing | None = None
    note: str = ""

    @property
    def cells(self) -> tuple[str, ...]:
        """Text of every column."""
        peer = self.peer and f"{self.peer} {time_text(self.peers) if self.peers else 'not installed'}"
        ratio = ratio_text(self.ours, self.peers) if self.ours and self.peers else ""
        return self.what, time_text(self.ours) if self.ours else "", peer, ratio, self.note


def time_text(timing: Timing) -> str:
    """Best and spread, for example ``12.3 µs +4%``."""
    units = {"s": 1.0, "ms": 1e-3, "µs": 1e-6}
    unit, size = next((item for item in units.items() if timing.best >= item[1]), ("ns", 1e-9))
    return f"{three_digits(timing.best / size)} {unit} +{100.0 * timing.spread:.0f}%"


def ratio_text(ours: Timing, peers: Timing) -> str:
    """Median and range of the peer's time over ours, for example ``8.3 (7.9-8.8)``."""
    ratios = [b / a for a, b in zip(ours.seconds, peers.seconds, strict=True)]
    return f"{three_digits(float(np.median(ratios)))} ({three_digits(min(ratios))}-{three_digits(max(ratios))})"


def three_digits(value: float) -> str:
    """Positive number with three significant digits, or all of a longer whole part."""
    digits = 2 - int(np.floor(np.log10(value)))
    return f"{value:.{max(0, digits)}f}"


def table(groups: Sequence[tuple[str, Sequence[Row]]]) -> str:
    """All groups, in columns of one width."""
    widths = [
        max(len(cell) for cell in column)
        for column in zip(COLUMNS, *(row.cells for _, rows in groups for row in rows), strict=True)
    ]

    def line(cells: Sequence[str]) -> str:
        return " | ".join(cell.ljust(width) for cell, width in zip(cells, widths, strict=True)).rstrip()

    lines = [line(COLUMNS)]
    for title, rows in groups:
        lines.append(f"-- {title} ".ljust(sum(widths) + 3 * (len(widths) - 1), "-"))
        lines.extend(line(row.cells) for row in rows)
    return "\n".join(lines)


def header() -> str:
    """When, on what, and with which versions."""
    lines = [
        f"{datetime.datetime.now().astimezone():%Y-%m-%d %H:%M %z}, {_cpu_model()}, "
        f"{core.threads()} threads, load {_load()} before the run",
        f"Python {platform.python_version()}, numpy {np.__version__}, "
        + ", ".join(f"{peer} {version_of(peer)}" for peer in PEERS),
        *LEGEND,
    ]
    return "\n".join(lines)


def _cpu_model() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def _load() -> str:
    """Processes that wanted to run in the last minute, on systems that count them."""
    return f"{os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else "unknown"
