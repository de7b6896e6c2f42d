"""ULog files against pyulog itself, real ones and written ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pyulog import ULog

import magloc
from arrays.io.errors import InputError
from tests.written_logs import ulog

FILES = ("sample.ulg", "sample_log_small.ulg")
CLOCK = np.arange(1_000_000, 3_000_000, 20_000, dtype=np.uint64)
FIELD_G = np.linspace(0.1, 0.4, 3 * len(CLOCK), dtype=np.float32).reshape(-1, 3)


def write(path: Path, *topics: tuple[str, int, dict[str, object]], **parameters: float) -> Path:
    path.write_bytes(ulog(topics, parameters))
    return path


@pytest.fixture
def flight(tmp_path: Path) -> Path:
    mag = {"timestamp": CLOCK, "timestamp_sample": CLOCK - 5000, "x": FIELD_G[:, 0], "y": FIELD_G[:, 1]}
    return write(tmp_path / "flight.ulg", ("sensor_mag", 0, mag), ("sensor_mag", 2, mag), CAL_MAG0_ROT=6.0)


@pytest.mark.parametrize("name", FILES)
def test_every_number_of_a_real_log_is_that_of_pyulog(name: str, data_folder: Path) -> None:
    path = data_folder / "flight-logs" / name
    log = magloc.read_log(path)
    expected = 0
    for message in ULog(str(path)).data_list:
        topic = message.name + (f"[{message.multi_id}]" if message.multi_id else "")
        for field, values in message.data.items():
            if field in ("timestamp", "timestamp_sample"):
                continue
            expected += 1
            channel = log[f"{topic}.{field}"]
            if len(channel) == len(values):
                np.testing.assert_allclose(channel.values / channel.si_per_unit, values, rtol=1e-15)
            else:  # a sensor whose sample stands for several rows
                assert set(channel.values) <= set(values.astype(float) * channel.si_per_unit)
    made = {f"vehicle_attitude.{angle}_deg" for angle in ("yaw", "pitch", "roll")}
    assert len(log) == expected + len(made & set(log))


def test_a_sensor_inside_another_message_has_its_own_clock(data_folder: Path) -> None:
    path = data_folder / "flight-logs" / "sample.ulg"
    (message,) = (each for each in ULog(str(path)).data_list if each.name == "sensor_combined")
    sample_us = message.data["timestamp"].astype(np.int64) + message.data["magnetometer_timestamp_relative"]
    log = magloc.read_log(path)
    gyro, mag = log["sensor_combined.gyro_rad[0]"], log["sensor_combined.magnetometer_ga[0]"]
    assert gyro.rate_Hz == pytest.approx(250.0)
    np.testing.assert_allclose(mag.time_s, 1e-6 * np.unique(sample_us), rtol=1e-12)


def test_clock_units_instances_and_parameters(flight: Path) -> None:
    log = magloc.read_log(flight)
    assert list(log) == ["sensor_mag.x", "sensor_mag.y", "sensor_mag[2].x", "sensor_mag[2].y"]
    channel = log["sensor_mag[2].x"]
    np.testing.assert_allclose(channel.time_s, 1e-6 * CLOCK - 0.005, rtol=1e-12)
    np.testing.assert_allclose(channel.values, 1e-4 * FIELD_G[:, 0].astype(float), rtol=1e-12)
    assert (channel.unit, channel.logged_unit, channel.clock) == ("T", "G", "boot")
    assert channel.rate_Hz == pytest.approx(50.0)
    assert log.parameters == {"CAL_MAG0_ROT": 6.0}
    assert log.unix_zero_s is None
    assert log.warnings == ()


def test_the_date_is_that_of_the_receiver(tmp_path: Path) -> None:
    gps = {"timestamp": CLOCK, "time_utc_usec": CLOCK + np.uint64(1_618_986_638_000_000)}
    assert magloc.read_log(write(tmp_path / "a.ulg", ("sensor_gps", 0, gps))).unix_zero_s == 1_618_986_638.0


def test_the_whole_messages_of_a_cut_log_are_read(flight: Path, caplog: pytest.LogCaptureFixture) -> None:
    data = flight.read_bytes()
    whole = len(magloc.read_log(flight)["sensor_mag.x"])
    flight.write_bytes(data[: 2 * len(data) // 3])
    log = magloc.read_log(flight)
    assert len(log["sensor_mag.x"]) == pytest.approx(0.66 * whole, abs=3.0)


def test_the_nearest_name_is_in_the_error(flight: Path) -> None:
    with pytest.raises(InputError, match=r"no channel sensor_mag\.z \(the nearest is sensor_mag\.[xy]\)"):
        magloc.read_log(flight).require("sensor_mag.z")


def test_a_clock_that_restarts_is_refused(tmp_path: Path) -> None:
    stamp = np.concatenate([CLOCK, CLOCK])
    combined = {"timestamp": stamp, "gyro_rad": np.zeros((len(stamp), 3), np.float32)}
    path = tmp_path / "two-boots.ulg"
    path.write_bytes(ulog([("sensor_combined", 0, combined)], ordered=False))
    with pytest.raises(InputError, match=r"found 1\.000000 s after 2\.980000 s in row 101"):
        magloc.read_log(path).vectors(["sensor_combined.gyro_rad[0]"])


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"ULog\x01\x12\x35", "header of ULog without readable messages"),
        (b"ULog\x01\x12\x35\x01" + bytes(8), "without messages"),
        (b"time_s,a\n0,1\n", "no format of a log that is known"),
        (None, "does not exist"),
    ],
)
def test_bad_files_are_refused(tmp_path: Path, data: bytes | None, words: str) -> None:
    path = tmp_path / "bad.ulg"
    if data is not None:
        path.write_bytes(data)
    with pytest.raises(InputError, match=words):
        magloc.read_log(path)


def test_other_times_are_no_vector(tmp_path: Path) -> None:
    mag = {"timestamp": CLOCK, "x": FIELD_G[:, 0]}
    path = write(tmp_path / "a.ulg", ("sensor_mag", 0, mag), ("sensor_mag", 1, {**mag, "timestamp": CLOCK + 1}))
    with pytest.raises(InputError, match="channels of one message"):
        magloc.read_log(path).vectors(["sensor_mag.x", "sensor_mag[1].x"])
