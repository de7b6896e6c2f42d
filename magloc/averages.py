"""Averages of readings: over a whole record, or over successive windows of time."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from arrays.array import SensorArray
from arrays.io.errors import InputError
from magloc.readings import Readings, change_between_rows


def average(readings: Readings) -> Readings:
    """Return the average of all complete rows of an array at rest, at the mean time.

    A row is complete if it has every channel that any row has. A channel that no row has stays missing. Incomplete
    rows are ignored: the field common to all sensors changes from row to row, and it cancels only between channels
    that are averaged over the same rows. Raises InputError if the array moves, the ambient field changes or no row is
    complete.
    """
    change = change_between_rows(readings)
    if change is not None:
        what, row, expected = change
        raise InputError(f"found {what} between rows 1 and {row + 1}, expected {expected}.")
    complete = complete_rows(readings)
    if not complete.any():
        raise InputError("found no row with all channels, expected at least one for an average.")
    ambient_T = readings.ambient_T
    return replace(
        readings[:1],
        time_s=readings.time_s[complete].mean(keepdims=True),
        values_T=readings.values_T[complete].mean(axis=0, keepdims=True),
        ambient_T=None if ambient_T is None else ambient_T[complete].mean(axis=0, keepdims=True),
    )


def complete_rows(readings: Readings) -> NDArray[np.bool_]:
    """Return which rows have every channel that any row has."""
    present = np.isfinite(readings.values_T)
    return np.asarray((present == present.any(axis=0)).all(axis=1))


def averaging_array(array: SensorArray, readings: Readings) -> SensorArray:
    r"""Return the array with the noise of an averaged row (:func:`average`).

    White noise and proportional noise fall by :math:`\sqrt n` with n complete rows. Misalignments and errors of the
    gains do not change: they are the same in every row, and no average removes them.
    """
    return _less_noisy(array, math.sqrt(max(1, int(complete_rows(readings).sum()))))


def window_averages(readings: Readings, window_s: float) -> Readings:
    """Return the mean of every window of time [s] that has a row, at the pose of its middle row."""
    window = np.floor((readings.time_s - readings.time_s[0]) / window_s + 1e-9)
    _, first, count = np.unique(window, return_index=True, return_counts=True)
    middle = first + count // 2
    known = np.isfinite(readings.values_T)
    total = np.add.reduceat(np.where(known, readings.values_T, 0.0), first)
    n_known = np.add.reduceat(known.astype(np.intp), first)
    with np.errstate(invalid="ignore"):
        values = total / n_known
    ambient = readings.ambient_T
    return replace(
        readings[middle],
        time_s=np.add.reduceat(readings.time_s, first) / count,
        values_T=values,
        ambient_T=None if ambient is None else np.add.reduceat(ambient, first) / count[:, None],
    )


def window_averaging_array(array: SensorArray, readings: Readings, window_s: float) -> SensorArray:
    """Return the array with the noise of the rows of :func:`window_averages`.

    The median number of readings in a window decides.
    """
    window = np.floor((readings.time_s - readings.time_s[0]) / window_s + 1e-9)
    return _less_noisy(array, float(np.sqrt(np.median(np.unique(window, return_counts=True)[1]))))


def _less_noisy(array: SensorArray, root: float) -> SensorArray:
    """Return the array with its white and proportional noise divided by the root of a number of rows."""
    own = (None if sensor.noise_fraction is None else sensor.noise_fraction / root for sensor in array.sensors)
    sensors = tuple(
        replace(sensor, noise_T=sensor.noise_T / root, noise_fraction=fraction)
        for sensor, fraction in zip(array.sensors, own, strict=True)
    )
    return replace(
        array,
        sensors=sensors,
        noise_fraction=array.noise_fraction / root,
        ambient_uncertainty_white_T=array.ambient_uncertainty_white_T / root,
    )
