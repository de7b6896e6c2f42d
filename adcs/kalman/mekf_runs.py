"""Whole runs of the multiplicative Kalman filter by a compiled kernel; :mod:`adcs.kalman.mekf` is the reference."""

from __future__ import annotations

from typing import Any

import numpy as np

from adcs.kalman.error_state import ALWAYS, SIZES, STATES, AttitudeTracks, FilterSettings, SensorSet, State
from adcs.satellite.sensors import SENSORS
from adcs.satellite.telemetry import Record
from arrays.typing import FloatArray
from magloc import core

_COVARIANCES_A_CALL = 400_000
"""Elements of covariances that one call computes: about ten milliseconds."""
PATIENCE_S = 300.0
"""A main hypothesis that has taken no reading of the sensor for so long loses against readings that agree, though no
other sensor tells: what lasts as long is the truth."""
PATIENT_READINGS = 10
"""The same for a gyro's bias, which costs the attitude nothing, in instants. Also: a main hypothesis that takes as many
readings of that sensor meanwhile is not wrong, and a sensor is back from a gap after as many of its intervals."""


def filter_runs(
    record: Record, settings: FilterSettings, first: State, sigma: FloatArray, *, closed_loop_F: bool = False
) -> AttitudeTracks:
    """Filter all runs of a record from their first states; sigma (4,) is the noise of a component of each reading."""
    used, around, readings = settings.sensors, record.environment, record.readings
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
