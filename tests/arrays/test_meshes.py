"""Meshes of arrays: as many glyphs as sensors, at their places, turned as they are, in proportion."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation

from arrays.array import SensorArray
from arrays.geometries import GEOMETRIES, cube, tetrahedron
from arrays.meshes import AXIS_COLOURS, glyph_size, mesh_of, sensor_mesh
from arrays.sensor import Sensor

BODIES = {"vector": 4, "scalar": 1}  # a cube and three rods, or a sphere


class TestGlyph:
    """One sensor."""

    @given(st.integers(0, 2**32 - 1))
    def test_rods_point_along_the_sensors_axes(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        rotation = Rotation.random(rng=rng)
        position = rng.normal(size=3)
        mesh = sensor_mesh(Sensor("s1", "vector", position, 1e-9, rotation.as_quat()), 0.2)
        for colour, axis in zip(AXIS_COLOURS, np.eye(3), strict=True):
            faces = mesh.faces[(mesh.visual.face_colors == colour).all(axis=1)]
            rod = mesh.vertices[np.unique(faces)]
            assert_allclose(rod.mean(axis=0), position + 0.1 * rotation.apply(axis), atol=1e-12)
            reach = (rod - position) @ rotation.apply(axis)
            assert_allclose([reach.min(), reach.max()], [0.0, 0.2], atol=1e-12)

    def test_bounds_of_a_vector_sensor(self) -> None:
        mesh = sensor_mesh(Sensor("s1", "vector", (1.0, 2.0, 3.0), 1e-9), 0.5)
        assert_allclose(mesh.bounds[1], [1.5, 2.5, 3.5], rtol=1e-12)
        assert_allclose(mesh.bounds[0], [0.85, 1.85, 2.85], rtol=1e-12)

    def test_bounds_of_a_scalar_sensor(self) -> None:
        mesh = sensor_mesh(Sensor("s1", "scalar", (1.0, 2.0, 3.0), 1e-9), 0.5)
        assert_allclose(mesh.bounds, [[0.8, 1.8, 2.8], [1.2, 2.2, 3.2]], rtol=1e-12)

    @pytest.mark.parametrize("size", [0.0, -1.0, np.nan, np.inf])
    def test_bad_size(self, size: float) -> None:
        with pytest.raises(ValueError, match="Input size_m must be a positive finite number; instead received"):
            sensor_mesh(Sensor("s1", "vector", (0, 0, 0), 1e-9), size)


class TestSize:
    """Glyphs are in proportion to the array."""

    @pytest.mark.parametrize("edge", [0.03, 1.5, 30.0])
    def test_proportion(self, edge: float) -> None:
        assert_allclose(mesh_of(tetrahedron(edge)).bounds, edge * mesh_of(tetrahedron(1.0)).bounds, rtol=1e-12)

    @pytest.mark.parametrize("name", GEOMETRIES)
    def test_glyphs_do_not_touch(self, name: str) -> None:
        array = GEOMETRIES[name].make(1.0)
        assert 2.0 * glyph_size(array) < pdist(array.positions).min()

    def test_sensors_in_one_place_do_not_count(self) -> None:
        stacked = Sensor("m", "scalar", (0.0, 0.0, 1.0), 1e-9)
        pair = (Sensor("a", "vector", (0.0, 0.0, 0.0), 1e-9), Sensor("b", "vector", (0.0, 0.0, 1.0), 1e-9))
        assert glyph_size(SensorArray((*pair, stacked))) == glyph_size(SensorArray(pair)) > 0.0


class TestArray:
    """All sensors together."""

    @pytest.mark.parametrize("kind", ["vector", "scalar"])
    @pytest.mark.parametrize("edge", [0.03, 30.0])
    def test_mesh_is_watertight(self, kind: str, edge: float) -> None:
        mesh = mesh_of(cube(edge, kind))
        assert mesh.is_watertight
        assert mesh.is_winding_consistent
        assert mesh.volume > 0.0
        assert mesh.body_count == 8 * BODIES[kind]

    def test_mesh_has_every_sensor_in_its_place(self) -> None:
        array = SensorArray(
            (
                Sensor("a", "vector", (0.0, 0.0, 0.0), 1e-9),
                Sensor("b", "scalar", (0.0, 1.0, 0.0), 1e-9),
                Sensor("c", "vector", (0.0, 0.0, 2.0), 1e-9, (0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5))),
            )
        )
        mesh = mesh_of(array, 0.1)
        parts = [sensor_mesh(sensor, 0.1) for sensor in array.sensors]
        assert mesh.body_count == sum(BODIES[sensor.kind] for sensor in array.sensors)
        assert_allclose(mesh.volume, sum(part.volume for part in parts), rtol=1e-12)
        assert_array_equal(
            mesh.bounds, [np.min([b.bounds[0] for b in parts], 0), np.max([b.bounds[1] for b in parts], 0)]
        )
