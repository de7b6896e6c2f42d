"""Logs of vehicles: CSV files, and binary logs of autopilots."""

import os
import threading
from dataclasses import replace

import numpy as np
import pytest

import adcs
import arrays
from sims.attitude.flights import FlightSettings, simulate_flight
from tests.adcs.log_calibration.flights import write_flight
from tests.written_logs import dataflash, ulog

FLIGHT = simulate_flight(2, FlightSettings(duration_s=30.0, magnetometers=2))


CALIBRATED = {
    "CAL_MAG0_ID": 0.0,
    "CAL_MAG1_ID": 77.0,
    "CAL_MAG1_ROT": 0.0,
    "CAL_MAG1_XOFF": 0.1,
    "CAL_MAG1_YOFF": -0.2,
    "CAL_MAG1_ZOFF": 0.3,
    "CAL_MAG1_XSCALE": 1.1,
    "CAL_MAG1_YSCALE": 0.9,
    "CAL_MAG1_ZSCALE": 1.0,
    "CAL_MAG1_XODIAG": 0.02,
}


LAYOUT = """
format_version = 1
[log]
time = "utc"
time_format = "utc"
[log.gyro]
columns = ["gyro_x_rad_s", "gyro_y_rad_s", "gyro_z_rad_s"]
unit = "rad/s"
[log.accelerometer]
[log.magnetometer]
columns = ["mast_x_nT", "mast_y_nT", "mast_z_nT"]
unit = "nT"
"""


def px4_log(path, *, magnetometer="sensor_mag", parameters=None, log=FLIGHT.log):
    """Write a flight as PX4 logs it; places in 1e-7 degrees."""
    stamp = (1e6 * log.time_s + 5e6).astype("u8")
    topics = [
        (
            "sensor_combined",
            0,
            {
                "timestamp": stamp,
                "gyro_rad": log.gyro_rad_s.astype("f4"),
                "accelerometer_timestamp_relative": np.zeros(len(stamp), "i4"),
                "accelerometer_m_s2": log.acceleration_m_s2.astype("f4"),
            },
        ),
        ("battery_status", 0, {"timestamp": stamp[::10], "current_a": log.currents[0].values[::10].astype("f4")}),
        (
            "vehicle_gps_position",
            0,
            {
                "timestamp": stamp[::100],
                "time_utc_usec": stamp[::100] + np.uint64(1_700_000_000_000_000),
                "lat": np.full(len(stamp[::100]), 473_000_000, "i4"),
                "lon": np.full(len(stamp[::100]), 85_000_000, "i4"),
                "alt": np.full(len(stamp[::100]), 500_000, "i4"),
                "fix_type": np.full(len(stamp[::100]), 3, "u1"),
            },
        ),
    ]
    for m, series in enumerate(log.magnetometers):
        gauss = 1e4 * series.values
        at = (1e6 * series.time_s + 5e6).astype("u8")
        if magnetometer == "sensor_mag":
            columns = {axis: gauss[:, i].astype("f4") for i, axis in enumerate("xyz")}
            device = {"device_id": np.full(len(at), 100 + m, "u4")}
            topics.append(("sensor_mag", m, {"timestamp": at, **device, **columns}))
        elif magnetometer == "vehicle_magnetometer" and m == 0:
            topics.append(("vehicle_magnetometer", 0, {"timestamp": at, "magnetometer_ga": gauss.astype("f4")}))
    path.write_bytes(ulog(topics, parameters))
    return path


class TestText:
    def test_magnetometers_and_currents_by_their_units(self, tmp_path):
        write_flight(FLIGHT, tmp_path / "log.csv")
        file = adcs.read_vehicle(tmp_path / "log.csv")
        assert [one.name for one in file.log.magnetometers] == ["field", "mag1"]
        assert [one.name for one in file.log.currents] == ["battery_A"]
        np.testing.assert_allclose(file.log.currents[0].values, FLIGHT.log.currents[0].values)
        read = file.log.magnetometers[1].finite().values
        np.testing.assert_allclose(read, FLIGHT.log.magnetometers[1].values[: len(read)], atol=1e-13)
        assert file.place is None

    @pytest.mark.parametrize("constant", [np.nan, 1e-5])
    def test_magnetometer_that_is_disabled(self, tmp_path, constant):
        dead = replace(FLIGHT.log.magnetometers[1], values=np.full_like(FLIGHT.log.magnetometers[1].values, constant))
        log = replace(FLIGHT.log, magnetometers=(FLIGHT.log.magnetometers[0], dead))
        write_flight(replace(FLIGHT, log=log), tmp_path / "log.csv")
        file = adcs.read_vehicle(tmp_path / "log.csv")
        assert [one.name for one in file.log.magnetometers] == ["field"]
        assert file.warnings == ("mag1 has no readings that vary, and is ignored",)

    def test_text_and_utc_columns_by_a_layout(self, tmp_path):
        """A magnetometer that the layout names is read once; cells of other columns may hold anything."""
        write_flight(FLIGHT, tmp_path / "log.csv")
        header, *rows = (tmp_path / "log.csv").read_text().splitlines()
        utc = np.datetime64("2026-05-12T10:00:00", "ms") + np.arange(len(rows)) * np.timedelta64(10, "ms")
        cells = [",".join([str(at), "STABILIZE", *row.split(",")[1:]]) for at, row in zip(utc, rows, strict=True)]
        header = header.replace("time_s", "utc,mode").replace("field_", "mast_")
        (tmp_path / "utc.csv").write_text("\n".join([header, *cells]))
        (tmp_path / "layout.toml").write_text(LAYOUT)
        file = adcs.read_vehicle(tmp_path / "utc.csv", tmp_path / "layout.toml")
        assert [one.name for one in file.log.magnetometers] == ["field", "mag1"]
        assert [one.name for one in file.log.currents] == ["battery_A"]
        np.testing.assert_allclose(np.diff(file.log.time_s), 0.01, atol=1e-6)

    def test_pipe(self, tmp_path):
        write_flight(FLIGHT, tmp_path / "log.csv")
        os.mkfifo(tmp_path / "pipe")
        writer = threading.Thread(target=(tmp_path / "pipe").write_bytes, args=[(tmp_path / "log.csv").read_bytes()])
        writer.start()
        file = adcs.read_vehicle(tmp_path / "pipe")
        writer.join()
        assert [one.name for one in file.log.magnetometers] == ["field", "mag1"]

    def test_named_current_that_is_missing(self, tmp_path):
        write_flight(FLIGHT, tmp_path / "log.csv")
        with pytest.raises(arrays.InputError, match=r"the nearest is battery_A"):
            adcs.read_vehicle(tmp_path / "log.csv", None, ["batery_A"])

    def test_log_without_magnetometer(self, tmp_path):
        flight = replace(FLIGHT, log=replace(FLIGHT.log))
        write_flight(flight, tmp_path / "log.csv")
        lines = (tmp_path / "log.csv").read_text().splitlines()
        (tmp_path / "bare.csv").write_text("\n".join(",".join(line.split(",")[:7]) for line in lines))
        with pytest.raises(arrays.InputError, match="one magnetometer"):
            adcs.read_vehicle(tmp_path / "bare.csv")


class TestPx4:
    def test_sensors_place_and_date(self, tmp_path):
        file = adcs.read_vehicle(px4_log(tmp_path / "log.ulg"))
        assert [one.name for one in file.log.magnetometers] == ["sensor_mag", "sensor_mag[1]"]
        assert [one.device_id for one in file.log.magnetometers] == [100, 101]
        np.testing.assert_allclose(file.log.magnetometers[0].values, FLIGHT.log.magnetometers[0].values, atol=1e-11)
        np.testing.assert_allclose(file.log.acceleration_m_s2, FLIGHT.log.acceleration_m_s2, atol=1e-5)
        assert [one.name for one in file.log.currents] == ["battery_status.current_a"]
        assert file.place == pytest.approx((47.3, 8.5, 500.0))
        assert file.date == "2023-11-14"
        assert not file.is_corrected

    def test_corrections_of_the_parameters_are_taken_out(self, tmp_path):
        """PX4 logs S (raw - offset), gauss; the parameters of the first device that has an identifier."""
        path = px4_log(tmp_path / "log.ulg", magnetometer="vehicle_magnetometer", parameters=CALIBRATED)
        file = adcs.read_vehicle(path)
        assert not file.is_corrected
        mag = file.log.magnetometers[0]
        assert mag.device_id == 77
        S = np.array([[1.1, 0.02, 0.0], [0.02, 0.9, 0.0], [0.0, 0.0, 1.0]])
        again = (1e4 * mag.values - [0.1, -0.2, 0.3]) @ S.T
        np.testing.assert_allclose(again, 1e4 * FLIGHT.log.magnetometers[0].values, atol=1e-6)

    def test_corrections_that_turn_the_axes_are_kept(self, tmp_path):
        turned = CALIBRATED | {"CAL_MAG1_ROT": 2.0}
        path = px4_log(tmp_path / "log.ulg", magnetometer="vehicle_magnetometer", parameters=turned)
        assert adcs.read_vehicle(path).is_corrected

    def test_corrected_fields_are_named(self, tmp_path):
        file = adcs.read_vehicle(px4_log(tmp_path / "log.ulg", magnetometer="vehicle_magnetometer"))
        assert file.is_corrected
        assert "adds to its parameters" in file.warnings[0]

    def test_magnetometer_that_is_disabled(self, tmp_path):
        still = replace(FLIGHT.log.magnetometers[1], values=np.full_like(FLIGHT.log.magnetometers[1].values, 1e-5))
        log = replace(FLIGHT.log, magnetometers=(FLIGHT.log.magnetometers[0], still))
        file = adcs.read_vehicle(px4_log(tmp_path / "log.ulg", log=log))
        assert [one.name for one in file.log.magnetometers] == ["sensor_mag"]
        assert "sensor_mag[1].x reads" in file.warnings[0]

    def test_no_magnetometer(self, tmp_path):
        with pytest.raises(arrays.InputError, match="found no readings of a magnetometer"):
            adcs.read_vehicle(px4_log(tmp_path / "log.ulg", magnetometer="none"))

    def test_layout_is_refused(self, tmp_path):
        with pytest.raises(arrays.InputError, match="binary log with a layout"):
            adcs.read_vehicle(px4_log(tmp_path / "log.ulg"), tmp_path / "log.toml")


OFS_mG, DIA, ODI = [[120.0, -80.0, 35.0], [-60.0, 10.0, 5.0]], [0.9, 1.1, 1.05], [0.02, -0.03, 0.04]


def ardupilot_log(path, *, learned_mG=0.0):
    """Write a flight as ArduPilot logs it, with two compasses; their parameters stand in the other order."""
    log = FLIGHT.log
    stamp = (1e6 * log.time_s + 5e6).astype("u8")
    columns = {"TimeUS": stamp, "I": np.zeros(len(stamp), "u1")}
    for name, values in (("Gyr", log.gyro_rad_s), ("Acc", log.acceleration_m_s2)):
        columns |= {f"{name}{axis}": values[:, i].astype("f4") for i, axis in enumerate("XYZ")}
    (xx, yy, zz), (xy, xz, yz) = DIA, ODI
    S = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    rows = []
    for k, series in enumerate(log.magnetometers):
        motor = np.outer(np.sin(series.time_s), [30.0, -20.0, 10.0]).round()
        field = (1e7 * series.values + OFS_mG[k]) @ S.T + motor
        parts = {"Mag": field, "Ofs": np.tile(np.array(OFS_mG[k]) + learned_mG, (len(field), 1)), "MO": motor}
        rows.append(
            {"TimeUS": (1e6 * series.time_s + 5e6).astype("u8"), "I": np.full(len(field), k, "u1")}
            | {
                f"{part}{axis}": of[:, i].round().astype("i2")
                for part, of in parts.items()
                for i, axis in enumerate("XYZ")
            }
        )
    parameters = {}
    for slot, k in (("", 1), ("2", 0)):
        for kind, three in (("OFS", OFS_mG[k]), ("DIA", DIA), ("ODI", ODI)):
            parameters |= {f"COMPASS_{kind}{slot}_{axis}": value for axis, value in zip("XYZ", three, strict=True)}
        parameters[f"COMPASS_DEV_ID{slot}"] = 70.0 + k
    mag = {name: np.concatenate([one[name] for one in rows]) for name in rows[0]}
    order = np.argsort(mag["TimeUS"], kind="stable")
    parm = {
        "TimeUS": stamp[:1].repeat(len(parameters)),
        "Name": np.array([name.encode() for name in parameters], "S16"),
        "Value": np.float32(list(parameters.values())),
    }
    messages = (
        ("PARM", parm, "s--", "F--"),
        ("IMU", columns, "s#EEEooo", "F-000000"),
        ("MAG", {name: of[order] for name, of in mag.items()}, "s#GGGGGGGGG", "F-CCCCCCCCC"),
    )
    path.write_bytes(dataflash(messages))
    return path


class TestArdupilot:
    def test_corrections_of_the_parameters_are_taken_out(self, tmp_path):
        """ArduPilot logs S (raw + offset) + motor as whole milligauss; the offsets tell which parameters are used."""
        file = adcs.read_vehicle(ardupilot_log(tmp_path / "log.bin"))
        assert not file.is_corrected
        assert [one.device_id for one in file.log.magnetometers] == [70, 71]
        for one, true in zip(file.log.magnetometers, FLIGHT.log.magnetometers, strict=True):
            np.testing.assert_allclose(one.values, true.values, atol=0.7e-7)

    def test_offsets_that_were_learned_in_flight(self, tmp_path):
        """No parameters have the logged offsets: the fields stay as they are, with a warning."""
        file = adcs.read_vehicle(ardupilot_log(tmp_path / "log.bin", learned_mG=7.0))
        assert file.is_corrected
        assert "adds to its parameters" in file.warnings[0]
