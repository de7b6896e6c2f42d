"""``adcs calibrate``: a magnetometer from a log, here of a satellite whose gains and bias were put in."""

from __future__ import annotations

import csv
import json
import math

import numpy as np
import pytest

from adcs import quaternion
from adcs.cli.app import main
from adcs.environment.environment import environment
from adcs.io.scenario_files import read_scenario
from adcs.io.telemetry_files import telemetry_columns
from adcs.satellite.telemetry import Telemetry
from arrays.io.csv import write_columns
from tests.adcs.refusals import assert_refused
from tests.command_line import refuse_constant

GAIN = np.eye(3) + np.array([[0.04, 0.01, 0.0], [0.0, -0.03, 0.0], [0.0, 0.0, 0.02]])
BIAS_T = np.array([900e-9, -600e-9, 300e-9])


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """Two hours of a satellite that tumbles: telemetry.csv and scenario.toml."""
    folder = tmp_path_factory.mktemp("calibrate")
    assert main(["run", "tabletsat", "--duration", "60", "--seeds", "1", "--out", str(folder), "--quiet"]) == 0
    text = (folder / "scenario.toml").read_text()
    (folder / "scenario.toml").write_text("step_s = 10.0\n" + text.replace("step_s = 1.0\n", ""))
    satellite = read_scenario(str(folder / "scenario.toml")).satellite
    time_s = np.arange(0.0, 7200.0, 10.0)
    b = environment(satellite.orbit, satellite.start, time_s).b_orbital_T
    turn = quaternion.multiply(
        quaternion.exp(0.01 * time_s[:, None] * np.array([0.6, 0.0, 0.8])),
        quaternion.exp(0.03 * time_s[:, None] * np.array([0.0, 1.0, 0.0])),
    )
    noise_T = 250e-9 * np.random.default_rng(0).standard_normal(b.shape)
    readings = quaternion.rotate_back(turn, b) @ GAIN.T + BIAS_T + noise_T
    write_columns(telemetry_columns(Telemetry(time_s, field_T=readings)), folder / "telemetry.csv")
    return folder


def files(log):
    return log / "telemetry.csv", "--config", log / "scenario.toml"


class TestResult:
    @pytest.mark.slow
    def test_json(self, adcs, log):
        outcome = adcs("calibrate", *files(log), "--json", "--quiet")
        assert outcome.status == 0, outcome.err
        found = json.loads(outcome.out, parse_constant=refuse_constant)
        assert found["rows_used"] == found["rows"] == 720
        assert found["rms_nT"] < 300.0 < found["raw_rms_nT"]
        for axis, bias_T in zip("xyz", BIAS_T, strict=True):
            assert abs(found[f"bias_{axis}_nT"] - 1e9 * bias_T) < 4.0 * found[f"sigma_bias_{axis}_nT"] < 400.0
        M = np.eye(3) + np.array([[found[f"gain_{i}{j}_percent"] / 100.0 for j in "xyz"] for i in "xyz"])
        np.testing.assert_allclose(M @ M.T, GAIN @ GAIN.T, rtol=0, atol=0.01)
        assert abs(found["time_shift_s"]) < 4.0 * found["sigma_time_shift_s"]
        assert not any("residuals are" in text for text in found["warnings"])
        assert any("does not determine gain_" in text for text in found["warnings"])

    @pytest.mark.slow
    def test_text_and_log(self, adcs, log, tmp_path):
        outcome = adcs("calibrate", *files(log), "--out", tmp_path / "calibrated.csv")
        assert outcome.status == 0, outcome.err
        for words in ("rms of the modulus", "bias, x y z [nT]", "D, row z [%]", "time shift [s]", "1 is consistent"):
            assert words in outcome.out
        assert "does not determine" in outcome.err
        with (tmp_path / "calibrated.csv").open() as file:
            rows = list(csv.DictReader(file))
        modulus = np.array([math.hypot(*(float(row[f"field_{axis}_nT"]) for axis in "xyz")) for row in rows])
        satellite = read_scenario(str(log / "scenario.toml")).satellite
        b = environment(satellite.orbit, satellite.start, np.arange(0.0, 7200.0, 10.0)).b_orbital_T
        assert np.std(modulus - 1e9 * np.linalg.norm(b, axis=1)) < 320.0

    def test_misfit_is_said(self, adcs, log, tmp_path):
        """Noise that is stated ten times too small."""
        text, scenario = (log / "scenario.toml").read_text(), tmp_path / "quiet.toml"
        assert "noise_nT = 250.0" in text
        scenario.write_text(text.replace("noise_nT = 250.0", "noise_nT = 10.0\n"))
        outcome = adcs("calibrate", log / "telemetry.csv", "--config", scenario)
        assert outcome.status == 0, outcome.err
        assert "residuals are" in outcome.err


class TestRefusals:
    @pytest.mark.parametrize(
        ("arguments", "fragments"),
        [
            (["--time-shift-s", "-1"], ["--time-shift-s", "0 or more"]),
            (["--attitude", "sun"], ["--attitude", "orbital"]),
            (["--out", "calibrated.txt"], ["--out", ".csv"]),
        ],
    )
    def test_one_line(self, adcs, log, arguments, fragments):
        assert_refused(adcs("calibrate", *files(log), *arguments), *fragments)

    def test_a_log_without_a_magnetometer(self, adcs, log, tmp_path):
        time_s = np.arange(0.0, 500.0, 10.0)
        only = Telemetry(time_s, gyro_rad_s=np.zeros((50, 3)))
        write_columns(telemetry_columns(only), tmp_path / "gyro.csv")
        outcome = adcs("calibrate", tmp_path / "gyro.csv", "--config", log / "scenario.toml")
        assert_refused(outcome, "gyro.csv", "must have 20 rows of the magnetometer", "instead received 0")
