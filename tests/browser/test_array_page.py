"""The live page of an array: sensors and dipole are where they should be, and the fit follows the hand."""

from __future__ import annotations

import re
from collections.abc import Iterator

import numpy as np
import pytest
import viser
from numpy.typing import NDArray

from arrays.geometries import tetrahedron
from magloc.measurement.differences import suitable_dipole
from magloc.viewer.pages.pages import array_page
from magloc.viewer.scene.glyphs import DIPOLE_COLOUR, FIELD_LINE_COLOUR, FIT_COLOUR, ArrayGlyphs
from magloc.viewer.scene.shapes import field_lines
from magloc.viewer.server import open_server
from tests.browser.screen import Camera, Screen, Sight, dark_grey, hue_of

FloatArray = NDArray[np.float64]
ARRAY = tetrahedron(30.0)  # the static page is of one of 3 cm
START_M, START_AM2 = suitable_dipole(ARRAY)
ARROW_M = 0.6 * ARRAY.circumradius
Z = np.array([0.0, 0.0, 1.0])
ORANGE, BLUE, YELLOW = hue_of(DIPOLE_COLOUR), hue_of(FIT_COLOUR, 9.0), hue_of(FIELD_LINE_COLOUR, 10.0)
ROD_BLUE = hue_of((70, 110, 200))


@pytest.fixture(scope="module")
def server(screen: Screen) -> Iterator[viser.ViserServer]:
    """The page of the array, open in the browser."""
    with open_server(0, "array") as server:
        page = array_page(server, ARRAY, live=True)
        screen.open_server(server)
        yield server
        screen.leave()
        page.close()


def found_position(screen: Screen) -> FloatArray:
    """What the panel says of the fit [m]."""
    words = re.search(r"found at \(([^)]*)\) m", screen.text().replace("\N{MINUS SIGN}", "-"))
    assert words, screen.text()
    return np.array([float(value) for value in words[1].split(",")])


def rms_bound(screen: Screen) -> float:
    """Root mean square error of the position that the panel's Cramér-Rao bound allows [m]."""
    words = re.search(r"σ x ([\d.]+) (\w+), y ([\d.]+) (\w+), z ([\d.]+) (\w+)", screen.text())
    assert words, screen.text()
    metres = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
    return float(np.linalg.norm([float(words[i]) * metres[words[i + 1]] for i in (1, 3, 5)]))


def dipole_places(position_m: FloatArray, direction: FloatArray = Z) -> FloatArray:
    """Its ball, and the flank of its arrow's head, which the control's thin arrow does not cover."""
    return np.array([position_m, position_m + 0.78 * ARROW_M * direction])


def is_under_the_mouse(camera: Camera, place_m: FloatArray, mouse_px: FloatArray) -> bool:
    return bool(np.linalg.norm(camera.pixels(place_m) - mouse_px) < 5.0)


class TestSensors:
    @pytest.mark.slow
    def test_every_body_and_its_axis_are_where_the_camera_has_them(
        self, screen: Screen, server: viser.ViserServer
    ) -> None:
        camera = screen.live_camera(server)
        with open_server(0, "size") as other:
            size = ArrayGlyphs(other.scene, ARRAY).size_m
        bodies = camera.pixels(ARRAY.positions)
        rods = camera.pixels(ARRAY.positions + 0.8 * size * Z)
        nowhere = camera.pixels(-ARRAY.positions[[0, 1, 2]] + 2.5 * size * Z)
        screen.until_seen(
            Sight("body of a sensor", bodies, dark_grey),
            Sight("z axis of a sensor", rods, ROD_BLUE),
            Sight("sensor", nowhere, lambda picture: dark_grey(picture) | ROD_BLUE(picture), absent=True),
        )

    @pytest.mark.slow
    def test_the_legend_names_them(self, screen: Screen, server: viser.ViserServer) -> None:
        assert "4 vector sensors, noise 1 nT" in screen.text()
        assert screen.browser.errors == []


class TestDipole:
    """In the order of a user's session: each test leaves the dipole where the next one finds it."""

    @pytest.mark.slow
    def test_arrow_fit_and_field_lines_are_where_the_camera_has_them(
        self, screen: Screen, server: viser.ViserServer
    ) -> None:
        camera = screen.live_camera(server)
        lines = field_lines(START_M, START_AM2, 1.5 * ARRAY.circumradius)[-6:, 8:-8].reshape(-1, 3)
        screen.until_seen(
            Sight("the dipole", camera.pixels(dipole_places(START_M)), ORANGE, radius=9),
            Sight("the fit", camera.pixels([START_M + 1.25 * ARROW_M * Z]), BLUE, radius=9),
            Sight("field lines", camera.pixels(lines), YELLOW, radius=2, share=0.9),
            Sight("field lines", np.array([[60.0, 220.0], [250.0, 60.0], [560.0, 450.0]]), YELLOW, absent=True),
        )
        screen.keep("array")
        assert np.linalg.norm(found_position(screen) - START_M) < 5.0 * rms_bound(screen)

    @pytest.mark.slow
    @pytest.mark.parametrize(("axis", "push_px"), [(0, 90.0), (2, -60.0)])
    def test_it_is_dragged_by_an_arrow_of_its_control_and_the_fit_follows(
        self, screen: Screen, server: viser.ViserServer, axis: int, push_px: float
    ) -> None:
        camera = screen.live_camera(server)
        before = np.array(screen.numbers("Position [m]"))
        old_fit = found_position(screen)
        along = np.eye(3)[axis]
        # The control's arrow ends 1.15 circumradii from the dipole.
        origin, grip = camera.pixels([before, before + 1.05 * ARRAY.circumradius * along])
        end = grip + push_px * (grip - origin) / np.linalg.norm(grip - origin)
        screen.browser.drag(tuple(grip.tolist()), tuple(end.tolist()), steps=6)
        screen.until(
            lambda: is_under_the_mouse(camera, screen.numbers("Position [m]") + 1.05 * ARRAY.circumradius * along, end),
            "the arrow stays under the mouse",
        )
        screen.until(lambda: not np.allclose(found_position(screen), old_fit), "the fit follows")
        after = np.array(screen.numbers("Position [m]"))
        assert np.delete(after - before, axis) == pytest.approx([0.0, 0.0], abs=1e-9)
        screen.until(
            lambda: bool(np.linalg.norm(found_position(screen) - after) < 5.0 * rms_bound(screen)),
            "the fit is where the dipole is",
        )
        screen.until_seen(
            Sight("the dipole", camera.pixels(dipole_places(after)), ORANGE, radius=9),
            Sight("the fit", camera.pixels([found_position(screen) + 1.25 * ARROW_M * Z]), BLUE, radius=9),
            Sight("its head where it was", camera.pixels(dipole_places(before)[1:]), ORANGE, radius=4, absent=True),
        )
        screen.keep(f"dipole-dragged-along-{'xyz'[axis]}")

    def test_a_slider_turns_it(self, screen: Screen, server: viser.ViserServer) -> None:
        camera = screen.live_camera(server)
        position = np.array(screen.numbers("Position [m]"))
        screen.slide("Elevation [°]", 0.5)
        screen.until(lambda: abs(screen.numbers("Elevation [°]")[0]) < 4.0, "the slider moves")
        azimuth, elevation = np.radians([screen.numbers("Azimuth [°]")[0], screen.numbers("Elevation [°]")[0]])
        direction = np.array(
            [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
        )
        screen.until_seen(
            Sight("the dipole", camera.pixels(dipole_places(position, direction)), ORANGE, radius=9),
            Sight("the upright arrow", camera.pixels(dipole_places(position)[1:]), ORANGE, radius=4, absent=True),
        )

    @pytest.mark.slow
    def test_back_to_the_start(self, screen: Screen, server: viser.ViserServer) -> None:
        screen.browser.click(*screen.button("Back to the start"))
        screen.until(lambda: np.allclose(screen.numbers("Position [m]"), START_M), "the dipole is back")
        camera = screen.live_camera(server)
        screen.until_seen(Sight("the dipole", camera.pixels(dipole_places(START_M)), ORANGE, radius=9))


class TestEditingTheArray:
    @pytest.mark.slow
    def test_a_sensor_is_dragged(self, screen: Screen, server: viser.ViserServer) -> None:
        camera = screen.live_camera(server)
        screen.browser.click(*screen.button("Array"))
        screen.switch("Drag it", on=True)
        place = ARRAY.positions[0]
        origin, grip = camera.pixels([place, place + 0.55 * ARRAY.circumradius * Z])
        body_before = Sight("the sensor", camera.pixels([place]), dark_grey)
        screen.until_seen(Sight("the control", grip[None], hue_of((51, 142, 228)), radius=4))
        end = grip + 100.0 * (grip - origin) / np.linalg.norm(grip - origin)
        screen.browser.drag(tuple(grip.tolist()), tuple(end.tolist()), steps=6)
        screen.until(
            lambda: is_under_the_mouse(camera, screen.numbers("Position [m]") + 0.55 * ARRAY.circumradius * Z, end),
            "the arrow stays under the mouse",
        )
        now = np.array(screen.numbers("Position [m]"))
        assert now[:2] == pytest.approx(place[:2], abs=1e-2)
        screen.switch("Drag it", on=False)
        screen.until_seen(
            Sight("the sensor", camera.pixels([now]), dark_grey),
            Sight("the sensor where it was", body_before.pixels, dark_grey, absent=True),
        )
        screen.keep("sensor-dragged")
