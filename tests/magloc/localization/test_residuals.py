"""What fixes leave of the readings. Oracles: the χ² of the fixes, which another route computes; magpylib's fields."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from arrays.array import SensorArray
from arrays.geometries import tetrahedron
from arrays.sensor import Sensor
from magloc.localization.fit.results import Fix
from magloc.localization.residuals import fix_residuals
from tests.oracles import magpylib_field
from tests.plain_locator import columns_of, plain_locator

NOISE_T = 1e-10
ARRAY = tetrahedron(1.5, noise_T=NOISE_T)
SOURCES = np.array([[3.0, 1.0, 0.5], [-2.0, 2.5, 1.0]])
MOMENTS = np.array([[60.0, 50.0, 60.0], [-20.0, 70.0, 10.0]])
AMBIENT_T = np.array([2e-5, -1e-6, 4.3e-5])


def readings(array: SensorArray, n: int, sources: int = 1) -> np.ndarray:
    """Noisy readings in an ambient field that changes from row to row."""
    rng = np.random.default_rng(5)
    fields = sum(magpylib_field(array.positions, SOURCES[k], MOMENTS[k]) for k in range(sources))
    ambient = AMBIENT_T + (0.0 if array.channel_is_scalar.any() else 1e-6 * rng.normal(size=(n, 1, 3)))
    exact = array.readings_of(np.broadcast_to(fields + ambient, (n, array.n_sensors, 3)))
    return exact + array.channel_noise_T * rng.normal(size=exact.shape)


def assert_squares_are_chi2(residuals: np.ndarray, fixes: list, rtol: float = 1e-4) -> None:
    np.testing.assert_allclose(np.nansum(residuals**2, axis=1), [fix.solutions[0].chi2 for fix in fixes], rtol=rtol)


class TestSquares:
    def test_of_vector_sensors(self) -> None:
        rows = readings(ARRAY, 10)
        fixes = plain_locator(ARRAY).fit_rows(rows)
        assert_squares_are_chi2(fix_residuals(ARRAY, rows, fixes), fixes)

    def test_of_missing_readings(self) -> None:
        rows = readings(ARRAY, 3)
        rows[1, 4] = np.nan
        fixes = plain_locator(ARRAY).fit_rows(rows)
        residuals = fix_residuals(ARRAY, rows, fixes)
        np.testing.assert_array_equal(np.isnan(residuals), np.isnan(rows))
        assert_squares_are_chi2(residuals, fixes)

    def test_of_unequal_and_proportional_noise(self) -> None:
        sensors = tuple(replace(s, noise_T=NOISE_T * (1 + i)) for i, s in enumerate(ARRAY.sensors))
        array = replace(ARRAY, sensors=sensors, noise_fraction=1e-5)
        rows = readings(array, 5)
        fixes = plain_locator(array).fit_rows(rows)
        assert_squares_are_chi2(fix_residuals(array, rows, fixes), fixes)

    def test_of_two_sources(self) -> None:
        places = np.random.default_rng(0).uniform(-1.5, 1.5, (9, 3))
        array = SensorArray(
            tuple(Sensor(f"s{i}", "vector", tuple(place.tolist()), NOISE_T) for i, place in enumerate(places))
        )
        rows = readings(array, 2, sources=2)
        fixes = plain_locator(array, sources=2).fit_rows(rows)
        assert len(fixes[0].solutions[0].sources) == 2
        assert_squares_are_chi2(fix_residuals(array, rows, fixes), fixes)

    def test_of_scalar_sensors_in_an_ambient_field_of_every_row(self) -> None:
        places = np.random.default_rng(1).uniform(-1.5, 1.5, (12, 3))
        array = SensorArray(
            tuple(Sensor(f"s{i}", "scalar", tuple(place.tolist()), NOISE_T) for i, place in enumerate(places)),
            ambient_T=(1e-5, 1e-5, 1e-5),
        )
        rows, ambient = readings(array, 2), np.tile(AMBIENT_T, (2, 1))
        fixes = plain_locator(array).fit_rows(rows, ambient)
        assert_squares_are_chi2(fix_residuals(array, rows, fixes, ambient), fixes)


class TestRows:
    def test_a_row_without_a_solution_has_none(self) -> None:
        assert np.isnan(fix_residuals(ARRAY, readings(ARRAY, 1), columns_of([Fix((), "no signal")]))).all()

    def test_a_dropped_sensor_has_none(self) -> None:
        rows = readings(ARRAY, 1)
        (fix,) = plain_locator(ARRAY).fit_rows(rows)
        name = ARRAY.ids[1]
        residuals = fix_residuals(ARRAY, rows, columns_of([replace(fix, dropped_sensors=(name,))]))
        np.testing.assert_array_equal(np.isnan(residuals[0]), ARRAY.channel_sensor == 1)

    def test_refuses_other_shapes(self) -> None:
        with pytest.raises(ValueError, match="readings_T must have shape"):
            fix_residuals(ARRAY, np.zeros((1, 5)), columns_of([Fix(())]))
