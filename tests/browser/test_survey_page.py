"""The live page of a survey: a target is dropped, added where the user clicks, and saved."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import viser

import magloc
from magloc.viewer.pages.pages import survey_page
from magloc.viewer.scene.glyphs import DIPOLE_COLOUR
from magloc.viewer.server import open_server
from tests.browser.screen import Screen, Sight, hue_of
from tests.magloc.surveying.test_survey import surveyed

ORANGE = hue_of(DIPOLE_COLOUR)
SAVED: list[magloc.Survey] = []


@pytest.fixture(scope="module")
def server(screen: Screen) -> Iterator[viser.ViserServer]:
    """The page of a survey with two targets, open in the browser."""

    def save(found: magloc.Survey) -> str:
        SAVED.append(found)
        return "saved in found"

    with open_server(0, "survey") as server:
        page = survey_page(server, surveyed("survey-drone", 901), save=save, live=True)
        screen.open_server(server)
        yield server
        screen.leave()
        page.close()


def press(screen: Screen, text: str) -> None:
    screen.browser.click(*screen.button(text))


class TestReview:
    """In the order of a user's session: each test leaves the page as the next one finds it."""

    @pytest.mark.slow
    def test_a_target_is_dropped(self, screen: Screen, server: viser.ViserServer) -> None:
        first, _ = surveyed("survey-drone", 901)
        ball = screen.live_camera(server).pixels(first.position_m[None])
        screen.until_seen(Sight("the first target", ball, ORANGE, radius=9))
        press(screen, "Drop it")
        screen.until(lambda: "1. drop t1" in screen.text(), "the decision is listed")
        press(screen, "Fit again")
        screen.until(lambda: "1 targets" in screen.text(), "the fit is done")
        screen.until_seen(Sight("the first target", ball, ORANGE, radius=4, absent=True))
        screen.keep("survey-dropped")

    @pytest.mark.slow
    def test_it_is_added_where_the_mouse_clicks(self, screen: Screen, server: viser.ViserServer) -> None:
        first, _ = surveyed("survey-drone", 901)
        inputs = server.gui._gui_input_handle_from_uuid.values()
        (clicks,) = (handle for handle in inputs if "sets a corner" in getattr(handle, "options", ()))
        clicks.value = "sets the place to add"
        on_ground = first.position_m * np.array([1.0, 1.0, 0.0])
        (pixel,) = screen.live_camera(server).pixels(on_ground[None])
        screen.browser.click(*pixel.tolist())
        screen.until(
            lambda: bool(np.linalg.norm(np.array(screen.numbers("Place x, y [m]")) - on_ground[:2]) < 0.1),
            "the place is that under the mouse",
        )
        press(screen, "Add it")
        press(screen, "Fit again")
        screen.until(lambda: "2 targets" in screen.text(), "the fit is done")
        ball = screen.live_camera(server).pixels(first.position_m[None])
        screen.until_seen(Sight("the added target", ball, ORANGE, radius=9))
        screen.keep("survey-added")

    @pytest.mark.slow
    def test_it_is_saved(self, screen: Screen, server: viser.ViserServer) -> None:
        press(screen, "Save")
        screen.until(lambda: "saved in found" in screen.text(), "the page says so")
        (found,) = SAVED
        assert sorted(target.id for target in found) == ["a1", "t2"]
        assert screen.browser.errors == []
