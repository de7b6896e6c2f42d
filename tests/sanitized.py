"""Programs of random updates, compiled with sanitizers where the compiler has them."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from magloc import core
from tests.test_core_examples import COMPILER


def check_random_updates(source: Path, count: int, folder: Path, *flags: str) -> None:
    """Run a program with so many updates in double and in float, and check the counts that it prints."""
    if COMPILER is None:
        pytest.skip("no C++ compiler")
    program = folder / "random_updates"
    includes = [f"-I{core.include_dir()}", f"-I{Path(__file__).parent}"]
    command = [
        COMPILER,
        "-std=c++17",
        "-O1",
        *flags,
        *includes,
        "-Wall",
        "-Wextra",
        "-Werror",
        str(source),
        "-o",
        str(program),
    ]
    sanitizers = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    if subprocess.run([*command, *sanitizers], check=False, capture_output=True).returncode:
        subprocess.run(command, check=True)
    done = subprocess.run([program, str(count)], check=True, capture_output=True, encoding="utf-8")
    words = dict(line.split() for line in done.stdout.splitlines())
    assert int(words["updates"]) == 2 * count
    assert int(words["refused"]) > count // 10
    assert int(words["not_finite"]) == 0
