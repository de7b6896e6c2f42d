"""The tracker's steps over many rows, the twin of :meth:`magloc.tracking.tracker.Tracker.update` between acquisitions.

A state of n numbers begins with position and moment. Every row has a transition F, and a square root of its noise in
two parts, ``S_q = A + |m| B``; its readings are whitened differences, padded to k with rows that are zero.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from arrays.typing import FloatArray
from magloc.compilation import compiled
from magloc.fields.dipole import MU0_OVER_4PI
from magloc.kalman_compiled import scalar_update, triangular_root
from magloc.linalg_compiled import orthonormalise, put, put_rows

IntArray = NDArray[np.int64]
TRACKED, PREDICTED, OUTLIER = 0, 1, 2


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
    """When an update has converged, and when it is believed; see :mod:`magloc.tracking.tracker`."""

    nis_limits: FloatArray
    tolerance: float
    max_iterations: int
    step_shrink: float
    least_singular: float
    largest_growth: float
    rows_to_lose: int
    start_range_error: float
    largest_range_error: float


class Followed(NamedTuple):
    """Outputs of every row: the state after and before its readings, and what became of them."""

    x: FloatArray
    S: FloatArray
    predicted_x: FloatArray
    predicted_S: FloatArray
    nis: FloatArray
    iterations: IntArray
    status: IntArray


@compiled
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


@compiled
def _updated(x: FloatArray, S: FloatArray, H: FloatArray, innovation: FloatArray, phi: FloatArray) -> float:
    """Updates by all scalars of unit variance in turn, in place; the sum of normalised squared innovations."""
    x0 = x[:6].copy()
    squares = 0.0
    for j in range(innovation.size):
        nu = innovation[j]
        for i in range(6):
            nu -= H[j, i] * (x[i] - x0[i])
        squares += scalar_update(x, S, H[j], nu, 1.0, phi)
    return squares


@compiled
def _chart(H: FloatArray, predicted_S: FloatArray, least_singular: float, M: FloatArray) -> bool:
    """M (6, k) with M H = I, by Gram and Schmidt on H's columns in units of what is known; whether there is one."""
    k = H.shape[0]
    n = predicted_S.shape[1]
    Q, R, unit = np.empty((6, k)), np.zeros((6, 6)), np.empty(6)
    for i in range(6):
        t = 0.0
        for c in range(n):
            t += predicted_S[i, c] * predicted_S[i, c]
        unit[i] = math.sqrt(t)
        for j in range(k):
            Q[i, j] = H[j, i] * unit[i]
    orthonormalise(Q, R)
    smallest, largest = math.inf, 0.0
    for i in range(6):
        smallest, largest = min(smallest, R[i, i]), max(largest, R[i, i])
    if not smallest > least_singular * largest:
        return False
    for i in range(5, -1, -1):
        for j in range(k):
            t = Q[i, j]
            for c in range(i + 1, 6):
                t -= R[i, c] * M[c, j]
            M[i, j] = t / R[i, i]
    for i in range(6):
        for j in range(k):
            M[i, j] *= unit[i]
    return True


@compiled
def _is_of_readings(S: FloatArray, predicted_S: FloatArray, largest_growth: float) -> bool:
    """Whether no standard deviation of position and moment has grown by more than a factor."""
    n = S.shape[1]
    for i in range(6):
        before, after = 0.0, 0.0
        for c in range(n):
            before += S[i, c] * S[i, c]
            after += predicted_S[i, c] * predicted_S[i, c]
        if after > largest_growth * largest_growth * before:
            return False
    return True


@compiled
def _solved(A: FloatArray, B: FloatArray) -> bool:
    """B becomes the solution X (6, m) of A X = B, by elimination with pivots that destroys A; whether there is one."""
    m = B.shape[1]
    for i in range(6):
        pivot = i
        for r in range(i + 1, 6):
            if abs(A[r, i]) > abs(A[pivot, i]):
                pivot = r
        if not abs(A[pivot, i]) > 0.0:
            return False
        if pivot != i:
            for c in range(6):
                A[i, c], A[pivot, c] = A[pivot, c], A[i, c]
            for c in range(m):
                B[i, c], B[pivot, c] = B[pivot, c], B[i, c]
        inverse = 1.0 / A[i, i]
        for r in range(i + 1, 6):
            factor = A[r, i] * inverse
            if factor != 0.0:
                for c in range(i + 1, 6):
                    A[r, c] -= factor * A[i, c]
                for c in range(m):
                    B[r, c] -= factor * B[i, c]
    for i in range(5, -1, -1):
        inverse = 1.0 / A[i, i]
        for c in range(m):
            t = B[i, c]
            for r in range(i + 1, 6):
                t -= A[i, r] * B[r, c]
            B[i, c] = t * inverse
    return True


@compiled
def _curved_prior(
    M: FloatArray,
    H: FloatArray,
    predicted: FloatArray,
    predicted_first: FloatArray,
    x: FloatArray,
    S: FloatArray,
    x_k: FloatArray,
    A: FloatArray,
    B: FloatArray,
    mean: FloatArray,
    root: FloatArray,
) -> None:
    """Mean (6,) and root (6, n) that the prediction (x, S) has to first order at the state x_k."""
    k, n = predicted.size, S.shape[1]
    for i in range(6):
        for c in range(6):
            t = 0.0
            for j in range(k):
                t += M[i, j] * H[j, c]
            A[i, c] = t
        t = 0.0
        for j in range(k):
            t += M[i, j] * (predicted[j] - predicted_first[j])
        B[i, 0] = t
        for c in range(n):
            B[i, 1 + c] = S[i, c]
    solved = _solved(A, B)
    for i in range(6):
        mean[i] = x_k[i] - B[i, 0] if solved else x[i]
        for c in range(n):
            root[i, c] = B[i, 1 + c] if solved else S[i, c]


@compiled
def follow(
    begin: int,
    end: int,
    x: FloatArray,
    S: FloatArray,
    contradictions: int,
    array: Channels,
    given: Rows,
    steps: Steps,
    rules: Rules,
    out: Followed,
) -> tuple[int, int]:
    """Follow a track from the state (x, S) before row begin, which are changed, to the first row that must be acquired.

    Returns that row, or end, and the number of contradictions so far. Outputs of rows before it are filled.
    """
    z, n_differences, transforms, transform_of_row, origins, rotations, ambients, ambient_of_row = given
    F_steps, A_steps, B_steps, step_of_row = steps
    centroid = array.centroid
    n = x.size
    k, n_channels = transforms.shape[1], array.sensor.size
    width = n + A_steps.shape[2]
    rows = np.empty((n, width))
    predicted_x, predicted_S = np.empty(n), np.empty((n, n))
    x_k, S_k, x_next = np.empty(n), np.empty((n, n)), np.empty(n)
    H, predicted, predicted_next = np.empty((k, 6)), np.empty(k), np.empty(k)
    channels, slopes = np.empty(n_channels), np.empty((n_channels, 6))
    innovation, phi = np.empty(k), np.empty(n)
    predicted_first, M = np.empty(k), np.empty((6, k))
    A, B, mean, root = np.empty((6, 6)), np.empty((6, 1 + n)), np.empty(n), np.empty((n, n))
    for row in range(begin, end):
        step, origin, rotation = step_of_row[row], origins[row], rotations[row]
        strength = math.sqrt(x[3] * x[3] + x[4] * x[4] + x[5] * x[5])
        for i in range(n):
            t = 0.0
            for j in range(n):
                t += F_steps[step, i, j] * x[j]
            predicted_x[i] = t
            for c in range(n):
                t = 0.0
                for j in range(n):
                    t += F_steps[step, i, j] * S[j, c]
                rows[i, c] = t
            for c in range(A_steps.shape[2]):
                rows[i, n + c] = A_steps[step, i, c] + strength * B_steps[step, i, c]
        triangular_root(rows, predicted_S)
        status = TRACKED
        nis = math.nan
        iterations = 0
        if n_differences[row] == 0:
            status = PREDICTED
        else:
            if _range_error(predicted_x, predicted_S, origin, rotation, centroid) > rules.start_range_error:
                return row, contradictions
            put(x_k, predicted_x)
            w, a = transform_of_row[row], ambient_of_row[row]
            _predicted(x_k, origin, rotation, ambients[a], array, transforms[w], channels, slopes, predicted, H)
            curved = _is_of_readings(S, predicted_S, rules.largest_growth) and _chart(
                H, predicted_S, rules.least_singular, M
            )
            put(predicted_first, predicted)
            put(mean, predicted_x)
            put_rows(root, predicted_S)
            converged, change_before, length = False, math.inf, 1.0
            for _ in range(rules.max_iterations):
                iterations += 1
                if curved and iterations > 1:
                    _curved_prior(
                        M, H, predicted, predicted_first, predicted_x, predicted_S, x_k, A, B, mean, root
                    )  # fmt: skip
                for j in range(k):
                    t = z[row, j] - predicted[j]
                    for i in range(6):
                        t -= H[j, i] * (mean[i] - x_k[i])
                    innovation[j] = t
                put(x_next, mean)
                put_rows(S_k, root)
                nis = _updated(x_next, S_k, H, innovation, phi)
                for i in range(n):
                    x_next[i] = x_k[i] + length * (x_next[i] - x_k[i])
                _predicted(
                    x_next, origin, rotation, ambients[a], array, transforms[w],
                    channels, slopes, predicted_next, H,
                )  # fmt: skip
                change = 0.0
                for j in range(k):
                    change += (predicted_next[j] - predicted[j]) ** 2
                    predicted[j] = predicted_next[j]
                put(x_k, x_next)
                change = math.sqrt(change) / length
                if not math.isfinite(change):
                    break
                if change < rules.tolerance:
                    converged = True
                    break
                if change >= change_before:
                    length *= rules.step_shrink
                change_before = change
            if not converged or nis > rules.nis_limits[n_differences[row]]:
                if contradictions + 1 >= rules.rows_to_lose:
                    return row, contradictions
                contradictions += 1
                status = OUTLIER
                iterations = 0
            else:
                contradictions = 0
        used_x, used_S = (x_k, S_k) if status == TRACKED else (predicted_x, predicted_S)
        if _range_error(used_x, used_S, origin, rotation, centroid) > rules.largest_range_error:
            return row, contradictions
        put(x, used_x)
        put_rows(S, used_S)
        put(out.x[row], x)
        put_rows(out.S[row], S)
        put(out.predicted_x[row], predicted_x)
        put_rows(out.predicted_S[row], predicted_S)
        out.nis[row], out.iterations[row], out.status[row] = nis, iterations, status
    return end, contradictions


@compiled
def _range_error(x: FloatArray, S: FloatArray, origin: FloatArray, R: FloatArray, centroid: FloatArray) -> float:
    """Standard deviation of the range over the range."""
    offset = np.empty(3)
    square = 0.0
    for i in range(3):
        t = x[i] - origin[i]
        for j in range(3):
            t -= R[i, j] * centroid[j]
        offset[i] = t
        square += t * t
    variance = 0.0
    for c in range(S.shape[1]):
        t = offset[0] * S[0, c] + offset[1] * S[1, c] + offset[2] * S[2, c]
        variance += t * t
    return math.sqrt(variance) / square if square > 0.0 else math.inf
