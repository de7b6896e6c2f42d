"""Filter of attitude and gyro bias, (δq, δΔω), with the gyro as an input instead of a measurement.

See docs/theory/attitude-kalman-filters.md. Source: Ivanov, Ivlev, Karpenko, Ovchinnikov, Keldysh Institute preprint 64,
2014, Table 5, row [λ, Δω].
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from adcs import quaternion
from adcs.kalman.error_state import AttitudeState, AttitudeTracks, FilterSettings, FilterStart
from adcs.kalman.mekf import (
    check_start,
    collect_tracks,
    joseph_update,
    sensor_nis,
    stacked_residuals,
    third_order_exponential,
)
from adcs.satellite.dynamics import relative_rate
from adcs.satellite.telemetry import Record, is_read
from arrays.typing import FloatArray
from magloc.navigation.rotations import cross_matrix


def run_reduced(record: Record, settings: FilterSettings, start: FilterStart) -> AttitudeTracks:
    """Run the reduced filter over whole runs.

    ``settings``: a set with a gyro and the state ``gyro-bias`` alone. Its q_λ and q_g are used; the gyro's noise is
    added to the attitude. ``start``: only its attitude is used; the rate is from the gyro. The covariance has the order
    (δq, δω, δΔω), where δω is minus the error of the bias plus the gyro's noise.
    """
    used = settings.sensors
    if not used.gyro or used.states != ("gyro-bias",):
        raise ValueError(
            "Input settings must have a gyro and the state gyro-bias alone; "
            f"instead received {used.sensors!r} with the states {list(used.states)}."
        )
    check_start(record, start)
    rates = _fill_gaps(record.readings.gyro_rad_s)
    gyro_rad_s = record.satellite.gyro.sigma_rad_s
    runs, n = rates.shape[:2]
    walk = np.square([settings.noise.attitude, settings.noise.gyro_bias_rad_s]) / record.dt_s
    walk[1] += record.satellite.gyro.bias_walk_rad_s**2
    others = replace(settings, sensors=replace(used, gyro=False, states=()))
    P = np.zeros((runs, 6, 6))
    P[:, :3, :3], P[:, 3:, 3:] = start.covariance[:, :3, :3], settings.gyro_bias_sigma_rad_s**2 * np.eye(3)
    q, bias = start.q, np.zeros((runs, 3))
    states, nis = [], []
    for row in range(n):
        if row:
            h = float(record.steps_s[row - 1])
            Q = np.diag(np.repeat(walk * h + [(0.5 * gyro_rad_s * h) ** 2, 0.0], 3))
            w = 0.5 * (rates[:, row - 1] + rates[:, row]) - bias
            q, Phi = _propagate(q, w, record.environment.orbital_rate_rad_s[:, row - 1], h)
            P = Phi @ P @ Phi.mT + Q
        state = AttitudeState(q, rates[:, row] - bias, {}, P)
        H, residual = stacked_residuals(record, row, state, others)
        noise = H @ P @ H.mT + np.eye(H.shape[1])
        nis.append(sensor_nis(noise, H, residual, others.sensors))
        dx, P = joseph_update(P, H, residual)
        q = quaternion.normalised(quaternion.multiply(q, quaternion.from_error_vector(dx[:, :3])))
        bias = bias + dx[:, 3:]
        whole = _covariance_with_rate(P, gyro_rad_s)
        states.append(replace(state, q=q, w=rates[:, row] - bias, optional={"gyro-bias": bias}, P=whole))
    return collect_tracks(settings, states, np.stack(nis, axis=1))


def _propagate(q: FloatArray, w: FloatArray, orbital_rate: FloatArray, h: float) -> tuple[FloatArray, FloatArray]:
    """Propagate the attitude by a step at a constant rate; also return Φ (runs, 6, 6)."""
    relative = relative_rate(q, w, orbital_rate)
    # The rate of the orbital frame is that in body axes at the middle of the step.
    half = quaternion.multiply(q, quaternion.exp(0.5 * h * relative))
    turned = quaternion.multiply(q, quaternion.exp(h * relative_rate(half, w, orbital_rate)))
    F = np.zeros((len(q), 6, 6))
    F[:, :3, :3] = -cross_matrix(w)
    F[:, :3, 3:] = -0.5 * np.eye(3)
    return quaternion.normalised(turned), third_order_exponential(F * h)


def _covariance_with_rate(P: FloatArray, gyro_rad_s: float) -> FloatArray:
    """Return the covariance (runs, 9, 9) of (δq, δω, δΔω) from that of (δq, δΔω): δω = noise - δΔω."""
    full = np.zeros((9, 6))
    full[:3, :3], full[3:6, 3:], full[6:, 3:] = np.eye(3), -np.eye(3), np.eye(3)
    noise = np.zeros((9, 9))
    noise[3:6, 3:6] = gyro_rad_s**2 * np.eye(3)
    return full @ P @ full.T + noise


def _fill_gaps(values: FloatArray) -> FloatArray:
    """Fill the gaps of readings (runs, n, 3) by the last one before them."""
    seen = is_read(values)
    if not seen[:, 0].all():
        raise ValueError(
            "Input record must have a gyro reading at the first instant of every run; instead one has none."
        )
    last = np.maximum.accumulate(np.where(seen, np.arange(values.shape[1]), 0), axis=-1)
    return np.take_along_axis(values, last[..., None], axis=1)
