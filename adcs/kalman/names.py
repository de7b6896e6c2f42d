"""Names of filters, of their noise and of their starts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, get_args

Filter = Literal["mekf", "constant-gain", "parallel-disturbance", "reduced", "smoother", "self-tuning"]
Noise = Literal["tuned", "paper"]
StartKind = Literal["near", "vectors", "any"]
FILTERS: tuple[str, ...] = get_args(Filter)
NOISES: tuple[str, ...] = get_args(Noise)
STARTS: tuple[str, ...] = get_args(StartKind)
TOGETHER = {"magnetometer": ("field-bias", "field-gain")}
"""Names of groups of states."""
MEASURED_BY = {
    "field-bias": "mag",
    "gyro-bias": "gyro",
    "field-model": "mag",
    "field-gain": "mag",
    "magnetometer": "mag",
}
"""Sensor without which a state cannot be estimated."""


def is_measured(state: str, sensors: str) -> bool:
    """Return whether sensors, joined by plus signs, include the sensor that a state needs."""
    return state not in MEASURED_BY or MEASURED_BY[state] in sensors.split("+")


def grouped_states(states: Sequence[str]) -> list[str]:
    """Return states with those of a group replaced by its name, the torques last."""
    names = list(states)
    for group, members in TOGETHER.items():
        if set(members) <= set(names):
            names = [group, *(name for name in names if name not in members)]
    return sorted(names, key=lambda name: name in ("disturbance", "dipole"))
