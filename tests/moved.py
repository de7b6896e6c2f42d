"""``python tests/moved.py OLD NEW``: the definitions of two commits are the same, wherever they stand.

Compares the multisets of all top-level definitions' syntax trees in the four packages. What a move rewrites is taken
out first: imports, the modules before a name in code and in text, and where lines of text break.
"""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections import Counter

PACKAGES = ("arrays", "magloc", "adcs", "sims")
DOTTED = re.compile(r"\b(?:arrays|magloc|adcs|sims)(?:\.\w+)*\.(\w+)")
MODULE = re.compile(r":mod:`[^`]+`")


class _Placeless(ast.NodeTransformer):
    """Takes out what a move rewrites."""

    def __init__(self, modules: set[str]) -> None:
        self.modules = modules

    def visit_ImportFrom(self, node: ast.ImportFrom) -> ast.AST | None:
        return None if (node.module or "").split(".")[0] in PACKAGES else node

    def visit_Attribute(self, node: ast.Attribute) -> ast.AST:
        if isinstance(node.value, ast.Name) and node.value.id in self.modules:
            return ast.Name(node.attr, node.ctx)
        return self.generic_visit(node)

    def visit_Constant(self, node: ast.Constant) -> ast.AST:
        if isinstance(node.value, str):
            return ast.Constant(re.sub(r"\W+", " ", DOTTED.sub(r"\1", MODULE.sub("", node.value))).strip().lower())
        return node


def definitions(commit: str) -> Counter[tuple[str, str]]:
    """Name and tree of every top-level definition of a commit."""
    listed = subprocess.run(["git", "ls-tree", "-r", "--name-only", commit], capture_output=True, text=True, check=True)
    files = [f for f in listed.stdout.split() if f.endswith(".py") and f.split("/")[0] in PACKAGES]
    modules = {f.removesuffix(".py").removesuffix("/__init__").replace("/", ".") for f in files}
    found: Counter[tuple[str, str]] = Counter()
    for file in files:
        text = subprocess.run(["git", "show", f"{commit}:{file}"], capture_output=True, text=True, check=True).stdout
        tree = ast.parse(text)
        aliases = {
            alias.asname or alias.name
            for node in ast.walk(tree)
            if isinstance(node, ast.ImportFrom)
            for alias in node.names
            if f"{node.module}.{alias.name}" in modules
        }
        for node in tree.body:
            if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
                name = node.name
            elif isinstance(node, (ast.Assign, ast.AnnAssign)):
                name = ast.unparse(node.targets[0] if isinstance(node, ast.Assign) else node.target)
            else:
                continue
            found[name, ast.dump(_Placeless(aliases).visit(node))] += 1
    return found


def main(old: str, new: str) -> int:
    """Print what differs; the number of names that do."""
    before, after = definitions(old), definitions(new)
    gone, come = (
        Counter(name for name, _ in (before - after).elements()),
        Counter(name for name, _ in (after - before).elements()),
    )
    print(f"{before.total()} definitions before, {after.total()} after, {(before & after).total()} the same")
    for name in sorted({*gone, *come}):
        print(f"{name}: {gone[name]} gone, {come[name]} come")
    return len({*gone, *come})


if __name__ == "__main__":
    sys.exit(min(1, main(*sys.argv[1:])))
