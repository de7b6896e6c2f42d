"""Flight lines: rows of a survey divided at gaps in time and at turns."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from arrays.typing import FloatArray

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


def flight_lines(time_s: FloatArray, place_m: FloatArray, ground_m: float = 0.0) -> list[FlightLine]:
    """Return the lines of a survey in the order of time.

    A line begins after a gap in time and after a turn. A turn belongs to the line before it.

    Parameters
    ----------
    time_s : ndarray, shape (n,)
    place_m : ndarray, shape (n, 3)
    ground_m : float
        Height of the ground in the world frame.
    """
    if len(time_s) < 2:
        return []
    step_s = float(np.median(np.diff(time_s)))
    gaps = np.flatnonzero(np.diff(time_s) > _LONGEST_GAP * step_s) + 1
    pieces = [slice(a, b) for a, b in zip([0, *gaps], [*gaps, len(time_s)], strict=True) if b - a > 1]
    starts = [slice_.start + first for slice_ in pieces for first in _line_starts(place_m[slice_, :2])]
    ends = [*starts[1:], len(time_s)]
    stops = {piece.stop for piece in pieces}
    lines = []
    for number, (start, end) in enumerate(zip(starts, ends, strict=True), 1):
        stop = min([stop for stop in stops if start < stop <= end], default=end)
        way = float(np.linalg.norm(np.diff(place_m[start:stop, :2], axis=0), axis=1).sum())
        duration = float(time_s[stop - 1] - time_s[start])
        height = float(place_m[start:stop, 2].mean() - ground_m)
        lines.append(FlightLine(f"L{number}", slice(start, stop), way / duration if duration else 0.0, height))
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
