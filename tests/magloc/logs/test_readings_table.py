"""Binary logs by the table [columns]: readings against the flight that made them, and the proposal of that table."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pytest

import arrays
import magloc
from arrays.io.errors import InputError
from magloc.logs.readings_table import date_of_log, origin_of_log
from tests.robot_flights import Flight
from tests.written_logs import ulog

FLIGHT = Flight(2, duration_s=20.0, noise_T=0.0)
SENSOR = '[[sensor]]\nid = "s1"\nkind = "vector"\nposition_m = [0.0, 0.0, 0.0]\nnoise_nT = 1.0\n'


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("logs")
    (path / "flight.ulg").write_bytes(FLIGHT.px4())
    (path / "flight.BIN").write_bytes(FLIGHT.ardupilot())
    return path


def drive(q: np.ndarray) -> bytes:
    """Return a drive of 10 s to the north with readings at 50 Hz, places at 5 Hz and these quaternions at 50 Hz."""
    us = np.arange(0, 10_000_000, 20_000, dtype=np.uint64)
    gps = {
        "timestamp": us[::10],
        "lat": np.round(1e7 * (48.0 + np.degrees(1e-6 * us[::10].astype(float) / 6.3674e6))).astype(np.int32),
        "lon": np.full(len(us[::10]), 110_000_000, np.int32),
        "alt": np.full(len(us[::10]), 500_000, np.int32),
    }
    mag = {"timestamp": us + np.uint64(7_000), "magnetometer_ga": np.tile(np.float32([0.2, 0.01, 0.43]), (len(us), 1))}
    mag["magnetometer_ga"][:, 0] += np.linspace(0.0, 0.01, len(us), dtype=np.float32)
    return ulog(
        [
            ("vehicle_gps_position", 0, gps),
            ("vehicle_magnetometer", 0, mag),
            ("vehicle_attitude", 0, {"timestamp": us, "q": q.astype(np.float32)}),
        ]
    )


@pytest.mark.parametrize(("name", "error_T"), [("flight.ulg", 1e-11), ("flight.BIN", 5.1e-8)])
def test_the_proposed_table_reads_the_flight(run, folder: Path, name: str, error_T: float) -> None:
    """DataFlash has whole milligauss, 100 nT."""
    array_file = folder / f"{name}.toml"
    assert run("columns", folder / name, "--out", array_file).status == 0
    array = arrays.read_sensors(array_file)
    readings = magloc.read_readings(folder / name, array, ordered=True)
    expected = FLIGHT.field_T(FLIGHT.field_s)
    np.testing.assert_allclose(readings.time_s, 10.0 + FLIGHT.field_s, atol=1e-6)
    np.testing.assert_allclose(readings.values_T, expected, rtol=0.0, atol=error_T)
    np.testing.assert_allclose(array.sensors[0].rotation_xyzw, [1.0, 0.0, 0.0, 0.0])


def test_places_and_angles_come_to_the_rows_of_the_sensor(run, tmp_path: Path) -> None:
    """A vehicle that drives to the north at 1 m/s and turns from 350 to 10 degrees."""
    yaw = np.radians(350.0 + 2.0 * 0.02 * np.arange(500))
    path = tmp_path / "drive.ulg"
    path.write_bytes(drive(np.stack([np.cos(yaw / 2), 0 * yaw, 0 * yaw, np.sin(yaw / 2)], 1)))
    assert run("columns", path, "--out", tmp_path / "a.toml").status == 0
    readings = magloc.read_readings(path, arrays.read_sensors(tmp_path / "a.toml"))
    checked = run("qc", path, "--array", tmp_path / "a.toml", "--json")
    assert (checked.status, json.loads(checked.out)["checks"][0]["value"]) == (0, len(readings))
    inside = readings.time_s < 9.7
    np.testing.assert_allclose(readings.array_position_m[inside, 1], readings.time_s[inside], atol=0.02)
    heading = np.radians(350.0 + 2.0 * readings.time_s[inside])
    nose = readings.array_rotation[np.flatnonzero(inside)].apply([1.0, 0.0, 0.0])
    np.testing.assert_allclose(nose, np.stack([np.sin(heading), np.cos(heading), 0 * heading], 1), atol=1e-3)


@pytest.mark.parametrize("missing", [0.0, np.nan])
def test_rows_without_an_attitude_are_left_out(
    run, tmp_path: Path, caplog: pytest.LogCaptureFixture, missing: float
) -> None:
    """An estimator that has no attitude from 2 to 4 s logs zeros or NaN; the rows before and after stay."""
    q = np.tile([1.0, 0.0, 0.0, 0.0], (500, 1))
    q[100:200] = missing
    path = tmp_path / "drive.ulg"
    path.write_bytes(drive(q))
    assert run("columns", path, "--out", tmp_path / "a.toml").status == 0
    caplog.clear()
    time_s = magloc.read_readings(path, arrays.read_sensors(tmp_path / "a.toml")).time_s
    expected_s = 0.007 + 0.02 * np.arange(500)
    expected_s = expected_s[((expected_s < 1.98) | (expected_s > 4.0)) & (expected_s < 9.8)]
    np.testing.assert_allclose(time_s, expected_s, atol=1e-9)
    # 101 rows lie between the attitudes at 1.98 s and 4.00 s; the last row is later than all attitudes.
    assert "drive.ulg: 102 rows lie outside the attitude's times or in its gaps" in caplog.text


def test_a_sensor_with_missing_readings_is_proposed(run, tmp_path: Path) -> None:
    """One reading of each axis is missing; the sensor works."""
    path = tmp_path / "drive.ulg"
    data = drive(np.tile([1.0, 0.0, 0.0, 0.0], (500, 1)))
    reading = struct.pack("<Q", 2_007_000)
    at = data.index(reading) + len(reading)
    path.write_bytes(data[:at] + np.full(3, np.nan, np.float32).tobytes() + data[at + 12 :])
    outcome = run("columns", path)
    assert 's1 = ["vehicle_magnetometer.magnetometer_ga[0]", ' in outcome.out
    assert "stands still" not in outcome.out


def test_the_origin_is_the_first_place_without_an_attitude(run, tmp_path: Path) -> None:
    path = tmp_path / "drive.ulg"
    path.write_bytes(drive(np.full((500, 4), np.nan)))
    assert run("columns", path, "--out", tmp_path / "a.toml").status == 0
    columns = arrays.read_sensors(tmp_path / "a.toml").columns
    assert origin_of_log(path, columns) == pytest.approx((48.0, 11.0, 500.0))


def test_a_log_that_is_read_for_its_origin_warns_once(run, tmp_path: Path) -> None:
    q = np.tile([1.0, 0.0, 0.0, 0.0], (500, 1))
    q[100:200] = np.nan
    path, array_file = tmp_path / "drive.ulg", tmp_path / "a.toml"
    path.write_bytes(drive(q))
    assert run("columns", path, "--out", array_file).status == 0
    lines = array_file.read_text(encoding="utf-8").splitlines()
    array_file.write_text("\n".join(line for line in lines if not line.startswith("origin")), encoding="utf-8")
    outcome = run("qc", path, "--array", array_file)
    assert outcome.status == 0
    assert outcome.err.count("rows lie outside the attitude's times") == 1


def test_an_attitude_whose_clock_goes_back_is_refused(run, tmp_path: Path) -> None:
    data = drive(np.tile([1.0, 0.0, 0.0, 0.0], (500, 1)))
    path = tmp_path / "drive.ulg"
    path.write_bytes(data)
    assert run("columns", path, "--out", tmp_path / "a.toml").status == 0
    at = data.rindex(struct.pack("<Q", 9_980_000) + np.float32(1.0).tobytes())  # the last attitude
    path.write_bytes(data[:at] + struct.pack("<Q", 3_000_000) + data[at + 8 :])
    outcome = run("qc", path, "--array", tmp_path / "a.toml")
    assert outcome.status == 2
    assert "drive.ulg: found 3.000000 s after 9.960000 s in row 500 of vehicle_attitude.yaw_deg" in outcome.err
    assert "cut the log there" in outcome.err


def test_paths_of_hdf5(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "log.h5", "w") as file:
        file["lab/field"] = 1e3 * np.arange(30.0).reshape(10, 3)
        file["lab/ticks"] = np.arange(10) * 5
    names = json.dumps([f"lab/field[{i}]" for i in range(3)])
    columns = f'[columns]\ntime = "lab/ticks"\ntime_unit = "ms"\n[columns.sensors]\ns1 = {names}\n'
    (tmp_path / "a.toml").write_text(SENSOR + columns)
    readings = magloc.read_readings(tmp_path / "log.h5", arrays.read_sensors(tmp_path / "a.toml"))
    np.testing.assert_allclose(readings.time_s, 0.005 * np.arange(10))
    np.testing.assert_allclose(readings.values_T, 1e-6 * np.arange(30.0).reshape(10, 3), rtol=1e-12)


def test_parquet_with_the_columns_of_a_readings_file(tmp_path: Path) -> None:
    columns = {"time_s": np.arange(5.0), **{f"s1_{axis}_nT": np.arange(5.0) + i for i, axis in enumerate("xyz")}}
    pd.DataFrame(columns).to_parquet(tmp_path / "log.parquet")
    (tmp_path / "a.toml").write_text(SENSOR)
    readings = magloc.read_readings(tmp_path / "log.parquet", arrays.read_sensors(tmp_path / "a.toml"))
    np.testing.assert_allclose(readings.values_T[:, 2], 1e-9 * (np.arange(5.0) + 2.0))


@pytest.mark.parametrize(
    ("columns", "words"),
    [
        ("", r"key columns\.unit: found nT for .* in G, expected unit = 100000 \(nT\)"),
        ('unit = "G"\ntime = "clock"', "found no channel clock"),
    ],
)
def test_faults_of_the_table_are_named(folder: Path, tmp_path: Path, columns: str, words: str) -> None:
    names = [f"vehicle_magnetometer.magnetometer_ga[{i}]" for i in range(3)]
    (tmp_path / "a.toml").write_text(f"{SENSOR}[columns]\n{columns}\n[columns.sensors]\ns1 = {json.dumps(names)}\n")
    with pytest.raises(InputError, match=words):
        magloc.read_readings(folder / "flight.ulg", arrays.read_sensors(tmp_path / "a.toml"))


def test_the_proposal_lists_all_messages_and_asks(run, folder: Path) -> None:
    said = run("columns", folder / "flight.BIN").out
    assert "# ArduPilot DataFlash." in said
    assert "#   IMU: 5000 rows, 250 Hz: GyrX [rad/s], GyrY [rad/s]" in said
    assert 'unit = "mG"' in said
    assert "# Asked: no channels of a place were found" in said


def test_the_proposal_lists_sensors_with_clocks_of_their_own(run, tmp_path: Path) -> None:
    """Old messages of PX4 have an accelerometer and a magnetometer with clocks of their own."""
    us, path = np.arange(0, 1_000_000, 10_000, dtype=np.uint64), tmp_path / "old.ulg"
    of_sensor = {
        f"{name}_timestamp_relative": np.full(len(us), later, np.int32)
        for name, later in (("accelerometer", 1_000), ("magnetometer", 2_000))
    }
    readings = {
        name: np.ones((len(us), 3), np.float32) for name in ("gyro_rad", "accelerometer_m_s2", "magnetometer_ga")
    }
    path.write_bytes(ulog([("sensor_combined", 0, {"timestamp": us, **readings, **of_sensor})]))
    out = run("columns", path).out
    assert "#   sensor_combined: 100 rows, 100 Hz: gyro_rad[0-2] [rad/s]" in out
    assert "#   sensor_combined (own clock of accelerometer_m_s2[0]): 100 rows, 100 Hz: accelerometer_m_s2[0-2]" in out
    assert "#   sensor_combined (own clock of magnetometer_ga[0]): 100 rows, 100 Hz: magnetometer_ga[0-2]" in out


def test_a_log_states_its_date_by_its_receiver(data_folder: Path) -> None:
    """The receiver of the autopilot states the 21st of April 2021, 06:30 UTC, at the start."""
    path = data_folder / "flight-logs" / "sample_log_small.ulg"
    assert date_of_log(path, arrays.LogColumns()) == "2021-04-21"
    names = tuple(f"vehicle_gps_position.{name}" for name in ("lat", "lon", "alt"))
    origin = origin_of_log(path, arrays.LogColumns(geodetic=names))
    np.testing.assert_allclose(origin, [63.4170622, 10.4082151, 66.814], rtol=1e-7)
