"""Pages that are made when the site is built: of the command lines, of the notebooks, and what links code to theory."""

from __future__ import annotations

import base64
import json
import re
import shutil
from collections.abc import Iterator
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from docutils import nodes
from explained import CARD, EXPLAINED, PICTURES
from header_pages import HEADERS, header_text
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx

HERE = Path(__file__).parent
NOTEBOOKS = HERE.parent / "notebooks"
# As a page of the gallery names that folder.
ORIGINALS = "../../../notebooks"
# How a docstring names a page of the theory.
PAGE = re.compile(r"docs/theory/([\w-]+)\.md")
# A link of a command's page to a heading that is on another page now.
LINK = re.compile(r"^(\* )\[(`[\w-]+`)\]\(#[\w-]+\)", re.MULTILINE)
# Modules whose names have a separate list, in alphabetical order.
MODULES = ("magloc.live", "magloc.plots", "adcs.mockup", "sims.experiments")
# Other pages that a function's page names at most of each folder, in this order.
MOST_PAGES = {"guide": 3, "theory": 2, "gallery": 2}
# What a bar stands in: literal text and formulas keep it, elsewhere it would be a substitution.
BAR = re.compile(r"(``.*?``|:math:`[^`]*`)|\\?\|")


def setup(app: Sphinx) -> dict[str, bool]:
    """Register with Sphinx."""
    # Before autosummary, which looks at the same event for what it has to make.
    app.connect("builder-inited", make_all, priority=100)
    # Before numpydoc, which makes other lines of them.
    app.connect("autodoc-process-docstring", readable, priority=100)
    # After numpydoc, which would take it for a part of the last section.
    app.connect("autodoc-process-docstring", illustrated, priority=900)
    app.connect("doctree-read", link_names)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def make_all(app: Sphinx) -> None:
    """Write what git does not keep: lists of names, commands, headers, notebooks and their cards, MathJax."""
    names = fresh(HERE / "reference" / "names")
    lists = reference_lists()
    for page, sections in lists.items():
        text = "\n".join(heading + autosummary("names", listed) for heading, listed in sections.items())
        (names / f"{page}.txt").write_text(text, encoding="utf-8")
    # Autosummary looks for its directives in files, not in what pages include.
    everything = [name for sections in lists.values() for listed in sections.values() for name in listed]
    (names / "all.md").write_text(autosummary(".", everything), encoding="utf-8")
    app.config.autosummary_generate = [str(names / "all.md")]
    commands = fresh(HERE / "reference" / "commands")
    for name, text in command_pages():
        (commands / f"{name.replace(' ', '-')}.md").write_text(text, encoding="utf-8")
    headers = fresh(HERE / "reference" / "headers")
    sections = (header_text(HERE.parent / "magloc" / "core" / "include", name) for name in HEADERS)
    (headers / "all.txt").write_text("\n".join(sections), encoding="utf-8")
    notebooks = fresh(HERE / "gallery" / "notebooks")
    for path in sorted(NOTEBOOKS.glob("*.ipynb")):
        notebook = json.loads(path.read_text(encoding="utf-8"))
        drawing = [cell for cell in notebook["cells"] if pictures([cell])]
        for cell in drawing:
            if "plt." in "".join(cell["source"]):  # what the library or a command draws takes a line or two
                cell["metadata"]["tags"] = ["hide-input"]
        notebook["cells"][0]["source"] += [f"\n\n{{download}}`Download this notebook <{ORIGINALS}/{path.name}>`"]
        (notebooks / path.name).write_text(json.dumps(notebook), encoding="utf-8")
        (notebooks / f"{path.stem}.png").write_bytes(pictures(drawing)[0])
    (notebooks / "cards.txt").write_text(cards(), encoding="utf-8")
    app.config.html_static_path.append(str(mathjax(fresh(HERE / "_build" / "mathjax"))))


def fresh(folder: Path) -> Path:
    """An empty folder."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    return folder


def autosummary(folder: str, names: list[str]) -> str:
    """Table of names with their summaries, whose pages are in a folder."""
    options = f".. autosummary::\n   :toctree: {folder}\n   :nosignatures:\n"
    return "\n".join(["```{eval-rst}", options, *(f"   {name}" for name in names), "```", ""])


def reference_lists() -> dict[str, dict[str, list[str]]]:
    """Names of each page of the reference, by a heading that leads to the page of the guide."""
    lists: dict[str, dict[str, list[str]]] = {module: {"": public(module)} for module in MODULES}
    for page, names in EXPLAINED.items():
        title = (HERE / "guide" / f"{page}.md").read_text(encoding="utf-8").partition("\n")[0].removeprefix("# ")
        heading = f"## {title}\n\n[{title.partition(':')[0]}](../guide/{page}.md) explains these names.\n\n"
        for package in ("arrays", "magloc", "adcs", "sims"):
            homes = (package, f"{package}.viewer")
            if listed := [name for name in names.split() if name.rpartition(".")[0] in homes and name not in MODULES]:
                lists.setdefault(package, {})[heading] = listed
    return lists


def public(module: str) -> list[str]:
    """Names of a module that have pages: functions and classes."""
    things = import_module(module)
    return [f"{module}.{name}" for name in sorted(things.__all__) if callable(getattr(things, name))]


def cards() -> str:
    """Cards of all notebooks in the order of their numbers, and their hidden table of contents."""
    found = []
    for path in NOTEBOOKS.glob("*.ipynb"):
        cell = "".join(json.loads(path.read_text(encoding="utf-8"))["cells"][0]["source"])
        if (card := CARD.match(cell)) is None:
            raise ValueError(f"{path.name}: expected a number, a title, minutes and a question in bold")
        question = " ".join(card[4].split())
        found.append((int(card[1]), card[2], card[3], question[0].upper() + question[1:], path.stem))
    lines = ["::::{grid} 1 2 2 3", ":gutter: 3", ":class-container: gallery", ""]
    for number, title, minutes, question, stem in sorted(found):
        kept = f"notebook-{stem}.png"
        picture = f"../{kept}" if (HERE / kept).exists() else f"notebooks/{stem}.png"
        lines += [f":::{{grid-item-card}} {number}. {title}", f":link: notebooks/{stem}", ":link-type: doc"]
        lines += [f":img-top: {picture}", f"{question} *{minutes} min.*", ":::"]
    contents = [f"notebooks/{stem}" for *_, stem in sorted(found)]
    return "\n".join([*lines, "::::", "", "```{toctree}", ":hidden:", "", *contents, "```", ""])


def pictures(cells: list[dict[str, Any]]) -> list[bytes]:
    """Those among the kept outputs of a notebook."""
    outputs = (output.get("data", {}) for cell in cells for output in cell.get("outputs", []))
    return [base64.b64decode(data["image/png"]) for data in outputs if "image/png" in data]


def command_pages() -> Iterator[tuple[str, str]]:
    """Name and page of every command, from the help that the command prints."""
    from adcs.cli.app import app as adcs
    from magloc.cli.app import app as magloc
    from magloc.cli.framework import use_docstrings

    for app in (magloc, adcs):
        for tokens in ([name, *inner] for name in app for inner in ([], *([other] for other in app[name]))):
            use_docstrings(app, tokens)
        text = app.generate_docs(output_format="markdown", recursive=True)
        for part in re.split(r"^## (?=(?:magloc|adcs) )", text, flags=re.MULTILINE)[1:]:
            name, _, rest = part.partition("\n")
            rest = LINK.sub(r"\1\2", rest)
            yield name, f"# {name}\n{re.sub(r'^###', '##', rest, flags=re.MULTILINE)}"


def mathjax(folder: Path) -> Path:
    """A folder with MathJax as one file, from the package that carries it."""
    package = find_spec("sphinx-mathjax-offline")
    if package is None or package.submodule_search_locations is None:
        raise ModuleNotFoundError("formulas need MathJax: pip install sphinx-mathjax-offline")
    [place] = package.submodule_search_locations
    shutil.copy(Path(place) / "static" / "mathjax" / "tex-svg-full.js", folder / "mathjax.js")
    return folder


def readable(app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    """Make links of the pages of the theory that a docstring names, and a modulus of every pair of bars."""
    text = "\n".join(BAR.sub(lambda part: part[1] or r"\|", PAGE.sub(r":doc:`/theory/\1`", line)) for line in lines)
    if what == "module":
        text = text.replace("References\n----------\n", ".. rubric:: References\n\n")
    lines[:] = text.split("\n")


def illustrated(app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    """Add the picture of a public name, and the pages where it is used."""
    for picture, names in PICTURES.items():
        if name in names:
            lines += ["", f".. image:: /{picture}", f"   :alt: What {name} finds or draws", "   :width: 75%"]
    pages, related = see_also(name) if what in ("function", "class") else ([], [])
    if pages:
        lines += ["", ".. rubric:: See also", "", *(f"- :doc:`/{page}`" for page in pages)]
        lines += ["- " + ", ".join(f":py:obj:`{other}`" for other in related), ""] if related else [""]


def see_also(name: str) -> tuple[list[str], list[str]]:
    """Pages for a public name, that of its explanation first, and the names that are explained there too."""
    explained = {f"guide/{page}": names.split() for page, names in EXPLAINED.items()}
    own = {page: names for page, names in explained.items() if {name, name.rpartition(".")[0]} & {*names}}
    uses = {page: len(re.findall(rf"\b{re.escape(name)}\b(?!\.\w)", text)) for page, text in texts().items()}
    others = sorted((page for page, count in uses.items() if count and page not in own), key=lambda page: -uses[page])
    pages = [page for folder, most in MOST_PAGES.items() for page in [o for o in others if o.startswith(folder)][:most]]
    return [*own, *pages], [other for names in own.values() for other in names if other != name]


@cache
def texts() -> dict[str, str]:
    """What the pages of guide, theory and gallery say, by the name of the page."""
    pages = [*sorted((HERE / "guide").glob("*.md")), *sorted((HERE / "theory").glob("*.md"))]
    notebooks = sorted((HERE / "gallery" / "notebooks").glob("*.ipynb"))
    found = {page: page.read_text(encoding="utf-8") for page in pages if page.stem != "index"}
    for page in notebooks:
        cells = json.loads(page.read_text(encoding="utf-8"))["cells"]
        found[page] = "\n".join("".join(cell["source"]) for cell in cells)
    return {str(page.relative_to(HERE).with_suffix("")): text for page, text in found.items()}


def link_names(app: Sphinx, doctree: nodes.document) -> None:
    """Make a link to the reference of every public name that stands in a text as code."""
    for literal in list(doctree.findall(nodes.literal)):
        if literal.astext() in public_names() and not isinstance(literal.parent, (nodes.reference, pending_xref)):
            target = {"refdomain": "py", "reftype": "obj", "reftarget": literal.astext(), "refexplicit": False}
            link = pending_xref("", refdoc=app.env.current_document.docname, refwarn=False, **target)
            literal.replace_self(link)
            link += literal


@cache
def public_names() -> frozenset[str]:
    """All of them, with their package."""
    packages = [import_module(package) for package in ("arrays", "magloc", "adcs", "sims")]
    return frozenset(f"{package.__name__}.{name}" for package in packages for name in package.__all__)
