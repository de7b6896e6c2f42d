"""Fusion of late fixes by integrating again, and the order in which samples and fixes arrive.

Who checks whom: the integration without delay, closed forms of a constant thrust, and the same fusion fed otherwise.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adcs.mockup.navigation.delayed_ekf import DelayedFilter
from adcs.mockup.navigation.fixes import FixOutcome, FixRecord, PlanarFix, fuse
from adcs.mockup.navigation.reintegration import (
    CameraOnly,
    ImuOnly,
    Reintegration,
    corrected_velocity,
    finite_difference,
)
from adcs.mockup.navigation.strapdown import Gate, ImuRecord, PlanarState, strapdown

START = PlanarState(np.array([0.3, -0.2]), np.array([0.05, 0.02]), 0.4)


def imu_of(rng, duration_s=10.0):
    n = int(100 * duration_s)
    t = 0.01 * np.arange(1.0, n + 1.0)
    return ImuRecord(0.0, t, 0.03 * np.sign(rng.standard_normal((n, 2))), rng.normal(0.3, 0.1) + 0.4 * np.sin(t))


def thrust(a, duration_s=10.0):
    n = int(100 * duration_s)
    return ImuRecord(0.0, 0.01 * np.arange(1.0, n + 1.0), np.tile([a, 0.0], (n, 1)), np.zeros(n))


def fixes_of(track, rows, delay_s=0.6):
    time_s = track.time_s[rows]
    return FixRecord(time_s, time_s + delay_s, track.position_m[rows], track.heading_rad[rows])


def fix_of(track, row):
    return PlanarFix(float(track.time_s[row]), track.position_m[row], float(track.heading_rad[row]))


class TestWithoutNoise:
    """Figure 10 of the acceptance: a late fix and the true velocity give the integration without delay."""

    @settings(max_examples=30, deadline=None)
    @given(st.integers(0, 2**32 - 1))
    def test_a_late_fix_with_the_true_velocity_changes_nothing(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        imu = imu_of(rng)
        truth = strapdown(imu, START)
        velocity = {float(t): v for t, v in zip(truth.time_s, truth.velocity_m_s, strict=True)}
        rows = np.sort(rng.choice(900, 12, replace=False))
        fused = fuse(
            Reintegration(START, 0.0, lambda one, two, samples: velocity[two.time_s]), imu, fixes_of(truth, rows)
        )
        np.testing.assert_allclose(fused.track.position_m, truth.position_m, rtol=0, atol=1e-12)
        np.testing.assert_allclose(fused.track.velocity_m_s, truth.velocity_m_s, rtol=0, atol=1e-12)
        np.testing.assert_allclose(fused.track.heading_rad, truth.heading_rad, rtol=0, atol=1e-12)
        assert set(fused.outcomes) == {FixOutcome.USED}

    def test_a_wrong_start_is_forgotten_with_two_fixes(self) -> None:
        imu = imu_of(np.random.default_rng(1))
        truth = strapdown(imu, START)
        wrong = PlanarState(np.array([5.0, 5.0]), np.array([1.0, 1.0]), -2.0)
        fused = fuse(Reintegration(wrong, 0.0, corrected_velocity), imu, fixes_of(truth, [50, 110]))
        last = fused.track.state(-1)
        np.testing.assert_allclose(last.position_m, truth.position_m[-1], atol=1e-12)
        np.testing.assert_allclose(last.velocity_m_s, truth.velocity_m_s[-1], atol=1e-12)
        # Before the fix has arrived nothing is known of it.
        assert np.linalg.norm(fused.track.position_m[109] - truth.position_m[109]) > 5.0

    def test_headings_of_the_camera_have_no_turns(self) -> None:
        imu = ImuRecord(0.0, 0.01 * np.arange(1.0, 1001.0), np.zeros((1000, 2)), np.full(1000, 2.0))
        truth = strapdown(imu, START)
        rows = np.arange(30, 900, 60)
        fixes = fixes_of(truth, rows)
        wound = FixRecord(fixes.time_s, fixes.arrival_s, fixes.position_m, np.angle(np.exp(1j * fixes.heading_rad)))
        np.testing.assert_allclose(fuse(Reintegration(START, 0.0), imu, wound).track.heading_rad, truth.heading_rad)


class TestVelocity:
    """A constant thrust a: the difference of two fixes T apart is late by T/2, wrong by a T/2."""

    def pair(self):
        imu = thrust(0.04)
        truth = strapdown(imu, START)
        one, two = fix_of(truth, 299), fix_of(truth, 359)
        return one, two, imu.between(one.time_s, two.time_s), truth.velocity_m_s[359]

    def test_the_source_s_is_half_a_period_late(self) -> None:
        one, two, samples, true = self.pair()
        error = finite_difference(one, two, samples) - true
        assert np.linalg.norm(error) == pytest.approx(0.04 * 0.3)  # 12 mm/s

    def test_the_corrected_one_is_not(self) -> None:
        one, two, samples, true = self.pair()
        np.testing.assert_allclose(corrected_velocity(one, two, samples), true, atol=1e-12)

    def test_the_corrected_one_turns_with_the_satellite(self) -> None:
        imu = imu_of(np.random.default_rng(2))
        truth = strapdown(imu, START)
        one, two = fix_of(truth, 299), fix_of(truth, 377)
        velocity = corrected_velocity(one, two, imu.between(one.time_s, two.time_s))
        np.testing.assert_allclose(velocity, truth.velocity_m_s[377], atol=1e-12)

    def test_a_zero_makes_it_wrong_by_half_of_what_it_gathers(self) -> None:
        one, two, samples, true = self.pair()
        error = corrected_velocity(one, two, samples.subtract_zeros([-0.005, 0.0], 0.0)) - true
        assert np.linalg.norm(error) == pytest.approx(0.005 * 0.3, rel=1e-9)

    def test_two_fixes_across_a_drop_out_tell_no_velocity(self) -> None:
        imu = thrust(0.04)
        truth = strapdown(imu, START)
        fusion = Reintegration(START, 0.0, finite_difference, longest_gap_s=3.0)
        fuse(fusion, imu, fixes_of(truth, [100, 450]))  # 3.5 s apart: the velocity stays the integrated one
        np.testing.assert_allclose(fusion.state.velocity_m_s, truth.velocity_m_s[-1], atol=1e-12)
        fusion = Reintegration(START, 0.0, finite_difference, longest_gap_s=4.0)
        fuse(fusion, imu, fixes_of(truth, [100, 450]))
        assert np.linalg.norm(fusion.state.velocity_m_s - truth.velocity_m_s[-1]) == pytest.approx(0.04 * 1.75)


class TestArrival:
    def used(self, method=finite_difference, **options):
        imu = imu_of(np.random.default_rng(3))
        return imu, strapdown(imu, START), Reintegration(START, 0.0, method, **options)

    def test_older_exposures_and_duplicates_are_left_out(self) -> None:
        imu, truth, fusion = self.used()
        fusion.add_samples(imu.part(0, 500))
        assert fusion.add_fix(fix_of(truth, 400)) is FixOutcome.USED
        state = fusion.state
        wrong = PlanarFix(float(truth.time_s[300]), np.array([9.0, 9.0]), 0.0)
        assert fusion.add_fix(wrong) is FixOutcome.STALE
        assert fusion.add_fix(PlanarFix(float(truth.time_s[400]), np.array([9.0, 9.0]), 0.0)) is FixOutcome.DUPLICATE
        assert fusion.state is state

    def test_an_exposure_that_the_samples_do_not_reach(self) -> None:
        imu, truth, fusion = self.used()
        fusion.add_samples(imu.part(0, 500))
        assert fusion.add_fix(fix_of(truth, 500)) is FixOutcome.AHEAD
        assert fusion.add_fix(fix_of(truth, 499)) is FixOutcome.USED
        np.testing.assert_array_equal(fusion.state.position_m, truth.position_m[499])

    def test_a_fix_older_than_the_samples_that_are_kept(self) -> None:
        imu, truth, fusion = self.used(buffer_s=2.0)
        fusion.add_samples(imu.part(0, 500))
        assert fusion.add_fix(fix_of(truth, 298)) is FixOutcome.TOO_OLD
        assert fusion.add_fix(fix_of(truth, 300)) is FixOutcome.USED

    def test_after_a_long_drop_out_it_goes_on(self) -> None:
        imu, truth, fusion = self.used(buffer_s=2.0)
        wrong = PlanarState(START.position_m + 1.0, START.velocity_m_s, 0.0)
        fusion = Reintegration(wrong, 0.0, corrected_velocity, buffer_s=2.0)
        fused = fuse(fusion, imu, fixes_of(truth, [700, 760]))
        assert fused.outcomes == (FixOutcome.USED, FixOutcome.USED)
        np.testing.assert_allclose(fusion.state.position_m, truth.position_m[-1], atol=1e-12)

    @pytest.mark.parametrize("method", [finite_difference, corrected_velocity])
    def test_samples_one_by_one_are_samples_at_once(self, method) -> None:
        imu, truth, fusion = self.used(method, buffer_s=1.0)
        fixes = fixes_of(truth, np.arange(20, 900, 61))
        at_once = fuse(fusion, imu, fixes).track
        other = Reintegration(START, 0.0, method, buffer_s=1.0)
        k = 0
        for i in range(len(imu)):
            track = other.add_samples(imu.part(i, i + 1))
            np.testing.assert_allclose(track.position_m[0], at_once.position_m[i], atol=1e-11)
            while k < len(fixes) and fixes.arrival_s[k] < imu.time_s[min(i + 1, len(imu) - 1)]:
                other.add_fix(fixes[k])
                k += 1
        np.testing.assert_allclose(other.state.velocity_m_s, at_once.velocity_m_s[-1], atol=1e-11)

    @pytest.mark.parametrize("delay_s", [0.0, 0.002, 0.02])
    def test_fixes_faster_than_a_sample_wait_for_its_end(self, delay_s: float) -> None:
        """All exposures are within intervals, and so no sample has reached them when a fix without delay arrives."""
        imu = thrust(0.03, 3.0)
        exposure_s = np.array([0.503, 1.004, 1.008, 2.001])
        position = 0.5 * 0.03 * np.stack([exposure_s**2, 0.0 * exposure_s], axis=1)
        fixes = FixRecord(exposure_s, exposure_s + delay_s, position, np.zeros(4))
        true, wrong = (PlanarState(np.array([x, 0.0]), np.zeros(2), 0.0) for x in (0.0, 0.1))
        for fusion in (Reintegration(wrong, 0.0, corrected_velocity), DelayedFilter(true, 0.0)):
            fused = fuse(fusion, imu, fixes)
            assert set(fused.outcomes) == {FixOutcome.USED}
            np.testing.assert_allclose(fused.track.position_m[-1], [0.5 * 0.03 * 9.0, 0.0], rtol=0, atol=1e-12)

    def test_an_exposure_within_an_interval(self) -> None:
        imu, _, fusion = self.used(corrected_velocity)
        fine = ImuRecord(
            0.0, 0.002 * np.arange(1.0, 5001.0), np.repeat(imu.acceleration_m_s2, 5, 0), np.repeat(imu.rate_rad_s, 5)
        )
        finer = strapdown(fine, START)
        fuse(fusion, imu, fixes_of(finer, np.arange(53, 4500, 301)))
        # The heading turns within the interval that is cut: 2e-5 m is of its second order.
        np.testing.assert_allclose(fusion.state.position_m, finer.position_m[-1], atol=2e-5)

    def test_what_the_gate_rejects_is_held(self) -> None:
        imu, truth, fusion = self.used()
        wild = imu.acceleration_m_s2.copy()
        wild[100] = 3.0
        spiked = ImuRecord(0.0, imu.time_s, wild, imu.rate_rad_s)
        off = fuse(fusion, spiked, fixes_of(truth, [])).track.velocity_m_s[-1] - truth.velocity_m_s[-1]
        assert 0.0 < np.linalg.norm(off) < 0.01 * 0.05
        wide = Reintegration(START, 0.0, gate=Gate(acceleration_m_s2=10.0))
        off = fuse(wide, spiked, fixes_of(truth, [])).track.velocity_m_s[-1] - truth.velocity_m_s[-1]
        assert np.linalg.norm(off) > 0.03

    def test_samples_follow_one_another(self) -> None:
        imu, _, fusion = self.used()
        with pytest.raises(ValueError, match="must begin where this record ends, at 0 s"):
            fusion.add_samples(imu.part(5, 10))


class TestWithoutFusion:
    def test_the_camera_alone_is_late(self) -> None:
        imu = thrust(0.0)
        truth = strapdown(imu, START)
        fused = fuse(CameraOnly(START), imu, fixes_of(truth, np.arange(59, 900, 60)))
        speed = float(np.linalg.norm(START.velocity_m_s))
        age = np.linalg.norm(fused.track.position_m - truth.position_m, axis=1)[300:] / speed
        assert age.min() > 0.6
        assert age.max() == pytest.approx(1.2, abs=0.011)
        np.testing.assert_allclose(fused.track.velocity_m_s[300:], truth.velocity_m_s[300:])

    def test_a_false_fix_is_followed(self) -> None:
        imu = thrust(0.0)
        truth = strapdown(imu, START)
        fixes = fixes_of(truth, [100, 160])
        false = FixRecord(
            fixes.time_s, fixes.arrival_s, fixes.position_m + np.array([[0.0, 0.0], [0.3, 0.0]]), fixes.heading_rad
        )
        for fusion in (Reintegration(START, 0.0), CameraOnly(START)):
            fuse(fusion, imu, false)
            assert fusion.state.velocity_m_s[0] - START.velocity_m_s[0] == pytest.approx(0.5)

    def test_the_imu_alone_takes_no_fix(self) -> None:
        imu = imu_of(np.random.default_rng(4))
        truth = strapdown(imu, START)
        shifted = fixes_of(truth, [100, 160])
        fused = fuse(ImuOnly(START), imu, shifted)
        np.testing.assert_allclose(fused.track.position_m, truth.position_m, atol=1e-12)
        assert fused.outcomes == (FixOutcome.UNUSED,) * 2

    def test_the_camera_alone_leaves_older_fixes_out(self) -> None:
        fusion = CameraOnly(START)
        assert fusion.add_fix(PlanarFix(1.0, np.ones(2), 0.0)) is FixOutcome.USED
        assert fusion.add_fix(PlanarFix(0.5, np.ones(2), 0.0)) is FixOutcome.STALE
        assert fusion.add_fix(PlanarFix(1.0, np.ones(2), 0.0)) is FixOutcome.DUPLICATE


class TestFixRecord:
    def record(self, **changes):
        values = {
            "time_s": [0.0, 0.6],
            "arrival_s": [0.6, 1.2],
            "position_m": np.zeros((2, 2)),
            "heading_rad": [0.0, 0.0],
        }
        return FixRecord(**{**values, **changes})

    @pytest.mark.parametrize(
        ("changes", "text"),
        [
            ({"arrival_s": [1.2, 0.6]}, "arrival_s must not go back; instead received 0.6 s after 1.2 s .fix 1."),
            ({"arrival_s": [0.6, 0.6], "time_s": [0.0, 0.7]}, "received 0.6 s for an exposure at 0.7 s .fix 1."),
            ({"position_m": np.zeros((2, 3))}, r"position_m must have shape \(2, 2\)"),
            ({"time_s": 1.0}, r"time_s must have shape \(k,\)"),
            ({"time_s": np.zeros(0)}, r"arrival_s must have shape \(0,\)"),
            ({"heading_rad": [0.0, math.inf]}, "heading_rad must be finite"),
            ({"sigma": np.ones((2, 2))}, r"sigma must have shape \(2, 3\)"),
            ({"sigma": [[1e-3, 1e-3, 1e-2], [1e-3, 0.0, 1e-2]]}, "sigma must be positive; instead received 0"),
        ],
    )
    def test_what_is_not_one_is_refused(self, changes, text: str) -> None:
        with pytest.raises(ValueError, match=text):
            self.record(**changes)

    def test_exposures_may_be_out_of_order(self) -> None:
        sigma = [[5e-3, 5e-3, 0.05], [1e-3, 1e-3, 0.01]]
        fixes = self.record(time_s=[0.5, 0.1], heading_rad=[5.0, 1.0], sigma=sigma).in_time_order()
        np.testing.assert_array_equal(fixes.sigma, sigma[::-1])
        np.testing.assert_array_equal(fixes[0].sigma, sigma[1])
        np.testing.assert_array_equal(fixes.time_s, [0.1, 0.5])
        np.testing.assert_array_equal(fixes.arrival_s, [0.1, 0.5])
        np.testing.assert_array_equal(fixes.heading_rad, [1.0, 5.0])

    def test_time_stamps_put_back(self) -> None:
        np.testing.assert_allclose(self.record().earlier(0.4).time_s, [-0.4, 0.2])

    def test_fixes_after_the_last_sample_do_not_come(self) -> None:
        imu = thrust(0.0, 1.0)
        assert len(fuse(CameraOnly(START), imu, self.record()).outcomes) == 1
