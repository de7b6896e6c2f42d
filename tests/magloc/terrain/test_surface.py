"""Terrain as a surface: interpolation, depths, parts of it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import magloc
from arrays.typing import FloatArray
from magloc.terrain.surface import FLAT


def hills(xy_m: FloatArray) -> FloatArray:
    """Smooth heights of 2 m relief."""
    return np.asarray(30.0 + 0.6 * np.sin(xy_m[..., 0] / 3.0) + 0.4 * np.cos(xy_m[..., 1] / 2.5))


def nodes(step_m: float = 1.0) -> FloatArray:
    axis = np.arange(-12.0, 12.0 + step_m / 2.0, step_m)
    return np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)


@pytest.fixture(scope="module")
def terrain() -> magloc.Terrain:
    """The hills, known at points of a grid of a metre."""
    return magloc.Terrain.from_points(np.column_stack([nodes(), hills(nodes())]))


@pytest.fixture(scope="module")
def places() -> FloatArray:
    """Places above and below the hills."""
    return np.random.default_rng(0).uniform([-9.0, -9.0, 28.0], [9.0, 9.0, 33.0], (500, 3))


class TestTerrain:
    def test_heights_between_points(self, terrain: magloc.Terrain, places: FloatArray) -> None:
        np.testing.assert_allclose(terrain.height_at(places[:, :2]), hills(places[:, :2]), atol=4e-3)

    def test_a_plane_is_exact(self, places: FloatArray) -> None:
        heights = nodes() @ [0.1, -0.2] + 5.0
        plane = magloc.Terrain.from_points(np.column_stack([nodes(), heights]))
        np.testing.assert_allclose(plane.height_at(places[:, :2]), places[:, :2] @ [0.1, -0.2] + 5.0, atol=1e-5)
        np.testing.assert_allclose(plane.slope_at(places[:, :2]), np.tile([0.1, -0.2], (500, 1)), atol=1e-5)

    def test_slope(self, terrain: magloc.Terrain, places: FloatArray) -> None:
        x, y = places[:, :2].T
        slope = np.stack([0.2 * np.cos(x / 3.0), -0.16 * np.sin(y / 2.5)], axis=-1)
        np.testing.assert_allclose(terrain.slope_at(places[:, :2]), slope, atol=0.02)

    def test_flatten(self, terrain: magloc.Terrain, places: FloatArray) -> None:
        flat = terrain.flatten(places)
        np.testing.assert_allclose(terrain.height_m - flat[:, 2], terrain.depth_of(places))
        np.testing.assert_allclose(terrain.depth_of(places), hills(places[:, :2]) - places[:, 2], atol=4e-3)
        np.testing.assert_allclose(terrain.drape(flat), places, rtol=0.0, atol=1e-12)

    def test_beyond_its_edge_it_goes_on(self, terrain: magloc.Terrain) -> None:
        edge, beyond = terrain.height_at(np.array([[12.0, 3.0], [40.0, 3.0]]))
        assert beyond == pytest.approx(edge, abs=1e-9)

    def test_a_part(self, terrain: magloc.Terrain, places: FloatArray) -> None:
        part = terrain.crop(np.array([-11.0, -11.0]), np.array([11.0, 11.0]))
        assert part.relief_m is not None
        assert terrain.relief_m is not None
        assert part.relief_m.size < terrain.relief_m.size
        np.testing.assert_allclose(part.height_at(places[:, :2]), terrain.height_at(places[:, :2]), atol=1e-4)

    def test_heights_above_ground(self, terrain: magloc.Terrain, places: FloatArray) -> None:
        above = np.column_stack([places[:, :2], np.full(500, 1.5)])
        turn = Rotation.from_quat(np.tile([0.0, 0.0, 0.0, 1.0], (500, 1)))
        readings = magloc.Readings(np.zeros((500, 1)), array_position_m=above, array_rotation=turn)
        lifted = terrain.place_above(readings).array_position_m
        assert lifted is not None
        np.testing.assert_allclose(lifted[:, 2], hills(places[:, :2]) + 1.5, atol=4e-3)

    def test_flat_ground_changes_nothing(self, places: FloatArray) -> None:
        """To the last bit: results on flat ground do not depend on this class."""
        assert FLAT.flatten(places) is places
        assert FLAT.drape(places) is places
        assert (magloc.Terrain(-7.3).depth_of(places) == -7.3 - places[:, 2]).all()
        assert not FLAT.slope_at(places[:, :2]).any()

    @pytest.mark.parametrize("sigma_m", [-0.1, np.nan, np.inf])
    def test_an_impossible_sigma_is_refused(self, sigma_m: float) -> None:
        with pytest.raises(ValueError, match="Input sigma_m must be zero or a positive number"):
            magloc.Terrain(sigma_m=sigma_m)

    @pytest.mark.parametrize("number", [2, 5])
    def test_points_on_a_line_are_refused(self, number: int) -> None:
        line = np.outer(np.arange(float(number)), [1.0, 2.0, 0.1])
        with pytest.raises(ValueError, match="cover an area"):
            magloc.Terrain.from_points(line)
