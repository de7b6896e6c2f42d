"""The replay of a drive. No browser: scene nodes and panels are read directly.

================================  ==================================================
what                              checked against
================================  ==================================================
sheet on the ceiling              the catalogue: each star lies on its light
places of satellite and estimate  the track
dial                              the error in millimetres
================================  ==================================================
"""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest
import viser
from scipy.spatial.transform import Rotation

from adcs.mockup.navigation.fixes import FixOutcome
from adcs.mockup.vision.paper_matcher import CameraFix
from adcs.stars.identification import NoFix
from adcs.viewer.drive import Drive, IdentifiedFrame
from adcs.viewer.drive_page import drive_page
from adcs.viewer.drive_player import DrivePlayer
from adcs.viewer.error_dial import ErrorDial, estimate_lines
from adcs.viewer.frame_image import IDENTIFIED_COLOUR, OTHER_STAR_COLOUR, ceiling_sheet, mark_stars
from adcs.viewer.table_scene import CEILING_M, LIGHT_COLOUR, suitable_enlargement
from magloc.viewer.panels.inputs import set_value
from magloc.viewer.server import open_server, page_html
from sims.cli.mockup_options import MockupOptions
from sims.cli.mockup_replay import drive_of
from sims.experiments.mockup_navigation import fused_runs
from sims.mockup.table_run import CameraErrors, TableScenario
from tests.waiting import wait_for

DURATION_S = 20.0


@pytest.fixture(scope="module")
def drive() -> Drive:
    scenario = TableScenario(duration_s=DURATION_S, camera=CameraErrors(false=0.15))
    drive = drive_of(fused_runs("ekf", scenario, [0]).results[0], "ekf", MockupOptions().table_camera())
    assert FixOutcome.REJECTED in drive.outcomes
    return drive


@pytest.fixture
def server() -> Iterator[viser.ViserServer]:
    before = set(threading.enumerate())
    with open_server(0, "test") as server:
        yield server
    wait_for(lambda: set(threading.enumerate()) <= before)


@pytest.fixture
def player(server: viser.ViserServer, drive: Drive) -> Iterator[DrivePlayer]:
    page, player = drive_page(server, drive, 12.0)
    yield player
    page.close()


def node(server: viser.ViserServer, name: str) -> viser.SceneNodeHandle:
    handle = server.scene.get_handle_by_name(name)
    assert handle is not None
    return handle


def heading_of(handle: viser.SceneNodeHandle) -> float:
    x, y, z, w = np.roll(np.asarray(handle.wxyz), -1)
    turn = Rotation.from_quat([x, y, z, w]).as_rotvec()
    assert np.abs(turn[:2]).max() < 1e-12
    return float(turn[2])


def same_angle(one: float, other: float) -> bool:
    return abs(np.angle(np.exp(1j * (one - other)))) < 1e-9


class TestDrive:
    def test_rows_and_fixes_by_time(self, drive):
        assert drive.row_at(-1.0) == 0
        assert drive.row_at(99.0) == len(drive.truth) - 1
        row = drive.row_at(7.0)
        assert drive.truth.time_s[row] == pytest.approx(7.0)
        fix = drive.last_fix(row)
        assert fix is not None
        assert drive.fixes.arrival_s[fix] <= 7.0 < drive.fixes.arrival_s[fix + 1]
        assert drive.last_fix(0) is None

    def test_a_frame_is_of_where_the_satellite_was(self, drive):
        for fix in range(3):
            frame, pose = drive.frame_of(fix), drive.pose_of_exposure(fix)
            assert isinstance(frame.fix, CameraFix)
            np.testing.assert_allclose(frame.fix.position_m, pose.position_m, atol=5e-4)
            assert np.angle(np.exp(1j * (frame.fix.heading_rad - pose.heading_rad))) == pytest.approx(0.0, abs=2e-3)

    def test_the_same_frame_again(self, drive):
        np.testing.assert_array_equal(drive.frame_of(2).image, drive.frame_of(2).image)


class TestFrameImage:
    def frame(self, fix) -> IdentifiedFrame:
        image = np.full((480, 640), 20, np.uint8)
        image[199:202, 299:302] = 200
        return IdentifiedFrame(image, np.array([[300.0, 200.0], [100.0, 50.0]]), fix)

    @pytest.fixture
    def named(self) -> IdentifiedFrame:
        return self.frame(CameraFix(np.zeros(2), 0.0, np.array([[0, 5]]), 0.0, 5, 0.9 / 640))

    def test_rings(self, named):
        picture = mark_stars(named)
        assert picture.shape == (480, 640, 3)
        np.testing.assert_array_equal(picture[200, 287], IDENTIFIED_COLOUR)
        np.testing.assert_array_equal(picture[50, 87], OTHER_STAR_COLOUR)
        np.testing.assert_array_equal(mark_stars(self.frame(NoFix("none")))[200, 287], OTHER_STAR_COLOUR)

    def test_sheet_is_translucent_but_for_stars(self, named):
        sheet = ceiling_sheet(named)
        assert sheet.shape == (240, 320, 4)
        np.testing.assert_array_equal(sheet[100, 150], 255)
        assert 0 < sheet[180, 20, 3] < 255


class TestScene:
    def test_satellite_estimate_and_ellipse(self, server, player, drive):
        for time_s, enlarged in ((12.0, "10 ×"), (16.0, "1 ×")):
            set_value(player.enlarge_dropdown, enlarged)
            player.move_to(time_s)
            row, times = drive.row_at(time_s), float(enlarged.split()[0])
            satellite, estimate = node(server, "/satellite"), node(server, "/estimate")
            np.testing.assert_allclose(satellite.position[:2], drive.truth.position_m[row])
            assert same_angle(heading_of(satellite), drive.truth.heading_rad[row])
            error = estimate.position[:2] - drive.truth.position_m[row]
            np.testing.assert_allclose(error, times * drive.errors_m[row], atol=1e-12)
            assert same_angle(heading_of(estimate), drive.track.heading_rad[row])
            ellipse = node(server, "/ellipse")
            np.testing.assert_allclose(ellipse.position[:2], estimate.position[:2])
            np.testing.assert_allclose(ellipse.scale[:2], 3.0 * times * drive.sigma_m[row])

    def test_every_star_of_the_sheet_lies_on_its_light(self, server, player, drive):
        """viser's images have their columns along x and their rows along y, seen in three/ThreeAssets.tsx."""
        exposure, sheet = node(server, "/exposure"), node(server, "/exposure/sheet")
        assert exposure.visible
        assert sheet.position[2] + exposure.position[2] == pytest.approx(CEILING_M, abs=0.01)
        fix = drive.last_fix(player.row)
        frame = drive.frame_of(fix)
        heading = heading_of(exposure)
        R = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]])
        scale = np.array([sheet.render_width / 640, sheet.render_height / 480])
        places = ((frame.stars_px - [319.5, 239.5]) * scale) @ R.T + exposure.position[:2]
        star, light = frame.fix.stars.T
        np.testing.assert_allclose(places[star], drive.lights_m[light], atol=1e-3)

    def test_lights_that_were_identified_are_green(self, server, player, drive):
        colours = np.asarray(node(server, "/sky").batched_colors)
        named = drive.frame_of(drive.last_fix(player.row)).fix.stars[:, 1]
        np.testing.assert_array_equal(colours[named], np.tile(IDENTIFIED_COLOUR, (len(named), 1)))
        others = np.delete(colours, named, axis=0)
        np.testing.assert_array_equal(others, np.tile(LIGHT_COLOUR, (len(others), 1)))

    def test_late_fix_and_rejected_fix(self, server, player, drive):
        for fix, outcome in enumerate(drive.outcomes):
            player.move_to(float(drive.fixes.arrival_s[fix]) + 0.02)
            wrong = outcome is FixOutcome.REJECTED
            shown, hidden = ("/rejected-fix", "/fix") if wrong else ("/fix", "/rejected-fix")
            assert (node(server, shown).visible, node(server, hidden).visible) == (True, False)
            np.testing.assert_allclose(node(server, shown).position[:2], drive.fixes.position_m[fix])
            assert same_angle(heading_of(node(server, shown)), drive.fixes.heading_rad[fix])
            assert ("<b>rejected</b>" in player.row_panel.content) == wrong

    def test_before_the_first_fix_there_is_none(self, server, player):
        player.move_to(0.3)
        for name in ("/fix", "/rejected-fix", "/exposure", "/age"):
            assert not node(server, name).visible
        assert "no fix has arrived" in player.frame_panel.content
        assert np.ptp(np.asarray(node(server, "/sky").batched_colors), axis=0).max() == 0
        player.move_to(5.0)
        assert node(server, "/fix").visible

    def test_trails_end_at_the_present(self, server, player, drive):
        end = np.asarray(node(server, "/path/truth").points)[-1, 1, :2]
        np.testing.assert_allclose(end, drive.truth.position_m[player.row], atol=1e-6)

    @pytest.mark.parametrize(("error_m", "enlarged"), [(0.001, 50.0), (0.005, 20.0), (0.1, 1.0), (3.0, 1.0)])
    def test_enlargement_suits_the_errors(self, error_m, enlarged):
        assert suitable_enlargement(error_m) == enlarged


class TestPlayer:
    def test_slider(self, player, drive):
        set_value(player.time_slider, 8.0)
        assert drive.truth.time_s[player.row] == pytest.approx(8.0)
        player.move_to(99.0)
        assert player.time_slider.value == pytest.approx(DURATION_S)

    def test_play_and_pause(self, player):
        player.move_to(0.0)
        set_value(player.speed_dropdown, "1 ×")
        player.play()
        player.play()  # a second time changes nothing
        assert sum(thread.name == "adcs-drive-player" for thread in threading.enumerate()) == 1
        assert player.play_button.label == "Pause"
        wait_for(lambda: player.row > 10)
        set_value(player.play_button, True)
        held = player.row
        assert (player.is_playing, player.play_button.label) == (False, "Play")
        time.sleep(0.2)
        assert player.row == held
        assert not any(thread.name == "adcs-drive-player" for thread in threading.enumerate())

    def test_it_stops_at_the_end_and_begins_again(self, player, drive, monkeypatch):
        tenths = iter(range(20))  # the clock stands still early in the second time
        monkeypatch.setattr("magloc.viewer.panels.time_player.perf_counter", lambda: 0.1 * next(tenths, 20))
        player.move_to(DURATION_S - 0.1)
        player.play()
        wait_for(lambda: not player.is_playing)
        assert player.row == len(drive.truth) - 1
        player.play()
        wait_for(lambda: player.row < 500)
        player.pause()

    def test_frames_are_made_once_and_only_when_seen(self, server, drive):
        asked = []

        def frame_of(fix: int) -> IdentifiedFrame:
            asked.append(fix)
            return drive.frame_of(fix)

        watched = Drive(**{**{k: getattr(drive, k) for k in Drive.__dataclass_fields__}, "frame_of": frame_of})
        page, player = drive_page(server, watched, 12.0)
        shown = watched.last_fix(player.row)
        player.move_to(12.01)
        player.move_to(11.99)
        assert asked == [shown]
        page.close()


class TestErrorDial:
    def test_dot_is_at_the_error_with_Y_up(self, drive):
        dial, row = ErrorDial(drive), drive.row_at(15.0)
        found = re.search(r'<circle cx="([-\d.]+)" cy="([-\d.]+)" r="5" fill="#0072b2"', dial.svg(row))
        assert found is not None
        place_m = np.array([float(found[1]), -float(found[2])]) / 100.0 * dial.reach_m
        np.testing.assert_allclose(place_m, drive.errors_m[row], atol=1e-3 * dial.reach_m)

    def test_reach_is_round_and_holds_what_is_usual(self, drive):
        reach_mm = 1e3 * ErrorDial(drive).reach_m
        assert reach_mm in (5.0, 10.0, 20.0, 50.0)
        assert reach_mm > 1e3 * drive.usual_error_m

    def test_words(self, drive):
        row = drive.row_at(15.0)
        _, error, fix = estimate_lines(drive, row)
        assert f"<b>{1e3 * np.hypot(*drive.errors_m[row]):.1f} mm</b>" in error
        age_s = drive.truth.time_s[row] - drive.fixes.time_s[drive.last_fix(row)]
        assert f"taken {age_s:.2f} s ago" in fix


class TestPages:
    def test_methods_without_sigma(self, server):
        runs = fused_runs("camera", TableScenario(duration_s=12.0), [1])
        page, player = drive_page(server, drive_of(runs.results[0], "camera", MockupOptions().table_camera()), 6.0)
        assert not node(server, "/ellipse").visible
        assert player.enlarge_dropdown.value == "1 ×"
        assert "fix that was rejected" not in str(page.entries)
        page.close()

    def test_a_page_that_plays(self, server, player, drive):
        page, second = drive_page(server, drive, 3.0)
        text = page_html(server, page)
        assert "__VISER_EMBED_DATA__" in text
        assert "late fix: where it was" in text
        assert len(text) < 8_000_000
        assert second.row == drive.row_at(3.0)  # where it was
        page.close()
