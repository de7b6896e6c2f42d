"""``adcs estimate``: the filters of ``adcs run`` on a log, here on the one that ``adcs run --out`` writes."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest
from matplotlib import image

from adcs import quaternion
from adcs.cli.app import main
from arrays.io.csv import write_columns
from tests.adcs.refusals import assert_refused
from tests.command_line import refuse_constant


@pytest.fixture(scope="module")
def example(tmp_path_factory):
    """Folder of a run of Sun, field and gyro with a bias."""
    folder = tmp_path_factory.mktemp("example")
    arguments = ["--sensors", "mag+sun+gyro", "--states", "gyro-bias", "--duration", "300", "--seeds", "1"]
    assert main(["run", "one-vector", *arguments, "--out", str(folder), "--quiet"]) == 0
    return folder


def table(path):
    with path.open() as file:
        rows = list(csv.DictReader(file))
    return {name: np.array([float(row[name] or "nan") for row in rows]) for name in rows[0]}


def errors_deg(columns, truth):
    q, true = (np.stack([part[name] for name in ("qw", "qx", "qy", "qz")], axis=1) for part in (columns, truth))
    return np.degrees(quaternion.angle_between(q, true))


def estimated(adcs, example, *options):
    """Columns of the estimates, without the files and pictures of ``--out``."""
    files = (example / "telemetry.csv", "--config", example / "scenario.toml")
    outcome = adcs("estimate", *files, *options, "--json")
    assert outcome.status == 0, outcome.err
    rows = json.loads(outcome.out, parse_constant=refuse_constant)["results"]
    return {name: np.array([row[name] for row in rows], dtype=np.float64) for name in rows[0]}


class TestExample:
    @pytest.mark.parametrize("sensors", ["mag+sun+gyro", "st", "st+gyro", "mag+sun"])
    def test_finds_the_truth_from_nowhere(self, adcs, example, sensors):
        """The acceptance limits of 200 s, as length of the error's vector: √3 times those of an axis."""
        states = ("--states", "gyro-bias") if "gyro" in sensors else ("--states", "none")
        error = errors_deg(estimated(adcs, example, "--sensors", sensors, *states), table(example / "truth.csv"))
        limit = {"mag+sun+gyro": 4e-2, "st": 9e-4, "st+gyro": 9e-4, "mag+sun": 0.14}[sensors]
        assert np.sqrt(np.mean(error[-60:] ** 2)) < 3**0.5 * limit

    def test_inertial_attitude_is_that_of_the_star_tracker(self, adcs, example, tmp_path):
        files = (example / "telemetry.csv", "--config", example / "scenario.toml")
        assert adcs("estimate", *files, "--out", tmp_path, "--quiet").status == 0
        columns, log = table(tmp_path / "estimates.csv"), table(example / "telemetry.csv")
        ours = np.stack([columns[f"eci_q{part}"] for part in "wxyz"], axis=1)
        stars = np.stack([log[f"star_q{part}"] for part in "wxyz"], axis=1)
        assert np.degrees(quaternion.angle_between(ours, stars))[-60:].max() < 0.15

    def test_gyro_bias(self, adcs, example):
        columns, truth = estimated(adcs, example), table(example / "truth.csv")
        for axis in "xyz":
            name = f"gyro_bias_{axis}_deg_s"
            assert abs(columns[name][-1] - truth[name][-1]) < 4.0 * columns[f"sigma_{name}"][-1]

    def test_files_and_pictures(self, adcs, example, tmp_path):
        files = (example / "telemetry.csv", "--config", example / "scenario.toml")
        outcome = adcs("estimate", *files, "--out", tmp_path)
        assert sorted(path.name for path in tmp_path.iterdir()) == [
            "attitude.aem",
            "consistency.png",
            "estimates.csv",
            "estimates.png",
            "orbit.oem",
        ]
        assert "wrote estimates.csv" in outcome.err
        assert image.imread(tmp_path / "estimates.png").shape[0] > 700
        assert "bias of the gyro" in outcome.out

    def test_json(self, adcs, example):
        outcome = adcs("estimate", example / "telemetry.csv", "--config", example / "scenario.toml", "--json")
        found = json.loads(outcome.out, parse_constant=refuse_constant)
        assert list(found) == ["results", "warnings"]
        assert len(found["results"]) == 301
        assert {"time_s", "qw", "eci_qw", "sigma_attitude_x_deg", "rate_x_deg_s", "gyro_bias_x_deg_s"} <= set(
            found["results"][0]
        )

    @pytest.mark.parametrize("name", ["constant-gain", "parallel-disturbance", "reduced", "smoother"])
    def test_every_filter(self, adcs, example, name):
        columns = estimated(adcs, example, "--sensors", "st+gyro", "--filter", name)
        error = errors_deg(columns, table(example / "truth.csv"))
        assert error[-60:].max() < 0.01


class TestGaps:
    def test_rows_that_are_not_there(self, adcs, example, tmp_path):
        lines = (example / "telemetry.csv").read_text().splitlines()
        gap = tmp_path / "gap.csv"
        gap.write_text("\n".join([*lines[:100], *lines[130:], ""]))
        outcome = adcs("estimate", gap, "--config", example / "scenario.toml", "--out", tmp_path)
        assert outcome.status == 0
        columns = table(tmp_path / "estimates.csv")
        assert len(columns["time_s"]) == 301 - 30
        assert columns["sigma_attitude_x_deg"][99] > columns["sigma_attitude_x_deg"][98]

    def test_starts_where_something_is_known(self, adcs, example, tmp_path):
        lines = (example / "telemetry.csv").read_text().splitlines()
        empty = [f"{line.split(',')[0]}{',' * line.count(',')}" for line in lines[1:11]]
        late = tmp_path / "late.csv"
        late.write_text("\n".join([lines[0], *empty, *lines[11:], ""]))
        outcome = adcs("estimate", late, "--config", example / "scenario.toml", "--json")
        assert outcome.status == 0
        assert len(json.loads(outcome.out)["results"]) == 291


class TestRefusals:
    def test_no_reading_of_a_sensor_in_use(self, adcs, example, tmp_path):
        columns = table(example / "telemetry.csv")
        names = [name for name in columns if not name.startswith("sun")]
        log = tmp_path / "log.csv"
        rows = [",".join(f"{columns[name][i]:.12g}" for name in names) for i in range(20)]
        log.write_text("\n".join([",".join(names), *rows, ""]))
        assert_refused(
            adcs("estimate", log, "--config", example / "scenario.toml"), "must have readings of the Sun sensor"
        )

    def test_a_set_that_cannot_observe_attitude(self, adcs, example):
        files = (example / "telemetry.csv", "--config", example / "scenario.toml")
        assert_refused(adcs("estimate", *files, "--sensors", "sun+gyro"), "must observe attitude", "Add a star tracker")

    def test_no_such_files(self, adcs, example, tmp_path):
        missing = tmp_path / "none"
        assert_refused(adcs("estimate", missing, "--config", example / "scenario.toml"), f"{missing} does not exist")
        assert_refused(adcs("estimate", example / "telemetry.csv", "--config", missing), f"{missing} does not exist")


class TestVectors:
    def test_rows_with_both(self, adcs, example, tmp_path):
        files = (example / "telemetry.csv", "--config", example / "scenario.toml")
        outcome = adcs("vectors", *files, "--out", tmp_path, "--json", "--quiet")
        columns, truth = table(tmp_path / "vectors.csv"), table(example / "truth.csv")
        assert len(json.loads(outcome.out, parse_constant=refuse_constant)["results"]) == len(columns["time_s"])
        rows = np.isin(np.round(truth["time_s"], 6), np.round(columns["time_s"], 6))
        both = {name: values[rows] for name, values in truth.items()}
        assert np.median(errors_deg(columns, both)) < 1.0
        assert adcs("vectors", *files, "--method", "triad").out.startswith(f"{len(columns['time_s'])} rows")

    def test_refusal(self, adcs, example, tmp_path):
        path = tmp_path / "log.csv"
        path.write_text("time_s,sun_x,sun_y,sun_z\n0,1,0,0\n")
        assert_refused(adcs("vectors", path, "--config", example / "scenario.toml"), "both magnetometer and Sun sensor")


class TestMisreading:
    def test_is_one_sentence(self, adcs, example, tmp_path):
        columns = table(example / "telemetry.csv")
        for axis in "xyz":
            columns[f"field_{axis}_nT"] = 1e-3 * columns[f"field_{axis}_nT"]
        path = tmp_path / "log.csv"
        write_columns(columns, path)
        assert_refused(adcs("estimate", path, "--config", example / "scenario.toml"), "magnetometer in µT taken for nT")
