"""Order of sensors above each other: the field of the ground decays upwards."""

from __future__ import annotations

import numpy as np

from arrays.array import SensorArray
from arrays.typing import FloatArray
from magloc.navigation.flight_lines import flight_lines
from magloc.readings import Readings
from magloc.surveying.fit.sensor_noise import white_noise_T
from magloc.surveying.preparation import field_moduli, without_ambient

_ABOVE_M = 0.2  # least difference in height, and its least share of the distance
_STEEP = 0.8
_LARGER = 1.3
_ATTITUDES = 100  # of which the mean counts
_SEEN = 5.0  # in standard deviations of the noise


def size_of_anomalies(array: SensorArray, readings: Readings) -> FloatArray:
    """Return the standard deviation of each sensor's modulus (N,) around the medians of lines; NaN without rows."""
    if not len(readings):
        return np.full(array.n_sensors, np.nan)
    place_m = readings.array_position_m
    assert place_m is not None
    moduli_T = without_ambient(readings, field_moduli(array, readings.values_T))
    for line in flight_lines(readings.time_s, place_m, place_m[:, 2], readings.lines):
        moduli_T[line.rows] -= np.median(moduli_T[line.rows], axis=0)
    return np.asarray(np.std(moduli_T, axis=0))


def weaker_sensors_below(array: SensorArray, readings: Readings, anomalies_T: FloatArray) -> tuple[str, ...]:
    """Return for each sensor the id of one below it with smaller anomalies, or "" without one."""
    assert readings.array_rotation is not None
    if not len(readings):
        return ("",) * array.n_sensors
    turns = readings.array_rotation[:: max(1, len(readings) // _ATTITUDES)]
    place_m = np.stack([turns.apply(position_m).mean(axis=0) for position_m in array.positions.copy()])
    noise_T = np.array([white_noise_T(array)[array.channel_sensor == i].max() for i in range(array.n_sensors)])
    found = []
    for i, upper_m in enumerate(place_m):
        apart_m = upper_m - place_m
        height_m = apart_m[:, 2]
        is_below = (height_m > _ABOVE_M) & (height_m > _STEEP * np.linalg.norm(apart_m, axis=1))
        is_weaker = is_below & (anomalies_T[i] > np.maximum(_LARGER * anomalies_T, _SEEN * noise_T[i]))
        found.append(array.ids[int(np.flatnonzero(is_weaker)[0])] if is_weaker.any() else "")
    return tuple(found)
