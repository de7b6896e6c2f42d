"""Filters with one gain, and of attitude and gyro bias alone: the acceptance figures and what the gain must be."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from adcs.kalman.mekf import predict, run_filter, stacked_residuals
from adcs.kalman.variants.constant_gain import converged_gain, run_constant_gain
from adcs.kalman.variants.gyro_driven import run_reduced
from tests.adcs.filter_runs import evaluate, runs_for, settings


class TestConstantGain:
    def test_acceptance(self) -> None:
        chosen = settings("st", ["disturbance"])
        runs, start = runs_for(chosen.sensors, 300.0)
        reached = evaluate(runs, run_constant_gain(runs, chosen, start))
        assert (reached["angle_rms_deg"] or 9.0) <= 7e-4
        assert (reached["rate_rms_deg_s"] or 9.0) <= 1e-4
        assert reached["diverged_runs"] == 0

    @pytest.mark.slow_after(1)
    @pytest.mark.parametrize(
        ("sensors", "angle", "rate"), [("st", 1.1e-3, 4e-4), ("mag+sun", 0.12, 3.2e-3), ("mag+sun+gyro", 0.25, 2e-3)]
    )
    def test_other_sets(self, sensors: str, angle: float, rate: float) -> None:
        chosen = settings(sensors)
        runs, start = runs_for(chosen.sensors, 300.0)
        reached = evaluate(runs, run_constant_gain(runs, chosen, start))
        assert (reached["angle_rms_deg"] or 9.0) <= angle
        assert (reached["rate_rms_deg_s"] or 9.0) <= rate

    def test_gain_is_that_of_the_riccati_equation(self) -> None:
        """The oracle: scipy's discrete algebraic Riccati equation with Φ and H at the end."""
        chosen = settings("st", ["disturbance"])
        runs, start = runs_for(chosen.sensors, 300.0, range(2))
        K = converged_gain(runs, chosen, start)
        state = run_filter(runs, chosen, start).at(-1)
        _, Phi = predict(runs, 299, state, chosen)
        H, _ = stacked_residuals(runs, 300, state, chosen)
        for run in range(2):
            P = solve_discrete_are(
                Phi[run].T, H[run].T, np.diag(chosen.process_variance(runs.dt_s, runs.dt_s)), np.eye(3)
            )
            expected = P @ H[run].T @ np.linalg.inv(H[run] @ P @ H[run].T + np.eye(3))
            np.testing.assert_allclose(K[run], expected, rtol=0, atol=2e-3 * np.abs(expected).max())
            np.testing.assert_allclose(np.abs(K[run]).max(axis=1), np.abs(expected).max(axis=1), rtol=2e-3)

    def test_gyro_bias_takes_too_long(self) -> None:
        """Negative: with the small process noise of a bias its frozen gain is small, too."""
        chosen = settings("st+gyro", ["gyro-bias"])
        runs, start = runs_for(chosen.sensors, 300.0)
        frozen = evaluate(runs, run_constant_gain(runs, chosen, start))["gyro_bias_rms_deg_s"] or 0.0
        full = evaluate(runs, run_filter(runs, chosen, start))["gyro_bias_rms_deg_s"] or 9.0
        assert frozen > 2e-3 > 4.0 * full

    def test_covariance_without_readings_grows(self) -> None:
        chosen = settings("mag+sun")
        runs, start = runs_for(chosen.sensors, 40.0, range(2))
        gain = converged_gain(runs, chosen, start)
        runs.readings.sun[:, 30:], runs.readings.field_T[:, 30:] = np.nan, np.nan
        sigma = run_constant_gain(runs, chosen, start, gain).sigma
        assert (np.diff(sigma[:, 30:], axis=1) > 0.0)[..., :3].all()


class TestReduced:
    @pytest.mark.parametrize(("sensors", "angle"), [("mag+sun+gyro", 6e-2), ("st+gyro", 1.5e-3)])
    def test_accuracy(self, sensors: str, angle: float) -> None:
        chosen = settings(sensors, ["gyro-bias"])
        runs, start = runs_for(chosen.sensors, 200.0)
        reached = evaluate(runs, run_reduced(runs, chosen, start))
        assert (reached["angle_rms_deg"] or 9.0) <= angle
        assert (reached["gyro_bias_rms_deg_s"] or 9.0) <= 1.3e-3
        # Its rate is the gyro's, of 0.005°/s.
        assert reached["rate_rms_deg_s"] == pytest.approx(0.005, rel=0.15)
        assert 0.6 < (reached["nees_per_dimension"] or 0.0) < 1.6

    def test_missing_readings(self) -> None:
        chosen = settings("mag+sun+gyro", ["gyro-bias"])
        runs, start = runs_for(chosen.sensors, 200.0, range(3))
        runs.readings.gyro_rad_s[:, 50:60] = np.nan
        runs.readings.sun[:, 100:120] = np.nan
        reached = evaluate(runs, run_reduced(runs, chosen, start))
        assert (reached["angle_rms_deg"] or 9.0) < 0.1

    def test_bad_input(self) -> None:
        chosen = settings("st+gyro", ["gyro-bias"])
        runs, start = runs_for(chosen.sensors, 5.0, range(2))
        for other in (settings("st+gyro"), settings("st+gyro", ["gyro-bias", "disturbance"]), settings("st")):
            with pytest.raises(ValueError, match="must have a gyro and the state gyro-bias alone"):
                run_reduced(runs, other, start)
        runs.readings.gyro_rad_s[1, 0] = np.nan
        with pytest.raises(ValueError, match="gyro reading at the first instant"):
            run_reduced(runs, chosen, start)
