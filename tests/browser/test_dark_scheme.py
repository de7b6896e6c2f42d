"""A page is dark where the browser asks for it, and all that it shows is seen there."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import viser

from arrays.geometries import tetrahedron
from magloc.viewer.pages.pages import array_page
from magloc.viewer.server import open_server, page_html, write_page
from tests.browser.screen import Screen, Sight, close_to, dark_grey

ARRAY = tetrahedron(1.0)
LIGHTNESS = "getComputedStyle(document.getElementById('legend')).color.match(/[0-9]+/)[0]"


@pytest.fixture(params=["dark", "light"])
def scheme(request: pytest.FixtureRequest, screen: Screen) -> Iterator[str]:
    features = [{"name": "prefers-color-scheme", "value": request.param}]
    screen.browser.call("Emulation.setEmulatedMedia", features=features)
    yield request.param
    screen.browser.call("Emulation.setEmulatedMedia", features=[])


def sights(screen: Screen, server: viser.ViserServer, scheme: str) -> list[Sight]:
    camera = screen.camera(server.initial_camera)
    corner = np.array([[0.5 * camera.size[0], 10.0]])
    empty = close_to((20, 20, 20) if scheme == "dark" else (255, 255, 255), 12.0)
    return [Sight("the page", corner, empty), Sight("sensor", camera.pixels(ARRAY.positions), dark_grey)]


class TestScheme:
    @pytest.mark.slow
    def test_live_page(self, screen: Screen, scheme: str) -> None:
        with open_server(0, "array") as server:
            array_page(server, ARRAY, live=False)
            screen.open_server(server)
            screen.until_seen(*sights(screen, server, scheme))
            screen.keep(f"{scheme}-live")
            screen.leave()

    def test_static_page(self, screen: Screen, scheme: str, tmp_path: Path) -> None:
        page = tmp_path / "array.html"
        with open_server(0, "array") as server:
            write_page(page_html(server, array_page(server, ARRAY, live=False)), page)
            screen.open(page.as_uri())
            screen.until_seen(*sights(screen, server, scheme))
        assert (int(screen.evaluate(LIGHTNESS)) > 128) == (scheme == "dark")
        screen.keep(f"{scheme}-static")
