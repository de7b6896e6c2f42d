"""The API of magloc as a user types it: files to positions, a sensor that lies, a track.

====================================  ==================================================================================
what                                  who checks it
====================================  ==================================================================================
public names                          that they stay functions once a command of the same name is loaded
the first minute, story 1             the source that made the readings; what the command prints
a sensor that lies (story 3)          the sensor that was bent
a track (story 4)                     the path that made the readings; the same rows one by one
====================================  ==================================================================================
"""

from __future__ import annotations

import math
from dataclasses import replace
from inspect import ismodule
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import arrays
import magloc
from magloc.readings import write_readings
from tests.command_line import Run
from tests.passing_source import ARRAY, MOMENT, POSITION, moving_source, readings_of

N_ROWS = 30


def test_a_function_stays_one_once_its_command_is_loaded(run: Run) -> None:
    run("track", "none.csv", "--array", "none.toml")
    run("locate", "none.csv", "--array", "none.toml")
    assert not any(ismodule(getattr(magloc, name)) for name in ("track", "locate"))


@pytest.fixture
def board(tmp_path: Path) -> Path:
    arrays.write_array(tmp_path / "board.toml", ARRAY)
    return tmp_path / "board.toml"


@pytest.fixture
def log(tmp_path: Path) -> Path:
    time_s, p, m = moving_source(N_ROWS)
    write_readings(tmp_path / "log.csv", magloc.Readings(readings_of(ARRAY, p, m), time_s=time_s), ARRAY)
    return tmp_path / "log.csv"


def distance(found: NDArray[np.float64], covariance: NDArray[np.float64], truth: NDArray[np.float64]) -> float:
    """Largest error of a position in its standard deviations."""
    return float(np.max(np.abs(found - truth) / np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1)[..., :3])))


class TestFirstMinute:
    def test_files_to_positions(self, board: Path, log: Path, run: Run) -> None:
        """Errors within 5 σ in each of 90 numbers: one false alarm in 20,000."""
        array = arrays.read_array(board)
        readings = magloc.read_readings(log, array)
        fixes = magloc.locate(array, readings)
        assert distance(fixes.position_m, fixes.covariance, moving_source(N_ROWS)[1]) < 5.0
        assert fixes.detected.all()
        assert fixes.dropped_sensors == [()] * N_ROWS
        assert f"… {N_ROWS} rows" in str(fixes)
        assert "…" not in str(magloc.locate(array, readings[:2]))
        typed = run("locate", log, "--array", board)
        assert fixes.table() + "\n" == f"{typed.out}{fixes.caution}\n"
        assert f"note: {fixes.caution}" in typed.err

    def test_as_many_sources_as_there_are(self, board: Path, log: Path) -> None:
        array = arrays.read_array(board)
        readings = magloc.read_readings(log, array)
        fixes = magloc.locate(array, readings[:2], sources="auto")
        ((low, high),) = fixes[0].best.range_interval_m
        assert 0.999 * low < np.linalg.norm(POSITION - array.centroid) < 1.001 * (high or math.inf)
        np.testing.assert_allclose(fixes.position_m, moving_source(2)[1], atol=0.1)

    def test_an_ndarray_will_do(self) -> None:
        _, p, m = moving_source(2)
        values_T = readings_of(ARRAY, p, m)
        plain, wrapped = magloc.locate(ARRAY, values_T), magloc.locate(ARRAY, magloc.Readings(values_T))
        np.testing.assert_array_equal(plain.position_m, wrapped.position_m)


def test_a_sensor_that_lies_is_named() -> None:
    """Story 3; a good sensor is excluded from one row in a thousand."""
    array = arrays.grid(3, 2, 1.0, noise_T=2e-10)
    readings = magloc.Readings(readings_of(array, POSITION[None], MOMENT[None]))
    bent = readings.values_T.copy()
    bent[:, 6:9] += [4e-8, -3e-8, 2e-8]
    fix = magloc.locate(array, replace(readings, values_T=bent))[0]
    assert fix.dropped_sensors == (array.ids[2],)
    assert not fix.misfit
    np.testing.assert_allclose(fix.best.position_m, POSITION, atol=0.1)


def test_a_track_at_once_and_row_by_row(board: Path, log: Path) -> None:
    """Story 4; NEES of one record within a factor of three of what it should be."""
    array = arrays.read_array(board)
    readings = magloc.read_readings(log, array)
    motion = magloc.OrnsteinUhlenbeck(speed_m_s=0.1, turn_rad_s=0.02)
    track = magloc.track(array, readings, motion=motion, smooth=True)
    truth = magloc.Truth(*moving_source(N_ROWS))
    result = track.consistency(truth)
    assert np.isfinite(result.nees).all()
    assert 1.0 / 3.0 < result.nees.sum() / result.nees_dof.sum() < 3.0
    walk = magloc.RandomWalk(speed_m_s=0.1, turn_rad_s=0.02)
    tracker = magloc.Tracker(array, walk)
    points = [tracker.update(row) for row in readings]
    at_once = magloc.track(array, readings, motion=walk)
    np.testing.assert_allclose([point.position_m for point in points], at_once.position_m, rtol=1e-9)
