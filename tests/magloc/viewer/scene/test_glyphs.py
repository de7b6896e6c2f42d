"""What the viewer puts into a scene: places, colours, sizes, the first camera, the legend. No browser is needed."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import viser
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from arrays.array import SensorArray
from arrays.geometries import GEOMETRIES, tetrahedron
from arrays.sensor import Sensor, SensorKind
from magloc.localization.fit.results import Fix, Solution
from magloc.readings import Readings
from magloc.tracking.results import TrackPoint, TrackResult
from magloc.viewer.pages import pages, texts
from magloc.viewer.pages.fixes import FixView
from magloc.viewer.pages.map import MapControls, MapView
from magloc.viewer.pages.open_result import MapResult
from magloc.viewer.panels.inputs import set_value
from magloc.viewer.scene import framing, shapes, track_glyph
from magloc.viewer.scene import glyphs as scene
from magloc.viewer.scene.legend import ColourScale, Swatch, legend_html, with_legend
from magloc.viewer.server import open_server
from tests.calls import calls_of
from tests.plain_locator import one_source
from tests.waiting import wait_for

FloatArray = NDArray[np.float64]


@pytest.fixture(scope="module")
def server() -> Iterator[viser.ViserServer]:
    with open_server(0, "test") as opened_server:
        yield opened_server


@pytest.fixture(autouse=True)
def empty(server: viser.ViserServer) -> None:
    server.scene.reset()
    server.gui.reset()


def tetrahedron_of(edge_m: float) -> SensorArray:
    return tetrahedron(edge_m, noise_T=1e-9)


def map_result(n: int = 9) -> MapResult:
    """A map whose values grow along all axes, with one octant that failed."""
    axis = np.linspace(-4.0, 4.0, n)
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    failed = (x > 0.0) & (y > 0.0) & (z > 0.0)
    values = np.where(failed, np.nan, 50.0 + x + 3.0 * y + 9.0 * z)
    source, moment = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 100.0])
    return MapResult(
        axis, values, failed, "starts", "passes until convergence", False, tetrahedron_of(0.5), source, moment, "map", 1
    )


def solution(position: FloatArray, *, observable: bool = True) -> Solution:
    covariance = np.diag([0.25, 0.01, 0.01, 1.0, 1.0, 1.0])
    interval = (4.0, 6.0) if observable else (2.0, None)
    return one_source(position, [0.0, 0.0, 7.0], covariance, chi2=3.0, dof=3, range_interval_m=(interval,))


class TestFirstCamera:
    """The first camera sees all points, and an array of 3 cm as one of 30 m."""

    @staticmethod
    def seen_from(server: viser.ViserServer, points: FloatArray) -> FloatArray:
        """Places in the picture, shape (n, 2): within ±1 vertically, within ± the aspect ratio horizontally."""
        camera = server.initial_camera
        forward = camera.look_at - camera.position
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        up = np.cross(right, forward)
        offset = points - camera.position
        depth = offset @ forward
        assert (depth > camera.near).all()
        assert (depth < camera.far).all()
        seen: FloatArray = np.stack([offset @ right, offset @ up], axis=-1) / depth[:, None] / np.tan(camera.fov / 2)
        return seen

    @pytest.mark.parametrize("size", [0.03, 1.5, 30.0])
    def test_all_points_are_in_view_and_fill_it(self, server: viser.ViserServer, size: float) -> None:
        points = size * np.random.default_rng(5).normal(size=(30, 3)) * [3.0, 1.0, 0.3] + [7.0 * size, 0.0, 0.0]
        framing.aim_camera(server, framing.extent_of(points))
        seen = self.seen_from(server, points)
        assert np.abs(seen[:, 1]).max() < 1.0
        assert np.abs(seen[:, 0]).max() < 1.15
        assert max(np.abs(seen[:, 1]).max(), np.abs(seen[:, 0]).max() / 1.15) > 0.7

    def test_it_scales_with_the_array(self, server: viser.ViserServer) -> None:
        cameras = []
        for edge in (0.03, 30.0):
            pages.array_page(server, tetrahedron_of(edge), live=False)
            cameras.append((server.initial_camera.position / edge, server.initial_camera.near / edge))
        assert cameras[0][0] == pytest.approx(cameras[1][0])
        assert cameras[0][1] == pytest.approx(cameras[1][1])

    def test_points_that_are_not_finite_do_not_count(self) -> None:
        extent = framing.extent_of([[np.nan, 0.0, 0.0], [1.0, 0.0, 0.0], [3.0, 0.0, 0.0], [np.inf, 0.0, 0.0]])
        assert extent.centre_m.tolist() == [2.0, 0.0, 0.0]
        assert extent.radius_m == 1.0

    @pytest.mark.parametrize("points", [np.zeros((0, 3)), np.full((4, 3), 2.0), np.full((2, 3), np.nan)])
    def test_one_place_or_none_is_given_a_metre(self, points: FloatArray) -> None:
        assert framing.extent_of(points).radius_m == 1.0


class TestFloor:
    @pytest.mark.parametrize("size", [0.03, 1.5, 30.0])
    def test_reaches_beyond_the_points_and_lies_below_them(
        self, server: viser.ViserServer, size: float, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        floors: list[dict[str, Any]] = []
        monkeypatch.setattr(server.scene, "add_grid", lambda name, **how: floors.append({"name": name, **how}))
        points = size * (np.array([7.0, -3.0, 2.0]) + np.random.default_rng(5).uniform(-1.0, 1.0, (30, 3)))
        height, cell = framing.set_up_scene(server, framing.extent_of(points))
        (floor,) = floors
        assert floor["name"] == "/floor"
        assert floor["cell_size"] == cell
        assert floor["section_size"] == pytest.approx(5.0 * cell)
        x, y, z = floor["position"]
        for half, places, middle in ((floor["width"] / 2.0, points[:, 0], x), (floor["height"] / 2.0, points[:, 1], y)):
            assert np.abs(places - middle).max() < half
            for line in (half, middle):  # lines of the floor are at multiples of a square
                assert line / cell == pytest.approx(round(line / cell), abs=1e-6)
        assert z == height
        assert points[:, 2].min() - 1.5 * cell < z < points[:, 2].min()


class TestLengths:
    """Round lengths of the floor, and how they are written."""

    @pytest.mark.parametrize(
        ("length", "expected"), [(1.0, 1.0), (0.99, 0.5), (3.7, 2.0), (74.0, 50.0), (0.0031, 0.002), (5e-9, 5e-9)]
    )
    def test_round_length_is_the_next_below(self, length: float, expected: float) -> None:
        assert scene.round_length(length) == pytest.approx(expected, rel=1e-9)

    @pytest.mark.parametrize(
        ("length", "expected"), [(0.005, "5 mm"), (0.02, "2 cm"), (0.5, "0.5 m"), (20.0, "20 m"), (2000.0, "2 km")]
    )
    def test_units_suit_the_length(self, length: float, expected: str) -> None:
        assert scene.length_text(length) == expected

    @pytest.mark.parametrize(
        ("field", "expected"), [(1.5e-5, "15 µT"), (1e-9, "1 nT"), (2e-10, "0.2 nT"), (5e-12, "5 pT"), (2e-3, "2 mT")]
    )
    def test_units_suit_the_noise(self, field: float, expected: str) -> None:
        assert texts.field_text(field) == expected


class TestArray:
    """Sensors stand where they are, turned as they are."""

    def test_places_turns_and_labels(self, server: viser.ViserServer) -> None:
        turn = Rotation.from_euler("xyz", [20.0, 30.0, 40.0], degrees=True).as_quat()
        sensors = (
            Sensor("a", "vector", (1.0, 2.0, 3.0), 1e-9, tuple(turn)),  # type: ignore[arg-type]
            Sensor("b", "scalar", (0.0, 0.0, 0.0), 1e-9),
            Sensor("c", "vector", (-1.0, 0.0, 0.0), 1e-9),
        )
        array = SensorArray(sensors)
        glyphs = scene.ArrayGlyphs(server.scene, array)
        vector, scalar = glyphs._glyphs["vector"], glyphs._glyphs["scalar"]
        assert vector.batched_positions.tolist() == [[1.0, 2.0, 3.0], [-1.0, 0.0, 0.0]]
        assert scalar.batched_positions.tolist() == [[0.0, 0.0, 0.0]]
        assert np.roll(vector.batched_wxyzs[0], -1) == pytest.approx(turn, abs=1e-6)
        assert {name: label.text for name, label in glyphs.labels.items()} == {"a": "a", "b": "b", "c": "c"}

    def test_moving_sensors_moves_glyphs_bars_and_labels(self, server: viser.ViserServer) -> None:
        glyphs = scene.ArrayGlyphs(server.scene, tetrahedron_of(1.0))
        larger = tetrahedron_of(2.0)
        before = glyphs.labels["s4"].position.copy()
        glyphs.set_array(larger)
        assert glyphs._glyphs["vector"].batched_positions == pytest.approx(larger.positions, rel=1e-6)
        assert glyphs.labels["s4"].position[2] > before[2]
        lengths = np.linalg.norm(np.diff(glyphs._edges.points, axis=1)[:, 0], axis=1)
        assert lengths == pytest.approx(2.0)

    def test_pose_moves_the_frame(self, server: viser.ViserServer) -> None:
        glyphs = scene.ArrayGlyphs(server.scene, tetrahedron_of(1.0))
        glyphs.set_pose([1.0, 2.0, 3.0], [0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)])
        assert glyphs.frame.position == pytest.approx([1.0, 2.0, 3.0])
        assert glyphs.frame.wxyz == pytest.approx([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])

    @pytest.mark.parametrize("shape", sorted(GEOMETRIES))
    @pytest.mark.parametrize("kind", ["vector", "scalar"])
    def test_every_geometry_has_a_page(self, server: viser.ViserServer, shape: str, kind: SensorKind) -> None:
        array = GEOMETRIES[shape].make(0.3, kind, 1e-9)
        page = pages.array_page(server, array, live=True)
        assert any(str(array.n_sensors) in getattr(entry, "text", "") for entry in page.entries)

    def test_a_single_sensor_can_be_seen(self, server: viser.ViserServer) -> None:
        single = SensorArray((Sensor("a", "vector", (5.0, 0.0, 0.0), 1e-9),))
        pages.array_page(server, single, live=True)
        assert server.initial_camera.look_at == pytest.approx([5.0, 0.0, 0.0])


class TestDipole:
    """The arrow stands on the source and points along the moment."""

    @pytest.mark.parametrize("moment", [(1.0, 2.0, -3.0), (0.0, 0.0, 1.0), (0.0, 0.0, -1.0), (0.0, 1e-9, -1.0)])
    def test_frame_is_turned_to_the_moment(self, server: viser.ViserServer, moment: tuple[float, ...]) -> None:
        glyph = scene.DipoleGlyph(server.scene, "/d", 1.0)
        glyph.show([1.0, 2.0, 3.0], moment)
        direction = Rotation.from_quat(np.roll(glyph.frame.wxyz, -1)).apply([0.0, 0.0, 1.0])
        assert glyph.frame.position == pytest.approx([1.0, 2.0, 3.0])
        assert direction == pytest.approx(np.array(moment) / np.linalg.norm(moment), abs=1e-9)

    def test_it_is_hidden_while_it_is_not_defined(self, server: viser.ViserServer) -> None:
        glyph = scene.DipoleGlyph(server.scene, "/d", 1.0)
        assert not glyph.frame.visible
        for position, moment, seen in (
            ([0.0, 0.0, 0.0], [0.0, 0.0, 1.0], True),
            ([0.0, 0.0, 0.0], [0.0, 0.0, 0.0], False),
            ([np.nan, 0.0, 0.0], [0.0, 0.0, 1.0], False),
            ([0.0, 0.0, 0.0], [0.0, np.inf, 1.0], False),
        ):
            glyph.show(position, moment)
            assert glyph.frame.visible is seen

    def test_one_that_is_not_wanted_stays_hidden(self, server: viser.ViserServer) -> None:
        glyph = scene.DipoleGlyph(server.scene, "/d", 1.0)
        glyph.visible = False
        glyph.show([0.0, 0.0, 0.0], [0.0, 0.0, 1.0])
        assert not glyph.frame.visible
        glyph.visible = True
        assert glyph.frame.visible


class TestSurface:
    """A surface that changes keeps its node, or is replaced."""

    def test_shapes_follow(self, server: viser.ViserServer) -> None:
        glyph = scene.SurfaceGlyph(server.scene, "/s")
        glyph.show(None)
        assert glyph.mesh is None
        glyph.show(shapes.ellipsoid([0.0, 0.0, 0.0], np.eye(3)))
        first = glyph.mesh
        glyph.show(shapes.ellipsoid([5.0, 0.0, 0.0], np.eye(3)))
        assert glyph.mesh is first
        assert first is not None
        assert first.vertices.mean(axis=0) == pytest.approx([5.0, 0.0, 0.0], abs=1e-5)
        long = shapes.range_region([5.0, 0.0, 0.0], np.eye(3), [0.0, 0.0, 0.0], (1.0, None), 20.0)
        glyph.show(long)
        assert glyph.mesh is not first
        glyph.show(None)
        assert glyph.mesh is not None
        assert not glyph.mesh.visible


class TestTrack:
    """A track is shown up to a time, with its tail and its ellipsoids."""

    POSITIONS = np.stack([np.arange(10.0), np.zeros(10), np.zeros(10)], axis=1)
    COVARIANCES = np.tile(np.diag([0.04, 0.01, 0.01]), (10, 1, 1))

    def test_tail(self, server: viser.ViserServer) -> None:
        track = track_glyph.TrackGlyph(server.scene, "/t", self.POSITIONS, self.COVARIANCES, size_m=0.1)
        assert len(track.line.points) == 9
        assert track.line.visible
        assert not track.mark.visible
        track.show_until(6, tail=2)
        assert track.line.points[:, :, 0].tolist() == [[4.0, 5.0], [5.0, 6.0]]
        assert track.mark.position == pytest.approx([6.0, 0.0, 0.0])
        assert track.regions is not None
        assert (track.regions.batched_scales.max(axis=1) > 0.0).tolist() == [False] * 4 + [True] * 3 + [False] * 3
        track.show_until(0, tail=2)
        assert not track.line.visible

    def test_ellipsoids_have_the_axes_of_the_covariance(self, server: viser.ViserServer) -> None:
        track = track_glyph.TrackGlyph(server.scene, "/t", self.POSITIONS, self.COVARIANCES, size_m=0.1)
        assert track.regions is not None
        assert np.sort(track.regions.batched_scales[0]) == pytest.approx(
            np.sqrt(7.814728 * np.array([0.01, 0.01, 0.04]))
        )

    def test_rows_that_are_not_tracked_leave_a_gap(self, server: viser.ViserServer) -> None:
        positions = self.POSITIONS.copy()
        positions[5] = np.nan
        track = track_glyph.TrackGlyph(server.scene, "/t", positions, None, size_m=0.1)
        assert len(track.line.points) == 7
        track.show_until(5, tail=5)
        assert not track.mark.visible

    def test_many_ellipsoids_are_thinned(self, server: viser.ViserServer) -> None:
        n = 1000
        track = track_glyph.TrackGlyph(server.scene, "/t", np.zeros((n, 3)), np.tile(np.eye(3), (n, 1, 1)), size_m=0.1)
        assert track.regions is not None
        assert len(track.regions.batched_positions) <= 40

    def test_first_and_last_tracked_point_have_their_times(
        self, server: viser.ViserServer, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        written: dict[str, FloatArray] = {}
        monkeypatch.setattr(pages, "add_label", lambda _, name, text, place: written.update({f"{name} {text}": place}))
        begin, end = (TrackPoint(time_s, status="not acquired") for time_s in (-1.0, 99.0))
        points = (begin, *(TrackPoint(2.0 * i, p) for i, p in enumerate(self.POSITIONS)), end)
        page = pages.track_page(server, TrackResult(points, is_truth=False), None, None)
        n = len(self.POSITIONS)
        assert list(written) == ["/times/1 0 s", f"/times/{n} {2 * (n - 1)} s"]
        for place, position in zip(written.values(), (self.POSITIONS[0], self.POSITIONS[-1]), strict=True):
            np.testing.assert_allclose(place[:2], position[:2])
            assert place[2] < position[2]
        page.close()

    def test_page_of_a_track_and_of_a_truth(self, server: viser.ViserServer) -> None:
        tracked = [
            TrackPoint(float(i), p, np.ones(3), np.eye(6), status="tracked") for i, p in enumerate(self.POSITIONS)
        ]
        points = (TrackPoint(-1.0, status="not acquired"), *tracked)
        page = pages.track_page(server, TrackResult(points, is_truth=False), tetrahedron_of(1.0), None)
        assert any("track" in getattr(entry, "text", "") for entry in page.entries)
        page.close()
        truth = TrackResult(tuple(TrackPoint(float(i), p) for i, p in enumerate(self.POSITIONS)), is_truth=True)
        page = pages.track_page(server, truth, None, None)
        assert page.title == "true path"
        page.close()


class TestMap:
    """Every point of a map is where it belongs, in its colour."""

    def test_all_points_are_one_cloud(self, server: viser.ViserServer) -> None:
        result = map_result()
        view = MapView(server, result)
        view.show_cut(False)
        assert len(view.cloud.points) == np.isfinite(result.values).sum()
        assert not view.failed.visible
        x, y, z = view.cloud.points.T.astype(np.float64)
        shares = (50.0 + x + 3.0 * y + 9.0 * z - view.limits[0]) / (view.limits[1] - view.limits[0])
        # Viridis goes from dark to light: brightness follows the value.
        order = np.argsort(shares)
        brightness = view.cloud.colors[order].astype(float) @ [0.2126, 0.7152, 0.0722]
        assert np.corrcoef(np.arange(len(order)), brightness)[0, 1] > 0.95

    def test_cut_leaves_the_points_behind_the_slice(self, server: viser.ViserServer) -> None:
        view = MapView(server, map_result())
        view.show_slice(1, 2.0)
        assert view.cloud.points[:, 1].min() == 2.0
        assert len(view.cloud.colors) == len(view.cloud.points)

    @pytest.mark.parametrize("axis", [0, 1, 2])
    def test_pixels_of_a_slice_have_the_colours_of_the_points_there(self, server: viser.ViserServer, axis: int) -> None:
        result = map_result()
        view = MapView(server, result)
        view.show_slice(axis, -1.0)
        handle, picture = view.slices[axis], view._picture(axis)
        assert handle.position[axis] == -1.0
        rows, columns = np.meshgrid(np.arange(len(picture)), np.arange(picture.shape[1]), indexing="ij")
        # viser: x of a picture goes right, y down, from its middle.
        right = ((columns + 0.5) / picture.shape[1] - 0.5) * handle.render_width
        down = ((rows + 0.5) / len(picture) - 0.5) * handle.render_height
        local = np.stack([right, down, np.zeros_like(right)], axis=-1)
        places = Rotation.from_quat(np.roll(handle.wxyz, -1)).apply(local.reshape(-1, 3)) + handle.position
        nearest = np.abs(places[:, :, None] - result.axis_m).argmin(axis=-1)
        assert (picture.reshape(-1, 4) == view._colour_cube[tuple(nearest.T)]).all()

    def test_surface_follows_the_level(self, server: viser.ViserServer) -> None:
        view = MapView(server, map_result())
        view.surface.visible = True
        view.show_level(45.0)
        assert view.surface.mesh is not None
        x, y, z = view.surface.mesh.vertices.T.astype(np.float64)
        inside = np.abs(np.array([x, y, z])).max(axis=0) < 3.9
        assert (x + 3.0 * y + 9.0 * z)[inside] == pytest.approx(-5.0, abs=1.0)

    def test_sliders_and_switches(self, server: viser.ViserServer) -> None:
        view = MapView(server, map_result())
        controls = MapControls(server, view)
        set_value(controls.places[1], 2.0)
        wait_for(lambda: view.cloud.points[:, 1].min() == 2.0)
        set_value(controls.places[0], 3.0)
        wait_for(lambda: view.slices[0].visible and view.slices[0].position[0] == 3.0)
        set_value(controls.level, 45.0)
        wait_for(lambda: view.surface.mesh is not None and bool(view.surface.mesh.visible))
        assert controls.surface.value
        assert view.level == 45.0
        set_value(controls.surface, False)
        wait_for(lambda: view.surface.mesh is not None and not view.surface.mesh.visible)
        set_value(controls.points, False)
        set_value(controls.cut, False)
        wait_for(lambda: not view.cloud.visible and len(view.cloud.points) == 9**3 - 4**3)

    def test_levels_of_a_logarithmic_map_are_logarithms(self, server: viser.ViserServer) -> None:
        linear = map_result()
        result = MapResult(**{**vars(linear), "values": linear.values + 50.0, "logarithmic": True})
        view = MapView(server, result)
        controls = MapControls(server, view)
        set_value(controls.level, 2.0)
        wait_for(lambda: view.level == pytest.approx(100.0))

    def test_page_has_units_and_a_scale(self, server: viser.ViserServer) -> None:
        page = pages.map_page(server, map_result())
        scale = page.entries[0]
        assert isinstance(scale, ColourScale)
        assert "passes" in scale.text
        assert any("100 A·m²" in getattr(entry, "text", "") for entry in page.entries)
        assert any(re.search(r"floor: \S+ (m|cm|mm)$", note) for note in page.notes)

    def test_a_map_without_a_value_can_be_seen(self, server: viser.ViserServer) -> None:
        result = map_result()
        nothing = MapResult(**{**vars(result), "values": np.full_like(result.values, np.nan)})
        pages.map_page(server, nothing)


class TestFixes:
    """The row that is chosen is the one that is seen."""

    def view(self, server: viser.ViserServer, fixes: list[Fix]) -> FixView:
        times, centroids = np.arange(len(fixes), dtype=float), np.zeros((len(fixes), 3))
        return FixView(server, times, fixes, centroids, size_m=0.3, reach_m=0.5, dot_m=0.01)

    def test_rows(self, server: viser.ViserServer) -> None:
        near, far = np.array([5.0, 0.0, 0.0]), np.array([0.0, 9.0, 0.0])
        fixes = [
            Fix((), "no signal"),
            Fix((solution(near),)),
            Fix((solution(far, observable=False), solution(near))),
        ]
        view = self.view(server, fixes)
        assert view.row == 2  # nine metres with the same σ
        assert view.best.frame.position == pytest.approx(far)
        assert view.others[0].frame.visible
        assert "not observable" in view.html()
        assert view.region.mesh is not None
        assert np.linalg.norm(view.region.mesh.vertices, axis=1).max() == pytest.approx(2.5 * 9.0, rel=1e-5)
        view.show_row(1)
        assert view.best.frame.position == pytest.approx(near)
        assert not view.others[0].frame.visible
        assert np.linalg.norm(view.region.mesh.vertices - near, axis=1).max() < 1.5
        view.show_row(0)
        assert not view.best.frame.visible
        assert not view.region.mesh.visible
        assert "no signal" in view.html()

    def test_slider(self, server: viser.ViserServer) -> None:
        fixes = [Fix((solution(np.array([x, 0.0, 0.0])),)) for x in (5.0, 6.0, 7.0)]
        view = self.view(server, fixes)
        rows: list[int] = []
        view.add_controls([rows.append])
        set_value(view.slider, 1)
        wait_for(lambda: rows == [1])
        assert view.best.frame.position == pytest.approx([6.0, 0.0, 0.0])

    def test_no_fix_at_all(self, server: viser.ViserServer) -> None:
        view = self.view(server, [Fix((), "no <signal>")] * 3)
        assert "no &lt;signal&gt;" in view.html()

    def test_page_of_an_array_that_moves(self, server: viser.ViserServer) -> None:
        array = tetrahedron_of(1.0)
        pose = np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0]])
        turn = Rotation.identity(2)
        rows = Readings(np.zeros((2, 12)), array_position_m=pose, array_rotation=turn)
        fixes = [Fix((solution(np.array([5.0, 0.0, 0.0])),)), Fix((solution(np.array([15.0, 0.0, 0.0])),))]
        page = pages.readings_page(server, array, fixes, rows)
        assert any("95 %" in getattr(entry, "text", "") for entry in page.entries)


class TestLegend:
    """The legend says what the colours mean, and shows any text as it is."""

    def test_texts_are_escaped(self) -> None:
        html = legend_html([Swatch((1, 2, 3), "a < b & c")], ["<script>"])
        assert "a &lt; b &amp; c" in html
        assert "<script>" not in html
        assert "rgb(1,2,3)" in html

    def test_scale_has_its_ends(self) -> None:
        html = legend_html([ColourScale("passes", "17", "57", ((0, 0, 0), (9, 9, 9)))])
        assert html.index("17") < html.index("57")
        assert "linear-gradient(to right,rgb(0,0,0),rgb(9,9,9))" in html

    def test_static_page_carries_it(self) -> None:
        page = with_legend("<html><body><p></p></body></html>", "A & B", [Swatch((1, 2, 3), "sensors")])
        assert page.endswith("</body></html>")
        assert "A &amp; B" in page


class TestSpeed:
    """Scenes are made of arrays: more points make next to no interpreted calls more."""

    def test_map(self, server: viser.ViserServer) -> None:
        few, many = (self.calls_of_map(server, map_result(n)) for n in (11, 41))
        assert all(large < 1.1 * small for small, large in zip(few, many, strict=True))

    @staticmethod
    def calls_of_map(server: viser.ViserServer, result: MapResult) -> list[int]:
        page = calls_of(lambda: pages.map_page(server, result))
        view = MapView(server, result)
        view.surface.visible = True
        level = calls_of(lambda: view.show_level(55.0))
        return [page, level, *(calls_of(lambda axis=axis: view.show_slice(axis, 1.0)) for axis in (0, 1))]

    def test_fix_and_track(self, server: viser.ViserServer) -> None:
        fix = Fix((solution(np.array([5.0, 0.0, 0.0]), observable=False),))
        views = (TestFixes().view(server, [fix] * n) for n in (5, 50))
        few, many = (calls_of(lambda view=view: view.show_row(3)) for view in views)
        assert many == few
        short, long = (self.track(server, n) for n in (20, 2000))
        assert calls_of(lambda: long.show_until(1500, 1500)) == calls_of(lambda: short.show_until(15, 15))

    @staticmethod
    def track(server: viser.ViserServer, n: int) -> track_glyph.TrackGlyph:
        positions = np.cumsum(np.random.default_rng(2).normal(size=(n, 3)), axis=0)
        return track_glyph.TrackGlyph(server.scene, f"/t{n}", positions, np.tile(np.eye(3), (n, 1, 1)), size_m=0.1)
