"""Motion models: against the differential equations that they solve, numerical derivatives, and closed forms."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from filterpy.common import van_loan_discretization
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from magloc.navigation.measured_motion import MeasuredMotion
from magloc.tracking.motion import (
    CoordinatedTurn,
    KnownMotion,
    LinearMotion,
    MotionModel,
    OrnsteinUhlenbeck,
    RandomWalk,
    cross_matrix,
    known_motions,
    rotation_matrix,
)
from tests.oracles import derivative

FloatArray = NDArray[np.float64]
VECTORS = npst.arrays(np.float64, (3,), elements=st.floats(-10.0, 10.0))
MODELS: list[MotionModel] = [
    RandomWalk(0.1, 0.02),
    OrnsteinUhlenbeck(0.1, 0.02),
    OrnsteinUhlenbeck(0.5, 0.3, correlation_s=4.0),
    CoordinatedTurn(0.5, 0.1),
    KnownMotion(0.1, 0.02, (0.3, -0.2, 0.1), (0.0, 0.05, -0.1), (1.0, 0.4, -0.2), (0.1, -0.2, 0.3), 0.05, 0.03, 0.01),
]


def step_derivative(motion: MotionModel, x: FloatArray, dt_s: float, step: float = 1e-2) -> FloatArray:
    """Numerical derivative of the predicted state."""

    def moved(states: FloatArray) -> FloatArray:
        return np.apply_along_axis(lambda state: motion.step(state, dt_s)[0], -1, states)

    return derivative(moved, x, step, atol=1e-9)


def state_of(motion: MotionModel, seed: int) -> FloatArray:
    """A state with a moment of about 100 A·m², and speeds and rates of the size that the model expects."""
    rng = np.random.default_rng(seed)
    x = np.concatenate([rng.normal(0.0, 5.0, 3), rng.normal(0.0, 60.0, 3), np.zeros(motion.n_states - 6)])
    x[6:9] = rng.normal(0.0, motion.speed_m_s, x[6:9].size)
    x[9:] = rng.normal(0.0, 0.3, x[9:].size)
    return x


class TestCrossMatrix:
    @given(VECTORS, VECTORS)
    def test_is_the_cross_product(self, a: FloatArray, b: FloatArray) -> None:
        np.testing.assert_allclose(cross_matrix(a) @ b, np.cross(a, b), atol=1e-12)

    def test_keeps_batches(self) -> None:
        vectors = np.random.default_rng(0).normal(size=(2, 4, 3))
        matrices = cross_matrix(vectors)
        assert matrices.shape == (2, 4, 3, 3)
        np.testing.assert_array_equal(matrices[1, 2], cross_matrix(vectors[1, 2]))
        np.testing.assert_array_equal(matrices, -np.swapaxes(matrices, -1, -2))


class TestRotationMatrix:
    @given(VECTORS)
    def test_is_scipys(self, vector: FloatArray) -> None:
        np.testing.assert_allclose(rotation_matrix(vector), Rotation.from_rotvec(vector).as_matrix(), atol=1e-13)

    @pytest.mark.parametrize("angle", [0.0, 1e-12, 0.99e-8, 1.01e-8, 1e-4, math.pi, 2.0 * math.pi])
    def test_at_every_size_of_angle(self, angle: float) -> None:
        vector = angle * np.array([2.0, -1.0, 2.0]) / 3.0
        np.testing.assert_allclose(rotation_matrix(vector), Rotation.from_rotvec(vector).as_matrix(), atol=2e-15)


class TestJacobian:
    """F is the derivative of the step, for every model."""

    @pytest.mark.parametrize("motion", MODELS)
    @pytest.mark.parametrize("dt_s", [0.05, 0.5, 5.0])
    def test_is_the_derivative(self, motion: MotionModel, dt_s: float) -> None:
        x = state_of(motion, 7)
        _, F, _ = motion.step(x, dt_s)
        numerical = step_derivative(motion, x, dt_s)
        assert F.shape == (x.size, x.size)
        np.testing.assert_allclose(F, numerical, atol=1e-7)

    @pytest.mark.parametrize("angle", [0.0, 1e-6, 0.0199, 0.0201])
    def test_of_a_slowly_wandering_turn(self, angle: float) -> None:
        """At rest, and on both sides of the angle below which the series stands for the quotient."""
        motion = OrnsteinUhlenbeck(0.5, 0.3, correlation_s=1e9)
        x = state_of(motion, 3)
        x[9:] = np.array([2.0, -1.0, 2.0]) / 3.0 * angle
        _, F, _ = motion.step(x, 0.5)
        np.testing.assert_allclose(F, step_derivative(motion, x, 0.5, step=1e-3), atol=1e-6)

    @pytest.mark.parametrize("angle", [0.9e-4, 1.1e-4])
    def test_of_a_slow_turn(self, angle: float) -> None:
        """On both sides of the angle below which the series stands for the quotient."""
        motion = CoordinatedTurn(0.5, 0.1)
        x = np.array([1.0, 2.0, 3.0, 60.0, -50.0, 40.0, 0.5, -0.3, 0.2, angle])
        _, F, _ = motion.step(x, 1.0)
        np.testing.assert_allclose(F, step_derivative(motion, x, 1.0), atol=1e-7)


def noise_of(motion: MotionModel, x: FloatArray, dt_s: float) -> FloatArray:
    _, _, S_q = motion.step(x, dt_s)
    return S_q @ S_q.T


class TestTwoHalfSteps:
    """Half a step twice is the whole step, where the model solves a differential equation."""

    @pytest.mark.parametrize("motion", MODELS)
    def test_mean(self, motion: MotionModel) -> None:
        """In the mean: at a rate that lasts for the turn, whose forgetting is taken once a step."""
        if isinstance(motion, OrnsteinUhlenbeck):
            motion = replace(motion, correlation_s=1e6)
        x = state_of(motion, 5)
        whole, _, _ = motion.step(x, 2.0)
        halves, _, _ = motion.step(motion.step(x, 1.0)[0], 1.0)
        np.testing.assert_allclose(halves, whole, rtol=1e-9, atol=1e-5)

    def test_covariance_of_a_wandering_position(self) -> None:
        """Position and speed are linear: Q(2h) = F Q(h) F⊤ + Q(h)."""
        motion = OrnsteinUhlenbeck(0.1, 0.02, correlation_s=3.0)
        x = state_of(motion, 5)
        _, F, S_q = motion.step(x, 1.0)
        part = np.ix_([0, 1, 2, 6, 7, 8], [0, 1, 2, 6, 7, 8])
        F, half = F[part], (S_q @ S_q.T)[part]
        np.testing.assert_allclose(F @ half @ F.T + half, noise_of(motion, x, 2.0)[part], rtol=1e-9, atol=1e-18)

    def test_a_random_walk_by_the_step_grows_with_the_rows(self) -> None:
        """S_q = V Δt is not the square root of a rate of diffusion: two half steps have half of the variance."""
        motion = RandomWalk(0.1, 0.02)
        x = state_of(motion, 5)
        np.testing.assert_allclose(2.0 * noise_of(motion, x, 1.0), 0.5 * noise_of(motion, x, 2.0), rtol=1e-14)


class TestUnknownMotion:
    """The paper's S_q: what the object may move and turn by in one row."""

    def test_square_root(self) -> None:
        motion = RandomWalk(0.1, math.radians(1.2))
        x = np.array([4.0, 1.0, -2.0, 60.0, -50.0, 60.0])
        moved, F, S_q = motion.step(x, 0.5)
        strength = math.sqrt(60.0**2 + 50.0**2 + 60.0**2)
        expected = [0.05] * 3 + [strength * math.radians(1.2) * 0.5] * 3
        np.testing.assert_allclose(S_q, np.diag(expected), rtol=1e-14)
        np.testing.assert_array_equal(F, np.eye(6))
        np.testing.assert_array_equal(moved, x)

    def test_parts_of_the_linear_step(self) -> None:
        motion = RandomWalk(0.3, 0.1)
        assert isinstance(motion, LinearMotion)
        x = state_of(motion, 2)
        F, A, B = motion.linear_step(0.25)
        _, F_of_step, S_q = motion.step(x, 0.25)
        np.testing.assert_array_equal(F, F_of_step)
        np.testing.assert_allclose(A + np.linalg.norm(x[3:]) * B, S_q, rtol=1e-14)

    def test_start_is_a_copy(self) -> None:
        source, S = np.arange(6.0), np.eye(6)
        x, root = RandomWalk(0.1, 0.1).start(source, S)
        x[0], root[0, 0] = 9.0, 9.0
        assert source[0] == 0.0
        assert S[0, 0] == 1.0


class TestWanderingMotion:
    def test_noise_is_van_loans(self) -> None:
        """Position and speed along an axis, discretised by filterpy from the continuous model."""
        V, tau, dt_s = 0.4, 7.0, 0.5
        F, Q = van_loan_discretization(
            np.array([[0.0, 1.0], [0.0, -1.0 / tau]]), np.array([[0.0], [V * math.sqrt(2.0 / tau)]]), dt_s
        )
        motion = OrnsteinUhlenbeck(V, 0.1, correlation_s=tau)
        x = state_of(motion, 1)
        _, F_model, S_q = motion.step(x, dt_s)
        Q_model = S_q @ S_q.T
        for axis in range(3):
            part = np.ix_([axis, 6 + axis], [axis, 6 + axis])
            np.testing.assert_allclose(F_model[part], F, rtol=1e-12, atol=1e-15)
            np.testing.assert_allclose(Q_model[part], Q, rtol=1e-9)

    @pytest.mark.parametrize("dt_s", [0.01, 0.5, 30.0])
    def test_speed_and_rate_keep_their_variance(self, dt_s: float) -> None:
        motion = OrnsteinUhlenbeck(0.4, 0.1, correlation_s=7.0)
        x = state_of(motion, 1)
        _, F, S_q = motion.step(x, dt_s)
        P = np.diag(np.repeat([0.16, 0.01], 3))
        np.testing.assert_allclose(F[6:, 6:] @ P @ F[6:, 6:].T + (S_q @ S_q.T)[6:, 6:], P, rtol=1e-9, atol=1e-14)

    def test_starts_with_these_variances(self) -> None:
        source, S = np.arange(6.0), np.tril(np.ones((6, 6)))
        x, root = OrnsteinUhlenbeck(0.4, 0.1).start(source, S)
        np.testing.assert_array_equal(x, [*source, *np.zeros(6)])
        P = root @ root.T
        np.testing.assert_array_equal(P[:6, :6], S @ S.T)
        np.testing.assert_allclose(np.diagonal(P)[6:], np.repeat([0.16, 0.01], 3), rtol=1e-14)
        np.testing.assert_array_equal(P[6:, :6], 0.0)

    def test_solves_the_differential_equation(self) -> None:
        """Speed and rate that fade: the moment turns about a fixed axis by the integral of the rate."""
        motion = OrnsteinUhlenbeck(0.5, 0.3, correlation_s=4.0)
        x = state_of(motion, 11)

        def slope(_: float, y: FloatArray) -> FloatArray:
            return np.concatenate([y[6:9], np.cross(y[9:], y[3:6]), -y[6:] / 4.0])

        solution = solve_ivp(slope, (0.0, 2.0), x, method="DOP853", rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(motion.step(x, 2.0)[0], solution.y[:, -1], rtol=1e-9, atol=1e-9)

    @pytest.mark.parametrize("turn_rad_s", [0.0, 1e-310, 1e-200])
    def test_without_a_turn_nothing_is_forgotten(self, turn_rad_s: float) -> None:
        """And nothing added, however long the correlation time is in double precision."""
        x = np.arange(12.0)
        moved, F, S = OrnsteinUhlenbeck(2.0, turn_rad_s).step(x, 0.5)
        np.testing.assert_allclose(moved[:3], x[:3] + 0.5 * x[6:9], rtol=1e-14)
        np.testing.assert_allclose(moved[6:], x[6:], rtol=1e-14)
        assert np.isfinite(F).all()
        of_rates = np.delete(np.arange(12), [3, 4, 5])
        np.testing.assert_allclose(S[of_rates], 0.0, rtol=0, atol=1e-90)

    def test_noise_of_the_moment_is_across_it(self) -> None:
        """Along the moment only what changes its strength is left; across it the turn comes in as well."""
        motion = OrnsteinUhlenbeck(0.1, 0.2, correlation_s=5.0)
        x = np.zeros(12)
        x[3:6] = [0.0, 0.0, 100.0]
        Q = noise_of(motion, x, 0.5)
        along = (motion.moment_change * 100.0) ** 2 * 0.5
        assert Q[5, 5] == pytest.approx(along, rel=1e-12)
        Q_angle = noise_of(motion, x, 0.5)[0, 0] / 0.1**2 * 0.2**2  # of ∫ω, as the position's is of ∫v
        assert Q[3, 3] == pytest.approx(along + 100.0**2 * Q_angle, rel=1e-9)

    def test_nothing_happens_in_no_time(self) -> None:
        motion = OrnsteinUhlenbeck(0.1, 0.2)
        x = state_of(motion, 1)
        moved, F, S_q = motion.step(x, 0.0)
        np.testing.assert_array_equal(moved, x)
        np.testing.assert_array_equal(F, np.eye(12))
        np.testing.assert_array_equal(S_q, 0.0)

    @pytest.mark.parametrize("tau", [0.5, 7.0])
    @pytest.mark.parametrize("dt_s", [0.05, 0.4999, 0.5001, 6.999, 7.001, 60.0, 3600.0, 1e5])
    def test_position_spreads_as_ornstein_and_uhlenbeck_say(self, tau: float, dt_s: float) -> None:
        """Variance 2 V² τ (Δt - τ (1 - exp(-Δt/τ))) of the position of a source whose speed is stationary."""
        motion = OrnsteinUhlenbeck(0.4, 0.1, correlation_s=tau)
        _, F, S_q = motion.step(state_of(motion, 1), dt_s)
        P = F[[0, 6]][:, [0, 6]] @ np.diag([0.0, 0.16]) @ F[[0, 6]][:, [0, 6]].T + (S_q @ S_q.T)[[0, 6]][:, [0, 6]]
        assert P[0, 0] == pytest.approx(2.0 * 0.16 * tau * (dt_s + tau * math.expm1(-dt_s / tau)), rel=1e-9)
        assert P[0, 1] == pytest.approx(-0.16 * tau * math.expm1(-dt_s / tau), rel=1e-9)
        assert P[1, 1] == pytest.approx(0.16, rel=1e-9)

    @pytest.mark.parametrize("dt_s", [1e-6, 1e-3, 1e4])
    def test_noise_is_regular_at_any_step(self, dt_s: float) -> None:
        motion = OrnsteinUhlenbeck(0.1, 0.02)
        _, _, S_q = motion.step(state_of(motion, 1), dt_s)
        Q = S_q @ S_q.T
        assert np.isfinite(Q).all()
        assert (np.diagonal(Q) > 0.0).all()


class TestConstantTurn:
    @pytest.mark.parametrize("rate", [0.0, 1e-6, 0.05, -0.7, 3.0])
    def test_solves_the_differential_equation(self, rate: float) -> None:
        motion = CoordinatedTurn(0.5, 0.1)
        x = np.array([1.0, 2.0, 3.0, 60.0, -50.0, 40.0, 0.5, -0.3, 0.2, rate])
        up = np.array([0.0, 0.0, 1.0])

        def slope(_: float, y: FloatArray) -> FloatArray:
            return np.concatenate([y[6:9], np.cross(y[9] * up, y[3:6]), np.cross(y[9] * up, y[6:9]), [0.0]])

        solution = solve_ivp(slope, (0.0, 2.0), x, method="DOP853", rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(motion.step(x, 2.0)[0], solution.y[:, -1], rtol=1e-9, atol=1e-9)

    @pytest.mark.parametrize("sign", [-1.0, 1.0])
    def test_series_and_quotient_meet(self, sign: float) -> None:
        """On both sides of the angle where one replaces the other the step and F are the same, but for the angle."""
        motion = CoordinatedTurn(0.5, 0.1)
        x = np.array([1.0, 2.0, 3.0, 60.0, -50.0, 40.0, 0.5, -0.3, 0.2, 0.0])
        low, high = x.copy(), x.copy()
        low[9], high[9] = sign * 0.99999999e-4, sign * 1.00000001e-4
        for part_low, part_high in zip(motion.step(low, 1.0), motion.step(high, 1.0), strict=True):
            np.testing.assert_allclose(part_high, part_low, atol=1e-7)

    def test_starts_with_the_given_deviations(self) -> None:
        x, root = CoordinatedTurn(0.5, 0.1).start(np.arange(6.0), np.eye(6))
        np.testing.assert_array_equal(x, [*np.arange(6.0), 0.0, 0.0, 0.0, 0.0])
        np.testing.assert_array_equal(root, np.diag([1.0] * 6 + [0.5] * 3 + [0.1]))

    def test_noise(self) -> None:
        """Over one step: an acceleration that is constant in it, and walks of the rate and the moment."""
        motion = CoordinatedTurn(0.5, 0.1, acceleration_m_s2=0.02, turn_change_rad_s=0.003, moment_change=0.004)
        x = np.array([1.0, 2.0, 3.0, 0.0, 30.0, 40.0, 0.5, -0.3, 0.2, 0.1])
        dt_s = 0.25
        Q = noise_of(motion, x, dt_s)
        assert Q[6, 6] == pytest.approx(0.02**2 * dt_s)
        assert Q[0, 6] == pytest.approx(0.5 * dt_s * 0.02**2 * dt_s)
        assert Q[0, 0] == pytest.approx((0.5 * dt_s) ** 2 * 0.02**2 * dt_s)
        assert Q[9, 9] == pytest.approx(0.003**2 * dt_s)
        assert Q[3, 3] == pytest.approx((0.004 * 50.0) ** 2 * dt_s)
        assert Q[3, 4] == 0.0


class TestKnownMotion:
    """Equation (17) with measured velocities and rates, MotionMT."""

    MOTION = KnownMotion(
        0.1,
        0.02,
        object_velocity_m_s=(0.3, -0.2, 0.1),
        object_rate_rad_s=(0.0, 0.05, -0.1),
        array_velocity_m_s=(1.0, 0.4, -0.2),
        array_rate_rad_s=(0.1, -0.2, 0.3),
        velocity_sigma_m_s=0.05,
        object_rate_sigma_rad_s=0.03,
        array_rate_sigma_rad_s=0.01,
    )
    X = np.array([5.0, -3.0, 2.0, 120.0, -60.0, 80.0])

    def test_solves_the_equation(self) -> None:
        def rate(_: float, x: FloatArray) -> FloatArray:
            p, m = x[:3], x[3:]
            dp = np.subtract(self.MOTION.object_velocity_m_s, self.MOTION.array_velocity_m_s)
            relative = np.subtract(self.MOTION.object_rate_rad_s, self.MOTION.array_rate_rad_s)
            return np.concatenate([dp - np.cross(self.MOTION.array_rate_rad_s, p), np.cross(relative, m)])

        expected = solve_ivp(rate, (0.0, 0.7), self.X, rtol=1e-10, atol=1e-10).y[:, -1]
        moved, F, _ = self.MOTION.step(self.X, 0.7)
        np.testing.assert_allclose(moved, expected, rtol=1e-7)
        np.testing.assert_allclose(F, step_derivative(self.MOTION, self.X, 0.7), atol=1e-6)

    def test_noise_is_the_scatter_of_wrong_measurements(self) -> None:
        """3,000 steps with measured velocities and rates that are wrong by their σ: entries to 0.1, some 5 σ."""
        rng = np.random.default_rng(8)
        n, dt_s = 3_000, 0.2
        exact = replace(self.MOTION, speed_m_s=0.0, turn_rad_s=0.0)
        steps = []
        for _ in range(n):
            wrong = replace(
                exact,
                object_velocity_m_s=tuple(exact.object_velocity_m_s + 0.05 * rng.normal(size=3)),
                object_rate_rad_s=tuple(exact.object_rate_rad_s + 0.03 * rng.normal(size=3)),
                array_rate_rad_s=tuple(exact.array_rate_rad_s + 0.01 * rng.normal(size=3)),
            )
            steps.append(wrong.step(self.X, dt_s)[0])
        _, _, S_q = exact.step(self.X, dt_s)
        Q, scatter = S_q @ S_q.T, np.cov(np.array(steps).T)
        sigma = np.sqrt(np.diagonal(Q))
        np.testing.assert_allclose(scatter / np.outer(sigma, sigma), Q / np.outer(sigma, sigma), atol=0.1)

    def test_of_a_random_walk_nothing_is_measured(self) -> None:
        walk, known = RandomWalk(0.1, 0.02), KnownMotion(0.1, 0.02)
        for one, other in zip(walk.step(self.X, 0.5), known.step(self.X, 0.5), strict=True):
            np.testing.assert_allclose(one @ one.T if one.ndim > 1 else one, other @ other.T if one.ndim > 1 else other)

    def test_of_steps(self) -> None:
        """The mean of both ends; the first row has no end before it."""
        velocity = np.arange(18.0).reshape(3, 2, 3)
        sigma = np.array([[0.1, 0.2], [0.3, 0.2], [0.1, 0.2]])
        motions = known_motions(MeasuredMotion(velocity, velocity / 10.0, sigma, sigma), RandomWalk(0.1, 0.02))
        assert motions[0].array_velocity_m_s == [0.0, 1.0, 2.0]
        assert motions[1].object_velocity_m_s == [6.0, 7.0, 8.0]
        assert motions[2].array_rate_rad_s == pytest.approx([0.9, 1.0, 1.1])
        assert motions[2].object_rate_sigma_rad_s == pytest.approx(0.2)
        assert motions[1].array_rate_sigma_rad_s == pytest.approx(np.sqrt(0.05))
