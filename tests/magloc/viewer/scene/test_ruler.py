"""Axes whose numbers stand where they say, and lines that drop to the floor."""

from __future__ import annotations

import numpy as np
import pytest
import viser

from magloc.viewer.scene import framing
from magloc.viewer.scene.ruler import DropLines, add_ruler


class TestRuler:
    @pytest.mark.parametrize(("size", "unit", "metres"), [(0.03, "cm", 0.01), (1.5, "m", 1.0), (30_000.0, "km", 1e3)])
    def test_numbers_stand_where_they_say(
        self, server: viser.ViserServer, monkeypatch: pytest.MonkeyPatch, size: float, unit: str, metres: float
    ) -> None:
        labels: list[tuple[str, str, np.ndarray]] = []
        monkeypatch.setattr(
            server.scene, "add_label", lambda name, text, position, **_: labels.append((name, text, position))
        )
        points = size * np.random.default_rng(1).uniform(-1.0, 2.0, (20, 3))
        extent = framing.extent_of(points)
        floor = framing.set_up_scene(server, extent)
        ends = add_ruler(server.scene, extent, floor)
        for i, axis in enumerate("xyz"):
            own = [(text, place) for name, text, place in labels if name.startswith(f"/ruler/{axis}/")]
            ticks = [(float(text.removeprefix(f"{axis} = ").removesuffix(unit)), place) for text, place in own]
            assert 2 <= len(ticks) <= 6
            assert np.diff([place[i] for _, place in ticks]).min() >= 0.1 * np.ptp(ends, axis=0).max()
            for number, place in ticks:
                assert metres * number == pytest.approx(place[i], rel=1e-6, abs=1e-9 * size)
            assert [text for text, _ in own if "=" in text] == [f"{axis} = {ticks[-1][0]:g} {unit}"]
            assert ends[:, i].min() <= points[:, i].min()
            assert ends[:, i].max() >= points[:, i].max()

    def test_all_of_it_is_in_the_first_view(self, server: viser.ViserServer) -> None:
        """Its ends are among the points that the camera aims at; where it looks stays the middle of the scene."""
        extent = framing.extent_of([[0.0, 0.0, 0.0], [1.0, 2.0, 0.5]])
        ends = add_ruler(server.scene, extent, framing.set_up_scene(server, extent))
        near = np.linalg.norm(server.initial_camera.position - extent.centre_m)
        framing.aim_camera(server, extent._replace(points_m=np.vstack([extent.points_m, ends])))
        assert np.linalg.norm(server.initial_camera.position - extent.centre_m) > near
        assert server.initial_camera.look_at == pytest.approx(extent.centre_m)


class TestDropLines:
    EXTENT = framing.extent_of([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])

    def test_from_the_points_to_the_floor(self, server: viser.ViserServer) -> None:
        drop = DropLines(server.scene, "/drop")
        drop.show([[0.2, 0.3, 0.9], [np.nan, 0.0, 0.0]])
        assert not drop._lines.visible
        drop.set_floor(framing.Floor(-0.5, 0.1), self.EXTENT)
        assert drop._lines.visible
        np.testing.assert_allclose(drop._lines.points[0], [[0.2, 0.3, 0.9], [0.2, 0.3, -0.5]], rtol=1e-6)
        assert (drop._lines.points[1:, :, 2] == -0.5).all()

    def test_nothing_to_drop(self, server: viser.ViserServer) -> None:
        drop = DropLines(server.scene, "/drop")
        drop.set_floor(framing.Floor(-0.5, 0.1), self.EXTENT)
        drop.show([[0.2, 0.3, 0.9]])
        drop.show(np.zeros((0, 3)))
        assert not drop._lines.visible
