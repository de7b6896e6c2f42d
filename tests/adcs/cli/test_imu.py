"""``adcs imu``: what it writes and prints of a log."""

from __future__ import annotations

import json

import numpy as np
import pytest
from matplotlib import image

import adcs as package
from arrays import Calibration, Sensor, SensorArray
from arrays.array_file import write_array
from arrays.io.csv import read_table, write_columns
from tests.adcs.refusals import assert_refused
from tests.command_line import refuse_constant

IMU = package.datasets.load("imu")


@pytest.fixture
def log(tmp_path):
    """The package's log with its truth."""
    table = read_table(IMU.path, "a log")
    columns = dict(zip(table.header, table.values.T, strict=True))
    columns |= dict(zip(("qw", "qx", "qy", "qz"), IMU.truth.as_quat(scalar_first=True).T, strict=True))
    write_columns(columns | {"moving": (IMU.time_s > 8.0).astype(float)}, tmp_path / "log.csv")
    return tmp_path / "log.csv"


class TestImu:
    def test_files(self, adcs, log, tmp_path):
        outcome = adcs("imu", log, "--out", tmp_path / "out", "--json")
        assert outcome.status == 0, outcome.err
        summary = json.loads(outcome.out, parse_constant=refuse_constant)
        table = read_table(tmp_path / "out" / "attitude.csv", "attitudes")
        assert table.header == (
            *("time_s", "qw", "qx", "qy", "qz"),
            *("sigma_tilt_deg", "sigma_heading_deg", "disturbed"),
        )
        values = table.complete(table.header)
        assert len(values) == summary["rows"] == len(IMU.time_s)
        assert values[:, 7].mean() == pytest.approx(summary["disturbed_fraction"])
        np.testing.assert_array_equal(np.unique(values[:, 7]), [0.0, 1.0])
        readings = IMU.gyro_rad_s, IMU.acceleration_m_s2, IMU.field_T
        track = package.inertial_magnetic_filter(IMU.time_s, *readings)
        np.testing.assert_allclose(values[:, 1:5], track.q, atol=1e-12)
        assert image.imread(tmp_path / "out" / "attitude.png").std() > 0.05

    def test_methods(self, adcs, log):
        """A magnet comes to sit on the unit and goes: subtracted, or ignored."""
        found = {}
        for method in ("auto", "plain", "reject", "subtract"):
            outcome = adcs("imu", log, "--method", method, "--json", "--quiet")
            found[method] = json.loads(outcome.out, parse_constant=refuse_constant)
        assert {method: one["method"] for method, one in found.items()} == {
            "auto": "subtract",
            "plain": "plain",
            "reject": "reject",
            "subtract": "subtract",
        }
        assert found["auto"]["flags"] == ["field-left-out", "magnet-subtracted"]
        assert found["auto"]["total_rms_deg"] < 2.0
        assert 0.2 < found["auto"]["disturbed_fraction"] < 0.4
        squares = found["auto"]["heading_rms_deg"] ** 2 + found["auto"]["inclination_rms_deg"] ** 2
        assert found["auto"]["total_rms_deg"] ** 2 == pytest.approx(squares, rel=0.02)

    def test_calibration(self, adcs, log, tmp_path):
        """A log with hard and soft iron and its calibration give the attitude of the log without."""
        table = read_table(log, "a log")
        columns = dict(zip(table.header, table.values.T, strict=True))
        scale, offset_nT = np.array([[1.1, 0.05, 0.0], [0.0, 0.9, 0.02], [0.0, 0.0, 1.05]]), [9000.0, -7000.0, 4000.0]
        names = [f"field_{axis}_nT" for axis in "xyz"]
        read = np.stack([columns[name] for name in names], axis=1) @ scale.T + offset_nT
        write_columns(columns | dict(zip(names, read.T, strict=True)), tmp_path / "iron.csv")
        calibration = Calibration.of("vector", scale, 1e-9 * np.array(offset_nT))
        sensor = Sensor("field", "vector", (0.0, 0.0, 0.0), 1e-7, calibration=calibration)
        write_array(tmp_path / "mag.toml", SensorArray((sensor,), common_field_T=7e-5))
        clean = json.loads(adcs("imu", log, "--json").out)
        mended = json.loads(adcs("imu", tmp_path / "iron.csv", "--calibration", tmp_path / "mag.toml", "--json").out)
        assert mended["total_rms_deg"] == pytest.approx(clean["total_rms_deg"], rel=1e-6)

    def test_calibration_of_a_scalar_sensor(self, adcs, log, tmp_path):
        sensor = Sensor("total", "scalar", (0.0, 0.0, 0.0), 1e-9)
        write_array(tmp_path / "mag.toml", SensorArray((sensor,), common_field_T=7e-5))
        assert_refused(adcs("imu", log, "--calibration", tmp_path / "mag.toml"), "found sensors total (scalar)")

    def test_words(self, adcs, log):
        outcome = adcs("imu", log, "--offline", "--quiet")
        first, second = outcome.out.splitlines()
        assert first.startswith("1500 rows; a magnet that moves with the sensor was subtracted; disturbed in ")
        assert second.startswith("rms while it moved: ")
        assert "minute 1: the field was ignored" in adcs("imu", log, "--method", "reject").err

    def test_without_truth(self, adcs):
        summary = json.loads(adcs("imu", IMU.path, "--json", "--quiet").out)
        assert "total_rms_deg" not in summary
        assert set(summary) == {"rows", "method", "disturbed_fraction", "flags", "seconds"}

    def test_without_a_magnetometer(self, adcs, tmp_path):
        """No columns of a field: flagged in JSON, said on stderr, and a misspelt column is no missing magnetometer."""
        table = read_table(IMU.path, "a log")
        columns = dict(zip(table.header, table.values.T, strict=True))
        six = {name: values for name, values in columns.items() if "field" not in name}
        write_columns(six, tmp_path / "six.csv")
        outcome = adcs("imu", tmp_path / "six.csv", "--json", "--out", tmp_path / "out")
        summary = json.loads(outcome.out)
        assert summary["method"] == "six-axes"
        assert summary["flags"] == ["heading-relative"]
        assert "there is no magnetometer" in outcome.err
        write_columns(six | {"mag_x": IMU.time_s}, tmp_path / "other.csv")
        assert_refused(adcs("imu", tmp_path / "other.csv"), "column field_x_nT: found no such column")

    def test_a_misread_gyro(self, adcs, tmp_path):
        table = read_table(IMU.path, "a log")
        columns = dict(zip(table.header, table.values.T, strict=True))
        turned = {n: -values if n.startswith("gyro") else values for n, values in columns.items()}
        write_columns(turned, tmp_path / "log.csv")
        outcome = adcs("imu", tmp_path / "log.csv", "--out", tmp_path / "out")
        assert_refused(
            outcome, "log.csv: gyro_rad_s must turn as the other sensors do", "the gyro, all its signs reversed"
        )
        assert not (tmp_path / "out").exists()

    def test_refusals(self, adcs, log, tmp_path):
        assert_refused(adcs("imu", tmp_path / "none.csv"), "none.csv does not exist")
        text = log.read_text().splitlines()
        log.write_text("\n".join([text[0], *text[900:], *text[1:5]]))
        assert_refused(adcs("imu", log), "line 603, column time_s", "expected times that ascend")
        log.write_text("\n".join(text[:5]))
        assert_refused(adcs("imu", log), "time_s must cover a second at least")
