"""The CMake package: find_package(magloc) builds the examples, which print what they print elsewhere."""

from __future__ import annotations

import re
import shutil
import subprocess
import tomllib
from pathlib import Path

import pytest

from magloc import core
from tests.conftest import REPOSITORY
from tests.test_core_examples import COMPILER, EXAMPLES, PLAIN, compiled, printed

NAMES = ("drone_heading", "satellite_3u", "hand_held_detector")
PREFIX = core.include_dir().parent
PROJECT = """cmake_minimum_required(VERSION 3.18)
project(board LANGUAGES CXX)
find_package(magloc 0.2 REQUIRED)
foreach(name {names})
  add_executable(${{name}} {folder}/${{name}}.cpp)
  target_link_libraries(${{name}} PRIVATE magloc::core)
endforeach()
"""


def test_the_examples_are_built_by_find_package(tmp_path: Path) -> None:
    """With the headers' folder as a prefix, and the same numbers as by plain includes."""
    cmake = shutil.which("cmake")
    if cmake is None or COMPILER is None:
        pytest.skip("needs cmake and a compiler")
    project = PROJECT.format(names=" ".join(NAMES), folder=EXAMPLES.as_posix())
    (tmp_path / "CMakeLists.txt").write_text(project, encoding="utf-8")
    options = [f"-DCMAKE_PREFIX_PATH={PREFIX}", f"-DCMAKE_CXX_COMPILER={COMPILER}", "-DCMAKE_CXX_FLAGS=-O2"]
    subprocess.run([cmake, "-S", tmp_path, "-B", tmp_path / "build", *options], check=True, capture_output=True)
    subprocess.run([cmake, "--build", tmp_path / "build"], check=True, capture_output=True)
    for name in NAMES:
        plain = compiled(COMPILER, f"{name}.cpp", tmp_path / name, *PLAIN)
        assert printed(tmp_path / "build" / name) == printed(plain)


def test_the_version_is_that_of_the_package() -> None:
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    text = (PREFIX / "cmake" / "magloc-config-version.cmake").read_text(encoding="utf-8")
    stated = re.search(r"PACKAGE_VERSION ([\d.]+)\)", text)
    assert stated is not None
    assert stated[1] == project["version"].partition(".dev")[0]
