"""Compiled rotation of a satellite with wheels.

:mod:`adcs.satellite.dynamics` is the readable twin and has the formulas.

Vectors, quaternions and matrices are tuples of scalars, which the compiler keeps in registers. The
functions of this module are made to be called by other kernels; :func:`run` follows whole runs, one row each.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adcs.satellite.dynamics import RigidBody, WheelControl
from adcs.satellite.magnetic_control import MU0, HysteresisRods
from magloc.compilation import compiled, internal

Array = NDArray[np.float64]
_MU0 = MU0
Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
Matrix = tuple[Vector, Vector, Vector]


class Body(NamedTuple):
    """A satellite: its inertia, the inverse of it, and its residual dipole."""

    J: Matrix
    J_inverse: Matrix
    dipole: Vector

    @classmethod
    def of(cls, body: RigidBody) -> Body:
        """In the layout of the compiled code."""
        return cls(matrix_at(body.inertia_kgm2), matrix_at(body.inverse), vector_at(body.residual_dipole_Am2))


class Control(NamedTuple):
    """Proportional-derivative control of the wheels towards a reference attitude."""

    attitude_gain: Vector
    rate_gain: Vector
    torque_limit: float
    momentum_limit: float
    q_reference: Quaternion

    @classmethod
    def of(cls, control: WheelControl, q_reference: Array) -> Control:
        """In the layout of the compiled code."""
        gains = vector_at(control.attitude_gain_Nm), vector_at(control.rate_gain_Nms)
        return cls(*gains, control.torque_limit_Nm, control.momentum_limit_Nms, quaternion_at(q_reference))


class Rods(NamedTuple):
    """Hysteresis rods: axes (K, 3), H_c, k of their loop, and the moment of the largest flux times 2/π."""

    axes: Array
    coercivity: float
    steepness: float
    strength: float

    @classmethod
    def of(cls, rods: HysteresisRods | None) -> Rods:
        """In the layout of the compiled code; without rods no axes."""
        if rods is None:
            return cls(np.empty((0, 3)), 0.0, 0.0, 0.0)
        strength = 2.0 / np.pi * rods.saturation_T * rods.volume_m3 / MU0
        return cls(np.ascontiguousarray(rods.axes), rods.coercivity_A_m, rods.steepness_m_A, strength)


class Surroundings(NamedTuple):
    """Orbital rate and gravity (R, n), field in the orbital frame (R, n, 3), of all instants of all runs."""

    orbital_rate: Array
    gravity: Array
    b_orbital: Array


class Motion(NamedTuple):
    """Attitude (R, n, 4), rate, momentum and torque of the wheels (R, n, 3) of all instants of all runs."""

    q: Array
    w: Array
    momentum: Array
    wheel_torque: Array


@compiled
def vector_at(values: Array) -> Vector:
    """Tuple of a row (3,)."""
    return values[0], values[1], values[2]


@compiled
def matrix_at(values: Array) -> Matrix:
    """Tuple of the rows of a matrix (3, 3)."""
    return vector_at(values[0]), vector_at(values[1]), vector_at(values[2])


@compiled
def quaternion_at(values: Array) -> Quaternion:
    """Tuple of a row (4,)."""
    return values[0], values[1], values[2], values[3]


@internal
def combined(a: Vector, scale: float, b: Vector) -> Vector:
    """Vector a + scale·b."""
    return a[0] + scale * b[0], a[1] + scale * b[1], a[2] + scale * b[2]


@internal
def dot(a: Vector, b: Vector) -> float:
    """Product a·b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled
def cross(a: Vector, b: Vector) -> Vector:
    """Vector a×b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@compiled
def applied(M: Matrix, v: Vector) -> Vector:
    """Vector M v of a matrix (3, 3)."""
    return (
        M[0][0] * v[0] + M[0][1] * v[1] + M[0][2] * v[2],
        M[1][0] * v[0] + M[1][1] * v[1] + M[1][2] * v[2],
        M[2][0] * v[0] + M[2][1] * v[1] + M[2][2] * v[2],
    )


@compiled
def with_dipole(body: Body, dipole: Vector) -> Body:
    """Body with a dipole besides its residual one."""
    return Body(body.J, body.J_inverse, combined(body.dipole, 1.0, dipole))


@compiled
def multiply(p: Quaternion, q: Quaternion) -> Quaternion:
    """Hamilton product p∘q."""
    return (
        p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3],
        p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2],
        p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1],
        p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0],
    )


@compiled
def conjugate(q: Quaternion) -> Quaternion:
    """Conjugate q*."""
    return q[0], -q[1], -q[2], -q[3]


@internal
def moved(q: Quaternion, scale: float, dq: Quaternion) -> Quaternion:
    """Quaternion q + scale·dq, not normalised."""
    return q[0] + scale * dq[0], q[1] + scale * dq[1], q[2] + scale * dq[2], q[3] + scale * dq[3]


@compiled
def normalised(q: Quaternion) -> Quaternion:
    """Quaternion of length 1."""
    inverse = 1.0 / np.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    return q[0] * inverse, q[1] * inverse, q[2] * inverse, q[3] * inverse


@compiled
def rotate_back(q: Quaternion, v: Vector) -> Vector:
    """Vector A(q) v = q*∘v∘q."""
    p = (q[1], q[2], q[3])
    twice = cross(p, v)
    twice = (2.0 * twice[0], 2.0 * twice[1], 2.0 * twice[2])
    return combined(combined(v, -q[0], twice), 1.0, cross(p, twice))


@compiled
def error_vector(q_estimated: Quaternion, q_true: Quaternion) -> Vector:
    """Vector part of q̂*∘q with the sign that makes the scalar part positive."""
    e = multiply(conjugate(q_estimated), q_true)
    sign = -1.0 if e[0] < 0.0 else 1.0
    return sign * e[1], sign * e[2], sign * e[3]


@compiled
def relative_rate(q: Quaternion, w: Vector, orbital_rate: float) -> Vector:
    """Rate against the orbital frame."""
    return combined(w, -orbital_rate, rotate_back(q, (0.0, 1.0, 0.0)))


@compiled
def environment_torque(body: Body, q: Quaternion, gravity: float, b_orbital: Vector) -> Vector:
    """Torque of the gravity gradient and of the residual dipole."""
    eta = rotate_back(q, (0.0, 0.0, 1.0))
    magnetic = cross(body.dipole, rotate_back(q, b_orbital))
    return combined(magnetic, 3.0 * gravity, cross(eta, applied(body.J, eta)))


@compiled
def angular_acceleration(body: Body, w: Vector, momentum: Vector, wheel_torque: Vector, torque: Vector) -> Vector:
    """Acceleration of the body."""
    gyroscopic = cross(w, combined(momentum, 1.0, applied(body.J, w)))
    return applied(body.J_inverse, combined(combined(torque, -1.0, wheel_torque), -1.0, gyroscopic))


@internal
def quaternion_rate(q: Quaternion, w_relative: Vector) -> Quaternion:
    """Rate of change ½ q∘(0, ω)."""
    return multiply(q, (0.0, 0.5 * w_relative[0], 0.5 * w_relative[1], 0.5 * w_relative[2]))


@compiled
def step(
    body: Body,
    q: Quaternion,
    w: Vector,
    momentum: Vector,
    wheel_torque: Vector,
    torque: Vector,
    orbital_rate: float,
    gravity: float,
    b_orbital: Vector,
    dt: float,
) -> tuple[Quaternion, Vector, Vector]:
    """One Runge-Kutta step of attitude, rate and wheel momentum."""
    half = 0.5 * dt
    middle = combined(momentum, half, wheel_torque)
    end = combined(momentum, dt, wheel_torque)

    q1 = quaternion_rate(q, relative_rate(q, w, orbital_rate))
    outside = combined(torque, 1.0, environment_torque(body, q, gravity, b_orbital))
    w1 = angular_acceleration(body, w, momentum, wheel_torque, outside)

    q_at, w_at = moved(q, half, q1), combined(w, half, w1)
    q2 = quaternion_rate(q_at, relative_rate(q_at, w_at, orbital_rate))
    outside = combined(torque, 1.0, environment_torque(body, q_at, gravity, b_orbital))
    w2 = angular_acceleration(body, w_at, middle, wheel_torque, outside)

    q_at, w_at = moved(q, half, q2), combined(w, half, w2)
    q3 = quaternion_rate(q_at, relative_rate(q_at, w_at, orbital_rate))
    outside = combined(torque, 1.0, environment_torque(body, q_at, gravity, b_orbital))
    w3 = angular_acceleration(body, w_at, middle, wheel_torque, outside)

    q_at, w_at = moved(q, dt, q3), combined(w, dt, w3)
    q4 = quaternion_rate(q_at, relative_rate(q_at, w_at, orbital_rate))
    outside = combined(torque, 1.0, environment_torque(body, q_at, gravity, b_orbital))
    w4 = angular_acceleration(body, w_at, end, wheel_torque, outside)

    sixth = dt / 6.0
    q = moved(moved(moved(moved(q, sixth, q1), 2.0 * sixth, q2), 2.0 * sixth, q3), sixth, q4)
    w = combined(combined(combined(combined(w, sixth, w1), 2.0 * sixth, w2), 2.0 * sixth, w3), sixth, w4)
    return normalised(q), w, end


@compiled
def error_jacobian(
    body: Body, q: Quaternion, w: Vector, momentum: Vector, gravity: float, b_orbital: Vector, F: Array
) -> None:
    """F of the error (δq, δω) for a known wheel torque, into all 36 elements of ``F`` (6, 6).

    Its columns are what the linear map makes of the three unit vectors e: with δη = 2 η×e for δq = e, and so for B.
    """
    J, J_inverse = body.J, body.J_inverse
    eta = rotate_back(q, (0.0, 0.0, 1.0))
    J_eta = applied(J, eta)
    b = rotate_back(q, b_orbital)
    total = combined(momentum, 1.0, applied(J, w))
    for i in range(3):
        e = (1.0 if i == 0 else 0.0, 1.0 if i == 1 else 0.0, 1.0 if i == 2 else 0.0)
        turned = cross(e, w)
        F[0, i], F[1, i], F[2, i] = turned
        F[0, 3 + i], F[1, 3 + i], F[2, 3 + i] = 0.5 * e[0], 0.5 * e[1], 0.5 * e[2]
        d_eta = cross(eta, e)
        gradient = combined(cross(d_eta, J_eta), 1.0, cross(eta, applied(J, d_eta)))
        magnetic = cross(body.dipole, cross(b, e))
        torque = (
            6.0 * gravity * gradient[0] + 2.0 * magnetic[0],
            6.0 * gravity * gradient[1] + 2.0 * magnetic[1],
            6.0 * gravity * gradient[2] + 2.0 * magnetic[2],
        )
        F[3, i], F[4, i], F[5, i] = applied(J_inverse, torque)
        gyroscopic = combined(cross(total, e), -1.0, cross(w, applied(J, e)))
        F[3, 3 + i], F[4, 3 + i], F[5, 3 + i] = applied(J_inverse, gyroscopic)


@internal
def _clipped(value: float, limit: float) -> float:
    return min(max(value, -limit), limit)


@compiled
def commanded_torque(
    J: Matrix, control: Control, q: Quaternion, w: Vector, momentum: Vector, orbital_rate: float, dt: float
) -> Vector:
    """Wheel torque of the proportional-derivative control, within its limits."""
    attitude_gain, rate_gain = control.attitude_gain, control.rate_gain
    torque_limit, momentum_limit = control.torque_limit, control.momentum_limit
    angle = error_vector(control.q_reference, q)
    rate = relative_rate(q, w, orbital_rate)
    gyroscopic = cross(w, combined(momentum, 1.0, applied(J, w)))
    x = _clipped(attitude_gain[0] * angle[0] + rate_gain[0] * rate[0] - gyroscopic[0], torque_limit)
    y = _clipped(attitude_gain[1] * angle[1] + rate_gain[1] * rate[1] - gyroscopic[1], torque_limit)
    z = _clipped(attitude_gain[2] * angle[2] + rate_gain[2] * rate[2] - gyroscopic[2], torque_limit)
    return (
        (_clipped(momentum[0] + x * dt, momentum_limit) - momentum[0]) / dt,
        (_clipped(momentum[1] + y * dt, momentum_limit) - momentum[1]) / dt,
        (_clipped(momentum[2] + z * dt, momentum_limit) - momentum[2]) / dt,
    )


@internal
def rods_moment(rods: Rods, state: Array, b: Vector) -> Vector:
    """Moment of rods after they have followed a field in body axes; ``state`` (2, K), H and z of each, goes on."""
    moment = (0.0, 0.0, 0.0)
    for i in range(len(rods.axes)):
        axis = vector_at(rods.axes[i])
        H = (axis[0] * b[0] + axis[1] * b[1] + axis[2] * b[2]) / _MU0
        way = -1.0 if state[0, i] > H else 1.0
        s = 0.5 + 0.5 * way * (state[0, i] - state[1, i]) / rods.coercivity
        t = np.tanh(0.5 * abs(H - state[0, i]) / rods.coercivity)
        state[0, i] = H
        state[1, i] = H - way * rods.coercivity * (2.0 * (s + t) / (1.0 + s * t) - 1.0)
        moment = combined(moment, rods.strength * np.arctan(rods.steepness * state[1, i]), axis)
    return moment


@compiled
def run(
    begin: int,
    end: int,
    motion: Motion,
    body: Body,
    control: Control,
    torque: Array,
    dipole: Array,
    rods: Rods,
    around: Surroundings,
    dt: float,
) -> None:
    """Runs begin to end under control that sees the true state, from their first rows on.

    The first rows of the motion hold the start of attitude, rate and momentum, and the others are filled; the wheels'
    torque is what is held from each instant to the next (the last row: what would be). ``torque`` and ``dipole``
    (R, n, 3), besides the residual one, are held likewise; surroundings are those at the start of every step. The
    rods' moment is held too, that of the field at the middle of the step, or they would lag by half of it more.
    """
    q, w, momentum, wheel_torque = motion
    n = q.shape[1]
    for r in range(begin, end):
        q_now = quaternion_at(q[r, 0])
        w_now = vector_at(w[r, 0])
        k_now = vector_at(momentum[r, 0])
        iron = np.zeros((2, len(rods.axes)))
        for i in range(n):
            rate = around.orbital_rate[r, i]
            u = commanded_torque(body.J, control, q_now, w_now, k_now, rate, dt)
            q[r, i, 0], q[r, i, 1], q[r, i, 2], q[r, i, 3] = q_now
            w[r, i, 0], w[r, i, 1], w[r, i, 2] = w_now
            momentum[r, i, 0], momentum[r, i, 1], momentum[r, i, 2] = k_now
            wheel_torque[r, i, 0], wheel_torque[r, i, 1], wheel_torque[r, i, 2] = u
            if i == n - 1:
                break
            outside, b_orbital = vector_at(torque[r, i]), vector_at(around.b_orbital[r, i])
            b = rotate_back(q_now, b_orbital)
            own = rods_moment(rods, iron, combined(b, 0.5 * dt, cross(b, w_now)))
            now = with_dipole(body, combined(own, 1.0, vector_at(dipole[r, i])))
            gravity = around.gravity[r, i]
            q_now, w_now, k_now = step(now, q_now, w_now, k_now, u, outside, rate, gravity, b_orbital, dt)
