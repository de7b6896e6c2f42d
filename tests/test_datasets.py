"""The recordings that come with the packages: what they hold, and that a simulation gives them again."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

import adcs
import magloc
from adcs.complementary.names import MAGNETS
from arrays.io.csv import read_table
from arrays.io.errors import InputError
from tests.datasets import ADCS, MAGLOC, RATES_HZ, write_imu, write_magnetic, write_satellite

LARGEST_BYTES = 600_000


def assert_same_files(made: Path, shipped: Path) -> None:
    """Files of the same names and words, and numbers that are equal but for the last digits of a float."""
    assert {path.name for path in made.iterdir()} <= {path.name for path in shipped.iterdir()}
    for path in made.iterdir():
        if path.suffix == ".toml":
            assert path.read_text(encoding="utf-8") == (shipped / path.name).read_text(encoding="utf-8")
            continue
        again, there = read_table(path, ""), read_table(shipped / path.name, "")
        assert again.header == there.header
        assert_allclose(again.values, there.values, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", RATES_HZ)
def test_recordings_are_what_the_simulation_gives(name: str, tmp_path: Path) -> None:
    write_magnetic(name, tmp_path)
    (tmp_path / f"{name}-path.csv").unlink()  # the truth again, or in error of it where a scenario says so
    assert_same_files(tmp_path, MAGLOC)


@pytest.mark.parametrize("write", [write_satellite, write_imu])
def test_logs_are_what_the_simulation_gives(write: Callable[[Path], None], tmp_path: Path) -> None:
    write(tmp_path)
    assert_same_files(tmp_path, ADCS)


def test_they_are_small() -> None:
    assert sum(path.stat().st_size for folder in (MAGLOC, ADCS) for path in folder.iterdir()) < LARGEST_BYTES


def test_one_is_said_in_a_line() -> None:
    """A prompt shows what is typed at it; this was thirty sensors with all that is known of each."""
    board = "<Dataset 'board': 101 rows of <SensorArray 'board-30': 30 sensors, 90 channels>, with the truth>"
    assert repr(magloc.datasets.load("board")) == board


def test_names() -> None:
    assert set(magloc.datasets.names()) == set(RATES_HZ)
    assert adcs.datasets.names() == ("imu", "satellite")


@pytest.mark.parametrize("load", [magloc.datasets.load, adcs.datasets.load])
def test_an_unknown_name(load: Callable[[str], object]) -> None:
    with pytest.raises(InputError, match=r"Input name must be one of .*; instead received 'shipp'"):
        load("shipp")


def test_fixes_of_the_board_are_right() -> None:
    board = magloc.datasets.load("board")
    fixes = magloc.locate(board.array, board.readings)
    assert fixes.detected.all()
    assert np.linalg.norm(fixes.position_m - board.truth.position_m, axis=1).max() < 2e-3


def test_the_ship_is_where_its_errors_say() -> None:
    """Where the covariance describes what is known: at 60 m, in the first rows, it does not."""
    ship = magloc.datasets.load("ship")
    track = magloc.track(ship.array, ship.readings, motion=magloc.RandomWalk(2.0, 0.02))
    assert track.tracked.all()
    described = np.array([point.gaussian for point in track])
    assert described.sum() >= 60
    assert np.linalg.norm(track.position_m - ship.truth.position_m, axis=1)[described].max() < 3.0


def test_the_attitude_of_the_satellite_is_right() -> None:
    log = adcs.datasets.load("satellite")
    attitude = adcs.estimate(log.telemetry, log.satellite, sensors="st+gyro", states=("gyro-bias",))
    error_deg = np.degrees((attitude.rotation.inv() * log.truth).magnitude())
    assert error_deg[-60:].max() < 0.02


def test_the_attitude_of_the_inertial_unit_is_right() -> None:
    """To a degree or two, whatever is done with the magnet; left out, the gyro holds the heading."""
    log = adcs.datasets.load("imu")
    error_deg = {
        magnet: np.degrees((found.rotation.inv() * log.truth).magnitude())
        for magnet in MAGNETS
        for found in [
            adcs.inertial_magnetic_filter(log.time_s, log.gyro_rad_s, log.acceleration_m_s2, log.field_T, magnet=magnet)
        ]
    }
    assert error_deg["auto"].max() < 4.0
    assert max(errors.mean() for errors in error_deg.values()) < 2.0
