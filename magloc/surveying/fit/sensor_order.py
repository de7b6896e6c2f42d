"""Order of sensors above each other: the field of the ground decays upwards."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from arrays.array import SensorArray
from arrays.typing import FloatArray
from magloc.navigation.crossovers import gain_of_exchange
from magloc.navigation.flight_lines import FlightLine
from magloc.readings import Readings
from magloc.surveying.fit.sensor_noise import white_noise_T

_ABOVE_M = 0.2  # least difference in height, and its least share of the distance
_STEEP = 0.8
_LARGER = 1.3
_ATTITUDES = 100  # of which the mean counts
_SEEN = 5.0  # in standard deviations of the noise
_BESIDE_M, _MOST_PAIRS = 0.1, 10  # least distance of sensors on the map, and pairs that are compared


def size_of_anomalies(variations_T: FloatArray, lines: Sequence[FlightLine]) -> FloatArray:
    """Return the standard deviation of each sensor's variations (n, N) around the medians of lines.

    Rows with a missing reading do not count; without any other the result is NaN.
    """
    whole = [own[np.isfinite(own).all(axis=1)] for own in (variations_T[line.rows] for line in lines)]
    around = [own - np.median(own, axis=0) for own in whole if len(own)]
    return np.asarray(np.std(np.concatenate(around), axis=0) if around else np.full(variations_T.shape[1], np.nan))


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


def exchanged_beside(
    array: SensorArray, readings: Readings, variations_T: FloatArray, lines: Sequence[FlightLine]
) -> tuple[str, str] | None:
    """Return the ids of two sensors beside each other that appear exchanged; None if all seem right.

    The nearer of two sensors of neighbouring lines are more alike than the farther ones.
    """
    place_m, turn = readings.array_position_m, readings.array_rotation
    assert place_m is not None
    assert turn is not None
    at_m = array.positions.copy()  # scipy rotates writable arrays only
    apart_m = {
        pair: float(np.linalg.norm((at_m[pair[0]] - at_m[pair[1]])[:2])) for pair in combinations(range(len(at_m)), 2)
    }
    pairs = sorted((pair for pair in apart_m if apart_m[pair] > _BESIDE_M), key=apart_m.__getitem__, reverse=True)
    gains = {}
    for pair in pairs[:_MOST_PAIRS]:
        sensors_m = [place_m + turn.apply(at_m[i]) for i in pair]
        gains[pair] = gain_of_exchange(readings.time_s, sensors_m, variations_T[:, pair], lines)
    best = max(gains, key=gains.__getitem__, default=None)
    return None if best is None or not gains[best] > 0.0 else (array.ids[best[0]], array.ids[best[1]])
