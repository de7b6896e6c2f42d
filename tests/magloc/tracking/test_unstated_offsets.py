"""Sensors whose offsets are not stated: told within twenty rows, in one sentence, and not searched row by row."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import magloc
from arrays import geometries
from arrays.array import SensorArray
from magloc.measurement.differences import predicted_channels
from magloc.tracking.chart.start import TrackStarter
from magloc.tracking.multi_target.tracker import SourcesTracker
from magloc.tracking.rows import Row
from magloc.tracking.sensor_health import OFFSETS, Misfits
from magloc.tracking.tracker import Tracker

NOISE_T, STEP_S, ROWS_TO_SAY = 3e-7, 0.05, 20
MOTION = magloc.RandomWalk(0.5, 0.1)
AMBIENT_T = (1.8e-5, 1e-6, -4.4e-5)


def board(n: int) -> SensorArray:
    """Board of n × n three-axis sensors, 0.1 m wide."""
    return geometries.grid(n, n, 0.1 / (n - 1), "vector", NOISE_T)


def helix() -> SensorArray:
    """Twelve scalar sensors in the Earth's field."""
    turn = np.linspace(0.0, 4.0 * np.pi, 12)
    sensors = geometries.grid(4, 3, 0.03, "scalar", NOISE_T).sensors
    places = np.stack([0.06 * np.cos(turn), 0.06 * np.sin(turn), 0.01 * turn], axis=1).tolist()
    placed = tuple(replace(one, position_m=(x, y, z)) for one, (x, y, z) in zip(sensors, places, strict=True))
    return SensorArray(placed, ambient_T=AMBIENT_T)


def rows_of(array: SensorArray, offset_T: float, seed: int, *, rest: int = 0, n_rows: int = 60) -> list[Row]:
    """Rows of a magnet on a circle above an array, after some without it; every channel has an offset of its own."""
    rng = np.random.default_rng(seed)
    moment = rng.normal(size=3)
    moment *= 0.25 / np.linalg.norm(moment)
    offset_T_of = offset_T * rng.uniform(-1.0, 1.0, array.n_channels)
    rows = []
    for i in range(n_rows):
        angle = 2.0 * np.pi * i * STEP_S / 4.0
        place = np.array([0.04 * np.cos(angle), 0.04 * np.sin(angle), 0.1])
        field = predicted_channels(array, place, moment if i >= rest else 0.0 * moment)
        rows.append(Row(i * STEP_S, field + offset_T_of + NOISE_T * rng.normal(size=array.n_channels)))
    return rows


class TestTracks:
    @pytest.mark.parametrize(
        ("n", "offset_T", "rest"),
        [
            # In `make test` each array and offset comes once, with and without a rest in turn.
            pytest.param(*case, rest, marks=[pytest.mark.slow] if (i + rest // 40) % 2 else [])
            for i, case in enumerate([(2, 2e-5), (3, 5e-6), (3, 1e-4), (4, 1e-6), (4, 2e-5)])
            for rest in (0, 40)
        ],
    )
    def test_says_so_once_within_twenty_rows(self, n, offset_T, rest, caplog) -> None:
        array = board(n)
        tracker = Tracker(array, MOTION)
        for row in rows_of(array, offset_T, n + rest, rest=rest)[:ROWS_TO_SAY]:
            point = tracker.update(row)
        assert [record.levelname for record in caplog.records] == ["WARNING"]
        assert "offset_uncertainty_nT" in caplog.text
        assert point.status == OFFSETS

    @pytest.mark.slow
    def test_of_moduli(self, caplog) -> None:
        array = helix()
        tracker = Tracker(array, MOTION)
        for row in rows_of(array, 2e-5, 1)[:ROWS_TO_SAY]:
            tracker.update(row)
        assert caplog.text.count("offset_uncertainty_nT") == 1

    def test_of_several_sources(self, caplog) -> None:
        array = board(4)
        tracker = SourcesTracker(array, sources=2)
        for row in rows_of(array, 2e-5, 2)[:ROWS_TO_SAY]:
            assert not tracker.update(row).tracks
        assert caplog.text.count("offset_uncertainty_nT") == 1

    def test_live_goes_on_and_a_tare_helps(self, caplog) -> None:
        array = board(4)
        follower = magloc.live.Follower(array, MOTION)
        rows = rows_of(array, 2e-5, 3, rest=40, n_rows=70)
        readings = magloc.Readings(
            np.stack([row.readings_T for row in rows]), time_s=np.array([row.time_s for row in rows])
        )
        points = list(follower.follow(readings[:ROWS_TO_SAY]))
        assert caplog.text.count("offset_uncertainty_nT") == 1
        follower.tare(0.5)
        points = list(follower.follow(readings[ROWS_TO_SAY:]))
        assert points[-1].status == "tracked"

    def test_most_rows_are_not_searched(self, monkeypatch) -> None:
        searched = []
        search, array = TrackStarter.mixture, board(3)
        monkeypatch.setattr(TrackStarter, "mixture", lambda *given: searched.append(1) or search(*given))
        tracker = Tracker(array, MOTION)
        for row in rows_of(array, 2e-5, 4, n_rows=300):
            tracker.update(row)
        assert len(searched) < 20

    @pytest.mark.parametrize("seed", range(4))
    @pytest.mark.parametrize("array", [board(2), board(4), helix()], ids=["4", "16", "moduli"])
    def test_no_word_of_it_where_there_are_none(self, array, seed, caplog) -> None:
        tracker = Tracker(array, MOTION)
        for row in rows_of(array, 0.0, seed, rest=10, n_rows=30):
            tracker.update(row)
        assert caplog.text == ""

    def test_no_word_of_it_where_they_are_stated(self, caplog) -> None:
        array = board(4)
        stated = replace(array, sensors=tuple(replace(one, offset_uncertainty_T=1.2e-5) for one in array.sensors))
        tracker = Tracker(stated, MOTION)
        points = [tracker.update(row) for row in rows_of(array, 2e-5, 5, n_rows=20)]
        assert caplog.text == ""
        assert not any(point.status == OFFSETS for point in points)


class TestMisfits:
    @given(st.integers(0, 10**6), st.floats(3.0, 1e3), st.integers(3, 60))
    def test_the_same_in_all_rows_last(self, seed, size, k) -> None:
        rng = np.random.default_rng(seed)
        misfit, found = size * rng.choice([-1.0, 1.0], k), Misfits()
        for _ in range(10):
            found = found.after(misfit + rng.normal(size=k), NOISE_T)
        assert found.are_alike
        assert found.waits == found.pause > 0

    @given(st.integers(0, 10**6), st.floats(3.0, 1e3), st.integers(3, 60))
    def test_independent_ones_do_not(self, seed, size, k) -> None:
        """The mean of ten holds a tenth of their energy; half of it for three numbers once in 10⁸."""
        rng, found = np.random.default_rng(seed), Misfits()
        for _ in range(10):
            found = found.after(size * rng.normal(size=k), NOISE_T)
        assert not found.are_alike
        assert found.waits == 0

    def test_pauses_grow(self) -> None:
        found, pauses = Misfits(), []
        for _ in range(14):
            found = found.after(np.ones(9), NOISE_T)
            pauses.append(found.pause)
        assert all(late == 2 * early for early, late in pairwise(pauses[9:]))

    def test_a_row_without_a_sensor_does_not_count(self) -> None:
        found = Misfits().after(np.ones(9), NOISE_T)
        assert found.after(np.ones(6), NOISE_T) is found
