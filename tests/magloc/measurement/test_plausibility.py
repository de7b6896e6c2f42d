"""A wrong unit, clock or attitude is said in a sentence, and nothing is where the record is right.

Built-in data and scenarios are the right ones; wrong ones are made of them.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import ArrayLike
from scipy.signal import butter, sosfilt, sosfiltfilt
from scipy.spatial.transform import Rotation

import magloc
import sims
from arrays.array import SensorArray
from arrays.geometries import axial, cube, grid, tetrahedron
from arrays.typing import FloatArray
from magloc.measurement.plausibility import array_doubts, doubts, moment_doubts, noise_ratio
from magloc.readings import Readings
from tests.hills import PAIR, plain, walk
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
    simulation = sims.simulate(scenario, rng=7)
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

    def test_one_sensor_in_microtesla(self) -> None:
        rows = walk(71, plain, 5.0, 3).readings
        one = replace(rows, values_T=rows.values_T * [1.0, 1e-3])
        assert "of the scalar sensors, high read 48.3" in " ".join(doubts(PAIR, one))

    def test_two_instruments_in_one_column(self) -> None:
        """Rows in turn, 60 nT apart. Of 60 simulated surveys, none had such a sentence."""
        rows = walk(71, plain, 5.0, 3).readings
        mixed = rows.values_T + 6e-8 * (np.arange(len(rows)) % 2)[:, None]
        words = " ".join(doubts(PAIR, replace(rows, values_T=mixed)))
        for sensor in PAIR.ids:
            assert f"the readings of {sensor} alternate from row to row by 60 nT" in words
        assert "alternate" not in " ".join(doubts(PAIR, rows))

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
        assert "does the attitude rotate the array's frame to the world's" in said
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


class TestAmbientField:
    """A stated field that differs from what all sensors read is doubted, a source beside them is not."""

    EARTH_T = np.array([5e-6, 18e-6, -45e-6])

    def said(
        self, kind: str, *, off_T: float, sigma_T: float, place_m: ArrayLike = (9.0, 4.0, 1.0), n: int = 40
    ) -> str:
        """Sentences on an array whose stated field is stronger than the true one, beside a source of 200 A·m²."""
        array = cube(1.0, kind=kind, noise_T=1e-10)
        modulus = np.linalg.norm(self.EARTH_T)
        stated = tuple((self.EARTH_T * (1.0 + off_T / modulus)).tolist())
        array = replace(array, ambient_T=stated, ambient_uncertainty_T=sigma_T)
        fields_T = self.EARTH_T + magloc.dipole.field(array.positions, place_m, [0.0, 120.0, 160.0])
        values_T = np.linalg.norm(fields_T, axis=1) if kind == "scalar" else fields_T.ravel()
        noise = array.channel_noise_T * np.random.default_rng(0).normal(size=(n, array.n_channels))
        return " ".join(doubts(array, Readings(values_T + noise)))

    @pytest.mark.parametrize("kind", ["scalar", "vector"])
    @pytest.mark.parametrize(("off_T", "sigma_T"), [(1537e-9, 20e-9), (-800e-9, 50e-9), (1500e-9, 0.0)])
    @pytest.mark.parametrize("n", [2, 40])
    def test_difference_is_said(self, kind: str, off_T: float, sigma_T: float, n: int) -> None:
        said = self.said(kind, off_T=off_T, sigma_T=sigma_T, n=n)
        found = re.search(r"the sensors read (\d+) nT (more|less) than the ambient field", said)
        assert found is not None
        assert float(found[1]) == pytest.approx(1e9 * abs(off_T), abs=150.0)  # what the source adds
        assert found[2] == ("less" if off_T > 0.0 else "more")
        assert ("assumed" in said) == (not sigma_T)

    @pytest.mark.parametrize("kind", ["scalar", "vector"])
    @pytest.mark.parametrize(
        ("off_T", "sigma_T", "place_m"),
        [(300e-9, 200e-9, (9.0, 4.0, 1.0)), (400e-9, 0.0, (9.0, 4.0, 1.0)), (0.0, 5e-9, (2.0, 1.0, 1.0))],
    )
    def test_nothing_where_it_is_within_its_uncertainty_or_a_source_is_near(
        self, kind: str, off_T: float, sigma_T: float, place_m: tuple[float, float, float]
    ) -> None:
        assert not self.said(kind, off_T=off_T, sigma_T=sigma_T, place_m=place_m)

    @pytest.mark.parametrize("name", ["drone", "survey-drone"])
    @given(off_nT=st.floats(-3000.0, 3000.0), sigma_nT=st.floats(5.0, 300.0))
    def test_of_records_of_passing_sources(self, name: str, off_nT: float, sigma_nT: float) -> None:
        """From 5 standard deviations on it is said, below 3 it is not: the sources take up to half of one."""
        array, readings = record(name)
        assume(not 3.0 * sigma_nT < abs(off_nT) < 5.0 * sigma_nT)
        assert readings.ambient_T is not None
        modulus = np.linalg.norm(readings.ambient_T, axis=1, keepdims=True)
        off = replace(readings, ambient_T=readings.ambient_T * (1.0 + 1e-9 * off_nT / modulus))[::5]
        said = " ".join(doubts(replace(array, ambient_uncertainty_T=1e-9 * sigma_nT), off))
        assert ("than the ambient field" in said) == (abs(off_nT) > 4.0 * sigma_nT)


class TestSize:
    """Places in another unit than metres make an array of a size that no array of its noise has."""

    @pytest.mark.parametrize(
        ("array", "factors"),
        [
            (grid(3, 3, 0.03, noise_T=200e-9), (1000.0, 100.0, 1.0 / 0.0254)),
            (grid(4, 4, 0.02, noise_T=1e-6), (1000.0, 100.0)),
            (tetrahedron(0.5, noise_T=1e-9), (1000.0, 100.0)),
            (axial(1.0, "scalar", noise_T=1e-11), (1000.0,)),
        ],
    )
    def test_other_units(self, array: SensorArray, factors: tuple[float, ...]) -> None:
        assert not list(array_doubts(array))
        for factor in factors:
            assert "in metres? If they are in mm" in " ".join(array_doubts(scaled(array, factor)))

    def test_nanometres(self) -> None:
        assert "in metres?" in " ".join(array_doubts(scaled(ARRAY, 1e-6)))

    def test_what_moves_is_not_as_wide(self) -> None:
        wide = axial(100.0, "scalar", noise_T=1e-10)
        still = Rotation.from_quat(np.tile([0.0, 0.0, 0.0, 1.0], (3, 1)))
        walked = Readings(np.zeros((3, 2)), array_position_m=np.eye(3), array_rotation=still)
        assert not list(array_doubts(wide))
        assert "a moving array" in " ".join(array_doubts(wide, walked))

    @given(st.floats(0.01, 3.0), st.floats(1e-12, 1e-5))
    def test_nothing_up_to_three_metres(self, edge_m: float, noise_T: float) -> None:
        assert not list(array_doubts(axial(edge_m, noise_T=noise_T)))


class TestMoments:
    @pytest.mark.parametrize("factor", [1000.0, 100.0, 1.0 / 0.0254])
    @pytest.mark.parametrize(("distance_m", "moment_Am2"), [(0.07, 0.36), (0.3, 20.0), (5.0, 300.0)])
    def test_length_in_another_unit(self, factor: float, distance_m: float, moment_Am2: float) -> None:
        """The field stays, so that the moment grows with the cube; inches of a weak source could be true."""
        distance, moment = np.full(20, distance_m), np.outer(np.full(20, moment_Am2), [0.6, 0.0, 0.8])
        assert not list(moment_doubts(distance, moment))
        said = " ".join(moment_doubts(factor * distance, factor**3 * moment))
        assert ("not plausible" in said and "in mm" in said) or (factor < 100.0 and distance_m > 0.07)

    def test_none_of_nothing(self) -> None:
        assert not list(moment_doubts([], []))
        assert not list(moment_doubts([np.nan], [[np.nan] * 3]))

    def test_a_moment_of_nothing(self) -> None:
        assert "not plausible" in " ".join(moment_doubts([1e-3], [[1e-12, 0.0, 0.0]]))

    @pytest.mark.parametrize("door", ["locate", "track"])
    def test_of_an_array_in_millimetres(self, door: str, caplog: pytest.LogCaptureFixture) -> None:
        """Its size is doubted, and the moment that follows."""
        board, readings = record("board")
        with caplog.at_level(logging.WARNING):
            getattr(magloc, door)(scaled(board, 1000.0), readings[:5])
        assert "the sensors span 102 m" in caplog.text
        assert "the moment is" in caplog.text


class TestGrid:
    def test_eastings_and_northings(self) -> None:
        walk = np.outer(np.arange(30.0), [1.0, 0.0, 0.0])
        assert not moved(walk)
        assert "eastings and northings" in moved(walk + np.array([372125.0, 5808303.0, 41.0]))


def scaled(array: SensorArray, factor: float) -> SensorArray:
    """The array with its places multiplied."""
    sensors = (replace(sensor, position_m=tuple(factor * x for x in sensor.position_m)) for sensor in array.sensors)
    return replace(array, sensors=tuple(sensors))
