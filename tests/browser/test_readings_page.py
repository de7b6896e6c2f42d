"""The live page of readings: the fix of the row that is chosen is seen where its numbers say."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import viser

from arrays.geometries import tetrahedron
from magloc.measurement.differences import predicted_channels
from magloc.readings import Readings
from magloc.viewer.pages.live_fit import LiveFit
from magloc.viewer.pages.pages import readings_page
from magloc.viewer.scene.glyphs import DIPOLE_COLOUR, FIT_COLOUR
from magloc.viewer.server import open_server
from tests.browser.conftest import SIZE
from tests.browser.screen import Screen, Sight, dark_grey, hue_of

ARRAY = tetrahedron(1.5)
POSITIONS = np.stack([np.linspace(-2.0, 2.0, 9), np.full(9, 2.0), np.full(9, 0.5)], axis=-1)
MOMENT = np.array([0.0, 0.0, 80.0])
ORANGE = hue_of(DIPOLE_COLOUR)
# Height of the sheet that viser lays over the scene on a phone.
PANEL_PX = """document.querySelector('[style*="max-height: 60%"]').getBoundingClientRect().height"""


@pytest.fixture(scope="module")
def server(screen: Screen) -> Iterator[viser.ViserServer]:
    values = np.array([predicted_channels(ARRAY, position, MOMENT) for position in POSITIONS])
    rows = Readings(values, time_s=0.5 * np.arange(9.0))
    fit = LiveFit(ARRAY)
    fixes = [fit.fix(reading) for reading in values]
    with open_server(0, "readings") as server:
        page = readings_page(server, ARRAY, fixes, rows)
        screen.open_server(server)
        yield server
        screen.leave()
        page.close()


class TestReadings:
    @pytest.mark.slow
    @pytest.mark.parametrize(("share", "row"), [(0.0, 0), (1.0, 8)])
    def test_the_row_slider_moves_the_source(
        self, screen: Screen, server: viser.ViserServer, share: float, row: int
    ) -> None:
        camera = screen.live_camera(server)
        screen.slide("row", share)
        x, y, z = POSITIONS[row].tolist()
        # The readings have no errors: neither has the fix.
        words = f"time {0.5 * row:g} s, ({x:.3f}, {y:.3f}, {z:.3f}) m"
        screen.until(lambda: words in screen.text().replace("\N{MINUS SIGN}", "-"), words)
        others = np.delete(POSITIONS, [0, row, 8], axis=0)
        screen.until_seen(
            Sight("source", camera.pixels([POSITIONS[row]]), ORANGE),
            Sight("source of the other row", camera.pixels([POSITIONS[8 - row]]), ORANGE, absent=True),
            Sight("fixes of other rows", camera.pixels(others), hue_of(FIT_COLOUR), share=0.7),
            Sight("sensor", camera.pixels(ARRAY.positions), dark_grey, share=0.75),
        )
        screen.keep("readings")

    @pytest.mark.slow
    def test_what_is_not_connected_yet_says_so(self, screen: Screen, server: viser.ViserServer) -> None:
        """viser's page says "Inactive" until it has connected: in its first minute."""
        screen.open(f"http://127.0.0.1:{server.get_port()}")
        screen.evaluate("document.body.append(Object.assign(document.createElement('p'), {innerText: 'Inactive'}))")
        screen.until(lambda: "Connecting…" in screen.text() and "Inactive" not in screen.text(), "it connects")

    def test_on_a_phone_all_is_in_view_and_the_panel_folded(self, screen: Screen, server: viser.ViserServer) -> None:
        shape = {"deviceScaleFactor": 1, "mobile": False}
        screen.leave()
        screen.browser.call("Emulation.setDeviceMetricsOverride", width=390, height=844, **shape)
        try:
            screen.open(f"http://127.0.0.1:{server.get_port()}")
            away = np.linalg.norm(np.asarray(server.initial_camera.position) - server.initial_camera.look_at)

            def stepped_back() -> bool:
                cameras = [client.camera for client in server.get_clients().values()]
                return any(np.linalg.norm(camera.position - camera.look_at) > 2.0 * away for camera in cameras)

            screen.until(stepped_back, "the camera steps back")
            screen.until(lambda: screen.evaluate(PANEL_PX) < 100.0, "the panel folds")
            camera = screen.live_camera(server)
            screen.until_seen(Sight("fixes", camera.pixels(POSITIONS[1:-1]), hue_of(FIT_COLOUR), share=0.7))
            screen.keep("readings-phone")
        finally:
            screen.browser.call("Emulation.setDeviceMetricsOverride", width=SIZE[0], height=SIZE[1], **shape)
