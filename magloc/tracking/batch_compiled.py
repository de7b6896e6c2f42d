"""The tracker's steps over many rows, the twin of :meth:`magloc.tracking.tracker.Tracker.update` for one component.

A state of n numbers begins with position and moment, and the velocity where there is one. Every row has a transition F,
and a square root of its noise in two parts, ``S_q = A + |m| B``; its readings are whitened differences, padded to k
with rows that are zero.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from arrays.typing import FloatArray
from magloc.compilation import compiled, internal
from magloc.fields.dipole import MU0_OVER_4PI
from magloc.kalman_compiled import triangular_root
from magloc.linalg_compiled import orthonormalise, put, put_rows
from magloc.tracking.chart.coordinates_compiled import fill_chart, into_chart, is_firm, move

IntArray = NDArray[np.int64]
TRACKED, PREDICTED = 0, 1


class Channels(NamedTuple):
    """The array: positions of the sensors, and sensor, kind and gain of every channel."""

    positions: FloatArray
    centroid: FloatArray
    sensor: NDArray[np.intp]
    is_scalar: NDArray[np.bool_]
    gain: FloatArray


class Rows(NamedTuple):
    """Whitened differences of every row, how they are formed, and the array's pose and ambient field."""

    z: FloatArray
    n_differences: IntArray
    transforms: FloatArray
    transform_of_row: IntArray
    origins: FloatArray
    rotations: FloatArray
    ambients: FloatArray
    ambient_of_row: IntArray


class Steps(NamedTuple):
    """Linear steps of the motion: transition F, noise ``A + |m| B``, and which of them leads to a row."""

    F: FloatArray
    A: FloatArray
    B: FloatArray
    of_row: IntArray


class Rules(NamedTuple):
    """When an update has converged, and when it is believed; see :mod:`magloc.tracking.chart.update` and `.tracker`."""

    nis_limits: FloatArray
    tolerance: float
    max_iterations: int
    rounding: float
    least_gain: float
    least_share: float
    firm: float
    full: int
    largest_growth: float
    largest_width: float
    radius: float


class Followed(NamedTuple):
    """Outputs of every row: state and root after and before its readings, and what became of them."""

    x: FloatArray
    S: FloatArray
    predicted_x: FloatArray
    predicted_S: FloatArray
    open_loop: FloatArray
    nis: FloatArray
    iterations: IntArray
    status: IntArray


class State(NamedTuple):
    """What is known between rows, changed in place: state, root in the chart about it, its centroid, open loop."""

    x: FloatArray
    S: FloatArray
    centroid: FloatArray
    open_loop: FloatArray


@internal
def _predicted(
    x: FloatArray,
    origin: FloatArray,
    R: FloatArray,
    ambient: FloatArray,
    array: Channels,
    transform: FloatArray,
    channels: FloatArray,
    slopes: FloatArray,
    predicted: FloatArray,
    H: FloatArray,
) -> None:
    """Whitened differences (k,) of a state, and their Jacobian (k, 6) with respect to position and moment."""
    positions, gain = array.positions, array.gain
    n_channels, k = array.sensor.size, predicted.size
    p0 = R[0, 0] * (x[0] - origin[0]) + R[1, 0] * (x[1] - origin[1]) + R[2, 0] * (x[2] - origin[2])
    p1 = R[0, 1] * (x[0] - origin[0]) + R[1, 1] * (x[1] - origin[1]) + R[2, 1] * (x[2] - origin[2])
    p2 = R[0, 2] * (x[0] - origin[0]) + R[1, 2] * (x[1] - origin[1]) + R[2, 2] * (x[2] - origin[2])
    m0 = R[0, 0] * x[3] + R[1, 0] * x[4] + R[2, 0] * x[5]
    m1 = R[0, 1] * x[3] + R[1, 1] * x[4] + R[2, 1] * x[5]
    m2 = R[0, 2] * x[3] + R[1, 2] * x[4] + R[2, 2] * x[5]
    for c in range(n_channels):
        s = array.sensor[c]
        d0, d1, d2 = positions[s, 0] - p0, positions[s, 1] - p1, positions[s, 2] - p2
        r2 = d0 * d0 + d1 * d1 + d2 * d2
        inverse = 1.0 / math.sqrt(r2)
        n0, n1, n2 = d0 * inverse, d1 * inverse, d2 * inverse
        scale = MU0_OVER_4PI * inverse * inverse * inverse
        nm = n0 * m0 + n1 * m1 + n2 * m2
        b0 = scale * (3.0 * nm * n0 - m0) + ambient[s, 0]
        b1 = scale * (3.0 * nm * n1 - m1) + ambient[s, 1]
        b2 = scale * (3.0 * nm * n2 - m2) + ambient[s, 2]
        g0, g1, g2 = gain[c, 0], gain[c, 1], gain[c, 2]
        if array.is_scalar[c]:
            modulus = math.sqrt(b0 * b0 + b1 * b1 + b2 * b2)
            channels[c] = g0 * modulus
            t = g0 / modulus if modulus > 0.0 else 0.0
            g0, g1, g2 = t * b0, t * b1, t * b2
        else:
            channels[c] = g0 * b0 + g1 * b1 + g2 * b2
        gn = g0 * n0 + g1 * n1 + g2 * n2
        gm = g0 * m0 + g1 * m1 + g2 * m2
        # dB/dp = -G, contracted with the gain; dB/dm is symmetric.
        steep = -3.0 * scale * inverse
        a = gm - 5.0 * nm * gn
        q0 = steep * (nm * g0 + gn * m0 + a * n0)
        q1 = steep * (nm * g1 + gn * m1 + a * n1)
        q2 = steep * (nm * g2 + gn * m2 + a * n2)
        u0, u1, u2 = scale * (3.0 * gn * n0 - g0), scale * (3.0 * gn * n1 - g1), scale * (3.0 * gn * n2 - g2)
        for i in range(3):
            slopes[c, i] = R[i, 0] * q0 + R[i, 1] * q1 + R[i, 2] * q2
            slopes[c, 3 + i] = R[i, 0] * u0 + R[i, 1] * u1 + R[i, 2] * u2
    predicted[:] = 0.0
    H[:] = 0.0
    for j in range(k):
        for c in range(n_channels):
            w = transform[j, c]
            if w != 0.0:
                predicted[j] += w * channels[c]
                for i in range(6):
                    H[j, i] += w * slopes[c, i]


@internal
def _product(A: FloatArray, B: FloatArray, AB: FloatArray) -> None:
    """AB (n, m) = A (n, p) B (p, m)."""
    for i in range(A.shape[0]):
        for c in range(B.shape[1]):
            t = 0.0
            for j in range(A.shape[1]):
                t += A[i, j] * B[j, c]
            AB[i, c] = t


@internal
def _widest(S: FloatArray) -> float:
    """Larger one of the standard deviations of log-range and direction."""
    widest = 0.0
    for i in range(3):
        t = 0.0
        for c in range(S.shape[1]):
            t += S[i, c] * S[i, c]
        widest = max(widest, t)
    return math.sqrt(widest)


@internal
def _grows(S: FloatArray, predicted_S: FloatArray, largest_growth: float) -> bool:
    """Whether a standard deviation of position and moment has grown by more than a factor."""
    for i in range(6):
        before, after = 0.0, 0.0
        for c in range(S.shape[1]):
            before += S[i, c] * S[i, c]
            after += predicted_S[i, c] * predicted_S[i, c]
        if after > largest_growth * largest_growth * before:
            return True
    return False


@compiled
def follow(
    begin: int,
    end: int,
    state: State,
    array: Channels,
    given: Rows,
    steps: Steps,
    rules: Rules,
    out: Followed,
) -> int:
    """Follow a track from a state before row begin, which is changed, to the first row that it does not explain.

    Returns that row, or end. Outputs of rows before it are filled.
    """
    x, S, centroid, open_loop = state
    n = x.size
    k, n_channels = given.transforms.shape[1], array.sensor.size
    n_noise = steps.A.shape[2]
    rows, product = np.empty((n, n + n_noise)), np.empty((n, n))
    frame, frame_there, centroid_there = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    x_before, S_before, L = np.empty(n), np.empty((n, n)), np.empty((n, n))
    zero, e, zeta, step = np.zeros(n), np.empty(n), np.empty(n), np.empty(n)
    M, bent = np.empty((n, k)), np.empty(k)
    H, h, h_first, h_there = np.empty((k, 6)), np.empty(k), np.empty(k), np.empty(k)
    channels, slopes = np.empty(n_channels), np.empty((n_channels, 6))
    J_e, J_first = np.empty((k, n)), np.empty((k, n))
    residual, residual_there = np.empty(k + n), np.empty(k + n)
    columns, triangle = np.empty((n + 1, k + n)), np.zeros((n + 1, n + 1))
    there, here, solution = np.empty(n), np.empty(n), np.empty((n, n))
    noise, transition = np.empty((n, n_noise)), np.empty((n, n))
    for row in range(begin, end):
        s, origin, R = steps.of_row[row], given.origins[row], given.rotations[row]
        for i in range(3):
            t = origin[i]
            for j in range(3):
                t += R[i, j] * array.centroid[j]
            centroid_there[i] = t
        # Prediction.
        strength = math.sqrt(x[3] * x[3] + x[4] * x[4] + x[5] * x[5])
        length = fill_chart(x, centroid, rules.radius, frame)
        move(x, zero, frame, length, False, here, L)
        _product(steps.F[s], L, transition)
        for i in range(n):
            t = 0.0
            for j in range(n):
                t += steps.F[s, i, j] * x[j]
            x_before[i] = t
            for c in range(n_noise):
                noise[i, c] = steps.A[s, i, c] + strength * steps.B[s, i, c]
        length = fill_chart(x_before, centroid_there, rules.radius, frame)
        into_chart(x_before, frame, length, transition)
        _product(transition, S, product)
        for i in range(n):
            for c in range(n):
                rows[i, c] = product[i, c]
            for c in range(n_noise):
                rows[i, n + c] = noise[i, c]
        into_chart(x_before, frame, length, rows[:, n:])
        triangular_root(rows, S_before)
        status, nis, iterations = TRACKED, math.nan, 0
        if given.n_differences[row] == 0:
            status = PREDICTED
        elif _widest(S_before) > rules.largest_width:
            return row
        else:
            w, a = given.transform_of_row[row], given.ambient_of_row[row]
            transform, ambient = given.transforms[w], given.ambients[a]
            put(here, x_before)
            put(zeta, zero)
            put(e, zero)
            _predicted(here, origin, R, ambient, array, transform, channels, slopes, h, H)
            put(h_first, h)
            firm = is_firm(x_before, S_before, length, rules.firm)
            move(x_before, e, frame, length, firm, here, L)
            bends = given.n_differences[row] >= rules.full and not _grows(S, S_before, rules.largest_growth)
            if bends:
                _derivatives(H, L, S_before, J_e, columns)
                for j in range(k):
                    for i in range(n):
                        J_first[j, i] = columns[i, j]
                _damped_inverse(columns, triangle, rules.least_share, M)
            cost = 0.0
            for j in range(k):
                residual[j] = given.z[row, j] - h[j]
                cost += residual[j] * residual[j]
            for i in range(n):
                residual[k + i] = 0.0
            is_stale, converged, share, gain = True, False, 1.0, 0.0
            while True:
                if is_stale:
                    _linearised(H, L, S_before, M, J_first, bends, J_e, columns)
                    for c in range(k + n):
                        columns[n, c] = residual[c]
                    orthonormalise(columns, triangle)
                    gain = 0.0
                    for i in range(n - 1, -1, -1):
                        t = triangle[i, n]
                        gain += t * t
                        for j in range(i + 1, n):
                            t -= triangle[i, j] * step[j]
                        step[i] = t / triangle[i, i]
                    is_stale, share = False, 1.0
                    converged = gain < rules.tolerance * rules.tolerance
                if converged or iterations >= rules.max_iterations:
                    break
                iterations += 1
                for i in range(n):
                    solution[i, 0] = zeta[i] + share * step[i]
                for i in range(n):
                    t = 0.0
                    for j in range(i + 1):
                        t += S_before[i, j] * solution[j, 0]
                    e[i] = t
                move(x_before, e, frame, length, firm, there, L)
                _predicted(there, origin, R, ambient, array, transform, channels, slopes, h_there, H)
                for i in range(n):
                    residual_there[k + i] = -solution[i, 0]
                if bends:
                    for j in range(k):
                        t = h_there[j] - h_first[j]
                        for i in range(n):
                            t -= J_first[j, i] * solution[i, 0]
                        bent[j] = t
                    for i in range(n):
                        for j in range(k):
                            residual_there[k + i] -= M[i, j] * bent[j]
                cost_there = 0.0
                for j in range(k):
                    residual_there[j] = given.z[row, j] - h_there[j]
                for c in range(k + n):
                    cost_there += residual_there[c] * residual_there[c]
                if cost_there <= cost - rules.least_gain * share * gain + rules.rounding * (1.0 + cost):
                    for i in range(n):
                        zeta[i] = solution[i, 0]
                    put(here, there)
                    put(residual, residual_there)
                    cost, is_stale = cost_there, True
                else:
                    share *= 0.5
            nis = cost
            if not converged or not nis <= rules.nis_limits[given.n_differences[row]]:
                return row
        if status == TRACKED:
            # U R⁻¹, seen from the new state: L is that at e.
            for i in range(n):
                for c in range(n):
                    t = S_before[i, c]
                    for j in range(c):
                        t -= solution[i, j] * triangle[j, c]
                    solution[i, c] = t / triangle[c, c]
            _product(L, solution, product)
            length = fill_chart(here, centroid_there, rules.radius, frame_there)
            into_chart(here, frame_there, length, product)
        else:
            put(here, x_before)
            put_rows(product, S_before)
        if _widest(product) > rules.largest_width:
            return row
        _product(steps.F[s], open_loop, solution)
        for i in range(n):
            for j in range(n):
                t = 0.0
                for c in range(n):
                    t += solution[i, c] * steps.F[s, j, c]
                for c in range(n_noise):
                    t += noise[i, c] * noise[j, c]
                open_loop[i, j] = t
            out.open_loop[row, i] = open_loop[i, i]
        put(x, here)
        put_rows(S, product)
        put(centroid, centroid_there)
        put(out.x[row], x)
        put_rows(out.S[row], S)
        put(out.predicted_x[row], x_before)
        put_rows(out.predicted_S[row], S_before)
        out.nis[row], out.iterations[row], out.status[row] = nis, iterations, status
    return end


@internal
def _derivatives(H: FloatArray, L: FloatArray, S: FloatArray, J_e: FloatArray, columns: FloatArray) -> None:
    """Derivatives of the readings by standard numbers, as rows (n, k) of columns."""
    k, n = J_e.shape
    for j in range(k):
        for i in range(n):
            t = 0.0
            for c in range(6):
                t += H[j, c] * L[c, i]
            J_e[j, i] = t
    for j in range(k):
        for i in range(n):
            t = 0.0
            for c in range(i, n):
                t += J_e[j, c] * S[c, i]
            columns[i, j] = t


@internal
def _damped_inverse(columns: FloatArray, triangle: FloatArray, least_share: float, M: FloatArray) -> None:
    """The twin of :func:`magloc.tracking.chart.update.damped_inverse`; columns are spoilt."""
    n, k = M.shape
    for i in range(n):
        for c in range(n):
            columns[i, k + c] = least_share if i == c else 0.0
    orthonormalise(columns[:n], triangle)
    for j in range(k):
        for i in range(n - 1, -1, -1):
            t = columns[i, j]
            for c in range(i + 1, n):
                t -= triangle[i, c] * M[c, j]
            M[i, j] = t / triangle[i, i]


@internal
def _linearised(
    H: FloatArray,
    L: FloatArray,
    S: FloatArray,
    M: FloatArray,
    J_first: FloatArray,
    bends: bool,
    J_e: FloatArray,
    columns: FloatArray,
) -> None:
    """Derivatives of the misfits of readings and prediction by standard numbers, as the first n rows of columns."""
    k, n = J_e.shape
    _derivatives(H, L, S, J_e, columns)
    for i in range(n):
        for c in range(n):
            t = 1.0 if i == c else 0.0
            if bends:
                for j in range(k):
                    t += M[c, j] * (columns[i, j] - J_first[j, i])
            columns[i, k + c] = t
