"""Pages that users read: Python blocks run, commands accept what is shown of them, every public name has a page."""

from __future__ import annotations

import importlib
import re
import shlex
from pathlib import Path

import matplotlib
import pytest
from cyclopts import CycloptsError, MissingArgumentError

import adcs.cli.app
import magloc.cli.app
from tests.conftest import REPOSITORY

DOCS = REPOSITORY / "docs"
GUIDE = sorted((DOCS / "guide").glob("*.md"))
PAGES = [REPOSITORY / "README.md", DOCS / "quickstart.md", *GUIDE]
BLOCKS = re.compile(r"<!-- (?:before|after) the page:\n(.*?)-->|```python\n(.*?)```", re.DOTALL)
APPS = {"magloc": magloc.cli.app.app, "adcs": adcs.cli.app.app}
COMMAND = re.compile(r"^(?:    |\$ )((?:magloc|adcs) .*)$|`((?:magloc|adcs) [a-z]+ [^`…]*)`", re.MULTILINE)
# A public name on a page of the reference, in a list of autosummary or by itself.
NAMED = re.compile(r"\b(?:arrays|magloc|adcs|sims)(?:\.\w+)+")


def with_python(page: Path) -> bool:
    return BLOCKS.search(page.read_text(encoding="utf-8")) is not None


def command_lines() -> list[tuple[str, bool]]:
    """Command lines of all pages, without comments, and whether they are whole; those in a sentence may be a part."""
    pages = [page for page in DOCS.rglob("*.md") if "commands" not in page.parts]
    found = {
        ((shown or inline).partition(" #")[0].partition(" > ")[0].strip(), bool(shown))
        for page in [REPOSITORY / "README.md", *pages]
        for shown, inline in COMMAND.findall(page.read_text(encoding="utf-8"))
    }
    return sorted(found)


def test_the_guide_is_found() -> None:
    assert len(GUIDE) >= 10
    assert len(command_lines()) > 30


@pytest.mark.parametrize("page", [page for page in PAGES if with_python(page)], ids=lambda page: page.stem)
def test_page(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    matplotlib.use("agg")
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    for hidden, shown in BLOCKS.findall(page.read_text(encoding="utf-8")):
        exec(compile(hidden or shown, str(page), "exec"), names)


@pytest.mark.parametrize(("line", "whole"), command_lines())
def test_command_line_is_accepted(line: str, whole: bool) -> None:
    """Its options exist and their values have the right form; nothing is run."""
    name, *arguments = shlex.split(line)
    try:
        APPS[name].parse_args(arguments, exit_on_error=False, print_error=False)
    except CycloptsError as error:
        if whole or not isinstance(error, MissingArgumentError):
            pytest.fail(f"{line}: {error}")


@pytest.mark.parametrize(
    "package", ["arrays", "magloc", "adcs", "sims", "magloc.plots", "adcs.mockup", "sims.experiments"]
)
def test_the_reference_has_every_public_name(package: str) -> None:
    pages = (path.read_text(encoding="utf-8") for path in (DOCS / "reference").glob("*.md"))
    named = {name for text in pages for name in NAMED.findall(text)}
    public = {f"{package}.{name}" for name in importlib.import_module(package).__all__}
    assert sorted(public - named) == []


def test_the_readme_is_short() -> None:
    assert len((REPOSITORY / "README.md").read_text(encoding="utf-8").splitlines()) <= 130
