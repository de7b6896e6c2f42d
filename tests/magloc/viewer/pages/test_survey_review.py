"""The review of a survey on its page, worked through the handlers of its buttons: no browser."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import viser

import magloc
from magloc.viewer.pages.survey import SurveyScene
from magloc.viewer.pages.survey_review import ReviewPanel
from magloc.viewer.panels.inputs import set_value
from tests.magloc.surveying.test_survey import surveyed
from tests.magloc.viewer.conftest import node
from tests.waiting import wait_for


@cache
def found() -> magloc.Survey:
    return surveyed("survey-drone", 901)


@pytest.fixture
def saved() -> list[magloc.Survey]:
    return []


@pytest.fixture
def panel(server: viser.ViserServer, saved: list[magloc.Survey]) -> ReviewPanel:
    def save(survey: magloc.Survey) -> str:
        saved.append(survey)
        return "saved in found"

    return ReviewPanel(server, SurveyScene(server, found()), save)


def press(button: viser.GuiButtonHandle) -> None:
    """Call the handlers of a button as the page would."""
    for callback in button._impl.update_cb:
        callback(None)  # type: ignore[arg-type]


def click_ground(panel: ReviewPanel, x: float, y: float) -> None:
    """Click on a place of the ground from a camera 20 m above and beside it."""
    origin = np.array([x - 5.0, y + 8.0, 20.0])
    panel.click(origin, np.array([x, y, 0.0]) - origin)


class TestReviewPanel:
    def test_a_target_is_dropped(self, server: viser.ViserServer, panel: ReviewPanel) -> None:
        assert node(server, "/t2").visible
        set_value(panel._scene.dropdown, "t2")
        press(panel.drop_button)
        assert "1. drop t2" in panel.panel.content
        press(panel.refit_button)
        assert panel.review.ids == ("t1",)
        assert panel._scene.dropdown.options == ("t1",)
        assert server.scene.get_handle_by_name("/t2") is None
        assert server.scene.get_handle_by_name("/t2-text") is None

    def test_the_last_fit_is_taken_back(self, server: viser.ViserServer, panel: ReviewPanel) -> None:
        press(panel.drop_button)
        press(panel.refit_button)
        press(panel.back_button)
        assert node(server, "/t1").visible
        assert len(panel.review.pending) == 1
        press(panel.back_button)
        assert panel.review.found is found()
        assert panel.review.pending == ()

    def test_a_target_is_added_where_the_user_clicks(self, server: viser.ViserServer, panel: ReviewPanel) -> None:
        place = found()[1].position_m
        set_value(panel._scene.dropdown, "t2")
        press(panel.drop_button)
        click_ground(panel, 1.0, 1.0)
        assert panel.place_input.value == (0.0, 0.0)
        set_value(panel.click_dropdown, "sets the place to add")
        click_ground(panel, *place[:2])
        assert panel.place_input.value == pytest.approx(place[:2], abs=0.005)
        press(panel.add_button)
        press(panel.refit_button)
        np.testing.assert_allclose(node(server, "/a1").position, place, atol=0.02)

    def test_a_target_is_split(self, panel: ReviewPanel) -> None:
        press(panel.split_button)
        press(panel.refit_button)
        assert set(panel.review.ids) == {"t1a", "t1b", "t2"}

    def test_a_polygon_is_excluded(self, server: viser.ViserServer, panel: ReviewPanel) -> None:
        set_value(panel.click_dropdown, "sets a corner")
        assert panel.polygon_button.disabled
        for x, y in ((-6.0, 1.0), (6.0, 1.0), (6.0, 3.2), (-6.0, 3.2)):
            click_ground(panel, x, y)
        assert not panel.polygon_button.disabled
        assert node(server, "/polygon").visible
        press(panel.polygon_button)
        assert panel.corners_m == []
        press(panel.refit_button)
        place = panel.review.found.rows.place_m
        assert not ((np.abs(place[:, 0]) < 6.0) & (place[:, 1] > 1.0) & (place[:, 1] < 3.2)).any()
        assert panel.review.decisions[0].numbers["rows"] == len(found().rows.time_s) - len(place)

    def test_half_a_line_is_excluded(self, server: viser.ViserServer, panel: ReviewPanel) -> None:
        line = found().flight_lines[2]
        set_value(panel.line_dropdown, "L3")
        set_value(panel.stretch_slider, (0, 50))
        wait_for(lambda: node(server, "/stretch").visible)
        press(panel.stretch_button)
        (decision,) = panel.review.pending
        time_s = found().rows.time_s[line.rows]
        half = time_s[: int(0.5 * (len(time_s) - 1)) + 1]
        assert decision.numbers["rows"] == len(half)

    def test_saving_fits_first(self, panel: ReviewPanel, saved: list[magloc.Survey]) -> None:
        press(panel.drop_button)
        press(panel.save_button)
        assert [target.id for target in saved[0]] == ["t2"]
        assert [type(decision).__name__ for decision in saved[0].decisions] == ["Drop", "Refit"]
        assert "saved in found" in panel.panel.content

    def test_what_is_not_possible_is_said(self, panel: ReviewPanel) -> None:
        press(panel.drop_button)
        press(panel.drop_button)
        assert "target must be one of t2; instead received t1" in panel.panel.content
        set_value(panel.place_input, (90.0, 0.0))
        press(panel.add_button)
        assert "of a row on the map" in panel.panel.content
        assert len(panel.review.pending) == 1
