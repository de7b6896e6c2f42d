"""A package of another distribution that has the name of ours."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import REPOSITORY


@pytest.mark.parametrize("name", ["arrays", "sims"])
@pytest.mark.parametrize("ours", ["magloc", "adcs"])
def test_a_foreign_package_is_refused_in_a_sentence(name: str, ours: str, tmp_path: Path) -> None:
    (tmp_path / name).mkdir()
    (tmp_path / name / "__init__.py").write_text("")
    path = os.pathsep.join([str(tmp_path), str(REPOSITORY)])
    command = [sys.executable, "-c", f"import {ours}"]
    ended = subprocess.run(command, env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True, cwd=tmp_path)
    assert ended.returncode == 1
    said = ended.stderr.splitlines()[-1]
    assert said.startswith(f"ImportError: magloc found the package {name} at {tmp_path}")
    assert said.endswith("Install magloc into a separate environment.")
