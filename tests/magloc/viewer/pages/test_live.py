"""The live page without a browser: who tells it of rows never waits, and its buttons do what they say."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import numpy as np
import pytest

from arrays.geometries import tetrahedron
from arrays.io.errors import InputError
from magloc.bodies.field import placed_magnets
from magloc.bodies.track import BodyTrack
from magloc.fields import dipole
from magloc.live.body import body_points
from magloc.live.follower import Follower
from magloc.readings import Readings
from magloc.tracking.results import SourcePoint, SourcesPoint, TrackPoint
from magloc.viewer.live_view import LiveView
from magloc.viewer.pages.live import SINGLE_ID
from tests.magloc.bodies.devices import hall_ring, knob
from tests.magloc.bodies.test_filter import record
from tests.waiting import wait_for

ARRAY = tetrahedron(1.5)


def point_at(time_s: float) -> TrackPoint:
    position = np.array([1.0, time_s, 0.5])
    return TrackPoint(time_s, position, np.array([0.0, 0.0, 80.0]), 1e-4 * np.eye(6), status="tracked")


class Controls:
    """Notes what the buttons do."""

    def __init__(self) -> None:
        self.calls: list[object] = []

    def stop(self) -> None:
        self.calls.append("stop")

    def start(self) -> None:
        self.calls.append("start")

    def tare(self, rest_s: float) -> None:
        self.calls.append(rest_s)
        if len(self.calls) > 3:
            raise InputError("a rest: found scalar sensor s1, expected vector sensors alone.")


@pytest.fixture
def controls() -> Controls:
    return Controls()


@pytest.fixture
def view(controls: Controls) -> Iterator[LiveView]:
    with LiveView(ARRAY, controls=controls, port=0, open=False) as view:
        yield view


def test_the_newest_row_is_shown_and_none_waits(view: LiveView, monkeypatch: pytest.MonkeyPatch) -> None:
    """While the page draws, a hundred rows come; it goes on with the last of them."""
    page, shown = view._live, list[float]()
    drawing, go_on = threading.Event(), threading.Event()

    def show(newest: object, window: object) -> None:
        shown.append(newest.point.time_s)  # type: ignore[attr-defined]
        drawing.set()
        go_on.wait()

    monkeypatch.setattr(page, "_show", show)
    view.update(point_at(0.0))
    drawing.wait()
    for i in range(1, 101):
        view.update(point_at(0.01 * i))
    go_on.set()
    wait_for(lambda: shown[-1:] == [1.0])
    assert shown == [0.0, 1.0]


def test_what_is_said(view: LiveView) -> None:
    for i in range(20):
        view.update(point_at(0.1 * i))
    page = view._live
    wait_for(lambda: "time 1.900 s" in page._source_panel.content)
    assert "tracked at (1.000, 1.900, 0.500) m" in page._source_panel.content
    np.testing.assert_allclose(page._sources[SINGLE_ID].dipole.frame.position, [1.0, 1.9, 0.5])
    view.update(TrackPoint(2.0, status="lost: the range is no longer known"))
    wait_for(lambda: "lost: the range" in page._source_panel.content)
    assert not page._sources[SINGLE_ID].dipole.frame.visible


def several_at(time_s: float, *ids: int) -> SourcesPoint:
    tracks = tuple(
        SourcePoint(time_s, np.array([1.0, time_s, id]), np.array([0.0, 0.0, 80.0]), 1e-4 * np.eye(6), id=id)
        for id in ids
    )
    return SourcesPoint(time_s, tracks, "tracked" if ids else "no source", 12.0, 12)


def test_several_sources_come_and_go(view: LiveView) -> None:
    """Each has an arrow; the readings less those of all are what two dipoles leave of them."""
    page = view._live
    field = sum(dipole.field(ARRAY.positions, [1.0, 0.0, id], [0.0, 0.0, 80.0]) for id in (1, 2))
    view.update(several_at(0.0, 1, 2), Readings(ARRAY.readings_of(field)[None], time_s=[0.0]))
    wait_for(lambda: "source 2" in page._source_panel.content)
    for id in (1, 2):
        np.testing.assert_allclose(page._sources[id].dipole.frame.position, [1.0, 0.0, id])
    assert not page._sources[SINGLE_ID].dipole.frame.visible
    wait_for(lambda: page._plot._residuals_T is not None and np.abs(page._plot._residuals_T).max() < 1e-15)
    view.update(several_at(1.0, 2))
    wait_for(lambda: "source 1" not in page._source_panel.content)
    assert not page._sources[1].dipole.frame.visible
    view.update(several_at(2.0))
    wait_for(lambda: "no source" in page._source_panel.content)


def test_a_body_turns() -> None:
    """Its magnets stand where rotations put them, with lines between; the residuals are noise."""
    array, body = hall_ring(4, common_field_T=None), knob()
    readings, position_m, R = record(array, body, 30, 60_55)
    with LiveView(array, port=0, open=False) as view:
        for point in Follower(array, body=body).follow(readings):
            view.update(point)
        page = view._live
        wait_for(lambda: "time 0.145 s" in page._source_panel.content)
        assert "σ of the rotation (" in page._source_panel.content
        places, _ = placed_magnets(body, position_m[-1], R[-1])
        for id, place in enumerate(places, start=1):
            np.testing.assert_allclose(page._sources[id].dipole.frame.position, place, atol=5e-5)
        ends = page._frame.points
        np.testing.assert_allclose(
            ends, [[places[0], places[1]], [places[0], places[2]], [places[1], places[2]]], atol=5e-5
        )
        wait_for(lambda: page._is_plotted)
        shown = page._plot._values_nT("residuals of the differences")
        assert np.nanstd(shown) < 2e-3 * np.nanstd(page._plot._values_nT("readings"))
        view.update(body_points(body, BodyTrack.none(1))[0])
        wait_for(lambda: "not tracked" in page._source_panel.content)
        assert not page._frame.visible


def test_the_window_is_as_long_as_it_says(view: LiveView) -> None:
    for i in range(20_000):
        view.update(point_at(0.002 * i))
    window = [seen.point.time_s for seen in view._live._window]
    assert len(window) <= 401
    assert 9.9 < window[-1] - window[0] < 14.0
    view.update(point_at(0.0))  # the sender was started anew
    assert [seen.point.time_s for seen in view._live._window] == [0.0]


def test_buttons(view: LiveView, controls: Controls) -> None:
    page = view._live
    page._on_switch(None)
    assert page._switch.label == "Start"
    page._on_switch(None)
    assert page._switch.label == "Stop"
    page._on_tare(None)
    assert controls.calls == ["stop", "start", 3.0]
    assert page._message.content == ""
    page._on_tare(None)
    assert "scalar sensor s1" in page._message.content


def test_it_ends() -> None:
    with LiveView(ARRAY, port=0, open=False) as view:
        view.update(point_at(0.0))
    assert not view._live._thread.is_alive()
