"""Columns and units of what a filter estimates."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from adcs.kalman.error_state import AttitudeTracks, SensorSet
from arrays.typing import FloatArray


class Shown(NamedTuple):
    """How a state is written: its column with the axis left open, its unit and what makes it of the SI's, in words."""

    column: str
    scale: float
    unit: str
    words: str


SHOWN = {
    "attitude": Shown("attitude_{}_deg", np.degrees(1.0), "°", "attitude"),
    "rate": Shown("rate_{}_deg_s", np.degrees(1.0), "°/s", "rate"),
    "gyro-bias": Shown("gyro_bias_{}_deg_s", np.degrees(1.0), "°/s", "bias of the gyro"),
    "field-bias": Shown("field_bias_{}_nT", 1e9, "nT", "bias of the magnetometer"),
    "disturbance": Shown("disturbance_{}_s2", 1.0, "1/s²", "disturbing acceleration"),
    "field-model": Shown("field_model_{}_nT", 1e9, "nT", "error of the field's model"),
    "dipole": Shown("dipole_{}_Am2", 1.0, "A·m²", "residual dipole"),
}
STATE_COLUMNS = tuple(shown.column.format(axis) for shown in SHOWN.values() for axis in "xyz")


def by_state(error: FloatArray, used: SensorSet) -> dict[str, FloatArray]:
    """Errors (..., N) or their standard deviations as (..., 3) of each state; that of the attitude is of the angle."""
    parts = np.split(error, error.shape[-1] // 3, axis=-1)
    return dict(zip(("attitude", "rate", *used.states), [2.0 * parts[0], *parts[1:]], strict=True))


def sigma_by_state(tracks: AttitudeTracks) -> dict[str, FloatArray]:
    """Standard deviations of the states that there are, shape (runs, n, 3)."""
    return by_state(tracks.sigma, tracks.settings.sensors)


def in_units(states: Mapping[str, FloatArray]) -> FloatArray:
    """States (..., 3) as (..., 21) in the order and units of :data:`STATE_COLUMNS`; NaN of one that is not there."""
    missing = np.full_like(next(iter(states.values())), np.nan)
    return np.concatenate([shown.scale * states.get(state, missing) for state, shown in SHOWN.items()], axis=-1)
