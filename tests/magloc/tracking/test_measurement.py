"""What a row measures of a source in the world: its derivatives, by scipy.differentiate."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from arrays import geometries
from arrays.array import SensorArray
from magloc.tracking.measurement import RowMeasurement
from magloc.tracking.motion import RandomWalk
from magloc.tracking.results import Row
from magloc.tracking.tracker import Tracker
from tests.oracles import derivative

FloatArray = NDArray[np.float64]
ARRAY = geometries.tetrahedron(1.5, "vector", 2e-10)
SOURCE = np.array([3.0, 1.5, 0.8, 120.0, -150.0, 160.0])
UNIT = np.repeat([1.0, 100.0], 3)
REST = RandomWalk(1e-9, 1e-9)


def measurement_of(readings_T: FloatArray, array: SensorArray = ARRAY) -> RowMeasurement:
    """In a world where the array is turned and elsewhere."""
    R = Rotation.from_rotvec([0.3, -0.8, 0.5]).as_matrix()
    return Tracker(array, REST).measurements.of(Row(0.0, readings_T, np.array([0.5, -0.2, 0.1]), R))


@pytest.fixture
def measurement() -> RowMeasurement:
    return measurement_of(np.zeros(12))


class TestDerivatives:
    """To 1e-6 of the largest entry in a column, in units of a metre and 100 A·m²."""

    def agree(self, J: FloatArray, expected: FloatArray) -> None:
        scale = np.abs(expected).max(axis=0)
        np.testing.assert_allclose(J / scale, expected / scale, atol=1e-6)

    def test_of_the_readings(self, measurement: RowMeasurement) -> None:
        expected = derivative(
            lambda y: np.apply_along_axis(lambda x: measurement.of_source(x * UNIT), -1, y), SOURCE / UNIT, 1e-2
        )
        self.agree(measurement.source_jacobian(SOURCE) * UNIT, expected)
