"""Attitude from logs of PX4, ArduPilot and ROS, whose conventions a simulated flight states."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import adcs
from adcs import quaternion
from arrays.io.errors import InputError
from tests.robot_flights import DECLINATION_RAD, Flight
from tests.written_logs import ulog

FLIGHT = Flight(1)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("flights")
    (path / "flight.ulg").write_bytes(FLIGHT.px4())
    (path / "flight.BIN").write_bytes(FLIGHT.ardupilot())
    return path


@pytest.mark.parametrize("name", ["flight.ulg", "flight.BIN"])
class TestFlight:
    def test_the_nose_of_the_autopilots_attitude_points_along_its_yaw(self, folder: Path, name: str) -> None:
        """A yaw of a from north, at rest: the nose is (sin a, cos a, 0) in east, north, up."""
        log = adcs.read_imu(folder / name)
        yaw = 0.7 + DECLINATION_RAD
        body = quaternion.to_rotation(log.q_autopilot[100])
        np.testing.assert_allclose(body.apply([1.0, 0.0, 0.0]), [np.sin(yaw), np.cos(yaw), 0.0], atol=1e-4)
        np.testing.assert_allclose(body.apply([0.0, 0.0, 1.0]), [0.0, 0.0, -1.0], atol=1e-4)

    def test_the_estimate_is_that_of_the_autopilot_but_for_the_declination(self, adcs, folder: Path, name: str) -> None:
        found = json.loads(adcs("imu", folder / name, "--json").out)
        assert found["autopilot_total_median_deg"] < 1.0
        assert found["autopilot_heading_offset_deg"] == pytest.approx(np.degrees(DECLINATION_RAD), abs=0.5)
        assert found["magnetometer_lag_s"] == pytest.approx(0.03, abs=5.0 * found["magnetometer_lag_sigma_s"])
        assert found["method"] != "six-axes"

    def test_each_sample_is_in_one_row(self, folder: Path, name: str) -> None:
        record = adcs.read_imu(folder / name).record
        is_read = np.isfinite(record.field_T[:, 0])
        assert is_read.sum() == pytest.approx(len(FLIGHT.field_s), abs=10)
        time_s = record.time_s[is_read] - 10.0
        expected = FLIGHT.ned_from_body(time_s).inv().apply([2e-5, 0.0, 4.3e-5])
        assert np.abs(record.field_T[is_read] - expected).max() < 5e-7  # also mG in whole numbers

    def test_a_layout_is_refused(self, folder: Path, name: str) -> None:
        with pytest.raises(InputError, match="found the log of an autopilot with a layout"):
            adcs.read_imu(folder / name, folder / "layout.toml")


def test_the_picture_and_the_rows_are_written(adcs, folder: Path, tmp_path: Path) -> None:
    said = adcs("imu", folder / "flight.ulg", "--out", tmp_path)
    assert "median difference from the autopilot" in said.out
    assert {path.name for path in tmp_path.iterdir()} == {"attitude.csv", "attitude.png"}


def test_a_real_flight_log_agrees_with_its_autopilot(adcs, data_folder: Path) -> None:
    """On the bench: PX4's estimate has the declination from a table, here of 0.1 degrees."""
    found = json.loads(adcs("imu", data_folder / "flight-logs" / "sample.ulg", "--json").out)
    assert found["autopilot_total_median_deg"] < 0.5
    assert found["autopilot_tilt_median_deg"] < 0.1


def px4(path: Path, **columns: object) -> Path:
    """Write a log of a few seconds whose columns of sensor_combined and magnetometer are replaced."""
    stamp = np.arange(1_000_000, 9_000_000, 10_000, dtype=np.uint64)
    n, rng = len(stamp), np.random.default_rng(0)
    combined = {
        "timestamp": stamp,
        "gyro_rad": rng.normal(0.0, 1e-3, (n, 3)).astype(np.float32),
        "accelerometer_m_s2": rng.normal([0.0, 0.0, -9.81], 0.05, (n, 3)).astype(np.float32),
    }
    field = {
        "timestamp": stamp,
        "magnetometer_ga": rng.normal([0.2, 0.0, 0.43], 1e-3, (n, 3)).astype(np.float32),
    }
    for name, value in columns.items():
        for topic in (combined, field):
            if name in topic:
                topic[name] = np.broadcast_to(np.asarray(value, np.asarray(topic[name]).dtype), np.shape(topic[name]))
    names = {"gyro": "gyro_rad", "accelerometer": "accelerometer_m_s2"}
    for name in columns.get("without", ()):
        del combined[names[name]]
    path.write_bytes(ulog([("sensor_combined", 0, combined), ("vehicle_magnetometer", 0, field)], ordered=False))
    return path


@pytest.mark.parametrize("value", [(0.0, 0.0, 0.0), (0.1, 0.2, 0.3), (np.nan, np.nan, np.nan)])
def test_a_magnetometer_that_stands_is_left_out_with_a_warning(adcs, tmp_path: Path, value: object) -> None:
    said = adcs("imu", px4(tmp_path / "a.ulg", magnetometer_ga=value), "--json")
    found = json.loads(said.out)
    assert found["method"] == "six-axes"
    assert any("T in all rows" in warning and "ignored" in warning for warning in found["warnings"])


@pytest.mark.parametrize(
    ("columns", "words"),
    [
        ({"without": ("gyro",)}, "found no gyro, expected one of PX4"),
        ({"without": ("accelerometer",)}, "found no accelerometer, expected one of PX4"),
        ({"gyro_rad": (0.0, 0.0, 0.0)}, "found a gyro sensor_combined.gyro_rad[0] that stands at"),
        ({"gyro_rad": (np.nan, np.nan, np.nan)}, "found a gyro sensor_combined.gyro_rad[0] that stands at [nan"),
        ({"accelerometer_m_s2": (np.nan, np.nan, np.nan)}, "that stands at [nan, nan, nan], expected one that works"),
        ({"timestamp": np.tile(np.arange(1_000_000, 5_000_000, 10_000), 2)}, "expected a clock that advances"),
    ],
)
def test_bad_logs_are_refused_in_one_sentence(adcs, tmp_path: Path, columns: dict[str, object], words: str) -> None:
    path = px4(tmp_path / "bad.ulg", **columns)
    said = adcs("imu", path)
    assert said.status == 2
    assert words in said.err
    assert said.err.count("\n") == 1


def test_ros_is_east_north_up_from_forward_left_up() -> None:
    """REP 103: at rest with the nose to the east, the quaternion is the identity."""
    from magloc.logs.channels import Log, Topic
    from magloc.logs.sensors import find_sensors

    time_s = np.arange(0.0, 2.0, 0.01)
    q = Rotation.from_euler("z", np.linspace(0.0, 0.1, len(time_s))[:, None]).as_quat()
    noise = np.random.default_rng(0).normal(size=(3, len(time_s)))
    fields = {f"angular_velocity.{a}": of for a, of in zip("xyz", noise, strict=True)}
    fields |= {f"linear_acceleration.{a}": of for a, of in zip("xyz", noise, strict=True)}
    fields |= {f"orientation.{a}": of for a, of in zip("xyzw", q.T, strict=True)}
    log = Log("a.bag", "ROS 1 bag", (Topic("/imu", time_s, fields, {}, "unix"),))
    own_s, rotation = find_sensors(log).own_attitude
    np.testing.assert_array_equal(own_s, time_s)
    np.testing.assert_allclose(rotation[0].apply([1.0, 0.0, 0.0]), [1.0, 0.0, 0.0], atol=1e-12)
