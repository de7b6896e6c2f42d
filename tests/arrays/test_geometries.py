"""Named geometries: distances, orientation and order as they are documented."""

from __future__ import annotations

import inspect

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.distance import pdist, squareform

from arrays.geometries import GEOMETRIES, axial, cross, cube, grid, hexagon, square, tetrahedron

NAMES = list(GEOMETRIES)


@pytest.mark.parametrize("name", NAMES)
class TestAll:
    """What every geometry keeps."""

    def test_centred(self, name: str) -> None:
        assert_allclose(GEOMETRIES[name].make(2.0).centroid, 0.0, atol=1e-15)

    @given(exponent=st.floats(-3, 3))
    def test_scales(self, name: str, exponent: float) -> None:
        size = 10.0**exponent
        unit = GEOMETRIES[name].make(1.0).positions
        assert_allclose(GEOMETRIES[name].make(size).positions, size * unit, rtol=1e-15, atol=0.0)

    @pytest.mark.parametrize("kind", ["vector", "scalar"])
    def test_sensors(self, name: str, kind: str) -> None:
        array = GEOMETRIES[name].make(1.0, kind, 3e-9)
        assert array.name == name
        assert array.ids == tuple(f"s{i}" for i in range(1, array.n_sensors + 1))
        assert {sensor.kind for sensor in array.sensors} == {kind}
        assert {sensor.noise_T for sensor in array.sensors} == {3e-9}
        assert_array_equal(array.rotation_matrices, np.tile(np.eye(3), (array.n_sensors, 1, 1)))

    def test_size_key(self, name: str) -> None:
        make, size_key = GEOMETRIES[name]
        assert next(iter(inspect.signature(make).parameters)) == size_key
        assert size_key in (make.__doc__ or "")
        assert make.__name__ == name

    @pytest.mark.parametrize("size", [0.0, -1.0, np.nan, np.inf, [1.0]])
    def test_bad_size(self, name: str, size: float) -> None:
        make, size_key = GEOMETRIES[name]
        with pytest.raises(ValueError, match=f"Input {size_key} must be a positive finite number; instead received"):
            make(size)


class TestTetrahedron:
    """Edges equal, base below and parallel to the x-y plane, apex up and last."""

    def test_edges(self) -> None:
        assert_allclose(pdist(tetrahedron(1.5).positions), 1.5, rtol=1e-15)

    def test_orientation(self) -> None:
        positions = tetrahedron(1.5).positions
        # The spec's figure: the base of an edge of 1.5 m lies 0.306 m from the centroid, the apex at 0.918 m.
        assert_allclose(positions[:3, 2], -0.306, atol=5e-4)
        assert_allclose(positions[3], [0.0, 0.0, 0.9186], atol=5e-5)
        assert positions[0, 0] > 0.0
        assert positions[0, 1] == 0.0
        assert positions[1, 1] > 0.0


class TestPlanar:
    """Shapes in the x-y plane, counter-clockwise."""

    @pytest.mark.parametrize("array", [square(1.5), cross(1.5), hexagon(1.5)], ids=["square", "cross", "hexagon"])
    def test_regular_and_counter_clockwise(self, array: object) -> None:
        x, y, z = array.positions.T
        angle = np.unwrap(np.arctan2(y, x))
        assert_array_equal(z, 0.0)
        assert_allclose(np.hypot(x, y), array.circumradius, rtol=1e-15)
        assert_allclose(np.diff(angle), 2 * np.pi / array.n_sensors, rtol=1e-14)

    def test_square(self) -> None:
        array = square(1.5)
        assert_allclose(np.sort(pdist(array.positions)), [1.5] * 4 + [1.5 * np.sqrt(2)] * 2, rtol=1e-15)
        assert_array_equal(array.positions[0], [0.75, 0.75, 0.0])

    def test_cross(self) -> None:
        assert_array_equal(cross(1.5).positions[:2], [[1.5, 0, 0], [0, 1.5, 0]])
        assert cross(1.5).circumradius == 1.5

    def test_hexagon(self) -> None:
        array = hexagon(1.5)
        neighbours = np.diag(squareform(pdist(array.positions)), k=1)
        assert_allclose(neighbours, 1.5, rtol=1e-15)
        assert_array_equal(array.positions[0], [1.5, 0.0, 0.0])


class TestSolidAndAxial:
    """The cube's corners, and the pair along z."""

    def test_cube(self) -> None:
        positions = cube(1.5).positions
        assert_allclose(np.sort(pdist(positions)), 1.5 * np.sqrt([1] * 12 + [2] * 12 + [3] * 4), rtol=1e-15)
        assert_array_equal(np.abs(positions), 0.75)
        assert_array_equal(positions[0], [-0.75, -0.75, -0.75])
        assert_array_equal(positions[1] - positions[0], [0.0, 0.0, 1.5])

    def test_axial(self) -> None:
        assert_array_equal(axial(1.5).positions, [[0, 0, 0.75], [0, 0, -0.75]])


class TestGrid:
    def test_stands_flat_and_centred_with_equal_spacing(self):
        board = grid(3, 2, 0.04, noise_T=2e-9)
        assert board.n_sensors == 6
        assert_allclose(board.centroid, 0.0, atol=1e-15)
        assert_allclose(board.positions[:3], [[-0.04, -0.02, 0.0], [0.0, -0.02, 0.0], [0.04, -0.02, 0.0]])
        assert_allclose(board.positions[3:, 1], 0.02)
        assert {sensor.noise_T for sensor in board.sensors} == {2e-9}

    def test_bad_input(self):
        with pytest.raises(ValueError, match="nx and ny must be at least 1"):
            grid(1, 1, 0.1)
        with pytest.raises(ValueError, match="Input pitch_m must be a positive finite number"):
            grid(2, 2, 0.0)
