"""The compiled step of :class:`magloc.tracking.multi_target.motion.FreeMotion`; its twin is in the tests of the motion.

The covariance is multiplied by the transition from both sides source by source, as no source moves another.
"""

from __future__ import annotations

import math

import numpy as np

from arrays.typing import FloatArray
from magloc.compilation import compiled, internal
from magloc.tracking.multi_target.state import N_COMMON, N_SEEN


@internal
def _fill_turn(angle: FloatArray, R: FloatArray, J: FloatArray) -> None:
    """Rotation R by a vector, and the small turns J δ that follow when δ is added to it."""
    x, y, z = angle[0], angle[1], angle[2]
    square = x * x + y * y + z * z
    a = math.sqrt(square)
    # sin(a)/a, (1 - cos(a))/a² and (a - sin(a))/a³, by series where they cancel.
    first, half, third = 1.0 - square / 6.0, 0.5 - square / 24.0, 1.0 / 6.0 - square / 120.0
    if a > 1e-2:
        first = math.sin(a) / a
        half = 2.0 * math.sin(0.5 * a) ** 2 / square
        third = (1.0 - first) / square
    K = ((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0))
    for i in range(3):
        for j in range(3):
            one = 1.0 if i == j else 0.0
            of_square = angle[i] * angle[j] - square * one
            R[i, j] = one + first * K[i][j] + half * of_square
            J[i, j] = one + half * K[i][j] + third * of_square


@internal
def move_rows(P: FloatArray, k: int, at: int, step: FloatArray, R: FloatArray, M: FloatArray) -> None:
    """Multiply rows of one source, whose motion stands from row `at` on, by its transition."""
    lasts, kept, turn_kept = step[0], step[1], step[3]
    c = N_SEEN * k + 3
    for j in range(P.shape[1]):
        u, v, w = P[c, j], P[c + 1, j], P[c + 2, j]
        p, q, r = P[at + 3, j], P[at + 4, j], P[at + 5, j]
        for i in range(3):
            P[c - 3 + i, j] += lasts * P[at + i, j]
            P[c + i, j] = R[i, 0] * u + R[i, 1] * v + R[i, 2] * w + M[i, 0] * p + M[i, 1] * q + M[i, 2] * r
            P[at + i, j] *= kept
            P[at + 3 + i, j] *= turn_kept


@internal
def fill_transition(
    rate: FloatArray, moment: FloatArray, step: FloatArray, m: FloatArray, R: FloatArray, M: FloatArray
) -> None:
    """Fill a source's moment m (3,) after a step, how it turns, R (3, 3), and how it does by its rate, M (3, 3)."""
    angle, J, turned = np.empty(3), np.empty((3, 3)), np.zeros((3, 3))
    for i in range(3):
        angle[i] = step[2] * rate[i]
    _fill_turn(angle, R, J)
    for i in range(3):
        m[i] = R[i, 0] * moment[0] + R[i, 1] * moment[1] + R[i, 2] * moment[2]
    length = math.sqrt(m[0] * m[0] + m[1] * m[1] + m[2] * m[2])
    _fill_turned(m, length, turned)
    for i in range(3):
        for j in range(3):
            M[i, j] = step[2] * (turned[i, 0] * J[0, j] + turned[i, 1] * J[1, j] + turned[i, 2] * J[2, j])


@internal
def _fill_turned(m: FloatArray, length: float, turned: FloatArray) -> None:
    """What a small turn changes of a moment's direction u: -[u]×."""
    x, y, z = m[0] / length, m[1] / length, m[2] / length
    turned[0, 1], turned[0, 2], turned[1, 2] = z, -y, x
    turned[1, 0], turned[2, 0], turned[2, 1] = -z, y, -x


@compiled
def step_all(
    state: tuple[FloatArray, FloatArray, FloatArray, FloatArray], P: FloatArray, step: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Positions, moments, velocities, rates of turn and covariance after a step.

    `step` has what a value gains from its rate and what the rate keeps, for places and for turns; then the noise of
    place, place with velocity, velocity, turn, turn with rate, rate, ln |m|, and the common field.
    """
    position, moment, velocity, rate = state
    K, n = len(position), len(P)
    p, m, v, w = np.empty((K, 3)), np.empty((K, 3)), np.empty((K, 3)), np.empty((K, 3))
    R, M, turned = np.empty((K, 3, 3)), np.empty((K, 3, 3)), np.zeros((K, 3, 3))
    after, u = P.copy(), np.empty((K, 3))
    seen = N_SEEN * K + N_COMMON
    for k in range(K):
        fill_transition(rate[k], moment[k], step, m[k], R[k], M[k])
        length = math.sqrt(m[k, 0] * m[k, 0] + m[k, 1] * m[k, 1] + m[k, 2] * m[k, 2])
        _fill_turned(m[k], length, turned[k])
        for i in range(3):
            u[k, i] = m[k, i] / length
            p[k, i] = position[k, i] + step[0] * velocity[k, i]
            v[k, i], w[k, i] = step[1] * velocity[k, i], step[3] * rate[k, i]
        move_rows(after, k, seen + 6 * k, step, R[k], M[k])
    for i in range(n):  # F P Fᵀ = F (F P)ᵀ, as P is symmetric
        for j in range(i):
            after[i, j], after[j, i] = after[j, i], after[i, j]
    for k in range(K):
        move_rows(after, k, seen + 6 * k, step, R[k], M[k])
    for k in range(K):
        first, at = N_SEEN * k, seen + 6 * k
        for i in range(3):
            after[first + i, first + i] += step[4]
            after[first + i, at + i] += step[5]
            after[at + i, first + i] += step[5]
            after[at + i, at + i] += step[6]
            after[at + 3 + i, at + 3 + i] += step[9]
            for j in range(3):
                along = u[k, i] * u[k, j]
                one = 1.0 if i == j else 0.0
                after[first + 3 + i, first + 3 + j] += step[7] * (one - along) + step[10] * along
                after[first + 3 + i, at + 3 + j] += step[8] * turned[k, i, j]
                after[at + 3 + j, first + 3 + i] += step[8] * turned[k, i, j]
    for i in range(N_COMMON):
        after[seen - N_COMMON + i, seen - N_COMMON + i] += step[11]
    return p, m, v, w, after
