"""The pictures of ``docs`` that no notebook shows: what each is made of, and how it is drawn.

``python -m tests.pictures`` draws those whose inputs are others than when they were drawn last: the commands or code
of a page, and the files of the repository that decide what is seen. ``drawn.json`` keeps checksums of the inputs, for
pixels differ with fonts, versions and graphics drivers.
"""

from __future__ import annotations

import ast
import hashlib
import io
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import viser
from PIL import Image

import magloc
from arrays.array_file import read_array
from magloc.viewer.origin import SMOOTH
from magloc.viewer.pages.pages import Page, array_page, survey_page
from magloc.viewer.server import open_server
from tests.browser.browser import Browser
from tests.browser.screen import Screen
from tests.notebooks import DOCS, MOST_PIXELS, NOTEBOOKS, ON_PAGES, SHOWN, small, with_commands

REPOSITORY = DOCS.parent
DRAWN = Path(__file__).parent / "drawn.json"
BLOCK = re.compile(r"^```python\n(.*?)^```", re.DOTALL | re.MULTILINE)
STYLE = "magloc/plots/style.py"
SCENE = ("magloc/viewer/scene/framing.py", "magloc/viewer/scene/glyphs.py", "magloc/viewer/scene/ruler.py")
SAVED = "\nfigure.savefig({file!r})\n"


def run(line: str, folder: Path) -> None:
    """A command line, executed in a folder."""
    name, *arguments = shlex.split(line)
    command = shutil.which(name, path=with_commands()) or name
    subprocess.run([command, *arguments, "--quiet"], cwd=folder, stdout=subprocess.DEVNULL, check=True)


class Picture(Protocol):
    """How a picture is made."""

    @property
    def sources(self) -> tuple[str, ...]:
        """Files of the repository that decide what is seen."""
        ...

    def steps(self) -> tuple[str, ...]:
        """Command lines, or code."""
        ...

    def draw(self, folder: Path) -> bytes:
        """Its PNG file, drawn in an empty folder."""
        ...


@dataclass(frozen=True)
class OfCommands:
    """Written by the last of some commands."""

    lines: tuple[str, ...]
    file: str
    sources: tuple[str, ...]
    widest_px: int = MOST_PIXELS

    def steps(self) -> tuple[str, ...]:
        return self.lines

    def draw(self, folder: Path) -> bytes:
        for line in self.lines:
            run(line, folder)
        return small((folder / self.file).read_bytes(), self.widest_px)


@dataclass(frozen=True)
class OfPage:
    """The ``figure`` of the first block of a page of the guide that has one."""

    page: str
    sources: tuple[str, ...] = ()

    def steps(self) -> tuple[str, ...]:
        blocks = BLOCK.findall((DOCS / "guide" / f"{self.page}.md").read_text(encoding="utf-8"))
        return (next(block for block in blocks if re.search(r"^figure\b.* = ", block, re.MULTILINE)),)

    def draw(self, folder: Path) -> bytes:
        file = f"{self.page}.png"
        code = self.steps()[0] + SAVED.format(file=file)
        environment = {**os.environ, "MPLBACKEND": "agg"}
        subprocess.run([sys.executable, "-c", code], cwd=folder, env=environment, stdout=subprocess.DEVNULL, check=True)
        return small((folder / file).read_bytes())


@dataclass(frozen=True)
class OfRecording:
    """Drawn by a module of the tests from a recording, in minutes."""

    module: str
    sources: tuple[str, ...]

    def steps(self) -> tuple[str, ...]:
        return (f"python -m {self.module} --out recording.png",)

    def draw(self, folder: Path) -> bytes:
        file = folder / "recording.png"
        subprocess.run([sys.executable, "-m", self.module, "--out", str(file)], cwd=REPOSITORY, check=True)
        return small(file.read_bytes())


@dataclass(frozen=True)
class OfTables:
    """Drawn by ``python -m tests.proof.picture`` from the tables of a page of validation."""

    page: str
    sources: tuple[str, ...]

    def steps(self) -> tuple[str, ...]:
        text = (DOCS / "validation" / self.page).read_text(encoding="utf-8")
        return tuple(line for line in text.splitlines() if line.startswith("| "))

    def draw(self, folder: Path) -> bytes:
        file = folder / "tables.png"
        subprocess.run([sys.executable, "-m", "tests.proof.picture", str(file)], cwd=REPOSITORY, check=True)
        return file.read_bytes()


@dataclass(frozen=True)
class Panel:
    """One panel of another picture, cut out: left, top, right and bottom [px]."""

    of: str
    box: tuple[int, int, int, int]

    @property
    def sources(self) -> tuple[str, ...]:
        return (f"docs/{self.of}",)

    def steps(self) -> tuple[str, ...]:
        return (f"cut {self.box}",)

    def draw(self, folder: Path) -> bytes:
        cut = io.BytesIO()
        Image.open(DOCS / self.of).crop(self.box).save(cut, "png", optimize=True)
        return cut.getvalue()


@dataclass(frozen=True)
class LivePage:
    """A live page in Chromium, when it says some words; by default that of an array, when it has found its dipole."""

    made_by: str
    array: str
    sources: tuple[str, ...]
    size_px: tuple[int, int] = (1280, 800)
    fill: Callable[[viser.ViserServer, Path], Page] = lambda server, path: array_page(
        server, read_array(path), live=True
    )
    words: str = "found at"

    def steps(self) -> tuple[str, ...]:
        return (self.made_by, f"the live page of {self.array} at {self.size_px}")

    def draw(self, folder: Path) -> bytes:
        run(self.made_by, folder)
        with Browser("about:blank", self.size_px) as browser, open_server(0, self.array) as server:
            screen, page = Screen(browser, folder), self.fill(server, folder / self.array)
            screen.open_server(server, SMOOTH)
            screen.until(lambda: self.words in screen.text(), "the page is complete")
            screen.keep("live")
            screen.leave()
            page.close()
        return small((folder / "live.png").read_bytes())


def review_page(server: viser.ViserServer, array: Path) -> Page:
    """The page to review the survey of the file beside an array."""
    sensors = read_array(array)
    rows = magloc.read_readings(array.with_name(array.name.replace("-array.toml", ".csv")), sensors)
    return survey_page(server, magloc.survey(sensors, rows), save=str, live=True)


SIMULATED = "magloc simulate weaving --out weaving.csv"
WEAVING = "sims/magnetics/scenarios/weaving.toml"
PAPER = ("magloc/convergence/scenarios/paper.toml", "magloc/plots/maps.py", STYLE)
MAP = "magloc map --out map"
SURVEY = (
    "magloc simulate survey-drone --out field.csv --seed 7",
    "magloc survey field.csv --array field-array.toml --out found",
)
SURVEY_SOURCES = (
    "sims/magnetics/scenarios/survey-drone.toml",
    "magloc/plots/surveys.py",
    "magloc/plots/profiles.py",
    STYLE,
)
PICTURES: dict[str, Picture] = {
    "track-weaving.png": OfCommands(
        (
            SIMULATED,
            "magloc track weaving.csv --array weaving-array.toml --truth weaving-truth.csv"
            " --speed-m-s 0.1 --turn-deg-s 1.2 --out track",
        ),
        "track/track.png",
        (WEAVING, "magloc/plots/tracks.py", STYLE),
        widest_px=1420,
    ),
    "track-three-magnets.png": OfCommands(
        (
            "magloc simulate three-magnets --out three.csv",
            "magloc track three.csv --array three-array.toml --sources 3 --out tracks",
        ),
        "tracks/track.png",
        ("sims/magnetics/scenarios/three-magnets.toml", "magloc/plots/tracks.py", STYLE),
        widest_px=1420,
    ),
    "survey-map.png": OfCommands(SURVEY, "found/survey.png", SURVEY_SOURCES),
    "survey-quality.png": OfCommands(
        (SURVEY[0], "magloc qc field.csv --array field-array.toml --out checked"),
        "checked/qc.png",
        ("sims/magnetics/scenarios/survey-drone.toml", "magloc/deliverables/quality_figure.py", STYLE),
    ),
    "survey-profiles.png": OfCommands(SURVEY, "found/profiles.png", SURVEY_SOURCES),
    "convergence-paper.png": OfCommands((MAP,), "map/convergence.png", PAPER, widest_px=1420),
    "bounds-reach.png": OfCommands(
        ("magloc bounds --moment-Am2 0 0 100 --accuracy-m 0.5 --out bounds",),
        "bounds/bounds-reach.png",
        ("magloc/convergence/scenarios/wide.toml", "magloc/plots/bounds.py", "magloc/plots/bound_scale.py", STYLE),
        widest_px=1420,
    ),
    "design-half-space.png": OfCommands(
        ("magloc design half-space-2m --png design.png",),
        "design.png",
        ("magloc/design/tasks/half-space-2m.toml", "magloc/plots/designs.py", STYLE),
    ),
    "attitude-complementary.png": OfCommands(
        ("adcs run complementary --filter adaptive --outage magnetometer-only --out comp",),
        "comp/complementary.png",
        ("adcs/plots/complementary.py", STYLE),
    ),
    "residuals-faulty.png": OfPage("sensor-faults", ("magloc/plots/localization.py", STYLE)),
    "joystick.png": OfPage("joystick", ("magloc/plots/calibrations.py", STYLE)),
    "hall-board.png": OfPage("hall-board", ("magloc/plots/tracks.py", STYLE)),
    "compensation.png": OfPage("compensation", ("magloc/plots/compensations.py", STYLE)),
    "drone-compass.png": OfPage("drone-compass", ("adcs/plots/vehicle_calibration.py", STYLE)),
    "background-diver.png": OfPage("background"),
    "distance-of-a-coil.png": OfPage("single-sensor-ranging"),
    "gradient-tensor.png": OfPage("gradient-tensor"),
    "same-data.png": OfTables("same-data.md", ("tests/proof/picture.py",)),
    "beating-tissue.png": OfRecording("docs.studies.beating_tissue", ("docs/studies/beating_tissue.py",)),
    "stars-identified.png": OfPage("star-identification"),
    "view-array.png": OfCommands(
        (
            "magloc new-array array.toml --shape tetrahedron --size-m 1.5 --noise-nT 1",
            "magloc view array.toml --png array.png",
        ),
        "array.png",
        SCENE,
    ),
    "view-dipole.png": LivePage(
        SIMULATED, "weaving-array.toml", (WEAVING, *SCENE, "magloc/viewer/pages/dipole_editor.py")
    ),
    "review-targets.png": LivePage(
        SURVEY[0],
        "field-array.toml",
        (*SURVEY_SOURCES[:1], *SCENE, "magloc/viewer/pages/survey.py", "magloc/viewer/pages/survey_review.py"),
        (1280, 1000),
        review_page,
        "Fit again",
    ),
    "view-map.png": OfCommands(
        (MAP, "magloc view map --png view-map.png"), "view-map.png", (PAPER[0], "magloc/viewer/pages/map.py", *SCENE)
    ),
    "view-mockup.png": OfCommands(
        ("adcs run mockup --part fusion --png view-mockup.png",),
        "view-mockup.png",
        (
            "adcs/viewer/drive_page.py",
            "adcs/viewer/drive_player.py",
            "adcs/viewer/table_scene.py",
            "magloc/viewer/panels/time_player.py",
        ),
    ),
    "card-locate.png": Panel("notebook-03-real-magnet.png", (12, 58, 296, 326)),
    "card-track.png": Panel("notebook-05-tracking.png", (426, 362, 852, 562)),
    "card-survey.png": Panel("survey-map.png", (58, 46, 409, 230)),
    "card-live.png": Panel("hall-board.png", (272, 62, 722, 510)),
    "card-calibrate.png": Panel("notebook-08-calibration.png", (24, 6, 330, 168)),
    "card-design.png": Panel("design-half-space.png", (58, 92, 418, 424)),
    "card-attitude.png": Panel("attitude-track.png", (20, 28, 322, 188)),
    "card-stars.png": Panel("stars-identified.png", (72, 5, 356, 235)),
}
OF_NOTEBOOKS = {f"notebook-{name}.png" for name in SHOWN} | {file for file, _ in ON_PAGES.values()}
# Pages of the gallery have pictures of notebooks that are written when the site is built.
OF_THE_SITE = {f"notebooks/{path.stem}.png" for path in NOTEBOOKS}


def code_of(path: Path) -> bytes:
    """Return the contents of a file, of a Python file without docstrings and comment lines."""
    if path.suffix != ".py":
        return path.read_bytes()
    lines = path.read_text(encoding="utf-8").splitlines()
    for node in ast.walk(ast.parse("\n".join(lines))):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            end = node.end_lineno or node.lineno
            lines[node.lineno - 1 : end] = [""] * (end - node.lineno + 1)
    return "\n".join(line for line in lines if line.strip() and not line.strip().startswith("#")).encode()


def fingerprint(picture: Picture) -> str:
    """Checksum of its steps and of the files that decide what is seen."""
    digest = hashlib.sha256("\n".join(picture.steps()).encode())
    for source in picture.sources:
        digest.update(hashlib.sha256(code_of(REPOSITORY / source)).digest())
    return digest.hexdigest()


def drawn() -> dict[str, str]:
    """Checksums of what each picture was drawn from."""
    kept: dict[str, str] = json.loads(DRAWN.read_text(encoding="utf-8"))
    return kept


def stale() -> list[str]:
    """Pictures whose inputs are others than when they were drawn."""
    kept = drawn()
    return [name for name, picture in PICTURES.items() if kept.get(name) != fingerprint(picture)]
