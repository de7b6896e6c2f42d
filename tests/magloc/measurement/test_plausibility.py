"""A wrong unit, clock or attitude is said in a sentence, and nothing is where the record is right.

Built-in data and scenarios are the right ones; wrong ones are made of them.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import ArrayLike
from scipy.signal import butter, sosfilt, sosfiltfilt
from scipy.spatial.transform import Rotation

import magloc
import sims
from arrays.array import SensorArray
from arrays.typing import FloatArray
from magloc.measurement.plausibility import doubts, noise_ratio
from magloc.readings import Readings
from tests.passing_source import ARRAY, moving_source, readings_of

DATASETS = ("board", "diver", "drone", "ship")
SCENARIOS = ("weaving", "survey-drone", "survey-diver", "paper", "three-magnets")


@cache
def record(name: str) -> tuple[SensorArray, Readings]:
    if name in DATASETS:
        recording = magloc.datasets.load(name)
        return recording.array, recording.readings
    scenario = sims.read_scenario(name)
    assert isinstance(scenario, sims.MagneticScenario)
    simulation = sims.simulate(scenario, seed=7)
    return simulation.array, simulation.readings


def sentences(name: str, wrong: Callable[[Readings], Readings] = lambda readings: readings) -> str:
    array, readings = record(name)
    return " ".join(doubts(array, wrong(readings)))


def in_microtesla(readings: Readings) -> Readings:
    return replace(readings, values_T=readings.values_T / 1000.0)


def in_picotesla(readings: Readings) -> Readings:
    return replace(readings, values_T=readings.values_T * 1000.0)


def in_milliseconds(readings: Readings) -> Readings:
    return replace(readings, time_s=readings.time_s * 1000.0)


def turned(readings: Readings, turn: Callable[[Rotation], Rotation]) -> Readings:
    assert readings.array_rotation is not None
    return replace(readings, array_rotation=turn(readings.array_rotation))


def to_the_array(readings: Readings) -> Readings:
    return turned(readings, Rotation.inv)


def scalar_first(readings: Readings) -> Readings:
    return turned(readings, lambda rotation: Rotation.from_quat(rotation.as_quat()[:, [3, 0, 1, 2]]))


def in_radians(readings: Readings) -> Readings:
    """Yaw, pitch and roll in radians, taken for degrees."""
    return turned(readings, lambda rotation: Rotation.from_euler("ZYX", rotation.as_euler("ZYX"), degrees=True))


class TestRight:
    @pytest.mark.parametrize("name", [*DATASETS, *SCENARIOS])
    def test_nothing_is_said(self, name: str) -> None:
        assert not sentences(name)

    def test_a_few_rows_say_nothing(self) -> None:
        array, readings = record("diver")
        assert not list(doubts(array, in_microtesla(readings[:19])))

    def test_readings_without_noise_at_rest_say_nothing(self) -> None:
        field_T = magloc.dipole.field(ARRAY.positions, [3.0, 0.0, 0.5], [0.0, 50.0, 100.0])
        assert not list(doubts(ARRAY, Readings(np.tile(ARRAY.readings_of(field_T), (30, 1)))))


class TestFilteredNoise:
    """Noise that is as large in all as it is stated, and far smaller from row to row."""

    @pytest.mark.parametrize(
        ("rate_Hz", "corner_Hz", "order", "filtered"),
        [(1e3, 50.0, 4, sosfilt), (200.0, 10.0, 4, sosfilt), (1e3, 25.0, 4, sosfiltfilt), (1e3, 10.0, 2, sosfilt)],
    )
    def test_nothing_is_said(
        self, rate_Hz: float, corner_Hz: float, order: int, filtered: Callable[..., FloatArray]
    ) -> None:
        white = np.random.default_rng(0).normal(size=(3000, ARRAY.n_channels))
        noise = filtered(butter(order, corner_Hz, fs=rate_Hz, output="sos"), white, axis=0)[1000:]
        noise *= ARRAY.channel_noise_T / noise.std(axis=0)
        assert not list(doubts(ARRAY, Readings(noise, time_s=np.arange(2000) / rate_Hz)))

    def test_noise_that_stands_for_errors_of_the_model(self) -> None:
        noise = 0.005 * ARRAY.channel_noise_T * np.random.default_rng(0).normal(size=(200, ARRAY.n_channels))
        assert noise_ratio(ARRAY, noise) < 0.01
        assert not list(doubts(ARRAY, Readings(noise)))


class TestUnit:
    @pytest.mark.parametrize("name", [*DATASETS, *SCENARIOS])
    def test_microtesla(self, name: str) -> None:
        """The board's magnet is too fast for its rows: what is left of its field may be filtered noise."""
        assert ("as they would in µT" in sentences(name, in_microtesla)) == (name != "board")

    @pytest.mark.parametrize(("unit", "nanotesla"), [("G", 1e-5), ("T", 1e-9)])
    def test_larger_units(self, unit: str, nanotesla: float) -> None:
        said = sentences("paper", lambda readings: replace(readings, values_T=nanotesla * readings.values_T))
        assert f"as they would in {unit}:" in said

    @pytest.mark.parametrize("name", [*DATASETS, "survey-drone", "survey-diver", "three-magnets"])
    def test_picotesla_where_sensors_saturate(self, name: str) -> None:
        """Others are misfits: tests/magloc/tracking/test_broken_assumptions.py."""
        assert "reach saturation_nT" in sentences(name, in_picotesla)

    def test_moduli_beside_their_ambient_field(self) -> None:
        assert "the ambient field is 4.88e+04 nT" in sentences("drone", in_microtesla)

    def test_ratio_is_that_of_the_noise(self) -> None:
        """Of 3,600 numbers, neighbours alike, the median is known to 3 %: off by four times that in 1 of 10,000."""
        _, places_m, moments_Am2 = moving_source(300)
        right = noise_ratio(ARRAY, readings_of(ARRAY, places_m, moments_Am2))
        assert 0.8 < right < 1.1  # less the mean of four sensors: √(3/4)
        assert noise_ratio(ARRAY, 0.1 * readings_of(ARRAY, places_m, moments_Am2)) == pytest.approx(0.1 * right)

    def test_nothing_where_the_ambient_field_is_taken_off(self) -> None:
        """Differences do not need it."""

        def less_its_median(readings: Readings) -> Readings:
            return replace(readings, values_T=readings.values_T - np.nanmedian(readings.values_T))

        assert "nT in the median" not in sentences("drone", less_its_median)


def moved(places_m: ArrayLike, dt_s: float = 1.0) -> str:
    """What is said of an array that goes along places (n, 3), of readings with their stated noise."""
    position_m = np.asarray(places_m, dtype=np.float64)
    n = len(position_m)
    noise = ARRAY.channel_noise_T * np.random.default_rng(0).normal(size=(n, ARRAY.n_channels))
    still = Rotation.from_quat(np.tile([0.0, 0.0, 0.0, 1.0], (n, 1)))
    return " ".join(
        doubts(
            ARRAY, Readings(noise, time_s=dt_s * np.arange(float(n)), array_position_m=position_m, array_rotation=still)
        )
    )


class TestClock:
    @pytest.mark.parametrize("name", ["diver", "drone", "survey-drone", "survey-diver"])
    def test_milliseconds(self, name: str) -> None:
        assert "are times in s" in sentences(name, in_milliseconds)

    def test_rests_do_not_count(self) -> None:
        stations = np.outer(np.repeat(np.arange(10.0), 40), [1.0, 0.0, 0.0])
        assert not moved(stations)
        assert "at 0.001 m/s" in moved(stations, 1000.0)

    def test_a_place_that_is_not_known_does_not_count(self) -> None:
        walk = np.outer(np.arange(100.0), [1.0, 0.0, 0.0])
        walk[50] = np.nan
        assert not moved(walk)
        assert "at 0.001 m/s" in moved(walk, 1000.0)

    @pytest.mark.parametrize(("speed_m_s", "doubted"), [(100.0, False), (1.5e3, True), (7.6e3, False), (20e3, True)])
    def test_fast_and_in_orbit(self, speed_m_s: float, doubted: bool) -> None:
        assert ("are times in s" in moved(np.outer(np.arange(100.0), [speed_m_s, 0.0, 0.0]))) == doubted


class TestAttitude:
    @pytest.mark.parametrize("name", ["diver", "survey-diver"])
    def test_from_the_world_to_the_array(self, name: str) -> None:
        assert "if the quaternions are taken from the world's frame to the array's" in sentences(name, to_the_array)

    @pytest.mark.parametrize("name", ["diver", "drone", "survey-drone", "survey-diver"])
    def test_scalar_first(self, name: str) -> None:
        assert "if their first column is the scalar" in sentences(name, scalar_first)

    @pytest.mark.parametrize("name", ["diver", "drone", "survey-drone", "survey-diver"])
    def test_radians(self, name: str) -> None:
        assert "if turns are taken in radians" in sentences(name, in_radians)


class TestOffset:
    """A sensor's offset turns the field in the world as well, as the array turns about the vertical."""

    EARTH_T = np.array([20e-6, 0.0, -45e-6])
    YAW = Rotation.from_rotvec(np.outer(np.linspace(0.0, 12.0, 200), [0.0, 0.0, 1.0]))

    def said(self, offset_T: float, attitude: Rotation = YAW, uncertainty_T: float = 0.0) -> str:
        array = replace(
            ARRAY, sensors=tuple(replace(sensor, offset_uncertainty_T=uncertainty_T) for sensor in ARRAY.sensors)
        )
        field_T = self.YAW.inv().apply(self.EARTH_T) + np.array([offset_T, 0.0, 0.0])
        values_T = np.tile(field_T, ARRAY.n_sensors)
        values_T += ARRAY.channel_noise_T * np.random.default_rng(0).normal(size=values_T.shape)
        readings = Readings(values_T, array_position_m=np.zeros((200, 3)), array_rotation=attitude)
        return " ".join(doubts(array, readings))

    def test_of_usual_size_says_nothing(self) -> None:
        assert not self.said(3.4e-6)

    def test_what_has_no_cure_is_asked(self) -> None:
        another_axis = self.YAW * Rotation.from_euler("Y", 1.0)
        said = self.said(0.0, another_axis)
        assert "is the attitude that" in said
        assert "are the sensors calibrated?" in said
        assert not self.said(0.0, another_axis, uncertainty_T=30e-6)


class TestDoors:
    """Whatever takes a whole record says it."""

    @pytest.mark.parametrize("door", ["locate", "track", "survey"])
    def test_warns(self, door: str, caplog: pytest.LogCaptureFixture) -> None:
        array, readings = record("drone" if door == "survey" else "paper")
        with caplog.at_level(logging.WARNING):
            try:
                getattr(magloc, door)(array, in_microtesla(readings)[:60])
            except ValueError:
                assert door == "survey"  # whose sensors have no targets below them
        assert "are they in nT" in caplog.text
