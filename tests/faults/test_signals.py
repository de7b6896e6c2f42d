"""Every command, ended by a signal at a random moment: whole files or none, a status that tells it, nothing left."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import netCDF4
import pytest

from tests.conftest import REPOSITORY
from tests.fuzz.cases import LINES, SELDOM, STREAM
from tests.waiting import WAIT_S, wait_for

QUICK, FULL = 6, 3 * len(LINES)  # at the end, each command has met each signal
CHUNK = 10
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGKILL)
# The moment is one of our program, not of the interpreter's own start.
PROGRAM = "import os, sys; from {}.cli.__main__ import main; os.write({}, b'.'); sys.exit(main())"


class Case(NamedTuple):
    """What is ended, by which signal, and when."""

    command: str
    line: str
    number: signal.Signals
    after_s: float


def made_case(seed: int) -> Case:
    """The case of a seed; each command and signal comes as often as each other."""
    rng = random.Random(seed)
    command = sorted(LINES)[seed % len(LINES)]
    return Case(
        command,
        rng.choice(LINES[command]),
        SIGNALS[seed // len(LINES) % len(SIGNALS)] if seed >= QUICK else SIGNALS[seed % len(SIGNALS)],
        (6.0 if command in SELDOM else 3.0) * rng.random() ** 1.5,
    )


def faults(case: Case, files: Path, folder: Path) -> Iterator[str]:
    """What is wrong with how a case ends."""
    shutil.copytree(files, folder)
    before = names_in(folder)
    with tempfile.TemporaryDirectory() as short:  # Chromium makes a socket in it, whose path must not be long
        yield from _faults(case, folder, before, Path(short))


def _faults(case: Case, folder: Path, before: set[str], temporary: Path) -> Iterator[str]:
    status, err = ended(case, folder, temporary)
    wanted = 128 + case.number
    if status not in (0, wanted):
        yield f"status {status}, expected {wanted}"
    if "Traceback" in err or "Exception ignored" in err:
        yield "a traceback"
    if status == 0 and case.number != signal.SIGKILL and ": interrupted" in err:
        yield "interrupted with status 0"
    made = names_in(folder) - before
    yield from (f"half of {name}" for name in sorted(made) if not is_whole(folder / name))
    # Who is killed cannot take away his own unfinished files; they are hidden, and in nobody's way.
    left = [name for name in made if case.number != signal.SIGKILL and Path(name).name.startswith(".")]
    left += [path.name for path in temporary.iterdir() if case.number != signal.SIGKILL or "chromium" in path.name]
    if left:
        yield f"left behind: {left[:3]}"


def ended(case: Case, folder: Path, temporary: Path) -> tuple[int, str]:
    """The status, as a shell counts it, and stderr of a command that a signal meets; all its processes are gone."""
    program, *name = case.command.split()
    reader, writer = os.pipe()
    words = [*name, *case.line.split()]
    if "--json" not in words and "view" in name:
        words = [word.replace("out.html", "out.png") for word in ("--png" if w == "--html" else w for w in words)]
    with (
        (folder / STREAM).open("rb") as stdin,
        subprocess.Popen(
            [sys.executable, "-c", PROGRAM.format(program, writer), *words],
            cwd=folder,
            env={**os.environ, "PYTHONPATH": str(REPOSITORY), "TMPDIR": str(temporary), "MPLBACKEND": "agg"},
            stdin=stdin,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            pass_fds=(writer,),
            start_new_session=True,
        ) as process,
    ):
        os.close(writer)
        os.read(reader, 1)
        os.close(reader)
        time.sleep(case.after_s)
        process.send_signal(case.number)
        _, err = process.communicate(timeout=WAIT_S)
    wait_for(lambda: not group_lives(process.pid) and not any(temporary.glob("magloc-chromium-*")))
    return process.returncode if process.returncode >= 0 else 128 - process.returncode, err


def group_lives(group: int) -> bool:
    """Whether a process of a group is left."""
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


def names_in(folder: Path) -> set[str]:
    """Files of a folder, those of a store apart, which has marks of its own for what is done."""
    names = (str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())
    return {name for name in names if ".zarr/" not in name}


def is_whole(path: Path) -> bool:
    """Whether a file ends as one of its kind does."""
    if path.name.startswith("."):
        return True  # not yet in its place
    data = path.read_bytes()
    match path.suffix:
        case ".png":
            return data.endswith(b"IEND\xaeB`\x82")
        case ".json":
            return bool(json.loads(data))
        case ".toml":
            return bool(tomllib.loads(data.decode()))
        case ".html":
            return data.rstrip().endswith(b"</html>")
        case ".nc":
            netCDF4.Dataset(path).close()  # refuses what is cut short
            return True
    return data.endswith(b"\n")


@pytest.mark.skipif(os.name != "posix", reason="needs signals")
@pytest.mark.parametrize(
    "first", [0, *(pytest.param(i, marks=pytest.mark.slow) for i in range(QUICK, QUICK + FULL, CHUNK))]
)
def test_ended_at_any_moment(first, files, tmp_path):
    found = []
    for seed in range(first, first + (CHUNK if first else QUICK)):
        (place := tmp_path / str(seed)).mkdir()
        case = made_case(seed)
        found += [f"seed {seed}: {case}: {fault}" for fault in faults(case, files, place / "case")]
    assert not found, "\n".join(found)
