"""Averages: exact means, their noise, and what is refused."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from arrays import geometries
from arrays.array import SensorArray
from arrays.io.errors import InputError
from arrays.sensor import Sensor
from magloc.averages import average, averaging_array, window_averages, window_averaging_array
from magloc.readings import Readings


@pytest.fixture
def array() -> SensorArray:
    return SensorArray(
        (
            Sensor("s1", "vector", (0.0, 0.0, 0.0), 1e-9),
            Sensor("s2", "vector", (1.0, 0.0, 0.0), 2e-9),
            Sensor("s3", "scalar", (0.0, 1.0, 0.0), 4e-9),
        )
    )


class TestAverage:
    """The mean of all rows, and its noise."""

    @staticmethod
    def readings(values_T: list[list[float]], **columns: object) -> Readings:
        return Readings(np.array(values_T), **columns)  # type: ignore[arg-type]

    def test_rows_with_less_than_the_others_are_left_out(self) -> None:
        rows = self.readings([[1.0, math.nan, 3.0], [3.0, math.nan, math.nan], [5.0, math.nan, 4.0]])
        mean = average(rows)
        np.testing.assert_array_equal(mean.values_T, [[3.0, math.nan, 3.5]])
        np.testing.assert_array_equal(mean.time_s, [1.0])

    def test_a_common_field_that_drifts_still_cancels(self) -> None:
        drift = np.linspace(0.0, 1.0, 6)[:, None] * np.ones(4)
        values = drift + np.arange(4.0)
        values[3:, 0] = math.nan
        np.testing.assert_allclose(np.diff(average(self.readings(values.tolist())).values_T[0]), 1.0, rtol=1e-12)

    def test_no_complete_row(self) -> None:
        with pytest.raises(InputError, match="no row with all channels"):
            average(self.readings([[1.0, math.nan], [math.nan, 2.0]]))

    def test_noise_falls_with_the_root_of_the_rows(self, array: SensorArray) -> None:
        values = np.ones((5, 7))
        values[4, 2] = math.nan  # this row is left out
        values[:, 6] = math.nan  # a channel that no row has
        averaged = averaging_array(array, self.readings(values.tolist()))
        before = [sensor.noise_T for sensor in array.sensors]
        np.testing.assert_allclose([sensor.noise_T for sensor in averaged.sensors], np.divide(before, 2.0), rtol=1e-15)

    def test_errors_of_the_calibration_do_not_average_out(self, array: SensorArray) -> None:
        uncertain = replace(
            array,
            sensors=tuple(
                replace(sensor, misalignment_rad=1e-3 * (sensor.kind == "vector"), gain_uncertainty=2e-3)
                for sensor in array.sensors
            ),
            noise_fraction=0.01,
        )
        averaged = averaging_array(uncertain, self.readings([[1.0] * 7] * 4))
        assert averaged.noise_fraction == 0.005
        for before, after in zip(uncertain.sensors, averaged.sensors, strict=True):
            assert after == replace(before, noise_T=before.noise_T / 2.0)

    def test_what_is_new_in_every_row_does(self, array: SensorArray) -> None:
        first, *others = array.sensors
        stated = replace(array, sensors=(replace(first, noise_fraction=0.1), *others), ambient_uncertainty_white_T=4e-9)
        averaged = averaging_array(stated, self.readings([[1.0] * 7] * 4))
        assert averaged.noise_fractions.tolist() == [0.05, *[0.0] * len(others)]
        assert averaged.ambient_uncertainty_white_T == 2e-9

    def test_array_that_moves(self) -> None:
        position = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.1, 0.0]])
        rows = self.readings([[1.0]] * 3, array_position_m=position, array_rotation=Rotation.identity(3))
        with pytest.raises(InputError, match="array moved between rows 1 and 3"):
            average(rows)
        with pytest.raises(InputError, match="field changed between rows 1 and 2"):
            average(self.readings([[1.0]] * 2, ambient_T=[[1e-9, 0.0, 0.0], [0.0, 1e-9, 0.0]]))


class TestWindows:
    def test_are_exact_means(self) -> None:
        values = np.random.default_rng(2).normal(size=(20, 3))
        averaged = window_averages(Readings(values, time_s=0.1 * np.arange(20.0)), 0.5)
        np.testing.assert_allclose(averaged.values_T, values.reshape(4, 5, 3).mean(axis=1), rtol=1e-12)
        np.testing.assert_allclose(averaged.time_s, [0.2, 0.7, 1.2, 1.7], rtol=1e-12)

    def test_leave_out_missing_readings_and_empty_windows(self) -> None:
        t = np.array([0.0, 0.1, 0.2, 5.0, 5.1])
        values = np.array([[1.0, np.nan], [np.nan, np.nan], [3.0, np.nan], [4.0, 1.0], [6.0, np.nan]])
        averaged = window_averages(Readings(values, time_s=t), 1.0)
        np.testing.assert_array_equal(averaged.values_T, [[2.0, np.nan], [5.0, 1.0]])
        np.testing.assert_allclose(averaged.time_s, [0.1, 5.05])

    def test_keep_the_pose_of_the_middle_and_the_mean_ambient_field(self) -> None:
        n = 6
        position = np.arange(3.0 * n).reshape(n, 3)
        rotation = Rotation.random(n, rng=np.random.default_rng(5))
        readings = Readings(
            np.zeros((n, 3)), array_position_m=position, array_rotation=rotation, ambient_T=1e-6 * position
        )
        averaged = window_averages(readings, 3.0)
        np.testing.assert_array_equal(averaged.array_position_m, position[[1, 4]])
        assert averaged.array_rotation is not None
        np.testing.assert_array_equal(averaged.array_rotation.as_quat(), rotation.as_quat()[[1, 4]])
        assert averaged.ambient_T is not None
        np.testing.assert_allclose(averaged.ambient_T, 1e-6 * position[[1, 4]], rtol=1e-12)

    def test_noise_of_the_averages(self) -> None:
        """White noise falls with the root of the window's rows: 2,000 windows of 4, false-alarm rate 1e-4."""
        array = SensorArray(
            tuple(
                Sensor(f"s{i}", kind="vector", position_m=(float(i), 0.0, 0.0), noise_T=1e-9 * (i + 1))
                for i in range(3)
            )
        )
        n = 8000
        noise = array.channel_noise_T * np.random.default_rng(3).normal(size=(n, 9))
        readings = Readings(noise, time_s=0.25 * np.arange(float(n)))
        averaged, quieter = window_averages(readings, 1.0), window_averaging_array(array, readings, 1.0)
        np.testing.assert_allclose(quieter.channel_noise_T, array.channel_noise_T / 2.0, rtol=1e-12)
        ratio = averaged.values_T.std(axis=0) / quieter.channel_noise_T
        np.testing.assert_allclose(ratio, 1.0, atol=4.4 / math.sqrt(2 * 2000))

    def test_of_one_row_change_nothing(self) -> None:
        array = geometries.tetrahedron(1.0)
        readings = Readings(np.random.default_rng(4).normal(size=(5, 12)))
        np.testing.assert_array_equal(window_averages(readings, 1.0).values_T, readings.values_T)
        assert window_averaging_array(array, readings, 1.0) == array
