"""Planar inertial navigation: samples, gate, integration.

Who checks whom
---------------

====================  ==========================================================================
operation             oracle
====================  ==========================================================================
rotate                scipy's Rotation about Z
strapdown             step by step; closed forms of constant acceleration; scipy's solve_ivp
between, concatenate  the integral over the whole is that over its parts
hold                  straight motion through what the gate rejects
====================  ==========================================================================
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from adcs.mockup.navigation.strapdown import Gate, ImuRecord, PlanarState, hold, rotate, step, strapdown, wrapped

seeds = st.integers(0, 2**32 - 1)
REST = PlanarState(np.zeros(2), np.zeros(2), 0.0)


def random_record(rng, n=50, runs=()):
    time_s = 3.0 + np.cumsum(rng.uniform(0.002, 0.03, n))
    return ImuRecord(3.0, time_s, rng.normal(0.0, 0.1, (*runs, n, 2)), rng.normal(0.0, 1.0, (*runs, n)))


def random_state(rng, runs=()):
    return PlanarState(rng.standard_normal((*runs, 2)), rng.standard_normal((*runs, 2)), rng.standard_normal(runs))


def constant(n, acceleration, rate, step_s=0.01):
    return ImuRecord(0.0, step_s * np.arange(1.0, n + 1.0), np.tile(acceleration, (n, 1)), np.full(n, rate))


class TestSign:
    """The one convention: heading counter-clockwise, a_table = R(φ) a_body, the gyro reads dφ/dt."""

    def test_at_a_heading_of_90_degrees_thrust_along_x_moves_along_y(self) -> None:
        track = strapdown(constant(100, [0.04, 0.0], 0.0), PlanarState(np.zeros(2), np.zeros(2), math.pi / 2))
        np.testing.assert_allclose(track.position_m[-1], [0.0, 0.02], atol=1e-15)
        np.testing.assert_allclose(track.velocity_m_s[-1], [0.0, 0.04], atol=1e-15)

    def test_a_positive_rate_turns_thrust_from_x_towards_y(self) -> None:
        turn = strapdown(constant(100, [0.0, 0.0], math.pi / 2), REST).state(-1)
        assert turn.heading_rad == pytest.approx(math.pi / 2)
        assert step(turn, 1.0, [1.0, 0.0], 0.0).velocity_m_s == pytest.approx([0.0, 1.0])

    @given(st.floats(-10.0, 10.0), seeds)
    def test_turning_is_a_rotation_about_z(self, heading: float, seed: int) -> None:
        v = np.random.default_rng(seed).standard_normal((5, 2))
        about_z = Rotation.from_euler("z", heading).apply(np.column_stack([v, np.zeros(5)]))
        np.testing.assert_allclose(rotate(heading, v), about_z[:, :2], atol=1e-14)

    @given(st.floats(-50.0, 50.0))
    def test_wrapped_angles_are_the_same_direction(self, angle: float) -> None:
        value = float(wrapped(angle))
        assert -math.pi < value <= math.pi
        assert math.cos(value - angle) == pytest.approx(1.0, abs=1e-12)


class TestIntegration:
    @settings(deadline=None)
    @given(seeds)
    def test_a_record_is_its_steps(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        imu, state = random_record(rng), random_state(rng)
        track = strapdown(imu, state)
        for i, dt in enumerate(imu.steps_s):
            state = step(state, float(dt), imu.acceleration_m_s2[i], imu.rate_rad_s[i])
            np.testing.assert_allclose(track.state(i).position_m, state.position_m, rtol=0, atol=1e-13)
            np.testing.assert_allclose(track.state(i).velocity_m_s, state.velocity_m_s, rtol=0, atol=1e-13)
            assert track.heading_rad[i] == pytest.approx(float(state.heading_rad), abs=1e-13)

    def test_several_runs_at_once_are_the_runs_one_by_one(self) -> None:
        rng = np.random.default_rng(1)
        imu, start = random_record(rng, runs=(2, 3)), random_state(rng, runs=(2, 3))
        track = strapdown(imu, start)
        one = ImuRecord(imu.begin_s, imu.time_s, imu.acceleration_m_s2[1, 2], imu.rate_rad_s[1, 2])
        alone = strapdown(one, PlanarState(start.position_m[1, 2], start.velocity_m_s[1, 2], start.heading_rad[1, 2]))
        np.testing.assert_allclose(track.position_m[1, 2], alone.position_m, atol=1e-14)
        np.testing.assert_allclose(track.state(-1).velocity_m_s[1, 2], alone.velocity_m_s[-1], atol=1e-14)

    @given(st.floats(-3.0, 3.0), st.integers(1, 400))
    def test_constant_acceleration_is_a_parabola(self, heading: float, n: int) -> None:
        start = PlanarState(np.array([1.0, -2.0]), np.array([0.1, 0.2]), heading)
        end = strapdown(constant(n, [0.03, -0.02], 0.0), start).state(-1)
        t, a = 0.01 * n, rotate(heading, [0.03, -0.02])
        np.testing.assert_allclose(end.position_m, start.position_m + start.velocity_m_s * t + 0.5 * a * t**2)
        np.testing.assert_allclose(end.velocity_m_s, start.velocity_m_s + a * t)

    def test_a_turning_thrust_is_that_of_the_differential_equation(self) -> None:
        a, w = np.array([0.03, 0.01]), 0.7

        def flow(t, y):
            return [y[2], y[3], *rotate(y[4], a), w]

        exact = solve_ivp(flow, (0.0, 10.0), [0.0, 0.0, 0.1, 0.0, 0.2], rtol=1e-11, atol=1e-12).y[:, -1]
        errors = []
        for n in (1000, 2000):
            end = strapdown(constant(n, a, w, 10.0 / n), PlanarState(np.zeros(2), np.array([0.1, 0.0]), 0.2)).state(-1)
            errors.append(np.linalg.norm(end.position_m - exact[:2]))
            assert end.heading_rad == pytest.approx(exact[4])
        assert errors[0] < 2e-6
        assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.05)  # the middle heading makes it of second order


class TestCutting:
    @settings(deadline=None)
    @given(seeds, st.floats(0.0, 1.0))
    def test_the_whole_is_its_parts(self, seed: int, fraction: float) -> None:
        rng = np.random.default_rng(seed)
        imu, start = random_record(rng), random_state(rng)
        cut_s = imu.begin_s + fraction * (imu.end_s - imu.begin_s)
        first, second = imu.between(imu.begin_s, cut_s), imu.between(cut_s, imu.end_s)
        middle = strapdown(first, start).state(-1) if len(first) else start
        end = strapdown(second, middle).state(-1) if len(second) else middle
        whole = strapdown(imu, start).state(-1)
        # A cut leaves the mean acceleration but turns both parts by headings of their own: second order in the step.
        np.testing.assert_allclose(end.position_m, whole.position_m, atol=1e-5)
        assert end.heading_rad == pytest.approx(float(whole.heading_rad), abs=1e-12)

    @given(seeds, st.integers(0, 50))
    def test_parts_at_samples_make_the_record_again(self, seed: int, row: int) -> None:
        imu = random_record(np.random.default_rng(seed))
        whole = imu.part(0, row).concatenate(imu.part(row, 50))
        assert whole.begin_s == imu.begin_s
        np.testing.assert_array_equal(whole.time_s, imu.time_s)
        np.testing.assert_array_equal(whole.acceleration_m_s2, imu.acceleration_m_s2)

    def test_it_begins_and_ends_where_it_is_cut(self) -> None:
        imu = constant(10, [1.0, 2.0], 3.0)
        part = imu.between(0.025, 0.081)
        assert (part.begin_s, part.end_s, len(part)) == (0.025, 0.081, 7)
        assert part.steps_s.sum() == pytest.approx(0.056)
        assert len(imu.between(0.05, 0.05)) == 0

    def test_what_it_does_not_cover_is_refused(self) -> None:
        imu = constant(10, [1.0, 2.0], 3.0)
        for first_s, last_s in ((-0.1, 0.05), (0.05, 0.2), (0.05, 0.04)):
            with pytest.raises(ValueError, match=r"must be in order within 0 to 0\.1 s"):
                imu.between(first_s, last_s)
        with pytest.raises(ValueError, match=r"must begin where this record ends, at 0\.1 s"):
            imu.concatenate(imu)


class TestTimeStamps:
    @pytest.mark.parametrize(
        ("time_s", "text"),
        [
            ([0.1, 0.2, 0.15], "0.15 s after 0.2 s .sample 2."),
            ([0.1, 0.1], "0.1 s after 0.1 s .sample 1."),
            ([0.0, 0.1], "0 s after 0 s .sample 0."),
            ([0.1, math.nan], "nan s after 0.1 s .sample 1."),
        ],
    )
    def test_that_go_back_are_refused(self, time_s: list[float], text: str) -> None:
        n = len(time_s)
        with pytest.raises(ValueError, match=f"must increase from sample to sample; instead received {text}"):
            ImuRecord(0.0, np.array(time_s), np.zeros((n, 2)), np.zeros(n))

    def test_shapes_are_checked(self) -> None:
        with pytest.raises(ValueError, match=r"Input time_s must have shape \(n,\)"):
            ImuRecord(0.0, np.ones((1, 1)), np.zeros((1, 2)), np.zeros(1))
        with pytest.raises(ValueError, match=r"Input rate_rad_s must have shape \(..., 1\)"):
            ImuRecord(0.0, np.ones(1), np.zeros((1, 2)), np.zeros(2))
        with pytest.raises(ValueError, match=r"Input acceleration_m_s2 must have shape \(1, 2\)"):
            ImuRecord(0.0, np.ones(1), np.zeros((1, 3)), np.zeros(1))
        with pytest.raises(ValueError, match=r"Input position_m must have shape \(..., 2\)"):
            PlanarState(np.zeros(3), np.zeros(2), 0.0)


class TestGaps:
    def test_time_goes_on_in_steps_without_readings(self) -> None:
        """Of 60 intervals, 20 are missing after the 30th sample; the next sample is the mean over its own one."""
        rng = np.random.default_rng(4)
        whole = ImuRecord(2.0, 2.0 + 0.01 * np.arange(1.0, 61.0), rng.standard_normal((3, 60, 2)), np.ones((3, 60)))
        there = np.r_[0:30, 50:60]
        imu = ImuRecord(2.0, whole.time_s[there], whole.acceleration_m_s2[:, there], whole.rate_rad_s[:, there])
        np.testing.assert_allclose(imu.gaps_s, [[2.3, 2.5]], atol=1e-12)
        filled = imu.fill_gaps()
        np.testing.assert_allclose(filled.time_s, whole.time_s, atol=1e-12)
        np.testing.assert_array_equal(filled.acceleration_m_s2[:, there], imu.acceleration_m_s2)
        assert np.isnan(filled.acceleration_m_s2[:, 30:50]).all()
        assert np.isnan(filled.rate_rad_s[:, 30:50]).all()
        assert len(filled.gaps_s) == 0

    def test_several_gaps_of_no_whole_number_of_steps(self) -> None:
        time_s = np.concatenate([0.1 * np.arange(1, 11), 2.33 + 0.1 * np.arange(10), 9.871 + 0.1 * np.arange(10)])
        filled = ImuRecord(0.0, time_s, np.zeros((30, 2)), np.zeros(30)).fill_gaps()
        assert np.isin(time_s, filled.time_s).all()
        assert 0.05 < filled.steps_s.min() < filled.steps_s.max() < 0.1 + 1e-9
        assert np.isnan(filled.rate_rad_s).sum() == len(filled) - 30

    @pytest.mark.parametrize("n", [0, 1, 9])
    def test_a_few_intervals_are_no_gap(self, n: int) -> None:
        time_s = 0.01 * np.cumsum([*[1.0] * 4, 4.9, *[1.0] * 4])[:n]
        imu = ImuRecord(0.0, time_s, np.zeros((n, 2)), np.zeros(n))
        assert imu.gaps_s.shape == (0, 2)
        assert imu.fill_gaps() is imu


class TestGate:
    def imu(self) -> ImuRecord:
        """Ten samples; a spike on x in sample 3, a missing y in sample 5, a wild rate in sample 7."""
        acceleration, rate = np.full((10, 2), 0.1), np.full(10, 1.0)
        acceleration[3, 0], acceleration[5, 1], rate[7] = -0.6, np.nan, 4.0
        return ImuRecord(0.0, 0.01 * np.arange(1.0, 11.0), acceleration, rate)

    def test_every_channel_has_its_own(self) -> None:
        expected = np.ones((10, 3), dtype=bool)
        expected[[3, 5, 7], [0, 1, 2]] = False
        np.testing.assert_array_equal(Gate().accept(self.imu()), expected)

    def test_velocity_and_rate_are_held(self) -> None:
        imu = self.imu()
        believed = hold(imu, Gate().accept(imu))
        np.testing.assert_array_equal(believed.acceleration_m_s2[[3, 5]], [[0.0, 0.1], [0.1, 0.0]])
        np.testing.assert_array_equal(believed.rate_rad_s, np.ones(10))

    def test_time_does_not_stop(self) -> None:
        imu = constant(100, [5.0, 5.0], 0.0)
        track = strapdown(hold(imu, Gate().accept(imu)), PlanarState(np.zeros(2), np.array([0.2, -0.1]), 1.0))
        np.testing.assert_allclose(track.position_m[-1], [0.2, -0.1])
        np.testing.assert_allclose(track.velocity_m_s[-1], [0.2, -0.1])

    def test_a_rate_from_before_the_record_is_held(self) -> None:
        imu = constant(5, [0.0, 0.0], 100.0)
        np.testing.assert_array_equal(hold(imu, Gate().accept(imu), 0.3).rate_rad_s, np.full(5, 0.3))
        empty = imu.part(0, 0)
        assert len(hold(empty, Gate().accept(empty))) == 0

    def test_the_source_s_limit_rejects_its_own_firings(self) -> None:
        firing = constant(1, [0.0, 0.0], math.radians(105.0))
        assert not Gate(rate_rad_s=math.radians(50.0)).accept(firing)[0, 2]
        assert Gate().accept(firing)[0, 2]

    def test_limits_are_positive(self) -> None:
        with pytest.raises(ValueError, match="Input acceleration_m_s2 must be positive"):
            Gate(acceleration_m_s2=0.0)
