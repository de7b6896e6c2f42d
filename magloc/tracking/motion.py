r"""Motion of sources and arrays: transition matrices and square roots of the noise.

A model has a state and its step over Δt. Position and moment come first in every state. With the array's pose known
the state is in the world frame, which does not turn. :func:`array_axes_transition` is model (17) of the source paper,
in the axes of an array whose motion is known.

=============  =============================================================
MotionMT       :class:`KnownMotion`, :class:`RandomWalk`
MotionMV       :mod:`magloc.signature.moment_filter`, the moment alone, (29)
O              the array's attitude: pose of the readings, or its rates
σ_R, σ_M       the rows of S_q: the noise that moves p and turns m
=============  =============================================================
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from arrays.typing import FloatArray, Vector
from magloc.navigation.measured_motion import MeasuredMotion
from magloc.navigation.rotations import cross_matrix, rotation_matrix, turn_of_change
from magloc.state_space import ornstein_uhlenbeck_step

N_SOURCE = 6
_AT_REST: Vector = (0.0, 0.0, 0.0)
_VERTICAL = np.array([0.0, 0.0, 1.0])


def array_axes_transition(
    dt_s: float,
    *,
    object_velocity_m_s: ArrayLike = (0.0, 0.0, 0.0),
    object_rate_rad_s: ArrayLike = (0.0, 0.0, 0.0),
    array_velocity_m_s: ArrayLike = (0.0, 0.0, 0.0),
    array_rate_rad_s: ArrayLike = (0.0, 0.0, 0.0),
) -> tuple[FloatArray, FloatArray]:
    r"""Return a step of position and moment in the axes of a moving array.

    .. math::

        \dot p = v_{object} - v_{array} - ω_{array} × p, \qquad \dot m = (ω_{object} - ω_{array}) × m

    with all vectors in the array's axes. The paper omits the term ω × p, and takes one Euler step; this is
    the exact solution for constant rates.

    Parameters
    ----------
    dt_s : float
        Length of the step [s].
    object_velocity_m_s, object_rate_rad_s, array_velocity_m_s, array_rate_rad_s : array_like, shape (3,)
        Velocities [m/s] and angular rates [rad/s].

    Returns
    -------
    F : ndarray, shape (6, 6)
        Transition matrix of (p, m).
    shift : ndarray, shape (6,)
        Added to the state: ``x_next = F x + shift``.
    """
    from scipy.linalg import expm

    object_rate, array_rate = np.asarray(object_rate_rad_s, float), np.asarray(array_rate_rad_s, float)
    velocity = np.asarray(object_velocity_m_s, float) - np.asarray(array_velocity_m_s, float)
    generator = np.zeros((4, 4))
    generator[:3, :3], generator[:3, 3] = -cross_matrix(array_rate), velocity
    step = expm(generator * dt_s)
    F = np.zeros((N_SOURCE, N_SOURCE))
    F[:3, :3] = step[:3, :3]
    F[3:, 3:] = expm(cross_matrix(object_rate - array_rate) * dt_s)
    return F, np.concatenate([step[:3, 3], np.zeros(3)])


class MotionModel(Protocol):
    """Motion of a source, as a tracker uses it."""

    @property
    def speed_m_s(self) -> float:
        """Characteristic speed along each axis."""

    @property
    def n_states(self) -> int:
        """Length of the state, of which the first six are position [m] and moment [A·m²]."""

    def start(self, source: FloatArray, S: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the state and the root of its covariance, given (p, m) (6,) and its root (6, 6)."""

    def step(self, x: FloatArray, dt_s: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the predicted state (n,), its Jacobian F (n, n), and a noise root S_q (n, m)."""

    def state_of(self, source: FloatArray, velocity_m_s: FloatArray, rate_rad_s: FloatArray) -> FloatArray:
        """Return the state (n,) of a source (6,) with a velocity and a rate of turn, (3,) each."""


@runtime_checkable
class LinearMotion(MotionModel, Protocol):
    """Linear motion with noise proportional to the moment's strength; it has compiled steps."""

    def linear_step(self, dt_s: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return F, and A and B (n, m) of the noise ``S_q = A + |m| B``."""


class _MovingState:
    """State of position and moment, then of velocity and turn rates, as many as the model has."""

    speed_m_s: float
    turn_rad_s: float
    n_states: int

    def start(self, source: FloatArray, S: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the state and the square root of its covariance, see :class:`MotionModel`."""
        rest_sigma = np.repeat([self.speed_m_s, self.turn_rad_s], 3)[: self.n_states - N_SOURCE]
        root = np.diag(np.concatenate([np.zeros(N_SOURCE), rest_sigma]))
        root[:N_SOURCE, :N_SOURCE] = S
        return np.concatenate([source, np.zeros(rest_sigma.size)]), root

    def state_of(self, source: FloatArray, velocity_m_s: FloatArray, rate_rad_s: FloatArray) -> FloatArray:
        """Return the state of a source of known motion, see :class:`MotionModel`."""
        return np.concatenate([source, velocity_m_s, rate_rad_s])[: self.n_states]


@dataclass(frozen=True)
class RandomWalk(_MovingState):
    """Random walk of position and moment with the S_q of Pavlov et al.

    ``S_q = diag(V Δt, V Δt, V Δt, |m| W Δt, …)``: the step has the length that the object may move in that time.

    Attributes
    ----------
    speed_m_s : float
        Characteristic unknown speed V along each axis.
    turn_rad_s : float
        Characteristic unknown rate W, about each axis.
    n_states : int
        6: position and moment; not to be changed.

    Examples
    --------
    >>> import magloc
    >>> motion = magloc.RandomWalk(speed_m_s=0.5, turn_rad_s=0.1)
    >>> motion.n_states
    6
    """

    speed_m_s: float
    turn_rad_s: float
    n_states: int = N_SOURCE

    def linear_step(self, dt_s: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the parts of the step, see :class:`LinearMotion`."""
        of_position = np.diag(np.repeat([self.speed_m_s * dt_s, 0.0], 3))
        of_moment = np.diag(np.repeat([0.0, self.turn_rad_s * dt_s], 3))
        return np.eye(N_SOURCE), of_position, of_moment

    def step(self, x: FloatArray, dt_s: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the prediction, see :class:`MotionModel`."""
        F, of_position, of_moment = self.linear_step(dt_s)
        return F @ x, F, of_position + math.sqrt(float(x[3:6] @ x[3:6])) * of_moment


@dataclass(frozen=True)
class OrnsteinUhlenbeck(_MovingState):
    r"""Velocity and rate of turn as Ornstein-Uhlenbeck processes of correlation time τ.

    State (p, m, v, ω), with

    .. math:: \dot p = v, \quad \dot m = ω × m, \quad \dot v = -v/τ + w_v, \quad \dot ω = -ω/τ + w_ω

    and white noises that keep the standard deviations of v and ω at the characteristic speed V and rate W. With τ
    towards infinity velocity and turn are constant. Discretised by van Loan's method.

    Attributes
    ----------
    speed_m_s, turn_rad_s : float
        Characteristic speed V and rate W, along and about each axis.
    correlation_s : float, optional
        Correlation time τ; by default 1/W, the time in which the course changes.
    moment_change : float
        Random walk of the moment besides its turn, relative to its modulus [1/√s].
    n_states : int
        12: position, moment, velocity and turn rates; not to be changed.

    Examples
    --------
    >>> import magloc
    >>> motion = magloc.OrnsteinUhlenbeck(speed_m_s=0.1, turn_rad_s=0.02, correlation_s=10.0)
    >>> motion.n_states
    12
    """

    speed_m_s: float
    turn_rad_s: float
    correlation_s: float | None = None
    moment_change: float = 3e-3
    n_states: int = 12

    @property
    def _correlation_s(self) -> float:
        if self.correlation_s is None:
            return 1.0 / self.turn_rad_s if self.turn_rad_s > 0.0 else math.inf
        return self.correlation_s

    def turning_step(self, dt_s: float) -> FloatArray:
        """Return the numbers (12,) of a step for the C++ kernel."""
        tau_s, change = self._correlation_s, self.moment_change * math.sqrt(dt_s)
        return np.array([*turning_step((tau_s, self.speed_m_s), (tau_s, self.turn_rad_s), dt_s), change, change])

    def step(self, x: FloatArray, dt_s: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the prediction, see :class:`MotionModel`."""
        gain_s, decay, root = ornstein_uhlenbeck_step(self._correlation_s, dt_s)
        p, m, v, rate = x[:3], x[3:6], x[6:9], x[9:]
        turn = rotation_matrix(gain_s * rate)
        m_next = turn @ m
        by_rate = -cross_matrix(m_next) @ turn_of_change(gain_s * rate)
        F = np.eye(12)
        F[:3, 6:9] = gain_s * np.eye(3)
        F[3:6, 3:6], F[3:6, 9:] = turn, gain_s * by_rate
        F[6:, 6:] = decay * np.eye(6)
        S_q = np.zeros((12, 15))
        of_speed, of_rate = self.speed_m_s * np.eye(3), self.turn_rad_s * np.eye(3)
        S_q[:3, :3], S_q[6:9, :3], S_q[6:9, 6:9] = root[0, 0] * of_speed, root[1, 0] * of_speed, root[1, 1] * of_speed
        S_q[3:6, 3:6] = root[0, 0] * self.turn_rad_s * by_rate
        S_q[9:, 3:6], S_q[9:, 9:12] = root[1, 0] * of_rate, root[1, 1] * of_rate
        S_q[3:6, 12:] = self.moment_change * math.sqrt(dt_s * float(m @ m)) * np.eye(3)
        return np.concatenate([p + gain_s * v, m_next, decay * v, decay * rate]), F, S_q


@dataclass(frozen=True)
class KnownMotion(_MovingState):
    r"""Motion with measured velocities and rates of array and object: MotionMT, equation (17).

    .. math:: p_j = p_{j-1} + (v_{object} - v_{array} - ω_{array} × p_{j-1}) Δt, \qquad
        m_j = m_{j-1} + (ω_{object} - ω_{array}) × m_{j-1} Δt

    The step is exact for constant rates. It is in the array's axes; with a known pose it is in the world's, and the
    array's velocity and rate are zero. The noise is the sum of :class:`RandomWalk`'s, for the unmeasured rest, and the
    measurements': σ of the velocities moves p, σ of the array's rate turns p and m together, and σ of the object's rate
    turns m.

    Attributes
    ----------
    speed_m_s, turn_rad_s : float
        Characteristic unmeasured speed and rate, along and about each axis.
    object_velocity_m_s, object_rate_rad_s, array_velocity_m_s, array_rate_rad_s : tuple of 3 floats
        Measured velocities and rates.
    velocity_sigma_m_s, object_rate_sigma_rad_s, array_rate_sigma_rad_s : float
        Standard deviations of the difference of the velocities, and of the rates, along and about each axis; new in
        every row.
    n_states : int
        6: position and moment; not to be changed.

    Examples
    --------
    >>> import magloc
    >>> motion = magloc.KnownMotion(0.1, 0.01, array_velocity_m_s=(1.0, 0.0, 0.0), array_rate_rad_s=(0.0, 0.0, 0.1))
    >>> motion.n_states
    6
    """

    speed_m_s: float
    turn_rad_s: float
    object_velocity_m_s: Vector = _AT_REST
    object_rate_rad_s: Vector = _AT_REST
    array_velocity_m_s: Vector = _AT_REST
    array_rate_rad_s: Vector = _AT_REST
    velocity_sigma_m_s: float = 0.0
    object_rate_sigma_rad_s: float = 0.0
    array_rate_sigma_rad_s: float = 0.0
    n_states: int = N_SOURCE

    def step(self, x: FloatArray, dt_s: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the prediction, see :class:`MotionModel`."""
        F, shift = array_axes_transition(
            dt_s,
            object_velocity_m_s=self.object_velocity_m_s,
            object_rate_rad_s=self.object_rate_rad_s,
            array_velocity_m_s=self.array_velocity_m_s,
            array_rate_rad_s=self.array_rate_rad_s,
        )
        x_next = F @ x + shift
        strength = math.sqrt(float(x[3:] @ x[3:]))
        S_q = np.zeros((N_SOURCE, 12))
        S_q[:3, :3] = math.hypot(self.speed_m_s, self.velocity_sigma_m_s) * dt_s * np.eye(3)
        S_q[3:, 3:6] = self.turn_rad_s * dt_s * strength * np.eye(3)
        by_rate = np.concatenate([cross_matrix(x_next[:3]), cross_matrix(x_next[3:])])
        S_q[:, 6:9] = self.array_rate_sigma_rad_s * dt_s * by_rate
        S_q[3:, 9:] = self.object_rate_sigma_rad_s * dt_s * by_rate[3:]
        return x_next, F, S_q


def known_motions(measured: MeasuredMotion, unknown: RandomWalk) -> list[KnownMotion]:
    """Return the motion of the step to each row, with a random walk for the unmeasured rest."""
    steps = measured.of_steps()
    rows = zip(
        steps.velocity_m_s.tolist(),
        steps.rate_rad_s.tolist(),
        np.hypot(*steps.velocity_sigma_m_s.T).tolist(),
        steps.rate_sigma_rad_s.tolist(),
        strict=True,
    )
    return [
        KnownMotion(unknown.speed_m_s, unknown.turn_rad_s, v[1], w[1], v[0], w[0], sigma_v, sigma_w[1], sigma_w[0])
        for v, w, sigma_v, sigma_w in rows
    ]


@lru_cache(maxsize=64)
def turning_step(velocity: tuple[float, float], rate: tuple[float, float], dt_s: float) -> list[float]:
    """Return ten numbers of a step for the C++ kernel, by correlation time and σ of velocity and rate of turn."""
    (gain_s, decay, root_v), (turn_gain_s, turn_decay, root_w) = (
        ornstein_uhlenbeck_step(tau_s, dt_s) for tau_s, _ in (velocity, rate)
    )
    lower = [0, 1, 1], [0, 0, 1]
    return [gain_s, decay, turn_gain_s, turn_decay, *velocity[1] * root_v[lower], *rate[1] * root_w[lower]]


@dataclass(frozen=True)
class CoordinatedTurn(_MovingState):
    r"""Turn of a vehicle about the vertical: velocity and moment turn at one rate, a random walk.

    State (p, m, v, ω): :math:`\dot p = v`, :math:`\dot v = ω e_z × v`, :math:`\dot m = ω e_z × m`.

    Attributes
    ----------
    speed_m_s, turn_rad_s : float
        Prior standard deviations of the velocity along each axis, and of the turn rate.
    acceleration_m_s2 : float
        Random walk of the velocity besides the turn [m/s/√s].
    turn_change_rad_s : float
        Random walk of the turn rate [rad/s/√s].
    moment_change : float
        Random walk of the moment besides its turn, relative to its modulus [1/√s].
    n_states : int
        10: position, moment, velocity and turn rate; not to be changed.

    Examples
    --------
    >>> import magloc
    >>> motion = magloc.CoordinatedTurn(speed_m_s=2.0, turn_rad_s=0.1)
    >>> motion.n_states
    10
    """

    speed_m_s: float
    turn_rad_s: float
    acceleration_m_s2: float = 0.01
    turn_change_rad_s: float = 0.002
    moment_change: float = 0.002
    n_states: int = 10

    def state_of(self, source: FloatArray, velocity_m_s: FloatArray, rate_rad_s: FloatArray) -> FloatArray:
        """Return the state of a source that turns about the vertical, see :class:`MotionModel`."""
        return np.concatenate([source, velocity_m_s, rate_rad_s[2:]])

    def step(self, x: FloatArray, dt_s: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the prediction, see :class:`MotionModel`."""
        p, m, v, rate = x[:3], x[3:6], x[6:9], float(x[9])
        angle, about_vertical = rate * dt_s, cross_matrix(_VERTICAL)
        turn, path = rotation_matrix(angle * _VERTICAL), turn_of_change(angle * _VERTICAL)
        d_turn = about_vertical @ turn
        # Derivative of the path's matrix, by a series where the quotient cancels.
        series = (0.5 - angle**2 / 8.0) * about_vertical + angle / 3.0 * about_vertical @ about_vertical
        d_path = series if abs(angle) < 1e-4 else (turn - path) / angle
        F = np.eye(10)
        F[:3, 6:9] = dt_s * path
        F[3:6, 3:6] = F[6:9, 6:9] = turn
        F[:3, 9], F[3:6, 9], F[6:9, 9] = dt_s**2 * (d_path @ v), dt_s * (d_turn @ m), dt_s * (d_turn @ v)
        root = math.sqrt(dt_s)
        strength = math.sqrt(float(m @ m))
        sigma = np.repeat([self.acceleration_m_s2 * root, self.moment_change * strength * root], 3)
        S_q = np.zeros((10, 7))
        S_q[:3, :3] = 0.5 * dt_s * np.diag(sigma[:3])
        S_q[6:9, :3] = np.diag(sigma[:3])
        S_q[3:6, 3:6] = np.diag(sigma[3:])
        S_q[9, 6] = self.turn_change_rad_s * root
        x_next = np.concatenate([p + dt_s * (path @ v), turn @ m, turn @ v, [rate]])
        return x_next, F, S_q
