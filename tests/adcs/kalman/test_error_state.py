"""Tests of adcs.kalman.error_state: names, what can be observed, and the tables of process noise."""

from __future__ import annotations

from itertools import permutations

import pytest

from adcs.kalman.error_state import ProcessNoise, sensor_set
from adcs.kalman.process_noise import PAPER_NOISE, paper_noise, tuned_noise

TABLE_3 = [
    ("st+gyro+mag+sun", ()),
    ("st+gyro+mag", ()),
    ("st+gyro", ()),
    ("st+mag+sun", ()),
    ("st+mag", ("field-bias",)),
    ("st+gyro", ("gyro-bias",)),
    ("mag+sun+gyro", ()),
    ("mag+sun+gyro", ("gyro-bias",)),
    ("mag+sun+gyro", ("field-bias",)),
    ("mag+sun", ()),
    ("mag+gyro", ()),
    ("st", ()),
]


class TestNames:
    def test_any_order(self) -> None:
        sets = {sensor_set("+".join(names)) for names in permutations(["st", "gyro", "mag", "sun"])}
        assert len(sets) == 1
        assert sets.pop().sensors == "st+gyro+mag+sun"
        assert sensor_set("gyro+st", ["disturbance", "gyro-bias"]) == sensor_set(
            "ST+GYRO", ["gyro-bias", "disturbance"]
        )

    @pytest.mark.parametrize("sensors", ["", "st+", "stars", "st+st", "st,gyro"])
    def test_unknown_sensors(self, sensors: str) -> None:
        with pytest.raises(ValueError, match=r"Input sensors must be different names of st, gyro, mag, sun; instead"):
            sensor_set(sensors)

    def test_unknown_states(self) -> None:
        with pytest.raises(ValueError, match=r"Input states must be different names of field-bias, .*'torque'"):
            sensor_set("st", ["torque"])

    def test_states_of_one_name(self) -> None:
        both = sensor_set("mag+sun", ["field-bias", "field-gain"])
        assert sensor_set("mag+sun", ["magnetometer"]) == sensor_set("mag+sun", ["magnetometer", "field-gain"]) == both
        with pytest.raises(ValueError, match="must not have field-bias without a magnetometer"):
            sensor_set("st+gyro", ["magnetometer"])

    def test_layout_of_the_error_state(self) -> None:
        used = sensor_set("st+gyro+mag", ["disturbance", "gyro-bias", "field-bias"])
        assert used.states == ("field-bias", "gyro-bias", "disturbance")
        assert [used.slice_of(state).start for state in used.states] == [6, 9, 12]
        assert used.size == 15


class TestObservability:
    @pytest.mark.parametrize(("sensors", "states"), TABLE_3)
    def test_sets_of_the_tables(self, sensors: str, states: tuple[str, ...]) -> None:
        used = sensor_set(sensors, states)
        assert used.size == 6 + 3 * len(states)
        assert sensor_set(sensors, (*states, "disturbance")).size == used.size + 3

    @pytest.mark.parametrize(
        ("sensors", "missing"),
        [
            ("gyro", r"no sensor measures attitude. Add a star tracker \(st\) or a magnetometer \(mag\)"),
            ("sun", r"rotation about the Sun open. Add a star tracker \(st\) or a magnetometer \(mag\)"),
            ("sun+gyro", r"rotation about the Sun open. Add a star tracker \(st\) or a magnetometer \(mag\)"),
        ],
    )
    def test_says_what_is_missing(self, sensors: str, missing: str) -> None:
        with pytest.raises(ValueError, match=missing):
            sensor_set(sensors)

    def test_bias_of_a_sensor_that_is_not_there(self) -> None:
        with pytest.raises(ValueError, match="add gyro to the sensors"):
            sensor_set("st", ["gyro-bias"])
        with pytest.raises(ValueError, match="add mag to the sensors"):
            sensor_set("st", ["field-bias"])


class TestNoise:
    @pytest.mark.parametrize(("sensors", "states"), TABLE_3)
    def test_every_row_has_the_source_s_noise(self, sensors: str, states: tuple[str, ...]) -> None:
        assert paper_noise(sensor_set(sensors, states)).rate_rad_s > 0.0
        assert tuned_noise(sensor_set(sensors, states)).attitude == 1e-8

    def test_names_in_the_table_are_those_of_sets(self) -> None:
        for sensors, states in PAPER_NOISE:
            used = sensor_set(sensors, states)
            assert (used.sensors, used.states) == (sensors, states)

    def test_set_outside_of_the_tables(self) -> None:
        with pytest.raises(ValueError, match="must be a set of the source's tables"):
            paper_noise(sensor_set("st+sun"))

    @pytest.mark.parametrize("bad", [-1.0, float("nan"), float("inf")])
    def test_bad_noise(self, bad: float) -> None:
        with pytest.raises(ValueError, match="Input rate_rad_s must be 0 or more"):
            ProcessNoise(1e-8, bad)
