"""Long runs: memory stays flat, and covariances stay positive definite."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from threading import Thread

import numpy as np
import pytest

import sims
from adcs.complementary.names import METHODS
from adcs.kalman.names import FILTERS
from tests.waiting import WAIT_S

GROWTH_MIB = 20.0
ROWS = 100_000
STATUS = "/proc/{}/status"

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not Path(STATUS.format("self")).exists(), reason="needs /proc"),
]


def resident_mib(pid: int) -> float:
    """What a process holds in memory."""
    (line,) = (line for line in Path(STATUS.format(pid)).read_text().splitlines() if line.startswith("VmRSS"))
    return int(line.split()[1]) / 1024.0


def endless(readings: Path) -> Iterator[str]:
    """Lines of a file again and again, with a time that goes on."""
    header, *lines = readings.read_text().splitlines()
    assert header.startswith("time_s,")
    rows = [line.split(",", 1) for line in lines]
    period = float(rows[-1][0]) + float(rows[1][0])
    yield header
    begin = 0.0
    while True:
        for time, rest in rows:
            yield f"{begin + float(time):.6f},{rest}"
        begin += period


def test_stream_of_rows(tmp_path: Path) -> None:
    """A source that comes back all the time: it is lost and found again."""
    scenario = sims.read_scenario("weaving")
    assert isinstance(scenario, sims.MagneticScenario)
    files = sims.write_simulation(sims.simulate(scenario, 0), tmp_path / "log.csv")
    command = [sys.executable, "-m", "magloc.cli", "track", "-", "--array", str(files.array), "--quiet"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        stdin, stdout = process.stdin, process.stdout
        assert stdin is not None
        assert stdout is not None

        def feed() -> None:
            with stdin:
                for line, _ in zip(endless(files.readings), range(1 + ROWS), strict=False):
                    stdin.write(line + "\n")

        feeder = Thread(target=feed)
        feeder.start()
        early, tracked = 0.0, 0
        for number, line in enumerate(stdout, start=1):
            entry = json.loads(line)
            if entry["position_m"] is not None:
                tracked += 1
                assert number % 50 or np.linalg.eigvalsh(np.asarray(entry["covariance"]))[0] > 0.0
            if number == ROWS // 10:
                early = resident_mib(process.pid)
            if number == ROWS - 1:
                late = resident_mib(process.pid)
        feeder.join(WAIT_S)
    assert (process.returncode, number) == (0, ROWS)
    assert tracked > 0.5 * ROWS
    assert late - early < GROWTH_MIB


def peak_mib(*words: str) -> float:
    """Most that a run of ``adcs`` holds in memory; it must say that no run diverged.

    Attitude filters have a tenth of the memory for the runs that are computed together, so that few runs fill it.
    """
    script = (
        "import resource, sys; from adcs.cli.app import main; from sims.experiments import attitude;"
        "attitude._NUMBERS_AT_ONCE //= 10; status = main(sys.argv[1:]);"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, file=sys.stderr); sys.exit(status)"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, "run", *words, "--json", "--quiet"], capture_output=True, text=True, check=True
    )
    assert json.loads(done.stdout).get("diverged_runs", 0) == 0
    return int(done.stderr) / 1024.0


@pytest.mark.parametrize(
    ("words", "few", "many", "kept_bytes"),
    [
        # Error, NEES and the NIS of four sensors are kept of the last minute. Of six states, 221 runs are computed
        # together, of nine 98.
        *((("tabletsat", "--filter", name, "--duration", "500"), 230, 680, 6 * 8 * 61) for name in FILTERS),
        *((("complementary", "--filter", name), 40, 120, 0) for name in METHODS),
        (("ellipsoid",), 1000, 4000, 0),
    ],
)
def test_runs_of_attitude_filters(words: tuple[str, ...], few: int, many: int, kept_bytes: int) -> None:
    """More runs, beyond those that are computed together, take no more memory than what is kept of each."""
    peaks = [peak_mib(*words, "--seeds", str(n)) for n in (few, many)]
    assert peaks[1] - peaks[0] < GROWTH_MIB + (many - few) * kept_bytes / 2**20
