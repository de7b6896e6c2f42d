"""Every command with streams and files that are closed or on a full disk: one sentence, and a status that tells it."""

from __future__ import annotations

import io
import shutil
import sys
from contextlib import chdir, redirect_stderr, redirect_stdout
from pathlib import Path

import pytest

from tests.fuzz.cases import LINES, MAINS, SELDOM, STREAM

FULL = Path("/dev/full")
COMMANDS = [pytest.param(name, marks=[pytest.mark.slow] if name in SELDOM else []) for name in LINES]
# In `make test` a full standard output is met by a command of each kind of output: text, JSON, lines, rows, nothing.
QUICK = {"adcs estimate", "adcs imu", "adcs run", "magloc columns", "magloc live", "magloc locate", "magloc new-array"}
PRINTING_NOTHING = {"magloc new-array", "magloc view", "magloc warm-up", "adcs view", "adcs warm-up"}
needs_full = pytest.mark.skipif(not FULL.exists(), reason="needs /dev/full")


@pytest.fixture
def folder(files, tmp_path, monkeypatch):
    shutil.copytree(files, tmp_path / "case")
    with chdir(tmp_path / "case"), (tmp_path / "case" / STREAM).open(encoding="utf-8") as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        yield tmp_path / "case"


def run(command, words, stdout):
    program, *name = command.split()
    with redirect_stdout(stdout), redirect_stderr(io.StringIO()) as err:
        status = MAINS[program]([*name, *words])
    return status, err.getvalue()


@needs_full
@pytest.mark.parametrize(
    "command", [pytest.param(name, marks=[] if name in QUICK else [pytest.mark.slow]) for name in LINES]
)
def test_full_standard_output(command, folder):
    with FULL.open("w") as full:
        status, err = run(command, LINES[command][0].split(), full)
    if command in PRINTING_NOTHING:
        assert status == 0
    else:
        assert (status, err.splitlines()[-1]) == (
            2,
            f"{command.split()[0]}: standard output: No space left on device",
        )


@pytest.mark.slow_after(1)
@pytest.mark.parametrize("command", COMMANDS)
def test_no_streams(command, folder, monkeypatch):
    """As the interpreter leaves them where the shell closed them: None."""
    program, *name = command.split()
    words = LINES[command][0].split()
    if "-" in words:
        pytest.skip("reads what is closed")
    with monkeypatch.context() as closed:
        for stream in ("stdin", "stdout", "stderr"):
            closed.setattr(sys, stream, None)
        status = MAINS[program]([*name, *words])
        for stream in ("stdin", "stdout", "stderr"):
            getattr(sys, stream).close()
    assert status == 0


WRITING = [
    (command, line, word)
    for command, lines in LINES.items()
    if command not in SELDOM
    for line in lines[:1]
    for word in line.split()
    if word.startswith("out.")
]


@needs_full
@pytest.mark.parametrize(("command", "line", "word"), WRITING)
def test_full_disk(command, line, word, folder):
    """The file of the output is a link to it, and stays one; nothing else is left."""
    (folder / word).symlink_to(FULL)
    before = {path.name for path in folder.rglob("*")}
    status, err = run(command, line.split(), io.StringIO())
    assert status == 2
    (sentence,) = err.splitlines()[-1:]
    assert "No space left on device" in sentence or "is a device or a pipe" in sentence
    assert word in sentence
    assert {path.name for path in folder.rglob("*")} == before
    assert (folder / word).is_symlink()
