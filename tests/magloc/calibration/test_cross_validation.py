"""Calibrations on a measured path: what rows left out say, and how far a calibration carries over."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import arrays
import magloc
from magloc.calibration.array import calibrate_on_path
from magloc.calibration.cross_validation import CrossValidation, choose_common_field, leave_poses_out
from tests.command_line import Run
from tests.magloc.calibration.test_array import MOMENT, PRIOR, Passage, passage


def measured(case: Passage, sigma_m: float = 0.0) -> tuple[magloc.Readings, magloc.Truth]:
    """Readings and a truth with errors, whose moment has an unknown strength."""
    error = sigma_m * np.random.default_rng(8).normal(size=case.position_m.shape)
    n = len(error)
    axis = np.tile(MOMENT / np.linalg.norm(MOMENT), (n, 1))
    readings = magloc.Readings(case.readings_T)
    truth = magloc.Truth(readings.time_s, case.position_m + error, axis=axis, sigma_m=np.full(n, sigma_m))
    return readings, truth


class TestMeasuredPath:
    def test_strength(self) -> None:
        """A moment of known direction: its strength times the gains is that of the readings."""
        case = passage(3)
        readings, truth = measured(case)
        result = magloc.calibrate(case.array, readings, truth=truth, prior=PRIOR)
        assert result.converged
        ratio = np.linalg.norm(result.moment_Am2, axis=1) / np.linalg.norm(MOMENT)
        found, true = result.array.channel_gain, case.true_array.channel_gain
        factor = np.vdot(found, true) / np.vdot(true, true)
        np.testing.assert_allclose(ratio * factor, 1.0, rtol=0, atol=1e-3)
        np.testing.assert_allclose(np.cross(result.moment_Am2, MOMENT), 0.0, rtol=0, atol=1e-12)

    def test_errors_of_the_path(self) -> None:
        """Over sixty rows 5 σ bounds hold for a true model, and the path is found better than it was measured."""
        case = passage(3, noise_T=1e-9, noisy=True)
        readings, truth = measured(case, 3e-4)
        result = magloc.calibrate(case.array, readings, truth=truth, prior=PRIOR)
        exact = magloc.calibrate(case.array, readings, truth=replace(truth, sigma_m=None), prior=PRIOR)
        assert abs(result.chi2 - result.dof) < 5.0 * np.sqrt(2.0 * result.dof)
        assert exact.chi2 > 100.0 * exact.dof
        better = np.linalg.norm(result.position_m - case.position_m, axis=1)
        assert np.median(better) < 0.5 * np.median(np.linalg.norm(truth.position_m - case.position_m, axis=1))

    def test_understated_noise(self) -> None:
        """Priors count for as much as by the noise that the residuals show; χ² is that of the stated noise."""
        case = passage(3, noise_T=1e-8, noisy=True)
        quiet = tuple(replace(sensor, noise_T=1e-9) for sensor in case.array.sensors)
        moments = np.broadcast_to(MOMENT, case.position_m.shape)
        stated, understated = (
            calibrate_on_path(array, case.readings_T, case.position_m, moment_Am2=moments, prior=PRIOR)
            for array in (case.array, replace(case.array, sensors=quiet))
        )
        np.testing.assert_allclose(understated.sigma, stated.sigma, rtol=0.1, atol=1e-9)
        np.testing.assert_allclose(understated.chi2, 100.0 * stated.chi2, rtol=0.01)


class TestCrossValidation:
    def test_rows_left_out(self) -> None:
        case = passage(3, noise_T=1e-9, noisy=True)
        validation = leave_poses_out(case.array, *measured(case), prior=PRIOR)
        assert validation is not None
        assert validation.error_m.shape == (60,)
        # The calibration of all rows, judged on rows of its own with no noise in the sensors' unknowns.
        fixes = magloc.locate(case.true_array, case.readings_T, body_length_m=0.0)
        least = np.median(np.linalg.norm(fixes.position_m - case.position_m, axis=1))
        assert least < np.median(validation.error_m) < 5.0 * least

    def test_rows_without_a_fix_count_as_the_worst(self) -> None:
        """Or a calibration that locates only the easy rows would seem better."""
        assert CrossValidation(np.array([1.0, 3.0, np.nan, np.nan])).mean_m == 2.5
        assert CrossValidation(np.full(3, np.nan)).mean_m == np.inf

    def test_too_few_rows(self) -> None:
        case = passage(3, n=19)
        assert leave_poses_out(case.array, *measured(case), prior=PRIOR) is None

    @pytest.mark.parametrize(("common_field_T", "is_small"), [(1e-7, True), (5e-5, False)])
    def test_common_field(self, common_field_T: float, is_small: bool) -> None:
        """A common field that stays small counts; one that changes by the Earth's does not."""
        case = passage(3, noise_T=3e-7, noisy=True, common_field_T=common_field_T)
        unstated = replace(case.array, common_field_T=None)
        chosen, validation = choose_common_field(unstated, *measured(case), prior=PRIOR)
        assert validation is not None
        assert (chosen.common_field_T is not None) is is_small


class TestRecording:
    """Calibrated on run 3 alone, used on runs 1 and 2."""

    @pytest.fixture
    def recording(self, data_folder: Path) -> Path:
        folder = data_folder / "magnet-mocap"
        if not folder.is_dir():
            pytest.skip("needs the recording magnet-mocap")
        return folder

    @pytest.mark.slow_after(1)
    @pytest.mark.parametrize("unknown_strength", [False, True])
    def test_carries_over(self, recording: Path, tmp_path: Path, run: Run, unknown_strength: bool) -> None:
        truth_path, out = recording / "run3-truth.csv", tmp_path / "array.toml"
        if unknown_strength:
            truth = magloc.read_truth(truth_path)
            assert truth.moment_Am2 is not None
            axis = truth.moment_Am2 / np.linalg.norm(truth.moment_Am2, axis=1)[:, None]
            columns = np.column_stack([truth.time_s, truth.position_m, axis, np.full(len(axis), 1.5e-4)])
            truth_path = tmp_path / "axes.csv"
            header = "time_s,x_m,y_m,z_m,axis_x,axis_y,axis_z,sigma_m"
            np.savetxt(truth_path, columns, delimiter=",", header=header, comments="")
        nominal = recording / "array-nominal.toml"
        arguments = ("--array", nominal, "--truth", truth_path, "--out", out, "--json")
        report = json.loads(run("calibrate", recording / "run3.csv", *arguments).out)
        assert report["cross_validation"]["background"] == "subtracted"
        assert report["cross_validation"]["median_m"] <= 0.16e-3
        array = arrays.read_array(out)
        for number, largest_mm in ((1, 0.35), (2, 0.26)):
            fixes = magloc.locate(array, magloc.read_readings(recording / f"run{number}.csv", array))
            true_m = magloc.read_truth(recording / f"run{number}-truth.csv").position_m
            assert 1e3 * np.median(np.linalg.norm(fixes.position_m - true_m, axis=1)) <= largest_mm
