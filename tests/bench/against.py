"""``make bench-against REV=…``: processor time of this code against that of another revision, built beside it.

Both run the same cases in turn, each in a process of its own with one thread, and the shortest of several samples
counts. ``--isa baseline`` confines this code's kernels, BLAS and numba to what every x86-64 processor has.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

Work = tuple[Callable[[], object], int]
"""What to time, and how many units of work a call does."""
ROOT = Path(__file__).resolve().parents[2]
SAMPLE_S = 0.3
_ON_ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS", "MAGLOC_NUM_THREADS"), "1")
_BASELINE = {"MAGLOC_ISA": "baseline", "OPENBLAS_CORETYPE": "Nehalem", "NUMBA_CPU_NAME": "nehalem"}
_IMPORTS = "import numpy, scipy.spatial.transform"
_FIRST_FIX = "import magloc; b = magloc.datasets.load('board'); magloc.Locator(b.array).fit(b.readings.values_T[0])"


def _sphere(n: int) -> Any:
    """Array of vector sensors on a sphere of 1.5 m."""
    from arrays.array import SensorArray
    from arrays.sensor import Sensor
    from magloc.directions import fibonacci_directions

    places = 1.5 * fibonacci_directions(n)
    return SensorArray(tuple(Sensor(f"s{i}", "vector", position_m=p, noise_T=1e-9) for i, p in enumerate(places)))


def _readings(array: Any, n: int, n_sources: int = 1) -> Any:
    """Readings (n, C) of sources of 300 A·m² at 2 to 8 m."""
    import numpy as np

    from magloc.measurement.differences import predicted_channels

    rng = np.random.default_rng(2)
    values = rng.normal(scale=array.channel_noise_T, size=(n, array.n_channels)) + array.channel_offset_T
    ambient = predicted_channels(array, np.full((1, 3), 100.0), np.zeros((1, 3)))
    for _ in range(n_sources):
        place, moment = rng.normal(size=(2, n, 3))
        place *= rng.uniform(2.0, 8.0, (n, 1)) / np.linalg.norm(place, axis=1, keepdims=True)
        moment *= 300.0 / np.linalg.norm(moment, axis=1, keepdims=True)
        values += predicted_channels(array, place, moment) - ambient
    return values + ambient


def _locate(n_sensors: int, n_rows: int, n_sources: int = 1) -> Work:
    from magloc import Locator

    array = _sphere(n_sensors)
    locator, readings = Locator(array, sources=n_sources), _readings(array, n_rows, n_sources)
    return lambda: locator.fit_rows(readings).covariance if n_sources == 1 else locator.fit_rows(readings), n_rows


def _one_row() -> Work:
    from magloc import Locator

    array = _sphere(4)
    locator, (reading,) = Locator(array), _readings(array, 1)
    return lambda: locator.fit(reading).best, 1


def _moduli() -> Work:
    from dataclasses import replace

    from arrays.geometries import cube
    from magloc import Locator

    array = replace(cube(1.5, kind="scalar", noise_T=1e-11), ambient_T=(2e-5, 1e-6, 4.5e-5))
    locator, readings = Locator(array), _readings(array, 200)
    return lambda: locator.fit_rows(readings).covariance, len(readings)


def _map(name: str) -> Work:
    import numpy as np

    from magloc.convergence import filters
    from magloc.convergence.over_starts import StartsScenario, simulate_measurement

    scenario = StartsScenario()
    _, measurement, z = simulate_measurement(scenario)
    axis = np.linspace(-20.0, 20.0, 13)
    starts = np.zeros((13**3, 6))
    starts[:, :3] = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    method = getattr(filters, name)()
    return lambda: method.run(measurement, z, starts), len(starts)


def _mekf(*states: str) -> Work:
    from adcs.kalman.mekf import run_filter
    from tests.adcs.filter_runs import runs_for, settings

    chosen = settings("mag+sun+gyro", states)
    runs, start = runs_for(chosen.sensors, 300.0, range(10))
    return lambda: run_filter(runs, chosen, start), runs.q.size // 4


def _bounds(kind: str) -> Work:
    from dataclasses import replace

    import numpy as np

    from arrays.geometries import cube, tetrahedron
    from magloc.bounds.over_moments import sigma_table
    from magloc.directions import moments_on_sphere

    scalar = replace(cube(1.5, kind="scalar", noise_T=1e-11), ambient_T=(2e-5, 1e-6, 4.5e-5))
    array = tetrahedron(1.5) if kind == "vector" else scalar
    places, moments = np.random.default_rng(8).uniform(-20.0, 20.0, (1000, 3)), moments_on_sphere(100.0, 51)
    return lambda: sigma_table(array, places, moments), len(places) * len(moments)


CASES: dict[str, Callable[[], Work]] = {
    "locate, 4 sensors": lambda: _locate(4, 2000),
    "locate, 30 sensors": lambda: _locate(30, 1000),
    "locate, 128 sensors": lambda: _locate(128, 300),
    "locate, one row alone": _one_row,
    "locate, two sources": lambda: _locate(30, 20, 2),
    "locate, moduli": _moduli,
    "map, iekf": lambda: _map("IekfFilter"),
    "map, repeated": lambda: _map("RepeatedFilter"),
    "map, damped": lambda: _map("DampedFilter"),
    "MEKF, 6 states": _mekf,
    "MEKF, 12 states": lambda: _mekf("gyro-bias", "field-bias"),
    "MEKF, 30 states": lambda: _mekf("field-bias", "gyro-bias", "disturbance", "field-model", "dipole", "field-gain"),
    "bounds, vectors": lambda: _bounds("vector"),
    "bounds, moduli": lambda: _bounds("scalar"),
}
"""Processor time of a unit of work: a row, a start, a step, a source."""
PROCESSES: dict[str, tuple[list[str], list[str] | None]] = {
    "import and first fix": (["-c", f"{_IMPORTS}; {_FIRST_FIX}"], ["-c", _IMPORTS]),
    "magloc locate, 100 rows": (
        [
            "-m",
            "magloc.cli",
            "locate",
            "--quiet",
            "--array",
            "magloc/datasets/board-array.toml",
            "magloc/datasets/board.csv",
        ],
        None,
    ),
}
"""Processor time of a whole process, and of one that is taken off it."""


def work(name: str) -> None:
    """Time a case once for every line that comes."""
    run, count = CASES[name]()
    run(), run()
    for _ in sys.stdin:
        shortest, until = float("inf"), time.process_time() + SAMPLE_S
        while time.process_time() < until:
            began = time.process_time()
            run()
            shortest = min(shortest, time.process_time() - began)
        print(shortest / count, flush=True)


def of_processes(trees: Sequence[Path], name: str, rounds: int, environment: dict[str, str]) -> list[float]:
    """Shortest processor time of a process of every tree; a first one, that compiles, does not count."""
    command, less = PROCESSES[name]

    def once(tree: Path, command: list[str]) -> float:
        began = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run(
            [sys.executable, "-P", *command],
            cwd=tree,
            env=_of(tree, environment),
            check=True,
            stdout=subprocess.DEVNULL,
        )
        ended = resource.getrusage(resource.RUSAGE_CHILDREN)
        return ended.ru_utime + ended.ru_stime - began.ru_utime - began.ru_stime

    times = [[(once(tree, command), once(tree, less) if less else 0.0) for tree in trees] for _ in range(rounds + 1)]
    return [min(a[i][0] for a in times[1:]) - min(a[i][1] for a in times[1:]) for i in range(len(trees))]


def of_calls(trees: Sequence[Path], name: str, rounds: int, environment: dict[str, str]) -> list[float]:
    """Shortest processor time of a unit of a case in every tree, in processes that go on."""
    workers = [
        subprocess.Popen(
            [sys.executable, "-P", __file__, "--work", name, "-"],
            cwd=tree,
            env=_of(tree, environment),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        for tree in trees
    ]
    shortest = [float("inf")] * len(trees)
    for _ in range(rounds):
        for i, worker in enumerate(workers):
            assert worker.stdin
            assert worker.stdout
            print(file=worker.stdin, flush=True)
            answer = worker.stdout.readline()
            if answer:
                shortest[i] = min(shortest[i], float(answer))
    for worker in workers:
        worker.communicate()
    return shortest


def _of(tree: Path, environment: dict[str, str]) -> dict[str, str]:
    return {**os.environ, **_ON_ONE_THREAD, **environment, "PYTHONPATH": str(tree)}


def tree_of(revision: str) -> Path:
    """Files of a revision, in a git worktree of their own, with the kernels built if it has some."""
    sha = subprocess.run(
        ["git", "rev-parse", "--short", revision + "^{commit}"], cwd=ROOT, check=True, capture_output=True, text=True
    )
    tree = ROOT / "build" / f"against-{sha.stdout.strip()}"
    if not tree.exists():
        subprocess.run(
            ["git", "worktree", "add", "--force", "--quiet", "--detach", tree, revision], cwd=ROOT, check=True
        )
    core = tree / "magloc" / "core"
    if (core / "CMakeLists.txt").exists() and not (core / "kernels.so").exists():
        options = [f"-DPython_EXECUTABLE={sys.executable}", "-DSKBUILD_STATE=editable"]
        subprocess.run(["cmake", "-G", "Ninja", "-S", core, "-B", tree / "build", *options], check=True)
        subprocess.run(["cmake", "--build", tree / "build"], check=True)
    return tree


def main() -> int:
    """Print a line for every case."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.against", description=__doc__)
    parser.add_argument("revision")
    parser.add_argument("case", nargs="*", help="words of a case; any of: " + "; ".join([*CASES, *PROCESSES]))
    parser.add_argument("--isa", choices=["best", "baseline"], default="best")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--work", help=argparse.SUPPRESS)
    arguments = parser.parse_intermixed_args()
    if arguments.work:
        work(arguments.work)
        return 0
    environment = _BASELINE if arguments.isa == "baseline" else {}
    trees = [tree_of(arguments.revision), ROOT]
    print(f"{'processor time':26}{arguments.revision:>12}{'now':>12}{'ratio':>8}")
    for name in (*CASES, *PROCESSES):
        if arguments.case and not any(words in name for words in arguments.case):
            continue
        timed = of_calls if name in CASES else of_processes
        old, new = timed(trees, name, arguments.rounds, environment)
        print(f"{name:26}{_text(old):>12}{_text(new):>12}{new / old:8.2f}", flush=True)
    return 0


def _text(seconds: float) -> str:
    unit, factor = next((u, f) for u, f in (("s", 1.0), ("ms", 1e3), ("µs", 1e6)) if seconds * f >= 1.0 or u == "µs")
    return f"{seconds * factor:.3g} {unit}"


if __name__ == "__main__":
    sys.exit(main())
