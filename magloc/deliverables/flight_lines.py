"""Flight lines: rows of a survey divided at gaps in time and at turns."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from arrays.typing import FloatArray
from magloc.terrain.surface import FLAT, Terrain

_LONGEST_GAP = 20.0  # in usual steps of time
_CHORD_M = 2.0  # length over which the course is measured
_TURN_deg = 35.0  # smallest angle between the courses before and after a row of a turn
_SHORTEST = 3.0  # in chords


class FlightLine(NamedTuple):
    """Rows of one line, with its mean speed and height above the ground."""

    name: str
    rows: slice
    speed_m_s: float
    height_m: float


def flight_lines(
    time_s: FloatArray,
    place_m: FloatArray,
    terrain: Terrain = FLAT,
) -> list[FlightLine]:
    """Return the lines of a survey in the order of time.

    A line begins after a gap in time and after a turn. A turn belongs to the line before it.

    Parameters
    ----------
    time_s : ndarray, shape (n,)
    place_m : ndarray, shape (n, 3)
    terrain : Terrain
        Ground that heights count from.
    """
    if len(time_s) < 2:
        return []
    step_s = float(np.median(np.diff(time_s)))
    gaps = np.flatnonzero(np.diff(time_s) > _LONGEST_GAP * step_s) + 1
    lines: list[FlightLine] = []
    flat_m = terrain.flatten(place_m)
    for begin, stop in pairwise([0, *gaps.tolist(), len(time_s)]):
        if stop - begin < 2:
            continue  # a single row
        starts = [begin + first for first in _line_starts(place_m[begin:stop, :2])]
        for rows in (slice(*ends) for ends in pairwise([*starts, stop])):
            way_m = float(np.linalg.norm(np.diff(place_m[rows, :2], axis=0), axis=1).sum())
            duration_s = float(time_s[rows][-1] - time_s[rows][0])
            height_m = float(flat_m[rows, 2].mean() - terrain.height_m)
            speed_m_s = way_m / duration_s if duration_s else 0.0
            lines.append(FlightLine(f"L{len(lines) + 1}", rows, speed_m_s, height_m))
    return lines


def _line_starts(xy_m: FloatArray) -> list[int]:
    """Return the first rows of lines in a piece without a gap: its first row, and rows where turns end."""
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xy_m, axis=0), axis=1))])
    chord = min(_CHORD_M, way[-1] / 10.0)
    if not chord > 0.0:
        return [0]
    way += np.arange(len(way)) * 1e-9 * chord  # rows at rest: interpolation needs increasing abscissae
    before, here, after = (
        np.stack([np.interp(way + shift, way, axis) for axis in xy_m.T], axis=-1) for shift in (-chord, 0.0, chord)
    )
    back, forth = here - before, after - here
    turn = np.abs(np.arctan2(back[:, 0] * forth[:, 1] - back[:, 1] * forth[:, 0], (back * forth).sum(axis=1)))
    turn[(way < chord) | (way > way[-1] - chord)] = 0.0  # beyond the ends there is no course
    turning = turn > np.radians(_TURN_deg)
    starts = [0]
    for end in np.flatnonzero(turning[:-1] & ~turning[1:]) + 1:
        if way[end] - way[starts[-1]] > _SHORTEST * chord and way[-1] - way[end] > _SHORTEST * chord:
            starts.append(int(end))
    return starts
