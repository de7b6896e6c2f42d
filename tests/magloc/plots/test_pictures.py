"""What the commands write for people to look at: PNG files, and CSV files with the data behind them."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from arrays.io.csv import write_columns
from magloc.calibration.results import residual_rms
from magloc.localization.fit.fixes import BODY_MATTERS
from magloc.plots.tracks import write_track_figures
from magloc.tracking.results import TrackPoint
from tests.command_line import Run, assert_refused, results_of
from tests.magloc.cli.test_calibrate import MOMENT, Files, made

N_ROWS = 24


def table(path: Path) -> dict[str, list[str]]:
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    return {name: [row[name] for row in rows] for name in rows[0]}


def numbers(cells: list[str]) -> np.ndarray:
    return np.array([float(cell) if cell else np.nan for cell in cells])


def assert_picture(path: Path) -> None:
    assert path.read_bytes().startswith(b"\x89PNG")


@pytest.fixture
def scene(run: Run, tmp_path: Path) -> Path:
    """Part of a simulated record in which the source is near."""
    assert run("simulate", "weaving", "--out", tmp_path / "weaving.csv").status == 0
    lines = (tmp_path / "weaving.csv").read_text(encoding="utf-8").splitlines()
    path = tmp_path / "readings.csv"
    path.write_text("\n".join([lines[0], *lines[140 : 140 + N_ROWS], ""]), encoding="utf-8")
    return tmp_path


class TestLocate:
    def test_writes_fixes_and_residuals(self, run: Run, scene: Path) -> None:
        folder = scene / "new" / "figures"
        truth = scene / "weaving-truth.csv"
        arguments = (scene / "readings.csv", "--array", scene / "weaving-array.toml", "--json")
        outcome = run("locate", *arguments, "--out", folder, "--truth", truth, "--quiet")
        assert outcome.err == ""
        entries = results_of(outcome)
        assert_picture(folder / "fixes.png")
        assert_picture(folder / "residuals.png")
        fixes, residuals = table(folder / "fixes.csv"), table(folder / "residuals.csv")
        best = [entry["solutions"][0] for entry in entries]
        position = np.array([solution["position_m"] for solution in best])
        np.testing.assert_allclose(numbers(fixes["y_m"]), position[:, 1])
        sigma = np.sqrt([solution["covariance"][2][2] for solution in best])
        np.testing.assert_allclose(numbers(fixes["s_z_m"]), sigma)
        assert numbers(fixes["detected"]).tolist() == [entry["detected"] for entry in entries]
        assert numbers(fixes["misfit"]).tolist() == [entry.get("misfit", False) for entry in entries]
        factor = numbers(fixes["body_factor"])
        said = [entry.get("body_factor", np.nan) for entry in entries]
        np.testing.assert_allclose(np.where(factor > BODY_MATTERS, factor, np.nan), said)
        true = np.column_stack([numbers(fixes[f"true_{name}_m"]) for name in "xyz"])
        np.testing.assert_allclose(numbers(fixes["error_m"]), np.linalg.norm(position - true, axis=1), rtol=1e-6)
        dof = numbers(fixes["dof"])
        np.testing.assert_allclose(numbers(fixes["chi2_high99"]), chi2.ppf(0.995, dof))
        assert list(residuals) == ["time_s", *(f"s{i}_{axis}_residual_sigmas" for i in range(1, 5) for axis in "xyz")]
        squares = sum(numbers(column) ** 2 for name, column in residuals.items() if name != "time_s")
        np.testing.assert_allclose(squares, numbers(fixes["chi2"]), rtol=1e-4)

    def test_truth_needs_a_folder(self, run: Run, scene: Path) -> None:
        truth = scene / "weaving-truth.csv"
        arguments = (scene / "readings.csv", "--array", scene / "weaving-array.toml")
        assert_refused(run("locate", *arguments, "--truth", truth), "--truth", "no --out")

    def test_truth_of_other_times(self, run: Run, scene: Path) -> None:
        truth = scene / "other.csv"
        truth.write_text("time_s,x_m,y_m,z_m\n-5,0,0,0\n", encoding="utf-8")
        arguments = (scene / "readings.csv", "--array", scene / "weaving-array.toml", "--out", scene / "figures")
        assert_refused(run("locate", *arguments, "--truth", truth), str(truth), "none of the times")
        assert not (scene / "figures").exists()

    def test_a_file_is_no_folder(self, run: Run, scene: Path) -> None:
        readings = scene / "readings.csv"
        outcome = run("locate", readings, "--array", scene / "weaving-array.toml", "--out", readings)
        assert_refused(outcome, f"--out {readings}", "expected a folder")
        assert outcome.out == ""


class TestTrack:
    def points(self) -> list[TrackPoint]:
        covariance = np.diag([1.0, 4.0, 9.0, 16.0, 25.0, 36.0])
        covariance[0, 1] = covariance[1, 0] = 1.0
        found = TrackPoint(1.0, np.arange(3.0), np.ones(3), covariance, np.full(6, 0.5), 2, 5.0, 9, "tracked")
        return [TrackPoint(0.0, status="not acquired: no signal"), found]

    def test_writes_both_pictures_and_one_table(self, tmp_path: Path) -> None:
        truth, nees = np.zeros((2, 3)), (np.array([np.nan, 7.5]), np.array([0, 6]))
        folder = tmp_path / "a" / "b"
        write_track_figures(self.points(), truth, folder, nees=nees, bound_m=np.array([np.inf, 0.5]), array_m=truth)
        assert_picture(folder / "track.png")
        assert_picture(folder / "consistency.png")
        columns = table(folder / "track.csv")
        assert columns["x_m"] == ["", "0.0"]
        assert columns["bound_m"] == ["", "0.5"]
        assert columns["status"] == ["not acquired: no signal", "tracked"]
        assert float(columns["nis_low99"][1]) == pytest.approx(chi2.ppf(0.005, 9))
        assert float(columns["nees_high99"][1]) == pytest.approx(chi2.ppf(0.995, 6))
        assert columns["nees"] == ["", "7.5"]

    def test_without_truth(self, tmp_path: Path) -> None:
        write_track_figures(self.points(), None, tmp_path)
        assert not any("nees" in name or "true" in name for name in table(tmp_path / "track.csv"))


class TestCalibrate:
    @pytest.fixture
    def files(self, tmp_path: Path) -> Files:
        return made(tmp_path, posed=True)

    def test_writes_changes_and_residuals(self, run: Run, files: Files) -> None:
        folder = files.folder / "figures"
        arguments = (files.readings, "--array", files.array, "--truth", files.truth(moment=True), "--out", files.out)
        outcome = run("calibrate", *arguments, "--json", "--figures", folder)
        assert outcome.status == 0, outcome.err
        sensors = json.loads(outcome.out)["sensors"]
        assert_picture(folder / "calibration.png")
        columns = table(folder / "calibration.csv")
        assert columns["sensor"] == [sensor["id"] for sensor in sensors]
        after, before = (numbers(columns[f"residual_rms_{when}_nT"]) for when in ("after", "before"))
        assert (before > 10.0 * after).all()
        deviation = [1e3 * sensor["position_sd_m"][1] for sensor in sensors]
        np.testing.assert_allclose(numbers(columns["s_position_y_mm"]), deviation)

    def test_a_file_is_no_folder(self, run: Run, files: Files) -> None:
        outcome = run(
            "calibrate", files.readings, "--array", files.array, "--out", files.out, "--figures", files.readings
        )
        assert_refused(outcome, f"--figures {files.readings}", "expected a folder")
        assert not files.out.exists()

    def test_turning(self, run: Run, files: Files) -> None:
        """Sensors of gains 1.1 without noise: the modulus is wrong by a tenth before, and right after."""
        rng = np.random.default_rng(3)
        field = rng.normal(size=(200, 3))
        field *= 48000.0 / np.linalg.norm(field, axis=1, keepdims=True)
        header = ["time_s", *(f"s{i}_{axis}_nT" for i in range(1, 7) for axis in "xyz")]
        values = 1.1 * np.tile(field, 6) + rng.normal(size=(200, 18))
        rows = [",".join([str(t), *map(repr, row.tolist())]) for t, row in enumerate(values)]
        files.readings.write_text("\n".join([",".join(header), *rows, ""]), encoding="utf-8")
        folder = files.folder / "figures"
        arguments = (files.readings, "--array", files.array, "--modulus-nT", 48000, "--out", files.out)
        outcome = run("calibrate", *arguments, "--figures", folder)
        assert outcome.status == 0, outcome.err
        assert_picture(folder / "turning.png")
        columns = table(folder / "turning.csv")
        np.testing.assert_allclose(numbers(columns["s3_modulus_before_nT"]), 52800.0, atol=10.0)
        np.testing.assert_allclose(numbers(columns["s3_modulus_after_nT"]), 48000.0, atol=10.0)

    def test_residuals_of_the_true_array_are_noise(self, files: Files) -> None:
        from magloc.readings import read_readings

        readings = read_readings(files.readings, files.true).values_T
        moments = np.swapaxes(files.world_from_array, -1, -2) @ MOMENT
        rms = residual_rms(files.true, readings, files.position_m, moments)
        # 40 rows of 3 numbers each: 0.8 to 1.2 of the noise, less what the common field takes, is beyond 4 σ.
        np.testing.assert_allclose(rms, 1e-9 * np.sqrt(5 / 6), rtol=0.3)


class TestColumns:
    def test_numbers_texts_and_what_is_missing(self, tmp_path: Path) -> None:
        columns = {"a_m": np.array([1.5, np.nan]), "n": np.array([1, 2]), "t": ['say "x", y', ""]}
        write_columns(columns, tmp_path / "c.csv")
        assert table(tmp_path / "c.csv") == {"a_m": ["1.5", ""], "n": ["1", "2"], "t": ['say "x", y', ""]}
