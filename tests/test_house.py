"""Rules of the house that no linter knows: names, roots, sizes."""

from __future__ import annotations

import ast
import importlib
import importlib.util
import inspect
import pkgutil
import re
from collections import Counter
from pathlib import Path
from typing import get_args

import pytest

import adcs
import magloc
from tests.conftest import REPOSITORY

PACKAGES = ("arrays", "magloc", "adcs", "sims")
BUILD = ("build_backend.py", "declare.py", "_declarations.py")
"""Files of magloc/core that build the library or are made by its build: nothing that is installed runs them."""
FILES = sorted(path for package in PACKAGES for path in (REPOSITORY / package).rglob("*.py") if path.name not in BUILD)
MOST_PARAMETERS, MOST_LINES, MOST_FILES = 12, 450, 14


@pytest.fixture(scope="module")
def trees() -> dict[Path, ast.Module]:
    return {path: ast.parse(path.read_text(encoding="utf-8")) for path in FILES}


def test_every_file_is_read() -> None:
    assert len(FILES) > 250


@pytest.mark.parametrize("package", PACKAGES)
class TestPublicNames:
    def test_the_stub_has_the_same(self, package: str) -> None:
        stub = ast.parse((REPOSITORY / package / "__init__.pyi").read_text(encoding="utf-8"))
        stated = [alias.asname for node in stub.body if isinstance(node, ast.ImportFrom) for alias in node.names]
        assert sorted(name for name in stated if name is not None) == importlib.import_module(package).__all__

    def test_each_can_be_had(self, package: str) -> None:
        module = importlib.import_module(package)
        assert [name for name in module.__all__ if getattr(module, name, None) is None] == []

    def test_none_is_shadowed_by_a_submodule(self, package: str) -> None:
        """A function of a submodule's name would turn into the module once that is imported."""
        module = importlib.import_module(package)
        submodules = {info.name: f"{package}.{info.name}" for info in pkgutil.iter_modules(module.__path__)}
        for name in set(submodules) & set(module.__all__):
            assert getattr(module, name) is importlib.import_module(submodules[name])

    def test_each_has_a_user(self, package: str) -> None:
        """A command, a page or a notebook; the reference lists all of them, and uses none."""
        reading = [path for path in pages() if "reference" not in path.relative_to(REPOSITORY).parts]
        users = [path for other in PACKAGES for path in (REPOSITORY / other / "cli").rglob("*.py")] + reading
        words = {word for path in users for word in re.findall(r"\w+", path.read_text(encoding="utf-8"))}
        assert sorted(set(importlib.import_module(package).__all__) - words) == []


# Results without a figure of their own, and why.
NOT_DRAWN = {
    "adcs.attitude_of_vectors": "attitudes of single instants; adcs.vector_attitude makes a track of them",
    "adcs.circular_orbit": "given, and not found",
    "adcs.combined_star_fixes": "readings for an estimate, which is drawn",
    "adcs.hipparcos_catalogue": "given, and not found",
    "magloc.equivalent_dipole": "one place and one moment",
    "magloc.fit_gradient_tensor": "one place and one moment",
    "magloc.fit_source_line": "a field along a line, asked for its distance",
    "magloc.view": "a page by itself",
    "adcs.view": "a page by itself",
}


def test_every_result_draws_itself() -> None:
    """Whatever class of ours a public function of magloc and adcs gives, unless it reads a file."""
    missing = set()
    for package in (magloc, adcs):
        for name, function in ((name, getattr(package, name)) for name in package.__all__):
            if not inspect.isfunction(function) or name.startswith("read_"):
                continue
            module = importlib.import_module(function.__module__)
            given = [getattr(module, part, None) for part in str(function.__annotations__["return"]).split(" | ")]
            results = [part for each in given for part in get_args(each) or (each,) if inspect.isclass(part)]
            if any(part.__module__.split(".")[0] in PACKAGES and not hasattr(part, "plot") for part in results):
                missing.add(f"{package.__name__}.{name}")
    assert missing == NOT_DRAWN.keys()


def test_only_command_lines_import_the_root_of_their_package(trees: dict[Path, ast.Module]) -> None:
    """A lazy root would hide an upward import from the linter."""
    found = []
    for path, tree in trees.items():
        package, *rest = path.relative_to(REPOSITORY).parts
        if rest[0] == "cli":
            continue
        modules = {info.name for info in pkgutil.iter_modules([str(REPOSITORY / package)])}
        for node in ast.walk(tree):
            whole = isinstance(node, ast.Import) and any(alias.name == package for alias in node.names)
            name = isinstance(node, ast.ImportFrom) and node.module == package
            if whole or (name and any(alias.name not in modules for alias in node.names)):
                found.append(f"{path.relative_to(REPOSITORY)}:{node.lineno}")
    assert found == []


def pages() -> list[Path]:
    return [REPOSITORY / "README.md", *(REPOSITORY / "docs").rglob("*.md"), *(REPOSITORY / "notebooks").glob("*.ipynb")]


def test_names_in_pages_are_there() -> None:
    dotted = re.compile(r"\b(?<!tests\.)(?:arrays|magloc|adcs|sims)(?:\.[A-Za-z_]\w*)+")
    files = (".h", ".hpp", ".csv", ".toml", ".png", ".gif", ".zarr", ".json", ".py", ".html", ".md", ".txt")
    named = {name for page in pages() for name in dotted.findall(page.read_text(encoding="utf-8"))}
    found = {name for name in named if not name.endswith(files)}
    missing = []
    for name in sorted(found):
        package, *rest = name.split(".")
        there: object = importlib.import_module(package)
        for i, part in enumerate(rest):
            if not hasattr(there, part) and importlib.util.find_spec(".".join([package, *rest[: i + 1]])):
                importlib.import_module(".".join([package, *rest[: i + 1]]))
            there = getattr(there, part, None)
        if there is None:
            missing.append(name)
    assert missing == []


class TestWholeFiles:
    """Whatever writes a file does so beside its place first, by the one piece that puts it there at the end."""

    WRITERS = frozenset(
        [
            "savefig",
            "to_netcdf",
            "to_zarr",
            "to_csv",
            "to_json",
            "write_text",
            "write_bytes",
            "savez",
            "savetxt",
            "tofile",
            "imsave",
            "dump",
            "open",
        ]
    )

    def writes(self, call: ast.Call) -> bool:
        """Whether it may make or change a file; `open` does by its mode, and `save` of what is no function of ours."""
        name = call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")
        if name == "open":
            modes = [a.value for a in [*call.args, *(k.value for k in call.keywords)] if isinstance(a, ast.Constant)]
            return any(isinstance(mode, str) and re.fullmatch(r"[rwaxbt+]*[wax+][rwaxbt+]*", mode) for mode in modes)
        if name == "save":
            return ast.unparse(call.func) not in ("style.save", "magloc.plots.save", "self.save", "save")
        return isinstance(call.func, ast.Attribute) and name in self.WRITERS

    def whole(self, tree: ast.AST) -> set[ast.AST]:
        """What stands within ``with replaced(…)`` or is handed to ``replace_file``."""
        found: set[ast.AST] = set()
        for node in ast.walk(tree):
            made = [item.context_expr for item in node.items] if isinstance(node, ast.With) else [node]
            names = {call.func.id for call in made if isinstance(call, ast.Call) and isinstance(call.func, ast.Name)}
            if names & ({"replaced"} if isinstance(node, ast.With) else {"replace_file"}):
                found |= set(ast.walk(node))
        return found

    def in_place(self, tree: ast.AST) -> list[ast.Call]:
        whole = self.whole(tree)
        calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call) and node not in whole]
        return [call for call in calls if self.writes(call)]

    def test_no_file_is_written_in_place(self, trees: dict[Path, ast.Module]) -> None:
        found = [
            f"{path.relative_to(REPOSITORY)}:{call.lineno}: {ast.unparse(call)[:80]}"
            for path, tree in trees.items()
            for call in self.in_place(tree)
        ]
        assert found == []

    def test_such_would_be_found(self) -> None:
        for code in (
            "figure.savefig(path)",
            "image.save(path)",
            "open(path, 'w')",
            "path.open(mode='ab')",
            "path.write_text('')",
            "dataset.to_netcdf(path)",
            "with open(path, 'x') as file: pass",
        ):
            assert self.in_place(ast.parse(code)), code
        for code in (
            "with replaced(path) as written: figure.savefig(written)",
            "replace_file(path, lambda place: image.save(place))",
            "write_text('', path)",
            "open(path)",
            "style.save(figure, path)",
        ):
            assert not self.in_place(ast.parse(code)), code


class TestSizes:
    def test_no_function_has_too_many_parameters(self, trees: dict[Path, ast.Module]) -> None:
        found = []
        for path, tree in trees.items():
            for node in ast.walk(tree):
                if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
                    names = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
                    count = sum(argument.arg not in ("self", "cls") for argument in names)
                    if count > MOST_PARAMETERS:
                        found.append(f"{path.relative_to(REPOSITORY)}: {node.name} has {count}")
        assert found == []

    def test_no_file_is_too_long(self) -> None:
        lines = {path.relative_to(REPOSITORY): len(path.read_text(encoding="utf-8").splitlines()) for path in FILES}
        assert {path: n for path, n in lines.items() if n > MOST_LINES} == {}

    def test_no_folder_is_too_full(self) -> None:
        files = Counter(path.parent.relative_to(REPOSITORY) for path in FILES)
        assert {folder: n for folder, n in files.items() if n > MOST_FILES} == {}
