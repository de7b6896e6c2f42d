"""Tests of ``adcs run mockup --part fusion`` with a recording: files that a simulated drive wrote, and bad ones."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from adcs.cli.app import main
from adcs.mockup.navigation.strapdown import wrapped
from sims.experiments.mockup_recording import fused_record
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


def table_of(path):
    return np.genfromtxt(path, delimiter=",", names=True)


class TestGaps:
    """Samples are missing from 15 to 25 s, fixes are not."""

    @pytest.fixture
    def gap(self, folder, tmp_path):
        rows = (folder / "mockup-fusion.csv").read_text().splitlines()
        (tmp_path / "s.csv").write_text("\n".join([*rows[:1501], *rows[2501:], ""]))
        fixes = (folder / "mockup-fixes.csv").read_text()
        (tmp_path / "f.csv").write_text(
            "".join(row for row in fixes.splitlines(keepends=True) if not row.endswith(",1,0\n"))
        )
        return ("run", "mockup", "--part", "fusion", "--samples", tmp_path / "s.csv", "--fixes", tmp_path / "f.csv")

    def test_fixes_within_are_used_and_sigma_covers_the_errors(self, folder, gap):
        """12,000 errors, normal with these σ, would go beyond 6 σ with a probability of less than 3e-5."""
        run = fused_record(gap[5], gap[7], "ekf")
        result, found = run.summary(), run.fused.track
        assert result["used_fixes"] == result["fixes"] == len(table_of(gap[7])) - 1
        assert result["samples"] < 3000
        (gap_s,) = result["gaps_s"]
        assert gap_s == pytest.approx([15.0, 25.0])
        truth = table_of(folder / "mockup-fusion.csv")
        rows = np.searchsorted(truth["time_s"], found.time_s - 1e-4)
        within = (found.time_s > 15.001) & (found.time_s < 25.001)
        assert within.sum() == 1000
        true_m = np.column_stack([truth["true_x_m"], truth["true_y_m"]])[rows]
        apart_m, sigma_m = np.abs(found.position_m - true_m), found.sigma[:, :2]
        assert (apart_m < 6.0 * sigma_m).all()
        assert apart_m[within].max() < 0.15
        assert 0.005 < sigma_m[within].mean() < 0.06
        apart_rad = np.abs(wrapped(found.heading_rad - np.radians(truth["true_heading_deg"][rows])))
        assert (apart_rad < 6.0 * found.sigma[:, 4]).all()

    @pytest.mark.parametrize("method", ["ekf", "paper", "velocity-corrected", "imu", "camera"])
    def test_every_method_names_it(self, adcs, gap, method):
        outcome = adcs(*gap, "--fusion", method)
        assert outcome.status == 0
        assert outcome.err.count("\n") == 1
        assert outcome.err.startswith("adcs: warning: ")
        assert "s.csv: found no samples from 15 to 25 s, expected one every 0.01 s; " in outcome.err
        assert adcs(*gap, "--fusion", method, "--quiet").err == ""


class TestCounts:
    def test_they_add_up_to_the_fixes_of_the_file(self, adcs, folder, files, tmp_path):
        """One fix is early, one comes again, one when nobody waits for it any more, one after the samples."""
        rows = (folder / "mockup-fixes.csv").read_text().splitlines()
        header, first, *later = rows
        early = ",".join(["-5", "0.1", *first.split(",")[2:]])
        again, old = later[3], ",".join(["1.01", "39.99", *first.split(",")[2:]])
        after = ",".join(["39.9", "41", *first.split(",")[2:]])
        late = sorted([*later, again, old], key=lambda row: float(row.split(",")[1]))
        (tmp_path / "f.csv").write_text("\n".join([header, early, first, *late, after, ""]))
        arguments = ("run", "mockup", "--part", "fusion", *files[:2], "--fixes", tmp_path / "f.csv")
        result = json.loads(adcs(*arguments, "--json").out)
        unused = result["unused_fixes"]
        assert (unused["duplicate"], unused["too old"], unused["rejected"]) == (1, 1, result["rejected_fixes"])
        assert result["used_fixes"] + sum(unused.values()) == result["fixes"]
        assert (result["early_fixes"], result["pending_fixes"]) == (1, 1)
        assert 1 + 1 + result["fixes"] + 1 == len(rows) - 1 + 4
        text = adcs(*arguments).out.splitlines()[1]
        assert text.endswith(
            f"{result['used_fixes']} used, {unused['rejected']} rejected, 1 duplicate, 1 too old; "
            "1 more before the first; 1 more after the last sample"
        )

    def test_they_add_up_to_the_fixes_of_simulated_drives(self, adcs):
        short = ("--part", "fusion", "--seeds", "1", "--duration", "20", "--repeated", "0.3", "--false-fixes", "0.1")
        result = json.loads(adcs("run", "mockup", *short, "--json").out)
        unused = result["unused_fixes"]
        assert unused["duplicate"] > 0
        assert result["used_fixes"] + sum(unused.values()) == result["fixes"]
        text = adcs("run", "mockup", *short).out.splitlines()[-1]
        numbers = [int(word) for word in text.split(";")[0].replace(":", "").split() if word.isdigit()]
        assert numbers[0] == sum(numbers[1:]) == result["fixes"]


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
            (["0,0,0,0", "1,0,0,0"], ["0,0.6,1e300,0,0"], ("f.csv, line 2, column x_m", "from -100 to 100 m")),
            (["0,0,0,0", "1,0,0,0"], ["0,0.6,0,-101,0"], ("f.csv, line 2, column y_m", "from -100 to 100 m")),
            (["0,0,0,0", "1,0,0,0"], ["0,0.6,0,0,1e300"], ("f.csv, line 2, column heading_deg", "a heading")),
            (["0,,0,0", "1,,0,0"], ["0,0.6,0,0,0"], ("s.csv, line 1, column acceleration_x_m_s2", "found no reading")),
            (["0,0,9.81,0", "1,0,9.8,0"], ["0,0.6,0,0,0"], ("column acceleration_y_m_s2", "up to 0.5 m/s²")),
            (["0,0,0,", "1,0,0,999"], ["0,0.6,0,0,0"], ("column rate_deg_s", "found no reading up to 200 °/s")),
            (["0,0,0,0", "1,0,0,0", "2,0,0,0", "1e300,0,0,0"], ["0,0.6,0,0,0"],
             ("s.csv, line 5, column time_s", "found 1e+300 s after 2 s", "within 1e+05 s")),
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
            (("--samples", "s.csv"), "--samples: found without --fixes, expected both."),
            (("--fixes", "f.csv"), "--fixes: found without --samples, expected both."),
            (("--samples", "s", "--fixes", "f", "--seeds", "2"), "--seeds: found with --samples, expected with"),
            (("--samples", "s", "--fixes", "f", "--fusion", "all"), "--fusion: found all with a recording"),
            (
                ("--samples", "s", "--fixes", "f", "--view"),
                "--view: found with --samples, expected with simulated",
            ),
            (("--samples", "no.csv", "--fixes", "f"), "no.csv"),
        ],
    )
    def test_options(self, adcs, arguments, sentence):
        assert_refused(adcs("run", "mockup", "--part", "fusion", *arguments), sentence)
