"""Fixed-interval smoother of the error state.

See docs/theory/attitude-kalman-filters.md.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from adcs import quaternion
from adcs.kalman.error_state import AttitudeState, AttitudeTracks, SensorSet
from adcs.kalman.mekf import apply_error, collect_tracks, predict
from adcs.satellite.telemetry import Record
from arrays.typing import FloatArray


def smooth(record: Record, estimates: AttitudeTracks) -> AttitudeTracks:
    """Smooth the estimates of whole runs.

    ``estimates``: result of :func:`adcs.kalman.mekf.run_filter`, whose ``nis`` is kept.
    """
    settings, n = estimates.settings, estimates.q.shape[1]
    later = estimates.at(n - 1)
    states = [later]
    for row in reversed(range(n - 1)):
        state = estimates.at(row)
        ahead, Phi = predict(record, row, state, settings)
        # States have different units, so solving with correlations is better conditioned.
        scale = np.sqrt(np.diagonal(ahead.P, axis1=-2, axis2=-1))
        correlation = ahead.P / (scale[:, :, None] * scale[:, None, :])
        C = np.linalg.solve(correlation, (Phi @ state.P) / scale[:, :, None]).mT / scale[:, None, :]
        dx = (C @ error_between(later, ahead, settings.sensors)[..., None])[..., 0]
        P = state.P + C @ (later.P - ahead.P) @ C.mT
        later = replace(apply_error(state, dx, settings.sensors), P=0.5 * (P + P.mT))
        states.append(later)
    return collect_tracks(settings, states[::-1], estimates.nis, estimates.rejected)


def error_between(
    state: AttitudeState | AttitudeTracks, other: AttitudeState | AttitudeTracks, used: SensorSet
) -> FloatArray:
    """Return the error state (..., N) by which ``state`` differs from ``other``.

    :func:`adcs.kalman.mekf.apply_error` is its inverse.
    """
    always = [quaternion.error_vector(other.q, state.q), state.w - other.w]
    return np.concatenate([*always, *(state.optional[name] - other.optional[name] for name in used.states)], axis=-1)
