"""Compiled complementary filters and the adaptive error-state filter: whole records, one row each.

:mod:`adcs.complementary.explicit`, :mod:`adcs.complementary.gauss_newton`, :mod:`adcs.complementary.outage` and
:mod:`adcs.complementary.adaptive` are the readable twins and have the formulas. What all runs share may be given once:
references and turns of the reference frame have one row or as many as the runs.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adcs import quaternion
from adcs.satellite.dynamics_compiled import (
    Quaternion,
    Vector,
    combined,
    conjugate,
    cross,
    dot,
    error_vector,
    multiply,
    normalised,
    quaternion_at,
    rotate_back,
    vector_at,
)
from adcs.satellite.vector_record import VectorRecord
from magloc.compilation import compiled, internal

Array = NDArray[np.float64]
EXPLICIT, GAUSS_NEWTON = 0, 1
MAGNETOMETER_ONLY, RAW, TRANSPORTED = 0, 1, 2
_NONE: Vector = (0.0, 0.0, 0.0)


class Record(NamedTuple):
    """Rates, vectors, references (R or 1, n, 3), turns of the frame (R or 1, n, 4) in the steps (n,) that end now."""

    rate: Array
    first: Array
    second: Array
    first_reference: Array
    second_reference: Array
    frame_turn: Array
    dt: Array

    @classmethod
    def of(cls, record: VectorRecord) -> Record:
        """In the layout of the compiled code."""
        return cls(
            record.rate_rad_s,
            record.first_body,
            record.second_body,
            record.first_reference,
            record.second_reference,
            quaternion.exp(record.frame_rate_rad_s * record.dt_s[:, None]),
            record.dt_s,
        )


class Weights(NamedTuple):
    """Weights of the vectors; (K_P, K_I) with the second vector and in its outage; (factor of K_I, level, memory)."""

    vectors: Array
    gains: Array
    boost: Array


class Outage(NamedTuple):
    """What stands in for a second vector that is missing: a rule, and how many instants ago its vector is from."""

    substitute: int
    delay: int


@compiled
def exp(v: Vector) -> Quaternion:
    """Quaternion of a rotation vector [rad]; the series is exact to rounding below 0.01 rad."""
    half = 0.25 * (v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    if half < 2.5e-5:
        c = 1.0 - half * (0.5 - half * (1.0 / 24.0 - half / 720.0))
        s = 0.5 * (1.0 - half * (1.0 / 6.0 - half * (1.0 / 120.0 - half / 5040.0)))
    else:
        angle = np.sqrt(half)
        c = np.cos(angle)
        s = 0.5 * np.sin(angle) / angle
    return c, s * v[0], s * v[1], s * v[2]


@internal
def unit(v: Vector) -> Vector:
    """Vector of length 1; NaN stays NaN."""
    inverse = 1.0 / np.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    return v[0] * inverse, v[1] * inverse, v[2] * inverse


@internal
def is_there(v: Vector) -> bool:
    """Whether a vector was measured."""
    return not np.isnan(v[0] + v[1] + v[2])


@internal
def gauss_newton_step(
    q: Quaternion, b: Vector, b_reference: Vector, s: Vector, s_reference: Vector, has_b: bool, has_s: bool, mu: float
) -> Quaternion:
    """One step towards the measured quaternion.

    With δq = q∘η the normal equations fall apart into one for the scalar part of η and three for the vector part,
    with the matrix 4 Σ(E - vvᵀ) + μE: the same step as that of the 4×4 equations.
    """
    xx = yy = zz = mu
    xy = xz = yz = 0.0
    g = _NONE
    along = 0.0
    count = 0.0
    for k in range(2):
        if (k == 0 and not has_b) or (k == 1 and not has_s):
            continue
        v = b if k == 0 else s
        predicted = rotate_back(q, b_reference if k == 0 else s_reference)
        xx += 4.0 * (1.0 - v[0] * v[0])
        yy += 4.0 * (1.0 - v[1] * v[1])
        zz += 4.0 * (1.0 - v[2] * v[2])
        xy -= 4.0 * v[0] * v[1]
        xz -= 4.0 * v[0] * v[2]
        yz -= 4.0 * v[1] * v[2]
        g = combined(g, 2.0, cross(v, predicted))
        along += 2.0 * (dot(v, predicted) - 1.0)
        count += 4.0
    # Cofactors of the symmetric matrix.
    a, d, f = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    e, h, i = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
    inverse = 1.0 / (xx * a + xy * d + xz * f)
    eta = (
        1.0 + along / (count + mu),
        inverse * (a * g[0] + d * g[1] + f * g[2]),
        inverse * (d * g[0] + e * g[1] + h * g[2]),
        inverse * (f * g[0] + h * g[1] + i * g[2]),
    )
    return normalised(multiply(q, eta))


@compiled
def complementary(
    begin: int,
    end: int,
    record: Record,
    weighting: Weights,
    method: int,
    counted: Array,
    outage: Outage,
    mu: float,
    q: Array,
    integral: Array,
    q_measured: Array,
) -> None:
    """Runs begin to end of a complementary filter, from the first rows of ``q`` (R, n, 4) and ``integral`` (R, n, 3).

    ``counted`` (n,) is how long the vectors of each instant count. ``q_measured`` (R, n, 4) gets the measured
    quaternions of the filter that has them.
    """
    rate, first, second, first_reference, second_reference, frame_turn, dt = record
    weights, gains, boost = weighting
    substitute, delay = outage
    n = rate.shape[1]
    shared = first_reference.shape[0] == 1
    p_line, c_line = np.empty((delay + 1, 4)), np.empty((delay + 1, 4))
    for r in range(begin, end):
        k = 0 if shared else r
        q_now = quaternion_at(q[r, 0])
        measured = q_now
        total = vector_at(integral[r, 0])
        smooth = _NONE
        p: Quaternion = (1.0, 0.0, 0.0, 0.0)
        c: Quaternion = (1.0, 0.0, 0.0, 0.0)
        for i in range(n):
            if i > 0:
                w = combined(vector_at(rate[r, i]), 1.0, total)
                turn = exp((w[0] * dt[i], w[1] * dt[i], w[2] * dt[i]))
                frame = quaternion_at(frame_turn[k, i])
                if substitute == TRANSPORTED:
                    p = normalised(multiply(p, turn))
                    c = normalised(multiply(c, frame))
                q_now = normalised(multiply(multiply(conjugate(frame), q_now), turn))
            b, b_reference = unit(vector_at(first[r, i])), unit(vector_at(first_reference[k, i]))
            s, s_reference = unit(vector_at(second[r, i])), unit(vector_at(second_reference[k, i]))
            in_outage = not is_there(s)
            if substitute == TRANSPORTED:
                slot = i % (delay + 1)
                p_line[slot, 0], p_line[slot, 1], p_line[slot, 2], p_line[slot, 3] = p
                c_line[slot, 0], c_line[slot, 1], c_line[slot, 2], c_line[slot, 3] = c
            if in_outage and substitute != MAGNETOMETER_ONLY and i >= delay:
                s, s_reference = unit(vector_at(first[r, i - delay])), unit(vector_at(first_reference[k, i - delay]))
                if substitute == TRANSPORTED:
                    slot = (i - delay) % (delay + 1)
                    s = rotate_back(multiply(conjugate(quaternion_at(p_line[slot])), p), s)
                    s_reference = rotate_back(multiply(conjugate(quaternion_at(c_line[slot])), c), s_reference)
            has_b, has_s = is_there(b) and is_there(b_reference), is_there(s) and is_there(s_reference)
            e = _NONE
            if method == GAUSS_NEWTON:
                # One vector leaves the turn around it to the estimate.
                start = measured if has_b and has_s else q_now
                measured = start
                if has_b or has_s:
                    measured = gauss_newton_step(start, b, b_reference, s, s_reference, has_b, has_s, mu)
                delta = error_vector(q_now, measured)
                e = (2.0 * delta[0], 2.0 * delta[1], 2.0 * delta[2])
                q_measured[r, i, 0], q_measured[r, i, 1], q_measured[r, i, 2], q_measured[r, i, 3] = measured
            else:
                if has_b:
                    e = combined(e, weights[0], cross(b, rotate_back(q_now, b_reference)))
                if has_s:
                    e = combined(e, weights[1], cross(s, rotate_back(q_now, s_reference)))
            kp, ki = gains[0], gains[1]
            if in_outage:
                kp, ki = gains[2], gains[3]
            smooth = combined((boost[2] * smooth[0], boost[2] * smooth[1], boost[2] * smooth[2]), 1.0 - boost[2], e)
            if dot(smooth, smooth) > boost[1] * boost[1]:
                ki *= boost[0]
            total = combined(total, ki * counted[i], e)
            angle = kp * counted[i]
            q_now = normalised(multiply(q_now, exp((angle * e[0], angle * e[1], angle * e[2]))))
            q[r, i, 0], q[r, i, 1], q[r, i, 2], q[r, i, 3] = q_now
            integral[r, i, 0], integral[r, i, 1], integral[r, i, 2] = total


@internal
def _scalar_update(P: Array, x: Array, h: Array, z: float, variance: float, Ph: Array) -> float:
    """Kalman update of x (6,) and P (6, 6), in place, by z = h·x + noise, h being zero from 3 on; its NIS."""
    expected = 0.0
    s = variance
    for i in range(6):
        value = P[i, 0] * h[0] + P[i, 1] * h[1] + P[i, 2] * h[2]
        Ph[i] = value
        if i < 3:
            s += h[i] * value
            expected += h[i] * x[i]
    nu = z - expected
    for i in range(6):
        gain = Ph[i] / s
        x[i] += gain * nu
        for j in range(i + 1):
            P[i, j] -= gain * Ph[j]
            P[j, i] = P[i, j]
    return nu * nu / s


@internal
def _vector_update(P: Array, x: Array, v: Vector, predicted: Vector, variance: float, h: Array, Ph: Array) -> float:
    """Update by a measured unit vector, along two axes across the predicted one; its NIS, of 2 degrees of freedom."""
    size = (abs(predicted[0]), abs(predicted[1]), abs(predicted[2]))
    axis: Vector = (1.0, 0.0, 0.0)
    if size[1] < size[0] and size[1] <= size[2]:
        axis = (0.0, 1.0, 0.0)
    elif size[2] < size[0]:
        axis = (0.0, 0.0, 1.0)
    t = unit(cross(predicted, axis))
    nis = 0.0
    for _ in range(2):
        # t·(v̂×δθ) = (t×v̂)·δθ
        h[0], h[1], h[2] = cross(t, predicted)
        nis += _scalar_update(P, x, h, dot(t, v), variance, Ph)
        t = cross(predicted, t)
    return nis


@internal
def _predict(P: Array, w: Vector, dt: float, attitude_variance: float, bias_variance: float, M: Array) -> None:
    """Covariance after a step, in place: δθ turns by -ω and grows by the error of the bias, M (6, 6) is scratch."""
    turn = exp((w[0] * dt, w[1] * dt, w[2] * dt))
    for j in range(6):
        # Columns of Φ P: the matrix of the turn back is the transition of δθ.
        rotated = rotate_back(turn, (P[0, j], P[1, j], P[2, j]))
        for i in range(3):
            M[i, j] = rotated[i] - dt * P[3 + i, j]
            M[3 + i, j] = P[3 + i, j]
    for i in range(6):
        rotated = rotate_back(turn, (M[i, 0], M[i, 1], M[i, 2]))
        for j in range(3):
            P[i, j] = rotated[j] - dt * M[i, 3 + j]
            P[i, 3 + j] = M[i, 3 + j]
    for i in range(6):
        for j in range(i):
            P[i, j] = 0.5 * (P[i, j] + P[j, i])
            P[j, i] = P[i, j]
    for i in range(3):
        P[i, i] += attitude_variance
        P[3 + i, 3 + i] += bias_variance


@compiled
def adaptive(
    begin: int,
    end: int,
    record: Record,
    sigmas: Array,
    noises: Array,
    adaptation: Array,
    q: Array,
    bias: Array,
    covariance: Array,
    smoothed_nis: Array,
) -> None:
    """Runs begin to end of the adaptive error-state filter from the first rows of ``q``, ``bias`` and ``covariance``.

    ``sigmas`` are those of the first vector (in its unit) and of the unit second one, ``noises`` the growth in a second
    of the variances of attitude and bias, ``adaptation`` (memory, threshold, that of the bias above it).
    """
    rate, first, second, first_reference, second_reference, frame_turn, dt = record
    n = rate.shape[1]
    shared = first_reference.shape[0] == 1
    P, M, x, h, Ph = np.empty((6, 6)), np.empty((6, 6)), np.empty(6), np.empty(3), np.empty(6)
    for r in range(begin, end):
        k = 0 if shared else r
        q_now = quaternion_at(q[r, 0])
        b_now = vector_at(bias[r, 0])
        P[:] = covariance[r, 0]
        smooth = 1.0
        extra = 0.0
        for i in range(n):
            if i > 0:
                w = combined(vector_at(rate[r, i]), -1.0, b_now)
                _predict(P, w, dt[i], noises[0] * dt[i], (noises[1] + extra) * dt[i], M)
                turn = exp((w[0] * dt[i], w[1] * dt[i], w[2] * dt[i]))
                q_now = normalised(multiply(multiply(conjugate(quaternion_at(frame_turn[k, i])), q_now), turn))
            x[:] = 0.0
            nis = 0.0
            dof = 0.0
            raw = vector_at(first[r, i])
            length = np.sqrt(dot(raw, raw))
            v = unit(raw)
            predicted = rotate_back(q_now, unit(vector_at(first_reference[k, i])))
            if is_there(v):
                nis += _vector_update(P, x, v, predicted, (sigmas[0] / length) ** 2, h, Ph)
                dof += 2.0
            v = unit(vector_at(second[r, i]))
            predicted = rotate_back(q_now, unit(vector_at(second_reference[k, i])))
            if is_there(v):
                nis += _vector_update(P, x, v, predicted, sigmas[1] ** 2, h, Ph)
                dof += 2.0
            q_now = normalised(multiply(q_now, exp((x[0], x[1], x[2]))))
            b_now = (b_now[0] + x[3], b_now[1] + x[4], b_now[2] + x[5])
            extra = 0.0
            if dof > 0.0:
                smooth = adaptation[0] * smooth + (1.0 - adaptation[0]) * nis / dof
                if smooth > adaptation[1]:
                    extra = adaptation[2]
            q[r, i, 0], q[r, i, 1], q[r, i, 2], q[r, i, 3] = q_now
            bias[r, i, 0], bias[r, i, 1], bias[r, i, 2] = b_now
            covariance[r, i] = P
            smoothed_nis[r, i] = smooth
