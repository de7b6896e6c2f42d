"""Columns and units of the states of a filter."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from arrays.typing import FloatArray


class StateColumns(NamedTuple):
    """Columns of a state in files: name with a placeholder for the axis, factor from SI, unit, words."""

    column: str
    scale: float
    unit: str
    words: str
    axes: tuple[str, ...] = ("x", "y", "z")

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns of all axes."""
        return tuple(self.column.format(axis) for axis in self.axes)


_ELEMENTS = tuple(row + column for row in "xyz" for column in "xyz")
STATE_UNITS = {
    "attitude": StateColumns("attitude_{}_deg", np.degrees(1.0), "°", "attitude"),
    "rate": StateColumns("rate_{}_deg_s", np.degrees(1.0), "°/s", "rate"),
    "gyro-bias": StateColumns("gyro_bias_{}_deg_s", np.degrees(1.0), "°/s", "bias of the gyro"),
    "field-bias": StateColumns("field_bias_{}_nT", 1e9, "nT", "bias of the magnetometer"),
    "disturbance": StateColumns("disturbance_{}_s2", 1.0, "1/s²", "disturbing acceleration"),
    "field-model": StateColumns("field_model_{}_nT", 1e9, "nT", "error of the field's model"),
    "dipole": StateColumns("dipole_{}_Am2", 1.0, "A·m²", "residual dipole"),
    "field-gain": StateColumns("field_gain_{}_percent", 100.0, "%", "gains of the magnetometer", _ELEMENTS),
}
STATE_COLUMNS = tuple(column for shown in STATE_UNITS.values() for column in shown.columns)


def state_table(states: Mapping[str, FloatArray]) -> FloatArray:
    """Return states as one table (..., 30) with :data:`STATE_COLUMNS`; NaN for missing states."""
    shape = next(iter(states.values())).shape[:-1]
    return np.concatenate(
        [
            shown.scale * states[state] if state in states else np.full((*shape, len(shown.axes)), np.nan)
            for state, shown in STATE_UNITS.items()
        ],
        axis=-1,
    )


def largest_by_state(values: FloatArray) -> FloatArray:
    """Return the largest component of each state, (..., 30) of :func:`state_table` -> (..., states)."""
    begins = np.cumsum([0, *(len(shown.axes) for shown in STATE_UNITS.values())])[:-1]
    return np.asarray(np.maximum.reduceat(values, begins, axis=-1))
