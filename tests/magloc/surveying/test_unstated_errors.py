"""Surveys whose array file does not state what errs: noise, heading errors, and an attitude that is the course."""

from __future__ import annotations

import logging
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

import arrays
import magloc
from arrays.typing import FloatArray
from magloc.navigation.course import chords
from magloc.surveying.preparation import whole_rows

AMBIENT_T = np.array([2e-6, 19e-6, -46e-6])
SIDE_M = np.array([0.75, 0.25, -0.25, -0.75])
COLUMNS = arrays.LogColumns(position=("x", "y", "z"), course=True)
NOISE_T, RATE_Hz, SPEED_M_S, SPACING_M = 5e-11, 10.0, 1.2, 2.0
PLACE_M = np.array([[1.6, 2.4, -0.4], [4.7, 8.6, -0.9], [6.3, 4.1, -0.6]])
MOMENT_Am2 = np.array([[0.3, 0.4, -1.1], [-0.8, 1.5, -3.0], [0.05, 0.1, -0.25]])


class Walk(NamedTuple):
    """Readings of a frame of four scalar sensors, with the course as its attitude, and the array."""

    array: arrays.SensorArray
    readings: magloc.Readings

    def survey(self, **of_sensors: float) -> magloc.Survey:
        sensors = tuple(replace(sensor, **of_sensors) for sensor in self.array.sensors)
        return magloc.survey(replace(self.array, sensors=sensors), self.readings)


@cache
def walk(seed: int, heading_T: float = 0.0) -> Walk:
    """Five lines there and back with turns, above three targets; the walker sways by centimetres."""
    rng = np.random.default_rng(seed)
    along = np.arange(-2.0, 14.0, SPEED_M_S / RATE_Hz)
    turn = np.linspace(0.0, np.pi, 42)[1:-1]
    parts = []
    for i in range(5):
        y = along if i % 2 == 0 else along[::-1]
        parts.append(np.column_stack([np.full(len(y), SPACING_M * i), y]))
        ahead = np.sign(y[-1] - y[0])
        parts.append(np.column_stack([SPACING_M * i + 1.0 - np.cos(turn), y[-1] + ahead * np.sin(turn)]))
    xy = np.concatenate(parts[:-1])
    n = len(xy)
    xy += gaussian_filter1d(rng.normal(size=(n, 2), scale=0.35), 2.0 * RATE_Hz, axis=0)
    yaw = np.unwrap(np.arctan2(*gaussian_filter1d(np.gradient(xy, axis=0), 2.5, axis=0).T[::-1]))
    z = 0.35 + gaussian_filter1d(rng.normal(size=n, scale=0.1), RATE_Hz)
    sensors_m = np.empty((n, 4, 3))
    sensors_m[..., 0] = xy[:, :1] - np.outer(np.sin(yaw), SIDE_M)
    sensors_m[..., 1] = xy[:, 1:] + np.outer(np.cos(yaw), SIDE_M)
    sensors_m[..., 2] = z[:, None]
    fields = AMBIENT_T + sum(magloc.dipole.field(sensors_m, p, m) for p, m in zip(PLACE_M, MOMENT_Am2, strict=True))
    values = np.linalg.norm(fields, axis=2) + heading_T * np.cos(yaw[:, None] + np.arange(4))
    place = np.column_stack([xy, z]) + rng.normal(size=(n, 3), scale=0.01)
    _, back, forth, _ = chords(place[:, :2])
    course = Rotation.from_euler("z", np.arctan2(*(back + forth).T[::-1])[:, None])
    readings = magloc.Readings(
        values + rng.normal(size=(n, 4), scale=NOISE_T),
        time_s=np.arange(n) / RATE_Hz,
        array_position_m=place,
        array_rotation=course,
        ambient_T=course.inv().apply(np.tile(AMBIENT_T, (n, 1))),
    )
    sensors = tuple(arrays.Sensor(f"s{i}", "scalar", (0.0, side, 0.0), NOISE_T) for i, side in enumerate(SIDE_M))
    return Walk(arrays.SensorArray(sensors, columns=COLUMNS), readings)


def check_targets(found: magloc.Survey) -> None:
    """Every target, no other, and errors as large as stated: χ² of three, 1 in 10,000 right ones is beyond 21."""
    assert len(found) == len(PLACE_M)
    for place in PLACE_M:
        target = min(found, key=lambda one: float(np.linalg.norm(one.position_m - place)))
        error: FloatArray = target.position_m - place
        assert error @ np.linalg.solve(target.covariance[:3, :3], error) < 21.0


class TestHeadingErrors:
    @pytest.mark.slow_after(1)
    @pytest.mark.parametrize("seed", [6101, 6102])
    def test_unstated(self, seed: int, caplog: pytest.LogCaptureFixture) -> None:
        """Eight times the noise; without the estimate they make targets at the ends of lines."""
        with caplog.at_level(logging.WARNING):
            found = walk(seed, 4e-10).survey()
        assert "State offset_uncertainty_nT" in caplog.text
        check_targets(found)
        assert found.chi2_per_dof < 1.3

    def test_stated(self, caplog: pytest.LogCaptureFixture) -> None:
        with caplog.at_level(logging.WARNING):
            found = walk(6101, 4e-10).survey(offset_uncertainty_T=1e-9)
        assert "offset_uncertainty_nT" not in caplog.text
        check_targets(found)

    def test_none(self, caplog: pytest.LogCaptureFixture) -> None:
        """A right model gains 30 in minus twice the log-likelihood once in a million."""
        with caplog.at_level(logging.WARNING):
            found = walk(6103).survey()
        assert "State" not in caplog.text
        assert all(not sensor.offset_uncertainty_T for sensor in found.array.sensors)
        check_targets(found)


class TestNoise:
    def test_ten_times_the_stated_noise(self, caplog: pytest.LogCaptureFixture) -> None:
        """It is measured to some per cent: the median of some thousand differences."""
        with caplog.at_level(logging.WARNING):
            found = walk(6104).survey(noise_T=0.1 * NOISE_T)
        assert "times the stated noise: taken into account. State noise_nT" in caplog.text
        assert found.array.sensors[0].noise_T == pytest.approx(NOISE_T, rel=0.25)
        check_targets(found)


class TestCourse:
    def test_rows_of_turns_have_no_attitude(self) -> None:
        array, readings = walk(6103)
        posed, rows = whole_rows(array, readings)
        assert posed.pose is not None
        assert np.degrees(posed.pose.attitude_rad) == pytest.approx(3.0)
        way = np.abs(np.diff(rows.array_position_m, axis=0))  # type: ignore[arg-type]
        assert 100 < len(readings) - len(rows) < 250
        assert np.median(way[:, 1]) > 3.0 * np.median(way[:, 0])

    def test_a_single_sensor_needs_none(self) -> None:
        array, readings = walk(6103)
        alone = replace(array, sensors=(replace(array.sensors[0], position_m=(0.0, 0.0, 0.0)),))
        _, rows = whole_rows(alone, replace(readings, values_T=readings.values_T[:, :1]))
        assert len(rows) == len(readings)
