"""The compiled iteration of a joint update; its readable twin is `iterated` in the tests of the update."""

from __future__ import annotations

import math

import numpy as np

from arrays.typing import FloatArray, IntArray
from magloc.compilation import compiled, internal
from magloc.fields.dipole_compiled import field_components, field_matrix_components, gradient_components
from magloc.linalg_compiled import put, put_rows
from magloc.tracking.multi_target.state import N_COMMON, N_SEEN

_TOLERANCE = 0.02


@internal
def move_moment(m: FloatArray, c: FloatArray, moved: FloatArray, D: FloatArray) -> None:
    """A moment at an error c, and its derivative D (3, 3) by it; twins: ``moved_moment`` and its derivative."""
    u, turn = np.empty(3), np.empty(3)
    length = math.sqrt(m[0] * m[0] + m[1] * m[1] + m[2] * m[2])
    along, square = 0.0, 0.0
    for i in range(3):
        u[i] = m[i] / length
        along += u[i] * c[i]
    for i in range(3):
        turn[i] = c[i] - along * u[i]
        square += turn[i] * turn[i]
    angle = math.sqrt(square)
    cosine, sinc, bend = math.cos(angle), 1.0 - square / 6.0, square / 30.0 - 1.0 / 3.0
    if angle > 1e-2:
        sinc = math.sin(angle) / angle
        bend = (cosine - sinc) / square
    strength = length * math.exp(along)
    for i in range(3):
        direction = cosine * u[i] + sinc * turn[i]
        moved[i] = strength * direction
        for j in range(3):
            # By the turn, which has no part along u; that the angle grows with it bends the path.
            by_turn = (sinc if i == j else 0.0) - (sinc * u[i] - bend * turn[i]) * turn[j] - sinc * u[i] * u[j]
            D[i, j] = strength * (direction * u[j] + by_turn)


@internal
def _fill_rows(position: FloatArray, moment: FloatArray, D: FloatArray, at: FloatArray, rows: FloatArray) -> None:
    """Derivatives (3, d) of the field at a sensor by the errors of all sources."""
    for k in range(len(position)):
        dx, dy, dz = at[0] - position[k, 0], at[1] - position[k, 1], at[2] - position[k, 2]
        gxx, gxy, gxz, gyy, gyz, gzz = gradient_components(dx, dy, dz, moment[k, 0], moment[k, 1], moment[k, 2])
        xx, xy, xz, yy, yz, zz = field_matrix_components(dx, dy, dz)
        first = N_SEEN * k
        rows[0, first], rows[0, first + 1], rows[0, first + 2] = -gxx, -gxy, -gxz
        rows[1, first], rows[1, first + 1], rows[1, first + 2] = -gxy, -gyy, -gyz
        rows[2, first], rows[2, first + 1], rows[2, first + 2] = -gxz, -gyz, -gzz
        for j in range(3):
            a, b, c = D[k, 0, j], D[k, 1, j], D[k, 2, j]
            rows[0, first + 3 + j] = xx * a + xy * b + xz * c
            rows[1, first + 3 + j] = xy * a + yy * b + yz * c
            rows[2, first + 3 + j] = xz * a + yz * b + zz * c


@internal
def linearise(
    position: FloatArray,
    moment: FloatArray,
    D: FloatArray,
    L: FloatArray,
    row: tuple[FloatArray, FloatArray, FloatArray, IntArray],
    HL: FloatArray,
) -> None:
    """Fill HL (C, d) at a state."""
    _, gain, positions, channel_sensor = row
    n, d = len(positions), len(L)
    by_y, rows = np.zeros((n, 3, d)), np.zeros((3, d))
    for i in range(3):
        rows[i, d - N_COMMON + i] = 1.0
    for s in range(n):
        _fill_rows(position, moment, D, positions[s], rows)
        for i in range(3):
            for j in range(d):
                t = rows[i, j]
                for k in range(j + 1):
                    by_y[s, i, k] += t * L[j, k]
    for c in range(len(HL)):
        s = channel_sensor[c]
        x, y, z = gain[c, 0], gain[c, 1], gain[c, 2]
        for k in range(d):
            HL[c, k] = x * by_y[s, 0, k] + y * by_y[s, 1, k] + z * by_y[s, 2, k]


@internal
def read(
    position: FloatArray,
    moment: FloatArray,
    common: FloatArray,
    row: tuple[FloatArray, FloatArray, FloatArray, IntArray],
    h: FloatArray,
) -> None:
    """What a state reads (C,)."""
    _, gain, positions, channel_sensor = row
    fields = np.empty_like(positions)
    for s in range(len(positions)):
        put(fields[s], common)
        for k in range(len(position)):
            x, y, z = field_components(
                positions[s, 0] - position[k, 0],
                positions[s, 1] - position[k, 1],
                positions[s, 2] - position[k, 2],
                moment[k, 0],
                moment[k, 1],
                moment[k, 2],
            )
            fields[s, 0] += x
            fields[s, 1] += y
            fields[s, 2] += z
    for c in range(h.size):
        s = channel_sensor[c]
        h[c] = gain[c, 0] * fields[s, 0] + gain[c, 1] * fields[s, 1] + gain[c, 2] * fields[s, 2]


@internal
def _move(
    state: tuple[FloatArray, FloatArray, FloatArray],
    error: FloatArray,
    p: FloatArray,
    m: FloatArray,
    b: FloatArray,
    D: FloatArray,
) -> None:
    """Places, moments and common field that an error (d,) leads to, and the derivatives D (K, 3, 3) of the moments."""
    position, moment, common = state
    for k in range(len(p)):
        first = N_SEEN * k
        for i in range(3):
            p[k, i] = position[k, i] + error[first + i]
        move_moment(moment[k], error[first + 3 : first + N_SEEN], m[k], D[k])
    for i in range(N_COMMON):
        b[i] = common[i] + error[N_SEEN * len(p) + i]


@internal
def fill_root(HL: FloatArray, R: FloatArray) -> None:
    """Lower root R of I + HLᵀ HL."""
    d = len(R)
    for i in range(d):
        for j in range(d):
            R[i, j] = 1.0 if i == j else 0.0
    for c in range(len(HL)):
        for i in range(d):
            t = HL[c, i]
            for j in range(i + 1):
                R[i, j] += t * HL[c, j]
    for i in range(d):
        for j in range(i):
            t = R[i, j]
            for k in range(j):
                t -= R[i, k] * R[j, k]
            R[i, j] = t / R[j, j]
        t = R[i, i]
        for k in range(i):
            t -= R[i, k] * R[i, k]
        R[i, i] = math.sqrt(t)


@internal
def solve_root(R: FloatArray, b: FloatArray) -> None:
    """Solve R Rᵀ y = b in place."""
    d = len(R)
    for i in range(d):
        for k in range(i):
            b[i] -= R[i, k] * b[k]
        b[i] /= R[i, i]
    for i in range(d - 1, -1, -1):
        b[i] /= R[i, i]
        for k in range(i):
            b[k] -= R[i, k] * b[i]


@internal
def _over_root(columns: FloatArray, first: int, root: FloatArray) -> None:
    """Columns (d, n), from one on, over a lower root in place: with root rootᵀ = A, roots of columnsᵀ A⁻¹ columns."""
    d, n = columns.shape
    for i in range(d):
        for k in range(i):
            t = root[i, k]
            for r in range(first, n):
                columns[i, r] -= t * columns[k, r]
        t = 1.0 / root[i, i]
        for r in range(first, n):
            columns[i, r] *= t


@internal
def _add_square(columns: FloatArray, first: int, sign: float, P: FloatArray) -> None:
    """Add columnsᵀ columns, from one column on, to the same rows and columns of P, in its lower triangle."""
    for k in range(len(columns)):
        for i in range(first, columns.shape[1]):
            t = sign * columns[k, i]
            for j in range(first, i + 1):
                P[i, j] += t * columns[k, j]


@internal
def fill_posterior(
    P: FloatArray, L: FloatArray, R: FloatArray, y: FloatArray, error: FloatArray, after: FloatArray
) -> None:
    """Add to an error (n,) what a row tells of it, and fill the covariance (n, n) after the row."""
    n, d = len(P), len(L)
    W = np.zeros((d, n))
    for k in range(d):
        for i in range(k, d):
            W[k, i] = L[i, k]
        for i in range(d, n):
            W[k, i] = P[i, k]
    _over_root(W, d, L)
    for k in range(d):
        for i in range(n):
            error[i] += y[k] * W[k, i]
    after[:] = 0.0
    for i in range(d, n):
        for j in range(d, i + 1):
            after[i, j] = P[i, j]
    _add_square(W, d, -1.0, after)
    _over_root(W, 0, R)
    _add_square(W, 0, 1.0, after)
    for i in range(n):
        for j in range(i):
            after[j, i] = after[i, j]


@compiled
def posterior(
    P: FloatArray, L: FloatArray, R: FloatArray, y: FloatArray, moment: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Error (n,) of the state, moments there (K, 3), and its covariance (n, n) in the chart there."""
    n, error = len(P), np.zeros(len(P))
    after = np.empty((n, n))
    fill_posterior(P, L, R, y, error, after)
    moved, D, old = np.empty_like(moment), np.empty((3, 3)), np.empty(3)
    for k in range(len(moment)):
        c = N_SEEN * k + 3
        move_moment(moment[k], error[c : c + 3], moved[k], D)
        length = math.sqrt(moved[k, 0] ** 2 + moved[k, 1] ** 2 + moved[k, 2] ** 2)
        for by_rows in range(2):
            for j in range(n):
                for i in range(3):
                    old[i] = after[c + i, j] if by_rows == 0 else after[j, c + i]
                for i in range(3):
                    t = (D[i, 0] * old[0] + D[i, 1] * old[1] + D[i, 2] * old[2]) / length
                    if by_rows == 0:
                        after[c + i, j] = t
                    else:
                        after[j, c + i] = t
    return error, moved, after


@compiled
def fill_standardised(HL: FloatArray, R: FloatArray, residual: FloatArray, followed: float, found: FloatArray) -> None:
    """Residuals (N, 3) of three channels each with unit covariance I - A P⁺ Aᵀ, A P⁺ Aᵀ = HL (R Rᵀ)⁻¹ HLᵀ."""
    n, d = HL.shape
    seen, C = np.empty((d, n)), np.empty((3, 3))
    for c in range(n):
        for k in range(d):
            seen[k, c] = HL[c, k]
    _over_root(seen, 0, R)
    for s in range(len(found)):
        for i in range(3):
            for j in range(i + 1):
                t = 0.0
                for k in range(d):
                    t += seen[k, 3 * s + i] * seen[k, 3 * s + j]
                C[i, j] = (1.0 + followed if i == j else 0.0) - t
        for i in range(3):
            left = residual[3 * s + i]
            for j in range(i):
                t = C[i, j]
                for k in range(j):
                    t -= C[i, k] * C[j, k]
                C[i, j] = t / C[j, j]
                left -= C[i, j] * found[s, j]
            t = C[i, i]
            for k in range(i):
                t -= C[i, k] * C[i, k]
            C[i, i] = math.sqrt(t)
            found[s, i] = left / C[i, i]


@internal
def _along(HL: FloatArray, step: FloatArray, along: FloatArray) -> float:
    """Fill HL @ step (C,); its square."""
    square = 0.0
    for c in range(len(HL)):
        t = 0.0
        for k in range(step.size):
            t += HL[c, k] * step[k]
        along[c] = t
        square += t * t
    return square


@compiled
def iterate(
    state: tuple[FloatArray, FloatArray, FloatArray],
    L: FloatArray,
    row: tuple[FloatArray, FloatArray, FloatArray, IntArray],
    y: FloatArray,
    residuals: FloatArray,
    HLs: FloatArray,
    R: FloatArray,
    most: int,
) -> tuple[float, bool]:
    """Fill y (d,), residuals (2, C) and HL (2, C, d) at the prediction and the end, R (d, d); cost, converged."""
    z, (K, d), best = row[0], (len(state[0]), y.size), math.inf
    p, m, b, D = np.empty((K, 3)), np.empty((K, 3)), np.empty(3), np.empty((K, 3, 3))
    error, new, trial, step = np.empty(d), np.empty(d), np.zeros(d), np.empty(d)
    r, HL, along = np.empty_like(z), HLs[1], np.empty_like(z)
    for _ in range(most):
        for i in range(d):
            t = 0.0
            for k in range(i + 1):
                t += L[i, k] * trial[k]
            error[i] = t
        _move(state, error, p, m, b, D)
        read(p, m, b, row, r)
        cost = 0.0
        for c in range(r.size):
            r[c] = z[c] - r[c]
            cost += r[c] * r[c]
        for i in range(d):
            cost += trial[i] * trial[i]
        if not cost < best:
            if best == math.inf:  # a source stands on a sensor
                return best, False
            for i in range(d):
                step[i] = trial[i] - y[i]
            if cost <= best + _TOLERANCE or _along(HL, step, along) < _TOLERANCE:
                return best, True
            for i in range(d):
                trial[i] = y[i] + 0.4 * step[i]
            continue
        is_first, best = best == math.inf, cost
        put(y, trial)
        put(residuals[1], r)
        linearise(p, m, D, L, row, HL)
        if is_first:
            put(residuals[0], r)
            put_rows(HLs[0], HL)
        fill_root(HL, R)
        _along(HL, y, along)
        new[:] = 0.0
        for c in range(r.size):
            t = r[c] + along[c]
            for k in range(d):
                new[k] += HL[c, k] * t
        solve_root(R, new)
        for i in range(d):
            step[i] = new[i] - y[i]
        if _along(HL, step, along) < _TOLERANCE:
            put(y, new)
            best = 0.0
            for c in range(r.size):
                residuals[1, c] = r[c] - along[c]
                best += residuals[1, c] * residuals[1, c]
            for i in range(d):
                best += y[i] * y[i]
            return best, True
        put(trial, new)
    return best, False


@compiled
def fill_bends(
    state: tuple[FloatArray, FloatArray, FloatArray],
    row: tuple[FloatArray, FloatArray, FloatArray, IntArray],
    errors: FloatArray,
    bends: FloatArray,
) -> None:
    """How far (n,) readings bend along errors (n, d): the length of their second difference, halved."""
    n, K = len(row[0]), len(state[0])
    at, ahead, behind = np.empty(n), np.empty(n), np.empty(n)
    p, m, b, D = np.empty((K, 3)), np.empty((K, 3)), np.empty(3), np.empty((K, 3, 3))
    read(state[0], state[1], state[2], row, at)
    for i in range(len(errors)):
        _move(state, errors[i], p, m, b, D)
        read(p, m, b, row, ahead)
        _move(state, -errors[i], p, m, b, D)
        read(p, m, b, row, behind)
        square = 0.0
        for c in range(n):
            t = 0.5 * (ahead[c] + behind[c]) - at[c]
            square += t * t
        bends[i] = math.sqrt(square)
