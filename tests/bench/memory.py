"""Most that every command holds in memory, at two sizes a factor of ten apart: which grow with their input?"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass
from itertools import cycle, islice
from pathlib import Path
from tempfile import TemporaryDirectory

from tests.bench.table import Row
from tests.bench.timing import FULL, Size
from tests.fuzz.cases import write_files

TITLE = "memory: peak of a command's process, and what a row, a second or a point more takes"
TIMES = 10
# What differs from one run of a command to the next [bytes].
SCATTER = 2_000_000
# A process counts what the one that starts it has held: one that has held next to nothing starts them.
_LAUNCHER = """
import resource, subprocess, sys
status = subprocess.run(sys.argv[1:], stdout=subprocess.DEVNULL).returncode
print(status, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)
"""
_RSS_UNIT = 1 if sys.platform == "darwin" else 1024


@dataclass(frozen=True)
class Case:
    """A command line where {n} is the size, or {grid} its third root; or files are as long, then the first is stdin."""

    line: str
    size: int = 0
    unit: str = "row"
    files: tuple[str, ...] = ()
    first: str = ""


_SATELLITE = {"first": "adcs run tabletsat --duration {n} --seeds 1 --out ."}
CASES = {
    "magloc locate": Case("readings.csv --array array.toml --json", 3000, files=("readings.csv",)),
    "magloc track": Case("readings.csv --array array.toml --jsonl", 3000, files=("readings.csv",)),
    "magloc live": Case("--array array.toml --from -", 1000, files=("readings.csv",)),
    "magloc signature": Case(
        "passing.csv --array passing-array.toml --object-path passing-path.csv",
        300,
        files=("passing.csv", "passing-path.csv"),
    ),
    "magloc calibrate": Case(
        "weaving.csv --array weaving-array.toml --truth weaving-truth.csv --out out.toml",
        300,
        files=("weaving.csv", "weaving-truth.csv"),
        first="magloc simulate weaving --out weaving.csv",
    ),
    "magloc simulate": Case("simulate.toml --out out.csv", 5000, files=("simulate.toml",)),
    "magloc survey": Case("ground.csv --array ground-array.toml", 300, files=("ground.csv",)),
    "magloc qc": Case("ground.csv --array ground-array.toml", 300, files=("ground.csv",)),
    "magloc compensate": Case("flight.csv --array flight.toml --currents motor_A", 1000, files=("flight.csv",)),
    "magloc map": Case("paper --grid {grid} --out out", 8000, "point"),
    "magloc bounds": Case("map.toml --grid {grid} --moments 4 --out out", 8000, "point"),
    "magloc design": Case("task.toml --out out.toml"),
    "magloc view": Case("readings.csv --array array.toml --html out.html", 1000, files=("readings.csv",)),
    "magloc new-array": Case("out.toml --shape tetrahedron --size-m 1.5 --noise-nT 1"),
    "magloc export-config": Case("array.toml --out out.hpp"),
    "magloc columns": Case("readings.csv", 3000, files=("readings.csv",)),
    "magloc demo": Case("out"),
    "magloc warm-up": Case(""),
    "adcs run": Case("tabletsat --duration {n} --seeds 10", 100, "second"),
    "adcs run complementary": Case("--duration {n}", 6000, "second"),
    "adcs run detumbling": Case("--seeds 1 --duration {n}", 50, "second"),
    "adcs run ellipsoid": Case("--duration {n} --seeds 2", 500, "second"),
    "adcs run mockup": Case("--part fusion --duration {n} --seeds 1", 12, "second"),
    "adcs compare": Case("tabletsat eclipse --duration {n} --seeds 1", 100, "second"),
    "adcs tables": Case("--duration {n} --seeds 1", 60, "second"),
    "adcs estimate": Case("telemetry.csv --config scenario.toml", 200, **_SATELLITE),
    "adcs vectors": Case("telemetry.csv --config scenario.toml", 200, **_SATELLITE),
    "adcs calibrate": Case("telemetry.csv --config scenario.toml --out out.csv", 200, **_SATELLITE),
    "adcs view": Case("telemetry.csv --config scenario.toml --html out.html", 200, **_SATELLITE),
    "adcs loads": Case("loads.csv --array loads.toml", 3000, files=("loads.csv",)),
    "adcs live": Case("--from replay:imu.csv --replay-speed 1e9 --config imu.toml", 3000, files=("imu.csv",)),
    "adcs imu": Case("imu.csv --config imu.toml", 3000, files=("imu.csv",)),
    # A longer record of repeated pieces is no motion, and is refused.
    "adcs calibrate-log": Case("imu.csv --config imu.toml --out out.toml", 60, files=("imu.csv",)),
    "adcs stars": Case("frames --catalogue stars.csv", 10, "frame", files=("frames/input.csv", "frames/result.csv")),
    "adcs demo": Case("out"),
    "adcs warm-up": Case(""),
}


def rows(size: Size) -> Iterator[Row]:
    """A command without a size has one peak. Two commands at a time: they take longer, but hold no more."""
    with TemporaryDirectory() as made:
        pristine = Path(made) / "pristine"
        pristine.mkdir()
        write_files(pristine)

        def row(name: str) -> Row:
            case = CASES[name]
            smaller = max(1, case.size * size.rows // FULL.rows)
            sizes = [smaller, TIMES * smaller] if case.size else [0]
            return Row(name, note=told([peak(name, case, n, pristine) for n in sizes], sizes, case.unit))

        with ThreadPoolExecutor(2) as both:
            yield from both.map(row, CASES)


def told(peaks: list[int], sizes: list[int], unit: str) -> str:
    """Peaks [bytes] and their slope."""
    texts = [f"{value / 1e6:.0f} MB" for value in peaks]
    if len(peaks) == 1:
        return texts[0]
    grown = peaks[1] - peaks[0]
    slope = f"{grown / (sizes[1] - sizes[0]):,.0f} bytes a {unit}" if abs(grown) > SCATTER else "flat"
    return f"{texts[0]} at {sizes[0]:,} {unit}s, {texts[1]} at {sizes[1]:,}: {slope}"


def peak(name: str, case: Case, n: int, pristine: Path) -> int:
    """Peak [bytes] of a command with its files in a folder of its own."""
    with TemporaryDirectory() as made:
        folder = Path(made) / "files"
        shutil.copytree(pristine, folder)
        words = {"n": n, "grid": round(n ** (1.0 / 3.0))}
        if case.first:
            _run(case.first.format(**words), folder)
        for file in case.files:
            lengthen(folder / file, n)
        return _run(f"{name} {case.line}".format(**words), folder, *case.files[:1])


def lengthen(path: Path, n: int) -> None:
    """Repeat the rows of a log until there are n, with a time that goes on; or simulate for n seconds."""
    text = path.read_text()
    if path.suffix == ".toml":
        path.write_text(re.sub(r"(?m)^duration_s = .*", f"duration_s = {n}.0", text))
        return
    head, *lines = text.splitlines()
    if not head.startswith("time_s,"):
        path.write_text("".join(f"{line}\n" for line in islice(cycle([head, *lines]), n)))
        return
    logged = [(float(time), rest) for time, rest in (line.split(",", 1) for line in lines)]
    period = logged[-1][0] - logged[0][0] + logged[1][0] - logged[0][0]
    many = (f"{logged[i % len(logged)][0] + period * (i // len(logged)):.6f}" for i in range(n))
    path.write_text("\n".join([head, *(f"{time},{rest}" for time, (_, rest) in zip(many, cycle(logged)))]) + "\n")


def _run(line: str, folder: Path, stdin: str = "") -> int:
    """Peak [bytes] of a command in a folder; RuntimeError where it fails."""
    program, *words = line.split()
    command = [sys.executable, "-c", _LAUNCHER, sys.executable, "-m", f"{program}.cli", *words, "--quiet"]
    with (folder / stdin).open() if stdin else nullcontext(subprocess.DEVNULL) as source:
        done = subprocess.run(command, cwd=folder, stdin=source, capture_output=True, text=True, check=True)
    status, most = map(int, done.stdout.split())
    if status != 0:
        raise RuntimeError(f"{line}: {done.stderr.strip()}")
    return most * _RSS_UNIT
