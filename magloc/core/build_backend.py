"""Build backend: scikit-build-core, with Zig from the package index as compiler on machines that have none.

Zig compiles for other machines, too: with MAGLOC_ZIG_TARGET=aarch64-linux-gnu.2.17 in the environment a wheel is for
Linux on ARM with glibc 2.17 or newer.
"""

import base64
import hashlib
import os
import shutil
import stat
import sys
import tempfile
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from zipfile import ZIP_DEFLATED, ZipFile

from scikit_build_core import build as _build
from scikit_build_core.build import (  # the other hooks of a build backend
    build_sdist,
    get_requires_for_build_sdist,
    prepare_metadata_for_build_editable,
    prepare_metadata_for_build_wheel,
)

__all__ = [
    "build_editable",
    "build_sdist",
    "build_wheel",
    "get_requires_for_build_editable",
    "get_requires_for_build_sdist",
    "get_requires_for_build_wheel",
    "prepare_metadata_for_build_editable",
    "prepare_metadata_for_build_wheel",
]
_COMPILERS = ("c++", "g++", "clang++", "clang-cl")
_ROOT = Path(__file__).resolve().parents[2]
_TARGET = os.environ.get("MAGLOC_ZIG_TARGET", "")
Settings = dict[str, Any] | None

if _TARGET:
    _machine, _system, _library = _TARGET.split("-")
    _version = _library.removeprefix("gnu.").replace(".", "_")
    os.environ["_PYTHON_HOST_PLATFORM"] = f"many{_system}_{_version}_{_machine}"  # the tag of the wheel


def _needs_zig() -> bool:
    has_compiler = bool(os.environ.get("CXX")) or any(shutil.which(name) for name in _COMPILERS)
    return bool(_TARGET) or not has_compiler


def _requirements(hook: Callable[[Settings], list[str]], settings: Settings) -> list[str]:
    return [*hook(settings), *(["ziglang>=0.13"] if _needs_zig() else [])]


def get_requires_for_build_wheel(config_settings: Settings = None) -> list[str]:
    """Return what a build needs beyond pyproject.toml."""
    return _requirements(_build.get_requires_for_build_wheel, config_settings)


def get_requires_for_build_editable(config_settings: Settings = None) -> list[str]:
    """Return what an editable build needs beyond pyproject.toml."""
    return _requirements(_build.get_requires_for_build_editable, config_settings)


def _use_zig_where_needed() -> None:
    """Let CMake find Zig as its compiler, if there is no other one or another machine is the target.

    CMake expects programs of one word. `zig cc` compiles C++, too; `zig c++` would first compile the C++ library, which
    the kernels do not need.
    """
    if not _needs_zig():
        return
    if find_spec("ziglang") is None:
        sys.exit("magloc: found no C++ compiler, expected g++ or clang++ in PATH, or Zig: pip install ziglang.")
    folder = Path(tempfile.mkdtemp(prefix="magloc-zig-"))
    tools = {}
    compiler = f"cc -target {_TARGET}" if _TARGET else "cc"
    for variable, command in (("CC", compiler), ("CXX", compiler), ("AR", "ar"), ("RANLIB", "ranlib")):
        program = folder / f"zig-{variable.lower()}"
        program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m ziglang {command} "$@"\n', encoding="utf-8")
        program.chmod(program.stat().st_mode | stat.S_IEXEC)
        tools[variable] = str(program)
    os.environ.update(CC=tools["CC"], CXX=tools["CXX"])
    options = [os.environ.get("CMAKE_ARGS", ""), f"-DCMAKE_AR={tools['AR']}", f"-DCMAKE_RANLIB={tools['RANLIB']}"]
    if _TARGET:
        options += [
            f"-DCMAKE_SYSTEM_NAME={_system.capitalize()}",
            f"-DCMAKE_SYSTEM_PROCESSOR={_machine}",
            "-DCMAKE_STRIP=",
        ]
    os.environ["CMAKE_ARGS"] = " ".join(options)


def build_wheel(wheel_directory: str, config_settings: Settings = None, metadata_directory: str | None = None) -> str:
    """Build a wheel and return its name."""
    _use_zig_where_needed()
    return _build.build_wheel(wheel_directory, config_settings, metadata_directory)


def build_editable(
    wheel_directory: str, config_settings: Settings = None, metadata_directory: str | None = None
) -> str:
    """Build the library beside the sources, and a wheel that adds the sources to Python's path; return its name.

    scikit-build-core's own editable wheel has an import hook, which would win over PYTHONPATH.
    """
    _use_zig_where_needed()
    name = _build.build_editable(wheel_directory, config_settings, metadata_directory)
    path = Path(wheel_directory) / name
    with ZipFile(path) as wheel:
        files = {each: wheel.read(each) for each in wheel.namelist() if ".dist-info/" in each}
    files["magloc.pth"] = f"{_ROOT}\n".encode()
    record = next(each for each in files if each.endswith(".dist-info/RECORD"))
    del files[record]
    lines = [f"{each},sha256={_digest(data)},{len(data)}" for each, data in files.items()]
    files[record] = "\n".join([*lines, f"{record},,", ""]).encode()
    with ZipFile(path, "w", ZIP_DEFLATED) as wheel:
        for each, data in files.items():
            wheel.writestr(each, data)
    return name


def _digest(data: bytes) -> str:
    return base64.urlsafe_b64encode(hashlib.sha256(data).digest()).rstrip(b"=").decode()
