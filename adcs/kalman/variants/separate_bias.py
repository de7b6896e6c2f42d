r"""Disturbance d (s⁻²) in :math:`\dot\omega = f(x) + d`, estimated by a filter of its own beside that of the state.

See docs/theory/attitude-kalman-filters.md. Source: Ivanov, Ivlev, Karpenko, Ovchinnikov, Keldysh Institute preprint 64,
2014, section on the parallel filter.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from adcs.kalman.error_state import AttitudeTracks, FilterSettings, Start
from adcs.kalman.mekf import check_start, collected, first_state, nis_of, predicted, stacked_residuals, with_error
from adcs.satellite.telemetry import Record
from arrays.typing import FloatArray


def by_sensitivity(S: FloatArray, change: FloatArray) -> FloatArray:
    """Correction S⁺(d⁺ - d⁻) of the state, which the source lacks, (runs, N, 3) and (runs, 3) -> (runs, N)."""
    return (S @ change[..., None])[..., 0]


def run_parallel(record: Record, settings: FilterSettings, start: Start, forgetting: float = 0.99) -> AttitudeTracks:
    """Filter of whole runs with a parallel filter of the disturbance.

    ``settings``: of a set with the state ``disturbance``; its process noise q_d is not used, forgetting takes its
    place. ``forgetting``: λ, above 0 and up to 1. Returns: of the set with the disturbance; its
    covariance is that of the whole.
    """
    if "disturbance" not in settings.sensors.states:
        raise ValueError("Input settings must have the state disturbance; instead received a set without it.")
    if not 0.0 < forgetting <= 1.0:
        raise ValueError(f"Input forgetting must be above 0 and up to 1; instead received {forgetting}.")
    check_start(record, start)
    inner = replace(settings, sensors=settings.sensors.without("disturbance"))
    state = first_state(inner, start)
    runs, n = record.momentum_Nms.shape[:2]
    size = inner.sensors.size
    S = np.zeros((runs, size, 3))
    P_d = np.tile(settings.disturbance_sigma_s2**2 * np.eye(3), (runs, 1, 1))
    states, nis = [], []
    for row in range(n):
        if row:
            state, Phi = predicted(record, row - 1, state, inner)
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
        nis.append(nis_of(whole, H, residual, inner.sensors))
        rest, rest_d = np.eye(size) - K @ H, np.eye(3) - K_d @ H_d
        S = rest @ S
        # Joseph's form of both covariances.
        P = rest @ state.P @ rest.mT + K @ K.mT
        P_d = rest_d @ P_d @ rest_d.mT + K_d @ noise @ K_d.mT
        change = (K_d @ residual[..., None])[..., 0]
        dx = (K @ residual[..., None])[..., 0] + by_sensitivity(S, change)
        state = with_error(state, dx, inner.sensors)
        optional = {**state.optional, "disturbance": state.of("disturbance") + change}
        state = replace(state, optional=optional, P=P)
        states.append(replace(state, P=_whole(P, S, P_d)))
    return collected(settings, states, np.stack(nis, axis=1))


def _whole(P: FloatArray, S: FloatArray, P_d: FloatArray) -> FloatArray:
    """Covariance of the error state with the disturbance behind the others, (runs, N + 3, N + 3)."""
    across = S @ P_d
    return np.block([[P + across @ S.mT, across], [across.mT, P_d]])
