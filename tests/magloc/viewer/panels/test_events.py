"""Events: rows in which a state changes, found by buttons; what a page says and marks of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from arrays.geometries import tetrahedron
from magloc.localization.fit.results import Fix
from magloc.localization.locator import locate
from magloc.measurement.differences import predicted_channels
from magloc.readings import Readings
from magloc.tracking.results import TrackPoint, TrackResult
from magloc.viewer.pages.pages import readings_page, track_page
from magloc.viewer.pages.texts import warning_lines
from magloc.viewer.panels.events import EventButtons, rows_of_change
from magloc.viewer.scene.glyphs import ArrayGlyphs
from magloc.viewer.server import open_server

ARRAY = tetrahedron(1.5)


class TestRowsOfChange:
    @given(st.lists(st.sampled_from("abc"), max_size=30))
    def test_between_two_of_them_nothing_changes(self, states: list[str]) -> None:
        rows = rows_of_change(states).tolist()
        assert all(states[i] != states[i - 1] for i in rows)
        parts = [states[a:b] for a, b in zip([0, *rows], [*rows, len(states)], strict=True)]
        assert all(len(set(part)) <= 1 for part in parts)


class TestButtons:
    def test_they_go_from_event_to_event_and_not_beyond(self) -> None:
        shown = [5]
        with open_server(0, "test") as server:
            events = EventButtons(server.gui, np.array([3, 5, 9]), lambda: shown[-1], shown.append, "hint")
            for forwards in (True, True, False, False, False, True):
                events.go(forwards=forwards)
        assert shown == [5, 9, 5, 3, 5]

    def test_none_where_nothing_happens(self) -> None:
        with open_server(0, "test") as server:
            events = EventButtons(server.gui, rows_of_change([1, 1]), lambda: 0, pytest.fail, "hint")
            events.go(forwards=True)
            assert not server.gui._gui_input_handle_from_uuid


class TestDoubts:
    FIX = locate(
        ARRAY, Readings(predicted_channels(ARRAY, np.array([2.0, 2.0, 0.5]), np.array([0.0, 0.0, 80.0]))[None])
    )[0]

    @pytest.mark.parametrize(
        ("change", "words"),
        [
            ({"detected": False}, "nothing is detected"),
            ({"too_near": True}, "too large, for a dipole"),
            ({"dropped_sensors": ("s<3",)}, "s&lt;3</b> contradicts"),
            ({"saturated_channels": ("s1_x", "s2_y")}, "s1_x, s2_y"),
        ],
    )
    def test_each_is_said(self, change: dict[str, object], words: str) -> None:
        assert warning_lines(self.FIX) == []
        (line,) = warning_lines(replace(self.FIX, **change))  # type: ignore[arg-type]
        assert words in line

    def test_of_a_misfit(self) -> None:
        worse = replace(self.FIX.best, chi2=1e4)
        assert "misfit" in warning_lines(Fix((worse,)))[0]


class TestMarks:
    def test_the_sensors_that_are_not_used_are_marked_in_their_row(self) -> None:
        point = TrackPoint(0.0, np.array([3.0, 0.0, 0.0]), np.array([0.0, 0.0, 9.0]), status="tracked")
        points = [replace(point, time_s=float(i), dropped_sensors=("s2",) if i == 1 else ()) for i in range(3)]
        with open_server(0, "test") as server:
            page = track_page(server, TrackResult(tuple(points), is_truth=False), ARRAY, None)
            assert page.playback is not None
            marks = []
            for row in range(3):
                page.playback.show(row)
                node = server.scene._handle_from_node_name.get("/array/not-used")
                marks.append(node is not None and node.visible)
            assert marks == [False, True, False]
            np.testing.assert_allclose(node.points, ARRAY.positions[[1]], atol=1e-6)  # type: ignore[union-attr]
            assert any("not used" in getattr(entry, "text", "") for entry in page.entries)
            page.close()

    def test_none_of_an_array_without_a_fault(self) -> None:
        with open_server(0, "test") as server:
            ArrayGlyphs(server.scene, ARRAY).mark_unused(())
            assert "/array/not-used" not in server.scene._handle_from_node_name

    def test_a_page_of_fixes_goes_to_the_row_of_a_fault(self) -> None:
        values = np.tile(predicted_channels(ARRAY, np.array([2.0, 2.0, 0.5]), np.array([0.0, 0.0, 80.0])), (4, 1))
        rows = Readings(values, time_s=np.arange(4.0))
        fixes = list(locate(ARRAY, rows))
        fixes[2] = replace(fixes[2], dropped_sensors=("s4",))
        with open_server(0, "test") as server:
            page = readings_page(server, ARRAY, fixes, rows)
            labels = [getattr(handle, "label", "") for handle in server.gui._gui_input_handle_from_uuid.values()]
            assert "Event (2)" in labels
            page.close()
