"""Compiled error-state filter of whole runs; :mod:`adcs.kalman.mekf` is the readable twin and has the formulas.

Readings are taken one scalar after the other, all linearised at the predicted state, which for independent noise is the
update of all at once without a matrix to invert. The covariance of a step is in Joseph's form.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adcs.kalman.covariance_compiled import by_dipole, scalar, spread, transition
from adcs.kalman.gate import contest_compiled as gate
from adcs.satellite.dynamics_compiled import (
    Body,
    Quaternion,
    Surroundings,
    Vector,
    applied,
    cross,
    dot,
    error_jacobian,
    error_vector,
    multiply,
    normalised,
    quaternion_at,
    rotate_back,
    step,
    vector_at,
    with_dipole,
)
from magloc.compilation import compiled, internal

Array = NDArray[np.float64]


class Estimated(NamedTuple):
    """Outputs (R, n, …); optional (R, n, N - 6): the states that there are; the last three (R, n, 4), at readings."""

    q: Array
    w: Array
    optional: Array
    covariance: Array
    nis: Array
    rejected: NDArray[np.bool_]
    log_det: Array


class First(NamedTuple):
    """Attitude (R, 4), rate (R, 3), optional states (R, N - 6) and covariance (R, N, N) before the first reading."""

    q: Array
    w: Array
    optional: Array
    P: Array


class Record(NamedTuple):
    """Wheels, torquers, readings, and the Sun in the orbital frame: (R, n, 3), of the star tracker (R, n, 4).

    ``star_whitening`` (R, n, 3, 3): what makes all errors of a star tracker's attitude alike.
    """

    momentum: Array
    wheel_torque: Array
    torquers: Array
    star: Array
    star_whitening: Array
    gyro: Array
    field: Array
    sun: Array
    sun_orbital: Array


class Settings(NamedTuple):
    """Which of star tracker, gyro, magnetometer and Sun sensor are used, their deviations and patience, (4,).

    Biases of field and gyro, the disturbance, the error of the field model, the dipole and the three rows of the
    magnetometer's D begin at ``firsts`` in the error state, -1 where there are none. ``open_variance`` (N,): of an
    error state of which nothing is known. ``variance`` (n - 1, N): what each step adds; ``kept`` (n - 1, N): what it
    leaves.
    """

    used: NDArray[np.bool_]
    sigma: Array
    firsts: NDArray[np.int64]
    variance: Array
    open_variance: Array
    kept: Array
    limit: float
    patience: NDArray[np.int64]


class Hypothesis(NamedTuple):
    """State (7 + 3K,): attitude, rate and optional states; its covariance (N, N), and the correction by readings (N,).

    ``attitude_variance`` (1,) is the trace of that of δq, as predicted.
    Readings of an instant are all linearised at the state that was predicted for it.
    """

    x: Array
    P: Array
    dx: Array
    attitude_variance: Array


class Work(NamedTuple):
    """Room of a reading: a row, A (N, N), u (N,), covariance and correction before it, columns of the row."""

    h: Array
    A: Array
    u: Array
    P: Array
    dx: Array
    columns: NDArray[np.int64]


class Steps(NamedTuple):
    """Room of a step: matrices (6, 6), G (2, 6, 3) by disturbance and dipole, and T (6, N)."""

    F: Array
    F_after: Array
    F2: Array
    F3: Array
    Phi: Array
    G: Array
    T: Array


@internal
def _copied(P: Array, dx: Array, P_to: Array, dx_to: Array) -> None:
    for i in range(len(dx)):
        dx_to[i] = dx[i]
        for j in range(len(dx)):
            P_to[i, j] = P[i, j]


@internal
def _at(x: Array, first: int) -> Vector:
    return x[first], x[first + 1], x[first + 2]


@internal
def _with_reading(
    one: Hypothesis,
    sensor: int,
    reading: Array,
    whitening: Array,
    model: Vector,
    firsts: NDArray[np.int64],
    r: float,
    work: Work,
) -> gate.Fit:
    """Take a reading into covariance and correction, and keep in ``work`` what they were; how it fits.

    ``whitening`` (3, 3): of a star tracker's attitude.
    """
    x, h, columns = one.x, work.h, work.columns
    _copied(one.P, one.dx, work.P, work.dx)
    q, bias, v = quaternion_at(x), -1, model
    e, g = (firsts[3], firsts[5]) if sensor == 2 else (-1, -1)
    if e >= 0:
        model = model[0] + x[16], model[1] + x[17], model[2] + x[18]
        axes = rotate_back(q, (1.0, 0.0, 0.0)), rotate_back(q, (0.0, 1.0, 0.0)), rotate_back(q, (0.0, 0.0, 1.0))
    if sensor == 0:
        e_q, W = error_vector(q, quaternion_at(reading)), whitening
        residual = dot(vector_at(W[0]), e_q), dot(vector_at(W[1]), e_q), dot(vector_at(W[2]), e_q)
    elif sensor == 1:
        residual, bias = _minus(_minus(vector_at(reading), _at(x, 4)), _at(x, 10)), firsts[1]
    else:
        v = rotate_back(q, model)
        residual = _minus(vector_at(reading), v)
        if g >= 0:
            residual = _minus(residual, (dot(_at(x, 22), v), dot(_at(x, 25), v), dot(_at(x, 28), v)))
        if sensor == 2:
            residual, bias = _minus(residual, _at(x, 7)), firsts[0]
    nis, determinant = 0.0, 1.0
    for j in range(3):
        if sensor == 0:
            for k in range(3):
                columns[k], h[k] = k, whitening[j, k]
            m = 3
        elif sensor == 1:
            columns[0], h[0], m = 3 + j, 1.0, 1
        elif g >= 0:
            # Row j of (E + D)2W(v), and the field itself for that row of D.
            row = (x[22 + 3 * j] + (j == 0), x[23 + 3 * j] + (j == 1), x[24 + 3 * j] + (j == 2))
            turned = cross(row, v)
            for k in range(3):
                columns[k], h[k] = k, 2.0 * turned[k]
                columns[3 + k], h[3 + k] = g + 3 * j + k, v[k]
            m = 6
        else:
            # Row j of 2W(v).
            one_on, two_on = (j + 1) % 3, (j + 2) % 3
            columns[0], h[0] = one_on, -2.0 * v[two_on]
            columns[1], h[1], m = two_on, 2.0 * v[one_on], 2
        if bias >= 0:
            columns[m], h[m] = bias + j, 1.0
            m += 1
        if e >= 0:
            for k in range(3):
                columns[m + k], h[m + k] = e + k, dot(row, axes[k]) if g >= 0 else axes[k][j]
            m += 3
        squared, s = scalar(one.P, one.dx, h, columns, m, residual[j], r, work.u, work.A)
        nis, determinant = nis + squared, determinant * (s / r)
    length = 0.0 if sensor < 2 else np.sqrt(dot(v, v))
    return nis, gate.eased(nis, r, length, one.attitude_variance[0]), np.log(determinant)


@internal
def _without_reading(one: Hypothesis, work: Work) -> None:
    """Undo the last reading."""
    _copied(work.P, work.dx, one.P, one.dx)


@internal
def _minus(a: Vector, b: Vector) -> Vector:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@internal
def _put(x: Array, q: Quaternion) -> None:
    x[0], x[1], x[2], x[3] = q


@compiled
def _correct(one: Hypothesis, firsts: NDArray[np.int64]) -> None:
    """Put the correction into the state."""
    x, dx = one.x, one.dx
    squared = dx[0] * dx[0] + dx[1] * dx[1] + dx[2] * dx[2]
    inverse = 1.0 / np.sqrt(max(squared, 1.0))
    delta = (np.sqrt(max(1.0 - squared, 0.0)), dx[0] * inverse, dx[1] * inverse, dx[2] * inverse)
    _put(x, normalised(multiply(quaternion_at(x), delta)))
    for j in range(3):
        x[4 + j] += dx[3 + j]
        for k in range(len(firsts)):
            if firsts[k] >= 0:
                x[7 + 3 * k + j] += dx[firsts[k] + j]
    dx[:] = 0.0


@internal
def _advance(
    one: Hypothesis,
    body: Body,
    record: Record,
    around: Surroundings,
    settings: Settings,
    place: tuple[int, int],
    dt: float,
    work: Steps,
) -> None:
    """State and covariance of the instant after ``place``, a run and an instant."""
    run, i = place
    x, F, F_after = one.x, work.F, work.F_after
    for state in range(len(settings.firsts)):
        for j in range(3):
            first = settings.firsts[state] + j
            if settings.firsts[state] >= 0 and settings.kept[i, first] < 1.0:
                x[7 + 3 * state + j] *= settings.kept[i, first]
                for other in range(len(one.P)):
                    one.P[first, other] *= settings.kept[i, first]
                    one.P[other, first] *= settings.kept[i, first]
    q, w = quaternion_at(x), _at(x, 4)
    k, b_o = vector_at(record.momentum[run, i]), vector_at(around.b_orbital[run, i])
    own = with_dipole(body, _at(x, 19))
    body = with_dipole(own, vector_at(record.torquers[run, i]))
    b = rotate_back(q, b_o)
    error_jacobian(body, q, w, k, around.gravity[run, i], b_o, F)
    u_k, torque = vector_at(record.wheel_torque[run, i]), applied(body.J, _at(x, 13))
    orbital_rate, gravity = around.orbital_rate[run, i], around.gravity[run, i]
    q, w, _ = step(body, q, w, k, u_k, torque, orbital_rate, gravity, b_o, dt)
    k, b_o = vector_at(record.momentum[run, i + 1]), vector_at(around.b_orbital[run, i + 1])
    after = with_dipole(own, vector_at(record.torquers[run, i + 1]))
    error_jacobian(after, q, w, k, around.gravity[run, i + 1], b_o, F_after)
    for row in range(6):
        for column in range(6):
            F[row, column] = 0.5 * (F[row, column] + F_after[row, column])
    transition(F, work.F2, work.F3, dt, work.Phi, work.G[0])
    if settings.firsts[4] >= 0:
        # The mean over the step, as of F: all else of it is held.
        b_after = rotate_back(q, b_o)
        mean = (0.5 * (b[0] + b_after[0]), 0.5 * (b[1] + b_after[1]), 0.5 * (b[2] + b_after[2]))
        by_dipole(work.G[0], body, mean, work.G[1])
    spread(work.Phi, work.G, (settings.firsts[2], settings.firsts[4]), settings.variance[i], one.P, work.T)
    _put(x, q)
    x[4], x[5], x[6] = w


@internal
def _begin(main: Hypothesis, second: Hypothesis, sensor: int, q: Quaternion, settings: Settings) -> None:
    """Make the second hypothesis one in which a reading is right, before it."""
    firsts, variance = settings.firsts, settings.open_variance
    second.x[:] = main.x
    _put(second.x, q)
    if sensor == 1:
        second.P[:], second.dx[:] = main.P, main.dx
        for j in range(firsts[1], firsts[1] + 3):
            second.P[j, :] = 0.0
            second.P[:, j] = 0.0
            second.P[j, j] = variance[j]
    else:
        second.P[:], second.dx[:] = 0.0, 0.0
        for j in range(len(variance)):
            second.P[j, j] = variance[j]
    _ready(second)


@internal
def _ready(one: Hypothesis) -> None:
    """Keep what the attitude's variance is before readings."""
    one.attitude_variance[0] = one.P[0, 0] + one.P[1, 1] + one.P[2, 2]


@internal
def _copy(source: Hypothesis, target: Hypothesis) -> None:
    target.x[:], target.P[:] = source.x, source.P


@internal
def _reading_of(record: Record, sensor: int, run: int, i: int) -> Array:
    if sensor == 0:
        return record.star[run, i]
    if sensor == 1:
        return record.gyro[run, i]
    return record.field[run, i] if sensor == 2 else record.sun[run, i]


@internal
def _direction(values: Array, used: bool) -> Vector:
    """A reading, NaN of a sensor that is not in use."""
    return vector_at(values) if used else (np.nan, np.nan, np.nan)


@internal
def _take_readings(
    main: Hypothesis,
    second: Hypothesis,
    contest: gate.Contest,
    record: Record,
    settings: Settings,
    models: tuple[Vector, Vector],
    place: tuple[int, int],
    out: Estimated,
    work: Work,
) -> None:
    """Readings of an instant, each by whom it belongs to."""
    run, i = place
    used, firsts = settings.used, settings.firsts
    for sensor in range(4):
        reading, whitening = _reading_of(record, sensor, run, i), record.star_whitening[run, i]
        if not (used[sensor] and np.isfinite(reading[0])):
            continue
        model, r = models[1 if sensor == 3 else 0], settings.sigma[sensor] ** 2
        fit_second = (np.nan, np.nan, np.nan)
        there = contest.counts[gate.BEGAN] >= 0
        fit = _with_reading(main, sensor, reading, whitening, model, firsts, r, work)
        out.nis[run, i, sensor], out.log_det[run, i, sensor] = fit[0], fit[2]
        if there:
            # Decided before it is taken, for there is room to undo one reading only.
            _without_reading(main, work)
            fit_second = _with_reading(second, sensor, reading, whitening, model, firsts, r, work)
        use, use_second = gate.decided(contest, sensor, settings.limit, fit, fit_second)
        if there:
            if not use_second:
                _without_reading(second, work)
            if use:
                _with_reading(main, sensor, reading, whitening, model, firsts, r, work)
        elif not use:
            _without_reading(main, work)
        out.rejected[run, i, sensor] = not use
        field, sun = _direction(record.field[run, i], used[2]), _direction(record.sun[run, i], used[3])
        both = np.isfinite(field[0]) and np.isfinite(sun[0])
        if not use and gate.may_begin(contest, sensor, firsts[1] >= 0, both):
            star = quaternion_at(record.star[run, i])
            _begin(main, second, sensor, gate.begun(quaternion_at(main.x), sensor, star, field, sun, *models), settings)
            _with_reading(second, sensor, reading, whitening, model, firsts, r, work)
            gate.begin(contest, sensor)
        gate.read(contest, sensor)


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
    dt: Array,
) -> None:
    """Filter runs begin to end."""
    n_rows, N, K = out.q.shape[1], first.P.shape[1], len(settings.firsts)
    main = Hypothesis(np.empty(7 + 3 * K), np.empty((N, N)), np.empty(N), np.empty(1))
    second = Hypothesis(np.empty(7 + 3 * K), np.empty((N, N)), np.empty(N), np.empty(1))
    six = np.empty((5, 6, 6))
    square, line = np.empty((2, N, N)), np.empty((3, N))
    steps = Steps(six[0], six[1], six[2], six[3], six[4], np.empty((2, 6, 3)), np.empty((6, N)))
    work = Work(line[2], square[0], line[0], square[1], line[1], np.empty(N, np.int64))
    contest = gate.Contest(np.empty(6, np.int64), np.empty((5, 4), np.int64), settings.patience, np.empty(1))
    for run in range(begin, end):
        main.x[:] = 0.0
        main.x[:4], main.x[4:7], main.P[:] = first.q[run], first.w[run], first.P[run]
        for k in range(K):
            for j in range(3 if settings.firsts[k] >= 0 else 0):
                main.x[7 + 3 * k + j] = first.optional[run, settings.firsts[k] - 6 + j]
        gate.reset(contest)
        for i in range(n_rows):
            if i > 0:
                _advance(main, body, record, around, settings, (run, i - 1), dt[i - 1], steps)
                if contest.counts[gate.BEGAN] >= 0:
                    _advance(second, body, record, around, settings, (run, i - 1), dt[i - 1], steps)
            contest.counts[gate.ROW] = i
            models = vector_at(around.b_orbital[run, i]), vector_at(record.sun_orbital[run, i])
            main.dx[:] = 0.0
            second.dx[:] = 0.0
            _ready(main)
            _ready(second)
            _take_readings(main, second, contest, record, settings, models, (run, i), out, work)
            _correct(main, settings.firsts)
            if contest.counts[gate.BEGAN] >= 0:
                _correct(second, settings.firsts)
                if gate.verdict(contest) > 0:
                    _copy(second, main)
            out.q[run, i], out.w[run, i], out.covariance[run, i] = main.x[:4], main.x[4:7], main.P
            for k in range(K):
                if settings.firsts[k] >= 0:
                    for j in range(3):
                        out.optional[run, i, settings.firsts[k] - 6 + j] = main.x[7 + 3 * k + j]
