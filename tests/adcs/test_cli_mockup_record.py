"""Tests of ``adcs run mockup --part fusion`` with a recording: files that a simulated drive wrote, and bad ones."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from adcs.cli import main
from tests.adcs.refusals import assert_refused

SAMPLES_HEADER = "time_s,acceleration_x_m_s2,acceleration_y_m_s2,rate_deg_s"
FIXES_HEADER = "exposure_s,arrival_s,x_m,y_m,heading_deg"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Files of a drive with false fixes."""
    folder = tmp_path_factory.mktemp("drive")
    short = ("--seeds", "1", "--duration", "40", "--false-fixes", "0.05", "--quiet")
    assert main(["run", "mockup", "--part", "fusion", *short, "--out", str(folder)]) == 0
    return folder


@pytest.fixture
def files(folder):
    return ("--samples", folder / "mockup-fusion.csv", "--fixes", folder / "mockup-fixes.csv")


class TestRecording:
    def test_the_estimate_is_near_the_truth(self, adcs, folder, files, tmp_path):
        outcome = adcs("run", "mockup", "--part", "fusion", *files, "--out", tmp_path, "--json")
        assert outcome.status == 0, outcome.err
        result = json.loads(outcome.out)
        assert {path.name for path in tmp_path.iterdir()} == {"mockup-fusion.png", "mockup-estimate.csv"}
        truth = np.genfromtxt(folder / "mockup-fusion.csv", delimiter=",", names=True)
        estimate = np.genfromtxt(tmp_path / "mockup-estimate.csv", delimiter=",", names=True)
        x, y = (np.interp(estimate["time_s"], truth["time_s"], truth[f"true_{axis}_m"]) for axis in "xy")
        late = estimate["time_s"] > 12.0
        apart = np.hypot(estimate["x_m"] - x, estimate["y_m"] - y)[late]
        assert np.sqrt(np.mean(apart**2)) < 0.01
        fixes = np.genfromtxt(folder / "mockup-fixes.csv", delimiter=",", names=True)
        assert result["rejected_fixes"] == fixes["false"].sum() > 0
        assert result["position_m"] == pytest.approx([estimate["x_m"][-1], estimate["y_m"][-1]], abs=1e-6)

    def test_other_methods_and_text(self, adcs, files):
        filtered, source = (
            json.loads(adcs("run", "mockup", "--part", "fusion", *files, "--fusion", name, "--json").out)
            for name in ("ekf", "velocity-corrected")
        )
        assert filtered["difference_rms_mm"] < source["difference_rms_mm"]
        assert source["rejected_fixes"] == 0
        lines = adcs("run", "mockup", "--part", "fusion", *files, "--fusion", "imu").out.splitlines()
        assert lines[0].endswith("fusion imu")
        assert lines[2].endswith("none")


class TestRefusals:
    @pytest.fixture
    def refused(self, adcs, tmp_path):
        """The outcome for the rows of two files."""

        def run(samples, fixes):
            for name, header, rows in (("s.csv", SAMPLES_HEADER, samples), ("f.csv", FIXES_HEADER, fixes)):
                (tmp_path / name).write_text("\n".join([header, *rows, ""]))
            files = ("--samples", tmp_path / "s.csv", "--fixes", tmp_path / "f.csv")
            return adcs("run", "mockup", "--part", "fusion", *files, "--out", tmp_path / "out")

        return run

    @pytest.mark.parametrize(
        ("samples", "fixes", "fragments"),
        [
            (["0,0,0,0", "0.02,0,0,0", "0.01,0,0,0"], ["0,0.6,0,0,0"], ("s.csv, line 4", "0.01 s after 0.02")),
            (["0,0,0,0", "0,0,0,0"], ["0,0.6,0,0,0"], ("s.csv, line 3", "expected times that increase")),
            (["0,0,0,0"], ["0,0.6,0,0,0"], ("s.csv", "two samples at least")),
            (["0,0,0,x", "1,0,0,0"], ["0,0.6,0,0,0"], ("s.csv, line 2, column rate_deg_s", "'x'")),
            (["0,0,0,0", "1,0,0,0"], ["0,0.6,0,0,0", "0.1,0.5,0,0,0"], ("f.csv, line 3", "do not go back")),
            (["0,0,0,0", "1,0,0,0"], ["0.7,0.6,0,0,0"], ("f.csv, line 2, column arrival_s", "after the exposure")),
            (["0,0,0,0", "1,0,0,0"], ["5,5.6,0,0,0"], ("f.csv", "found no exposure from -1 to 1 s")),
            (["0,0,0,0", "1,0,0,0"], ["0,0.6,0,,0"], ("f.csv, line 2, column y_m", "found no value")),
        ],
    )  # fmt: skip
    def test_bad_rows(self, refused, tmp_path, samples, fixes, fragments):
        assert_refused(refused(samples, fixes), *fragments)
        assert not (tmp_path / "out").exists()

    def test_a_missing_column(self, adcs, folder, tmp_path):
        (tmp_path / "f.csv").write_text("exposure_s,arrival_s,x_m,y_m,heading_rad\n0,0.6,0,0,0\n")
        samples = ("--samples", folder / "mockup-fusion.csv")
        outcome = adcs("run", "mockup", "--part", "fusion", *samples, "--fixes", tmp_path / "f.csv")
        assert_refused(outcome, "column heading_deg", "the nearest is heading_rad")

    @pytest.mark.parametrize(
        ("arguments", "sentence"),
        [
            (("--samples", "s.csv"), "--samples: found it without --fixes, expected both."),
            (("--fixes", "f.csv"), "--fixes: found it without --samples, expected both."),
            (("--samples", "s", "--fixes", "f", "--seeds", "2"), "--seeds: found it with --samples, expected it with"),
            (("--samples", "s", "--fixes", "f", "--fusion", "all"), "--fusion all: found it with --samples"),
            (
                ("--samples", "s", "--fixes", "f", "--view"),
                "--view: found it with --samples, expected it with simulated",
            ),
            (("--samples", "no.csv", "--fixes", "f"), "no.csv"),
        ],
    )
    def test_options(self, adcs, arguments, sentence):
        assert_refused(adcs("run", "mockup", "--part", "fusion", *arguments), sentence)
