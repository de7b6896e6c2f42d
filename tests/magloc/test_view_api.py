"""``magloc.view``: the viewer from Python, as a server, as a file, and inline in a notebook."""

from __future__ import annotations

import sys
import urllib.request
from html import unescape
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import rich
import viser
from scipy.spatial.transform import Rotation

import magloc
from arrays.geometries import cube, tetrahedron
from arrays.io.errors import InputError
from magloc.localization.fit.fixes import Fixes
from magloc.localization.locator import locate
from magloc.measurement.differences import predicted_channels
from magloc.readings import Readings
from magloc.surveying.results import Reach, SurveyRows
from magloc.tracking.results import TrackPoint, TrackResult
from magloc.viewer.pages.pages import readings_page, survey_page
from magloc.viewer.pages.survey import target_lines
from magloc.viewer.server import address, free_port, open_server
from magloc.viewer.view import View, thin_readings
from tests.browser.browser import Browser
from tests.magloc.cli.test_view import needs_chromium

ARRAY = tetrahedron(1.5)
PLACES = np.stack([np.linspace(-2.0, 2.0, 5), np.full(5, 3.0), np.full(5, 0.5)], axis=-1)
VALUES_T = np.array([predicted_channels(ARRAY, place, [0.0, 80.0, 30.0]) for place in PLACES])


@pytest.fixture(scope="module")
def fixes() -> Fixes:
    return locate(ARRAY, VALUES_T)


@pytest.fixture
def in_notebook(monkeypatch: pytest.MonkeyPatch) -> None:
    kernel = SimpleNamespace(IPKernelApp=SimpleNamespace(initialized=lambda: True))
    monkeypatch.setitem(sys.modules, "ipykernel.kernelapp", kernel)


def page_of(address: str) -> bytes:
    direct = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    with direct.open(address, timeout=20.0) as reply:
        page: bytes = reply.read()
    return page


class TestServer:
    """Outside of a notebook a scene is served until it is closed."""

    def test_an_array_is_served_and_the_browser_opened(self, monkeypatch: pytest.MonkeyPatch) -> None:
        seen: list[str] = []
        monkeypatch.setattr("webbrowser.open", seen.append)
        with magloc.view(ARRAY, port=0) as shown:
            assert seen == [shown.address]
            assert b"<html" in page_of(shown.address)
            assert "dipole to be dragged" in shown.html
        with pytest.raises(OSError, match="refused"):
            page_of(shown.address)

    def test_nothing_is_said_and_others_may_speak_again(self, capsys: pytest.CaptureFixture[str]) -> None:
        with open_server(free_port(0), "quiet"):
            pass
        assert capsys.readouterr().out == ""
        rich.print("heard")
        assert capsys.readouterr().out == "heard\n"

    def test_a_scene_that_cannot_be_filled_leaves_no_server(self, monkeypatch: pytest.MonkeyPatch) -> None:
        def refuse(server: viser.ViserServer, *_: object, **__: object) -> None:
            addresses.append(address(server))
            raise RuntimeError("the scene is empty")

        addresses: list[str] = []
        monkeypatch.setattr("magloc.viewer.view.array_page", refuse)
        with pytest.raises(RuntimeError, match="the scene is empty"):
            magloc.view(ARRAY, port=0, open=False)
        with pytest.raises(OSError, match="refused"):
            page_of(addresses[0])


@pytest.mark.usefixtures("in_notebook")
class TestInline:
    """In a notebook a result shows itself, without a server."""

    def page(self, shown: View) -> str:
        inline = shown._repr_html_()
        begin, end = '<iframe srcdoc="', '" style="'
        assert inline.startswith(begin)
        return unescape(inline[len(begin) : inline.index(end)])

    def test_fixes(self, fixes: Fixes) -> None:
        shown = magloc.view(ARRAY, fixes)
        page = self.page(shown)
        assert page == shown.html
        assert "__VISER_EMBED_DATA__" in page
        assert "rows, in which a source is detected" in page
        with pytest.raises(OSError, match="refused"):
            page_of(shown.address)

    def test_readings_are_located(self) -> None:
        assert "rows, in which a source is detected" in self.page(magloc.view(ARRAY, Readings(VALUES_T)))

    def test_readings_that_cannot_be_located_are_seen_all_the_same(self) -> None:
        two = ARRAY.subset(ARRAY.ids[:2])
        assert "one square of the floor" in self.page(magloc.view(two, Readings(VALUES_T[:, :6])))

    def test_a_survey(self) -> None:
        """Targets stand where they are, named with their depths; all rows are there."""
        position, rows = np.array([1.0, 2.0, -0.6]), np.random.default_rng(1).uniform(1.0, 7.0, (40, 3))
        target = magloc.Target("t1", position, np.array([0.0, 1.0, 2.0]), 1e-4 * np.eye(6), 0.6, (0.5, 0.7), 900.0)
        values = SurveyRows(np.arange(40.0), rows, 1e-9 * rows[:, 0], 0.0 * rows[:, 0])
        reach = Reach(np.zeros((0, 3)), np.zeros(0))
        survey = magloc.Survey((target,), ARRAY, values, reach, magloc.Terrain(), 26.0, 1.0, False, 0.0, 1.0)
        assert "95 % ellipsoids of their positions" in self.page(magloc.view(None, survey))
        with open_server(0, "survey") as server:
            survey_page(server, survey)
            nodes = server.scene._handle_from_node_name
            np.testing.assert_allclose(nodes["/t1"].position, position)
            assert nodes["/t1-text"].text == "t1: 0.60 m"
            np.testing.assert_allclose(nodes["/rows"].points, rows, atol=1e-6)
            np.testing.assert_allclose(nodes["/chosen"].position, [1.0, 2.0, 0.0])
        said = " ".join(target_lines(target))
        assert "depth 0.6 m: 0.5 m to 0.7 m (95 %)" in said
        assert f"moment 2.24 A·m²; iron: {5**0.5 / 0.3:.2g}" in said

    def test_several_sources_are_all_seen(self) -> None:
        array = cube(1.5)
        places = ([2.0, 2.5, 0.5], [-2.5, -2.0, 1.0])
        fixes = locate(array, sum(predicted_channels(array, place, [0.0, 80.0, 30.0]) for place in places), sources=2)
        with open_server(0, "fixes") as server:
            readings_page(server, array, fixes, None)
            shown = [handle for name, handle in server.scene._handle_from_node_name.items() if "/fixes/best" in name]
            found = [handle.position for handle in shown if handle.name in ("/fixes/best", "/fixes/best-2")]
        order = np.argsort(-np.array(found)[:, 0])
        np.testing.assert_allclose(np.array(found)[order], places, atol=1e-3)

    def test_a_source_whose_place_is_known(self) -> None:
        fixes = locate(ARRAY, VALUES_T[:1], position_m=PLACES[:1])
        assert "source of the row" in self.page(magloc.view(ARRAY, fixes))

    def test_track_brings_its_array_and_readings(self) -> None:
        noise = np.random.default_rng(0).normal(0.0, ARRAY.channel_noise_T, (40, ARRAY.n_channels))
        path = np.stack([np.linspace(-1.0, 1.0, 40), np.full(40, 3.0), np.full(40, 0.5)], axis=-1)
        values = np.array([predicted_channels(ARRAY, place, [0.0, 80.0, 30.0]) for place in path])
        found = magloc.track(ARRAY, Readings(values + noise, time_s=0.1 * np.arange(40.0)))
        page = self.page(magloc.view(None, found))
        assert "95 % ellipsoids" in page
        assert "4 vector sensors" in page

    def test_truth_and_map(self) -> None:
        assert "true path" in self.page(magloc.view(None, magloc.Truth(np.arange(5.0), PLACES)))
        source = magloc.Source([5.0, 0.0, 0.3], [100.0, 0.0, 0.0])
        converged = magloc.convergence_map(ARRAY, source, method="repeated", edge_m=20.0, n=5)
        assert "Convergence of" in self.page(magloc.view(None, converged))


class TestFiles:
    """``html`` and ``png`` write, and serve nothing."""

    def test_page(self, tmp_path: Path, fixes: Fixes) -> None:
        path = tmp_path / "fixes.html"
        shown = magloc.view(ARRAY, fixes, html=path)
        assert path.read_text(encoding="utf-8") == shown.html
        assert [file.name for file in tmp_path.iterdir()] == ["fixes.html"]

    @pytest.mark.slow
    @needs_chromium
    def test_page_fetches_nothing_and_the_picture_is_one(self, tmp_path: Path, fixes: Fixes) -> None:
        page, picture = tmp_path / "fixes.html", tmp_path / "fixes.png"
        magloc.view(ARRAY, fixes, html=page, png=picture)
        assert picture.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
        with Browser(page.as_uri(), (640, 400)) as browser:
            browser.wait_for("document.querySelector('canvas') !== null")
            browser.settled_screenshot()
            assert browser.requests == [page.as_uri()]
            assert browser.errors == []

    def test_errors_name_the_argument(self, tmp_path: Path) -> None:
        with pytest.raises(InputError, match=r"^Input html .*found no folder"):
            magloc.view(ARRAY, html=tmp_path / "no" / "x.html")
        with pytest.raises(InputError, match=r"^Input png .*expected \.png"):
            magloc.view(ARRAY, png=tmp_path / "x.jpg")


class TestArguments:
    """What does not belong together is refused before a server is opened."""

    @pytest.fixture(autouse=True)
    def no_server(self, monkeypatch: pytest.MonkeyPatch) -> None:
        def refuse(*_: object, **__: object) -> None:
            raise AssertionError("a server was opened for bad input")

        monkeypatch.setattr("viser.ViserServer", refuse)

    def test_no_array(self, fixes: Fixes) -> None:
        with pytest.raises(ValueError, match="Input array"):
            magloc.view(None, fixes)

    def test_nothing_tracked(self) -> None:
        nothing = TrackResult((TrackPoint(0.0),), is_truth=False)
        with pytest.raises(ValueError, match="a row where the source is tracked"):
            magloc.view(ARRAY, nothing)

    def test_something_else(self) -> None:
        with pytest.raises(ValueError, match="instead received str"):
            magloc.view(ARRAY, "fixes.json")  # type: ignore[arg-type]

    def test_readings_of_other_rows(self, fixes: Fixes) -> None:
        with pytest.raises(ValueError, match="a row for each of 5 fixes; instead received 2"):
            magloc.view(ARRAY, fixes, readings=Readings(VALUES_T[:2]))

    def test_fixes_in_the_world_need_poses(self, fixes: Fixes) -> None:
        moved = fixes.moved(np.zeros((5, 3)), Rotation.identity(5), frame="world")
        with pytest.raises(ValueError, match="must have poses"):
            magloc.view(ARRAY, moved)


def test_long_readings_are_thinned_evenly() -> None:
    rows = thin_readings(Readings(np.zeros((4001, 12))))
    np.testing.assert_array_equal(rows.time_s, np.arange(0.0, 4001.0, 3.0))
