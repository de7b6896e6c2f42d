"""Bags that rosbags itself writes."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

import magloc
from arrays.io.errors import InputError

N, START_S = 40, 1_750_000_000.0
TIME_S = START_S + 0.02 * np.arange(N)
FIELD_T = np.random.default_rng(2).normal(0.0, 3e-5, (N, 3))
RATE = np.random.default_rng(3).normal(size=(N, 3))


def messages(store, first: bool):
    """Yield topic, type, time of the recording and message: stamps are 5 ms before the recording."""
    of = store.types
    header, time = of["std_msgs/msg/Header"], of["builtin_interfaces/msg/Time"]
    for t, field, rate in zip(TIME_S, FIELD_T, RATE, strict=True):
        stamp = time(int(t), round(1e9 * (t - int(t))))
        head = header(7, stamp, "imu") if first else header(stamp, "imu")
        vector = of["geometry_msgs/msg/Vector3"]
        mag = of["sensor_msgs/msg/MagneticField"](head, vector(*field), np.zeros(9))
        zero, q = vector(0.0, 0.0, 9.8), of["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
        imu = of["sensor_msgs/msg/Imu"](head, q, np.zeros(9), vector(*rate), np.zeros(9), zero, np.zeros(9))
        at = round(1e9 * (t + 0.005))
        yield "/mag", "sensor_msgs/msg/MagneticField", at, mag
        yield "/imu/data", "sensor_msgs/msg/Imu", at, imu
        yield "/temperature", "std_msgs/msg/Float64", at, of["std_msgs/msg/Float64"](20.0 + field[0])
        yield "/name", "std_msgs/msg/String", at, of["std_msgs/msg/String"]("text")


def write_ros1(path: Path, restart: int = N) -> Path:
    """Write a bag in which all drivers start again at a row."""
    store = get_typestore(Stores.ROS1_NOETIC)
    with Writer1(path) as writer:
        known = {}
        for i, (topic, kind, at, message) in enumerate(messages(store, True)):
            if (key := (topic, i // 4 < restart)) not in known:
                known[key] = writer.add_connection(topic, kind, typestore=store, callerid=f"/driver{key[1]}")
            writer.write(known[key], at, store.serialize_ros1(message, kind))
    return path


def write_ros2(path: Path, storage: StoragePlugin) -> Path:
    store = get_typestore(Stores.ROS2_HUMBLE)
    with Writer2(path, version=9, storage_plugin=storage) as writer:
        known = {}
        for topic, kind, at, message in messages(store, False):
            if topic not in known:
                known[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(known[topic], at, store.serialize_cdr(message, kind))
    return path


@pytest.fixture(params=["bag", "folder", "db3", "mcap"])
def bag(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    if request.param == "bag":
        return write_ros1(tmp_path / "flight.bag")
    storage = StoragePlugin.MCAP if request.param == "mcap" else StoragePlugin.SQLITE3
    folder = write_ros2(tmp_path / "flight", storage)
    if request.param == "folder":
        return folder
    (file,) = folder.glob(f"*.{request.param}")
    return Path(shutil.copy(file, tmp_path / f"one.{request.param}"))


def test_the_numbers_are_those_that_were_written(bag: Path) -> None:
    log = magloc.read_log(bag)
    time_s, field_T = log.vectors([f"/mag.magnetic_field.{axis}" for axis in "xyz"])
    np.testing.assert_array_equal(field_T, FIELD_T)
    np.testing.assert_allclose(time_s, TIME_S, rtol=0.0, atol=1e-6)
    rate = log.vectors([f"/imu/data.angular_velocity.{axis}" for axis in "xyz"])[1]
    np.testing.assert_array_equal(rate, RATE)
    assert log["/mag.magnetic_field.x"].unit == "T"
    assert log["/imu/data.angular_velocity.x"].unit == "rad/s"
    assert log["/imu/data.linear_acceleration.z"].unit == "m/s2"
    assert not any(name.startswith("/name") for name in log)


def test_a_message_without_a_stamp_has_the_time_of_the_recording(bag: Path) -> None:
    time_s = magloc.read_log(bag)["/temperature.data"].time_s
    np.testing.assert_allclose(time_s, TIME_S + 0.005, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("name", ["a.bag", "a.mcap", "a.db3"])
def test_a_damaged_bag_is_refused(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    magic = {"a.bag": b"#ROSBAG V2.0\n", "a.mcap": b"\x89MCAP0\r\n", "a.db3": b"SQLite format 3\0"}[name]
    path.write_bytes(magic + bytes(100))
    with pytest.raises(InputError, match="bag that cannot be read"):
        magloc.read_log(path)


def test_a_driver_that_starts_again_loses_no_rows(tmp_path: Path) -> None:
    """ROS 1 records it as a second publisher of the same topic."""
    log = magloc.read_log(write_ros1(tmp_path / "flight.bag", restart=15))
    time_s, field_T = log.vectors([f"/mag.magnetic_field.{axis}" for axis in "xyz"])
    np.testing.assert_allclose(time_s, TIME_S, rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(field_T, FIELD_T, rtol=1e-15)
