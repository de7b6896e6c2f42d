"""The live page of a map: points, slices and surface have the colours of the legend at the places of the map."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import viser
from matplotlib import colormaps
from numpy.typing import NDArray

from arrays.geometries import tetrahedron
from magloc.viewer.pages.map import FAILED_COLOUR
from magloc.viewer.pages.open_result import MapResult
from magloc.viewer.pages.pages import map_page
from magloc.viewer.scene.glyphs import DIPOLE_COLOUR, REGION_COLOUR
from magloc.viewer.server import open_server
from tests.browser.screen import Camera, Screen, Sight, close_to, dark_grey, hue_of

FloatArray = NDArray[np.float64]
AXIS = np.linspace(-4.0, 4.0, 17)
SOURCE = np.array([2.0, 0.0, 0.0])
DIPOLE = np.array([SOURCE, SOURCE])  # its ball, and the head of its arrow
DIPOLE[1, 2] += 0.8 * 0.09 * 8.0


def made_up_map() -> MapResult:
    """Values are ten times the distance from the source; the half where x is negative fails."""
    places = np.stack(np.meshgrid(AXIS, AXIS, AXIS, indexing="ij"), axis=-1)
    values = 10.0 * np.linalg.norm(places - SOURCE, axis=-1)
    failed = places[..., 0] < 0.0
    return MapResult(
        AXIS,
        np.where(failed, np.nan, values),
        failed,
        "starts",
        "passes until convergence",
        False,
        tetrahedron(2.0),
        SOURCE,
        np.array([0.0, 0.0, 100.0]),
        "made up",
        1,
    )


RESULT = made_up_map()
KNOWN = RESULT.values[np.isfinite(RESULT.values)]
TOP = float(np.ceil(np.percentile(KNOWN, 99.0)))


def colour_of(place_m: FloatArray) -> FloatArray:
    """What the legend says of the value at a place."""
    value = 10.0 * np.linalg.norm(place_m - SOURCE)
    return 255.0 * np.array(colormaps["viridis"]((value - KNOWN.min()) / (TOP - KNOWN.min()))[:3])


@pytest.fixture(scope="module")
def server(screen: Screen) -> Iterator[viser.ViserServer]:
    with open_server(0, "map") as server:
        page = map_page(server, RESULT)
        screen.open_server(server)
        yield server
        screen.leave()
        page.close()


def sights(what: str, camera: Camera, places_m: FloatArray, *, within: float, radius: int = 3) -> list[Sight]:
    """Each place in the colour that the legend gives it."""
    return [Sight(f"{what} {p}", camera.pixels([p]), close_to(colour_of(p), within), radius) for p in places_m]


class TestMap:
    """In the order of a user's session."""

    @pytest.mark.slow
    def test_the_slice_the_source_and_the_array_are_where_the_camera_has_them(
        self, screen: Screen, server: viser.ViserServer
    ) -> None:
        camera = screen.live_camera(server)
        on_slice = np.array([[x, 0.0, z] for x in (0.5, 3.5) for z in (-3.5, -2.0, 3.5)])
        failed = np.array([[-3.5, 0.0, -3.5], [-2.0, 0.0, 3.0], [-3.5, 0.0, 0.0]])
        screen.until_seen(
            *sights("slice", camera, on_slice, within=45.0),
            Sight("starts that fail", camera.pixels(failed), close_to(np.add(FAILED_COLOUR, 60), 40.0)),
            Sight("the source", camera.pixels(DIPOLE), hue_of(DIPOLE_COLOUR), 6),
            Sight("sensors", camera.pixels(RESULT.array.positions), dark_grey, radius=6, share=0.7),
        )
        screen.keep("map")
        assert "passes until convergence" in screen.text()
        assert screen.browser.errors == []

    @pytest.mark.slow
    def test_points_have_the_colours_of_the_legend(self, screen: Screen, server: viser.ViserServer) -> None:
        camera = screen.live_camera(server)
        screen.switch("coloured points", on=True)
        screen.switch("across y", on=False)
        screen.switch("surface", on=False)
        # Of the outer layers that the camera sees, behind the cut.
        face = [[4.0, y, z] for y in (1.0, 2.5, 4.0) for z in (-2.0, 0.5, 3.0)]
        top = [[x, y, 4.0] for x in (0.5, 2.0, 3.0) for y in (1.0, 3.0)]
        points = np.array(face + top)
        in_front = np.array([[4.0, -3.0, -3.5], [3.0, -4.0, -3.0]])
        nothing = hue_of((60, 90, 140), 75.0)
        screen.until_seen(
            *sights("point", camera, points, within=30.0, radius=2),
            Sight("points before the cut", camera.pixels(in_front), nothing, absent=True),
        )
        screen.switch("cut open", on=False)
        screen.until_seen(*sights("point", camera, in_front, within=30.0, radius=2))

    def test_the_level_slider_moves_the_surface(self, screen: Screen, server: viser.ViserServer) -> None:
        camera = screen.live_camera(server)
        screen.switch("coloured points", on=False)
        screen.switch("across y", on=False)
        right, up, _ = camera.axes
        sky = hue_of(REGION_COLOUR, 20.0, 0.1)

        def ring(radius_m: float) -> FloatArray:
            # Half of the ball is there: x < 0 fails. Upwards and to the right it is whole.
            return camera.pixels([SOURCE + radius_m * up, SOURCE + radius_m * (up + right) / np.sqrt(2.0)])

        for share in (0.25, 0.45):
            screen.slide("level", share)
            wanted = KNOWN.min() + share * (TOP - KNOWN.min())
            screen.until(lambda wanted=wanted: abs(screen.numbers("level")[0] - wanted) < 2.5, "the slider moves")
            radius = screen.numbers("level")[0] / 10.0
            screen.until_seen(
                Sight("inside of the surface", ring(0.85 * radius), sky, radius=1),
                Sight("outside of the surface", ring(1.2 * radius), sky, radius=1, absent=True),
            )
        screen.keep("map-surface")
        screen.switch("surface", on=False)
        screen.until_seen(Sight("surface", ring(0.85 * radius), sky, radius=1, absent=True))

    @pytest.mark.slow
    def test_a_slider_moves_a_slice(self, screen: Screen, server: viser.ViserServer) -> None:
        camera = screen.live_camera(server)
        screen.switch("coloured points", on=False)
        screen.switch("across y", on=False)
        screen.switch("surface", on=False)
        screen.slide("z [m]", 0.25)
        screen.until(lambda: abs(screen.numbers("z [m]")[0] + 2.0) < 0.6, "the slider moves")
        z = screen.numbers("z [m]")[0]
        places = np.array([[x, y, z] for x in (1.0, 3.5) for y in (-3.0, 0.5, 3.5)])
        screen.until_seen(
            *sights("slice", camera, places, within=45.0),
            Sight("slice where it was", camera.pixels([[3.5, 3.5, 1.0]]), hue_of((60, 90, 140), 75.0), absent=True),
        )
        screen.keep("map-slice")
