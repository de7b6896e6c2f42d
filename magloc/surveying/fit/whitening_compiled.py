"""Compiled loops of :mod:`magloc.surveying.fit.whitening`; tests hold them to whole covariances and to the dipole."""

from __future__ import annotations

import math

import numpy as np

from arrays.typing import FloatArray, IntArray
from magloc.compilation import compiled
from magloc.fields.dipole_compiled import field_matrix_components, gradient_components


@compiled
def gains_of(H: FloatArray, kept: FloatArray, added: FloatArray, dt: FloatArray, start: FloatArray) -> FloatArray:
    """Kalman gains, and 1/σ of every innovation behind them, (n, k, S + 1).

    Of measurements H (n, k, S) of unit noise, one after the other; what is kept of states and added to their variances
    in every step, (n, S) each, and their variances before the first one, (S,).
    """
    n, k, S = H.shape
    out = np.empty((n, k, S + 1))
    P = np.diag(start)
    v = np.empty(S)
    for i in range(n):
        for a in range(S):
            for b in range(S):
                P[a, b] *= kept[i, a] * kept[i, b]
        # The last two states are a value and its slope.
        if S >= 2:
            for b in range(S):
                P[S - 2, b] += dt[i] * P[S - 1, b]
            for a in range(S):
                P[a, S - 2] += dt[i] * P[a, S - 1]
        for a in range(S):
            P[a, a] += added[i, a]
        for j in range(k):
            variance = 1.0
            for a in range(S):
                t = 0.0
                for b in range(S):
                    t += P[a, b] * H[i, j, b]
                v[a] = t
                variance += t * H[i, j, a]
            for a in range(S):
                out[i, j, a] = v[a] / variance
                for b in range(S):
                    P[a, b] -= v[a] * v[b] / variance
            out[i, j, S] = 1.0 / math.sqrt(variance)
    return out


@compiled
def whiten(Y: FloatArray, rows: IntArray, H: FloatArray, gains: FloatArray, kept: FloatArray, dt: FloatArray) -> None:
    """Innovations over their deviation, in place, of columns (g, k, m) at some rows; at the others they are zero."""
    g, k, m = Y.shape
    S = H.shape[2]
    mean, share = np.zeros((S, m)), np.ones(S)
    last = -1
    for n in range(g):
        i = rows[n]
        share[:] = 1.0
        passed = 0.0
        for between in range(last + 1, i + 1):
            passed += dt[between]
            for a in range(S):
                share[a] *= kept[between, a]
        last = i
        for a in range(S):
            if share[a] != 1.0:
                for c in range(m):
                    mean[a, c] *= share[a]
        if S >= 2:
            for c in range(m):
                mean[S - 2, c] += passed * mean[S - 1, c]
        for j in range(k):
            row = Y[n, j]
            for a in range(S):
                h = H[i, j, a]
                if h != 0.0:
                    for c in range(m):
                        row[c] -= h * mean[a, c]
            for a in range(S):
                gain = gains[i, j, a]
                for c in range(m):
                    mean[a, c] += gain * row[c]
            for c in range(m):
                row[c] *= gains[i, j, S]


@compiled
def moment_columns(
    sensors: FloatArray,
    directions: FloatArray,
    U: FloatArray,
    channel_sensor: IntArray,
    places: FloatArray,
    starts: IntArray,
    rows: IntArray,
) -> FloatArray:
    """What moments of unit x, y and z at places (m, 3) add to measurements of some groups of rows: (g, k, 3 m)."""
    C, k, m = directions.shape[1], len(U), len(places)
    out = np.zeros((len(rows), k, 3 * m))
    px, py, pz = places[:, 0].copy(), places[:, 1].copy(), places[:, 2].copy()
    fx, fy, fz = np.empty(m), np.empty(m), np.empty(m)
    for n in range(len(rows)):
        first, end = starts[rows[n]], starts[rows[n] + 1]
        scale = 1e-7 / math.sqrt(end - first)
        for i in range(first, end):
            for c in range(C):
                s = sensors[i, channel_sensor[c]]
                u0, u1, u2 = directions[i, c, 0], directions[i, c, 1], directions[i, c, 2]
                for q in range(m):
                    x, y, z = s[0] - px[q], s[1] - py[q], s[2] - pz[q]
                    inverse = 1.0 / (x * x + y * y + z * z)
                    size = scale * inverse * math.sqrt(inverse)
                    along = 3.0 * (u0 * x + u1 * y + u2 * z) * inverse
                    fx[q], fy[q], fz[q] = size * (along * x - u0), size * (along * y - u1), size * (along * z - u2)
                for j in range(k):
                    if U[j, c] != 0.0:
                        row = out[n, j]
                        for q in range(m):
                            row[q] += U[j, c] * fx[q]
                            row[m + q] += U[j, c] * fy[q]
                            row[2 * m + q] += U[j, c] * fz[q]
    return out


@compiled
def source_columns(
    sensors: FloatArray,
    directions: FloatArray,
    U: FloatArray,
    channel_sensor: IntArray,
    positions: FloatArray,
    moments: FloatArray,
    starts: IntArray,
) -> FloatArray:
    """Derivatives of the measurements of all groups by positions and moments of sources: (g, k, 6 K)."""
    C, k, K = directions.shape[1], len(U), len(positions)
    out = np.zeros((len(starts) - 1, k, 6 * K))
    of_channel = np.empty(6)
    for n in range(len(starts) - 1):
        first, end = starts[n], starts[n + 1]
        scale = 1.0 / math.sqrt(end - first)
        for i in range(first, end):
            for c in range(C):
                s, u = sensors[i, channel_sensor[c]], directions[i, c]
                for q in range(K):
                    dx, dy, dz = s[0] - positions[q, 0], s[1] - positions[q, 1], s[2] - positions[q, 2]
                    xx, xy, xz, yy, yz, zz = gradient_components(
                        dx, dy, dz, moments[q, 0], moments[q, 1], moments[q, 2]
                    )
                    of_channel[0] = -(xx * u[0] + xy * u[1] + xz * u[2])
                    of_channel[1] = -(xy * u[0] + yy * u[1] + yz * u[2])
                    of_channel[2] = -(xz * u[0] + yz * u[1] + zz * u[2])
                    xx, xy, xz, yy, yz, zz = field_matrix_components(dx, dy, dz)
                    of_channel[3] = xx * u[0] + xy * u[1] + xz * u[2]
                    of_channel[4] = xy * u[0] + yy * u[1] + yz * u[2]
                    of_channel[5] = xz * u[0] + yz * u[1] + zz * u[2]
                    for j in range(k):
                        if U[j, c] != 0.0:
                            for a in range(6):
                                out[n, j, 6 * q + a] += scale * U[j, c] * of_channel[a]
    return out


@compiled
def pole_columns(
    sensors: FloatArray,
    directions: FloatArray,
    U: FloatArray,
    channel_sensor: IntArray,
    poles: FloatArray,
    starts: IntArray,
) -> FloatArray:
    """What unit poles (P, 3), whose field is away/|away|³, add to the measurements of all groups: (g, k, P)."""
    C, k, P = directions.shape[1], len(U), len(poles)
    out = np.zeros((len(starts) - 1, k, P))
    seen = np.empty(P)
    for n in range(len(starts) - 1):
        first, end = starts[n], starts[n + 1]
        scale = 1.0 / math.sqrt(end - first)
        for i in range(first, end):
            for c in range(C):
                s = sensors[i, channel_sensor[c]]
                u0, u1, u2 = scale * directions[i, c, 0], scale * directions[i, c, 1], scale * directions[i, c, 2]
                for p in range(P):
                    x, y, z = s[0] - poles[p, 0], s[1] - poles[p, 1], s[2] - poles[p, 2]
                    square = x * x + y * y + z * z
                    seen[p] = (u0 * x + u1 * y + u2 * z) / (square * math.sqrt(square))
                for j in range(k):
                    if U[j, c] != 0.0:
                        for p in range(P):
                            out[n, j, p] += U[j, c] * seen[p]
    return out
