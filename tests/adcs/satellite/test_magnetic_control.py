"""B-dot: the law, the equation of its mean torque, and runs of both."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from adcs.kalman.mekf import run_filter
from adcs.satellite.magnetic_control import BDot, b_dot_gain, detumbled
from sims.experiments import accuracy
from sims.experiments.b_dot import INERTIA_KGM2, Detumbling, detumbling
from tests.adcs.filter_runs import settings, start_of


class TestLaw:
    def test_it_brakes_what_turns_across_the_field(self) -> None:
        """Torque m×B of -k (ω - its part along the field), for a turn of half a degree from reading to reading."""
        rng = np.random.default_rng(0)
        b, w = 30e-6 * np.array([0.6, 0.0, 0.8]), 1e-3 * rng.standard_normal(3)
        step, law = 0.01, BDot(gain_Nms=2e-4, largest_Am2=10.0)
        moment = law.moment_Am2(b, b - step * np.cross(w, b), step)
        n = b / np.linalg.norm(b)
        np.testing.assert_allclose(np.cross(moment, b), -2e-4 * (w - n * (n @ w)), rtol=1e-4, atol=1e-10)

    def test_each_torquer_has_its_limit(self) -> None:
        moment = BDot(gain_Nms=1.0, largest_Am2=0.2).moment_Am2([0.0, 0.0, 30e-6], [1e-6, -1e-9, 30e-6], 1.0)
        np.testing.assert_allclose(moment, [-0.2, 0.2, 0.0], atol=1e-15)

    def test_without_a_reading_nothing_is_set(self) -> None:
        assert BDot(gain_Nms=1.0).moment_Am2(np.full(3, np.nan), [1e-6, 0.0, 0.0], 1.0).tolist() == [0.0, 0.0, 0.0]

    def test_a_duty_above_one_is_refused(self) -> None:
        with pytest.raises(ValueError, match="duty must be at most 1"):
            BDot(gain_Nms=1.0, duty=1.2)


class TestMeanTorque:
    def test_across_a_field_that_stays(self) -> None:
        """Saturated: H falls by 1.2 m d |B| a second; then by k d / I of itself."""
        law, J = BDot(gain_Nms=2e-4, largest_Am2=0.1, duty=0.5), np.diag([0.04, 0.04, 0.01])
        b = np.tile([0.0, 0.0, 30e-6], (3000, 1))
        H = detumbled(law, [0.0, 5e-3, 0.0], b, J, 1.0)
        assert H[0] - H[100] == pytest.approx(100.0 * 1.2 * 0.1 * 0.5 * 30e-6)
        assert H[2500] / H[2400] == pytest.approx((1.0 - 2e-4 * 0.5 / 0.04) ** 100)

    def test_what_is_along_the_field_stays(self) -> None:
        b = np.tile([0.0, 0.0, 30e-6], (50, 1))
        assert detumbled(BDot(gain_Nms=1e-3), [0.0, 0.0, 1e-3], b, INERTIA_KGM2, 1.0)[-1] == 1e-3

    def test_the_gain_is_that_of_the_largest_moment(self) -> None:
        assert b_dot_gain(INERTIA_KGM2, 1e-3) == pytest.approx(4e-3 * 0.041)


@pytest.fixture(scope="module")
def few() -> Detumbling:
    return detumbling(range(4), rate_deg_s=1.5, duration_s=1500.0)


class TestRuns:
    def test_they_end_slow(self, few: Detumbling) -> None:
        rate = np.linalg.norm(few.runs.w, axis=-1)
        assert (few.time_s < 1500.0).all()
        assert np.degrees(rate[:, -60:]).max() < 0.5 < np.degrees(rate[:, 0]).min()

    def test_a_filter_that_is_told_follows(self, few: Detumbling) -> None:
        """The commands are in the record: without a gyro the attitude stays known while torquers brake."""
        used = settings("mag+sun", ["disturbance"])
        told, none = few.runs, replace(few.runs, torquers_Am2=np.zeros_like(few.runs.torquers_Am2))
        # In the median: runs that begin in eclipse, 5° an axis off, find the attitude when the Sun rises.
        errors = [
            np.median(accuracy.error_norm_deg(runs, run_filter(runs, used, start_of(runs)))[:, 300:])
            for runs in (told, none)
        ]
        assert errors[0] < 0.2
        assert errors[1] > 3.0 * errors[0]

    @pytest.mark.slow
    def test_of_forty_starts_at_ten_degrees_a_second(self) -> None:
        """Median within 10 % of the equation, 80 % within 20 %, 2,500 s at most with 0.2 A·m²."""
        found = detumbling(range(40), duration_s=5000.0)
        ratio = found.time_s / found.theory_s
        assert np.median(ratio) == pytest.approx(1.0, abs=0.1)
        assert np.mean(np.abs(ratio - 1.0) <= 0.2) >= 0.8
        assert np.median(found.time_s) <= 2500.0
        assert math.isfinite(found.time_s.max())
