"""A track played through time, and readings plotted beside it. No browser: scene nodes and panels are read directly."""

import itertools
import re
import threading
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from arrays.array import SensorArray
from arrays.geometries import tetrahedron
from arrays.sensor import Sensor
from magloc.readings import Readings
from magloc.tracking.results import TrackPoint, TrackResult
from magloc.viewer.pages.dipole_editor import direction_of
from magloc.viewer.pages.track_player import TrackPlayer
from magloc.viewer.panels.inputs import set_value
from magloc.viewer.panels.readings_plot import (
    DIFFERENCES,
    RAW,
    ReadingsPlot,
    differences_from_mean,
    span_of,
    thin_extremes,
)
from magloc.viewer.scene.glyphs import FIELD_LINE_COLOUR, TRACK_COLOUR, ArrayGlyphs
from tests.magloc.viewer.conftest import node
from tests.waiting import wait_for

ARRAY = tetrahedron(0.3)
N = 100
STEP_S = 0.1
GAP = range(40, 50)
RNG = np.random.default_rng(5)


def positions() -> np.ndarray:
    t = STEP_S * np.arange(N)
    return np.stack([np.cos(t), np.sin(t), 0.1 * t], axis=1)


def covariance(i: int) -> np.ndarray:
    spread = np.diag([1.0, 2.0, 3.0, 9.0, 9.0, 9.0])
    return (1e-4 * (1.0 + i)) * spread


def track(start_s: float = 1000.0) -> list[TrackPoint]:
    """A track from row 0 to 99 that is lost from 40 to 49."""
    return [
        TrackPoint(start_s + STEP_S * i, status="lost: the range is no longer known")
        if i in GAP
        else TrackPoint(
            start_s + STEP_S * i,
            place,
            np.array([0.0, 3.0, 4.0]),
            covariance(i),
            nis=8.0,
            nis_dof=9,
            status="tracked",
        )
        for i, place in enumerate(positions())
    ]


def readings(n: int = N, start_s: float = 1000.0) -> Readings:
    values = 1e-9 * RNG.standard_normal((n, ARRAY.n_channels))
    return Readings(values, time_s=start_s + STEP_S * np.arange(n))


def of_one(points: list[TrackPoint]) -> TrackResult:
    return TrackResult(tuple(points), is_truth=False)


@pytest.fixture
def player(server) -> Iterator[TrackPlayer]:
    player = TrackPlayer(server, of_one(track()), 0.5)
    yield player
    player.pause()


class TestTrackPlayer:
    def test_point_arrow_ellipsoid_and_tail_follow_the_time(self, server, player):
        set_value(player.tail_slider, 1.0)
        set_value(player.time_slider, 3.0)
        assert player.index == 30
        place = positions()[30]
        np.testing.assert_allclose(node(server, "/track/tail/mark").position, place)
        arrow = node(server, "/track/moment")
        np.testing.assert_allclose(arrow.position, place)
        np.testing.assert_allclose(direction_of(arrow.wxyz), [0.0, 0.6, 0.8], atol=1e-12)
        offset = np.asarray(node(server, "/track/tail/region-now").vertices, dtype=np.float64) - place
        squared = np.einsum("ni,ij,nj->n", offset, np.linalg.inv(covariance(30)[:3, :3]), offset)
        np.testing.assert_allclose(squared, chi2.ppf(0.95, 3), rtol=1e-4)
        line = np.asarray(node(server, "/track/tail/line").points)
        expected = positions()[20:31]
        np.testing.assert_allclose(line, np.stack([expected[:-1], expected[1:]], axis=1), atol=1e-6)
        assert "row 31 of 100, time 1003.000 s" in player.row_panel.content
        assert "NIS/dof 8/9" in player.row_panel.content

    def test_no_tail_is_no_line_and_the_whole_track_may_be_hidden(self, server, player):
        set_value(player.tail_slider, 0.0)
        player.show_row(20)
        assert not node(server, "/track/tail/line").visible
        whole = node(server, "/track/whole")
        # 39 intervals before the gap, 49 after it, none across it.
        assert whole.visible
        assert len(whole.points) == 39 + 49
        set_value(player.whole_checkbox, False)
        assert not whole.visible

    def test_a_gap_shows_nothing_and_says_why(self, server, player):
        player.show_row(45)
        assert not node(server, "/track/moment").visible
        assert not node(server, "/track/tail/mark").visible
        assert not node(server, "/track/tail/region-now").visible
        assert "<b>not tracked</b>: lost: the range is no longer known" in player.row_panel.content
        # The strip of times has a part for each of the hundred rows.
        assert player.strip_panel.content.count("#d5d9de") == len(GAP)
        assert "tracked in 90 of 100 rows" in player.strip_panel.content
        player.show_row(50)
        assert node(server, "/track/moment").visible
        assert node(server, "/track/tail/mark").visible

    def test_the_row_is_the_last_one_before_the_time(self, player):
        set_value(player.time_slider, 3.04)
        assert player.index == 30
        set_value(player.time_slider, 3.1)
        assert player.index == 31
        player.show_row(10**6)
        assert player.index == N - 1
        player.show_row(-5)
        assert player.index == 0
        assert player.time_slider.value == 0.0

    def test_it_starts_at_the_last_row_that_is_tracked(self, server):
        points = track()[:45]
        player = TrackPlayer(server, of_one(points), 0.5)
        assert player.index == 39

    def test_buttons_step_from_row_to_row(self, player):
        player.show_row(10)
        set_value(player.row_buttons, "next")
        assert player.index == 11
        set_value(player.row_buttons, "previous")
        set_value(player.row_buttons, "previous")
        assert player.index == 9

    def test_a_loop_begins_again(self, player, monkeypatch):
        tenths = itertools.count()
        monkeypatch.setattr("magloc.viewer.panels.time_player.perf_counter", lambda: 0.1 * next(tenths))
        seen: list[int] = []
        player._on_row = [seen.append]
        set_value(player.speed_dropdown, "10 ×")
        set_value(player.loop_checkbox, True)
        set_value(player.play_button, True)
        wait_for(lambda: seen.count(0) > 2)
        player.pause()
        assert max(seen) > N // 2

    def test_array_and_followers_get_pose_and_row(self, server):
        glyphs = ArrayGlyphs(server.scene, ARRAY)
        place = RNG.standard_normal((N, 3))
        turn = Rotation.random(N, random_state=1).as_quat()
        rows: list[int] = []
        player = TrackPlayer(
            server, of_one(track()), 0.5, array_poses=(place, turn), on_pose=glyphs.set_pose, on_row=[rows.append]
        )
        player.show_row(45)  # the array moves where the source is not tracked, too
        np.testing.assert_allclose(glyphs.frame.position, place[45])
        np.testing.assert_allclose(glyphs.frame.wxyz, np.roll(turn[45], 1))
        assert rows[-1] == 45

    def test_play_runs_to_the_end_with_its_speed_and_stops(self, player, monkeypatch):
        tenths = itertools.count()  # the clock's: at ten times the speed, a second of the track for every frame
        monkeypatch.setattr("magloc.viewer.panels.time_player.perf_counter", lambda: 0.1 * next(tenths))
        seen: list[int] = []
        player._on_row = [seen.append]
        player.show_row(0)
        set_value(player.speed_dropdown, "10 ×")
        set_value(player.play_button, True)
        assert player.play_button.label == "Pause"
        wait_for(lambda: not player.is_playing)
        # 9.9 s of the track after ten frames, and the clock is asked once before the first.
        assert next(tenths) == 11
        assert player.index == N - 1
        assert player.play_button.label == "Play"
        assert seen == sorted(seen)
        assert len(set(seen)) > 3
        wait_for(lambda: not any(thread.name == "magloc-track-player" for thread in threading.enumerate()))

    def test_play_at_the_end_begins_anew_and_pause_holds(self, player, monkeypatch):
        tenths = iter(range(20))  # the clock stands still before half of the time is over
        monkeypatch.setattr("magloc.viewer.panels.time_player.perf_counter", lambda: 0.1 * next(tenths, 20))
        player.show_row(N - 1)
        set_value(player.speed_dropdown, "1 ×")
        player.play()
        player.play()  # a second time changes nothing
        assert sum(thread.name == "magloc-track-player" for thread in threading.enumerate()) == 1
        wait_for(lambda: 0 < player.index < N // 2)
        set_value(player.play_button, True)
        held = player.index
        assert not player.is_playing
        time.sleep(0.3)
        assert player.index == held
        assert not any(thread.name == "magloc-track-player" for thread in threading.enumerate())

    def test_a_time_that_the_user_chooses_while_it_plays_counts(self, player, monkeypatch):
        monkeypatch.setattr("magloc.viewer.panels.time_player.perf_counter", lambda: 0.0)
        player.show_row(0)
        set_value(player.speed_dropdown, "0.1 ×")
        player.play()
        set_value(player.time_slider, 8.0)
        wait_for(lambda: player.index >= 80)
        player.pause()
        assert player.index == 80

    def test_a_truth_has_no_ellipsoids_and_one_row_does_not_play(self, server):
        truth = [TrackPoint(5.0, np.array([1.0, 2.0, 0.0]), status="truth")]
        player = TrackPlayer(server, of_one(truth), 0.5)
        player.play()
        assert not player.is_playing
        assert player.time_slider.disabled
        np.testing.assert_allclose(node(server, "/track/tail/mark").position, [1.0, 2.0, 0.0])
        assert not node(server, "/track/moment").visible
        assert "truth at (1.000, 2.000, 0.000) m" in player.row_panel.content

    def test_a_track_without_any_position_is_shown_as_such(self, server):
        player = TrackPlayer(server, of_one([TrackPoint(float(i), status="silent") for i in range(3)]), 0.5)
        assert player.index == 0
        assert "<b>not tracked</b>: silent" in player.row_panel.content


class TestSeveralSources:
    @pytest.fixture
    def player(self, server) -> Iterator[TrackPlayer]:
        first = track()
        second = [
            TrackPoint(point.time_s)
            if point.position_m is None
            else replace(point, position_m=point.position_m + np.array([0.0, 0.0, 1.0]))
            for point in first[:30]
        ] + [TrackPoint(point.time_s) for point in first[30:]]
        player = TrackPlayer(
            server, TrackResult(tuple(first), is_truth=False, ids=(1, 4), others=(tuple(second),)), 0.5
        )
        yield player
        player.pause()

    def test_each_is_where_it_is_and_has_its_id_and_colour(self, server, player):
        player.show_row(20)
        for id, up, colour in ((1, 0.0, TRACK_COLOUR), (4, 1.0, FIELD_LINE_COLOUR)):
            place = positions()[20] + np.array([0.0, 0.0, up])
            mark = node(server, f"/track-{id}/tail/mark")
            np.testing.assert_allclose(mark.position, place)
            assert tuple(mark.color) == colour
            assert node(server, f"/track-{id}/now").text.strip() == str(id)
        assert "source 1" in player.row_panel.content
        assert "source 4" in player.row_panel.content

    def test_one_that_is_lost_is_gone(self, server, player):
        player.show_row(35)
        assert node(server, "/track-1/tail/mark").visible
        for part in ("tail/mark", "moment", "now"):
            assert not node(server, f"/track-4/{part}").visible
        assert "source 4" not in player.row_panel.content


class TestReadingsPlot:
    def test_lines_are_the_readings_in_nT_and_the_mark_is_at_the_row(self, server):
        rows = readings()
        plot = ReadingsPlot(server, rows, ARRAY)
        plot.show_row(25)
        lines = plot.lines(RAW)
        np.testing.assert_allclose(lines.since_first_s, STEP_S * np.arange(N), atol=1e-9)
        np.testing.assert_allclose(lines.values, 1e9 * rows.values_T)
        assert lines.labels == ARRAY.channel_names
        begin, end = places_of_axis(plot, 0.0, STEP_S * (N - 1))
        assert marked(plot) == pytest.approx(begin + 25.0 / (N - 1) * (end - begin), abs=0.02)
        said = re.findall("<b[^>]*>(.*?)</b>", plot.cursor_panel.content)
        np.testing.assert_allclose([number(text) for text in said], 1e9 * rows.values_T[25], atol=1e-3)
        assert plot.at_input.value == pytest.approx(2.5)

    def test_chosen_sensors_and_axes_are_shown(self, server):
        plot = ReadingsPlot(server, readings(), ARRAY)
        set_value(plot.sensor_checkboxes["s2"], False)
        set_value(plot.axis_checkboxes["y"], False)
        assert plot.lines(RAW).labels == ("s1_x", "s1_z", "s3_x", "s3_z", "s4_x", "s4_z")
        wait_for(lambda: paths(plot) == 6)
        for checkbox in plot.sensor_checkboxes.values():
            set_value(checkbox, False)
        wait_for(lambda: paths(plot) == 0)

    def test_differences_are_free_of_the_common_field(self, server):
        rows = readings()
        common = 5e-5 * np.sin(rows.time_s)[:, None]
        plot = ReadingsPlot(server, replace(rows, values_T=rows.values_T + common), ARRAY)
        assert plot.lines(RAW).span[1] > 1e4
        lines = plot.lines(DIFFERENCES)
        assert np.abs(lines.values).max() < 10.0
        np.testing.assert_allclose(lines.values.T.reshape(4, 3, -1).sum(axis=0), 0.0, atol=1e-6)
        assert lines.span[1] < 10.0

    def test_rows_out_of_order_are_put_in_order_and_marked_by_their_row(self, server):
        rows = readings()
        shuffled = np.random.default_rng(2).permutation(N)
        plot = ReadingsPlot(server, rows[shuffled], ARRAY)
        assert np.all(np.diff(plot.lines(RAW).since_first_s) >= 0.0)
        plot.show_row(7)
        begin, end = places_of_axis(plot, 0.0, STEP_S * (N - 1))
        assert marked(plot) == pytest.approx(begin + shuffled[7] / (N - 1) * (end - begin), abs=0.02)

    def test_a_time_that_is_typed_asks_for_the_nearest_row(self, server):
        shuffled = np.random.default_rng(3).permutation(N)
        plot, asked = ReadingsPlot(server, readings()[shuffled], ARRAY), []
        plot.on_select(asked.append)
        set_value(plot.at_input, 4.04)
        wait_for(lambda: bool(asked))
        assert [shuffled[row] for row in asked] == [40]

    def test_a_row_that_is_shown_asks_for_none(self, server):
        plot, asked = ReadingsPlot(server, readings(), ARRAY), []
        plot.on_select(asked.append)
        for row in (3, 50, 99):
            plot.show_row(row)
        assert asked == []

    def test_a_span_shows_the_page_of_the_row(self, server):
        rows = readings(2000)
        plot = ReadingsPlot(server, rows, ARRAY)
        assert plot.span_dropdown.options == ("all", "10 s", "1 s")
        set_value(plot.span_dropdown, "10 s")
        plot.show_row(1234)
        wait_for(lambda: ends(plot) == (120.0, 130.0))
        inside = (plot._time_s >= 120.0) & (plot._time_s <= 130.0)
        low, high = span_of(1e9 * rows.values_T[inside])
        lines = plot._lines(RAW, tuple(range(12)), 10.0, 12)
        assert lines.span == pytest.approx((low, high))
        drawn = plot.lines_panel.content
        plot.show_row(1250)
        assert plot.lines_panel.content is drawn

    def test_a_long_record_is_thinned(self, server):
        rows = readings(20_000)
        rows.values_T[12_345, 2] = 1e-6  # a single outlier must stay in sight
        lines = ReadingsPlot(server, rows, ARRAY).lines(RAW)
        assert len(lines.values) <= 400
        assert lines.values[:, 2].max() == pytest.approx(1e3)


def marked(plot: ReadingsPlot) -> float:
    """Where the cursor is [px]."""
    found = re.search(r"translate\(([-0-9.]+)\)", plot.cursor_panel.content)
    assert found
    return float(found[1])


def places_of_axis(plot: ReadingsPlot, begin_s: float, end_s: float) -> list[float]:
    """Where the ends of its axis are, by the lines drawn from the first row to the last [px]."""
    assert ends(plot) == pytest.approx((begin_s, end_s))
    first, *_, last = re.findall(r'<path d="M([0-9]+ .*?)"', plot.lines_panel.content)[-1].split()[::2]
    return [0.1 * float(first), 0.1 * float(last)]


def ends(plot: ReadingsPlot) -> tuple[float, float]:
    """Of the axis of time that is drawn [s]."""
    found = re.search('data-begin="(.*?)" data-end="(.*?)"', plot.lines_panel.content)
    assert found
    return float(found[1]), float(found[2])


def paths(plot: ReadingsPlot) -> int:
    """How many lines are drawn."""
    return plot.lines_panel.content.count('stroke="#')


def number(text: str) -> float:
    """A number as people write it."""
    return float(text.replace("\N{MINUS SIGN}", "-"))


class TestThinning:
    @given(
        arrays(
            np.float64,
            st.tuples(st.integers(1, 300), st.integers(1, 3)),
            elements=st.floats(-1e5, 1e5) | st.just(np.nan),
        ),
        st.sampled_from([10, 50, 100]),
    )
    def test_extremes_stay_and_time_goes_on(self, values, most):
        time_s = np.arange(len(values)) * 0.5
        kept_s, kept = thin_extremes(time_s, values, most)
        assert len(kept_s) == len(kept) <= max(most, 1)
        assert np.all(np.diff(kept_s) >= 0.0)
        assert kept_s[0] == time_s[0]
        assert kept_s[-1] == time_s[-1]
        for column in range(values.shape[1]):
            known = values[np.isfinite(values[:, column]), column]
            if known.size:
                assert np.nanmin(kept[:, column]) == known.min()
                assert np.nanmax(kept[:, column]) == known.max()
            else:
                assert np.isnan(kept[:, column]).all()

    def test_span_of_nothing_and_of_one_value(self):
        assert span_of(np.full((3, 2), np.nan))[0] < span_of(np.full((3, 2), np.nan))[1]
        low, high = span_of(np.array([[5.0, 5.0]]))
        assert low < 5.0 < high


class TestDifferences:
    def test_vector_and_scalar_sensors_have_means_of_their_own(self):
        sensors = (
            *ARRAY.sensors,
            Sensor("m1", "scalar", (1.0, 0.0, 0.0), 1e-11),
            Sensor("m2", "scalar", (0.0, 1.0, 0.0), 1e-11),
        )
        array = SensorArray(sensors)
        values = RNG.standard_normal((5, array.n_channels))
        result = differences_from_mean(array, values)
        np.testing.assert_allclose(result[:, 12], 0.5 * (values[:, 12] - values[:, 13]))
        vectors = values[:, :12].reshape(5, 4, 3)
        expected = vectors - vectors.mean(axis=1, keepdims=True)
        np.testing.assert_allclose(result[:, :12], expected.reshape(5, 12))

    def test_a_sensor_that_misses_a_reading_is_left_out_of_the_mean(self):
        values = RNG.standard_normal((1, 12))
        values[0, 1] = np.nan
        result = differences_from_mean(ARRAY, values)
        assert np.isnan(result[0, :3]).all()
        others = values[0, 3:].reshape(3, 3)
        np.testing.assert_allclose(result[0, 3:], (others - others.mean(axis=0)).ravel())
