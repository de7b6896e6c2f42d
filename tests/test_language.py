"""Language of pages, docstrings and messages, as far as a machine can hold it: short sentences, plain first words."""

from __future__ import annotations

import ast
import importlib
import inspect
import json
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from numpydoc.validate import validate

from tests.conftest import REPOSITORY

PACKAGES = ("arrays", "magloc", "adcs", "sims")
WRITTEN = [
    REPOSITORY / "README.md",
    REPOSITORY / "CONTRIBUTING.md",
    *(page for page in sorted((REPOSITORY / "docs").rglob("*.md")) if not {"names", "commands"} & set(page.parts)),
    *sorted((REPOSITORY / "notebooks").glob("*.ipynb")),
]
MOST_WORDS, MOST_WORDS_OF_A_PAGE, MOST_BYTES = 20.0, 24.0, 12 * 1024

FENCE = re.compile(r"^(```+|~~~+)[^\n]*\n.*?^\1[ ]*$", re.DOTALL | re.MULTILINE)
HIDDEN = re.compile(r"<!--.*?-->", re.DOTALL)
FORMULA = re.compile(r"^\$\$.*?\$\$", re.DOTALL | re.MULTILINE)
ITEM = re.compile(r"(?:[-*+]|\d+\.)\s+")
# Lines without sentences: tables, headings, directives and their options, comments, labels.
SKIPPED = re.compile(r"[|#:<{]|---|\(\w[\w-]*\)=$")
# The end of a sentence, before a capital, a digit, a symbol or code.
END = re.compile(r"(?<=[.!?])[*_)\"]*\s+(?=[A-Z*_(\"§\dχσΔ∂])")
WORD = re.compile(r"[^\W_][\w'’.,²³/%°-]*")

UNCLEAR = re.compile(r"(?:What|Of|Where|That|Whether)\b")


def paragraphs(text: str) -> Iterator[str]:
    """Paragraphs and items of lists; code spans count as one word, links as their text."""
    text = FORMULA.sub("\n\n", HIDDEN.sub("", FENCE.sub("\n\n", text)))
    lines: list[str] = []
    for line in [*text.splitlines(), ""]:
        shown = line.strip()
        indented_code = line.startswith("    ") and not lines
        if not shown or SKIPPED.match(shown) or indented_code or ITEM.match(shown):
            if lines:
                joined = re.sub(r"`[^`]*`", "§", " ".join(lines))
                yield re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", re.sub(r"\$[^$]*\$", "§", joined))
            lines = []
        if shown and not SKIPPED.match(shown) and not indented_code:
            lines.append(ITEM.sub("", shown, count=1) if ITEM.match(shown) else shown)


def prose_of(page: Path) -> str:
    """Text of a page, or of the Markdown cells of a notebook."""
    text = page.read_text(encoding="utf-8")
    if page.suffix != ".ipynb":
        return text
    return "\n\n".join("".join(cell["source"]) for cell in json.loads(text)["cells"] if cell["cell_type"] == "markdown")


def words_of_sentences(text: str) -> list[int]:
    """Number of words of each sentence of three words or more; a code span is one word."""
    sentences = [sentence for paragraph in paragraphs(text) for sentence in END.split(paragraph)]
    counts = [len(WORD.findall(sentence.replace("§", "x"))) for sentence in sentences]
    return [count for count in counts if count >= 3]


class TestSentences:
    def test_counted(self) -> None:
        prose = "# Title of a page\n\nOne `two three` four. Five\nsix seven!\n\n"
        text = prose + "| a | b |\n\n```python\nx = 1\n```\n- Eight nine ten.\n"
        assert words_of_sentences(text) == [3, 3, 3]

    @pytest.mark.parametrize("page", WRITTEN, ids=lambda page: str(page.relative_to(REPOSITORY)))
    def test_of_a_page_are_short(self, page: Path) -> None:
        counts = words_of_sentences(prose_of(page))
        assert sum(counts) <= MOST_WORDS_OF_A_PAGE * len(counts)

    def test_of_all_pages_are_short(self) -> None:
        counts = [count for page in WRITTEN for count in words_of_sentences(prose_of(page))]
        assert len(counts) > 2000
        assert sum(counts) <= MOST_WORDS * len(counts)


# Pages of validation whose sections stand for themselves; the others state data and date once for the whole page.
MEASURED = ("arrays", "attitude", "fixes", "same-data", "surveys", "tracks")
# Sections whose tables point to others, or invite recordings that do not exist.
WITHOUT_DATA = ("On data that nothing was tuned on", "Where another tool is better", "What is not proven")
SECTION = re.compile(r"^## (?P<title>[^\n]*)\n(?P<text>.*?)(?=^## |\Z)", re.DOTALL | re.MULTILINE)
STATED = {"data": r"Data:", "what was tuned": r"Tuned\s+on\s+it:", "date": r"\b20\d\d-\d\d-\d\d\b"}


@pytest.mark.parametrize("page", MEASURED)
def test_a_table_of_validation_states_data_tuning_and_date(page: str) -> None:
    text = (REPOSITORY / "docs" / "validation" / f"{page}.md").read_text(encoding="utf-8")
    sections = [section for section in SECTION.finditer(text) if "|---" in section["text"]]
    assert len(sections) > 4
    own = [section for section in sections if section["title"] not in WITHOUT_DATA]
    missing = [(s["title"], what) for s in own for what, pattern in STATED.items() if not re.search(pattern, s["text"])]
    assert missing == []


def test_the_changelog_is_short() -> None:
    assert len((REPOSITORY / "CHANGELOG.md").read_bytes()) <= MOST_BYTES


def docstrings(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Line and text of all docstrings, also of attributes."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            for part in node.body:
                constant = part.value if isinstance(part, ast.Expr) else None
                if isinstance(constant, ast.Constant) and isinstance(constant.value, str):
                    yield part.lineno, constant.value


def messages(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Line and beginning of texts that are raised, warned of or logged."""
    for node in ast.walk(tree):
        calls = [node.exc] if isinstance(node, ast.Raise) else [node]
        for call in calls:
            if not isinstance(call, ast.Call) or not call.args:
                continue
            name = call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")
            if not isinstance(node, ast.Raise) and name not in ("warn", "warning", "info", "error"):
                continue
            first = call.args[0]
            if isinstance(first, ast.JoinedStr) and first.values:
                first = first.values[0]
            if isinstance(first, ast.Constant) and isinstance(first.value, str):
                yield first.lineno, first.value


def unclear(path: Path) -> list[str]:
    """Docstrings and messages of a file that begin with a word of ``UNCLEAR``."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    texts = [*docstrings(tree), *messages(tree)]
    return [
        f"{path.relative_to(REPOSITORY)}:{line}: {text.strip().splitlines()[0]}"
        for line, text in texts
        if UNCLEAR.match(text.strip())
    ]


FOLDERS = sorted({path.parent for package in PACKAGES for path in (REPOSITORY / package).rglob("*.py")})


class TestFirstWords:
    def test_unclear_ones_are_found(self) -> None:
        function = 'def f(x):\n    """Of it."""\n    raise ValueError(f"Where {x}")\n'
        code = f'"""What is."""\n\n{function}\nA = 1\n"""Whatever."""\n'
        tree = ast.parse(code)
        texts = [text for _, text in [*docstrings(tree), *messages(tree)]]
        assert [text for text in texts if UNCLEAR.match(text)] == ["What is.", "Of it.", "Where "]

    @pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.relative_to(REPOSITORY).as_posix())
    def test_of_docstrings_and_messages_are_clear(self, folder: Path) -> None:
        assert [text for path in sorted(folder.glob("*.py")) for text in unclear(path)] == []


# Checks of numpydoc that do not apply: longer summaries are not always needed, the site adds "See also", and
# tests/test_guide.py runs the examples and finds parameters of classes among their attributes.
NOT_APPLIED = {"ES01", "EX01", "SA01"}
# A method may have one line.
NOT_APPLIED_TO_METHODS = {"PR01", "RT01", "YD01"}
DOCUMENTED = ["arrays", "magloc", "adcs", "sims", "magloc.live", "magloc.viewer", "magloc.plots", "adcs.mockup"]


def faults(name: str, not_applied: set[str]) -> list[str]:
    """Faults that numpydoc finds in a docstring, but for checks that do not apply."""
    found = validate(name)
    if "Yields" in found["docstring"]:
        not_applied = not_applied | {"RT01"}
    return [f"{name}: {code} {text}" for code, text in found["errors"] if code not in not_applied]


def test_faults_of_docstrings_are_found() -> None:
    codes = {fault.split()[1] for fault in faults("tests.test_language.unclear", NOT_APPLIED)}
    assert {"PR01", "RT01"} <= codes


@pytest.mark.parametrize("package", [*DOCUMENTED, "sims.experiments"])
def test_docstrings_of_public_names_are_complete(package: str) -> None:
    module = importlib.import_module(package)
    things = {f"{package}.{name}": getattr(module, name) for name in module.__all__}
    found = []
    for name, thing in things.items():
        if inspect.isfunction(thing):
            found += faults(name, NOT_APPLIED)
        elif inspect.isclass(thing):
            found += faults(name, NOT_APPLIED | {"PR01"})
            methods = [part for part in vars(thing) if not part.startswith("_") and callable(getattr(thing, part))]
            for method in methods:
                found += faults(f"{name}.{method}", NOT_APPLIED | NOT_APPLIED_TO_METHODS)
    assert found == []
