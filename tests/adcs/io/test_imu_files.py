"""Logs of inertial units: columns and units of one's own, and MAT files."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.io import savemat

import adcs
from adcs.io.imu_files import read_imu
from arrays.io.csv import write_columns
from arrays.io.errors import InputError

IMU = adcs.datasets.load("imu")
OWN = """
[log]
time = "stamp"
time_format = "unix"
moving = "m"
[log.gyro]
columns = ["p", "q", "r"]
unit = "deg/s"
samples = "point"
[log.accelerometer]
columns = ["ax", "ay", "az"]
unit = "g"
at_rest = "down"
mounting = [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]
[log.magnetometer]
columns = ["bx", "by", "bz"]
unit = "uT"
[log.truth]
columns = ["a", "b", "c", "d"]
order = "scalar-last"
"""


@pytest.fixture
def own(tmp_path):
    """The log of the package with other columns, units and axes, every fifth field only."""
    mounted = IMU.acceleration_m_s2 @ np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    field = np.where(np.arange(len(IMU.time_s))[:, None] % 5 == 0, 1e6 * IMU.field_T, np.nan)
    columns = {"stamp": IMU.time_s + 1.7e9, "m": (IMU.time_s > 8.0).astype(float), "text": ["x"] * len(IMU.time_s)}
    for names, values in (
        ("p q r", np.degrees(IMU.gyro_rad_s)),
        ("ax ay az", -mounted / 9.80665),
        ("bx by bz", field),
        ("a b c d", IMU.truth.as_quat()),
    ):
        columns |= dict(zip(names.split(), values.T, strict=True))
    write_columns(columns, tmp_path / "own.csv")
    (tmp_path / "own.toml").write_text(OWN)
    return tmp_path


def matlab(path, **changes):
    """A made-up trial of the benchmark."""
    n = len(IMU.time_s)
    content = {
        "sampling_rate": 25.0,
        "imu_gyr": IMU.gyro_rad_s,
        "imu_acc": IMU.acceleration_m_s2,
        "imu_mag": 1e6 * IMU.field_T,
        "opt_quat": IMU.truth.as_quat(scalar_first=True),
        "opt_pos": np.zeros((n, 3)),
        "movement": np.ones(n),
    }
    savemat(path, {name: value for name, value in (content | changes).items() if value is not None})
    return path


class TestRead:
    def test_of_the_package(self):
        log = read_imu(IMU.path)
        np.testing.assert_array_equal(log.record.rate_rad_s, IMU.gyro_rad_s)
        np.testing.assert_array_equal(log.record.field_T, IMU.field_T)
        assert log.q_true is None
        assert log.moving.all()

    def test_own_columns(self, own):
        log = read_imu(own / "own.csv", own / "own.toml")
        np.testing.assert_allclose(np.diff(log.record.time_s), np.diff(IMU.time_s), atol=1e-6)
        np.testing.assert_allclose(log.record.rate_rad_s, IMU.gyro_rad_s, rtol=1e-12)
        np.testing.assert_allclose(log.record.acceleration_m_s2, IMU.acceleration_m_s2, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(log.record.field_T[::5], IMU.field_T[::5], rtol=1e-12)
        assert np.isnan(log.record.field_T[1:5]).all()
        np.testing.assert_allclose(log.q_true, IMU.truth.as_quat(scalar_first=True), rtol=1e-12)
        assert log.record.gyro_samples == "point"
        assert log.moving.sum() == (IMU.time_s > 8.0).sum()

    @pytest.mark.parametrize(("time_format", "per_s"), [("milliseconds", 1e3), ("microseconds", 1e6)])
    def test_other_units_of_time(self, time_format, per_s, own):
        names = ["p", "q", "r", "ax", "ay", "az", "bx", "by", "bz", "a", "b", "c", "d", "m"]
        rates = np.column_stack([np.degrees(IMU.gyro_rad_s), IMU.acceleration_m_s2 / -9.80665, 1e6 * IMU.field_T])
        values = np.column_stack([rates, IMU.truth.as_quat(), np.ones(len(rates))])
        write_columns({"stamp": per_s * IMU.time_s, **dict(zip(names, values.T, strict=True))}, own / "own.csv")
        (own / "own.toml").write_text(OWN.replace('"unix"', f'"{time_format}"'))
        np.testing.assert_allclose(read_imu(own / "own.csv", own / "own.toml").record.time_s, IMU.time_s, atol=1e-9)

    def test_other_names_without_a_layout(self, tmp_path):
        write_columns({"time_s": IMU.time_s, "p": IMU.time_s}, tmp_path / "log.csv")
        with pytest.raises(InputError, match=r"found no such column.*; a layout \(--config\) names other columns"):
            read_imu(tmp_path / "log.csv")

    def test_degrees_without_a_layout(self, tmp_path):
        names = [f"{kind}_{axis}_{unit}" for kind, unit in KINDS for axis in "xyz"]
        values = np.column_stack([np.degrees(IMU.gyro_rad_s), IMU.acceleration_m_s2, 1e9 * IMU.field_T])
        write_columns({"time_s": IMU.time_s, **dict(zip(names, values.T, strict=True))}, tmp_path / "log.csv")
        np.testing.assert_allclose(read_imu(tmp_path / "log.csv").record.rate_rad_s, IMU.gyro_rad_s, rtol=1e-12)

    def test_matlab(self, tmp_path):
        log = read_imu(matlab(tmp_path / "trial.mat"))
        np.testing.assert_allclose(log.record.field_T, IMU.field_T, rtol=1e-12)
        np.testing.assert_allclose(log.record.time_s, IMU.time_s, atol=1e-9)
        assert log.position_m.shape == (len(IMU.time_s), 3)


KINDS = (("gyro", "deg_s"), ("acceleration", "m_s2"), ("field", "nT"))


class TestRefusals:
    @pytest.mark.parametrize(
        ("changes", "expected"),
        [
            ({"imu_gyr": None}, "found no variable imu_gyr"),
            ({"imu_mag": np.zeros((7, 3))}, "found variables of other shapes"),
            ({"imu_acc": np.zeros((1500, 3))}, "acceleration_m_s2 must have a length"),
            ({"sampling_rate": np.zeros((1, 1))}, "found the sampling rate 0, expected a positive number"),
        ],
    )
    def test_matlab(self, tmp_path, changes, expected):
        with pytest.raises(InputError, match=expected):
            read_imu(matlab(tmp_path / "trial.mat", **changes))

    def test_no_matlab_file(self, tmp_path):
        (tmp_path / "cut.mat").write_bytes(matlab(tmp_path / "trial.mat").read_bytes()[:4000])
        with pytest.raises(
            InputError, match=r"no MAT file that can be read, expected a trial of BROAD, version 7 at most\.$"
        ):
            read_imu(tmp_path / "cut.mat")
        with pytest.raises(InputError, match="does not exist"):
            read_imu(tmp_path / "none.mat")
        with pytest.raises(InputError, match="a MAT file with a layout"):
            read_imu(tmp_path / "trial.mat", tmp_path / "own.toml")

    def test_columns(self, own, tmp_path):
        write_columns({"time_s": IMU.time_s, "gyro_x": IMU.time_s}, tmp_path / "other.csv")
        with pytest.raises(InputError, match=r"column gyro_x_deg_s: found no such column \(the nearest is gyro_x\)"):
            read_imu(tmp_path / "other.csv")
        (tmp_path / "short.toml").write_text(OWN.replace('"ax"', '"axx"'))
        with pytest.raises(InputError, match="column axx: found no such column"):
            read_imu(own / "own.csv", tmp_path / "short.toml")
        (tmp_path / "no.toml").write_text(OWN.replace("[log.magnetometer]", "[log.magnet]"))
        with pytest.raises(InputError, match="magnet: found an unknown key"):
            read_imu(own / "own.csv", tmp_path / "no.toml")
