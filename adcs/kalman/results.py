"""Columns and units of what a filter estimates."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from adcs.kalman.error_state import SENSORS, Estimates, SensorSet
from adcs.satellite.telemetry import Record

if TYPE_CHECKING:
    pass
from arrays.typing import FloatArray

STATE_COLUMNS = tuple(
    f"{name}_{axis}_{unit}"
    for name, unit in (
        ("attitude", "deg"),
        ("rate", "deg_s"),
        ("gyro_bias", "deg_s"),
        ("field_bias", "nT"),
        ("disturbance", "s2"),
    )
    for axis in "xyz"
)
_SENSOR_WORDS = dict(zip(SENSORS, ("no star tracker", "no gyro", "no magnetometer", "no Sun sensor"), strict=True))


def sigma_in_units(estimates: Estimates) -> FloatArray:
    """Standard deviations (runs, n, 15) in the units of :data:`STATE_COLUMNS`; NaN of a state that is not there."""
    sigma, used = estimates.sigma, estimates.settings.sensors
    values = np.full((*sigma.shape[:2], 15), np.nan)
    values[..., :3] = np.degrees(2.0 * sigma[..., :3])
    values[..., 3:6] = np.degrees(sigma[..., 3:6])
    scales = {"gyro-bias": np.degrees(1.0), "field-bias": 1e9, "disturbance": 1.0}
    for place, (state, scale) in enumerate(scales.items(), start=2):
        first = used.first_of(state)
        if first >= 0:
            values[..., 3 * place : 3 * place + 3] = scale * sigma[..., first : first + 3]
    return values


def sensor_gaps(record: Record, used: SensorSet, run: int = 0) -> list[tuple[str, NDArray[np.bool_]]]:
    """Sensors in use that have no reading at times, in words, and where they have."""
    readings = record.readings
    values = dict(zip(SENSORS, (readings.star, readings.gyro_rad_s, readings.field_T, readings.sun), strict=True))
    there = {name: ~np.isnan(values[name][run, :, 0]) for name in used.sensors.split("+")}
    return [(_SENSOR_WORDS[name], seen) for name, seen in there.items() if not seen.all()]
