"""Tests of adcs.kalman.variants.separate_bias: acceptance figures, the printed form that fails.

The optimum it must agree with.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from adcs.kalman.mekf import run_filter
from adcs.kalman.variants import separate_bias
from adcs.kalman.variants.separate_bias import run_parallel
from sims.attitude.simulation import simulate
from sims.experiments.accuracy import normalised_error_squared
from tests.adcs.filter_runs import SEEDS, evaluate, runs_for, scenario_for, settings, start_of

CHOSEN = settings("st", ["disturbance"])


class TestParallelFilter:
    def test_acceptance(self) -> None:
        runs, start = runs_for(CHOSEN.sensors, 200.0)
        reached = evaluate(runs, run_parallel(runs, CHOSEN, start))
        assert (reached["angle_rms_deg"] or 9.0) <= 6e-4
        assert (reached["rate_rms_deg_s"] or 9.0) <= 3e-5
        assert (reached["disturbance_rms_s2"] or 9.0) <= 1e-8
        assert reached["diverged_runs"] == 0

    def test_vectors(self) -> None:
        chosen = settings("mag+sun+gyro", ["disturbance"])
        runs, start = runs_for(chosen.sensors, 600.0)
        reached = evaluate(runs, run_parallel(runs, chosen, start))
        assert (reached["angle_rms_deg"] or 9.0) <= 4e-2
        assert (reached["disturbance_rms_s2"] or 9.0) <= 8e-8

    @pytest.mark.slow
    @pytest.mark.parametrize(("sensors", "duration_s"), [("st", 200.0), ("mag+sun+gyro", 600.0)])
    def test_printed_form_fails(self, sensors: str, duration_s: float, monkeypatch: pytest.MonkeyPatch) -> None:
        """Negative: without the correction of the state it is tens of times worse, and its covariance is void."""
        chosen = settings(sensors, ["disturbance"])
        runs, start = runs_for(chosen.sensors, duration_s)
        right = evaluate(runs, run_parallel(runs, chosen, start))
        monkeypatch.setattr(separate_bias, "sensitivity_correction", lambda S, _: np.zeros(S.shape[:-1]))
        printed = evaluate(runs, run_parallel(runs, chosen, start))
        assert (printed["disturbance_rms_s2"] or 0.0) > 10.0 * (right["disturbance_rms_s2"] or 9.0)
        assert (printed["nees_per_dimension"] or 0.0) > 100.0

    def test_is_the_augmented_filter_where_nothing_is_forgotten(self) -> None:
        """Friedland's theorem: for a constant bias the separated filter is the augmented one without q_d.

        Up to what B has in place of the filter's own Φ, h²/4 for half an acceleration over a step in δq.
        """
        chosen = replace(CHOSEN, noise=replace(CHOSEN.noise, disturbance_s2=0.0))
        runs, start = runs_for(chosen.sensors, 200.0, range(4))
        apart, together = run_parallel(runs, chosen, start, forgetting=1.0), run_filter(runs, chosen, start)
        scale = together.sigma[:, 20:]
        np.testing.assert_allclose(apart.sigma[:, 20:], scale, rtol=1e-3)
        difference = np.abs(apart.optional["disturbance"] - together.optional["disturbance"])[:, 20:]
        assert (difference < 0.02 * scale[..., 6:]).all()

    def test_covariance_has_the_disturbance_in_it(self) -> None:
        """The covariance of the state alone had a NEES of 12 to 25 in the source's form; that of the whole is true."""
        runs, start = runs_for(CHOSEN.sensors, 200.0)
        estimates = run_parallel(runs, CHOSEN, start)
        nees = normalised_error_squared(runs, estimates)[:, 50:].mean() / 9.0
        assert 0.2 < nees < 1.6

    @pytest.mark.slow
    def test_slow_disturbance(self) -> None:
        scenario = replace(scenario_for(CHOSEN.sensors, 1000.0), torque_period_s=5800.0)
        runs = simulate(scenario, SEEDS)
        reached = evaluate(runs, run_parallel(runs, CHOSEN, start_of(runs)))
        # It changes by up to 1.7e-9 s⁻² in a second, and λ = 0.99 remembers a hundred of them.
        assert (reached["disturbance_rms_s2"] or 9.0) < 1.7e-7

    def test_bad_input(self) -> None:
        runs, start = runs_for(CHOSEN.sensors, 5.0, range(2))
        with pytest.raises(ValueError, match="must have the state disturbance"):
            run_parallel(runs, settings("st"), start)
        for forgetting in (0.0, 1.1, float("nan")):
            with pytest.raises(ValueError, match="Input forgetting must be above 0 and at most 1"):
                run_parallel(runs, CHOSEN, start, forgetting)


class TestAugmentedFilter:
    def test_follows_a_slow_disturbance(self) -> None:
        chosen = settings("mag+sun+gyro", ["disturbance"])
        runs = simulate(replace(scenario_for(chosen.sensors, 1500.0), torque_period_s=5800.0), SEEDS)
        reached = evaluate(runs, run_filter(runs, chosen, start_of(runs)))
        assert (reached["disturbance_rms_s2"] or 9.0) < 1.5e-7
        assert (reached["nees_per_dimension"] or 9.0) < 1.6
