"""One pass of Gauss and Newton's iteration over all rows of a young joint track, compiled.

A filter and Bryson and Frazier's smoother, both linearised along a trajectory, in the charts about it. The tests hold
it to a general minimiser of the rows' whole sum of squares.
"""

from __future__ import annotations

import math

import numpy as np

from arrays.typing import FloatArray, IntArray
from magloc.compilation import compiled, internal
from magloc.linalg_compiled import put, put_rows
from magloc.tracking.multi_target.motion_compiled import fill_transition, move_rows, step_all
from magloc.tracking.multi_target.state import N_COMMON, N_SEEN
from magloc.tracking.multi_target.update_compiled import (
    fill_posterior,
    fill_root,
    linearise,
    move_moment,
    read,
    solve_root,
)

Means = tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]


@internal
def _fill_chart(m: FloatArray, other: FloatArray, c: FloatArray, T: FloatArray) -> None:
    """Coordinates c (3,) of another moment in the chart about one, and what a small error there is in its own."""
    length, size, cosine = 0.0, 0.0, 0.0
    for i in range(3):
        length += m[i] * m[i]
        size += other[i] * other[i]
        cosine += m[i] * other[i]
    length, size = math.sqrt(length), math.sqrt(size)
    cosine /= length * size
    square = 0.0
    for i in range(3):
        c[i] = other[i] / size - cosine * m[i] / length
        square += c[i] * c[i]
    sine = math.sqrt(square)
    per = math.atan2(sine, cosine) / sine if sine > 0.0 else 1.0
    strength = math.log(size / length)
    for i in range(3):
        c[i] = per * c[i] + strength * m[i] / length
    moved = np.empty(3)
    move_moment(m, c, moved, T)
    for i in range(3):
        for j in range(3):
            T[i, j] /= size


@internal
def _to_chart(track: Means, row: int, other: Means, T: FloatArray, delta: FloatArray, P: FloatArray) -> None:
    """Errors (n,) and covariance (n, n) about a state become those about a trajectory's row; T (K, 3, 3) of moments.

    They are Gaussian in the chart about the state.
    """
    K, n = len(other[0]), delta.size
    c, old = np.empty(3), np.empty(3)
    motion = N_SEEN * K + N_COMMON
    for k in range(K):
        at, t = N_SEEN * k + 3, T[k]
        _fill_chart(other[1][k], track[1][row, k], c, t)
        for i in range(3):
            old[i] = delta[at + i] - c[i]
            delta[at - 3 + i] += other[0][k, i] - track[0][row, k, i]
            delta[motion + 6 * k + i] += other[2][k, i] - track[2][row, k, i]
            delta[motion + 6 * k + 3 + i] += other[3][k, i] - track[3][row, k, i]
        for i in range(3):
            delta[at + i] = t[i, 0] * old[0] + t[i, 1] * old[1] + t[i, 2] * old[2]
        for j in range(n):
            for i in range(3):
                old[i] = P[at + i, j]
            for i in range(3):
                P[at + i, j] = t[i, 0] * old[0] + t[i, 1] * old[1] + t[i, 2] * old[2]
        for j in range(n):
            for i in range(3):
                old[i] = P[j, at + i]
            for i in range(3):
                P[j, at + i] = t[i, 0] * old[0] + t[i, 1] * old[1] + t[i, 2] * old[2]
    for i in range(N_COMMON):
        delta[N_SEEN * K + i] += other[4][i] - track[4][row, i]


@internal
def _fill_cholesky(P: FloatArray, L: FloatArray) -> None:
    """Lower root of the leading block of a covariance."""
    for i in range(len(L)):
        for j in range(i + 1):
            t = P[i, j]
            for k in range(j):
                t -= L[i, k] * L[j, k]
            L[i, j] = math.sqrt(t) if i == j else t / L[j, j]


@internal
def _solve_lower(L: FloatArray, b: FloatArray) -> None:
    """Solve L x = b in place."""
    for i in range(len(L)):
        for k in range(i):
            b[i] -= L[i, k] * b[k]
        b[i] /= L[i, i]


@internal
def _solve_transposed(L: FloatArray, b: FloatArray) -> None:
    """Solve Lᵀ x = b in place."""
    for i in range(len(L) - 1, -1, -1):
        b[i] /= L[i, i]
        for k in range(i):
            b[k] -= L[i, k] * b[i]


@compiled
def smooth(
    track: Means,
    prior: Means,
    P: FloatArray,
    steps: FloatArray,
    rows: tuple[FloatArray, FloatArray, FloatArray, IntArray],
    offsets: FloatArray,
    last: FloatArray,
) -> tuple[float, float]:
    """Fill offsets (m, n) of a trajectory towards the smoothed one, and the covariance (n, n) at its end.

    Returned are χ² of all rows, and the logarithm of the volume: their likelihood is that of successive updates.
    """
    z, gain, positions, channel_sensor = rows
    m, n, K, C = len(z), len(P), len(prior[0]), z.shape[1]
    d = N_SEEN * K + N_COMMON
    T, D = np.empty((m, K, 3, 3)), np.zeros((K, 3, 3))
    Ps, Ls, Rs, ys = np.empty((m, n, n)), np.zeros((m, d, d)), np.empty((m, d, d)), np.zeros((m, d))
    delta, r, HL, h, t_d = np.zeros(n), np.empty(C), np.empty((C, d)), np.empty(C), np.empty(d)
    cost, log_volume = 0.0, 0.0
    column, ahead = np.empty((n, 1)), np.empty(3)
    turns, by_rate = np.empty((m, K, 3, 3)), np.empty((m, K, 3, 3))
    for row in range(m):
        if row == 0:
            put_rows(Ps[0], P)
            _to_chart(track, 0, prior, T[0], delta, Ps[0])
        else:
            before = track[0][row - 1], track[1][row - 1], track[2][row - 1], track[3][row - 1]
            p, mo, v, w, moved = step_all(before, last, steps[row])
            for i in range(n):
                column[i, 0] = delta[i]
            for k in range(K):
                rate, moment = track[3][row - 1, k], track[1][row - 1, k]
                fill_transition(rate, moment, steps[row], ahead, turns[row, k], by_rate[row, k])
                move_rows(column, k, d + 6 * k, steps[row], turns[row, k], by_rate[row, k])
            for i in range(n):
                delta[i] = column[i, 0]
            put_rows(Ps[row], moved)
            _to_chart(track, row, (p, mo, v, w, track[4][row - 1]), T[row], delta, Ps[row])
        put(offsets[row], delta)
        _fill_cholesky(Ps[row], Ls[row])
        for k in range(K):
            length = math.sqrt(track[1][row, k, 0] ** 2 + track[1][row, k, 1] ** 2 + track[1][row, k, 2] ** 2)
            for i in range(3):
                D[k, i, i] = length
        here = z[row], gain[row], positions[row], channel_sensor
        read(track[0][row], track[1][row], track[4][row], here, h)
        linearise(track[0][row], track[1][row], D, Ls[row], here, HL)
        put(t_d, delta[:d])
        _solve_lower(Ls[row], t_d)
        for c in range(C):
            t = z[row, c] - h[c]
            for k in range(d):
                t -= HL[c, k] * t_d[k]
            r[c] = t
            cost += t * t
        fill_root(HL, Rs[row])
        y = ys[row]
        for c in range(C):
            for k in range(d):
                y[k] += HL[c, k] * r[c]
        put(t_d, y)
        solve_root(Rs[row], y)
        for k in range(d):
            cost -= t_d[k] * y[k]
            log_volume += 2.0 * math.log(Rs[row, k, k])
        fill_posterior(Ps[row], Ls[row], Rs[row], y, delta, last)
    slope, new, q = np.zeros(n), np.empty(n), np.empty(d)
    for row in range(m - 1, -1, -1):
        for i in range(d):
            t = 0.0
            for j in range(n):
                t += Ps[row, i, j] * slope[j]
            q[i] = t
        _solve_lower(Ls[row], q)
        put(t_d, q)
        solve_root(Rs[row], t_d)
        for k in range(d):
            q[k] += ys[row, k] - t_d[k]
        _solve_transposed(Ls[row], q)
        for k in range(d):
            slope[k] -= q[k]
        for i in range(n):
            t = 0.0
            for j in range(n):
                t += Ps[row, i, j] * slope[j]
            offsets[row, i] -= t
        if row:
            _transpose_step(slope, new, K, T[row], steps[row], turns[row], by_rate[row])
    return cost, log_volume


@internal
def _transpose_step(
    slope: FloatArray, new: FloatArray, K: int, T: FloatArray, step: FloatArray, R: FloatArray, M: FloatArray
) -> None:
    """A gradient (n,) by a row's errors becomes one by those of the row before, in place."""
    motion = N_SEEN * K + N_COMMON
    put(new, slope)
    c = np.empty(3)
    for k in range(K):
        at, rate = N_SEEN * k, motion + 6 * k
        for i in range(3):
            c[i] = T[k, 0, i] * slope[at + 3] + T[k, 1, i] * slope[at + 4] + T[k, 2, i] * slope[at + 5]
        for i in range(3):
            new[at + 3 + i] = R[k, 0, i] * c[0] + R[k, 1, i] * c[1] + R[k, 2, i] * c[2]
            new[rate + i] = step[1] * slope[rate + i] + step[0] * slope[at + i]
            turned = M[k, 0, i] * c[0] + M[k, 1, i] * c[1] + M[k, 2, i] * c[2]
            new[rate + 3 + i] = step[3] * slope[rate + 3 + i] + turned
    put(slope, new)
