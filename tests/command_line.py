"""Running the command lines in the tests' own process, and what every command has in common."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple


class Outcome(NamedTuple):
    """What a run of the command line left behind."""

    status: int
    out: str
    err: str


Run = Callable[..., Outcome]


def refuse_constant(name: str) -> None:
    raise AssertionError(f"{name} is not JSON")


def results_of(outcome: Outcome) -> list[dict[str, Any]]:
    assert outcome.status == 0, outcome.err
    parsed = json.loads(outcome.out, parse_constant=refuse_constant)
    assert set(parsed) - {"innovations"} == {"results", "warnings"}
    results: list[dict[str, Any]] = parsed["results"]
    return results


def assert_refused(outcome: Outcome, *fragments: str) -> None:
    """Exit status 2 and one line on stderr that says what and where."""
    assert outcome.status == 2
    lines = outcome.err.splitlines()
    assert len(lines) == 1, outcome.err
    assert lines[0].startswith("magloc: ")
    assert "Traceback" not in outcome.err
    for fragment in fragments:
        assert fragment in lines[0]


@contextmanager
def viewer_started(*arguments: str | Path) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """``magloc view`` in a process of its own, and the address that it prints."""
    command = [sys.executable, "-m", "magloc.cli", "view", *map(str, arguments)]
    environment = {**os.environ, "MAGLOC_NUM_THREADS": "1"}
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
    ) as process:
        try:
            assert process.stdout is not None
            yield process, process.stdout.readline().strip()
        finally:
            process.kill()
