"""Notebooks as tests (``pytest --nbmake notebooks``): their warnings are errors, as everywhere else."""

import os
import sys
from collections.abc import Generator
from pathlib import Path

import pytest

from tests.notebooks import KERNEL_WARNINGS


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None, object, object]:
    """Give the notebook's kernel a separate environment; it inherits this process's."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONWARNINGS", KERNEL_WARNINGS)
        patch.setenv("JUPYTER_PLATFORM_DIRS", "1")
        patch.setenv("PATH", str(Path(sys.executable).parent), prepend=os.pathsep)  # the commands of this Python
        return (yield)
