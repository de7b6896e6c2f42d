"""The live page of a drive, and the file that plays it: satellite, sky and camera are where they should be."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import viser
from numpy.typing import NDArray

from adcs.mockup.vision.camera import footprint
from adcs.viewer.drive import Drive
from adcs.viewer.drive_page import drive_page
from adcs.viewer.drive_player import DrivePlayer
from adcs.viewer.frame_image import IDENTIFIED_COLOUR
from adcs.viewer.table_scene import CEILING_M, ESTIMATE_COLOUR, FIX_COLOUR, VIEW_COLOUR
from magloc.viewer.pages.pages import Page
from magloc.viewer.server import open_server, page_html, write_page
from sims.cli.mockup_options import MockupOptions
from sims.cli.mockup_replay import drive_of
from sims.experiments.mockup_navigation import fused_runs
from sims.mockup.table_run import TableScenario
from tests.browser.screen import Camera, Screen, Sight, hue_of

FloatArray, BoolArray = NDArray[np.float64], NDArray[np.bool_]
DURATION_S = 20.0


class Open(NamedTuple):
    server: viser.ViserServer
    drive: Drive
    page: Page
    player: DrivePlayer


@pytest.fixture(scope="module")
def replay(screen: Screen) -> Iterator[Open]:
    """The page of a drive, open in the browser."""
    result = fused_runs("ekf", TableScenario(duration_s=DURATION_S), [0]).results[0]
    drive = drive_of(result, "ekf", MockupOptions().table_camera())
    with open_server(0, "drive") as server:
        page, player = drive_page(server, drive, 15.0)
        screen.open_server(server)
        yield Open(server, drive, page, player)
        screen.leave()
        page.close()


def satellite_grey(picture: FloatArray) -> BoolArray:
    """Pixels of the satellite, darker than the table, also where the estimate's light blue ellipse lies over it."""
    return (np.ptp(picture, axis=-1) < 0.28) & (picture.max(axis=-1) < 0.72) & (picture.min(axis=-1) > 0.12)


def on_ceiling(points_m: FloatArray) -> FloatArray:
    return np.column_stack([points_m, np.full(len(points_m), CEILING_M)])


def sights(camera: Camera, drive: Drive, row: int) -> list[Sight]:
    """What is to be seen of a row: satellite, lights of the last frame, and what the camera sees now."""
    fix = drive.last_fix(row)
    assert fix is not None
    named = drive.frame_of(fix).fix.stars[:, 1]  # type: ignore[union-attr]
    body = np.append(drive.truth.position_m[row], 0.05)
    pose = drive.true_pose(row)
    heading = float(pose.heading_rad)
    tip = drive.truth.position_m[row] + 0.2 * np.array([np.cos(heading), np.sin(heading)])
    exposed = on_ceiling(footprint(drive.camera, drive.pose_of_exposure(fix), 8))
    # Corners are left out: there the two outlines are close to each other.
    sides = np.arange(32) % 8 != 0
    return [
        Sight("satellite", camera.pixels(body[None]), satellite_grey, radius=8),
        Sight("estimate's arrow", camera.pixels(np.append(tip, 0.11)[None]), hue_of(ESTIMATE_COLOUR), radius=16),
        Sight("identified lights", camera.pixels(on_ceiling(drive.lights_m[named])), hue_of(IDENTIFIED_COLOUR)),
        Sight("the frame's outline", camera.pixels(exposed[sides]), hue_of(FIX_COLOUR), share=0.7),
        Sight(
            "what the camera sees",
            camera.pixels(on_ceiling(footprint(drive.camera, pose, 8))[sides]),
            hue_of(VIEW_COLOUR, 20.0, 0.25),
            share=0.7,
        ),
    ]


class TestDrive:
    """In the order of a user's session."""

    @pytest.mark.slow
    def test_satellite_lights_and_frame_are_where_they_should_be(self, screen: Screen, replay: Open) -> None:
        camera = screen.live_camera(replay.server)
        screen.until_seen(*sights(camera, replay.drive, replay.player.row))
        screen.keep("mockup")
        assert "frame of the last fix" in screen.text()
        assert screen.browser.errors == []

    def test_the_time_slider_moves_the_scene(self, screen: Screen, replay: Open) -> None:
        camera, before = screen.live_camera(replay.server), replay.drive.truth.position_m[replay.player.row]
        screen.slide("Time [s]", 0.2)
        screen.until(lambda: abs(replay.drive.truth.time_s[replay.player.row] - 4.0) < 1.0, "the time follows")
        was = np.append(before, 0.05)[None]
        gone = Sight("satellite where it was", camera.pixels(was), satellite_grey, radius=2, absent=True)
        screen.until_seen(*sights(camera, replay.drive, replay.player.row), gone)

    @pytest.mark.slow
    def test_play_and_dial(self, screen: Screen, replay: Open) -> None:
        screen.browser.click(*screen.button("Error"))
        screen.until(lambda: "cross: truth" in screen.text(), "the dial")
        begin = replay.player.row
        screen.browser.click(*screen.button("Play"))
        screen.until(lambda: replay.player.row > begin + 100, "time runs")
        screen.browser.click(*screen.button("Pause"))
        screen.until(lambda: not replay.player.is_playing, "time stands still")
        screen.keep("mockup-dial")

    @pytest.mark.slow
    def test_the_file_that_plays(self, screen: Screen, replay: Open, tmp_path: Path) -> None:
        path = tmp_path / "drive.html"
        write_page(page_html(replay.server, replay.page), path)
        screen.open(path.as_uri())
        camera = screen.camera(replay.server.initial_camera)
        # Anywhere along the drive: it plays while one looks.
        body = np.column_stack([replay.drive.truth.position_m, np.full(len(replay.drive.truth), 0.05)])[::100]
        later = [Sight("satellite", camera.pixels(place[None]), satellite_grey, radius=3) for place in body[5:]]

        def has_moved() -> bool:
            picture = screen.picture()
            return any(sight.holds(picture) for sight in later)

        screen.until(has_moved, "the satellite has left its first place")
        assert "late fix: where it was" in screen.text()
        assert screen.browser.requests == [path.as_uri()]
        assert screen.browser.errors == []
