"""The compiled iteration of a joint update; its readable twin is `iterated` in the tests of the update."""

from __future__ import annotations

import math

import numpy as np

from arrays.typing import FloatArray, IntArray
from magloc.compilation import compiled
from magloc.fields.dipole_compiled import field_components, field_matrix_components, gradient_components
from magloc.linalg_compiled import put, put_rows
from magloc.tracking.multi_target.state import N_COMMON, N_SEEN

_TOLERANCE, _MOST_ITERATIONS = 0.02, 60


@compiled
def _move_moment(m: FloatArray, c: FloatArray, moved: FloatArray, D: FloatArray) -> None:
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


@compiled
def _fill_rows(
    position: FloatArray, moment: FloatArray, D: FloatArray, at: FloatArray, field: FloatArray, rows: FloatArray
) -> None:
    """Field (3,) of all sources at a sensor, and its derivatives (3, d) by the errors."""
    field[:] = 0.0
    for k in range(len(position)):
        dx, dy, dz = at[0] - position[k, 0], at[1] - position[k, 1], at[2] - position[k, 2]
        mx, my, mz = moment[k, 0], moment[k, 1], moment[k, 2]
        gxx, gxy, gxz, gyy, gyz, gzz = gradient_components(dx, dy, dz, mx, my, mz)
        xx, xy, xz, yy, yz, zz = field_matrix_components(dx, dy, dz)
        field[0] += xx * mx + xy * my + xz * mz
        field[1] += xy * mx + yy * my + yz * mz
        field[2] += xz * mx + yz * my + zz * mz
        first = N_SEEN * k
        rows[0, first], rows[0, first + 1], rows[0, first + 2] = -gxx, -gxy, -gxz
        rows[1, first], rows[1, first + 1], rows[1, first + 2] = -gxy, -gyy, -gyz
        rows[2, first], rows[2, first + 1], rows[2, first + 2] = -gxz, -gyz, -gzz
        for j in range(3):
            a, b, c = D[k, 0, j], D[k, 1, j], D[k, 2, j]
            rows[0, first + 3 + j] = xx * a + xy * b + xz * c
            rows[1, first + 3 + j] = xy * a + yy * b + yz * c
            rows[2, first + 3 + j] = xz * a + yz * b + zz * c


@compiled
def _linearise(
    position: FloatArray,
    moment: FloatArray,
    common: FloatArray,
    D: FloatArray,
    L: FloatArray,
    positions: FloatArray,
    gain: FloatArray,
    channel_sensor: IntArray,
    r: FloatArray,
    HL: FloatArray,
) -> None:
    """Subtract what a state predicts from r (C,), and fill HL (C, d)."""
    n, d = len(positions), len(L)
    fields, by_y = np.empty((n, 3)), np.zeros((n, 3, d))
    rows = np.zeros((3, d))
    for i in range(3):
        rows[i, d - N_COMMON + i] = 1.0
    for s in range(n):
        _fill_rows(position, moment, D, positions[s], fields[s], rows)
        for i in range(3):
            fields[s, i] += common[i]
            for j in range(d):
                t = rows[i, j]
                for k in range(j + 1):
                    by_y[s, i, k] += t * L[j, k]
    for c in range(len(r)):
        s = channel_sensor[c]
        x, y, z = gain[c, 0], gain[c, 1], gain[c, 2]
        r[c] -= x * fields[s, 0] + y * fields[s, 1] + z * fields[s, 2]
        for k in range(d):
            HL[c, k] = x * by_y[s, 0, k] + y * by_y[s, 1, k] + z * by_y[s, 2, k]


@compiled
def _fill_root(HL: FloatArray, R: FloatArray) -> None:
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


@compiled
def _solve(R: FloatArray, b: FloatArray) -> None:
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


@compiled
def over_root(rows: FloatArray, root: FloatArray) -> FloatArray:
    """Rows (n, d) times the inverse of a lower root's transpose: with root rootᵀ = A, a root of rows A⁻¹ rowsᵀ."""
    n, d = rows.shape
    found = np.empty((n, d))
    for r in range(n):
        for i in range(d):
            t = rows[r, i]
            for k in range(i):
                t -= root[i, k] * found[r, k]
            found[r, i] = t / root[i, i]
    return found


@compiled
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
) -> tuple[float, bool]:
    """Fill y (d,), residuals (2, C) and HL (2, C, d) at the prediction and the end, R (d, d); cost, converged."""
    position, moment, common = state
    z, gain, positions, channel_sensor = row
    d = y.size
    p, m, b, D = np.empty_like(position), np.empty_like(moment), np.empty(3), np.empty((len(position), 3, 3))
    error, new, trial, step = np.empty(d), np.empty(d), np.zeros(d), np.empty(d)
    r, HL, along = np.empty_like(z), HLs[1], np.empty_like(z)
    scratch = np.empty_like(HL)
    best = math.inf
    for _ in range(_MOST_ITERATIONS):
        for i in range(d):
            t = 0.0
            for k in range(i + 1):
                t += L[i, k] * trial[k]
            error[i] = t
        for k in range(len(p)):
            for i in range(3):
                p[k, i] = position[k, i] + error[N_SEEN * k + i]
            _move_moment(moment[k], error[N_SEEN * k + 3 : N_SEEN * k + 6], m[k], D[k])
        for i in range(3):
            b[i] = common[i] + error[d - N_COMMON + i]
        put(r, z)
        _linearise(p, m, b, D, L, positions, gain, channel_sensor, r, scratch)
        cost = 0.0
        for c in range(r.size):
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
        if best == math.inf:
            put(residuals[0], r)
            put_rows(HLs[0], scratch)
        best = cost
        put(y, trial)
        put(residuals[1], r)
        put_rows(HL, scratch)
        _fill_root(HL, R)
        _along(HL, y, along)
        new[:] = 0.0
        for c in range(r.size):
            t = r[c] + along[c]
            for k in range(d):
                new[k] += HL[c, k] * t
        _solve(R, new)
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
def _read(
    state: tuple[FloatArray, FloatArray, FloatArray],
    error: FloatArray,
    row: tuple[FloatArray, FloatArray, FloatArray, IntArray],
    h: FloatArray,
) -> None:
    """What a state reads (C,) at an error (d,) of it."""
    position, moment, common = state
    _, gain, positions, channel_sensor = row
    m, D, fields = np.empty_like(moment), np.empty((3, 3)), np.empty_like(positions)
    for s in range(len(positions)):
        put(fields[s], common)
    for k in range(len(position)):
        first = N_SEEN * k
        _move_moment(moment[k], error[first + 3 : first + N_SEEN], m[k], D)
        for s in range(len(positions)):
            x, y, z = field_components(
                positions[s, 0] - position[k, 0] - error[first],
                positions[s, 1] - position[k, 1] - error[first + 1],
                positions[s, 2] - position[k, 2] - error[first + 2],
                m[k, 0],
                m[k, 1],
                m[k, 2],
            )
            fields[s, 0] += x
            fields[s, 1] += y
            fields[s, 2] += z
    for c in range(h.size):
        s = channel_sensor[c]
        h[c] = gain[c, 0] * fields[s, 0] + gain[c, 1] * fields[s, 1] + gain[c, 2] * fields[s, 2]


@compiled
def fill_bends(
    state: tuple[FloatArray, FloatArray, FloatArray],
    row: tuple[FloatArray, FloatArray, FloatArray, IntArray],
    errors: FloatArray,
    bends: FloatArray,
) -> None:
    """How far (n,) readings bend along errors (n, d): the length of their second difference, halved."""
    n = len(row[0])
    at, ahead, behind, none = np.empty(n), np.empty(n), np.empty(n), np.zeros(errors.shape[1])
    _read(state, none, row, at)
    for i in range(len(errors)):
        _read(state, errors[i], row, ahead)
        _read(state, -errors[i], row, behind)
        square = 0.0
        for c in range(n):
            t = 0.5 * (ahead[c] + behind[c]) - at[c]
            square += t * t
        bends[i] = math.sqrt(square)
