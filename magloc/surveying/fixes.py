"""Places that stand still between the fixes of a receiver that is slower than the readings."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np

from arrays.array import SensorArray
from arrays.typing import FloatArray, IntArray
from magloc.navigation.poses import rotations_at, vectors_at
from magloc.readings import Readings

_LOG = logging.getLogger(__name__)
_FEWEST_PLACES = 4
_LOST = 3  # rows: where places are new in every row, the next one that changes leaps if so many were held
_AS_FAST = 0.5  # of the usual speed, over all of a run: it was held, and the carrier did not rest


def between_fixes(array: SensorArray, readings: Readings) -> tuple[SensorArray, Readings]:
    """Return readings whose places move evenly between fixes, and the array whose errors last as long as these.

    Where most places are repeated in a row they are a staircase: one step for each fix. A carrier that rests repeats
    its place, too, but it goes on from there by no more than in any other interval.
    """
    if readings.array_position_m is None or readings.array_rotation is None:
        return array, readings
    place, time_s, n = readings.array_position_m, readings.time_s, len(readings)
    first = np.flatnonzero(np.concatenate([[True], (place[1:] != place[:-1]).any(axis=1)]))
    if len(first) < _FEWEST_PLACES or not (np.diff(time_s) > 0.0).all():
        return array, readings
    last, end = _last_fixes(place, time_s, first)
    fixes = np.union1d(first, last)
    rows = np.arange(n)
    known = np.isin(rows, fixes) | (rows <= last[np.searchsorted(first, rows, "right") - 1])
    held = int((~known).sum())
    if not held:
        return array, readings
    rate_Hz = (len(fixes) - 1) / (time_s[fixes[-1]] - time_s[fixes[0]])
    _LOG.warning(
        f"places stand still in {held} of {n} rows, between fixes that come {rate_Hz:.3g} times a second: interpolated"
        f" between fixes{f', and the last {n - end} rows left out' if end < n else ''}"
    )
    turns = readings.array_rotation
    still = (turns[1:].inv() * turns[:-1]).magnitude() == 0.0
    turns_too = bool(still[~known[1:]].all())
    moved = replace(
        readings,
        array_position_m=vectors_at(time_s, time_s[known], place[known]),
        array_rotation=rotations_at(time_s, time_s[known], turns[known]) if turns_too else turns,
        interpolated_m=_errors_m(place, time_s, np.flatnonzero(known)),
    )[:end]
    pose, interval_s = array.pose, interval_of_fixes(moved)
    if pose is not None and pose.correlation_s < interval_s:  # a fix errs as long as it counts
        array = replace(array, pose=replace(pose, correlation_s=interval_s))
    return array, moved


def interval_of_fixes(readings: Readings) -> float:
    """Usual time between fixes where places were interpolated [s], 0 where none were."""
    if readings.interpolated_m is None or not (known := readings.interpolated_m == 0.0).any():
        return 0.0
    held = np.flatnonzero(np.diff(known.astype(np.int8)) == 1)  # the last row before each fix
    times = readings.time_s[held + 1]
    return float(np.median(np.diff(times))) if len(times) > 1 else 0.0


def _last_fixes(place: FloatArray, time_s: FloatArray, first: IntArray) -> tuple[IntArray, int]:
    """Return the row of the last fix in each run of equal places, and the end of the rows that fixes enclose."""
    n = len(time_s)
    length = np.diff(first, append=n)
    way = np.linalg.norm(np.diff(place[first], axis=0), axis=1)
    period = int(np.median(length))
    if period > 1:
        after_s = period * float(np.median(np.diff(time_s)))
        speed = float(np.median(way)) / after_s
        periods = np.maximum(np.round(length[:-1] / period), 1.0)
        moving = np.clip(np.round(way / (speed * after_s)), 1.0, periods).astype(np.intp)
        last = np.maximum(first[1:] - moving * period, first[:-1])
        end = int(first[-1] + (length[-1] - 1) // period * period)
        return np.append(last, end), end + 1
    took_s = np.diff(time_s[first])
    leaps = (length[:-1] >= _LOST) & (way > _AS_FAST * np.median(way / took_s) * took_s)
    return np.append(np.where(leaps, first[:-1], first[1:] - 1), n - 1), n


def _errors_m(place: FloatArray, time_s: FloatArray, known: IntArray) -> FloatArray:
    """Return the standard deviation (n,) of places between rows that are known, as much as the way bends about them.

    A way of constant acceleration leaves the chord by half of the change of velocity in one interval, times u (1 - u)
    of that interval. Where it has a corner it leaves it by up to four times as much.
    """
    at_s = time_s[known]
    took_s = np.diff(at_s)
    velocity = np.diff(place[known], axis=0) / took_s[:, None]
    bend = np.linalg.norm(np.diff(velocity, axis=0), axis=1)
    most = np.maximum(np.append(bend, 0.0), np.concatenate([[0.0], bend]))  # at either end of an interval
    which = np.clip(np.searchsorted(at_s, time_s, "right") - 1, 0, len(took_s) - 1)
    part = np.clip((time_s - at_s[which]) / took_s[which], 0.0, 1.0)
    return np.asarray(most[which] * took_s[which] * part * (1.0 - part))
