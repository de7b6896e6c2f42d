"""Streams that are closed, full or read no longer, and signals: one sentence, a status that tells it, nothing left."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from arrays.array_file import write_array
from arrays.geometries import tetrahedron
from tests.magloc.cli.test_view import needs_chromium
from tests.waiting import WAIT_S, wait_for

CALLS = ("--help", "--version", "bounds --help", "wrong")


def in_shell(arguments: str, streams: str) -> subprocess.CompletedProcess[str]:
    command = f"exec {sys.executable} -m magloc.cli {arguments} {streams}"
    return subprocess.run(["sh", "-c", command], capture_output=True, text=True, timeout=WAIT_S, check=False)


class TestStreams:
    @pytest.mark.parametrize(
        ("arguments", "streams"),
        [
            pytest.param(arguments, streams, marks=[pytest.mark.slow] if (i + k) % 2 else [])
            for i, streams in enumerate((">&-", "2>&-", "<&-", "<&- >&- 2>&-"))
            for k, arguments in enumerate(CALLS)
        ],
    )
    def test_closed(self, arguments: str, streams: str) -> None:
        done = in_shell(arguments, streams)
        assert done.returncode == (2 if arguments == "wrong" else 0)
        assert "Traceback" not in done.stderr

    @pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
    @pytest.mark.parametrize("arguments", CALLS[:3])
    def test_full(self, arguments: str) -> None:
        done = in_shell(arguments, "> /dev/full")
        assert (done.returncode, done.stderr) == (2, "magloc: standard output: No space left on device\n")

    @pytest.mark.parametrize("arguments", CALLS[:3])
    def test_read_no_longer(self, arguments: str) -> None:
        reader, writer = os.pipe()
        os.close(reader)
        with os.fdopen(writer, "wb") as nobody:
            command = [sys.executable, "-m", "magloc.cli", *arguments.split()]
            done = subprocess.run(command, stdout=nobody, stderr=subprocess.PIPE, timeout=WAIT_S, check=False)
        assert (done.returncode, done.stderr) == (141, b"")


class TestSignals:
    def test_what_cannot_be_raised_elsewhere_is_still_said(self) -> None:
        """The hook that brings an interruption back swallows nothing else."""
        code = """
import sys, magloc.cli.app
class Broken:
    def __del__(self):
        raise RuntimeError("in a destructor")
def main():
    Broken()
    return 0
magloc.cli.app.main = main
from magloc.cli.entry import run_program
sys.exit(run_program("magloc"))
"""
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=WAIT_S, check=False)
        assert done.returncode == 0
        assert "RuntimeError: in a destructor" in done.stderr

    @pytest.mark.parametrize("program", ["magloc", "adcs"])
    @pytest.mark.parametrize(("number", "word"), [("SIGINT", "interrupted"), ("SIGTERM", "terminated")])
    @pytest.mark.parametrize("seen_as", ["KeyboardInterrupt", "ImportError"])  # by an extension that is half loaded
    def test_ended_while_it_loads(self, program: str, number: str, word: str, seen_as: str) -> None:
        code = f"""
import signal, sys
class Hand:
    def find_spec(self, name, *_):
        if name == "cyclopts":
            try:
                signal.raise_signal(signal.{number})
            except KeyboardInterrupt:
                raise {seen_as}
sys.meta_path.insert(0, Hand())
from {program}.cli.__main__ import main
sys.exit(main())
"""
        command = [sys.executable, "-c", code]
        done = subprocess.run(command, capture_output=True, text=True, timeout=WAIT_S, check=False)
        assert (done.returncode, done.stderr) == (128 + signal.Signals[number], f"{program}: {word}\n")

    @pytest.mark.parametrize("program", ["magloc", "adcs"])
    def test_interrupted_where_nothing_can_be_raised(self, program: str) -> None:
        """As in a callback of the collector, which swallows it; the interruption comes again."""
        code = f"""
import sys, time
import {program}.cli.app as app
class Deleted:
    def __del__(self):
        raise KeyboardInterrupt
def never_ends():
    Deleted()
    for _ in range(30_000):
        time.sleep(0.01)
app.main = never_ends
from {program}.cli.__main__ import main
sys.exit(main())
"""
        command = [sys.executable, "-c", code]
        done = subprocess.run(command, capture_output=True, text=True, timeout=WAIT_S, check=False)
        assert (done.returncode, done.stderr) == (130, f"{program}: interrupted\n")

    @pytest.mark.slow_after(1)
    @needs_chromium
    @pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
    def test_ended_with_a_browser(self, number: signal.Signals, tmp_path: Path) -> None:
        """Browser, its folder and the unfinished picture are gone, whatever ends the command."""
        write_array(tmp_path / "array.toml", tetrahedron(1.0))
        command = [sys.executable, "-m", "magloc.cli", "view", "array.toml", "--png", "out.png"]
        with TemporaryDirectory(prefix="m") as short:  # Chromium makes a socket in it, whose path must not be long
            environment = {**os.environ, "TMPDIR": short}
            with subprocess.Popen(command, cwd=tmp_path, env=environment, stderr=subprocess.PIPE, text=True) as process:
                there = Path(short).glob
                wait_for(lambda: any(there("magloc-chromium-*/DevToolsActivePort")) or process.poll() is not None)
                process.send_signal(number)
                _, err = process.communicate(timeout=WAIT_S)
            terminated = number == signal.SIGTERM
            assert (process.returncode, err) == ((143, "magloc: terminated\n") if terminated else (-9, ""))
            if not terminated:
                wait_for(lambda: not list(there("magloc-*")) and not processes_with(short))
            assert not list(there("magloc-*"))
            assert not processes_with(short)
        assert [path.name for path in tmp_path.iterdir()] == ["array.toml"]


def processes_with(word: str) -> list[int]:
    """Processes whose command line has a word; none where the system has no such list."""
    found = []
    for line in Path("/proc").glob("[0-9]*/cmdline"):
        with suppress(OSError):  # gone meanwhile
            if word.encode() in line.read_bytes():
                found.append(int(line.parent.name))
    return found
