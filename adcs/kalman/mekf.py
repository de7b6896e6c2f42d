"""Multiplicative (error-state) Kalman filter of attitude and rate, assembled from any sensors and optional states.

See docs/theory/attitude-kalman-filters.md. Source: Ivanov, Ivlev, Karpenko, Ovchinnikov, Keldysh Institute preprint 64,
2014, with the corrections of :mod:`adcs.satellite.dynamics`; the factors 2 (δq is half an angle) are missing there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace

import numpy as np

from adcs import quaternion
from adcs.kalman.error_state import (
    ALWAYS,
    ATTRIBUTES,
    STATES,
    AttitudeTracks,
    FilterSettings,
    SensorSet,
    Start,
    State,
    optional_of,
)
from adcs.quaternion import cross_matrix, rotate_back
from adcs.satellite import dynamics
from adcs.satellite.sensors import SENSORS
from adcs.satellite.telemetry import Record, is_read
from arrays.typing import FloatArray

Jacobian = Callable[[Record, int, FloatArray, FloatArray], FloatArray]
"""F (runs, 6, 6) of attitude and rate from record, row, q (runs, 4) and w (runs, 3)."""


def first_state(settings: FilterSettings, start: Start) -> State:
    """State before the first reading."""
    runs, size = len(start.q), settings.sensors.size
    P = np.zeros((runs, size, size))
    P[:, :ALWAYS, :ALWAYS] = start.covariance
    P[:, range(ALWAYS, size), range(ALWAYS, size)] = settings.start_variance
    zero = np.zeros((runs, 3))
    return State(start.q, start.w, zero, zero, zero, P)


def known_torque_jacobian(record: Record, row: int, q: FloatArray, w: FloatArray) -> FloatArray:
    """F (runs, 6, 6) of a filter that is told the wheels' torque.

    See :func:`adcs.satellite.dynamics.error_jacobian`.
    """
    around = record.environment
    return dynamics.error_jacobian(
        record.satellite.body, q, w, record.momentum_Nms[:, row], around.gravity_s2[:, row], around.b_orbital_T[:, row]
    )


def closed_loop_jacobian(record: Record, row: int, q: FloatArray, w: FloatArray) -> FloatArray:
    """F of the source paper (``closed_loop_F``), wrong.

    See :func:`adcs.satellite.dynamics.closed_loop_error_jacobian`.
    """
    satellite = record.satellite
    return dynamics.closed_loop_error_jacobian(
        satellite.body, satellite.control, q, w, quaternion.IDENTITY, record.environment.gravity_s2[:, row]
    )


def transition(F: FloatArray, used: SensorSet, dt_s: float) -> FloatArray:
    """Φ (runs, N, N) of the error state from F (runs, 6, 6) of attitude and rate, to the third order of the step."""
    full = np.zeros((len(F), used.size, used.size))
    full[:, :ALWAYS, :ALWAYS] = F
    if used.disturbance:
        first = used.first_of("disturbance")
        full[:, 3:6, first : first + 3] = np.eye(3)
    step = full * dt_s
    squared = step @ step
    return np.eye(used.size) + step + squared / 2.0 + squared @ step / 6.0


def moved(record: Record, row: int, state: State) -> tuple[FloatArray, FloatArray]:
    """Attitude and rate (runs, 4), (runs, 3) one step after instant ``row``, by the equations of motion."""
    satellite, around = record.satellite, record.environment
    q, w, _ = dynamics.step(
        satellite.body,
        state.q,
        state.w,
        record.momentum_Nms[:, row],
        record.wheel_torque_Nm[:, row],
        state.disturbance_s2 @ satellite.body.inertia_kgm2,
        around.orbital_rate_rad_s[:, row],
        around.gravity_s2[:, row],
        around.b_orbital_T[:, row],
        record.dt_s,
    )
    return q, w


def predicted(
    record: Record, row: int, state: State, settings: FilterSettings, jacobian: Jacobian = known_torque_jacobian
) -> tuple[State, FloatArray]:
    """State one step after instant ``row`` before its readings, and Φ (runs, N, N)."""
    q, w = moved(record, row, state)
    F = 0.5 * (jacobian(record, row, state.q, state.w) + jacobian(record, row + 1, q, w))
    Phi = transition(F, settings.sensors, record.dt_s)
    P = Phi @ state.P @ Phi.mT + np.diag(settings.process_variance)
    return replace(state, q=q, w=w, P=0.5 * (P + P.mT)), Phi


def deviations(record: Record, settings: FilterSettings) -> FloatArray:
    """Noise of one component of the readings of star tracker, gyro, magnetometer and Sun sensor, shape (4,)."""
    satellite = record.satellite
    return np.array(
        [
            satellite.star_tracker.sigma_rad,
            satellite.gyro.sigma_rad_s,
            np.hypot(satellite.magnetometer.sigma_T, settings.field_error_T),
            satellite.sun_sensor.sigma_rad,
        ]
    )


def residuals(record: Record, row: int, state: State, used: SensorSet) -> list[tuple[int, FloatArray, FloatArray]]:
    """Sensor's place in SENSORS, residual (runs, 3) and H (runs, 3, N) of every sensor of a set at instant ``row``.

    NaN where there is no reading.
    """
    readings, around = record.readings, record.environment

    def rows(first: int, part: FloatArray, bias: str = "") -> FloatArray:
        """H with a part (3, 3) from one column on, and ones for a bias that is estimated."""
        H = np.zeros((len(state.q), 3, used.size))
        H[..., first : first + 3] = part
        if bias in used.states:
            H[..., used.first_of(bias) : used.first_of(bias) + 3] = np.eye(3)
        return H

    parts: list[tuple[int, FloatArray, FloatArray]] = []
    if used.star:
        parts.append((0, quaternion.error_vector(state.q, readings.star[:, row]), rows(0, np.eye(3))))
    if used.gyro:
        residual = readings.gyro_rad_s[:, row] - state.w - state.gyro_bias_rad_s
        parts.append((1, residual, rows(3, np.eye(3), "gyro-bias")))
    if used.magnetometer:
        b = rotate_back(state.q, around.b_orbital_T[:, row])
        residual = readings.field_T[:, row] - b - state.field_bias_T
        parts.append((2, residual, rows(0, 2.0 * cross_matrix(b), "field-bias")))
    if used.sun:
        s = rotate_back(state.q, around.sun_orbital[:, row])
        parts.append((3, readings.sun[:, row] - s, rows(0, 2.0 * cross_matrix(s))))
    return parts


def stacked_residuals(
    record: Record, row: int, state: State, settings: FilterSettings
) -> tuple[FloatArray, FloatArray]:
    """H (runs, k, N) and residual (runs, k) of all sensors at instant ``row``, in units of their noise.

    Both are zero where there is no reading, which teaches nothing.
    """
    sigma = deviations(record, settings)
    H, residual = [], []
    for sensor, one, rows in residuals(record, row, state, settings.sensors):
        seen = is_read(one)
        H.append(np.where(seen[:, None, None], rows / sigma[sensor], 0.0))
        residual.append(np.where(seen[:, None], one / sigma[sensor], 0.0))
    return np.concatenate(H, axis=1), np.concatenate(residual, axis=1)


def nis_of(noise: FloatArray, H: FloatArray, residual: FloatArray, used: SensorSet) -> FloatArray:
    """NIS (runs, 4) of every sensor given those before it, from stacked residuals and their covariance (runs, k, k)."""
    whitened = np.linalg.solve(np.linalg.cholesky(noise), residual[..., None])[..., 0]
    each = np.sum(whitened.reshape(len(H), -1, 3) ** 2, axis=-1)
    read = (H != 0.0).any(axis=-1)[:, ::3] | (H != 0.0).any(axis=-1)[:, 1::3]
    nis = np.full((len(H), len(SENSORS)), np.nan)
    nis[:, [used.star, used.gyro, used.magnetometer, used.sun]] = np.where(read, each, np.nan)
    return nis


def joseph_update(P: FloatArray, H: FloatArray, residual: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Correction (runs, N) and covariance (E - KH) P (E - KH)ᵀ + KKᵀ, from residuals (runs, k) in noise units."""
    PHt = P @ H.mT
    K = np.linalg.solve(H @ PHt + np.eye(H.shape[-2]), PHt.mT).mT
    rest = np.eye(P.shape[-1]) - K @ H
    return (K @ residual[..., None])[..., 0], rest @ P @ rest.mT + K @ K.mT


def corrected(record: Record, row: int, state: State, settings: FilterSettings) -> tuple[State, FloatArray]:
    """State with the readings of instant ``row``, and NIS (runs, 4); all sensors are linearised at ``state``."""
    H, residual = stacked_residuals(record, row, state, settings)
    nis = nis_of(H @ state.P @ H.mT + np.eye(H.shape[1]), H, residual, settings.sensors)
    dx, P = joseph_update(state.P, H, residual)
    return replace(with_error(state, dx, settings.sensors), P=P), nis


def with_error(state: State, dx: FloatArray, used: SensorSet) -> State:
    """State into which an error (runs, N) is put."""
    q = quaternion.multiply(state.q, quaternion.from_error_vector(dx[:, :3]))
    optional = {}
    for name, values in optional_of(state, used).items():
        first = used.first_of(name)
        optional[ATTRIBUTES[name]] = values + dx[:, first : first + 3]
    return replace(state, q=quaternion.normalised(q), w=state.w + dx[:, 3:6], **optional)


def run_readable(
    record: Record,
    settings: FilterSettings,
    start: Start,
    jacobian: Jacobian = known_torque_jacobian,
) -> AttitudeTracks:
    """Filter of whole runs in NumPy, the reference of :func:`run_filter`.

    ``jacobian``: :func:`known_torque_jacobian`, or :func:`closed_loop_jacobian` to reproduce the source paper.
    """
    check_start(record, start)
    state, nis = corrected(record, 0, first_state(settings, start), settings)
    states, innovations = [state], [nis]
    for row in range(record.momentum_Nms.shape[1] - 1):
        state, _ = predicted(record, row, state, settings, jacobian)
        state, nis = corrected(record, row + 1, state, settings)
        states.append(state)
        innovations.append(nis)
    return collected(settings, states, np.stack(innovations, axis=1))


def collected(settings: FilterSettings, states: list[State], nis: FloatArray) -> AttitudeTracks:
    """Estimates of the states of all instants."""
    # A state has the fields of a track, in their order.
    stacked = [np.stack([getattr(state, one.name) for state in states], axis=1) for one in fields(State)]
    return AttitudeTracks(settings, *[*stacked, nis])


def check_start(record: Record, start: Start) -> None:
    """Raise ValueError unless a start has as many runs as the record, and none of it is missing."""
    runs = record.momentum_Nms.shape[0]
    for name, shape in (("q", (runs, 4)), ("w", (runs, 3)), ("covariance", (runs, ALWAYS, ALWAYS))):
        values = getattr(start, name)
        if values.shape != shape or not np.isfinite(values).all():
            raise ValueError(f"Input start.{name} must be finite with shape {shape}; instead received {values.shape}.")


def run_filter(record: Record, settings: FilterSettings, start: Start) -> AttitudeTracks:
    """Filter of whole runs, compiled; runs are shared out among the threads of numba.

    ``record``: of any number of runs, such as :class:`sims.attitude.simulation.AttitudeRuns`. ``start``: one for
    every run: :func:`start_near`, or :mod:`adcs.kalman.initialisation`. Raises ValueError: the start does not have
    as many runs as the record.
    """
    from adcs.kalman import mekf_compiled as kernel
    from adcs.satellite import dynamics_compiled
    from magloc.compilation import over_rows

    check_start(record, start)
    used, first, around = settings.sensors, first_state(settings, start), record.environment
    runs, n = record.momentum_Nms.shape[:2]
    q, w, optional = np.empty((runs, n, 4)), np.empty((runs, n, 3)), np.zeros((3, runs, n, 3))
    covariance, nis = np.empty((runs, n, used.size, used.size)), np.full((runs, n, len(SENSORS)), np.nan)
    readings = record.readings
    wheels = (record.momentum_Nms, record.wheel_torque_Nm)
    read = (readings.star, readings.gyro_rad_s, readings.field_T, readings.sun, around.sun_orbital)
    places = (around.orbital_rate_rad_s, around.gravity_s2, around.b_orbital_T)
    over_rows(
        kernel.run,
        runs,
        kernel.Estimated(q, w, optional, covariance, nis),
        kernel.First(np.ascontiguousarray(first.q), np.ascontiguousarray(first.w), first.P),
        dynamics_compiled.Body.of(record.satellite.body),
        # One layout in memory, for which the kernel is compiled.
        kernel.Record(*(np.ascontiguousarray(values, dtype=np.float64) for values in (*wheels, *read))),
        dynamics_compiled.Surroundings(*(np.ascontiguousarray(values, dtype=np.float64) for values in places)),
        kernel.Settings(
            np.array([used.star, used.gyro, used.magnetometer, used.sun]),
            deviations(record, settings),
            np.array([used.first_of(state) for state in STATES]),
            settings.process_variance,
        ),
        record.dt_s,
    )
    return AttitudeTracks(settings, q, w, optional[0], optional[1], optional[2], covariance, nis)
