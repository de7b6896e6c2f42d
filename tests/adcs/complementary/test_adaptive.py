"""Tests of the adaptive error-state filter."""

import dataclasses
import math

import numpy as np
import pytest

from adcs import quaternion
from adcs.complementary.adaptive import AdaptiveTrack, AdaptiveTuning, adaptive_track
from adcs.complementary.explicit import Gains, complementary_track
from sims.attitude.complementary import ORBIT, SatelliteScenario, satellite_runs
from tests.adcs.complementary.readable import adaptive_steps


def errors_deg(track, runs):
    return np.degrees(2.0 * quaternion.error_vector(track.q, runs.q))


def window(runs, begin, end):
    orbits = runs.scenario.orbits
    return (orbits >= begin) & (orbits < end)


OUTAGE = SatelliteScenario(step_orbits=0.3, outage_orbits=1.5, duration_s=4.0 * ORBIT.period_s)


@pytest.fixture(scope="module")
def paper():
    return satellite_runs(SatelliteScenario(), range(8))


@pytest.fixture(scope="module")
def outage():
    return satellite_runs(OUTAGE, range(8))


class TestFigures:
    """Section 10 of the specification, seeds 0 to 7."""

    @pytest.mark.slow
    def test_forty_seeds(self):
        """The same figures, and the mean of the pooled errors."""
        runs = satellite_runs(SatelliteScenario(), range(40))
        errors = errors_deg(adaptive_track(runs.record), runs)
        pooled = np.sqrt(np.mean(errors[:, window(runs, 0.5, 3.0)] ** 2, axis=(1, 2)))
        assert pooled.mean() <= 0.05
        assert np.mean(pooled <= 0.06) >= 0.95
        assert np.median(np.abs(errors[:, window(runs, 1.7, 3.5)]).max(axis=(1, 2))) <= 1.1
        dark = satellite_runs(OUTAGE, range(40))
        largest = np.abs(errors_deg(adaptive_track(dark.record), dark)[:, window(dark, 2.0, 4.0)]).max(axis=(1, 2))
        assert np.mean(largest <= 0.1) >= 0.95

    def test_step(self, paper):
        errors = errors_deg(adaptive_track(paper.record), paper)
        for one in errors:
            assert math.sqrt(np.mean(one[window(paper, 0.5, 3.0)] ** 2)) <= 0.06
            assert np.abs(one[window(paper, 1.7, 3.5)]).max() <= 1.1

    def test_outage(self, outage):
        errors = errors_deg(adaptive_track(outage.record), outage)
        assert np.abs(errors[:, window(outage, 2.0, 4.0)]).max() <= 0.1

    def test_credible(self, paper, outage):
        """Mean NEES of 6 states before the step, after it, and in the outage, the Sun as noisy as it is taken for.

        Within a window it hardly changes, so that eight runs are eight numbers of variance 12: 3.5 standard deviations
        of their mean are 4.3, false alarm 5e-4.
        """
        for runs, begin, end in ((paper, 0.5, 1.7), (paper, 1.75, 3.5), (outage, 2.0, 4.0)):
            noise = AdaptiveTuning().second_sigma_rad * np.random.default_rng(0).standard_normal((*runs.q.shape[:2], 3))
            record = dataclasses.replace(runs.record, second_body=runs.record.second_body + noise)
            track, then = adaptive_track(record), window(runs, begin, end)
            # Of these rows alone: a covariance of each is large.
            rows = AdaptiveTrack(*(values[:, then] for values in vars(track).values()))
            del track
            nees = rows.nees(runs.q[:, then], runs.bias_rad_s[then, None])
            assert nees.mean() == pytest.approx(6.0, abs=4.3)

    def test_finds_the_bias(self, paper):
        bias = adaptive_track(paper.record).bias_rad_s[:, -1]
        np.testing.assert_allclose(np.degrees(bias), 0.02, atol=1e-4)

    def test_step_during_the_outage(self):
        """Found late, as the field alone shows little at a time; a frozen integral never finds it: 25° and more."""
        scenario = SatelliteScenario(step_orbits=2.0, outage_orbits=1.5, duration_s=3.5 * ORBIT.period_s)
        runs = satellite_runs(scenario, range(4))
        angle = np.linalg.norm(errors_deg(adaptive_track(runs.record), runs), axis=-1)
        assert angle[:, window(runs, 3.0, 3.5)].max() < 1.0
        assert angle[:, window(runs, 2.0, 2.3)].max(axis=1).min() > 3.0
        frozen = errors_deg(complementary_track(runs.record, Gains(0.005, 6.25e-6)), runs)
        assert np.abs(frozen[:, window(runs, 3.0, 3.5)]).max(axis=(1, 2)).min() > 20.0

    def test_without_adaptation(self, paper):
        """What it is for: the same filter never finds the step in time."""
        deaf = AdaptiveTuning(threshold=1e9)
        errors = errors_deg(adaptive_track(paper.record, deaf), paper)
        assert np.abs(errors[:, window(paper, 1.7, 3.5)]).max() > 3.0


class TestConsistency:
    def test_nees_where_the_model_holds(self):
        """Sun as noisy as assumed, bias that walks as assumed: 6 within the spread of 40 runs.

        The mean of 40 numbers of variance 12 has the standard deviation 0.55; 3.5 of them, false alarm 5e-4.
        """
        sigma, walk, n = 1e-3, 2e-7, 1500
        tuning = AdaptiveTuning(
            second_sigma_rad=sigma, bias_noise_rad_s=walk, threshold=1e9, start_attitude_rad=0.01, start_bias_rad_s=1e-5
        )
        runs = satellite_runs(SatelliteScenario(duration_s=float(n), step_orbits=9.0), range(40))
        rng = np.random.default_rng(11)
        walks = walk * rng.standard_normal((40, n + 1, 3))
        walks[:, 0] = 1e-5 * rng.standard_normal((40, 3))
        bias = np.cumsum(walks, axis=1)
        record = dataclasses.replace(
            runs.record,
            rate_rad_s=runs.record.rate_rad_s + bias,
            second_body=runs.record.second_body + sigma * rng.standard_normal(bias.shape),
        )
        start = quaternion.multiply(runs.q[:, 0], quaternion.exp(-0.01 * rng.standard_normal((40, 3))))
        nees = adaptive_track(record, tuning, q_start=start).nees(runs.q, bias)
        for instant in (500, 1000, n):
            assert nees[:, instant].mean() == pytest.approx(6.0, abs=3.5 * math.sqrt(12.0 / 40.0))


class TestTwins:
    @pytest.mark.parametrize("rate", [0.0, 0.05])
    def test_agree(self, rate, instruction_sets):
        scenario = SatelliteScenario(duration_s=250.0, step_orbits=0.01, outage_orbits=0.025)
        runs = satellite_runs(scenario, range(2))
        record = dataclasses.replace(runs.record, rate_rad_s=runs.record.rate_rad_s + rate)
        first = record.first_body.copy()
        first[:, 20:25] = np.nan
        record = dataclasses.replace(record, first_body=first)
        tracks = [adaptive_track(record) for _ in instruction_sets]
        for run in range(2):
            q, bias, covariance = (np.array(a) for a in zip(*adaptive_steps(record, run=run), strict=True))
            sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
            scale = sigma[:, :, None] * sigma[:, None, :]
            for track in tracks:
                assert quaternion.angle_between(track.q[run], q).max() < 1e-7
                np.testing.assert_allclose(track.bias_rad_s[run], bias, atol=1e-9)
                np.testing.assert_allclose(track.covariance[run] / scale, covariance / scale, atol=1e-6)

    def test_nothing_to_do(self):
        runs = satellite_runs(SatelliteScenario(duration_s=2.0), [0])
        record = dataclasses.replace(
            runs.record,
            **{
                field.name: getattr(runs.record, field.name)[:, :0]
                for field in dataclasses.fields(runs.record)
                if field.name != "dt_s"
            },
            dt_s=runs.record.dt_s[:0],
        )
        assert adaptive_track(record).q.shape == (1, 0, 4)


class TestInput:
    @pytest.mark.parametrize(
        ("values", "sentence"),
        [
            ({"first_sigma": 0.0}, "first_sigma must be positive"),
            ({"threshold": math.nan}, "threshold must be positive"),
            ({"memory": 1.0}, "memory must be less than 1"),
            ({"attitude_noise_rad": -1.0}, "attitude_noise_rad must be positive"),
        ],
    )
    def test_tuning(self, values, sentence):
        with pytest.raises(ValueError, match=sentence):
            AdaptiveTuning(**values)
