"""The delayed error-state filter.

Who checks whom
---------------

=========================  ============================================================================
operation                  oracle
=========================  ============================================================================
predicted, of many         the same sample after sample
predicted, of one          the integration step; derivatives by finite differences; the integral of
                           white noise (van Loan)
the filter                 a textbook filter of ten lines that gets the fixes without delay
consistency                NEES of all states and of each, NIS of the fixes, with truth of the filter's
                           own noises; zeros that drift steadily: test_delayed_filter_zeros.py
=========================  ============================================================================

Statistical tests have fixed seeds, not chosen, and state the probability with which a right program fails them.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from filterpy.common import van_loan_discretization
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats
from scipy.differentiate import jacobian

from adcs.mockup.navigation.delayed_ekf import (
    H_FIX,
    STATES,
    DelayedFilter,
    DelayedFilterSettings,
    FilterTrack,
    N,
    StartSigma,
    predict,
)
from adcs.mockup.navigation.fixes import FixOutcome, FixRecord, PlanarFix, fuse
from adcs.mockup.navigation.strapdown import ImuRecord, PlanarState, step, strapdown

seeds = st.integers(0, 2**32 - 1)
SETTINGS, SIGMA = DelayedFilterSettings(), StartSigma()
START = PlanarState(np.array([0.3, -0.2]), np.array([0.05, 0.02]), 0.4)
FALSE_ALARM = 1e-4


def predicted_once(x, P, step_s, reading, there, densities):
    """State and covariance after one sample."""
    (x,), (P,) = predict(x, P, [step_s], [reading], [there], densities)
    return x, P


def random_covariance(rng):
    root = rng.standard_normal((N, N)) * np.sqrt(np.diagonal(SIGMA.covariance))[:, None]
    return root @ root.T


def own_world(rng, duration_s, settings=SETTINGS, sigma=SIGMA, period_s=0.6, delay_s=0.6):
    """Truth with the noises that the filter assumes: (track, zeros and drifts (n, 5), samples, fixes)."""
    n = int(100 * duration_s)
    dt, t = 0.01, 0.01 * np.arange(1.0, n + 1.0)
    off = np.sqrt(np.diagonal(sigma.covariance)) * rng.standard_normal(N)
    true_start = PlanarState(
        START.position_m + off[0:2], START.velocity_m_s + off[2:4], float(START.heading_rad) + float(off[4])
    )
    thrust = 0.04 * np.sign(np.sin(np.outer(t, [1.3, 0.9]) + rng.uniform(0.0, 6.0, 2)))
    rate = 0.5 * np.sin(0.4 * t + rng.uniform(0.0, 6.0))
    track = strapdown(ImuRecord(0.0, t, thrust, rate), true_start)
    walk = math.sqrt(dt) * np.repeat([settings.zero_walk_m_s2_rs, settings.zero_walk_rad_s_rs], [2, 1])
    drifts = off[8:] + np.cumsum(math.sqrt(dt) * settings.drift_walk_m_s3_rs * rng.standard_normal((n + 1, 2)), axis=0)
    # A sample has the zero of its beginning, as the filter has it.
    zeros = off[5:8] + np.cumsum(walk * rng.standard_normal((n + 1, 3)), axis=0)
    zeros[1:, :2] += dt * np.cumsum(drifts[:-1], axis=0)
    noise = np.array([settings.acceleration_m_s2, settings.acceleration_m_s2, settings.rate_rad_s])
    readings = np.column_stack([thrust, rate]) + zeros[:-1] + noise * rng.standard_normal((n, 3))
    imu = ImuRecord(0.0, t, readings[:, :2], readings[:, 2])
    rows = np.arange(round(period_s / dt) - 1, n, round(period_s / dt))
    fix_noise = rng.standard_normal((len(rows), 3)) * [settings.fix_m, settings.fix_m, settings.fix_rad]
    fixes = FixRecord(
        t[rows],
        t[rows] + delay_s,
        track.position_m[rows] + fix_noise[:, :2],
        np.angle(np.exp(1j * (track.heading_rad[rows] + fix_noise[:, 2]))),
    )
    return track, np.concatenate([zeros, drifts], axis=1)[1:], imu, fixes


def textbook(imu, fixes, settings=SETTINGS, sigma=SIGMA):
    """Means (n, N) and covariances of a Kalman filter in its usual form; fixes at the ends of samples, at once."""
    x = np.concatenate([START.position_m, START.velocity_m_s, [START.heading_rad], np.zeros(N - 5)])
    P, R = sigma.covariance, np.diag(np.square([settings.fix_m, settings.fix_m, settings.fix_rad]))
    xs, Ps, k = [], [], 0
    for i, dt in enumerate(imu.steps_s):
        x, P = predicted_once(x, P, dt, [*imu.acceleration_m_s2[i], imu.rate_rad_s[i]], [True] * 3, settings.densities)
        if k < len(fixes) and fixes.time_s[k] == imu.time_s[i]:
            y = np.append(fixes.position_m[k], fixes.heading_rad[k]) - x[[0, 1, 4]]
            y[2] = (y[2] + math.pi) % (2.0 * math.pi) - math.pi
            S = H_FIX @ P @ H_FIX.T + R
            K = P @ H_FIX.T @ np.linalg.inv(S)
            if y @ np.linalg.solve(S, y) <= settings.fix_gate:
                x, P = x + K @ y, (np.eye(N) - K @ H_FIX) @ P @ (np.eye(N) - K @ H_FIX).T + K @ R @ K.T
            k += 1
        xs.append(x)
        Ps.append(P)
    return np.array(xs), np.array(Ps)


def scaled(P, like):
    scale = np.sqrt(np.diagonal(like))
    return P / np.outer(scale, scale)


class TestPrediction:
    @settings(deadline=None)
    @given(seeds)
    def test_the_mean_is_the_integration_step(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        x, dt, z = rng.standard_normal(N), rng.uniform(0.001, 0.1), rng.standard_normal(3)
        state = step(PlanarState(x[0:2], x[2:4], x[4]), dt, z[:2] - x[5:7], z[2] - x[7])
        mean, _ = predicted_once(x, np.eye(N), dt, z, [True] * 3, SETTINGS.densities)
        np.testing.assert_allclose(mean[0:2], state.position_m, atol=1e-14)
        np.testing.assert_allclose(mean[2:4], state.velocity_m_s, atol=1e-14)
        zeros = x[5:7] + dt * x[8:10]
        np.testing.assert_allclose(mean[4:], [state.heading_rad, *zeros, *x[7:]], atol=1e-14)

    @pytest.mark.parametrize("there", [(True, True, True), (False, True, True), (True, False, False)])
    def test_the_transition_is_its_derivative(self, there) -> None:
        rng = np.random.default_rng(1)
        x, z, P = rng.standard_normal(N), rng.standard_normal(3), random_covariance(rng)
        none = np.zeros_like(SETTINGS.densities)

        def mean(points):
            flat = points.reshape(N, -1).T
            return np.array([predicted_once(p, P, 0.1, z, there, none)[0] for p in flat]).T.reshape(points.shape)

        F = jacobian(mean, x, initial_step=0.05).df
        _, after = predicted_once(x, P, 0.1, z, there, none)
        np.testing.assert_allclose(scaled(after, after), scaled(F @ P @ F.T, after), atol=1e-8)

    def test_the_noise_is_that_of_a_white_acceleration(self) -> None:
        # In one axis: x'' = w of density q; van Loan's integral of it over a step.
        _, Q = predicted_once(np.zeros(N), np.zeros((N, N)), 0.3, [0.0] * 3, [True] * 3, SETTINGS.densities)
        _, other = van_loan_discretization(
            np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [math.sqrt(SETTINGS.densities[0])]]), 0.3
        )
        for axis in (0, 1):
            np.testing.assert_allclose(Q[np.ix_([axis, axis + 2], [axis, axis + 2])], other, rtol=1e-9)
        # A zero that walks, with a drift that walks too.
        _, other = van_loan_discretization(
            np.array([[0.0, 1.0], [0.0, 0.0]]), np.diag([SETTINGS.zero_walk_m_s2_rs, SETTINGS.drift_walk_m_s3_rs]), 0.3
        )
        for axis in (5, 6):
            np.testing.assert_allclose(Q[np.ix_([axis, axis + 3], [axis, axis + 3])], other, rtol=1e-9)
        assert Q[7, 7] == pytest.approx(0.3 * SETTINGS.zero_walk_rad_s_rs**2)
        assert Q[4, 4] == pytest.approx(0.3 * 0.01 * SETTINGS.rate_rad_s**2)

    def test_a_missing_axis_is_uncertain_along_itself(self) -> None:
        x = np.zeros(N)
        x[4] = math.pi / 2  # body x is table Y
        _, Q = predicted_once(x, np.zeros((N, N)), 0.01, [0.0] * 3, [False, True, True], SETTINGS.densities)
        assert Q[3, 3] == pytest.approx(0.01 * 0.01 * SETTINGS.missing_acceleration_m_s2**2)
        assert Q[2, 2] == pytest.approx(0.01 * 0.01 * SETTINGS.acceleration_m_s2**2)

    @settings(max_examples=30, deadline=None)
    @given(seeds)
    def test_many_samples_are_one_after_the_other(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        n = 20
        steps = rng.uniform(0.001, 0.05, n)
        readings, there = rng.standard_normal((n, 3)), rng.random((n, 3)) < 0.8
        # Covariance and noises of order one, so that no term is lost in rounding.
        densities, root = rng.uniform(0.5, 2.0, SETTINGS.densities.size), rng.standard_normal((N, N))
        mean, covariance = rng.standard_normal(N), root @ root.T
        x, P = predict(mean, covariance, steps, readings, there, densities)
        for i in range(n):
            mean, covariance = predicted_once(mean, covariance, steps[i], readings[i], there[i], densities)
            np.testing.assert_allclose(x[i], mean, rtol=0, atol=1e-12)
            np.testing.assert_allclose(scaled(P[i], covariance), scaled(covariance, covariance), atol=1e-10)
        np.testing.assert_array_equal(P, P.transpose(0, 2, 1))


class TestDelay:
    """Late fixes give the estimate that they would have given without delay."""

    def test_it_is_the_textbook_filter(self) -> None:
        _, _, imu, fixes = own_world(np.random.default_rng(2), 20.0)
        xs, Ps = textbook(imu, fixes)
        late = DelayedFilter(START, 0.0)
        fused = fuse(late, imu, fixes)
        end = int(np.searchsorted(imu.time_s, fixes.time_s[len(fused.outcomes) - 1]))
        # Up to the last fix that has arrived both know the same.
        again, _ = textbook(imu, fixes.rows(slice(len(fused.outcomes))))
        np.testing.assert_allclose(late.x, again[-1], rtol=0, atol=1e-11)
        undelayed = DelayedFilter(START, 0.0)
        at_once = fuse(undelayed, imu, fixes.in_time_order()).track
        assert isinstance(at_once, FilterTrack)
        between = ~np.isin(imu.time_s, fixes.time_s)  # a fix counts from the sample after its arrival
        np.testing.assert_allclose(at_once.position_m[between], xs[between, 0:2], rtol=0, atol=1e-11)
        np.testing.assert_allclose(at_once.heading_rad[between], xs[between, 4], rtol=0, atol=1e-11)
        np.testing.assert_allclose(at_once.zero_m_s2[between], xs[between, 5:7], rtol=0, atol=1e-11)
        np.testing.assert_allclose(at_once.drift_m_s3[between], xs[between, 8:10], rtol=0, atol=1e-11)
        sigma = np.sqrt(np.diagonal(Ps, axis1=1, axis2=2))
        np.testing.assert_allclose(at_once.sigma[between], sigma[between], rtol=1e-8)
        assert end > 1800

    @settings(max_examples=15, deadline=None)
    @given(seeds)
    def test_the_order_of_arrival_does_not_matter(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        _, _, imu, fixes = own_world(rng, 6.0)
        false = np.where(rng.random((len(fixes), 1)) < 0.2, rng.uniform(-1.0, 1.0, (len(fixes), 2)), 0.0)
        fixes = replace(fixes, position_m=fixes.position_m + false, time_s=fixes.time_s - 0.004)
        ordered, mixed = DelayedFilter(START, 0.0), DelayedFilter(START, 0.0)
        for fusion in (ordered, mixed):
            fusion.add_samples(imu)
        for k in range(len(fixes)):
            ordered.add_fix(fixes[k])
        for k in rng.permutation(len(fixes)):
            mixed.add_fix(fixes[int(k)])
        np.testing.assert_allclose(mixed.x, ordered.x, rtol=0, atol=1e-10)
        np.testing.assert_allclose(scaled(mixed.P, ordered.P), scaled(ordered.P, ordered.P), atol=1e-7)

    def test_samples_one_by_one_are_samples_at_once(self) -> None:
        _, _, imu, fixes = own_world(np.random.default_rng(4), 12.0)
        settings = DelayedFilterSettings(buffer_s=1.0)  # the history is forgotten several times
        at_once = fuse(DelayedFilter(START, 0.0, settings), imu, fixes).track
        one_by_one, k = DelayedFilter(START, 0.0, settings), 0
        for i in range(len(imu)):
            track = one_by_one.add_samples(imu.part(i, i + 1))
            np.testing.assert_allclose(track.position_m[0], at_once.position_m[i], rtol=0, atol=1e-11)
            while k < len(fixes) and fixes.arrival_s[k] < imu.time_s[min(i + 1, len(imu) - 1)]:
                assert one_by_one.add_fix(fixes[k]) is FixOutcome.USED
                k += 1

    def test_an_exposure_within_an_interval(self) -> None:
        # Samples of a fifth of the length hold the same readings: there the exposures are at their ends.
        _, _, imu, _ = own_world(np.random.default_rng(5), 6.0)
        fine = ImuRecord(
            0.0, 0.002 * np.arange(1.0, 3001.0), np.repeat(imu.acceleration_m_s2, 5, 0), np.repeat(imu.rate_rad_s, 5)
        )
        rows = np.arange(101, 2900, 307)
        truth = strapdown(fine, START)
        fixes = FixRecord(fine.time_s[rows], fine.time_s[rows], truth.position_m[rows] + 1e-3, truth.heading_rad[rows])
        coarse, other = DelayedFilter(START, 0.0), DelayedFilter(START, 0.0)
        coarse.add_samples(imu)
        other.add_samples(fine)
        for k in range(len(fixes)):
            coarse.add_fix(fixes[k])
            other.add_fix(fixes[k])
        sigma = np.sqrt(np.diagonal(other.P))
        assert np.max(np.abs(coarse.x - other.x) / sigma) < 0.02
        np.testing.assert_allclose(scaled(coarse.P, other.P), scaled(other.P, other.P), atol=0.01)


class TestConsistency:
    def errors(self, runs, duration_s, seed):
        """At the end of each run, error squared of every state over its variance, and NEES; the NIS of all fixes."""
        squared, nees, nis = [], [], []
        for k in range(runs):
            track, zeros, imu, fixes = own_world(np.random.default_rng([seed, k]), duration_s)
            late = DelayedFilter(START, 0.0)
            fuse(late, imu, fixes)
            true = np.concatenate([track.position_m[-1], track.velocity_m_s[-1], [track.heading_rad[-1]], zeros[-1]])
            error = (late.x - true) / np.sqrt(np.diagonal(late.P))
            squared.append(error**2)
            nees.append(float(error @ np.linalg.solve(scaled(late.P, late.P), error)))
            nis.extend(late.nis)
        return np.array(squared), np.array(nees), np.array(nis)

    def check(self, runs, duration_s, seed):
        squared, nees, nis = self.errors(runs, duration_s, seed)
        low, high = stats.chi2.ppf([FALSE_ALARM / 2, 1 - FALSE_ALARM / 2], N * runs)
        assert low < nees.sum() < high
        # Each state alone, too: what is too sure of its zeros may be less sure of its heading. Bonferroni.
        low, high = stats.chi2.ppf([FALSE_ALARM / 2 / N, 1 - FALSE_ALARM / 2 / N], runs)
        for state, sum_of_squares in zip(STATES, squared.sum(axis=0), strict=True):
            assert low < sum_of_squares < high, state
        # Innovations of one run are independent, and those of several: χ² of 3 numbers each.
        low, high = stats.chi2.ppf([FALSE_ALARM / 2, 1 - FALSE_ALARM / 2], 3 * len(nis))
        assert low < nis.sum() < high

    def test_errors_are_as_large_as_stated(self) -> None:
        self.check(60, 15.0, seed=6)

    @pytest.mark.slow
    def test_errors_are_as_large_as_stated_in_many_long_runs(self) -> None:
        self.check(600, 60.0, seed=7)


class TestFalseFixes:
    def world(self, seed=8):
        return own_world(np.random.default_rng(seed), 12.0)

    def test_a_jump_is_rejected(self) -> None:
        _, _, imu, fixes = self.world()
        position = fixes.position_m.copy()
        position[8] += 0.3
        jumped = replace(fixes, position_m=position)
        late, without = DelayedFilter(START, 0.0), DelayedFilter(START, 0.0)
        outcomes = fuse(late, imu, jumped).outcomes
        assert [k for k, outcome in enumerate(outcomes) if outcome is not FixOutcome.USED] == [8]
        fuse(without, imu, fixes.rows(np.arange(len(fixes)) != 8))
        np.testing.assert_allclose(late.x, without.x, rtol=0, atol=1e-11)

    def test_a_right_place_with_a_wrong_heading_is_rejected(self) -> None:
        _, _, imu, fixes = self.world()
        heading = fixes.heading_rad.copy()
        heading[8] += math.radians(2.0)
        assert (
            fuse(DelayedFilter(START, 0.0), imu, replace(fixes, heading_rad=heading)).outcomes[8] is FixOutcome.REJECTED
        )

    def test_good_fixes_are_beyond_a_gate_as_often_as_chi_square_says(self) -> None:
        nis: list[float] = []
        for k in range(30):
            _, _, imu, fixes = own_world(np.random.default_rng([9, k]), 12.0)
            late = DelayedFilter(START, 0.0, DelayedFilterSettings(fix_gate=math.inf))
            fuse(late, imu, fixes)
            nis.extend(late.nis)
        beyond = int(np.sum(np.array(nis) > stats.chi2.isf(0.05, 3)))
        assert stats.binom.ppf(FALSE_ALARM / 2, len(nis), 0.05) <= beyond
        assert beyond <= stats.binom.isf(FALSE_ALARM / 2, len(nis), 0.05)

    def test_a_filter_that_is_lost_finds_back(self) -> None:
        track, _, imu, fixes = self.world()
        wrong = PlanarState(
            START.position_m + np.array([0.5, -0.4]), START.velocity_m_s, float(START.heading_rad) + 2.0
        )
        late = DelayedFilter(wrong, 0.0)
        fused = fuse(late, imu, fixes)
        expected = (FixOutcome.REJECTED, FixOutcome.REJECTED, FixOutcome.REACQUIRED, FixOutcome.USED)
        assert fused.outcomes[:4] == expected
        assert set(fused.outcomes[4:]) == {FixOutcome.USED}
        error = fused.track.position_m[-1] - track.position_m[-1]
        assert isinstance(fused.track, FilterTrack)
        assert np.all(np.abs(error) < 5.0 * fused.track.sigma[-1, :2])
        assert np.linalg.norm(error) < 0.01

    def test_false_fixes_that_disagree_do_not_make_it_give_up(self) -> None:
        _, _, imu, fixes = self.world()
        rng = np.random.default_rng(10)
        position, heading = fixes.position_m.copy(), fixes.heading_rad.copy()
        position[5:11], heading[5:11] = rng.uniform(-1.2, 1.2, (6, 2)), rng.uniform(-3.0, 3.0, 6)
        outcomes = fuse(
            DelayedFilter(START, 0.0), imu, replace(fixes, position_m=position, heading_rad=heading)
        ).outcomes
        assert outcomes[5:11] == (FixOutcome.REJECTED,) * 6
        assert set(outcomes[11:]) == {FixOutcome.USED}

    def test_false_fixes_that_move_as_nothing_can_do_not_either(self) -> None:
        """Right headings, and places that jump to and fro by 0.2 m: no velocity takes three of them."""
        _, _, imu, fixes = self.world()
        position = fixes.position_m.copy()
        position[5:11] += 0.3 + 0.1 * (-1.0) ** np.arange(6)[:, None]
        outcomes = fuse(DelayedFilter(START, 0.0), imu, replace(fixes, position_m=position)).outcomes
        assert outcomes[5:11] == (FixOutcome.REJECTED,) * 6
        assert set(outcomes[11:]) == {FixOutcome.USED}


class TestArrival:
    def test_duplicates_old_ones_and_those_ahead(self) -> None:
        _, _, imu, fixes = own_world(np.random.default_rng(11), 12.0)
        late = DelayedFilter(START, 0.0, DelayedFilterSettings(buffer_s=2.0))
        late.add_samples(imu.part(0, 1000))
        assert late.add_fix(PlanarFix(8.5, fixes.position_m[13], fixes.heading_rad[13])) is not FixOutcome.DUPLICATE
        x = late.x
        assert late.add_fix(PlanarFix(8.5, np.zeros(2), 0.0)) is FixOutcome.DUPLICATE
        assert late.add_fix(PlanarFix(7.9, np.zeros(2), 0.0)) is FixOutcome.TOO_OLD
        assert late.add_fix(PlanarFix(10.01, np.zeros(2), 0.0)) is FixOutcome.AHEAD
        np.testing.assert_array_equal(late.x, x)

    def test_a_fix_of_the_very_beginning_is_too_old(self) -> None:
        late = DelayedFilter(START, 0.0)
        assert late.add_fix(PlanarFix(0.0, START.position_m, 0.4)) is FixOutcome.TOO_OLD

    def test_a_drop_out_opens_the_gate_and_is_survived(self) -> None:
        track, _, imu, fixes = own_world(np.random.default_rng(12), 60.0)
        inside = (fixes.time_s > 15.0) & (fixes.time_s < 50.0)
        late = DelayedFilter(START, 0.0)
        fused = fuse(late, imu, fixes.rows(~inside))
        assert set(fused.outcomes) == {FixOutcome.USED}
        assert isinstance(fused.track, FilterTrack)
        before, end = np.searchsorted(imu.time_s, [15.0, 50.0])
        assert fused.track.sigma[end, 0] > 20.0 * fused.track.sigma[before, 0]
        off = np.abs(fused.track.position_m - track.position_m) / fused.track.sigma[:, :2]
        assert off.max() < 5.0
        assert np.linalg.norm(fused.track.position_m[-1] - track.position_m[-1]) < 0.01

    def test_missing_samples_widen_it(self) -> None:
        track, _, imu, fixes = own_world(np.random.default_rng(13), 12.0)
        acceleration, rate = imu.acceleration_m_s2.copy(), imu.rate_rad_s.copy()
        acceleration[600:640, 0], rate[700:720] = np.nan, np.nan
        holes = ImuRecord(0.0, imu.time_s, acceleration, rate)
        whole, fused = (fuse(DelayedFilter(START, 0.0), samples, fixes).track for samples in (imu, holes))
        assert isinstance(whole, FilterTrack)
        assert isinstance(fused, FilterTrack)
        assert fused.sigma[640, 2] > 1.5 * whole.sigma[640, 2]
        assert fused.sigma[720, 4] > 1.5 * whole.sigma[720, 4]
        assert np.all(np.abs(fused.position_m - track.position_m) < 5.0 * fused.sigma[:, :2])
        assert np.all(np.abs(fused.heading_rad - track.heading_rad) < 5.0 * fused.sigma[:, 4])

    def test_lost_readings_have_noises_of_their_own(self) -> None:
        """Each channel is lost on its own, 50 ms after its last reading; the reference goes row by row."""
        rng, n = np.random.default_rng(6), 120
        acceleration, rate = 0.01 * rng.standard_normal((n, 2)), 0.1 * rng.standard_normal(n)
        acceleration[20:60, 1], rate[40:100], acceleration[110:113, 0] = np.nan, np.nan, np.nan
        time_s = 0.01 * np.arange(1.0, n + 1.0)
        late = DelayedFilter(START, 0.0)
        # In pieces, of which some begin within what is lost.
        for first, last in ((0, 30), (30, 31), (31, 75), (75, n)):
            begin_s = 0.0 if first == 0 else time_s[first - 1]
            rows = slice(first, last)
            late.add_samples(ImuRecord(begin_s, time_s[rows], acceleration[rows], rate[rows]))
        x, P = np.concatenate([START.position_m, START.velocity_m_s, [0.4], np.zeros(5)]), SIGMA.covariance
        held_rate, dt = 0.0, np.diff(time_s, prepend=0.0)
        for i in range(n):
            there = np.isfinite([*acceleration[i], rate[i]])
            held_rate = rate[i] if there[2] else held_rate
            lost = (int(25 <= i < 60), int(45 <= i < 100))
            reading = [*np.nan_to_num(acceleration[i]), held_rate]
            x, P = predicted_once(x, P, dt[i], reading, there, SETTINGS.all_densities[lost])
        np.testing.assert_allclose(late.x, x, rtol=0, atol=1e-11)
        np.testing.assert_allclose(scaled(late.P, P), scaled(P, P), atol=1e-9)

    def test_a_minute_without_readings(self) -> None:
        """σ of velocity and heading grow with √t; a fix of the middle is taken there."""
        n = 6000
        late = DelayedFilter(START, 0.0)
        track = late.add_samples(
            ImuRecord(0.0, 0.01 * np.arange(1.0, n + 1.0), np.full((n, 2), np.nan), np.full(n, np.nan))
        )
        assert track.sigma[-1, 2] == pytest.approx(SETTINGS.lost_m_s_rs * math.sqrt(60.0), rel=0.01)
        assert track.sigma[-1, 4] == pytest.approx(SETTINGS.lost_rad_rs * math.sqrt(60.0), rel=0.01)
        far = START.position_m + START.velocity_m_s * 55.0 + [3.0, -2.0]
        assert late.add_fix(PlanarFix(55.0, far, 2.5)) is FixOutcome.USED
        assert math.sqrt(late.P[0, 0]) < 0.2 * track.sigma[-1, 0]

    def test_samples_follow_one_another(self) -> None:
        _, _, imu, _ = own_world(np.random.default_rng(14), 1.0)
        with pytest.raises(ValueError, match=r"at 0 s; instead received samples that begin at 0\.05 s"):
            DelayedFilter(START, 0.0).add_samples(imu.part(5, 10))

    def test_settings_are_positive(self) -> None:
        with pytest.raises(ValueError, match="Input fix_m must be positive; instead received 0"):
            DelayedFilterSettings(fix_m=0.0)
