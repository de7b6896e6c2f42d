"""Multiplicative extended Kalman filter (MEKF) of attitude and rate.

See docs/theory/attitude-kalman-filters.md. Source: Ivanov, Ivlev, Karpenko, Ovchinnikov, Keldysh Institute preprint 64,
2014. Ours: the corrections of :mod:`adcs.satellite.dynamics`, and the factors 2 (δq is half an angle) missing there.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from adcs import quaternion
from adcs.frames import turned
from adcs.kalman.error_state import (
    ALWAYS,
    SIZES,
    STATES,
    AttitudeState,
    AttitudeTracks,
    FilterSettings,
    FilterStart,
    SensorSet,
)
from adcs.quaternion import rotate_back
from adcs.satellite import dynamics
from adcs.satellite.sensors import SENSORS
from adcs.satellite.telemetry import Record, is_read
from arrays.typing import BoolArray, FloatArray
from magloc import core
from magloc.navigation.rotations import cross_matrix

_COVARIANCES_A_CALL = 400_000
"""Elements of covariances that one call computes: about ten milliseconds."""
PATIENCE_S = 300.0
"""Time without an accepted reading of a sensor after which a second hypothesis replaces the main one, even if no other
sensor decides between them."""
PATIENT_READINGS = 10
"""The same for a gyro's bias, in instants. As many accepted readings of that sensor keep the main hypothesis, and as
many intervals of a sensor end its gap."""


def initial_state(settings: FilterSettings, start: FilterStart) -> AttitudeState:
    """Return the state before the first reading."""
    runs, size = len(start.q), settings.sensors.size
    P = np.zeros((runs, size, size))
    P[:, range(ALWAYS, size), range(ALWAYS, size)] = settings.start_variance
    known = start.covariance.shape[-1]
    P[:, :known, :known] = start.covariance
    zero = {state: np.zeros((runs, SIZES[state])) for state in settings.sensors.states}
    return AttitudeState(start.q, start.w, {**zero, **start.optional}, P)


def complete_start(settings: FilterSettings, start: FilterStart) -> FilterStart:
    """Return a start with the missing optional states added."""
    state = initial_state(settings, start)
    return FilterStart(state.q, state.w, state.P, state.optional)


def known_torque_jacobian(record: Record, row: int, state: AttitudeState) -> FloatArray:
    """Return F (runs, 6, 6) of a filter that knows the torque of the wheels.

    See :func:`adcs.satellite.dynamics.error_jacobian`.
    """
    around = record.environment
    return dynamics.error_jacobian(
        record.satellite.body,
        state.q,
        state.w,
        record.momentum_Nms[:, row],
        around.gravity_s2[:, row],
        around.b_orbital_T[:, row],
        state.optional_state("dipole") + record.torquers_Am2[:, row],
    )


def acceleration_by_dipole(record: Record, row: int, state: AttitudeState) -> FloatArray:
    """Return the Jacobian of dω/dt with respect to a dipole [A·m²], -J⁻¹W(AB), shape (runs, 3, 3)."""
    b_body = rotate_back(state.q, record.environment.b_orbital_T[:, row])
    return -record.satellite.body.inverse @ cross_matrix(b_body)


def transition(F: FloatArray, by_dipole: FloatArray, settings: FilterSettings, dt_s: float) -> FloatArray:
    """Return Φ (runs, N, N) of the error state to the third order of the step.

    ``F`` (runs, 6, 6): of attitude and rate. ``by_dipole`` (runs, 3, 3): of :func:`acceleration_by_dipole`.
    """
    used = settings.sensors
    full = np.zeros((len(F), used.size, used.size))
    full[:, :ALWAYS, :ALWAYS] = F
    for state, acceleration in (("disturbance", np.eye(3)), ("dipole", by_dipole)):
        if state in used.states:
            full[:, 3:6, used.slice_of(state)] = acceleration
    return third_order_exponential(full * dt_s)


def third_order_exponential(A: FloatArray) -> FloatArray:
    """Return the matrix exponential of matrices (..., n, n) to the third order."""
    squared = A @ A
    return np.asarray(np.eye(A.shape[-1]) + A + squared / 2.0 + squared @ A / 6.0)


def propagate(record: Record, row: int, state: AttitudeState) -> tuple[FloatArray, FloatArray]:
    """Propagate attitude (runs, 4) and rate (runs, 3) by one step from instant ``row``."""
    satellite, around = record.satellite, record.environment
    q, w, _ = dynamics.step(
        satellite.body,
        state.q,
        state.w,
        record.momentum_Nms[:, row],
        record.wheel_torque_Nm[:, row],
        state.optional_state("disturbance") @ satellite.body.inertia_kgm2,
        around.orbital_rate_rad_s[:, row],
        around.gravity_s2[:, row],
        around.b_orbital_T[:, row],
        float(record.steps_s[row]),
        state.optional_state("dipole") + record.torquers_Am2[:, row],
    )
    return q, w


def added_variance(record: Record, settings: FilterSettings, step_s: float | FloatArray) -> FloatArray:
    """Return the diagonal of Q, (N,), or (k, N) for steps (k, 1), with the stated walks of the sensors' biases."""
    variance, satellite = settings.process_variance(step_s, record.dt_s), record.satellite
    walks = {"gyro-bias": satellite.gyro.bias_walk_rad_s, "field-bias": satellite.magnetometer.bias_walk_T}
    for state, walk in walks.items():
        if state in settings.sensors.states:
            variance[..., settings.sensors.slice_of(state)] += walk**2 * np.asarray(step_s)
    return variance


def predict(
    record: Record, row: int, state: AttitudeState, settings: FilterSettings
) -> tuple[AttitudeState, FloatArray]:
    """Predict the state one step after instant ``row``; also return Φ (runs, N, N)."""
    step_s = float(record.steps_s[row])
    decay = settings.decay(step_s)
    own = {
        name: decay[settings.sensors.slice_of(name)] * state.optional_state(name) for name in settings.sensors.states
    }
    state = replace(state, optional={**state.optional, **own}, P=decay[:, None] * state.P * decay)
    q, w = propagate(record, row, state)
    ahead = replace(state, q=q, w=w)
    F = 0.5 * (known_torque_jacobian(record, row, state) + known_torque_jacobian(record, row + 1, ahead))
    by_dipole = 0.5 * (acceleration_by_dipole(record, row, state) + acceleration_by_dipole(record, row + 1, ahead))
    Phi = transition(F, by_dipole, settings, step_s)
    P = Phi @ state.P @ Phi.mT + np.diag(added_variance(record, settings, step_s))
    return replace(ahead, P=0.5 * (P + P.mT)), Phi * decay


def deviations(record: Record, settings: FilterSettings) -> FloatArray:
    """Return the noise per component of star tracker, gyro, magnetometer and Sun sensor, shape (4,)."""
    satellite = record.satellite
    error_T = 0.0 if "field-model" in settings.sensors.states else settings.field_error_T
    return np.array(
        [
            satellite.star_tracker.sigma_rad,
            satellite.gyro.sigma_rad_s,
            np.hypot(satellite.magnetometer.sigma_T, error_T),
            satellite.sun_sensor.sigma_rad,
        ]
    )


def residuals(
    record: Record, row: int, state: AttitudeState, used: SensorSet
) -> list[tuple[int, FloatArray, FloatArray]]:
    """Return index in SENSORS, residual (runs, 3) and H (runs, 3, N) of each sensor of a set.

    The residual at instant ``row`` is NaN without a reading.
    """
    readings, around = record.readings, record.environment

    def rows(first: int, part: FloatArray, bias: str = "") -> FloatArray:
        """Return H with a block (3, 3) from one column on, and ones for an estimated bias."""
        H = np.zeros((len(state.q), 3, used.size))
        H[..., first : first + 3] = part
        if bias in used.states:
            H[..., used.slice_of(bias)] = np.eye(3)
        return H

    parts: list[tuple[int, FloatArray, FloatArray]] = []
    if used.star:
        W = readings.star_whitening[:, row]
        parts.append((0, turned(W, quaternion.error_vector(state.q, readings.star[:, row])), rows(0, W)))
    if used.gyro:
        residual = readings.gyro_rad_s[:, row] - state.w - state.optional_state("gyro-bias")
        parts.append((1, residual, rows(3, np.eye(3), "gyro-bias")))
    if used.magnetometer:
        b = rotate_back(state.q, around.b_orbital_T[:, row] + state.optional_state("field-model"))
        gain = np.eye(3) + state.optional_state("field-gain").reshape(-1, 3, 3)
        residual = readings.field_T[:, row] - turned(gain, b) - state.optional_state("field-bias")
        H = rows(0, 2.0 * gain @ cross_matrix(b), "field-bias")
        if "field-model" in used.states:
            H[..., used.slice_of("field-model")] = gain @ quaternion.matrix(state.q).mT
        if "field-gain" in used.states:
            # Row i of D multiplies the whole field and changes component i.
            H[..., used.slice_of("field-gain")] = np.einsum("ij,rk->rijk", np.eye(3), b).reshape(-1, 3, 9)
        parts.append((2, residual, H))
    if used.sun:
        s = rotate_back(state.q, around.sun_orbital[:, row])
        parts.append((3, readings.sun[:, row] - s, rows(0, 2.0 * cross_matrix(s))))
    return parts


def stacked_residuals(
    record: Record, row: int, state: AttitudeState, settings: FilterSettings
) -> tuple[FloatArray, FloatArray]:
    """Return H (runs, k, N) and residual (runs, k) of all sensors in units of their noise.

    Both are zero without a reading, so that the update changes nothing.
    """
    sigma = deviations(record, settings)
    H, residual = [], []
    for sensor, one, rows in residuals(record, row, state, settings.sensors):
        seen = is_read(one)
        H.append(np.where(seen[:, None, None], rows / sigma[sensor], 0.0))
        residual.append(np.where(seen[:, None], one / sigma[sensor], 0.0))
    return np.concatenate(H, axis=1), np.concatenate(residual, axis=1)


def sensor_nis(noise: FloatArray, H: FloatArray, residual: FloatArray, used: SensorSet) -> FloatArray:
    """Return NIS (runs, 4) of each sensor given those before it.

    ``noise`` (runs, k, k): covariance of the stacked residuals.
    """
    whitened = np.linalg.solve(np.linalg.cholesky(noise), residual[..., None])[..., 0]
    each = np.sum(whitened.reshape(len(H), -1, 3) ** 2, axis=-1)
    read = (H != 0.0).any(axis=-1)[:, ::3] | (H != 0.0).any(axis=-1)[:, 1::3]
    nis = np.full((len(H), len(SENSORS)), np.nan)
    nis[:, [used.star, used.gyro, used.magnetometer, used.sun]] = np.where(read, each, np.nan)
    return nis


def joseph_update(
    P: FloatArray, H: FloatArray, residual: FloatArray, K: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Return the correction (runs, N) and the covariance (E - KH) P (E - KH)ᵀ + KKᵀ.

    ``residual`` (runs, k): in units of the noise. ``K`` (runs, N, k): gain, by default the optimal one.
    """
    if K is None:
        PHt = P @ H.mT
        K = np.asarray(np.linalg.solve(H @ PHt + np.eye(H.shape[-2]), PHt.mT).mT)
    rest = np.eye(P.shape[-1]) - K @ H
    return (K @ residual[..., None])[..., 0], rest @ P @ rest.mT + K @ K.mT


def update_state(
    record: Record, row: int, state: AttitudeState, settings: FilterSettings, gain: FloatArray | None = None
) -> tuple[AttitudeState, FloatArray]:
    """Update the state by all readings of instant ``row``, without a gate; also return NIS (runs, 4).

    ``gain`` (runs, N, k): gain for the k stacked residuals, by default the optimal one.
    """
    H, residual = stacked_residuals(record, row, state, settings)
    nis = sensor_nis(H @ state.P @ H.mT + np.eye(H.shape[1]), H, residual, settings.sensors)
    # A sensor without a reading has rows of zeros in H, and must add no noise.
    K = None if gain is None else gain * (H != 0.0).any(axis=-1)[:, None, :]
    dx, P = joseph_update(state.P, H, residual, K)
    return replace(apply_error(state, dx, settings.sensors), P=P), nis


def apply_error(state: AttitudeState, dx: FloatArray, used: SensorSet) -> AttitudeState:
    """Return the state corrected by an error state (runs, N): the reset of the MEKF."""
    q = quaternion.multiply(state.q, quaternion.from_error_vector(dx[:, :3]))
    optional = {
        **state.optional,
        **{name: state.optional_state(name) + dx[:, used.slice_of(name)] for name in used.states},
    }
    return replace(state, q=quaternion.normalised(q), w=state.w + dx[:, 3:6], optional=optional)


def collect_tracks(
    settings: FilterSettings,
    states: list[AttitudeState],
    nis: FloatArray,
    rejected: BoolArray | None = None,
    log_det: FloatArray | None = None,
) -> AttitudeTracks:
    """Collect the states of all instants; without ``rejected`` no reading is rejected."""
    return AttitudeTracks(
        settings,
        np.stack([state.q for state in states], axis=1),
        np.stack([state.w for state in states], axis=1),
        {name: np.stack([state.optional_state(name) for state in states], axis=1) for name in settings.sensors.states},
        np.stack([state.P for state in states], axis=1),
        nis,
        np.zeros(nis.shape, dtype=np.bool_) if rejected is None else rejected,
        np.full(nis.shape, np.nan) if log_det is None else log_det,
    )


def check_start(record: Record, start: FilterStart) -> None:
    """Raise ValueError unless a start is finite and has as many runs as the record."""
    runs = record.momentum_Nms.shape[0]
    size = ALWAYS + sum(SIZES[state] for state in start.optional)
    for name, shape in (("q", (runs, 4)), ("w", (runs, 3)), ("covariance", (runs, size, size))):
        values = getattr(start, name)
        if values.shape != shape or not np.isfinite(values).all():
            raise ValueError(f"Input start.{name} must be finite with shape {shape}; instead received {values.shape}.")


def run_filter(
    record: Record, settings: FilterSettings, start: FilterStart, *, closed_loop_F: bool = False
) -> AttitudeTracks:
    """Filter whole runs in compiled code, in parallel over runs.

    ``record``: any number of runs, such as :class:`sims.attitude.simulation.AttitudeRuns`. ``start``: start of each
    run, from :func:`start_near` or :mod:`adcs.kalman.initialisation`. ``closed_loop_F``: use the Jacobian of the source
    paper, which assumes that the control knows the true state, so that its filters are overconfident. Raises
    ValueError if the start does not have as many runs as the record.
    """
    check_start(record, start)
    work, tracks = filter_problem(record, settings, start, closed_loop_F=closed_loop_F)
    runs, n = record.momentum_Nms.shape[:2]
    block = _COVARIANCES_A_CALL // settings.sensors.size**2
    core.run("mekf_runs", work, runs * n, block=block, chain=n * max(1, block // max(1, n)))
    return tracks


def filter_problem(
    record: Record, settings: FilterSettings, start: FilterStart, *, closed_loop_F: bool = False, n_before: int = 0
) -> tuple[core.Problem, AttitudeTracks]:
    """Return the description of a filter to the kernel ``mekf_runs``, and the tracks that the kernel fills.

    ``n_before``: instants that the filter of one run in the kernel's workspace has taken. Above 0, the record begins
    with the last of them, and the start is not used.
    """
    used, around, readings = settings.sensors, record.environment, record.readings
    first, sigma = initial_state(settings, start), deviations(record, settings)
    runs, n = record.momentum_Nms.shape[:2]
    q, w, optional = np.empty((runs, n, 4)), np.empty((runs, n, 3)), np.empty((runs, n, used.size - ALWAYS))
    covariance, (nis, log_det) = np.empty((runs, n, used.size, used.size)), np.full((2, runs, n, len(SENSORS)), np.nan)
    rejected = np.zeros(nis.shape, dtype=np.bool_)
    body = record.satellite.body
    each_instant = {
        "momentum": record.momentum_Nms,
        "wheel_torque": record.wheel_torque_Nm,
        "torquers": record.torquers_Am2,
        "orbital_rate": around.orbital_rate_rad_s,
        "gravity": around.gravity_s2,
        "field_model": around.b_orbital_T,
        "sun_model": around.sun_orbital,
        "star": readings.star,
        "star_whitening": readings.star_whitening,
        "gyro": readings.gyro_rad_s,
        "field": readings.field_T,
        "sun": readings.sun,
    }
    for name, values in each_instant.items():
        if values.shape[:2] != (runs, n) or len(around.time_s) != n:
            raise ValueError(
                f"Input record must have {name} of {runs} runs and {n} instants; instead received {values.shape}."
            )
    inputs = {
        **each_instant,
        "inertia": body.inertia_kgm2,
        "inverse_inertia": body.inverse,
        "residual_dipole": body.residual_dipole_Am2,
        "attitude_gain": record.satellite.control.attitude_gain_Nm,
        "rate_gain": record.satellite.control.rate_gain_Nms,
        "dt": record.steps_s,
        "first_q": first.q,
        "first_w": first.w,
        "first_optional": np.concatenate([np.zeros((runs, 0)), *first.optional.values()], axis=1),
        "first_covariance": first.P,
        "sigma": sigma,
        "kept": settings.decay(record.steps_s[:, None]),
        "added_variance": added_variance(record, settings, record.steps_s[:, None]),
        "open_variance": settings.open_variance,
    }
    places = [_first_index(used, state, part) for state in STATES for part in range(SIZES[state] // 3)]
    fields: dict[str, Any] = dict(
        n_runs=runs,
        n_instants=n,
        n_states=used.size,
        has_feedback=closed_loop_F,
        used=np.array([used.star, used.gyro, used.magnetometer, used.sun], dtype=np.uint8),
        place=np.array(places, dtype=np.int64),
        gate_limit=settings.gate_limit,
        patience=np.array([patience(sensor, record.dt_s) for sensor in range(len(SENSORS))], dtype=np.int64),
        q=q,
        w=w,
        optional=optional,
        covariance=covariance,
        nis=nis,
        log_determinant=log_det,
        rejected=rejected.view(np.uint8),
        n_before=n_before,
        **{name: np.ascontiguousarray(values, dtype=np.float64) for name, values in inputs.items()},
    )
    parts = np.split(optional, np.cumsum([SIZES[state] for state in used.states]), axis=-1)
    by_state = dict(zip(used.states, parts, strict=False))
    tracks = AttitudeTracks(settings, q, w, by_state, covariance, nis, rejected, log_det)
    return core.problem("mekf", **fields), tracks


def patience(sensor: int, dt_s: float) -> int:
    """Return the instants after which a sensor's second hypothesis wins without another sensor."""
    return PATIENT_READINGS if SENSORS[sensor] == "gyro" else round(PATIENCE_S / dt_s)


def _first_index(used: SensorSet, state: str, part: int) -> int:
    """Return the index in the error state of a part of an optional state; -1 if it is not in the set."""
    return used.slice_of(state).start + 3 * part if state in used.states else -1
