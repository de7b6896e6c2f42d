"""What notebooks are written with: public names alone; and that each says where it stands in the reading order."""

from __future__ import annotations

import ast
import importlib
import re
from pathlib import Path
from types import ModuleType
import nbformat
import pytest
from IPython.core.inputtransformer2 import TransformerManager
from tests.notebooks import NOTEBOOKS


OURS = ("arrays", "magloc", "adcs", "sims")
MOST_IMPORTS = 3
MOST_DRAWN = 11
PLACE = re.compile(r"^\*Notebook (\d+) of (\d+) · (\d+) minutes · [^*]+\*$", re.MULTILINE)


def code_of(path: Path) -> ast.Module:
    """Code of a notebook, with calls in place of lines of a shell."""
    notebook = nbformat.read(path, as_version=4)
    cells = [cell.source for cell in notebook.cells if cell.cell_type == "code"]
    return ast.parse("\n".join(TransformerManager().transform_cell(cell) for cell in cells))


def public(module: ModuleType) -> set[str]:
    """Public names of a package, or of a module that is one of them."""
    stated = getattr(module, "__all__", None)
    names = set(stated) if stated is not None else {name for name in vars(module) if not name.startswith("_")}
    modules = {name for name in names if stated is None and isinstance(getattr(module, name), ModuleType)}
    return names - modules


def imports_of_ours(tree: ast.Module) -> list[ast.Import | ast.ImportFrom]:
    found = []
    for node in ast.walk(tree):
        names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
        if any(name.split(".")[0] in OURS for name in names):
            found.append(node)
    return found


def private_names(tree: ast.Module) -> list[str]:
    """What the code takes of our packages and is not public, wherever it stands in a chain of attributes."""
    bound: dict[str, object] = {}
    found = []
    for node in imports_of_ours(tree):
        for alias in node.names:
            whole = alias.name if isinstance(node, ast.Import) else f"{node.module}.{alias.name}"
            package, *rest = whole.split(".")
            root = importlib.import_module(package)
            if len(rest) > (0 if isinstance(node, ast.Import) else 1) or not public(root).issuperset(rest):
                found.append(whole)
            else:
                bound[alias.asname or alias.name] = getattr(root, rest[0]) if rest else root
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute):
            module = module_of(node.value, bound)
            if module is not None and node.attr not in public(module):
                found.append(ast.unparse(node))
    return found


def module_of(node: ast.expr, bound: dict[str, object]) -> ModuleType | None:
    """The module of ours that an expression is."""
    if isinstance(node, ast.Name):
        there = bound.get(node.id)
    elif isinstance(node, ast.Attribute):
        there = getattr(module_of(node.value, bound), node.attr, None)
    else:
        there = None
    return there if isinstance(there, ModuleType) else None


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_public_names_only_and_few_imports(path: Path) -> None:
    tree = code_of(path)
    assert private_names(tree) == []
    assert len(imports_of_ours(tree)) <= MOST_IMPORTS


@pytest.mark.parametrize(
    ("code", "private"),
    [
        ("import magloc\nmagloc.plots.fixes, magloc.dipole.field, magloc.datasets.load, magloc.locate", []),
        ("from adcs import mockup\nmockup.Camera()", []),
        ("from magloc.fields import dipole", ["magloc.fields.dipole"]),
        ("import magloc.state_space", ["magloc.state_space"]),
        ("from magloc import readings", ["magloc.readings"]),
        ("import magloc\nmagloc.plots.style.BLUE", ["magloc.plots.style"]),
        ("import magloc as m\nm.kalman, m.dipole.np", ["m.kalman", "m.dipole.np"]),
    ],
)
def test_a_private_name_is_found(code: str, private: list[str]) -> None:
    assert private_names(ast.parse(code)) == private


def drawing_calls(tree: ast.Module) -> list[str]:
    """Calls of matplotlib, but to show, and of what comes of it by assignments and loops."""
    drawing = {"ax", "axes", "fig", "figure"}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            whole = getattr(node, "module", None) or ""
            named = [alias for alias in node.names if (whole or alias.name).split(".")[0] == "matplotlib"]
            drawing |= {alias.asname or alias.name.split(".")[0] for alias in named}
    before = -1
    while before != len(drawing):
        before = len(drawing)
        for node in ast.walk(tree):
            made = node.value if isinstance(node, ast.Assign) else getattr(node, "iter", None)
            if made is None or not drawing & names_in(made):
                continue
            if isinstance(node, ast.Assign) and root_of(made) not in drawing:
                continue  # a value that is computed of a drawing is none
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            drawing |= {name for target in targets for name in names_in(target)}
    calls = [ast.unparse(n) for n in ast.walk(tree) if isinstance(n, ast.Call) and root_of(n) in drawing]
    return [call for call in calls if not call.endswith(".show()")]


def names_in(node: ast.AST) -> set[str]:
    return {part.id for part in ast.walk(node) if isinstance(part, ast.Name)}


def root_of(node: ast.AST) -> str:
    """The name at the beginning of a chain of attributes, items and calls."""
    while isinstance(node, ast.Attribute | ast.Subscript | ast.Call):
        node = node.func if isinstance(node, ast.Call) else node.value
    return node.id if isinstance(node, ast.Name) else ""


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_the_library_draws(path: Path) -> None:
    assert len(drawing_calls(code_of(path))) <= MOST_DRAWN


def test_drawing_by_hand_is_found() -> None:
    code = """
import matplotlib.pyplot as plt
import magloc
fixes.plot(), magloc.plots.fixes(fixes, array), starts["distance"].plot()
picture, (left, right) = plt.subplots(1, 2)
for panel, value in zip((left, right), values):
    panel.plot(value)
    panel.lines[0].set(lw=2)
plt.show()
"""
    assert len(drawing_calls(ast.parse(code))) == 3


def test_they_say_their_place_in_the_gallery() -> None:
    """The first cell is the card: a number, a title, minutes and a question."""
    card = importlib.import_module("docs.explained").CARD
    numbers = []
    for path in NOTEBOOKS:
        first = nbformat.read(path, as_version=4).cells[0].source
        [(number, of, _)] = PLACE.findall(first)
        found = card.match(first)
        assert found is not None, path.name
        assert (found[1], int(of)) == (number, len(NOTEBOOKS))
        numbers.append(int(number))
    assert sorted(numbers) == list(range(1, len(NOTEBOOKS) + 1))
