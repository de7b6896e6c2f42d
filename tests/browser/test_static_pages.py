"""The files of ``--html``: they need no server, and show the same scene from the same camera."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from arrays.array_file import write_array
from arrays.geometries import tetrahedron
from magloc.viewer.pages.open_result import MapResult
from magloc.viewer.pages.pages import array_page, map_page, track_page
from magloc.viewer.scene.framing import PHONE_WIDTH
from magloc.viewer.scene.glyphs import DIPOLE_COLOUR
from magloc.viewer.server import open_server, page_html, write_page
from tests.browser.conftest import SIZE
from tests.browser.screen import Screen, Sight, dark_grey, hue_of
from tests.browser.test_map_page import DIPOLE, RESULT, sights
from tests.browser.test_track_page import ARRAY, ORANGE, READINGS, TIMES, across, arrow_in, plot_box
from tests.browser.test_track_page import RESULT as TRACK
from tests.command_line import Run

LARGEST = 15_000_000
PLAYED = "document.querySelector('[role=slider]').ariaValueNow"


class TestStaticPages:
    @pytest.mark.slow
    def test_array_of_3_cm(self, screen: Screen, run: Run, tmp_path: Path) -> None:
        array = tetrahedron(0.03)
        write_array(tmp_path / "array.toml", array)
        page = tmp_path / "array.html"
        assert run("view", tmp_path / "array.toml", "--html", page, "--quiet").status == 0
        with open_server(0, "array") as server:
            array_page(server, array, live=False)
            screen.open(page.as_uri())
            camera = screen.camera(server.initial_camera)
        screen.until_seen(
            Sight("body of a sensor", camera.pixels(array.positions), dark_grey),
            Sight("sensor", camera.pixels(-0.5 * array.positions), dark_grey, absent=True),
        )
        assert screen.browser.requests == [page.as_uri()]
        assert screen.browser.errors == []
        screen.keep("static-array")

    def test_map(self, screen: Screen, tmp_path: Path) -> None:
        page = tmp_path / "map.html"
        with open_server(0, "map") as server:
            write_page(page_html(server, map_page(server, RESULT)), page)
            screen.open(page.as_uri())
            camera = screen.camera(server.initial_camera)
        on_slice = np.array([[x, 0.0, z] for x in (0.5, 3.5) for z in (-3.5, -2.0, 3.5)])
        arrow = camera.pixels(DIPOLE)
        screen.until_seen(
            *sights("slice", camera, on_slice, within=45.0), Sight("the source", arrow, hue_of(DIPOLE_COLOUR), radius=6)
        )
        screen.keep("static-map")
        assert "passes until convergence" in screen.text()

    def test_a_map_of_41_points_along_an_axis_is_small(self, tmp_path: Path) -> None:
        axis = np.linspace(-20.0, 20.0, 41)
        values = np.random.default_rng(0).uniform(1.0, 60.0, (41, 41, 41))
        known = np.zeros(values.shape, dtype=bool)
        array = tetrahedron(1.0)
        result = MapResult(axis, values, known, "starts", "passes", False, array, None, None, "random", 1)
        with open_server(0, "map") as server:
            write_page(page_html(server, map_page(server, result)), tmp_path / "map.html")
        assert (tmp_path / "map.html").stat().st_size < LARGEST

    def test_on_a_phone_all_is_in_view(self, screen: Screen, tmp_path: Path) -> None:
        """A page that is narrow sees as far to the sides as the first camera does: its picture is that much smaller."""
        page, shape = tmp_path / "array.html", {"deviceScaleFactor": 1, "mobile": False}
        array = tetrahedron(0.03)
        with open_server(0, "array") as server:
            write_page(page_html(server, array_page(server, array, live=False)), page)
            screen.browser.call("Emulation.setDeviceMetricsOverride", width=390, height=844, **shape)
            try:
                screen.open(page.as_uri())
                camera = screen.camera(server.initial_camera)
                upright = 2.0 * np.arctan(PHONE_WIDTH * 844.0 / 390.0 * np.tan(0.5 * camera.field_of_view_rad))
                places = replace(camera, field_of_view_rad=upright).pixels(array.positions)
                assert (places[:, 0] > 0.0).all()
                assert (places[:, 0] < 390.0).all()
                screen.until_seen(Sight("body of a sensor", places, dark_grey))
                screen.keep("static-phone")
            finally:
                screen.browser.call("Emulation.setDeviceMetricsOverride", width=SIZE[0], height=SIZE[1], **shape)


class TestReadings:
    """A track of 41 rows, played for 20 s after it has stood still for 2 s; its last row is shown at first."""

    @pytest.fixture
    def wide(self, screen: Screen) -> Iterator[None]:
        """Room for the scene beside the plot."""
        shape = {"deviceScaleFactor": 1, "mobile": False}
        screen.browser.call("Emulation.setDeviceMetricsOverride", width=1280, height=800, **shape)
        yield
        screen.browser.call("Emulation.setDeviceMetricsOverride", width=SIZE[0], height=SIZE[1], **shape)

    @pytest.mark.slow
    @pytest.mark.usefixtures("wide")
    def test_a_click_into_the_plot_moves_the_scene_and_the_cursor(self, screen: Screen, tmp_path: Path) -> None:
        page = tmp_path / "track.html"
        with open_server(0, "track") as server:
            write_page(page_html(server, track_page(server, TRACK, ARRAY, READINGS)), page)
            screen.open(page.as_uri())
            camera = screen.camera(server.initial_camera)
        places = camera.pixels(arrow_in(20))
        screen.until_seen(Sight("the moment at the end", camera.pixels(arrow_in(40)), ORANGE, radius=4))
        assert "row 41 of 41" in screen.text()
        np.testing.assert_allclose(self.numbers(screen), 1e9 * READINGS.values_T[40], atol=0.051)
        box = plot_box(screen)
        screen.until(lambda: float(screen.evaluate(PLAYED)) > 0.0, "the player has begun")
        screen.browser.click(across(box, 0.5), box["y"] + 0.4 * box["height"])
        screen.until_seen(Sight("the moment in the middle", places, ORANGE, radius=4))
        assert float(screen.evaluate(PLAYED)) == pytest.approx(2.0 + 20.5 / 41.0 * TIMES[-1], abs=0.01)
        np.testing.assert_allclose(self.numbers(screen), 1e9 * READINGS.values_T[20], atol=0.051)
        assert "row 21 of 41" in screen.text()
        assert screen.browser.errors == []
        screen.keep("static-readings")

    def numbers(self, screen: Screen) -> list[float]:
        """At the cursor, of every channel."""
        texts = screen.evaluate("[...document.querySelectorAll('#row b.of-channel')].map(found => found.textContent)")
        return [float(text.replace("\N{MINUS SIGN}", "-")) for text in texts]
