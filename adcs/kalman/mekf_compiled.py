"""Compiled error-state filter of whole runs; :mod:`adcs.kalman.mekf` is the readable twin and has the formulas.

Readings are taken one scalar after the other, all linearised at the predicted state, which for independent noise is the
update of all at once without a matrix to invert. The covariance of a step is in Joseph's form.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adcs.satellite.dynamics_compiled import (
    Body,
    Quaternion,
    Surroundings,
    Vector,
    applied,
    error_jacobian,
    error_vector,
    multiply,
    normalised,
    quaternion_at,
    rotate_back,
    step,
    vector_at,
)
from magloc.compilation import compiled

Array = NDArray[np.float64]
_ALWAYS = 6


class Estimated(NamedTuple):
    """Outputs (R, n, …), optional (3, R, n, 3): biases of field and gyro, disturbance; nis (R, n, 4) at readings."""

    q: Array
    w: Array
    optional: Array
    covariance: Array
    nis: Array


class First(NamedTuple):
    """Attitude (R, 4), rate (R, 3) and covariance (R, N, N) before the first reading."""

    q: Array
    w: Array
    P: Array


class Record(NamedTuple):
    """Wheels, readings, and the Sun in the orbital frame: (R, n, 3) or of the star tracker (R, n, 4)."""

    momentum: Array
    wheel_torque: Array
    star: Array
    gyro: Array
    field: Array
    sun: Array
    sun_orbital: Array


class Settings(NamedTuple):
    """Which of star tracker, gyro, magnetometer and Sun sensor are used, and their deviations, (4,) both.

    Biases of field and gyro and the disturbance begin at ``firsts`` in the error state, -1 where there are none.
    """

    used: NDArray[np.bool_]
    sigma: Array
    firsts: NDArray[np.int64]
    variance: Array


@compiled
def _transition(F: Array, F2: Array, F3: Array, dt: float, Phi: Array, G: Array) -> None:
    """Φ (6, 6) of attitude and rate and G (6, 3) by a disturbance, from F; ``F2`` and ``F3`` are for work."""
    for i in range(6):
        for j in range(6):
            total = 0.0
            for k in range(6):
                total += F[i, k] * F[k, j]
            F2[i, j] = total
    for i in range(6):
        for j in range(6):
            total = 0.0
            for k in range(6):
                total += F2[i, k] * F[k, j]
            F3[i, j] = total
    half, sixth = dt * dt / 2.0, dt * dt * dt / 6.0
    for i in range(6):
        for j in range(6):
            one = 1.0 if i == j else 0.0
            Phi[i, j] = one + dt * F[i, j] + half * F2[i, j] + sixth * F3[i, j]
        for j in range(3):
            one = 1.0 if i == 3 + j else 0.0
            G[i, j] = dt * one + half * F[i, 3 + j] + sixth * F2[i, 3 + j]


@compiled
def _spread(Phi: Array, G: Array, d: int, variance: Array, P: Array, T: Array) -> None:
    """P becomes Φ P Φᵀ + Q; only the first six rows of Φ differ from those of the unit matrix. ``d``: -1 without."""
    n = P.shape[0]
    for i in range(_ALWAYS):
        for j in range(n):
            T[i, j] = 0.0
        for k in range(_ALWAYS):
            factor = Phi[i, k]
            for j in range(n):
                T[i, j] += factor * P[k, j]
        if d >= 0:
            for k in range(3):
                factor = G[i, k]
                for j in range(n):
                    T[i, j] += factor * P[d + k, j]
    for i in range(_ALWAYS):
        for j in range(i + 1):
            total = 0.0
            for k in range(_ALWAYS):
                total += T[i, k] * Phi[j, k]
            if d >= 0:
                for k in range(3):
                    total += T[i, d + k] * G[j, k]
            P[i, j] = total
            P[j, i] = total
        for j in range(_ALWAYS, n):
            P[i, j] = T[i, j]
            P[j, i] = T[i, j]
    for i in range(n):
        P[i, i] += variance[i]


@compiled
def _scalar(
    P: Array, dx: Array, a: Vector, first: int, unit: int, residual: float, r: float, u: Array, A: Array
) -> float:
    """Update by one scalar whose row has ``a`` from column ``first`` and 1 in column ``unit``; its NIS.

    ``residual`` is that at the predicted state, before any scalar of the instant. ``unit`` is -1 where there is none;
    ``u`` (n,) and ``A`` (n, n) are for work.
    """
    n = P.shape[0]
    for i in range(n):
        u[i] = P[first, i] * a[0] + P[first + 1, i] * a[1] + P[first + 2, i] * a[2]
    s = r
    nu = residual - a[0] * dx[first] - a[1] * dx[first + 1] - a[2] * dx[first + 2]
    if unit >= 0:
        for i in range(n):
            u[i] += P[unit, i]
        s += u[unit]
        nu -= dx[unit]
    s += a[0] * u[first] + a[1] * u[first + 1] + a[2] * u[first + 2]
    inverse = 1.0 / s
    gain = nu * inverse
    for i in range(n):
        dx[i] += u[i] * gain
    # A = (E - Kh) P with K = u/s, then A (E - Kh)ᵀ + K r Kᵀ = A - (A hᵀ - K r) Kᵀ: what is left of a direction that
    # the reading fixes is not the difference of large numbers.
    for i in range(n):
        K = u[i] * inverse
        for j in range(n):
            A[i, j] = P[i, j] - K * u[j]
    for i in range(n):
        rest = a[0] * A[i, first] + a[1] * A[i, first + 1] + a[2] * A[i, first + 2] - r * u[i] * inverse
        if unit >= 0:
            rest += A[i, unit]
        rest *= inverse
        for j in range(i + 1):
            value = A[i, j] - rest * u[j]
            P[i, j] = value
            P[j, i] = value
    return nu * nu * inverse


@compiled
def _three(P: Array, dx: Array, v: Vector, bias: int, residual: Vector, r: float, u: Array, A: Array) -> float:
    """Update by a direction with rows 2W(v) for the attitude and 1 for its bias; NIS."""
    nis = _scalar(P, dx, (0.0, -2.0 * v[2], 2.0 * v[1]), 0, bias, residual[0], r, u, A)
    unit = bias + 1 if bias >= 0 else -1
    nis += _scalar(P, dx, (2.0 * v[2], 0.0, -2.0 * v[0]), 0, unit, residual[1], r, u, A)
    unit = bias + 2 if bias >= 0 else -1
    return nis + _scalar(P, dx, (-2.0 * v[1], 2.0 * v[0], 0.0), 0, unit, residual[2], r, u, A)


@compiled
def _ones(P: Array, dx: Array, first: int, bias: int, residual: Vector, r: float, u: Array, A: Array) -> float:
    """Update by three components of the state themselves, and of their bias; NIS."""
    nis = _scalar(P, dx, (1.0, 0.0, 0.0), first, bias, residual[0], r, u, A)
    unit = bias + 1 if bias >= 0 else -1
    nis += _scalar(P, dx, (0.0, 1.0, 0.0), first, unit, residual[1], r, u, A)
    unit = bias + 2 if bias >= 0 else -1
    return nis + _scalar(P, dx, (0.0, 0.0, 1.0), first, unit, residual[2], r, u, A)


@compiled
def _minus(a: Vector, b: Vector) -> Vector:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@compiled
def _plus(v: Vector, dx: Array, first: int) -> Vector:
    if first < 0:
        return v
    return v[0] + dx[first], v[1] + dx[first + 1], v[2] + dx[first + 2]


@compiled
def _with_error(q: Quaternion, dx: Array) -> Quaternion:
    squared = dx[0] * dx[0] + dx[1] * dx[1] + dx[2] * dx[2]
    inverse = 1.0 / np.sqrt(max(squared, 1.0))
    delta = (np.sqrt(max(1.0 - squared, 0.0)), dx[0] * inverse, dx[1] * inverse, dx[2] * inverse)
    return normalised(multiply(q, delta))


@compiled
def run(
    begin: int,
    end: int,
    out: Estimated,
    first: First,
    body: Body,
    record: Record,
    around: Surroundings,
    settings: Settings,
    dt: float,
) -> None:
    """Filter runs begin to end."""
    q_out, w_out, optional_out, covariance, nis = out
    momentum, wheel_torque, star, gyro, field, sun, sun_orbital = record
    orbital_rate, gravity, b_orbital = around
    used, sigma, firsts, variance = settings
    n_rows, N = q_out.shape[1], first.P.shape[1]
    b_first, g_first, d_first = firsts[0], firsts[1], firsts[2]
    r_star, r_gyro = sigma[0] * sigma[0], sigma[1] * sigma[1]
    r_field, r_sun = sigma[2] * sigma[2], sigma[3] * sigma[3]
    P, T = np.empty((N, N)), np.empty((6, N))
    F, F_after, F2, F3, Phi = np.empty((6, 6)), np.empty((6, 6)), np.empty((6, 6)), np.empty((6, 6)), np.empty((6, 6))
    G, A, dx, u = np.empty((6, 3)), np.empty((N, N)), np.empty(N), np.empty(N)
    for run in range(begin, end):
        q, w = quaternion_at(first.q[run]), vector_at(first.w[run])
        b_bias, g_bias, d = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
        P[:] = first.P[run]
        for i in range(n_rows):
            if i > 0:
                k = vector_at(momentum[run, i - 1])
                b_o = vector_at(b_orbital[run, i - 1])
                error_jacobian(body, q, w, k, gravity[run, i - 1], b_o, F)
                u_k, torque = vector_at(wheel_torque[run, i - 1]), applied(body.J, d)
                q, w, _ = step(body, q, w, k, u_k, torque, orbital_rate[run, i - 1], gravity[run, i - 1], b_o, dt)
                k, b_o = vector_at(momentum[run, i]), vector_at(b_orbital[run, i])
                error_jacobian(body, q, w, k, gravity[run, i], b_o, F_after)
                for row in range(6):
                    for column in range(6):
                        F[row, column] = 0.5 * (F[row, column] + F_after[row, column])
                _transition(F, F2, F3, dt, Phi, G)
                _spread(Phi, G, d_first, variance, P, T)
            dx[:] = 0.0
            if used[0] and np.isfinite(star[run, i, 0]):
                residual = error_vector(q, quaternion_at(star[run, i]))
                nis[run, i, 0] = _ones(P, dx, 0, -1, residual, r_star, u, A)
            if used[1] and np.isfinite(gyro[run, i, 0]):
                residual = _minus(_minus(vector_at(gyro[run, i]), w), g_bias)
                nis[run, i, 1] = _ones(P, dx, 3, g_first, residual, r_gyro, u, A)
            if used[2] and np.isfinite(field[run, i, 0]):
                v = rotate_back(q, vector_at(b_orbital[run, i]))
                residual = _minus(_minus(vector_at(field[run, i]), v), b_bias)
                nis[run, i, 2] = _three(P, dx, v, b_first, residual, r_field, u, A)
            if used[3] and np.isfinite(sun[run, i, 0]):
                v = rotate_back(q, vector_at(sun_orbital[run, i]))
                nis[run, i, 3] = _three(P, dx, v, -1, _minus(vector_at(sun[run, i]), v), r_sun, u, A)
            q = _with_error(q, dx)
            w = _plus(w, dx, 3)
            b_bias, g_bias, d = _plus(b_bias, dx, b_first), _plus(g_bias, dx, g_first), _plus(d, dx, d_first)
            q_out[run, i, 0], q_out[run, i, 1], q_out[run, i, 2], q_out[run, i, 3] = q
            w_out[run, i, 0], w_out[run, i, 1], w_out[run, i, 2] = w
            optional_out[0, run, i, 0], optional_out[0, run, i, 1], optional_out[0, run, i, 2] = b_bias
            optional_out[1, run, i, 0], optional_out[1, run, i, 1], optional_out[1, run, i, 2] = g_bias
            optional_out[2, run, i, 0], optional_out[2, run, i, 1], optional_out[2, run, i, 2] = d
            covariance[run, i] = P
