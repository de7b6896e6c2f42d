"""Columns and units of what a filter estimates."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from arrays.typing import FloatArray


class Shown(NamedTuple):
    """How a state is written: its column with the axis left open, its unit and what makes it of the SI's, in words."""

    column: str
    scale: float
    unit: str
    words: str
    axes: tuple[str, ...] = ("x", "y", "z")

    @property
    def columns(self) -> tuple[str, ...]:
        """Columns of all axes."""
        return tuple(self.column.format(axis) for axis in self.axes)


_ELEMENTS = tuple(row + column for row in "xyz" for column in "xyz")
SHOWN = {
    "attitude": Shown("attitude_{}_deg", np.degrees(1.0), "°", "attitude"),
    "rate": Shown("rate_{}_deg_s", np.degrees(1.0), "°/s", "rate"),
    "gyro-bias": Shown("gyro_bias_{}_deg_s", np.degrees(1.0), "°/s", "bias of the gyro"),
    "field-bias": Shown("field_bias_{}_nT", 1e9, "nT", "bias of the magnetometer"),
    "disturbance": Shown("disturbance_{}_s2", 1.0, "1/s²", "disturbing acceleration"),
    "field-model": Shown("field_model_{}_nT", 1e9, "nT", "error of the field's model"),
    "dipole": Shown("dipole_{}_Am2", 1.0, "A·m²", "residual dipole"),
    "field-gain": Shown("field_gain_{}_percent", 100.0, "%", "gains of the magnetometer", _ELEMENTS),
}
STATE_COLUMNS = tuple(column for shown in SHOWN.values() for column in shown.columns)


def in_units(states: Mapping[str, FloatArray]) -> FloatArray:
    """States (..., k) as (..., 30) in the order and units of :data:`STATE_COLUMNS`; NaN of one that is not there."""
    shape = next(iter(states.values())).shape[:-1]
    return np.concatenate(
        [
            shown.scale * states[state] if state in states else np.full((*shape, len(shown.axes)), np.nan)
            for state, shown in SHOWN.items()
        ],
        axis=-1,
    )


def worst_axis(values: FloatArray) -> FloatArray:
    """Largest of the numbers of every state of :data:`SHOWN`, (..., 30) as :func:`in_units` -> (..., states)."""
    begins = np.cumsum([0, *(len(shown.axes) for shown in SHOWN.values())])[:-1]
    return np.asarray(np.maximum.reduceat(values, begins, axis=-1))
