"""Compiled prediction and update of the error state's covariance; :mod:`adcs.kalman.mekf` is the readable twin."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from adcs.satellite.dynamics_compiled import Body, Vector, applied, cross
from magloc.compilation import internal

Array = NDArray[np.float64]
_ALWAYS = 6


@internal
def transition(F: Array, F2: Array, F3: Array, dt: float, Phi: Array, G: Array) -> None:
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


@internal
def by_dipole(G: Array, body: Body, b: Vector, by: Array) -> None:
    """Into ``by`` (6, 3) what a dipole does in a field b in body axes: G (6, 3) of a disturbance times -J⁻¹W(b)."""
    for j in range(3):
        e = (1.0 if j == 0 else 0.0, 1.0 if j == 1 else 0.0, 1.0 if j == 2 else 0.0)
        acceleration = applied(body.J_inverse, cross(e, b))
        for i in range(6):
            by[i, j] = G[i, 0] * acceleration[0] + G[i, 1] * acceleration[1] + G[i, 2] * acceleration[2]


@internal
def spread(Phi: Array, G: Array, firsts: tuple[int, int], variance: Array, P: Array, T: Array) -> None:
    """P becomes Φ P Φᵀ + Q; only the first six rows of Φ differ from those of the unit matrix.

    ``G`` (2, 6, 3): by disturbance and dipole, which begin at ``firsts`` in the error state, -1 without.
    """
    n = P.shape[0]
    for i in range(_ALWAYS):
        for j in range(n):
            T[i, j] = 0.0
        for k in range(_ALWAYS):
            factor = Phi[i, k]
            for j in range(n):
                T[i, j] += factor * P[k, j]
        for s in range(2):
            if firsts[s] >= 0:
                for k in range(3):
                    factor = G[s, i, k]
                    for j in range(n):
                        T[i, j] += factor * P[firsts[s] + k, j]
    for i in range(_ALWAYS):
        for j in range(i + 1):
            total = 0.0
            for k in range(_ALWAYS):
                total += T[i, k] * Phi[j, k]
            for s in range(2):
                if firsts[s] >= 0:
                    for k in range(3):
                        total += T[i, firsts[s] + k] * G[s, j, k]
            P[i, j] = total
            P[j, i] = total
        for j in range(_ALWAYS, n):
            P[i, j] = T[i, j]
            P[j, i] = T[i, j]
    for i in range(n):
        P[i, i] += variance[i]


@internal
def scalar(
    P: Array, dx: Array, h: Array, columns: NDArray[np.int64], m: int, residual: float, r: float, u: Array, A: Array
) -> tuple[float, float]:
    """Update by one scalar; its NIS and the variance of its innovation.

    Its row has the first ``m`` numbers of ``h`` in the first ``m`` ``columns``, else zeros. ``residual`` is that at the
    predicted state, before any scalar of the instant. ``u`` (N,) and ``A`` (N, N) are for work.
    """
    n = P.shape[0]
    s, nu = r, residual
    for i in range(n):
        u[i] = 0.0
    for place in range(m):
        j, factor = columns[place], h[place]
        for i in range(n):
            u[i] += factor * P[j, i]
        nu -= factor * dx[j]
    for place in range(m):
        s += h[place] * u[columns[place]]
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
        rest = -r * u[i] * inverse
        for place in range(m):
            rest += h[place] * A[i, columns[place]]
        rest *= inverse
        for j in range(i + 1):
            value = A[i, j] - rest * u[j]
            P[i, j] = value
            P[j, i] = value
    return nu * nu * inverse, s
