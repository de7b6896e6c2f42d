r"""Filter with a constant gain: :math:`x^+ = x^- + K \tilde z` with one K.

See docs/theory/attitude-kalman-filters.md. Source: Ivanov, Ivlev, Karpenko, Ovchinnikov, Keldysh Institute preprint 64,
2014, Table 5.
"""

from __future__ import annotations

import numpy as np

from adcs.kalman.error_state import AttitudeTracks, FilterSettings, FilterStart
from adcs.kalman.mekf import (
    check_start,
    collect_tracks,
    initial_state,
    predict,
    run_filter,
    stacked_residuals,
    update_state,
)
from adcs.satellite.telemetry import Record
from arrays.typing import FloatArray


def converged_gain(record: Record, settings: FilterSettings, start: FilterStart, row: int = -1) -> FloatArray:
    """Return the gain of the MEKF at an instant, by default the last, in units of the sensors' noise.

    Shape (runs, N, k) for the k residuals of :func:`adcs.kalman.mekf.stacked_residuals`; columns of a sensor without a
    reading at that instant are zero.
    """
    state = run_filter(record, settings, start).at(row)
    H, _ = stacked_residuals(record, row, state, settings)
    # K = P⁺ Hᵀ R⁻¹.
    return state.P @ H.mT


def run_constant_gain(
    record: Record, settings: FilterSettings, start: FilterStart, gain: FloatArray | None = None
) -> AttitudeTracks:
    """Filter whole runs with one gain.

    ``gain`` (runs, N, k): by default that of :func:`converged_gain` at the last instant.
    """
    check_start(record, start)
    if (record.steps_s != record.dt_s).any():
        raise ValueError("Input record must have equal steps for a constant gain; instead received others.")
    K = converged_gain(record, settings, start) if gain is None else gain
    state = initial_state(settings, start)
    states, nis = [], []
    for row in range(record.momentum_Nms.shape[1]):
        if row:
            state, _ = predict(record, row - 1, state, settings)
        state, nis_now = update_state(record, row, state, settings, K)
        states.append(state)
        nis.append(nis_now)
    return collect_tracks(settings, states, np.stack(nis, axis=1))
