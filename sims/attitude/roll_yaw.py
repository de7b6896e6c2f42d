"""Truth of the roll/yaw satellite: the error dynamics alone, and the attitude loop.

:mod:`adcs.ellipsoids.roll_yaw` has the system and its observers. Every run has its own
stream of random numbers: run s does not depend on the other runs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from adcs.ellipsoids.roll_yaw import ORBITAL_RATE, STEP_S, input_matrix, transition
from arrays.typing import FloatArray
from magloc import core
from sims.noise import stream

Controller = Callable[[FloatArray, FloatArray, FloatArray], FloatArray]
ACTUAL_INERTIA_KGM2 = np.array([[90.0, 0.2, 0.2], [0.2, 60.0, 0.1], [0.2, 0.1, 90.0]])
JUMP = 4.0
_RUNS_A_BLOCK = 1000  # a millisecond
_SUBSTEPS = 10  # Runge-Kutta steps of 0.2 s: a fifth of the disturbance torque's period


@dataclass(frozen=True, eq=False)
class ErrorRuns:
    """Runs of the dynamics of the error alone."""

    states_rad: FloatArray  # (n_runs, n_steps + 1, 2): (roll, yaw)
    readings_rad: FloatArray  # (n_runs, n_steps): roll readings after every step


@dataclass(frozen=True)
class ErrorScenario:
    """Settings of :func:`error_runs`."""

    noise_rad: float  # readings are wrong by uniform random numbers within ±noise_rad
    drift_rad_s: float  # zero shift of the yaw gyro, constant
    n_steps: int
    jump_s: float | None = None  # from this time on the readings are wrong by four times as much


def error_runs(scenario: ErrorScenario, seeds: Sequence[int]) -> ErrorRuns:
    """Simulate errors of roll and yaw, uniform at the start in a circle of radius 3 c."""
    n_runs, n_steps = len(seeds), scenario.n_steps
    amplitude = _amplitude(scenario)
    states, noise = np.empty((n_runs, n_steps + 1, 2)), np.empty((n_runs, n_steps))
    for run, seed in enumerate(seeds):
        start = stream(seed, "start")
        radius, angle = 3.0 * scenario.noise_rad * math.sqrt(start.random()), 2.0 * math.pi * start.random()
        states[run, 0] = radius * math.cos(angle), radius * math.sin(angle)
        noise[run] = stream(seed, "horizon").uniform(-1.0, 1.0, n_steps)
    A, drift = transition(), input_matrix()[:, 1] * scenario.drift_rad_s * STEP_S
    for step in range(n_steps):
        # A product of matrices would round a run by how many are beside it.
        states[:, step + 1] = np.einsum("ij,rj->ri", A, states[:, step]) + drift
    return ErrorRuns(states, states[:, 1:, 0] + amplitude * noise)


@dataclass(frozen=True, eq=False)
class LoopScenario:
    """Settings of :func:`fly`.

    ``drift_rad_s``: zero shift of the pitch and yaw gyros, constant. The roll gyro has none: the observer's disturbance
    is a segment along yaw. ``torque_phases`` (3,): φ [rad].
    """

    noise_rad: float  # horizon readings are wrong by uniform random numbers within ±noise_rad
    drift_rad_s: float
    n_steps: int  # cycles of 2 s
    first_yaw_rad: float
    jump_s: float | None = None  # from this time on the readings are wrong by four times as much
    torque_Nm: float = 1e-4  # amplitude of the disturbance torque b sin(ω t + φ) about every axis
    torque_rate: float = 6.0  # ω [rad/s]
    torque_phases: FloatArray = field(default_factory=lambda: np.array([0.0, math.pi / 4.0, math.pi / 2.0]))
    inertia_kgm2: FloatArray = field(default_factory=ACTUAL_INERTIA_KGM2.copy)  # (3, 3)


@dataclass(frozen=True, eq=False)
class LoopRuns:
    """Flights in the attitude loop."""

    angles_rad: FloatArray  # (n_runs, n_steps + 1, 3): roll, pitch and yaw of the body in the orbital frame
    rates_rad_s: FloatArray  # (n_runs, n_steps + 1, 3): angular rate of the body in the inertial frame, body axes
    increments_rad: FloatArray  # (n_runs, n_steps, 3): of the gyros in every cycle
    roll_readings_rad: FloatArray  # (n_runs, n_steps)


def fly(scenario: LoopScenario, controller: Controller, seeds: Sequence[int]) -> LoopRuns:
    """Fly satellites with a controller.

    Every cycle of 2 s the horizon sensor is read once, the gyros give their increments and rates, and the controller's
    torque is held during the next cycle; there is none in the first.
    ``controller``: takes horizon readings (n_runs, 2), gyro increments (n_runs, 3) and gyro rates (n_runs, 3), and
    returns torques (n_runs, 3). ``seeds``: one for each run.
    """
    n_runs, n_steps = len(seeds), scenario.n_steps
    noise = np.empty((n_runs, n_steps, 2))
    for run, seed in enumerate(seeds):
        noise[run] = _amplitude(scenario)[:, None] * stream(seed, "horizon").uniform(-1.0, 1.0, (n_steps, 2))
    shift = scenario.drift_rad_s * np.array([0.0, 1.0, 1.0])
    angles, rates = np.zeros((n_runs, n_steps + 1, 3)), np.zeros((n_runs, n_steps + 1, 3))
    angles[:, 0, 2] = scenario.first_yaw_rad
    # At rest in the orbital frame.
    rates[:, 0] = ORBITAL_RATE * np.array([-scenario.first_yaw_rad, -1.0, 0.0])
    torque, increments = np.zeros((n_runs, 3)), np.empty((n_runs, n_steps, 3))
    for step in range(n_steps):
        state = advance(scenario, angles[:, step], rates[:, step], torque, step * STEP_S)
        angles[:, step + 1], rates[:, step + 1] = state[:, :3], state[:, 3:6]
        horizon = state[:, :2] + noise[:, step]
        increments[:, step] = state[:, 6:] + shift * STEP_S
        torque = controller(horizon, increments[:, step], state[:, 3:6] + shift)
    return LoopRuns(angles, rates, increments, angles[:, 1:, 0] + noise[..., 0])


def _amplitude(scenario: ErrorScenario | LoopScenario) -> FloatArray:
    """Return the largest error of every reading [rad], shape (n_steps,)."""
    amplitude = np.full(scenario.n_steps, scenario.noise_rad)
    if scenario.jump_s is not None:
        amplitude[STEP_S * np.arange(1, scenario.n_steps + 1) >= scenario.jump_s] *= JUMP
    return amplitude


def advance(
    scenario: LoopScenario, angles_rad: FloatArray, rates_rad_s: FloatArray, torque_Nm: FloatArray, time_s: float
) -> FloatArray:
    r"""Advance satellites by one cycle of 2 s, in Runge-Kutta steps of 0.2 s.

    Euler's equations :math:`J\dot\omega = T - \omega \times J\omega`, and small angles against the orbital frame:
    :math:`\dot\gamma = \omega_x + \omega_0\psi`, :math:`\dot\theta = \omega_y + \omega_0`,
    :math:`\dot\psi = \omega_z - \omega_0\gamma`.
    ``angles_rad``, ``rates_rad_s``, ``torque_Nm`` (n_runs, 3): as in :class:`LoopRuns`; the control torque is
    held. ``time_s``: phase of the disturbance torque. Returns (n_runs, 9): angles [rad], rates [rad/s],
    and the integral of the rates over the cycle [rad].
    """
    state = np.concatenate([angles_rad, rates_rad_s, np.zeros_like(rates_rad_s)], axis=1)
    at = np.linspace(time_s, time_s + STEP_S, 2 * _SUBSTEPS + 1)
    work = core.problem(
        "small_motion",
        n_steps=_SUBSTEPS,
        dt=STEP_S / _SUBSTEPS,
        orbital_rate=ORBITAL_RATE,
        inertia=np.ascontiguousarray(scenario.inertia_kgm2),
        inverse_inertia=np.linalg.inv(scenario.inertia_kgm2),
        control=np.ascontiguousarray(torque_Nm),
        disturbance=scenario.torque_Nm * np.sin(scenario.torque_rate * at[:, None] + scenario.torque_phases),
        state=state,
    )
    core.run("small_motion_runs", work, len(state), block=_RUNS_A_BLOCK)
    return state
