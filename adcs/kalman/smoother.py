"""Estimates of a finished record with what later readings tell as well: a fixed-interval smoother of the error state.

See docs/theory/attitude-kalman-filters.md.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from adcs import quaternion
from adcs.kalman.error_state import AttitudeTracks, SensorSet, State
from adcs.kalman.mekf import collected, predicted, with_error
from adcs.satellite.telemetry import Record
from arrays.typing import FloatArray


def smoothed(record: Record, estimates: AttitudeTracks) -> AttitudeTracks:
    """Smoothed estimates of whole runs.

    ``estimates``: of :func:`adcs.kalman.mekf.run_filter`. Returns: ``nis`` is that of the filter.
    """
    settings, n = estimates.settings, estimates.q.shape[1]
    later = estimates.at(n - 1)
    states = [later]
    for row in reversed(range(n - 1)):
        state = estimates.at(row)
        ahead, Phi = predicted(record, row, state, settings)
        # States of mixed units: solve with the correlations.
        scale = np.sqrt(np.diagonal(ahead.P, axis1=-2, axis2=-1))
        correlation = ahead.P / (scale[:, :, None] * scale[:, None, :])
        C = np.linalg.solve(correlation, (Phi @ state.P) / scale[:, :, None]).mT / scale[:, None, :]
        dx = (C @ difference(later, ahead, settings.sensors)[..., None])[..., 0]
        P = state.P + C @ (later.P - ahead.P) @ C.mT
        later = replace(with_error(state, dx, settings.sensors), P=0.5 * (P + P.mT))
        states.append(later)
    return collected(settings, states[::-1], estimates.nis, estimates.rejected)


def difference(state: State | AttitudeTracks, other: State | AttitudeTracks, used: SensorSet) -> FloatArray:
    """Error state (..., N) that :func:`adcs.kalman.mekf.with_error` puts into ``other`` to make it ``state``."""
    always = [quaternion.error_vector(other.q, state.q), state.w - other.w]
    return np.concatenate([*always, *(state.optional[name] - other.optional[name] for name in used.states)], axis=-1)
