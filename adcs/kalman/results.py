"""Columns and units of what a filter estimates."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from adcs.kalman.error_state import AttitudeTracks
from arrays.typing import FloatArray

UNITS = {
    "attitude": ("attitude_{}_deg", np.degrees(1.0)),
    "rate": ("rate_{}_deg_s", np.degrees(1.0)),
    "gyro-bias": ("gyro_bias_{}_deg_s", np.degrees(1.0)),
    "field-bias": ("field_bias_{}_nT", 1e9),
    "disturbance": ("disturbance_{}_s2", 1.0),
}
"""Column of each state, with its axis left open, and what makes its unit of the SI's."""
STATE_COLUMNS = tuple(column.format(axis) for column, _ in UNITS.values() for axis in "xyz")


def sigma_by_state(tracks: AttitudeTracks) -> dict[str, FloatArray]:
    """Standard deviations (runs, n, 3) of the states that there are; that of the attitude is of the angle."""
    sigma, used = tracks.sigma, tracks.settings.sensors
    first = {"attitude": 0, "rate": 3} | {state: used.first_of(state) for state in used.states}
    return {state: (2.0 if i == 0 else 1.0) * sigma[..., i : i + 3] for state, i in first.items()}


def in_units(states: Mapping[str, FloatArray]) -> FloatArray:
    """States (..., 3) as (..., 15) in the order and units of :data:`STATE_COLUMNS`; NaN of one that is not there."""
    missing = np.full_like(next(iter(states.values())), np.nan)
    return np.concatenate([scale * states.get(state, missing) for state, (_, scale) in UNITS.items()], axis=-1)
