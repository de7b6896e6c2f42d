r"""Separate-bias filter of the disturbance d (s⁻²) in :math:`\dot\omega = f(x) + d`.

See docs/theory/attitude-kalman-filters.md. Source: Ivanov, Ivlev, Karpenko, Ovchinnikov, Keldysh Institute preprint 64,
2014, section on the parallel filter.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from adcs.kalman.error_state import AttitudeTracks, FilterSettings, FilterStart
from adcs.kalman.mekf import (
    apply_error,
    check_start,
    collect_tracks,
    initial_state,
    predict,
    sensor_nis,
    stacked_residuals,
)
from adcs.satellite.telemetry import Record
from arrays.typing import FloatArray


def sensitivity_correction(S: FloatArray, change: FloatArray) -> FloatArray:
    """Return the correction S⁺(d⁺ - d⁻) of the state, (runs, N, 3) and (runs, 3) -> (runs, N).

    The source lacks it.
    """
    return (S @ change[..., None])[..., 0]


def run_parallel(
    record: Record, settings: FilterSettings, start: FilterStart, forgetting: float = 0.99
) -> AttitudeTracks:
    """Filter whole runs with a parallel filter of the disturbance.

    ``settings``: a set with the state ``disturbance``; forgetting replaces its process noise q_d. ``forgetting``: λ,
    above 0 and at most 1. The covariance contains all states, with the disturbance last.
    """
    if "disturbance" not in settings.sensors.states:
        raise ValueError("Input settings must have the state disturbance; instead received a set without it.")
    if not 0.0 < forgetting <= 1.0:
        raise ValueError(f"Input forgetting must be above 0 and at most 1; instead received {forgetting}.")
    check_start(record, start)
    inner = replace(settings, sensors=settings.sensors.drop("disturbance"))
    state = initial_state(inner, start)
    runs, n = record.momentum_Nms.shape[:2]
    size = inner.sensors.size
    S = np.zeros((runs, size, 3))
    P_d = np.tile(settings.disturbance_sigma_s2**2 * np.eye(3), (runs, 1, 1))
    states, nis = [], []
    for row in range(n):
        if row:
            state, Phi = predict(record, row - 1, state, inner)
            h = float(record.steps_s[row - 1])
            S = Phi @ S + np.concatenate([h * h / 4.0 * np.eye(3), h * np.eye(3), np.zeros((size - 6, 3))])
            P_d = P_d / forgetting ** (h / record.dt_s)
        H, residual = stacked_residuals(record, row, state, inner)
        HP = H @ state.P
        noise = HP @ H.mT + np.eye(H.shape[1])
        K = np.linalg.solve(noise, HP).mT
        H_d = H @ S
        of_d = H_d @ P_d
        whole = of_d @ H_d.mT + noise
        K_d = np.linalg.solve(whole, of_d).mT
        nis.append(sensor_nis(whole, H, residual, inner.sensors))
        rest, rest_d = np.eye(size) - K @ H, np.eye(3) - K_d @ H_d
        S = rest @ S
        # Joseph's form of both covariances.
        P = rest @ state.P @ rest.mT + K @ K.mT
        P_d = rest_d @ P_d @ rest_d.mT + K_d @ noise @ K_d.mT
        change = (K_d @ residual[..., None])[..., 0]
        dx = (K @ residual[..., None])[..., 0] + sensitivity_correction(S, change)
        state = apply_error(state, dx, inner.sensors)
        optional = {**state.optional, "disturbance": state.optional_state("disturbance") + change}
        state = replace(state, optional=optional, P=P)
        states.append(replace(state, P=_joint_covariance(P, S, P_d)))
    return collect_tracks(settings, states, np.stack(nis, axis=1))


def _joint_covariance(P: FloatArray, S: FloatArray, P_d: FloatArray) -> FloatArray:
    """Return the joint covariance (runs, N + 3, N + 3) of the error state and the disturbance."""
    across = S @ P_d
    return np.block([[P + across @ S.mT, across], [across.mT, P_d]])
