"""Tests of adcs.satellite.dynamics: one class per law.

The oracles: conservation of energy and angular momentum, closed forms of a symmetric top, a pendulum in the gravity
gradient and a compass needle, scipy's solver of differential equations, and central differences of the full equations.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from adcs import quaternion
from adcs.satellite import dynamics
from adcs.satellite.dynamics import RigidBody, WheelControl, wheel_control
from magloc.navigation.rotations import cross_matrix
from tests.adcs.attitudes import commanded_torque, random_attitudes
from tests.adcs.kalman.readable import closed_loop_error_jacobian

Array = NDArray[np.float64]
J = np.array([[0.519, 0.002, 0.005], [0.002, 0.579, 0.009], [0.005, 0.009, 0.71]])
BODY = RigidBody(J)
MAGNETIC = RigidBody(J, np.array([0.3, -0.2, 0.5]))
CONTROL = wheel_control(BODY)
RATE = 1.083e-3
GRAVITY = RATE**2
B = np.array([20e-6, -10e-6, 30e-6])
ZERO = np.zeros(3)


def random_state(rng: np.random.Generator, n: int = 20) -> tuple[Array, Array, Array]:
    return random_attitudes(n, rng), 0.02 * rng.standard_normal((n, 3)), 0.01 * rng.standard_normal((n, 3))


def follow(
    body: RigidBody,
    q: Array,
    w: Array,
    *,
    seconds: float,
    dt: float = 1.0,
    momentum: Array = ZERO,
    rate: float = 0.0,
    gravity: float = 0.0,
    field: Array = ZERO,
) -> list[tuple[Array, Array, Array]]:
    """States every dt with resting wheels."""
    states = [(q, w, momentum)]
    for _ in range(round(seconds / dt)):
        states.append(dynamics.step(body, *states[-1], ZERO, ZERO, rate, gravity, field, dt))
    return states


class TestBody:
    def test_not_positive_definite(self) -> None:
        with pytest.raises(ValueError, match=r"Input inertia_kgm2 must be positive definite; .* -0\.1, 0\.5, 0\.5"):
            RigidBody(np.diag([0.5, -0.1, 0.5]))

    def test_triangle_inequality(self) -> None:
        with pytest.raises(
            ValueError, match=r"triangle inequality, .* instead received principal moments 0\.2, 0\.2, 0\.5"
        ):
            RigidBody(np.diag([0.2, 0.2, 0.5]))
        RigidBody(np.diag([0.2, 0.2, 0.4]))  # a flat plate

    @pytest.mark.parametrize("inertia", [np.eye(2), np.full((3, 3), np.nan), np.eye(3) + np.eye(3, k=1)])
    def test_no_inertia(self, inertia: Array) -> None:
        with pytest.raises(ValueError, match=r"Input inertia_kgm2 must be .*; instead received"):
            RigidBody(inertia)

    def test_principal_moments_alone(self) -> None:
        with pytest.raises(ValueError, match=r"numpy\.diag\(moments\) .*received shape \(3,\)"):
            RigidBody(np.ones(3))

    def test_no_dipole(self) -> None:
        with pytest.raises(ValueError, match=r"Input residual_dipole_Am2 must be 3 finite numbers"):
            RigidBody(J, np.array([1.0, 2.0]))

    @given(st.integers(0, 2**32 - 1))
    def test_every_cloud_of_masses_is_a_body(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        places, masses = rng.standard_normal((6, 3)), rng.uniform(0.1, 1.0, 6)
        inertia = sum(m * (p @ p * np.eye(3) - np.outer(p, p)) for m, p in zip(masses, places, strict=True))
        RigidBody(np.asarray(inertia))


class TestConservation:
    def test_jacobi_integral_on_a_circular_orbit(self) -> None:
        # Energy against the orbital frame with the potentials of gravity gradient and of its turning:
        # ½ ω_rel·Jω_rel + 3/2 n² η·Jη - 1/2 n² e2·Je2.
        q = quaternion.exp(np.array([0.3, -0.2, 0.4]))
        w = dynamics.absolute_rate(q, np.array([2e-4, -3e-4, 1e-4]), RATE)
        values = []
        for q_at, w_at, _ in follow(BODY, q, w, seconds=6000.0, dt=10.0, rate=RATE, gravity=GRAVITY):
            relative = dynamics.relative_rate(q_at, w_at, RATE)
            eta, normal = quaternion.rotate_back(q_at, [0, 0, 1]), quaternion.rotate_back(q_at, [0, 1, 0])
            values.append(
                0.5 * relative @ J @ relative + 1.5 * GRAVITY * eta @ J @ eta - 0.5 * GRAVITY * normal @ J @ normal
            )
        # The parts change by some 1e-7 J.
        np.testing.assert_allclose(values, values[0], rtol=0, atol=1e-14)


class TestClosedForms:
    def test_needle_swings_in_the_field(self) -> None:
        # m × B turns the moment towards the field, with the frequency √(m B/J) for small angles.
        needle = RigidBody(np.eye(3), np.array([2.0, 0.0, 0.0]))
        field = np.array([50e-6, 0.0, 0.0])
        frequency = np.sqrt(2.0 * 50e-6)
        states = follow(needle, quaternion.exp(np.array([0.0, 0.0, 1e-3])), ZERO, seconds=600.0, field=field)
        yaw = [quaternion.log(q)[2] for q, _, _ in states]
        np.testing.assert_allclose(yaw, 1e-3 * np.cos(frequency * np.arange(601.0)), rtol=0, atol=1e-8)

    def test_rest_in_the_orbital_frame_is_a_turn_in_space(self) -> None:
        w = dynamics.absolute_rate(quaternion.IDENTITY, ZERO, RATE)
        np.testing.assert_array_equal(w, [0.0, RATE, 0.0])
        np.testing.assert_allclose(dynamics.relative_rate(quaternion.IDENTITY, w, RATE), ZERO, atol=1e-20)


class TestIntegration:
    def right_side(self, _: float, y: Array, wheel_torque: Array, torque: Array) -> Array:
        """The equations as spec and paper print them, with matrices, by another route than the code."""
        q, w, k = y[:4], y[4:7], y[7:]
        A = quaternion.to_rotation(q / np.linalg.norm(q)).as_matrix().T
        eta, m = A[:, 2], MAGNETIC.residual_dipole_Am2
        outside = 3 * GRAVITY * np.cross(eta, J @ eta) + np.cross(m, A @ B) + torque
        w_dot = np.linalg.solve(J, -wheel_torque + outside - np.cross(w, J @ w + k))
        rel = w - A @ [0.0, RATE, 0.0]
        Omega = np.block([[np.zeros((1, 1)), -rel[None]], [rel[:, None], -cross_matrix(rel)]])
        return np.concatenate([0.5 * Omega @ q, w_dot, wheel_torque])

    def test_against_scipy(self) -> None:
        rng = np.random.default_rng(3)
        q, w, k = (one[0] for one in random_state(rng, 1))
        wheel_torque, torque = 1e-4 * rng.standard_normal((2, 3))
        state = (q, w, k)
        for _ in range(1000):
            state = dynamics.step(MAGNETIC, *state, wheel_torque, torque, RATE, GRAVITY, B, 0.1)
        solved = solve_ivp(
            self.right_side,
            (0.0, 100.0),
            np.concatenate([q, w, k]),
            args=(wheel_torque, torque),
            method="DOP853",
            rtol=1e-12,
            atol=1e-14,
        ).y[:, -1]
        assert quaternion.angle_between(state[0], quaternion.normalised(solved[:4])) < 1e-10
        np.testing.assert_allclose(state[1], solved[4:7], rtol=0, atol=1e-11)
        np.testing.assert_allclose(state[2], solved[7:], rtol=0, atol=1e-12)

    def test_fourth_order(self) -> None:
        q, w = quaternion.IDENTITY, np.array([0.2, -0.1, 0.15])
        ends = [follow(BODY, q, w, seconds=16.0, dt=dt)[-1][1] for dt in (1.0, 0.5, 0.05)]
        ratio = np.linalg.norm(ends[0] - ends[2]) / np.linalg.norm(ends[1] - ends[2])
        assert 13.0 < ratio < 19.0

    def test_batches(self) -> None:
        state = random_state(np.random.default_rng(5), 6)
        together = dynamics.step(BODY, *(one.reshape(2, 3, -1) for one in state), ZERO, ZERO, RATE, GRAVITY, B, 1.0)
        for i in range(6):
            alone = dynamics.step(BODY, *(one[i] for one in state), ZERO, ZERO, RATE, GRAVITY, B, 1.0)
            for batch, single in zip(together, alone, strict=True):
                np.testing.assert_allclose(batch.reshape(6, -1)[i], single, rtol=0, atol=1e-16)


class TestControl:
    def test_gains(self) -> None:
        np.testing.assert_allclose(CONTROL.attitude_gain_Nm, 2 * 0.03**2 * np.diag(J))
        np.testing.assert_allclose(CONTROL.rate_gain_Nms, 2 * 0.8 * 0.03 * np.diag(J))

    def test_small_errors_decay_as_the_oscillator(self) -> None:
        # J θ'' + K_ω θ' + K_λ θ/2 = 0, about a principal axis, without orbit.
        body = RigidBody(np.diag([0.5, 0.6, 0.7]))
        control = wheel_control(body)
        state = (quaternion.exp(np.array([0.01, 0.0, 0.0])), ZERO, ZERO)
        angles = []
        for _ in range(1000):
            torque = commanded_torque(body, control, *state, quaternion.IDENTITY, 0.0, 0.1)
            state = dynamics.step(body, *state, torque, ZERO, 0.0, 0.0, ZERO, 0.1)
            angles.append(quaternion.log(state[0])[0])
        time_s = 0.1 * np.arange(1, 1001)
        damped = 0.03 * np.sqrt(1 - 0.8**2)
        expected = np.exp(-0.024 * time_s) * (np.cos(damped * time_s) + 0.024 / damped * np.sin(damped * time_s))
        # Holding the torque for 0.1 s delays it by half of that: 0.024 · 0.05 of the angle.
        np.testing.assert_allclose(angles, 0.01 * expected, rtol=0, atol=2e-5)

    def test_holds_the_orbital_frame_from_any_attitude(self) -> None:
        state = random_state(np.random.default_rng(9), 30)
        for _ in range(600):
            torque = commanded_torque(BODY, CONTROL, *state, quaternion.IDENTITY, RATE, 1.0)
            state = dynamics.step(BODY, *state, torque, ZERO, RATE, GRAVITY, ZERO, 1.0)
        assert np.degrees(quaternion.angle_between(state[0], quaternion.IDENTITY)).max() < 0.3

    def test_limits(self) -> None:
        tight = replace(CONTROL, torque_limit_Nm=1e-4, momentum_limit_Nms=2e-3)
        state = random_state(np.random.default_rng(11), 10)
        state = (state[0], state[1], np.zeros((10, 3)))
        saturated = 0
        for _ in range(200):
            torque = commanded_torque(BODY, tight, *state, quaternion.IDENTITY, RATE, 1.0)
            state = dynamics.step(BODY, *state, torque, ZERO, RATE, GRAVITY, ZERO, 1.0)
            assert np.abs(torque).max() <= 1e-4 * (1 + 1e-9)
            assert np.abs(state[2]).max() <= 2e-3 * (1 + 1e-9)
            saturated += int(np.sum(np.abs(state[2]) > 1.999e-3))
        assert saturated > 0

    @pytest.mark.parametrize(
        "bad", [{"torque_limit_Nm": 0.0}, {"momentum_limit_Nms": -1.0}, {"rate_gain_Nms": -np.ones(3)}]
    )
    def test_bad_control(self, bad: dict[str, float]) -> None:
        with pytest.raises(ValueError, match=rf"Input {next(iter(bad))} must be .*; instead received"):
            WheelControl(**{"attitude_gain_Nm": np.ones(3), "rate_gain_Nms": np.ones(3), **bad})  # type: ignore[arg-type]


def error_rate(body: RigidBody, state: tuple[Array, Array, Array], u: Array, dx: Array) -> Array:
    """Rate of (δq, δω) between an estimate and the truth dx away from it, by the full equations of both."""
    q, w, k = state
    q_true = quaternion.multiply(q, quaternion.from_error_vector(dx[..., :3]))
    w_true = w + dx[..., 3:]
    rates = []
    for q_at, w_at in ((q, w), (q_true, w_true)):
        torque = dynamics.environment_torque(body, q_at, GRAVITY, B)
        rates.append(
            (
                quaternion.derivative(q_at, dynamics.relative_rate(q_at, w_at, RATE)),
                dynamics.angular_acceleration(body, w_at, k, u, torque),
            )
        )
    (q_dot, w_dot), (q_true_dot, w_true_dot) = rates
    delta_dot = quaternion.multiply(quaternion.conjugate(q_dot), q_true) + quaternion.multiply(
        quaternion.conjugate(q), q_true_dot
    )
    return np.concatenate([delta_dot[..., 1:], w_true_dot - w_dot], axis=-1)


class TestErrorJacobian:
    STEP = 1e-4
    STATE = random_state(np.random.default_rng(13))

    def differences(self, rate_of: object) -> Array:
        columns = []
        for i in range(6):
            dx = np.zeros(6)
            dx[i] = self.STEP
            columns.append((rate_of(dx) - rate_of(-dx)) / (2 * self.STEP))  # type: ignore[operator]
        return np.stack(columns, axis=-1)

    @pytest.mark.parametrize("body", [BODY, MAGNETIC], ids=["gravity", "residual dipole"])
    def test_known_torque(self, body: RigidBody) -> None:
        F = dynamics.error_jacobian(body, *self.STATE, GRAVITY, B)
        measured = self.differences(lambda dx: error_rate(body, self.STATE, ZERO, dx))
        np.testing.assert_allclose(F[:, 3:, :3], measured[:, 3:, :3], rtol=0, atol=1e-9)
        np.testing.assert_allclose(F, measured, rtol=0, atol=1e-8)

    def test_closed_loop_lacks_one_term(self) -> None:
        q, w, k = self.STATE
        control = replace(CONTROL, torque_limit_Nm=1e9, momentum_limit_Nms=1e9)

        def rate_of(dx: Array) -> Array:
            q_true = quaternion.multiply(q, quaternion.from_error_vector(dx[:3]))
            u = commanded_torque(BODY, control, q, w, k, quaternion.IDENTITY, RATE, 1.0)
            u_true = commanded_torque(BODY, control, q_true, w + dx[3:], k, quaternion.IDENTITY, RATE, 1.0)
            fed_back = np.concatenate([np.zeros((len(q), 3)), -(u_true - u) @ BODY.inverse], axis=-1)
            return error_rate(BODY, self.STATE, ZERO, dx) + fed_back

        printed = closed_loop_error_jacobian(BODY, control, q, w, GRAVITY)
        orbital = quaternion.rotate_back(q, [0.0, RATE, 0.0])
        missing = 2 * BODY.inverse @ np.diag(control.rate_gain_Nms) @ cross_matrix(orbital)
        measured = self.differences(rate_of)
        assert np.abs(measured - printed)[:, 3:, :3].max() > 1e-5
        printed[:, 3:, :3] += missing
        np.testing.assert_allclose(printed, measured, rtol=0, atol=1e-8)

    def test_batches(self) -> None:
        shaped = [one.reshape(4, 5, -1) for one in self.STATE]
        F = dynamics.error_jacobian(BODY, *shaped, np.full((4, 5), GRAVITY), B)
        assert F.shape == (4, 5, 6, 6)
        np.testing.assert_allclose(F[2, 3], dynamics.error_jacobian(BODY, *(one[2, 3] for one in shaped), GRAVITY, B))


class TestDipole:
    def test_a_dipole_besides_the_residual_one(self) -> None:
        """Of torque, step and Jacobian: the same as a body with the sum of both."""
        rng = np.random.default_rng(18)
        q, w, k = random_state(rng)
        extra = np.array([0.01, -0.02, 0.03])
        both = dynamics.RigidBody(MAGNETIC.inertia_kgm2, MAGNETIC.residual_dipole_Am2 + extra)
        around = GRAVITY, B
        for one, other in (
            (dynamics.environment_torque(MAGNETIC, q, *around, extra), dynamics.environment_torque(both, q, *around)),
            (
                dynamics.error_jacobian(MAGNETIC, q, w, k, *around, extra),
                dynamics.error_jacobian(both, q, w, k, *around),
            ),
            (
                dynamics.step(MAGNETIC, q, w, k, ZERO, ZERO, RATE, *around, 1.0, extra)[1],
                dynamics.step(both, q, w, k, ZERO, ZERO, RATE, *around, 1.0)[1],
            ),
        ):
            np.testing.assert_allclose(one, other, rtol=1e-13, atol=1e-16)
