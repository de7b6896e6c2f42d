"""A bank of filters that finds how large the disturbance is.

What is checked         by what
σ of attitude and rate  the truth: NEES of simulated torques that swing
the mixture             two filters that disagree, by hand
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

import adcs
from adcs.io.estimates import estimate_columns
from adcs.kalman.mekf import run_filter
from adcs.kalman.variants.self_tuning import DISTURBANCES_S2, mixture, run_self_tuned, weights
from magloc.chi_square import normalised_square
from sims.attitude.simulation import AttitudeRuns, simulate
from sims.experiments.accuracy import errors
from tests.adcs.filter_runs import settings, start_of, tabletsat


def runs_with(torque_Nm: float, period_s: float, duration_s: float = 1200.0, seeds: int = 6) -> AttitudeRuns:
    return simulate(replace(tabletsat(duration_s), torque_Nm=torque_Nm, torque_period_s=period_s), range(seeds))


class TestConsistency:
    @pytest.mark.slow_after(1)
    @pytest.mark.parametrize(
        ("sensors", "torque_Nm", "period_s"),
        [
            ("st", 8e-7, math.inf),
            ("st", 8e-7, 100.0),
            ("st+gyro", 1e-5, 1000.0),
            ("mag+sun", 8e-7, 300.0),
            ("mag+sun+gyro", 8e-7, 1000.0),
        ],
    )
    def test_sigma_is_right(self, sensors: str, torque_Nm: float, period_s: float) -> None:
        """Six runs; a mean of as many has a standard deviation of 0.1 where errors last for minutes."""
        chosen, runs = settings(sensors, ["disturbance"]), runs_with(torque_Nm, period_s)
        tracks = run_self_tuned(runs, chosen, start_of(runs))
        error = errors(runs, tracks)[:, 480:]
        covariance = tracks.covariance[:, 480:]
        for size in (3, 6):
            nees = normalised_square(error[..., :size], covariance[..., :size, :size]).mean() / size
            assert 0.6 < nees < 1.4

    def test_one_filter_is_not(self) -> None:
        chosen, runs = settings("st", ["disturbance"]), runs_with(8e-7, 100.0, 600.0)
        tracks = run_filter(runs, chosen, start_of(runs))
        error = errors(runs, tracks)[:, 240:, :3]
        assert normalised_square(error, tracks.covariance[:, 240:, :3, :3]).mean() / 3.0 > 4.0


class TestResult:
    def test_what_was_found_is_in_the_result(self) -> None:
        """Of swings of 8e-7 N·m on 0.5 to 0.7 kg·m², 8e-7 s⁻² rms, within a step or two; one filter finds none."""
        runs = runs_with(8e-7, 100.0, 600.0, 1)
        log, satellite = adcs.Telemetry.of(runs, runs.satellite.start), runs.satellite
        track = adcs.estimate(log, satellite, sensors="st", filter="self-tuning")
        assert track.tuned_disturbance_s2 is not None
        assert 2e-7 < track.tuned_disturbance_s2[-1] < 4e-6
        assert f"disturbance, 1σ found      {track.tuned_disturbance_s2[-1]:.2g} 1/s²" in repr(track)
        assert "tuned_disturbance_s2" in estimate_columns(track)
        assert "±1σ that the bank found" in {text.get_text() for text in track.plot().legends[0].get_texts()}
        one = adcs.estimate(log, satellite, sensors="st", states=["disturbance"])
        assert one.tuned_disturbance_s2 is None
        assert "1σ found" not in repr(one)


class TestBank:
    def test_a_larger_torque_is_found_to_be_larger(self) -> None:
        chosen, largest = settings("st", ["disturbance"]), []
        for torque_Nm in (1e-7, 1e-4):
            runs = runs_with(torque_Nm, 300.0, 300.0, 2)
            bank = [
                run_filter(
                    runs,
                    replace(chosen, disturbance_sigma_s2=float(s), disturbance_correlation_s=300.0),
                    start_of(runs),
                )
                for s in DISTURBANCES_S2[::2]
            ]
            weight = weights(bank, runs)
            np.testing.assert_allclose(weight.sum(axis=0), 1.0, rtol=1e-12)
            largest.append(weight[:, :, -1].argmax(axis=0))
        assert (largest[1] > largest[0]).all()

    def test_mixture_has_the_mean_and_the_spread(self) -> None:
        """Two filters 2 mrad/s apart, weighed 1 to 3: 1.5 mrad/s from the first, and 0.75 (mrad/s)² more variance."""
        chosen = settings("st", ["disturbance"])
        runs = runs_with(8e-7, math.inf, 20.0, 1)
        one = run_filter(runs, chosen, start_of(runs))
        other = replace(one, w=one.w + np.array([2e-3, 0.0, 0.0]))
        weight = np.stack([np.full(one.w.shape[:2], share) for share in (0.25, 0.75)])
        mean = mixture([one, other], weight, np.array([1e-7, 1e-5]))
        np.testing.assert_allclose(mean.w - one.w, np.broadcast_to([1.5e-3, 0.0, 0.0], one.w.shape), atol=1e-15)
        np.testing.assert_allclose(mean.covariance[..., 3, 3] - one.covariance[..., 3, 3], 0.75e-6, rtol=1e-9)
        np.testing.assert_allclose(mean.q, one.q, atol=1e-15)
        # Three quarters of the way from 1e-7 to 1e-5, in decades.
        np.testing.assert_allclose(mean.tuned_disturbance_s2, 10.0**-5.5, rtol=1e-12)

    def test_needs_a_disturbance(self) -> None:
        runs = runs_with(8e-7, math.inf, 5.0, 1)
        with pytest.raises(ValueError, match="must have the state disturbance"):
            run_self_tuned(runs, settings("st"), start_of(runs))
