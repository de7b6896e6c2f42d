"""The corrected log: the same text, with more cells at the end of each row, that the array file reads again."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import arrays
import magloc
from arrays.io.errors import InputError
from magloc.compensation.files import LogFile

ONE = arrays.SensorArray((arrays.Sensor("mag", "scalar", (0.0, 0.0, 0.0), 1e-11),), common_field_T=1e-6)
ADDED = {"mag_compensated_nT": np.array([1.5, np.nan, 3.25]), "mag_compensation_sigma_nT": np.array([0.1, np.nan, 0.2])}


def columns(**more: object) -> arrays.SensorArray:
    given = {"sensors": {"mag": "Mag"}, "time": "T"} | more
    return replace(ONE, columns=arrays.LogColumns(**given))  # type: ignore[arg-type]  # as a test names them


def test_a_readings_file(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text("time_s,mag_nT,motor_A\n0,48000,5\n1,48001,6\n2,48002,7\n")
    log = LogFile.read(path, ONE, ["motor_A"])
    np.testing.assert_array_equal(log.currents["motor_A"], [5.0, 6.0, 7.0])
    log.write(tmp_path / "out.csv", ADDED)
    assert (tmp_path / "out.csv").read_text().splitlines() == [
        "time_s,mag_nT,motor_A,mag_compensated_nT,mag_compensation_sigma_nT",
        "0,48000,5,1.5000,0.1000",
        "1,48001,6,,",
        "2,48002,7,3.2500,0.2000",
    ]


def test_a_log_with_its_own_habits(tmp_path: Path) -> None:
    """Preamble, comments, semicolons, decimal commas, empty cells at the end, another encoding: all stay."""
    path = tmp_path / "log.csv"
    text = "Gerät 7\r\nT;Mag;Note;\r\n# Start\r\n0;48000,5;a;\r\n\r\n1;48001,5;\r\n2;48002,5;c;;\r\n"
    path.write_bytes(text.encode("windows-1252"))
    array = columns(separator="semicolon", decimal=",", encoding="windows-1252")
    out = tmp_path / "out.csv"
    LogFile.read(path, array).write(out, ADDED)
    assert out.read_bytes().decode("windows-1252").splitlines() == [
        "Gerät 7",
        "T;Mag;Note;mag_compensated_nT;mag_compensation_sigma_nT",
        "# Start",
        "0;48000,5;a;1,5000;0,1000",
        "",
        "1;48001,5;;;",
        "2;48002,5;c;3,2500;0,2000",
    ]
    again = columns(separator="semicolon", decimal=",", encoding="windows-1252", sensors={"mag": "mag_compensated_nT"})
    np.testing.assert_allclose(magloc.read_readings(out, again).values_T[:, 0], [1.5e-9, np.nan, 3.25e-9])


def test_blanks_between_the_cells(tmp_path: Path) -> None:
    path, out = tmp_path / "log.txt", tmp_path / "out.txt"
    path.write_text("T   Mag\n0  48000\n1  48001\n2  48002  \n")
    array = columns(separator="space")
    LogFile.read(path, array).write(out, ADDED)
    again = columns(separator="space", sensors={"mag": "mag_compensated_nT"})
    np.testing.assert_allclose(magloc.read_readings(out, again).values_T[:, 0], [1.5e-9, np.nan, 3.25e-9])


@pytest.mark.parametrize(
    ("current", "fragment"), [("motor_B", "the nearest is motor_A"), ("mag_nT", "which is a column of the readings")]
)
def test_currents_that_are_none(tmp_path: Path, current: str, fragment: str) -> None:
    path = tmp_path / "log.csv"
    path.write_text("time_s,mag_nT,motor_A\n0,48000,5\n1,48001,6\n")
    with pytest.raises(InputError, match=fragment):
        LogFile.read(path, ONE, [current])
    with pytest.raises(InputError, match="found motor_A twice"):
        LogFile.read(path, ONE, ["motor_A", "motor_A"])


def test_a_log_without_times(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text("times,mag_nT,array_x_m,array_y_m,array_z_m\n0,48000,,,\n1,48001,1,2,3\n")
    with pytest.raises(InputError, match=r"column time_s: found no such column \(the nearest is times\)"):
        LogFile.read(path, ONE)
