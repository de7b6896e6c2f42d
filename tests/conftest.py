"""Fixtures for all tests."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from adcs.cli.app import main as adcs_main
from magloc.cli.app import main
from tests.command_line import Outcome, Run

REPOSITORY = Path(__file__).parents[1]

# The same examples in every run of `make test`, new ones in every run of `make test-full`. Neither asks the clock.
for profile, derandomize in (("fixed", True), ("random", False)):
    settings.register_profile(
        profile, derandomize=derandomize, deadline=None, suppress_health_check=[HealthCheck.too_slow]
    )
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "fixed"))


@pytest.fixture(scope="session")
def data_folder() -> Path:
    """Folder of recordings: the one that MAGLOC_DATA names, else ``../shared/data`` beside the repository."""
    named = os.environ.get("MAGLOC_DATA")
    beside = REPOSITORY.parent / "shared" / "data"
    for folder in (Path(named) if named else beside, beside):
        if folder.is_dir():
            return folder
    pytest.skip("needs recordings, but neither MAGLOC_DATA nor ../shared/data is a folder")


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    """Run ``magloc`` with arguments in this process."""

    def run_in_process(*arguments: str | Path) -> Outcome:
        status = main([str(argument) for argument in arguments])
        return Outcome(status, *capsys.readouterr())

    return run_in_process


@pytest.fixture
def adcs(capsys: pytest.CaptureFixture[str]) -> Run:
    """Run ``adcs`` with arguments in this process."""

    def run_in_process(*arguments: str | Path) -> Outcome:
        status = adcs_main([str(argument) for argument in arguments])
        return Outcome(status, *capsys.readouterr())

    return run_in_process
