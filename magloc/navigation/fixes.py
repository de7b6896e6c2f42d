"""Interpolation of places between the fixes of a receiver that is slower than the readings."""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from arrays.columns import POSITION_COLUMNS
from arrays.io.csv import Table
from arrays.io.errors import InputError
from arrays.typing import FloatArray, IntArray
from magloc.navigation.poses import rotations_at, vectors_at

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

_LOG = logging.getLogger(__name__)
_FEWEST_PLACES = 4
_LOST = 3  # After so many equal rows in a record of new places, the next change counts as a jump.
_AS_FAST = 0.5  # Above this share of the usual speed over a run, the place was held and the carrier did not rest.


class Interpolated(NamedTuple):
    """Poses between fixes, standard deviation of positions along each axis, and number of rows with repeated positions.

    Rows from ``end`` are after the last fix; their places are unknown.
    """

    position_m: FloatArray
    rotation: Rotation
    error_m: FloatArray
    held: int
    end: int
    rate_Hz: float


def between_fixes(time_s: FloatArray, position_m: FloatArray, rotation: Rotation) -> Interpolated | None:
    """Return poses interpolated between fixes, or None if places are not held between fixes.

    If most places equal those of the row before, they form a staircase with one step for each fix. A carrier at rest
    repeats its place too, but its next step is no longer than in any other interval. An attitude that is held with the
    places is interpolated with them.
    """
    first = np.flatnonzero(np.concatenate([[True], (position_m[1:] != position_m[:-1]).any(axis=1)]))
    if len(first) < _FEWEST_PLACES or not (np.diff(time_s) > 0.0).all():
        return None
    last, end = _last_fixes(position_m, time_s, first)
    rows = np.arange(len(time_s))
    known = np.isin(rows, first) | (rows <= last[np.searchsorted(first, rows, "right") - 1])
    held = int((~known).sum())
    if not held:
        return None
    fixes_s = time_s[np.union1d(first, last)]
    stands = (rotation[1:].inv() * rotation[:-1]).magnitude() == 0.0
    too = bool(stands[~known[1:]].all())
    return Interpolated(
        vectors_at(time_s, time_s[known], position_m[known]),
        rotations_at(time_s, time_s[known], rotation[known]) if too else rotation,
        _errors_m(position_m, time_s, np.flatnonzero(known)),
        held,
        end,
        (len(fixes_s) - 1) / float(fixes_s[-1] - fixes_s[0]),
    )


def without_gaps(table: Table) -> tuple[Table, FloatArray | None]:
    """Return the table of a log with places in all rows, and the standard deviations (n,) that interpolation adds [m].

    Rows before the first place or after the last one are ignored. Without a missing place, or without times, the second
    item is None.
    """
    if not {"time_s", *POSITION_COLUMNS} <= set(table.header):
        return table, None
    at = [table.header.index(name) for name in POSITION_COLUMNS]
    time_s, place = table.values[:, table.header.index("time_s")], table.values[:, at]
    known = [np.isfinite(place[:, :2]).all(axis=1), np.isfinite(place[:, 2])]
    whole = known[0] & known[1]
    if whole.all():
        return table, None
    if not (known[0].any() and known[1].any()):
        missing = "place" if not known[0].any() else "height"
        raise InputError(f"{table.path}: found no row with a {missing}, expected some rows with one.")
    first_s, last_s = max(time_s[one].min() for one in known), min(time_s[one].max() for one in known)
    inside = (time_s >= first_s) & (time_s <= last_s)
    if not inside.any():
        raise InputError(f"{table.path}: found heights and places at different times, expected them in the same rows.")
    values, error_m = table.values.copy(), np.zeros(len(time_s))
    for columns, is_known in ((at[:2], known[0]), (at[2:], known[1])):
        fixes = np.flatnonzero(is_known)[np.argsort(time_s[is_known], kind="stable")]
        for column in columns:
            values[:, column] = np.interp(time_s, time_s[fixes], values[fixes, column])
        if len(fixes) > 1:
            error_m = np.maximum(error_m, _errors_m(place[:, [at.index(each) for each in columns]], time_s, fixes))
    found = [f"{(inside & ~whole).sum()} are interpolated"] * bool((inside & ~whole).any())
    found += [f"{(~inside).sum()} before the first or after the last one are left out"] * bool((~inside).any())
    _LOG.warning(f"{table.path}: {(~whole).sum()} of {len(time_s)} rows have no complete place: {', '.join(found)}")
    table = replace(table, values=values[inside], line_numbers=table.line_numbers[inside])
    return table, error_m[inside] if (inside & ~whole).any() else None


def interval_of_fixes(time_s: FloatArray, error_m: FloatArray | None) -> float:
    """Return the median duration of the gaps whose positions were interpolated [s]; 0 without a gap."""
    if error_m is None:
        return 0.0
    known = np.flatnonzero(error_m == 0.0)
    between = time_s[known[1:]] - time_s[known[:-1]]
    gaps = between[np.diff(known) > 1]
    return float(np.median(gaps)) if gaps.size else 0.0


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
    """Return the standard deviation (n,) of places between known rows, from the curvature of the path.

    With constant acceleration the distance from the chord is half of the change of velocity in one interval, times the
    interval, times u (1 - u). At a corner it is up to four times as large.
    """
    at_s = time_s[known]
    # The readers of files refuse infinite places and times, and equal times.
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        took_s = np.diff(at_s)
        velocity = np.diff(place[known], axis=0) / took_s[:, None]
        bend = np.linalg.norm(np.diff(velocity, axis=0), axis=1)
    most = np.maximum(np.append(bend, 0.0), np.concatenate([[0.0], bend]))  # at either end of an interval
    which = np.clip(np.searchsorted(at_s, time_s, "right") - 1, 0, len(took_s) - 1)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        part = np.clip((time_s - at_s[which]) / took_s[which], 0.0, 1.0)
        return np.asarray(most[which] * took_s[which] * part * (1.0 - part))
