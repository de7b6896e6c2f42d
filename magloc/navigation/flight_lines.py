"""Flight lines: rows of a survey divided at gaps in time and at turns."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from arrays.typing import BoolArray, FloatArray
from magloc.navigation.course import chords

_LONGEST_GAP = 20.0  # in usual steps of time
_ANOTHER_TIME_S = 3600.0  # within one name
_TURN_deg = 35.0  # smallest angle between the courses before and after a row of a turn
_SHORTEST = 3.0  # in chords
_FLAT = 1e-3  # A single line extends less across than this share of its length.


class FlightLine(NamedTuple):
    """Rows of one line, with its mean speed and height above the ground."""

    name: str
    rows: slice
    speed_m_s: float
    height_m: float


def flight_lines(
    time_s: FloatArray, place_m: FloatArray, height_m: FloatArray, names: Sequence[tuple[float, str]] = ()
) -> list[FlightLine]:
    """Return the lines of a survey in the order of time.

    A line begins where the log names one, and after an hour without rows. Without names it begins after a gap in time
    and after a turn, and a turn belongs to the line before it.

    Parameters
    ----------
    time_s : ndarray, shape (n,)
    place_m : ndarray, shape (n, 3)
    height_m : ndarray, shape (n,)
        Heights above the ground.
    names : sequence of (float, str)
        Times at which the lines of the log begin, and their names.
    """
    if len(time_s) < 2:
        return []
    lines: list[FlightLine] = []
    for name, rows in _named_rows(time_s, names) if names else _straight_rows(time_s, place_m):
        way_m = float(np.linalg.norm(np.diff(place_m[rows, :2], axis=0), axis=1).sum())
        duration_s = float(time_s[rows][-1] - time_s[rows][0])
        speed_m_s = way_m / duration_s if duration_s else 0.0
        lines.append(FlightLine(name or f"L{len(lines) + 1}", rows, speed_m_s, float(height_m[rows].mean())))
    return lines


def _named_rows(time_s: FloatArray, names: Sequence[tuple[float, str]]) -> Iterator[tuple[str, slice]]:
    """Yield the lines of a log that have two rows or more."""
    starts = np.searchsorted(time_s, [start_s for start_s, _ in names]).tolist()
    starts[0] = 0
    for (_, name), ends in zip(names, pairwise([*starts, len(time_s)]), strict=True):
        gaps = ends[0] + 1 + np.flatnonzero(np.diff(time_s[slice(*ends)]) > _ANOTHER_TIME_S)
        yield from (
            (name, slice(*part)) for part in pairwise([ends[0], *gaps.tolist(), ends[1]]) if part[1] > part[0] + 1
        )


def _straight_rows(time_s: FloatArray, place_m: FloatArray) -> Iterator[tuple[str, slice]]:
    """Yield pieces without a gap or a turn, which have no names."""
    step_s = float(np.median(np.diff(time_s)))
    gaps = np.flatnonzero(np.diff(time_s) > _LONGEST_GAP * step_s) + 1
    for begin, stop in pairwise([0, *gaps.tolist(), len(time_s)]):
        if stop - begin > 1:
            starts = [begin + first for first in _line_starts(place_m[begin:stop, :2])]
            yield from (("", slice(*ends)) for ends in pairwise([*starts, stop]))


def _line_starts(xy_m: FloatArray) -> list[int]:
    """Return the first rows of lines in a piece without a gap: its first row, and rows where turns end."""
    way, _, _, chord = chords(xy_m)
    if not chord:
        return [0]
    turning, starts = rows_of_turns(xy_m), [0]
    for end in np.flatnonzero(turning[:-1] & ~turning[1:]) + 1:
        if way[end] - way[starts[-1]] > _SHORTEST * chord and way[-1] - way[end] > _SHORTEST * chord:
            starts.append(int(end))
    return starts


def rows_of_turns(xy_m: FloatArray) -> BoolArray:
    """Return the rows (n,) in which the courses over two metres before and after differ by more than 35°."""
    way, back, forth, chord = chords(xy_m)
    turn = np.abs(np.arctan2(back[:, 0] * forth[:, 1] - back[:, 1] * forth[:, 0], (back * forth).sum(axis=1)))
    turn[(way < chord) | (way > way[-1] - chord)] = 0.0  # beyond the ends there is no course
    return np.asarray(turn > np.radians(_TURN_deg))


def covers_area(xy_m: FloatArray) -> bool:
    """Return whether rows (n, 2) cover an area, and not a single line."""
    return bool(np.linalg.matrix_rank(xy_m - xy_m.mean(axis=0), rtol=_FLAT) == 2)


def line_spacing(xy_m: FloatArray) -> float:
    """Return the usual distance between lines [m] of rows (n, 2): the area that they cover, divided by the way."""
    way_m = float(np.linalg.norm(np.diff(xy_m, axis=0), axis=1).sum())
    extent_m = float(np.ptp(xy_m, axis=0).max())
    if not covers_area(xy_m):
        return extent_m / 20.0  # a single line
    from scipy.spatial import ConvexHull

    return max(float(ConvexHull(xy_m).volume) / way_m, extent_m / 500.0)
