r"""Filters whose gain is not computed on board: :math:`x^+ = x^- + K \tilde z` with one K.

See docs/theory/attitude-kalman-filters.md. Source: Ivanov, Ivlev, Karpenko, Ovchinnikov, Keldysh Institute preprint 64,
2014, Table 5.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from adcs.kalman.error_state import AttitudeTracks, FilterSettings, Start
from adcs.kalman.mekf import (
    check_start,
    collected,
    first_state,
    nis_of,
    predicted,
    run_filter,
    stacked_residuals,
    with_error,
)
from adcs.satellite.telemetry import Record
from arrays.typing import FloatArray


def converged_gain(record: Record, settings: FilterSettings, start: Start, row: int = -1) -> FloatArray:
    """Gain of the filter at an instant, by default the last, in units of the sensors' noise.

    Returns (runs, N, k): for the k residuals of :func:`adcs.kalman.mekf.stacked_residuals`; columns of a sensor without
    a reading at that instant are zero.
    """
    state = run_filter(record, settings, start).at(row)
    H, _ = stacked_residuals(record, row, state, settings)
    # K = P⁺ Hᵀ R⁻¹.
    return state.P @ H.mT


def run_constant_gain(
    record: Record, settings: FilterSettings, start: Start, gain: FloatArray | None = None
) -> AttitudeTracks:
    """Filter of whole runs with one gain.

    ``gain`` (runs, N, k): that of :func:`converged_gain` at the last instant, unless given.
    """
    check_start(record, start)
    if (record.steps_s != record.dt_s).any():
        raise ValueError("Input record must have equal steps for a constant gain; instead received others.")
    K = converged_gain(record, settings, start) if gain is None else gain
    state = first_state(settings, start)
    states, nis = [], []
    for row in range(record.momentum_Nms.shape[1]):
        if row:
            state, _ = predicted(record, row - 1, state, settings)
        H, residual = stacked_residuals(record, row, state, settings)
        noise = H @ state.P @ H.mT + np.eye(H.shape[1])
        nis.append(nis_of(noise, H, residual, settings.sensors))
        # A sensor without a reading has rows of zeros in H, and must add no noise.
        K_now = K * (H != 0.0).any(axis=-1)[:, None, :]
        rest = np.eye(settings.sensors.size) - K_now @ H
        P = rest @ state.P @ rest.mT + K_now @ K_now.mT
        state = replace(with_error(state, (K_now @ residual[..., None])[..., 0], settings.sensors), P=P)
        states.append(state)
    return collected(settings, states, np.stack(nis, axis=1))
