"""Zeros of the accelerometer in closed form.

Who checks whom
---------------

=======================  ===============================================================================
operation                oracle
=======================  ===============================================================================
double_integral          the source's double sum, written out; the integration step by step
zero_problem             the source's real sums and its matrix
constant_zeros_after,    scipy.optimize.least_squares; noise-free data; the scatter of many fits
zeros_and_start
heading_from_fixes       noise-free data
=======================  ===============================================================================
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats
from scipy.optimize import least_squares

from adcs.mockup.navigation.fixes import FixRecord
from adcs.mockup.navigation.strapdown import ImuRecord, PlanarState, strapdown
from adcs.mockup.navigation.zeros import (
    constant_zeros_after,
    double_integral,
    heading_from_fixes,
    zero_problem,
    zeros_and_start,
)

seeds = st.integers(0, 2**32 - 1)
ZEROS = np.array([0.005, -0.004])
START = PlanarState(np.array([0.3, -0.2]), np.array([0.05, 0.02]), 0.4)
FALSE_ALARM = 1e-4


def random_imu(rng, duration_s=15.0):
    """What a satellite that turns and fires would read without zeros; uneven steps."""
    time_s = 2.0 + np.cumsum(rng.uniform(0.008, 0.012, int(100 * duration_s)))
    t = time_s - 2.0
    rate = rng.uniform(-0.5, 0.5) + rng.uniform(0.0, 0.7) * np.sin(rng.uniform(0.3, 2.0) * t + rng.uniform(0.0, 6.0))
    fire = 0.04 * np.sign(np.sin(np.outer(t, rng.uniform(0.5, 2.0, 2))))
    return ImuRecord(2.0, time_s, fire, rate)


def fixes_of(track, every=60, noise=0.0, rng=None):
    rows = np.arange(every // 2, len(track), every)
    position = track.position_m[rows]
    if rng is not None:
        position = position + noise * rng.standard_normal(position.shape)
    return FixRecord(track.time_s[rows], track.time_s[rows], position, track.heading_rad[rows])


def middle_heading(imu, heading0=START.heading_rad):
    angle = imu.rate_rad_s * imu.steps_s
    return heading0 + np.cumsum(angle) - 0.5 * angle


def double_sum(t, u):
    """Twice integrated as the source writes it, t[0] being the beginning: O(n²) for each of the n results."""
    dt = np.diff(t)
    result = []
    for k in range(1, len(t)):
        cross = sum(u[j] * dt[j] * dt[m] for j in range(k - 1) for m in range(j + 1, k))
        result.append(cross + 0.5 * sum(u[j] * dt[j] ** 2 for j in range(k)))
    return np.array(result)


class TestDoubleIntegral:
    @settings(max_examples=20, deadline=None)
    @given(seeds, st.integers(1, 25))
    def test_the_single_sum_is_the_double_sum(self, seed: int, n: int) -> None:
        rng = np.random.default_rng(seed)
        t = 100.0 + np.concatenate([[0.0], np.cumsum(rng.uniform(0.005, 0.02, n))])
        u = rng.standard_normal(n)
        single = double_integral(t[0], t[1:], u, t[1:])
        # Time stamps of 100 s are exact to 1e-14 s only; the sums themselves are of order 1.
        np.testing.assert_allclose(single.real, double_sum(t - t[0], u), rtol=0, atol=1e-12)
        assert not single.imag.any()

    def test_it_is_what_the_integration_moves_by(self) -> None:
        imu = random_imu(np.random.default_rng(3))
        u = imu.acceleration_m_s2 @ [1.0, 1j] * np.exp(1j * middle_heading(imu))
        moved = double_integral(imu.begin_s, imu.time_s, u, imu.time_s)
        track = strapdown(imu, PlanarState(np.zeros(2), np.zeros(2), START.heading_rad))
        np.testing.assert_allclose(np.stack([moved.real, moved.imag], axis=1), track.position_m, atol=1e-12)

    def test_within_an_interval_it_is_a_parabola(self) -> None:
        at = [0.0, 0.25, 1.0, 1.5, 2.0]
        values = double_integral(0.0, [1.0, 2.0], [2.0, 4.0], at).real
        np.testing.assert_allclose(values, [0.0, 0.25**2, 1.0, 1.0 + 2.0 * 0.5 + 2.0 * 0.5**2, 1.0 + 2.0 + 2.0])

    def test_outside_of_the_record_it_is_refused(self) -> None:
        with pytest.raises(ValueError, match=r"must be within 1 to 3 s; instead received 2\.5 to 3\.5 s"):
            double_integral(1.0, [2.0, 3.0], [1.0, 1.0], [2.5, 3.5])


class TestTheSourcesSums:
    """Its real coefficients, at counter-clockwise heading: sin φ has the other sign."""

    def coefficients(self, seed):
        imu = random_imu(np.random.default_rng(seed))
        phi = middle_heading(imu)
        fixes = fixes_of(strapdown(imu.subtract_zeros(-ZEROS, 0.0), START))

        def D(u):
            return double_integral(imu.begin_s, imu.time_s, u, fixes.time_s).real

        x, y = imu.acceleration_m_s2.T
        t = fixes.time_s - imu.begin_s
        (p_x, p_y), (v_x, v_y) = START.position_m, START.velocity_m_s
        f_x = p_x + v_x * t + D(x * np.cos(phi) - y * np.sin(phi))
        f_y = p_y + v_y * t + D(y * np.cos(phi) + x * np.sin(phi))
        a_x, b_x, a_y, b_y = -D(np.cos(phi)), D(np.sin(phi)), -D(np.sin(phi)), -D(np.cos(phi))
        return imu, fixes, (f_x, f_y, a_x, b_x, a_y, b_y)

    @pytest.mark.parametrize("seed", range(5))
    def test_the_matrix_is_a_number(self, seed: int) -> None:
        _, _, (_, _, a_x, b_x, a_y, b_y) = self.coefficients(seed)
        a11, a12, a22 = np.sum(a_x**2 + a_y**2), np.sum(a_x * b_x + a_y * b_y), np.sum(b_x**2 + b_y**2)
        assert abs(a12) / a11 <= 1e-12
        assert a22 == pytest.approx(a11, rel=1e-12)

    @pytest.mark.parametrize("seed", range(5))
    def test_its_solution_is_ours(self, seed: int) -> None:
        imu, fixes, (f_x, f_y, a_x, b_x, a_y, b_y) = self.coefficients(seed)
        c_x, c_y = fixes.position_m.T
        A = np.array(
            [
                [np.sum(a_x**2 + a_y**2), np.sum(a_x * b_x + a_y * b_y)],
                [np.sum(a_x * b_x + a_y * b_y), np.sum(b_x**2 + b_y**2)],
            ]
        )
        f = -np.array([np.sum(a_x * (f_x - c_x) + a_y * (f_y - c_y)), np.sum(b_x * (f_x - c_x) + b_y * (f_y - c_y))])
        problem = zero_problem(imu, middle_heading(imu), fixes)
        (turn,) = problem.by_zero
        free = complex(*START.position_m) + complex(*START.velocity_m_s) * problem.time_s + problem.moved
        zero = np.vdot(turn, free - problem.measured) / np.vdot(turn, turn)
        np.testing.assert_allclose([zero.real, zero.imag], np.linalg.solve(A, f), rtol=1e-9)


class TestNoiseFree:
    """Every fit finds what went in, to 1e-9 m/s²."""

    def record(self, seed, zeros=ZEROS):
        rng = np.random.default_rng(seed)
        true = random_imu(rng)
        track = strapdown(true, START)
        return true.subtract_zeros(-np.asarray(zeros), 0.0), fixes_of(track)

    @pytest.mark.parametrize("first", [2, 4, 10])
    def test_two_unknowns_with_a_line_through_the_first_fixes(self, first: int) -> None:
        # Thrust and zeros bend the path between these fixes; the line is that of what the samples leave of it.
        imu, fixes = self.record(first)
        fit = constant_zeros_after(zero_problem(imu, middle_heading(imu), fixes), first)
        np.testing.assert_allclose(fit.zero_m_s2, ZEROS, rtol=0, atol=1e-9)
        np.testing.assert_allclose(fit.start_position_m, START.position_m, rtol=0, atol=1e-9)
        np.testing.assert_allclose(fit.start_velocity_m_s, START.velocity_m_s, rtol=0, atol=1e-9)

    @pytest.mark.parametrize("seed", range(5))
    def test_six_unknowns(self, seed: int) -> None:
        imu, fixes = self.record(seed)
        fit = zeros_and_start(zero_problem(imu, middle_heading(imu), fixes))
        np.testing.assert_allclose(fit.zero_m_s2, ZEROS, rtol=0, atol=1e-9)
        np.testing.assert_allclose(fit.start_position_m, START.position_m, rtol=0, atol=1e-9)
        np.testing.assert_allclose(fit.start_velocity_m_s, START.velocity_m_s, rtol=0, atol=1e-9)
        again = strapdown(imu.subtract_zeros(fit.zeros[0], 0.0), fit.start(START.heading_rad))
        rows = np.searchsorted(again.time_s, fixes.time_s)
        np.testing.assert_allclose(again.position_m[rows], fixes.position_m, atol=1e-8)

    def test_zeros_that_go_along_with_the_temperature(self) -> None:
        rng = np.random.default_rng(9)
        true = random_imu(rng, duration_s=60.0)
        warming = 5.0 * (1.0 - np.exp(-(true.time_s - true.begin_s) / 30.0))
        slope = np.array([3e-4, -2e-4])
        imu = true.subtract_zeros(-(ZEROS + warming[:, None] * slope), 0.0)
        fixes = fixes_of(strapdown(true, START))
        fit = zeros_and_start(zero_problem(imu, middle_heading(imu), fixes, warming[None]))
        np.testing.assert_allclose(fit.zeros, [ZEROS, slope], rtol=0, atol=1e-9)
        np.testing.assert_allclose(fit.zero_course(warming[None])[-1], ZEROS + warming[-1] * slope, atol=1e-8)

    def test_constant_zeros_do_not_fit_a_drift(self) -> None:
        rng = np.random.default_rng(10)
        true = random_imu(rng, duration_s=180.0)
        t = true.time_s - true.begin_s
        imu = true.subtract_zeros(-(ZEROS + np.outer(t / 180.0, [0.002, -0.0015])), 0.0)
        fixes = fixes_of(strapdown(true, START))
        heading = middle_heading(imu)
        assert zeros_and_start(zero_problem(imu, heading, fixes)).residual_rms_m > 0.005  # five times a fix's noise
        assert zeros_and_start(zero_problem(imu, heading, fixes, t[None])).residual_rms_m < 1e-9

    def test_the_heading_and_the_gyro_s_zero(self) -> None:
        true = random_imu(np.random.default_rng(11))
        track = strapdown(true, PlanarState(np.zeros(2), np.zeros(2), 3.1))
        fixes = fixes_of(track)
        half_turns = FixRecord(
            fixes.time_s, fixes.arrival_s, fixes.position_m, np.angle(np.exp(1j * fixes.heading_rad))
        )
        heading, zero = heading_from_fixes(true.subtract_zeros(0.0, -0.003), half_turns)
        assert zero == pytest.approx(0.003, abs=1e-10)
        np.testing.assert_allclose(np.exp(1j * heading), np.exp(1j * middle_heading(true, 3.1)), atol=1e-4)


class TestAgainstScipy:
    """Least squares on the integrated track itself, by numerical derivatives."""

    def problem(self):
        rng = np.random.default_rng(12)
        true = random_imu(rng)
        fixes = fixes_of(strapdown(true, START), noise=1e-3, rng=rng)
        imu = true.subtract_zeros(-ZEROS, 0.0)
        return imu, fixes, zero_problem(imu, middle_heading(imu), fixes)

    def residual(self, imu, fixes, zeros, position, velocity):
        track = strapdown(imu.subtract_zeros(zeros, 0.0), PlanarState(position, velocity, START.heading_rad))
        return (track.position_m[np.searchsorted(track.time_s, fixes.time_s)] - fixes.position_m).ravel()

    def test_six_unknowns(self) -> None:
        imu, fixes, problem = self.problem()
        other = least_squares(lambda u: self.residual(imu, fixes, u[:2], u[2:4], u[4:]), np.zeros(6), x_scale="jac")
        fit = zeros_and_start(problem)
        ours = np.concatenate([fit.zero_m_s2, fit.start_position_m, fit.start_velocity_m_s])
        np.testing.assert_allclose(ours, other.x, atol=1e-8)
        theirs = 1e-6 * np.linalg.inv(other.jac.T @ other.jac)
        scale = np.sqrt(np.diagonal(theirs))
        np.testing.assert_allclose(fit.covariance / np.outer(scale, scale), theirs / np.outer(scale, scale), atol=1e-5)


class TestCovariance:
    """The scatter of fits to noisy fixes; one NEES of all seeds, false alarm 1e-4."""

    @pytest.mark.parametrize("fit_of", [zeros_and_start, constant_zeros_after])
    def test_the_errors_are_as_large_as_stated(self, fit_of) -> None:
        rng = np.random.default_rng(13)
        true = random_imu(rng)
        track, imu = strapdown(true, START), true.subtract_zeros(-ZEROS, 0.0)
        heading, total, runs = middle_heading(imu), 0.0, 200
        for _ in range(runs):
            fit = fit_of(zero_problem(imu, heading, fixes_of(track, noise=1e-3, rng=rng)))
            error = fit.zero_m_s2 - ZEROS
            if len(fit.covariance) == 6:
                start = [fit.start_position_m - START.position_m, fit.start_velocity_m_s - START.velocity_m_s]
                error = np.concatenate([error, *start])
            total += float(error @ np.linalg.solve(fit.covariance, error))
        low, high = stats.chi2.ppf([FALSE_ALARM / 2, 1 - FALSE_ALARM / 2], runs * len(error))
        assert low < total < high


class TestRefusals:
    def problem(self, n_fixes=20, courses=None):
        imu = random_imu(np.random.default_rng(14))
        fixes = fixes_of(strapdown(imu, START)).rows(slice(n_fixes))
        return zero_problem(imu, middle_heading(imu), fixes, courses)

    def test_too_few_fixes(self) -> None:
        with pytest.raises(ValueError, match="determine 3 complex unknowns; instead received 2 that do not"):
            zeros_and_start(self.problem(2))
        with pytest.raises(ValueError, match="less than the 4 fixes; instead received 4"):
            constant_zeros_after(self.problem(4), 4)

    def test_a_course_that_is_constant(self) -> None:
        with pytest.raises(ValueError, match="determine 4 complex unknowns"):
            zeros_and_start(self.problem(courses=np.ones((1, 1500))))

    def test_courses_where_there_are_none(self) -> None:
        problem = self.problem(courses=np.linspace(0.0, 1.0, 1500)[None])
        with pytest.raises(ValueError, match="must have constant zeros only; instead received 1 more"):
            constant_zeros_after(problem)

    def test_shapes_and_missing_readings(self) -> None:
        imu = random_imu(np.random.default_rng(15))
        fixes = fixes_of(strapdown(imu, START))
        with pytest.raises(ValueError, match=r"heading_rad must have shape \(1500,\)"):
            zero_problem(imu, [0.0], fixes)
        with pytest.raises(ValueError, match=r"courses must have shape \(m, 1500\)"):
            zero_problem(imu, middle_heading(imu), fixes, np.ones(1500))
        with pytest.raises(ValueError, match="must have all readings"):
            zero_problem(imu.subtract_zeros([math.nan, 0.0], 0.0), middle_heading(imu), fixes)
        with pytest.raises(ValueError, match="must be two at least; instead received 1"):
            heading_from_fixes(imu, fixes.rows(slice(1)))
