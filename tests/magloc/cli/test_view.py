"""``magloc view``: bad input is one sentence, files are written whole, the server starts, answers and ends."""

from __future__ import annotations

import json
import signal
import socket
import struct
import urllib.request
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import viser
from numpy.typing import NDArray

from arrays.array_file import write_array
from arrays.geometries import tetrahedron
from arrays.io.errors import InputError
from magloc.measurement.differences import predicted_channels
from magloc.readings import Readings, write_readings
from magloc.tracking.results import TrackResult
from magloc.viewer.chromium import BINARIES, find_chromium
from magloc.viewer.pages.open_result import MapResult, ReadingsResult, read_result
from magloc.viewer.pages.pages import array_page
from magloc.viewer.scene.glyphs import ArrayGlyphs
from magloc.viewer.server import free_port, open_server
from tests.browser.browser import Browser
from tests.command_line import Run, assert_refused, viewer_started

LARGEST_PAGE = 15_000_000
PICTURE_PX = (1280, 800)
SCENE_PX = 946  # width of the scene beside the panel
FloatArray = NDArray[np.float64]


def places_in_picture(points: FloatArray, camera: viser.InitialCameraConfig) -> FloatArray:
    """Columns and rows of points in the picture (n, 2) [px]."""
    forward = camera.look_at - camera.position
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    offset = points - camera.position
    scale = 0.5 * PICTURE_PX[1] / np.tan(0.5 * camera.fov) / (offset @ forward)
    places: FloatArray = np.stack(
        [0.5 * SCENE_PX + scale * (offset @ right), 0.5 * PICTURE_PX[1] - scale * (offset @ up)], axis=-1
    )
    return places


def has_chromium() -> bool:
    try:
        find_chromium()
    except InputError:
        return False
    return True


needs_chromium = pytest.mark.skipif(not has_chromium(), reason=f"needs one of {', '.join(BINARIES)}")


@pytest.fixture
def array_file(tmp_path: Path) -> Path:
    path = tmp_path / "tetra.toml"
    write_array(path, tetrahedron(1.5))
    return path


@pytest.fixture
def readings_file(tmp_path: Path) -> Path:
    """Readings with their array beside them."""
    array = tetrahedron(1.5)
    write_array(tmp_path / "readings-array.toml", array)
    x = np.linspace(-2.0, 2.0, 5)
    positions = np.stack([x, np.full(5, 3.0), np.full(5, 0.5)], axis=-1)
    values = np.array([predicted_channels(array, p, [0.0, 80.0, 30.0]) for p in positions])
    path = tmp_path / "readings.csv"
    write_readings(path, Readings(values), array)
    return path


def track_entries() -> list[dict[str, object]]:
    tracked = {"moment_Am2": [0, 0, 5], "covariance": np.eye(6).tolist(), "nis": 3.0, "nis_dof": 9, "status": "tracked"}
    nothing = {"position_m": None, "moment_Am2": None, "covariance": None, "nis": None, "status": "not acquired"}
    return [
        {"time_s": 0.0, **nothing},
        {"time_s": 1.0, "position_m": [1, 2, 3], **tracked},
        {"time_s": 2.0, "position_m": [2, 2, 3], **tracked},
    ]


class TestKindsOfFiles:
    """A path is recognised by what it holds."""

    def test_readings_find_their_array(self, readings_file: Path) -> None:
        result = read_result(readings_file)
        assert isinstance(result, ReadingsResult)
        assert result.array_path.name == "readings-array.toml"
        assert len(result.readings) == 5

    def test_readings_find_an_array_that_is_called_so(self, readings_file: Path) -> None:
        readings_file.with_name("readings-array.toml").rename(readings_file.with_name("array.toml"))
        result = read_result(readings_file)
        assert isinstance(result, ReadingsResult)
        assert result.array_path.name == "array.toml"

    @pytest.mark.parametrize("kind", ["json", "jsonl"])
    def test_track(self, tmp_path: Path, kind: str) -> None:
        path = tmp_path / f"track.{kind}"
        entries = track_entries()
        lines = "\n".join(map(json.dumps, entries)) + "\n"
        path.write_text(json.dumps({"results": entries}) if kind == "json" else lines)
        result = read_result(path)
        assert isinstance(result, TrackResult)
        assert [point.position_m is None for point in result.points] == [True, False, False]
        assert result.points[1].covariance is not None
        assert result.points[1].covariance.shape == (6, 6)
        assert not result.is_truth

    def test_truth_in_a_plane(self, tmp_path: Path) -> None:
        path = tmp_path / "truth.csv"
        path.write_text("time_s,x_m,y_m\n1,5,6\n0,3,4\n")
        result = read_result(path)
        assert isinstance(result, TrackResult)
        assert result.is_truth
        assert [list(p.position_m) for p in result.points if p.position_m is not None] == [[3, 4, 0], [5, 6, 0]]

    @pytest.mark.parametrize("over", ["starts", "sources"])
    def test_map(self, run: Run, tmp_path: Path, over: str) -> None:
        folder = tmp_path / "map"
        assert run("map", "--over", over, "--grid", "5", "--out", folder, "--quiet").status == 0
        for path in (folder, folder / "map.zarr"):
            result = read_result(path)
            assert isinstance(result, MapResult)
            assert result.over == over
            assert result.values.shape == (5, 5, 5)
            assert np.isfinite(result.values).any()
            assert not (np.isfinite(result.values) & result.failed).any()

    @pytest.mark.slow
    def test_large_maps_are_thinned(self, run: Run, tmp_path: Path) -> None:
        folder = tmp_path / "map"
        assert run("map", "--grid", "66", "--out", folder, "--quiet").status == 0
        result = read_result(folder)
        assert isinstance(result, MapResult)
        assert result.every == 2
        assert result.values.shape == (33, 33, 33)


class TestBadInput:
    """One sentence, exit status 2, and no server that stays open."""

    @pytest.fixture(autouse=True)
    def no_server(self, monkeypatch: pytest.MonkeyPatch) -> None:
        def refuse(*_: object, **__: object) -> None:
            raise AssertionError("a server was opened for bad input")

        monkeypatch.setattr("viser.ViserServer", refuse)

    @pytest.mark.parametrize("name", ["nothing.toml", "nothing.csv", "nothing.json", "nothing"])
    def test_nothing_there(self, run: Run, tmp_path: Path, name: str) -> None:
        assert_refused(run("view", tmp_path / name), name, "does not exist")

    def test_unknown_kind(self, run: Run, tmp_path: Path) -> None:
        path = tmp_path / "picture.png"
        path.write_bytes(b"\x89PNG")
        assert_refused(run("view", path), "picture.png", "unknown kind", "an array (.toml)")

    def test_empty_folder_and_one_without_a_map(self, run: Run, tmp_path: Path) -> None:
        assert_refused(run("view", tmp_path), "an empty folder", "map.zarr")
        (tmp_path / "notes.txt").write_text("x")
        assert_refused(run("view", tmp_path), "a folder without a map")

    def test_empty_store(self, run: Run, tmp_path: Path) -> None:
        (tmp_path / "map.zarr").mkdir()
        assert_refused(run("view", tmp_path), "a folder without a map")

    def test_a_map_of_which_nothing_is_done(self, run: Run, tmp_path: Path) -> None:
        from magloc.convergence.over_starts import StartsMap
        from magloc.convergence.scenario_files import read_starts_scenario
        from magloc.grids.store import Sweep

        with Sweep(StartsMap.of(read_starts_scenario("paper", method=None, noise_seed=None), 5), tmp_path / "map.zarr"):
            pass
        assert_refused(run("view", tmp_path), "without computed points")

    def test_a_store_of_something_else(self, run: Run, tmp_path: Path) -> None:
        import zarr

        zarr.create_array(tmp_path / "map.zarr", shape=(3,), dtype="f8")
        assert_refused(run("view", tmp_path), "something else than a map")

    @pytest.mark.parametrize(
        ("file", "right", "wrong"),
        [
            ("iterations/zarr.json", '"level": 1', '"level": 1.5'),
            ("iterations/zarr.json", '"zstd"', '"nothing"'),
            ("x/zarr.json", '"shape"', '"shapes"'),
            ("zarr.json", '"position_m": [', '"position_m": ["here", '),
        ],
    )
    def test_a_damaged_map(self, run: Run, tmp_path: Path, file: str, right: str, wrong: str) -> None:
        run("map", "paper", "--grid", 3, "--out", tmp_path / "map", "--quiet")
        damaged = tmp_path / "map" / "map.zarr" / file
        text = damaged.read_text()
        assert right in text
        damaged.write_text(text.replace(right, wrong))
        assert_refused(
            run("view", tmp_path / "map"), "map.zarr" if "x/" in file else "map", "something else than a map"
        )

    def test_a_map_whose_axis_is_lost(self, run: Run, tmp_path: Path) -> None:
        import zarr

        run("map", "paper", "--grid", 3, "--out", tmp_path, "--quiet")
        zarr.open_array(tmp_path / "map.zarr" / "x")[:] = np.nan
        assert_refused(run("view", tmp_path), "an axis that does not increase")

    def test_readings_that_all_miss(self, run: Run, readings_file: Path) -> None:
        header = readings_file.read_text().splitlines()[0]
        readings_file.write_text(f"{header}\n0{',' * 12}\n1{',nan' * 12}\n")
        assert_refused(run("view", readings_file), "found no reading in any row")

    def test_readings_without_an_array(self, run: Run, readings_file: Path) -> None:
        readings_file.with_name("readings-array.toml").unlink()
        assert_refused(run("view", readings_file), "found no array", "--array")

    def test_a_table_of_something_else(self, run: Run, tmp_path: Path) -> None:
        (tmp_path / "a.csv").write_text("a,b\n1,2\n")
        assert_refused(run("view", tmp_path / "a.csv"), "neither readings")

    @pytest.mark.parametrize(
        ("text", "fragment"),
        [
            ("{", "not JSON"),
            ("[1, 2]", "no list of results"),
            ('{"starts": 5}', "no list of results"),
            ('{"results": []}', "no row where the source is tracked"),
            ('{"results": [{"time_s": 0, "solutions": []}]}', "fixes of `magloc locate`"),
            ('{"results": [{"time_s": 0, "position_m": [1, 2]}]}', "position_m"),
            ('{"results": [{"time_s": 0, "position_m": "here"}]}', "position_m"),
            ('{"results": [{"time_s": null, "position_m": [1, 2, 3]}]}', "time_s"),
            ('{"results": [{"time_s": 0, "position_m": [1, 2, 1e300]}]}', "position_m"),
            (f'{{"results": [{{"time_s": 0, "position_m": [1, 2, {"9" * 400}]}}]}}', "position_m"),
            ('{"results": [{"time_s": 1e300, "position_m": [1, 2, 3]}]}', "time_s"),
            ('{"results": [{"time_s": 0, "position_m": [1, 2, 3], "nis": "x"}]}', "nis"),
            (
                f'{{"results": [{{"time_s": 0, "position_m": [1, 2, 3], "covariance": {[[-1.0] * 6] * 6}}}]}}',
                "variance below zero",
            ),
            ('{"results": [{"time_s": 0, "position_m": null}]}', "no row where the source is tracked"),
        ],
    )
    def test_a_track_that_is_none(self, run: Run, tmp_path: Path, text: str, fragment: str) -> None:
        (tmp_path / "track.json").write_text(text)
        assert_refused(run("view", tmp_path / "track.json"), "track.json", fragment)

    def test_options_that_do_not_go_together(self, run: Run, array_file: Path, readings_file: Path) -> None:
        assert_refused(run("view", array_file, "--readings", readings_file), "--readings", "a track")
        assert_refused(run("view", array_file, "--array", array_file), "--array")

    def test_a_folder_to_write_into_that_is_not_there(self, run: Run, array_file: Path) -> None:
        assert_refused(run("view", array_file, "--html", array_file.parent / "no" / "x.html"), "--html", "no folder")
        assert_refused(run("view", array_file, "--png", array_file.parent / "no" / "x.png"), "--png", "no folder")

    def test_no_chromium(self, run: Run, array_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setenv("PATH", str(array_file.parent))
        assert_refused(run("view", array_file, "--png", array_file.with_suffix(".png")), "--png", "chromium")

    @pytest.mark.parametrize("port", ["-1", "65536", "1.5", "http"])
    def test_no_port(self, run: Run, array_file: Path, port: str) -> None:
        assert_refused(run("view", array_file, "--port", port), "port")


class TestPorts:
    """The port that is asked for, or the next one."""

    def test_the_next_one_is_taken(self) -> None:
        with socket.create_server(("127.0.0.1", 0)) as taken:
            port = taken.getsockname()[1]
            assert free_port(port) > port

    def test_all_in_use(self) -> None:
        with socket.create_server(("127.0.0.1", 65535)), pytest.raises(InputError, match="65535 to 65535 in use"):
            free_port(65535)

    def test_any(self) -> None:
        assert free_port(0) > 0


class TestPages:
    """``--html`` writes one file that holds all it needs."""

    @pytest.fixture(params=["array", "readings", "track", "map"])
    def result(self, request: pytest.FixtureRequest, run: Run, tmp_path: Path) -> Path:
        if request.param == "array":
            path: Path = request.getfixturevalue("array_file")
        elif request.param == "readings":
            path = request.getfixturevalue("readings_file")
        elif request.param == "track":
            path = tmp_path / "track.json"
            path.write_text(json.dumps({"results": track_entries()}))
        else:
            path = tmp_path / "map"
            run("map", "--grid", "5", "--out", path, "--quiet")
        return path

    def test_file(self, run: Run, result: Path, tmp_path: Path) -> None:
        page = tmp_path / "page.html"
        before = {path.name for path in tmp_path.iterdir()}
        outcome = run("view", result, "--html", page)
        assert outcome.status == 0, outcome.err
        assert outcome.out == ""
        assert "wrote" in outcome.err
        text = page.read_text(encoding="utf-8")
        assert page.stat().st_size < LARGEST_PAGE
        assert "__VISER_EMBED_DATA__" in text
        assert "one square of the floor" in text
        assert {path.name for path in tmp_path.iterdir()} == before | {"page.html"}

    def test_one_that_cannot_be_written_leaves_nothing(self, run: Run, array_file: Path, tmp_path: Path) -> None:
        (tmp_path / "page.html").mkdir()
        before = sorted(tmp_path.iterdir())
        assert_refused(run("view", array_file, "--html", tmp_path / "page.html"), "--html", "found a folder")
        assert sorted(tmp_path.iterdir()) == before

    @pytest.mark.slow
    @needs_chromium
    def test_nothing_is_downloaded(self, run: Run, array_file: Path, tmp_path: Path) -> None:
        page = tmp_path / "page.html"
        run("view", array_file, "--html", page, "--quiet")
        with Browser(page.as_uri(), (640, 400)) as browser:
            browser.wait_for("document.querySelector('canvas') !== null")
            browser.settled_screenshot()
            assert browser.requests == [page.as_uri()]
            assert browser.errors == []


class TestPicture:
    """``--png`` draws without a person."""

    @pytest.mark.slow
    @needs_chromium
    def test_sensors_are_seen_where_the_first_camera_has_them(
        self, run: Run, array_file: Path, tmp_path: Path, read_png: Callable[[Path], np.ndarray]
    ) -> None:
        picture = tmp_path / "array.png"
        outcome = run("view", array_file, "--png", picture)
        assert outcome.status == 0, outcome.err
        assert struct.unpack(">II", picture.read_bytes()[16:24]) == PICTURE_PX
        red, green, blue = np.moveaxis(read_png(picture).astype(int), -1, 0)
        array = tetrahedron(1.5)
        with open_server(0, "test") as server:
            array_page(server, array, live=False)
            camera = server.initial_camera
            size = ArrayGlyphs(server.scene, array).size_m
            seen = places_in_picture(array.positions + np.array([0.0, 0.0, 0.8 * size]), camera)
            bodies = places_in_picture(array.positions, camera)
        # The rods along the sensors' z axes are blue, their bodies grey.
        for colour, places in (
            ((blue > red + 60) & (blue > green + 30), seen),
            ((abs(red - green) < 25) & (abs(blue - red) < 45) & (red < 175), bodies),
        ):
            for x, y in np.rint(places).astype(int):
                assert colour[y - 8 : y + 9, x - 8 : x + 9].sum() > 20
        # Nothing of a rod is anywhere else, but for the array's own z axis.
        rows, columns = np.nonzero((blue > red + 60) & (blue > green + 30))
        rods = np.hypot(columns[:, None] - seen[:, 0], rows[:, None] - seen[:, 1]).min(axis=1) < 40
        assert rods[columns < SCENE_PX].mean() > 0.6

    @pytest.fixture
    def read_png(self) -> Callable[[Path], np.ndarray]:
        from matplotlib.image import imread

        return lambda path: np.rint(255.0 * imread(path)[..., :3])


class TestServer:
    """The command serves until Ctrl-C, and then ends quietly."""

    def test_it_answers_and_ends_at_an_interruption(self, array_file: Path) -> None:
        with socket.create_server(("127.0.0.1", 0)) as taken:
            port = taken.getsockname()[1]
            with viewer_started(array_file, "--port", str(port)) as (process, address):
                assert address.startswith("http://127.0.0.1:")
                assert address != f"http://127.0.0.1:{port}"
                direct = urllib.request.build_opener(urllib.request.ProxyHandler({}))
                with direct.open(address, timeout=20.0) as reply:
                    assert b"<html" in reply.read()
                process.send_signal(signal.SIGINT)
                out, err = process.communicate(timeout=120.0)
        assert process.returncode == 0
        assert out == ""
        assert f"port {port} is in use" in err
        assert "Traceback" not in err
