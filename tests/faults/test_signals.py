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
PROGRAM = """\
import importlib, os, sys, types
from magloc.cli import entry
from {}.cli.__main__ import main
def load(name):  # the handlers exist now; a signal before them ends the process as the system does
    os.write({}, b".")
    return importlib.import_module(name)
entry.importlib = types.SimpleNamespace(import_module=load)
sys.exit(main())
"""


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


# A program whose modules swallow what is raised while they load, as some libraries do.
GREEDY = """
import os, signal, time
try:
    os.kill(os.getpid(), signal.{name})
    time.sleep(0.01)
except BaseException:
    pass
print("loaded", flush=True)
"""
LOADS_FIRST = "import greedy, time\ndef main():\n    time.sleep(60)\n"
LOADS_LATER = "import time\ndef main():\n    import greedy\n    time.sleep(60)\n"
NEVER_ENDS = """
import time
def main():
    word = "runs"
    while True:
        try:
            print(word, flush=True)
            time.sleep(60)
        except BaseException:
            word = "swallowed"
"""
TIDIES_UP = """
import os, signal, time
def main():
    try:
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(60)
    finally:
        os.kill(os.getpid(), signal.SIGTERM)
        print("tidied", flush=True)
"""
ENTER = "import sys; from magloc.cli.entry import run_program; sys.exit(run_program('greedy_program'))"


@pytest.mark.skipif(os.name != "posix", reason="needs signals")
class TestEntry:
    @pytest.fixture
    def start(self, tmp_path):
        """Start a program whose application has a source text."""

        def started(app: str, name: str = "SIGTERM") -> subprocess.Popen[str]:
            (folder := tmp_path / "greedy_program" / "cli").mkdir(parents=True)
            (folder / "app.py").write_text(app)
            (tmp_path / "greedy.py").write_text(GREEDY.format(name=name))
            return subprocess.Popen(
                [sys.executable, "-c", ENTER],
                env={**os.environ, "PYTHONPATH": os.pathsep.join([str(REPOSITORY), str(tmp_path)])},
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
            )

        return started

    @pytest.mark.parametrize("app", [LOADS_FIRST, LOADS_LATER], ids=["first", "later"])
    @pytest.mark.parametrize(("name", "said"), [("SIGINT", "interrupted"), ("SIGTERM", "terminated")])
    def test_one_that_a_loading_module_swallows_acts_when_it_is_loaded(self, start, app, name, said):
        with start(app, name) as process:
            out, err = process.communicate(timeout=WAIT_S)
        assert (process.returncode, out, err) == (
            128 + signal.Signals[name],
            "loaded\n",
            f"greedy_program: {said}\n",
        )

    @pytest.mark.parametrize("first", [signal.SIGINT, signal.SIGTERM])
    @pytest.mark.parametrize("second", [signal.SIGINT, signal.SIGTERM])
    def test_the_second_one_ends_a_program_that_swallows_the_first(self, start, first, second):
        with start(NEVER_ENDS) as process:
            process.stdout.readline()
            process.send_signal(first)
            assert process.stdout.readline() == "swallowed\n"
            time.sleep(0.2)
            process.send_signal(second)
            assert process.wait(timeout=WAIT_S) == 128 + second

    def test_the_same_one_twice_at_once_lets_it_tidy_up(self, start):
        with start(TIDIES_UP) as process:
            out, err = process.communicate(timeout=WAIT_S)
        assert (process.returncode, out, err) == (143, "tidied\n", "greedy_program: terminated\n")
