"""Multiplicative (error-state) Kalman filter of attitude and rate, assembled from any sensors and optional states.

See docs/theory/attitude-kalman-filters.md. Source: Ivanov, Ivlev, Karpenko, Ovchinnikov, Keldysh Institute preprint 64,
2014, with the corrections of :mod:`adcs.satellite.dynamics`; the factors 2 (δq is half an angle) are missing there.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from adcs import quaternion
from adcs.frames import turned
from adcs.kalman.error_state import ALWAYS, SIZES, STATES, AttitudeTracks, FilterSettings, SensorSet, Start, State
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
"""A main hypothesis that has taken no reading of the sensor for so long loses against readings that agree, though no
other sensor tells: what lasts as long is the truth."""
PATIENT_READINGS = 10
"""The same for a gyro's bias, which costs the attitude nothing, in instants. Also: a main hypothesis that takes as many
readings of that sensor meanwhile is not wrong, and a sensor is back from a gap after as many of its intervals."""


def first_state(settings: FilterSettings, start: Start) -> State:
    """State before the first reading."""
    runs, size = len(start.q), settings.sensors.size
    P = np.zeros((runs, size, size))
    P[:, range(ALWAYS, size), range(ALWAYS, size)] = settings.start_variance
    known = start.covariance.shape[-1]
    P[:, :known, :known] = start.covariance
    zero = {state: np.zeros((runs, SIZES[state])) for state in settings.sensors.states}
    return State(start.q, start.w, {**zero, **start.optional}, P)


def whole_start(settings: FilterSettings, start: Start) -> Start:
    """Return a start that has the optional states too."""
    state = first_state(settings, start)
    return Start(state.q, state.w, state.P, state.optional)


def known_torque_jacobian(record: Record, row: int, state: State) -> FloatArray:
    """F (runs, 6, 6) of a filter that is told the wheels' torque.

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
        state.of("dipole") + record.torquers_Am2[:, row],
    )


def acceleration_by_dipole(record: Record, row: int, state: State) -> FloatArray:
    """What a dipole [A·m²] adds to dω/dt, -J⁻¹W(AB), shape (runs, 3, 3)."""
    b_body = rotate_back(state.q, record.environment.b_orbital_T[:, row])
    return -record.satellite.body.inverse @ cross_matrix(b_body)


def transition(F: FloatArray, by_dipole: FloatArray, settings: FilterSettings, dt_s: float) -> FloatArray:
    """Φ (runs, N, N) of the error state to the third order of the step.

    ``F`` (runs, 6, 6): of attitude and rate. ``by_dipole`` (runs, 3, 3): of :func:`acceleration_by_dipole`.
    """
    used = settings.sensors
    full = np.zeros((len(F), used.size, used.size))
    full[:, :ALWAYS, :ALWAYS] = F
    for state, acceleration in (("disturbance", np.eye(3)), ("dipole", by_dipole)):
        if state in used.states:
            full[:, 3:6, used.place(state)] = acceleration
    step = full * dt_s
    squared = step @ step
    return np.asarray(np.eye(used.size) + step + squared / 2.0 + squared @ step / 6.0)


def moved(record: Record, row: int, state: State) -> tuple[FloatArray, FloatArray]:
    """Attitude and rate (runs, 4), (runs, 3) one step after instant ``row``, by the equations of motion."""
    satellite, around = record.satellite, record.environment
    q, w, _ = dynamics.step(
        satellite.body,
        state.q,
        state.w,
        record.momentum_Nms[:, row],
        record.wheel_torque_Nm[:, row],
        state.of("disturbance") @ satellite.body.inertia_kgm2,
        around.orbital_rate_rad_s[:, row],
        around.gravity_s2[:, row],
        around.b_orbital_T[:, row],
        float(record.steps_s[row]),
        state.of("dipole") + record.torquers_Am2[:, row],
    )
    return q, w


def predicted(record: Record, row: int, state: State, settings: FilterSettings) -> tuple[State, FloatArray]:
    """State one step after instant ``row`` before its readings, and Φ (runs, N, N): decay, and then motion."""
    step_s = float(record.steps_s[row])
    kept = settings.kept(step_s)
    own = {name: kept[settings.sensors.place(name)] * state.of(name) for name in settings.sensors.states}
    state = replace(state, optional={**state.optional, **own}, P=kept[:, None] * state.P * kept)
    q, w = moved(record, row, state)
    ahead = replace(state, q=q, w=w)
    F = 0.5 * (known_torque_jacobian(record, row, state) + known_torque_jacobian(record, row + 1, ahead))
    by_dipole = 0.5 * (acceleration_by_dipole(record, row, state) + acceleration_by_dipole(record, row + 1, ahead))
    Phi = transition(F, by_dipole, settings, step_s)
    P = Phi @ state.P @ Phi.mT + np.diag(settings.process_variance(step_s, record.dt_s))
    return replace(ahead, P=0.5 * (P + P.mT)), Phi * kept


def deviations(record: Record, settings: FilterSettings) -> FloatArray:
    """Noise of one component of the readings of star tracker, gyro, magnetometer and Sun sensor, shape (4,)."""
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
            H[..., used.place(bias)] = np.eye(3)
        return H

    parts: list[tuple[int, FloatArray, FloatArray]] = []
    if used.star:
        W = readings.star_whitening[:, row]
        parts.append((0, turned(W, quaternion.error_vector(state.q, readings.star[:, row])), rows(0, W)))
    if used.gyro:
        residual = readings.gyro_rad_s[:, row] - state.w - state.of("gyro-bias")
        parts.append((1, residual, rows(3, np.eye(3), "gyro-bias")))
    if used.magnetometer:
        b = rotate_back(state.q, around.b_orbital_T[:, row] + state.of("field-model"))
        gain = np.eye(3) + state.of("field-gain").reshape(-1, 3, 3)
        residual = readings.field_T[:, row] - turned(gain, b) - state.of("field-bias")
        H = rows(0, 2.0 * gain @ cross_matrix(b), "field-bias")
        if "field-model" in used.states:
            H[..., used.place("field-model")] = gain @ quaternion.matrix(state.q).mT
        if "field-gain" in used.states:
            # Row i of D meets the whole field and tells component i.
            H[..., used.place("field-gain")] = np.einsum("ij,rk->rijk", np.eye(3), b).reshape(-1, 3, 9)
        parts.append((2, residual, H))
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
    """State with all readings of instant ``row``, without a gate, and NIS (runs, 4); linearised at ``state``."""
    H, residual = stacked_residuals(record, row, state, settings)
    nis = nis_of(H @ state.P @ H.mT + np.eye(H.shape[1]), H, residual, settings.sensors)
    dx, P = joseph_update(state.P, H, residual)
    return replace(with_error(state, dx, settings.sensors), P=P), nis


def with_error(state: State, dx: FloatArray, used: SensorSet) -> State:
    """State into which an error (runs, N) is put."""
    q = quaternion.multiply(state.q, quaternion.from_error_vector(dx[:, :3]))
    optional = {**state.optional, **{name: state.of(name) + dx[:, used.place(name)] for name in used.states}}
    return replace(state, q=quaternion.normalised(q), w=state.w + dx[:, 3:6], optional=optional)


def collected(
    settings: FilterSettings,
    states: list[State],
    nis: FloatArray,
    rejected: BoolArray | None = None,
    log_det: FloatArray | None = None,
) -> AttitudeTracks:
    """Estimates of the states of all instants; a filter without a gate rejects nothing."""
    return AttitudeTracks(
        settings,
        np.stack([state.q for state in states], axis=1),
        np.stack([state.w for state in states], axis=1),
        {name: np.stack([state.of(name) for state in states], axis=1) for name in settings.sensors.states},
        np.stack([state.P for state in states], axis=1),
        nis,
        np.zeros(nis.shape, dtype=np.bool_) if rejected is None else rejected,
        np.full(nis.shape, np.nan) if log_det is None else log_det,
    )


def check_start(record: Record, start: Start) -> None:
    """Raise ValueError unless a start has as many runs as the record, and none of it is missing."""
    runs = record.momentum_Nms.shape[0]
    size = ALWAYS + sum(SIZES[state] for state in start.optional)
    for name, shape in (("q", (runs, 4)), ("w", (runs, 3)), ("covariance", (runs, size, size))):
        values = getattr(start, name)
        if values.shape != shape or not np.isfinite(values).all():
            raise ValueError(f"Input start.{name} must be finite with shape {shape}; instead received {values.shape}.")


def run_filter(
    record: Record, settings: FilterSettings, start: Start, *, closed_loop_F: bool = False
) -> AttitudeTracks:
    """Filter of whole runs, compiled; runs are shared out among threads.

    ``record``: of any number of runs, such as :class:`sims.attitude.simulation.AttitudeRuns`. ``start``: one for
    every run: :func:`start_near`, or :mod:`adcs.kalman.initialisation`. ``closed_loop_F``: the source paper's Jacobian,
    as if the control saw the true state: its filters are overconfident. Raises ValueError: the start does not have as
    many runs as the record.
    """
    check_start(record, start)
    used, around, readings = settings.sensors, record.environment, record.readings
    first, sigma = first_state(settings, start), deviations(record, settings)
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
        "kept": settings.kept(record.steps_s[:, None]),
        "added_variance": settings.process_variance(record.steps_s[:, None], record.dt_s),
        "open_variance": settings.open_variance,
    }
    places = [_begins(used, state, part) for state in STATES for part in range(SIZES[state] // 3)]
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
        **{name: np.ascontiguousarray(values, dtype=np.float64) for name, values in inputs.items()},
    )
    work = core.problem("mekf", **fields)
    block = _COVARIANCES_A_CALL // used.size**2
    core.run("mekf_runs", work, runs * n, block=block, chain=n * max(1, block // max(1, n)))
    parts = np.split(optional, np.cumsum([SIZES[state] for state in used.states]), axis=-1)
    return AttitudeTracks(
        settings, q, w, dict(zip(used.states, parts, strict=False)), covariance, nis, rejected, log_det
    )


def patience(sensor: int, dt_s: float) -> int:
    """Instants after which a hypothesis that a reading of a sensor began is believed though no other sensor tells."""
    return PATIENT_READINGS if SENSORS[sensor] == "gyro" else round(PATIENCE_S / dt_s)


def _begins(used: SensorSet, state: str, part: int) -> int:
    """Where three numbers of an optional state begin in the error state; -1 where the set does not have it."""
    return used.place(state).start + 3 * part if state in used.states else -1
