"""Lines as flown."""

from __future__ import annotations

import numpy as np
import pytest

import sims
from arrays.typing import FloatArray
from magloc.navigation.flight_lines import flight_lines
from sims.magnetics.paths import Lawnmower


def straight(n: int, speed_m_s: float = 1.0) -> tuple[FloatArray, FloatArray]:
    time_s = np.arange(n) / 10.0
    return time_s, np.array([0.0, 0.0, 1.5]) + np.outer(time_s, [speed_m_s, 0.0, 0.0])


class TestFlightLines:
    @pytest.mark.parametrize("name", ["survey-drone", "survey-cart"])
    def test_of_a_lawnmower(self, name: str) -> None:
        """As many lines as the scenario has, along its course, and all rows in one of them."""
        scenario = sims.read_scenario(name)
        path = scenario.carrier.path
        assert isinstance(path, Lawnmower)
        readings = sims.simulate(scenario, rng=3).readings
        assert readings.array_position_m is not None
        place = readings.array_position_m
        lines = flight_lines(readings.time_s, place, place[:, 2])
        assert len(lines) == path.lines
        assert [line.rows.start for line in lines[1:]] == [line.rows.stop for line in lines[:-1]]
        assert (lines[0].rows.start, lines[-1].rows.stop) == (0, len(readings))
        for line in lines:
            assert np.ptp(place[line.rows, 1]) < path.spacing_m + 0.5
        assert [line.speed_m_s for line in lines[:-1]] == pytest.approx([path.speed_m_s] * (path.lines - 1), rel=0.03)

    def test_a_straight_way_is_one(self) -> None:
        time_s, place = straight(300)
        (line,) = flight_lines(time_s, place, place[:, 2] - 0.5)
        assert (line.rows, line.name) == (slice(0, 300), "L1")
        assert (line.speed_m_s, line.height_m) == (pytest.approx(1.0), pytest.approx(1.0))

    def test_a_gap_in_time_begins_one(self) -> None:
        time_s, place = straight(300)
        time_s[120:] += 60.0
        assert [line.rows for line in flight_lines(time_s, place, place[:, 2])] == [slice(0, 120), slice(120, 300)]

    def test_a_rest_begins_none(self) -> None:
        time_s, place = straight(300)
        place[100:200] = place[100]
        place[200:] = place[100] + place[1:101] - place[0]
        assert len(flight_lines(time_s, place, place[:, 2])) == 1

    def test_a_log_names_them(self) -> None:
        """Rows before the first name count to its line, and a line without rows is left out."""
        time_s, place = straight(300)
        names = [(3.0, "10"), (12.0, "T2"), (40.0, "11"), (50.0, "12")]
        lines = flight_lines(time_s, place, place[:, 2], names)
        assert [(line.name, line.rows) for line in lines] == [("10", slice(0, 120)), ("T2", slice(120, 300))]

    def test_of_no_rows(self) -> None:
        assert flight_lines(np.zeros(0), np.zeros((0, 3)), np.zeros(0)) == []

    def test_of_a_survey_at_rest(self) -> None:
        (line,) = flight_lines(straight(300)[0], np.zeros((300, 3)), np.zeros(300))
        assert (line.rows, line.speed_m_s) == (slice(0, 300), 0.0)
