"""Words by which a filter, its noise and its start are chosen."""

from __future__ import annotations

from typing import Literal, get_args

Filter = Literal["mekf", "constant-gain", "parallel-disturbance", "reduced", "smoother", "self-tuning"]
Noise = Literal["tuned", "paper"]
StartKind = Literal["near", "vectors", "any"]
FILTERS: tuple[str, ...] = get_args(Filter)
NOISES: tuple[str, ...] = get_args(Noise)
STARTS: tuple[str, ...] = get_args(StartKind)
TOGETHER = {"magnetometer": ("field-bias", "field-gain")}
"""What several states are called together."""
MEASURED_BY = {
    "field-bias": "mag",
    "gyro-bias": "gyro",
    "field-model": "mag",
    "field-gain": "mag",
    "magnetometer": "mag",
}
"""States that belong to a sensor: without it they cannot be estimated."""


def is_measured(state: str, sensors: str) -> bool:
    """Whether sensors, joined by plus signs, have the one that measures a state, if it is one's own."""
    return state not in MEASURED_BY or MEASURED_BY[state] in sensors.split("+")
