"""What users read: Python of pages and docstrings runs, commands accept what is shown, every public name has a page."""

from __future__ import annotations

import doctest
import importlib
import inspect
import re
import shlex
from pathlib import Path
from typing import Any

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
CONTINUED = re.compile(r" \\\n +")
# All pages but those that are made of commands and notebooks when the site is built.
WRITTEN = [REPOSITORY / "README.md", *(page for page in sorted(DOCS.rglob("*.md")) if "commands" not in page.parts)]
# A block of code with its language, or a line of commands, of a page's text.
CODE = re.compile(r"^```[a-z]+\n(.*?)^```|^    ([^\n]*)$", re.DOTALL | re.MULTILINE)
HIDDEN = re.compile(r"<!--.*?-->", re.DOTALL)
# What a page of the site shows of a line of code at desktop width without a scroll bar.
WIDEST = 88
# Pages, and packages with examples, whose code takes many seconds.
SLOW = {
    "array-design",
    "detection-range-and-bounds",
    "drone-log",
    "exporting",
    "field-log",
    "live",
    "magloc.plots",
    "monte-carlo",
    "ship-signature",
    "sims.experiments",
    "single-sensor-ranging",
    "stated-uncertainty",
    "tracking",
    "uncertainty",
    "which-error-bars",
}
# Public classes whose example repeats the long one of a function.
AGAIN = {
    "Compensation",
    "LogCalibration",
    "MomentTrack",
    "Quality",
    "RepeatedFilter",
    "Review",
    "Signature",
    "SourcesTrack",
    "Survey",
    "Target",
}
PACKAGES = [
    "arrays",
    "magloc",
    "adcs",
    "sims",
    "magloc.live",
    "magloc.viewer",
    "magloc.plots",
    "adcs.mockup",
    "sims.experiments",
]
ROOTS = PACKAGES[:4]
# What a docstring says of its parameters: the heading's entries up to the next heading or the end.
STATED = re.compile(r"^(?:Parameters|Attributes)\n-+\n(.*?)(?=^\S[^\n]*\n-|\Z)", re.DOTALL | re.MULTILINE)
# A public name on a page of the reference, in a list of autosummary or by itself.
NAMED = re.compile(r"\b(?:arrays|magloc|adcs|sims)(?:\.\w+)+")


def with_python(page: Path) -> bool:
    return BLOCKS.search(page.read_text(encoding="utf-8")) is not None


def seldom(cases: list[Any]) -> list[Any]:
    """Cases of which the slow ones are marked."""
    slow = {case for case in cases if getattr(case, "stem", case) in SLOW}
    return [pytest.param(case, marks=pytest.mark.slow) if case in slow else case for case in cases]


def command_lines() -> list[tuple[str, bool]]:
    """Command lines of all pages, without comments, and whether they are whole; those in a sentence may be a part."""
    found = {
        ((shown or inline).partition(" #")[0].partition(" > ")[0].strip(), bool(shown))
        for page in WRITTEN
        for shown, inline in COMMAND.findall(CONTINUED.sub(" ", page.read_text(encoding="utf-8")))
    }
    return sorted(found)


def test_the_guide_is_found() -> None:
    assert len(GUIDE) >= 10
    assert len(command_lines()) > 30


@pytest.mark.parametrize("page", seldom([page for page in PAGES if with_python(page)]), ids=lambda page: page.stem)
def test_page(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    matplotlib.use("agg")
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    for hidden, shown in BLOCKS.findall(page.read_text(encoding="utf-8")):
        exec(compile(hidden or shown, str(page), "exec"), names)


@pytest.mark.parametrize("page", WRITTEN, ids=lambda page: str(page.relative_to(REPOSITORY)))
def test_no_line_of_code_scrolls(page: Path) -> None:
    blocks = CODE.findall(HIDDEN.sub("", page.read_text(encoding="utf-8")))
    lines = [line for block in blocks for code in block for line in code.splitlines()]
    assert [line for line in lines if len(line) > WIDEST] == []


def documented(package: str) -> dict[str, object]:
    """Public classes and functions of a package."""
    module = importlib.import_module(package)
    public = {name: getattr(module, name) for name in module.__all__}
    return {name: thing for name, thing in public.items() if inspect.isclass(thing) or inspect.isfunction(thing)}


@pytest.mark.parametrize("package", PACKAGES)
def test_parameters_of_public_names_are_explained(package: str) -> None:
    missing = []
    for name, thing in documented(package).items():
        if inspect.isclass(thing) and issubclass(thing, Exception):
            continue
        text = "\n".join(STATED.findall(inspect.getdoc(thing) or ""))
        entries = re.findall(r"^(\S[^:\n]*)", text, re.MULTILINE)
        stated = {part.strip(" *") for entry in entries for part in entry.split(",")}
        missing += [f"{name}: {taken}" for taken in inspect.signature(thing).parameters if taken not in stated]
    assert missing == []


@pytest.mark.parametrize("again", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.parametrize("package", seldom(PACKAGES))
def test_examples_of_public_names(package: str, again: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every public class and function has some, and they print what they say."""
    matplotlib.use("agg")
    monkeypatch.chdir(tmp_path)
    runner, said = doctest.DocTestRunner(verbose=False), []
    for name, thing in documented(package).items():
        test = doctest.DocTestParser().get_doctest(inspect.getdoc(thing) or "", {}, f"{package}.{name}", None, None)
        assert test.examples, name
        if (name in AGAIN) == again:
            runner.run(test, out=said.append)
    assert runner.failures == 0, "".join(said)


@pytest.mark.parametrize(("line", "whole"), command_lines())
def test_command_line_is_accepted(line: str, whole: bool) -> None:
    """Its options exist and their values have the right form; nothing is run."""
    name, *arguments = shlex.split(line)
    try:
        APPS[name].parse_args(arguments, exit_on_error=False, print_error=False)
    except CycloptsError as error:
        if whole or not isinstance(error, MissingArgumentError):
            pytest.fail(f"{line}: {error}")


@pytest.mark.parametrize("package", PACKAGES)
def test_the_reference_has_every_public_name(package: str) -> None:
    """On a page by itself, or in a list that is made when the site is built: of a module, or by page of the guide."""
    pages = "\n".join(path.read_text(encoding="utf-8") for path in (DOCS / "reference").glob("*.md"))
    explained = importlib.import_module("docs.explained").EXPLAINED
    listed = {name for names in explained.values() for name in names.split()}
    whole = re.findall(r"\{include\} names/([\w.]+)\.txt", pages)
    public = {f"{package}.{name}" for name in importlib.import_module(package).__all__}
    named = {*NAMED.findall(pages), *listed}
    assert [name for name in sorted(public - named) if name.rpartition(".")[0] not in {*whole} - {*ROOTS}] == []
    assert sorted(name for name in listed if name.startswith(f"{package}.") and not exists(name)) == []


def exists(name: str) -> bool:
    """Whether a module has a public name, or is one."""
    home, _, last = name.rpartition(".")
    return last in importlib.import_module(home).__all__


def test_the_guide_leads_to_each_of_its_pages_by_a_question() -> None:
    questions = (DOCS / "guide" / "index.md").read_text(encoding="utf-8").partition("```{toctree}")[0]
    named = set(re.findall(r"\]\(([\w-]+)\.md", questions))
    assert {page.stem for page in GUIDE} - {"index"} - named == set()


def test_links_of_the_readme_lead_somewhere() -> None:
    """The site's are held by its build."""
    links = re.findall(r"\]\(([^)#]+)[^)]*\)", (REPOSITORY / "README.md").read_text(encoding="utf-8"))
    assert len(links) > 15
    assert [link for link in links if not link.startswith("http") and not (REPOSITORY / link).exists()] == []


def test_the_readme_is_short() -> None:
    assert len((REPOSITORY / "README.md").read_text(encoding="utf-8").splitlines()) <= 80
