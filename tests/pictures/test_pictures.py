"""Every picture of the pages is of today's inputs: what they are drawn from is compared, and never their pixels."""

from __future__ import annotations

import io
import re
import shlex
from dataclasses import replace
from pathlib import Path

import pytest
from PIL import Image

import adcs.cli.app
import magloc.cli.app
from tests import pictures
from tests.pictures import (
    DOCS,
    OF_NOTEBOOKS,
    OF_THE_SITE,
    PICTURES,
    REPOSITORY,
    OfCommands,
    Panel,
    code_of,
    drawn,
    fingerprint,
)

APPS = {"magloc": magloc.cli.app.app, "adcs": adcs.cli.app.app}
# A picture that a page shows, by a directive, an option of a card, an image of Markdown, or a table of the site.
SHOWN = re.compile(
    r"(?:\{(?:figure|image)\} |img-top: |!\[[^\]]*\]\()([^\s)]+\.\w+)|^    \"([\w-]+\.png)\":", re.MULTILINE
)
TRACK = PICTURES["track-weaving.png"]


def shown() -> set[str]:
    """Pictures that the pages show, as they are named from docs."""
    written = [page for page in DOCS.rglob("*.md") if not {"_build", "commands", "names"} & set(page.parts)]
    texts = [page.read_text(encoding="utf-8") for page in [REPOSITORY / "README.md", DOCS / "explained.py", *written]]
    names = {first or second for text in texts for first, second in SHOWN.findall(text)}
    return {name.removeprefix("docs/").removeprefix("../") for name in names}


class TestWhatMakesThem:
    def test_of_every_picture_that_a_page_shows(self) -> None:
        assert len(shown()) > 30
        assert shown() <= PICTURES.keys() | OF_NOTEBOOKS | OF_THE_SITE

    def test_of_every_picture_that_is_kept(self) -> None:
        assert {path.name for path in DOCS.glob("*.png")} == PICTURES.keys() | OF_NOTEBOOKS

    def test_none_is_drawn_for_nothing(self) -> None:
        assert PICTURES.keys() <= shown()

    @pytest.mark.parametrize("line", sorted({s for p in PICTURES.values() for s in p.steps() if s.split()[0] in APPS}))
    def test_the_command_lines_are_accepted(self, line: str) -> None:
        name, *arguments = shlex.split(line)
        APPS[name].parse_args(arguments, exit_on_error=False, print_error=False)


class TestInputs:
    @pytest.mark.parametrize("name", PICTURES)
    def test_they_are_those_that_it_was_drawn_from(self, name: str) -> None:
        assert drawn().get(name) == fingerprint(PICTURES[name]), f"`make pictures` draws {name} anew; look at it"

    def test_none_is_kept_of_a_picture_that_is_gone(self) -> None:
        assert drawn().keys() <= PICTURES.keys()

    def test_another_option_is_another_input(self) -> None:
        assert isinstance(TRACK, OfCommands)
        other = replace(TRACK, lines=(*TRACK.lines[:-1], TRACK.lines[-1].replace("0.1", "0.2")))
        assert fingerprint(other) != fingerprint(TRACK)

    def test_another_word_in_a_file_is_another_input(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        for source in TRACK.sources:
            (tmp_path / source).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / source).write_bytes((REPOSITORY / source).read_bytes())
        before = fingerprint(TRACK)
        monkeypatch.setattr(pictures, "REPOSITORY", tmp_path)
        assert fingerprint(TRACK) == before
        with (tmp_path / TRACK.sources[0]).open("a") as scenario:
            scenario.write("seed = 1\n")
        assert fingerprint(TRACK) != before


def test_docstrings_and_comments_draw_nothing(tmp_path: Path) -> None:
    path = tmp_path / "figure.py"
    codes = []
    for version in (
        '"""A\\nmap."""\n\n# W.\nWIDTH = 7.1\n\ndef draw():\n    """Draw it.\n\n    All.\n    """\n    return "#"\n',
        '"""Map."""\nWIDTH = 7.1\ndef draw():\n    """Draw."""\n    return "#"\n',
        '"""Map."""\nWIDTH = 7.1\ndef draw():\n    """Draw."""\n    return "##"\n',
    ):
        path.write_text(version, encoding="utf-8")
        codes.append(code_of(path))
    assert codes[0] == codes[1] == b'WIDTH = 7.1\ndef draw():\n    return "#"'
    assert codes[2] != codes[1]


def test_a_command_draws(tmp_path: Path) -> None:
    picture = OfCommands(("magloc map --grid 5 --out map",), "map/convergence.png", (), widest_px=300)
    assert Image.open(io.BytesIO(picture.draw(tmp_path))).width == 300


def test_a_panel_is_cut_out() -> None:
    panel = PICTURES["card-locate.png"]
    assert isinstance(panel, Panel)
    cut = Image.open(io.BytesIO(panel.draw(DOCS)))
    assert cut.convert("RGB").tobytes() == Image.open(DOCS / panel.of).crop(panel.box).convert("RGB").tobytes()
