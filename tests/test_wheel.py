"""The wheel holds all of the packages, their data, the library and its headers; the one from the sdist is the same."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tarfile
import zipfile
from email.parser import Parser
from pathlib import Path

import pytest

from magloc import core
from tests.conftest import REPOSITORY
from tests.test_core_examples import COMPILER
from tests.test_house import PACKAGES
from tests.test_packaging import PROJECT
from tests.test_portability import names
from tests.waiting import WAIT_S

pytest.importorskip("scikit_build_core", reason="needs scikit-build-core, of the extra test")
ONLY_TO_BUILD = (".cpp", "CMakeLists.txt", "core/build_backend.py", "core/declare.py")
LIBRARY = ("magloc/core/kernels.", "magloc/core/_declarations.py")
BUILD_S = 1800.0
"""Longest time that a build takes on a busy machine."""


def made(kind: str, tree: Path, place: Path) -> Path:
    """Build a wheel or an sdist of a tree, as pip does, in the folder of the tests."""
    code = f"from build_backend import build_{kind} as build; print(build({str(place)!r}))"
    environment = {
        **os.environ,
        "PYTHONPATH": str(tree / "magloc" / "core"),
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",  # cmake and ninja
        "SKBUILD_BUILD_DIR": str(place / "build"),
        # What a wheel holds does not depend on them, and the build is shorter.
        "CMAKE_ARGS": "-DMAGLOC_SETS=baseline -DMAGLOC_OPTIMISATION=-O0",
        "PYTHONDONTWRITEBYTECODE": "1",  # a build must not add files to the tree that another test lists
    }
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tree, stdout=subprocess.PIPE, encoding="utf-8", timeout=BUILD_S, check=True,
        env=environment,
    )  # fmt: skip
    return place / done.stdout.split()[-1]


def contents(wheel: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(wheel) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    if COMPILER is None:
        pytest.skip("needs a compiler")
    return contents(made("wheel", REPOSITORY, tmp_path_factory.mktemp("wheel")))


@pytest.fixture(scope="module")
def unpacked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of an sdist."""
    place = tmp_path_factory.mktemp("sdist")
    with tarfile.open(made("sdist", REPOSITORY, place)) as archive:
        archive.extraction_filter = getattr(tarfile, "data_filter", None)  # from Python 3.11.4 on
        archive.extractall(place)
    return next(path for path in place.iterdir() if path.is_dir())


def metadata_of(wheel: dict[str, bytes]) -> str:
    return next(data for name, data in wheel.items() if name.endswith(".dist-info/METADATA")).decode()


class TestWheel:
    def test_has_every_file_of_the_packages(self, wheel: dict[str, bytes]) -> None:
        wanted = {name for name in names() if name.startswith(tuple(f"{package}/" for package in PACKAGES))}
        wanted = {name for name in wanted if not name.endswith(ONLY_TO_BUILD)}
        kinds = {".py", ".pyi", ".toml", ".csv", ".obj", ".typed", ".h", ".hpp", ".cmake"}
        assert {Path(name).suffix for name in wanted} == kinds
        inside = {name for name in wheel if ".dist-info/" not in name}
        assert {name for name in inside if not name.startswith(LIBRARY)} == wanted
        assert len(inside - wanted) == len(LIBRARY)
        for name in wanted:
            assert wheel[name] == (REPOSITORY / name).read_bytes(), name

    def test_says_what_it_is(self, wheel: dict[str, bytes]) -> None:
        told = Parser().parsestr(metadata_of(wheel))
        assert (told["Name"], told["Version"]) == (PROJECT["name"], PROJECT["version"])
        assert (told["License-Expression"], told["Requires-Python"]) == (PROJECT["license"], ">=3.11")
        extras = set(PROJECT["optional-dependencies"])
        assert set(told.get_all("Provides-Extra")) == extras
        base = [line for line in told.get_all("Requires-Dist") if "extra ==" not in line]
        assert sorted(base) == sorted(PROJECT["dependencies"])

    def test_has_the_commands_and_the_licence(self, wheel: dict[str, bytes]) -> None:
        inside = {name.partition(".dist-info/")[2]: data for name, data in wheel.items() if ".dist-info/" in name}
        assert inside["licenses/LICENSE"] == (REPOSITORY / "LICENSE").read_bytes()
        lines = inside["entry_points.txt"].decode().split("\n")
        assert {f"{name} = {place}" for name, place in PROJECT["scripts"].items()} <= set(lines)

    def test_is_for_every_python_on_this_system(self, wheel: dict[str, bytes]) -> None:
        told = next(data for name, data in wheel.items() if name.endswith(".dist-info/WHEEL")).decode()
        assert "Root-Is-Purelib: false" in told
        assert re.search(r"^Tag: py3-none-(?!any)\w+$", told, re.MULTILINE)


class TestSdist:
    @pytest.mark.slow
    def test_gives_the_same_wheel(self, unpacked: Path, wheel: dict[str, bytes], tmp_path: Path) -> None:
        again = contents(made("wheel", unpacked, tmp_path))
        assert again.keys() == wheel.keys()
        unlike = [name for name in wheel if again[name] != wheel[name]]
        # The linker numbers each build; its contents are tested by all tests of kernels.
        assert all(name.startswith(LIBRARY) or name.endswith("/RECORD") for name in unlike)

    def test_has_the_tests_and_the_pages(self, unpacked: Path) -> None:
        there = {path.relative_to(unpacked).as_posix() for path in unpacked.rglob("*") if path.is_file()}
        wanted = {name for name in names() if not name.startswith(".") and "/." not in name}
        assert {
            "pyproject.toml",
            "LICENSE",
            "Makefile",
            "constraints.txt",
            "tests/conftest.py",
            "docs/conf.py",
        } <= wanted
        assert wanted <= there
        assert not [name for name in there if "__pycache__" in name or name.endswith((".pyc", ".nbi", ".nbc"))]


def made_by_pip(tree: Path, place: Path, **environment: str) -> Path:
    """Build a wheel by pip in an environment of its own, which fetches what the build needs from the package index."""
    subprocess.run([sys.executable, "-m", "venv", str(place / "fresh")], check=True, timeout=WAIT_S)
    fresh = place / "fresh" / "bin"
    environment = {"PATH": str(fresh), "HOME": str(place), **environment}
    others = {name: value for name, value in os.environ.items() if name not in ("CC", "CXX")}
    command = [str(fresh / "python"), "-m", "pip", "wheel", "--no-deps", "--wheel-dir", str(place), str(tree)]
    done = subprocess.run(
        command, env={**others, **environment}, capture_output=True, encoding="utf-8", timeout=BUILD_S
    )
    if "No matching distribution found" in done.stderr or "Connection" in done.stderr:
        pytest.skip("needs the package index")
    assert done.returncode == 0, done.stderr
    return next(place.glob("magloc-*.whl"))


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="Windows needs clang-cl")
def test_a_machine_without_a_compiler_builds_it(unpacked: Path, tmp_path: Path) -> None:
    """PATH holds Python alone, so that the build asks the package index for Zig."""
    with zipfile.ZipFile(made_by_pip(unpacked, tmp_path)) as archive:
        archive.extractall(tmp_path / "installed")
    code = "import magloc.core as c; from magloc.fields.points import field_at_points as f; print(c.__file__)"
    code += "; assert f([[0, 0, 1]], [[0, 0, 0]], [[0, 0, 5]])[0, 2] == 1e-6"
    environment = {**os.environ, "PYTHONPATH": str(tmp_path / "installed")}
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, encoding="utf-8"
    )
    assert done.returncode == 0, done.stderr
    assert str(tmp_path) in done.stdout


def test_without_any_compiler_it_says_what_is_missing() -> None:
    code = "import sys; sys.modules['ziglang'] = None; from build_backend import build_wheel; build_wheel('.')"
    environment = {"PATH": "", "PYTHONPATH": str(REPOSITORY / "magloc" / "core"), "PYTHONDONTWRITEBYTECODE": "1"}
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=REPOSITORY, env=environment, capture_output=True, encoding="utf-8"
    )
    assert done.returncode == 1
    assert done.stderr == (
        "magloc: found no C++ compiler, expected g++ or clang++ in PATH, or Zig: pip install ziglang.\n"
    )


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="Windows needs clang-cl")
def test_zig_builds_it_for_linux_on_arm(unpacked: Path, tmp_path: Path) -> None:
    built = made_by_pip(unpacked, tmp_path, MAGLOC_ZIG_TARGET="aarch64-linux-gnu.2.17")
    assert built.name.endswith("-py3-none-manylinux_2_17_aarch64.whl")
    library = contents(built)["magloc/core/kernels.so"]
    assert library.startswith(b"\x7fELF\x02\x01")  # 64 bits, little-endian
    assert int.from_bytes(library[18:20], "little") == 183  # AArch64
    for kernel in re.findall(r"int64_t (magloc_\w+)\(const", (core.include_dir() / "magloc.h").read_text()):
        assert f"\0{kernel}\0".encode() in library
    assert set(re.findall(rb"GLIBC_[\d.]+", library)) == {b"GLIBC_2.17"}
