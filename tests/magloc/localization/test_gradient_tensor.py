"""The dipole of a gradient tensor.

| what | who checks it |
|---|---|
| least squares of field and tensor | fields that are linear in space |
| closed form | field and gradient of magloc.fields.dipole |
| what it costs | the power of edge over distance, and a fit of the differences to the same readings |
"""

from __future__ import annotations

import numpy as np
import pytest

import arrays
import magloc
from arrays.typing import FloatArray
from tests.arrays.test_differences import random_array

N = 300


def directions(seed: int) -> FloatArray:
    v = np.random.default_rng(seed).standard_normal((N, 3))
    return np.asarray(v / np.linalg.norm(v, axis=1, keepdims=True))


def of_dipoles(array: arrays.SensorArray, distance_m: float) -> tuple[FloatArray, FloatArray]:
    """Positions and readings of sources of 250 A·m² in all directions."""
    p, m = distance_m * directions(0) + array.centroid, 250.0 * directions(1)
    return p, array.readings_of(magloc.dipole.field(array.positions, p[:, None], m[:, None]))


def median_error(array: arrays.SensorArray, distance_m: float) -> float:
    """Of the position, over the distance."""
    p, readings = of_dipoles(array, distance_m)
    found = magloc.fit_gradient_tensor(array, readings).position_m
    return float(np.median(np.linalg.norm(found - p, axis=1)) / distance_m)


class TestLeastSquares:
    @pytest.mark.parametrize("array", [arrays.square(2.0), random_array(0, 6)], ids=["plane", "any"])
    def test_a_linear_field_is_found(self, array: arrays.SensorArray) -> None:
        rng = np.random.default_rng(0)
        B, G = rng.standard_normal((4, 3)), rng.standard_normal((4, 3, 3))
        G = G + np.swapaxes(G, -1, -2)
        G -= np.trace(G, axis1=-2, axis2=-1)[:, None, None] / 3.0 * np.eye(3)
        fields = B[:, None] + np.einsum("rij,nj->rni", G, array.positions - array.centroid) + array.ambient_fields
        found = magloc.fit_gradient_tensor(array, array.readings_of(fields))
        np.testing.assert_allclose(found.field_T, B, rtol=0, atol=1e-9)
        np.testing.assert_allclose(found.tensor_T_m, G, rtol=0, atol=1e-9)

    def test_a_sensor_without_weight_does_not_count(self) -> None:
        quiet = arrays.cube(1.0).sensors
        wild = arrays.Sensor("wild", "vector", (0.1, 0.2, 0.3), noise_T=1.0)
        array = arrays.SensorArray((*quiet, wild))
        _, readings = of_dipoles(array, 5.0)
        readings[:, -3:] += 1e-3
        alone = magloc.fit_gradient_tensor(array.subset(array.ids[:-1]), readings[:, :-3])
        tensor = magloc.fit_gradient_tensor(array, readings).tensor_T_m
        np.testing.assert_allclose(tensor, alone.tensor_T_m, rtol=1e-3, atol=2e-11)

    def test_a_missing_reading_is_nan_in_its_row_alone(self) -> None:
        array = arrays.tetrahedron(1.0)
        _, readings = of_dipoles(array, 5.0)
        readings[1, 4] = np.nan
        rows = np.isnan(magloc.fit_gradient_tensor(array, readings).position_m).all(axis=1)
        assert np.flatnonzero(rows).tolist() == [1]

    @pytest.mark.parametrize(
        ("array", "words"),
        [(arrays.axial(1.0), "in one line"), (arrays.tetrahedron(1.0, "scalar"), "vector sensors only")],
    )
    def test_arrays_that_cannot(self, array: arrays.SensorArray, words: str) -> None:
        with pytest.raises(ValueError, match=words):
            magloc.fit_gradient_tensor(array, np.zeros(array.n_channels))


class TestClosedForm:
    def test_exact_where_the_tensor_is(self) -> None:
        here, p, m = np.array([0.3, -0.2, 0.5]), 5.0 * directions(0), 100.0 * directions(1)
        fields = magloc.dipole.field(here, p, m), magloc.dipole.gradient_tensor(here, p, m)
        found = magloc.GradientTensor(here, *fields)
        # How much rounding grows: the tensor has no inverse where the moment is across the line.
        d = here - p
        along = np.abs(np.sum(d * m, axis=1)) / np.linalg.norm(d, axis=1) / 100.0
        assert np.max(np.linalg.norm(found.position_m - p, axis=1) * along) < 1e-12
        assert np.max(np.linalg.norm(found.moment_Am2 - m, axis=1) * along) < 1e-10

    def test_a_moment_across_the_line_is_no_error(self) -> None:
        here, p, m = np.zeros(3), [2.0, 0.0, 0.0], [0.0, 1.0, 0.0]
        found = magloc.GradientTensor(here, magloc.dipole.field(here, p, m), magloc.dipole.gradient_tensor(here, p, m))
        assert not np.isfinite(found.position_m).all()


class TestWhatItCosts:
    @pytest.mark.parametrize(
        ("array", "power"), [(arrays.tetrahedron(1.0), 1.0), (arrays.cube(1.0), 2.0), (arrays.cross(0.5), 2.0)]
    )
    def test_its_error_is_a_power_of_edge_over_distance(self, array: arrays.SensorArray, power: float) -> None:
        """Medians of 300 sources each: their ratio scatters by 2 or 3 in a hundred."""
        ratio = median_error(array, 20.0) / median_error(array, 40.0)
        assert np.log2(ratio) == pytest.approx(power, abs=0.25)

    def test_the_differences_have_none(self) -> None:
        array = arrays.tetrahedron(1.0)
        p, readings = of_dipoles(array, 5.0)
        for fix, truth in zip(magloc.locate(array, readings), p, strict=True):
            nearest = min(fix.solutions, key=lambda solution: solution.chi2)
            assert np.linalg.norm(nearest.position_m - truth) < 1e-4
        assert median_error(array, 5.0) > 0.05
