"""The live page of a source that is followed: it moves as the rows come, and its buttons are heard."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import magloc
from arrays.array_file import write_array
from arrays.geometries import tetrahedron
from magloc.bodies.field import placed_magnets
from magloc.live.follower import Follower
from magloc.measurement.differences import predicted_channels
from magloc.readings import Readings, write_readings
from magloc.tracking.motion import RandomWalk
from magloc.viewer.live_view import LiveView
from magloc.viewer.scene.glyphs import DIPOLE_COLOUR, TRACK_COLOUR
from tests.browser.screen import Screen, Sight, dark_grey, hue_of
from tests.magloc.bodies.devices import hall_ring, knob, readings_of

ARRAY = tetrahedron(1.5, noise_T=1e-11)
N = 200
TIMES = 0.02 * np.arange(N)
POSITIONS = np.stack([np.linspace(-1.0, 1.0, N), np.full(N, -0.8), np.full(N, 1.2)], axis=-1)
MOMENT = np.array([0.0, 0.0, 80.0])
ROWS = Readings(
    np.array([predicted_channels(ARRAY, p, MOMENT) for p in POSITIONS])
    + 1e-11 * np.random.default_rng(0).normal(size=(N, 12)),
    time_s=TIMES,
)
BLUE, ORANGE = hue_of(TRACK_COLOUR), hue_of(DIPOLE_COLOUR)


class TestPage:
    """In the order of a user's session."""

    @pytest.fixture(scope="class")
    @classmethod
    def follower(cls) -> Follower:
        return Follower(ARRAY, RandomWalk(1.0, 0.1))

    @pytest.fixture(scope="class")
    @classmethod
    def view(cls, follower: Follower, screen: Screen) -> Iterator[LiveView]:
        with LiveView(ARRAY, controls=follower, port=0, open=False) as view:
            screen.open_server(view._server)
            yield view
            screen.leave()

    def test_the_source_moves_and_leaves_a_tail(self, screen: Screen, follower: Follower, view: LiveView) -> None:
        camera = screen.live_camera(view._server)
        for point in follower.follow(ROWS[:100]):
            view.update(point)
        screen.until(lambda: "time 1.980 s" in screen.text(), "the newest row")
        screen.until_seen(
            Sight("source", camera.pixels(POSITIONS[99:100]), ORANGE),
            Sight("tail", camera.pixels(POSITIONS[5:90:5]), BLUE, share=0.9),
            Sight("where it will be", camera.pixels(POSITIONS[120::20]), BLUE, absent=True),
            Sight("sensor", camera.pixels(ARRAY.positions), dark_grey, share=0.75),
        )
        for point in follower.follow(ROWS[100:]):
            view.update(point)
        screen.until(lambda: "time 3.980 s" in screen.text(), "the newest row")
        screen.until_seen(
            Sight("source", camera.pixels(POSITIONS[-1:]), ORANGE),
            Sight("tail", camera.pixels(POSITIONS[5:190:5]), BLUE, share=0.9),
            Sight("source where it was", camera.pixels(POSITIONS[99:100]), ORANGE, absent=True),
        )
        words = screen.text()
        assert "tracked at (1.000, -0.800, 1.200) m" in words
        assert f"{N} rows, {N} tracked" in words
        assert "0 lost, 0 late, 0 doubled, 0 garbled" in words
        assert "rows/s" in words
        assert "latency" in words
        of_kind = view._live._plot._values_nT
        assert np.nanmax(np.abs(of_kind("residuals of the differences"))) < 1e-3 * np.nanmax(of_kind("readings"))
        screen.keep("live")
        assert screen.browser.errors == []

    def test_stop_start_and_tare(self, screen: Screen, follower: Follower, view: LiveView) -> None:
        def status_of(row: int) -> str:
            (point,) = follower.follow(replaced(ROWS[row : row + 1], 4.0 + TIMES[row]))
            view.update(point)
            return point.status

        screen.browser.click(*screen.button("Stop"))
        screen.until(lambda: status_of(next(NUMBERS)) == "stopped", "the follower stops")
        screen.until(lambda: "not tracked: stopped" in screen.text(), "the page says so")
        screen.browser.click(*screen.button("Start"))
        screen.until(lambda: status_of(next(NUMBERS)) in ("acquired", "tracked"), "the follower starts")
        screen.browser.click(*screen.button("Tare"))
        screen.until(lambda: status_of(next(NUMBERS)).startswith("rest"), "the background is taken")


NUMBERS = iter(range(N))


def replaced(readings: Readings, time_s: float) -> Readings:
    return Readings(readings.values_T, time_s=[time_s])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_array(tmp_path / "array.toml", ARRAY)
    write_readings(tmp_path / "rows.csv", ROWS, ARRAY)
    return tmp_path


class TestCommands:
    """They serve the page until Ctrl-C, also when the rows have ended."""

    @pytest.mark.slow
    @pytest.mark.parametrize(
        "words", ["live --from - --view --speed-m-s 1", pytest.param("view -", marks=pytest.mark.slow)]
    )
    def test_the_last_row_stays(self, screen: Screen, folder: Path, words: str) -> None:
        command = [sys.executable, "-m", "magloc.cli", *words.split(), "--array", "array.toml", "--port", "0"]
        with (
            (folder / "rows.csv").open() as stdin,
            (folder / "out").open("w") as stdout,
            subprocess.Popen(
                command, cwd=folder, stdin=stdin, stdout=stdout, stderr=subprocess.PIPE, text=True
            ) as process,
        ):
            try:
                assert process.stderr is not None
                _, _, address, *_ = process.stderr.readline().split()
                screen.open(address)
                screen.until(lambda: "time 3.980 s" in screen.text(), "the last row")
                screen.leave()
                process.send_signal(signal.SIGINT)
                _, err = process.communicate(timeout=120.0)
            finally:
                process.kill()
        assert process.returncode == 0
        assert len((folder / "out").read_text().splitlines()) == (N if "live" in words else 1)
        assert "Traceback" not in err


@pytest.mark.slow
def test_a_loop_of_ones_own(screen: Screen) -> None:
    """Points of a tracker, with the readings that they are found from."""
    tracker = magloc.Tracker(ARRAY, RandomWalk(1.0, 0.1))
    with magloc.viewer.LiveView(ARRAY, port=0, open=False) as view:
        screen.open_server(view._server)
        for row in ROWS[:20]:
            view.update(tracker.update(row), row)
        screen.until(lambda: "time 0.380 s" in screen.text(), "the newest row")
        assert "Stop" not in screen.text()
        screen.leave()


def test_a_body_turns_when_a_row_arrives(screen: Screen) -> None:
    """A knob turns by 60° about its axis: its magnets leave their places, and the words have units."""
    array, body = hall_ring(4, common_field_T=None), knob(angle_rad=np.radians(65.0))
    angle = np.radians(60.0) * np.linspace(0.0, 1.0, 120)
    R = Rotation.from_rotvec(angle[:, None] * np.array([0.0, 0.0, 1.0])).as_matrix()
    position_m = np.tile([0.0, 0.0, 0.015], (120, 1))
    rows = Readings(readings_of(array, body, position_m, R, np.random.default_rng(0)), time_s=np.arange(120) / 100.0)
    (before, after), _ = placed_magnets(body, position_m[[0, -1]], R[[0, -1]])
    follower = Follower(array, body=body)
    with LiveView(array, controls=follower, port=0, open=False) as view:
        screen.open_server(view._server)
        points = list(follower.follow(rows))
        camera = screen.live_camera(view._server)
        view.update(points[0])
        screen.until(lambda: "time 0.000 s" in screen.text(), "the first row")
        screen.until_seen(Sight("magnets", camera.pixels(before), ORANGE))
        for point in points[1:]:
            view.update(point)
        screen.until(lambda: "time 1.190 s" in screen.text(), "the newest row")
        screen.until_seen(
            Sight("magnets", camera.pixels(after), ORANGE),
            Sight("magnets where they were", camera.pixels(before), ORANGE, absent=True),
        )
        words = screen.text()
        assert re.search(r"tracked at \([-0-9., ]+\) m", words)
        assert re.search(r"σ x [0-9.]+ [µm]?m, y [0-9.]+ [µm]?m, z [0-9.]+ [µm]?m", words)
        turn = re.search(r"rotation vector \(([-0-9., ]+)\)°", words)
        assert turn is not None
        np.testing.assert_allclose([float(x) for x in turn.group(1).split(",")], [0.0, 0.0, 60.0], atol=0.5)
        assert re.search(r"σ of the rotation \([-0-9., e]+\)°", words)
        screen.leave()
