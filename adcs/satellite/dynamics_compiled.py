"""Compiled rotation of a satellite with wheels.

:mod:`adcs.satellite.dynamics` is the readable twin and has the formulas.

Vectors, quaternions and matrices are tuples of scalars, which the compiler keeps in registers. The
functions of this module are made to be called by other kernels.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adcs.satellite.dynamics import RigidBody
from magloc.compilation import compiled, internal

Array = NDArray[np.float64]
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


class Surroundings(NamedTuple):
    """Orbital rate and gravity (R, n), field in the orbital frame (R, n, 3), of all instants of all runs."""

    orbital_rate: Array
    gravity: Array
    b_orbital: Array


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
