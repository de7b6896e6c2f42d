"""The live page of a track: time moves the scene, and the plot beside it."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator

import numpy as np
import pytest
import viser
from matplotlib.colors import rgb_to_hsv
from numpy.typing import NDArray

from arrays.geometries import tetrahedron
from magloc.measurement.differences import predicted_channels
from magloc.readings import Readings
from magloc.tracking.results import TrackPoint, TrackResult
from magloc.viewer.pages.pages import track_page
from magloc.viewer.pages.track_player import time_colours
from magloc.viewer.panels.lines import _LEFT, _RIGHT, _WIDTH
from magloc.viewer.scene.glyphs import DIPOLE_COLOUR
from magloc.viewer.server import open_server
from tests.browser.screen import Screen, Sight, close_to, dark_grey, hue_of

FloatArray = NDArray[np.float64]
ARRAY = tetrahedron(1.5)
TIMES = 0.5 * np.arange(41)
POSITIONS = np.stack([np.linspace(-4.0, 4.0, 41), np.full(41, 3.0), np.linspace(0.0, 1.0, 41)], axis=-1)
MOMENT = np.array([0.0, 0.0, 80.0])
SIGMA_M = 0.1
Z = np.array([0.0, 0.0, 1.0])
RESULT = TrackResult(
    tuple(
        TrackPoint(
            float(time), position, MOMENT, np.diag([SIGMA_M**2] * 3 + [1.0] * 3), nis=9.0, nis_dof=9, status="tracked"
        )
        for time, position in zip(TIMES, POSITIONS, strict=True)
    ),
    is_truth=False,
)
READINGS = Readings(np.array([predicted_channels(ARRAY, place, MOMENT) for place in POSITIONS]), time_s=TIMES)
# The scene holds the track and the array: a fifth of its radius.
_SEEN = np.vstack([POSITIONS, ARRAY.positions])
ARROW_M = 0.2 * float(np.linalg.norm(_SEEN - 0.5 * (_SEEN.min(axis=0) + _SEEN.max(axis=0)), axis=1).max())
ORANGE = hue_of(DIPOLE_COLOUR)
EARLY, LATE = (hue_of(colour, 35.0, 0.25) for colour in time_colours(np.array([0.0, 0.3, 0.75, 1.0]))[1:3])


def coloured(picture: FloatArray) -> NDArray[np.bool_]:
    """Pixels of a colour of times, from violet to green; not of the moment, of ellipsoids or of grey lines."""
    hue, saturation, value = np.moveaxis(rgb_to_hsv(picture), -1, 0)
    return (hue > 60.0 / 360.0) & (hue < 300.0 / 360.0) & (saturation > 0.25) & (value > 0.2)


@pytest.fixture(scope="module")
def server(screen: Screen) -> Iterator[viser.ViserServer]:
    with open_server(0, "track") as server:
        page = track_page(server, RESULT, ARRAY, READINGS)
        screen.open_server(server)
        yield server
        screen.leave()
        page.close()


def slid(screen: Screen, name: str, share: float, followed: Callable[[], bool]) -> None:
    """Drag a slider, and wait for what follows it."""
    screen.slide(name, share)
    screen.until(followed, f"what follows the slider {name}", again=lambda: screen.slide(name, share))


def row_of(screen: Screen) -> int:
    """Which row the panel says is shown, from 0."""
    words = re.search(r"row (\d+) of 41", screen.text())
    assert words, screen.text()
    return int(words[1]) - 1


def arrow_in(row: int) -> FloatArray:
    """The head of the moment's arrow, beyond the ellipsoid."""
    return POSITIONS[row : row + 1] + 0.85 * ARROW_M * Z


def plot_box(screen: Screen) -> dict[str, float]:
    """Rectangle of the plot of the readings, scrolled into view [px]."""
    box = screen.browser.wait_for(
        "(() => { const plot = [...document.querySelectorAll('svg.lines')].find(found => found.clientWidth);"
        " if (!plot) return null;"
        " plot.scrollIntoView({block: 'nearest'}); return plot.getBoundingClientRect().toJSON() })()"
    )
    return dict(box)


def across(box: dict[str, float], share: float) -> float:
    """Where a share of the axis of time is in the page [px]."""
    return box["x"] + box["width"] * (_LEFT + share * (_RIGHT - _LEFT)) / _WIDTH


class TestTrack:
    """In the order of a user's session."""

    @pytest.mark.slow
    def test_line_arrow_and_array_are_where_the_camera_has_them(
        self, screen: Screen, server: viser.ViserServer
    ) -> None:
        camera = screen.live_camera(server)
        between = 0.5 * (POSITIONS[1:] + POSITIONS[:-1])
        screen.until_seen(
            Sight("track", camera.pixels(between), coloured),
            Sight("track a third on", camera.pixels(POSITIONS[11:14]), EARLY),
            Sight("track three quarters on", camera.pixels(POSITIONS[29:32]), LATE),
            Sight("moment at the end", camera.pixels(arrow_in(40)), ORANGE, radius=4),
            Sight("sensor", camera.pixels(ARRAY.positions), dark_grey),
            Sight("track", camera.pixels(between[::8] + 1.5 * Z), coloured, absent=True),
        )
        screen.keep("track")
        assert row_of(screen) == 40
        assert screen.browser.errors == []

    @pytest.mark.slow
    def test_the_time_slider_moves_the_scene(self, screen: Screen, server: viser.ViserServer) -> None:
        camera = screen.live_camera(server)
        slid(screen, "Time [s]", 0.3, lambda: abs(row_of(screen) - 12) <= 2)
        row = row_of(screen)
        later = 0.5 * (POSITIONS[row + 2 :] + POSITIONS[row + 1 : -1])
        screen.until_seen(
            Sight("moment", camera.pixels(arrow_in(row)), ORANGE, radius=4),
            Sight("track so far", camera.pixels(POSITIONS[1:row]), coloured),
            Sight("moment where it was", camera.pixels(arrow_in(40)), ORANGE, radius=4, absent=True),
            Sight("track of later times", camera.pixels(later[2:]), coloured, absent=True),
        )
        screen.keep("track-earlier")

    @pytest.mark.slow
    def test_the_tail_is_cut(self, screen: Screen, server: viser.ViserServer) -> None:
        camera = screen.live_camera(server)
        slid(screen, "Time [s]", 1.0, lambda: row_of(screen) == 40)
        slid(screen, "Tail [s]", 0.25, lambda: abs(screen.numbers("Tail [s]")[0] - 5.0) < 1.0)
        screen.until_seen(
            Sight("tail", camera.pixels(POSITIONS[33:40]), coloured),
            Sight("track before the tail", camera.pixels(POSITIONS[:27]), coloured, absent=True),
        )

    def test_play_and_pause(self, screen: Screen, server: viser.ViserServer, monkeypatch: pytest.MonkeyPatch) -> None:
        tenths, last = iter(range(52)), [52]  # the clock stands still after 5.2 s, in row 10
        monkeypatch.setattr("magloc.viewer.panels.time_player.perf_counter", lambda: 0.1 * next(tenths, last[0]))
        camera = screen.live_camera(server)

        def play() -> None:
            if screen.evaluate("[...document.querySelectorAll('button')].some(b => b.innerText.trim() === 'Play')"):
                screen.browser.click(*screen.button("Play"))

        play()
        screen.until(lambda: row_of(screen) == 10, "time runs from the beginning", again=play)
        screen.browser.click(*screen.button("Pause"))
        screen.browser.wait_for("[...document.querySelectorAll('button')].some(b => b.innerText.trim() === 'Play')")
        last[0] = 150  # it goes on, and moves nothing
        screen.until_seen(Sight("moment", camera.pixels(arrow_in(10)), ORANGE, radius=4))
        assert row_of(screen) == 10

    def test_keys_step_from_row_to_row(self, screen: Screen, server: viser.ViserServer) -> None:
        def press(key: str) -> None:
            for kind in ("keyDown", "keyUp"):
                screen.browser.call("Input.dispatchKeyEvent", type=kind, key=key, code=key)

        begin = row_of(screen)
        for key, row in (("PageDown", begin + 1), ("PageUp", begin)):
            press(key)
            screen.until(lambda row=row: row_of(screen) == row, f"the row after {key}")  # type: ignore[misc]

    @pytest.mark.slow
    def test_the_plot_marks_the_time(self, screen: Screen, server: viser.ViserServer) -> None:
        slid(screen, "Time [s]", 0.5, lambda: abs(row_of(screen) - 20) <= 2)
        share = row_of(screen) / 40.0
        box = plot_box(screen)
        rows = box["y"] + box["height"] * np.linspace(0.15, 0.75, 8)
        mark = np.column_stack([np.full(8, across(box, share)), rows])
        elsewhere = mark + np.array([0.2 * box["width"], 0.0])

        grey = close_to((128, 128, 128), 30.0)
        screen.until_seen(
            Sight("mark of the time", mark, grey, radius=2),
            Sight("mark of the time", elsewhere, grey, radius=2, absent=True),
        )
        screen.keep("track-plot")

    def test_a_click_into_the_plot_moves_time(self, screen: Screen, server: viser.ViserServer) -> None:
        camera = screen.live_camera(server)

        def click() -> None:
            box = plot_box(screen)
            screen.browser.click(across(box, 0.25), box["y"] + 0.5 * box["height"])

        click()
        screen.until(lambda: row_of(screen) == 10, "the row that was pointed at", again=click)
        screen.until_seen(Sight("moment", camera.pixels(arrow_in(10)), ORANGE, radius=4))
