"""Fixtures for the tests of adcs."""

from __future__ import annotations

from pathlib import Path

import pytest

from adcs.cli import main
from tests.command_line import Outcome, Run


@pytest.fixture
def adcs(capsys: pytest.CaptureFixture[str]) -> Run:
    """Run ``adcs`` with arguments in this process."""

    def run_in_process(*arguments: str | Path) -> Outcome:
        status = main([str(argument) for argument in arguments])
        return Outcome(status, *capsys.readouterr())

    return run_in_process
