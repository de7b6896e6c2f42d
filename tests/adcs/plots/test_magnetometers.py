"""Figures of magnetometers on board: every number of the result is where its panel says."""

from __future__ import annotations

import numpy as np
import pytest

import adcs
from adcs.plots.magnetometers import magnetometer_figure
from adcs.satellite.magnetometer_calibration import NAMES, Attitude
from sims import experiments


class TestOwnFields:
    def test_a_panel_for_each_load_has_the_fields_at_all_magnetometers(self) -> None:
        run = experiments.switching_loads(rng=0, duration_s=600.0)
        own = adcs.find_own_fields(run.array, run.readings_T, run.time_s, run.gyro_rad_s, run.states)
        axes = own.plot().axes
        assert [ax.get_title("left").partition(":")[0] for ax in axes] == ["heater", "radio"]
        assert [label.get_text() for label in axes[-1].get_xticklabels()] == list(run.array.ids)
        for ax, vectors_T, sigma_T in zip(axes, own.vectors_T, own.sigma_T, strict=True):
            shown = [bars.lines[0].get_ydata() for bars in ax.containers]
            np.testing.assert_allclose(np.transpose(shown), 1e9 * vectors_T)
            spans = [np.ptp(bars.lines[2][0].get_segments(), axis=1)[:, 1] for bars in ax.containers]
            np.testing.assert_allclose(np.transpose(spans), 6e9 * sigma_T)


class TestCalibration:
    @pytest.mark.parametrize(("attitude", "components"), [("none", 1), ("orbital", 3)])
    @pytest.mark.parametrize("time_shift_s", [0.0, 30.0])
    def test_residuals_and_numbers(self, attitude: Attitude, components: int, time_shift_s: float) -> None:
        log, prior = adcs.datasets.load("satellite"), adcs.MagnetometerPrior(time_shift_s=time_shift_s)
        result = adcs.calibrate_magnetometer(log.telemetry, log.satellite, prior=prior, attitude=attitude)
        left, numbers = magnetometer_figure(result).axes
        shown = np.transpose([line.get_ydata() for line in left.lines])
        assert shown.shape[1] == components
        np.testing.assert_array_equal(shown, 1e9 * result.residual_T.reshape(shown.shape))
        labels = [label.get_text().replace(" ", "_") for label in numbers.get_xticklabels()]
        assert labels == list(NAMES if time_shift_s else NAMES[:-1])
        found = numbers.containers[0].lines[0].get_ydata()
        assert found[:3] == pytest.approx(result.bias_T / prior.bias_T)
        assert found[labels.index("gain_yx")] == pytest.approx(result.gain[1, 0] / prior.axes_rad)

    def test_the_result_draws_itself(self) -> None:
        log = adcs.datasets.load("satellite")
        result = adcs.calibrate_magnetometer(log.telemetry, log.satellite)
        assert "rms" in result.plot().axes[0].get_title("left")
