"""Agreement of lines flown in opposite directions: a clock of the places that is early or late shifts them apart."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from arrays.typing import FloatArray, IntArray
from magloc.navigation.flight_lines import FlightLine, covers_area, line_spacing
from magloc.navigation.poses import vectors_at

_ALONG = 0.25  # way between rows that are used, in spacings of lines
_MOST_ROWS = 40_000
_NEAR = 1.5  # distance of neighbours, in usual distances of opposite lines as logged
_ALIGNED = 0.5  # least cosine between a line and the usual course
_SCALE = 4.5  # readings above so many usual moduli count by their logarithm, so that one anomaly does not decide
_SMALL_S = np.linspace(-1.5, 1.5, 31)
_LEAPS_S = np.array([18.0, *(3600.0 * np.arange(1, 13))])  # GPS time is 18 s ahead of UTC, local times whole hours
_LEAST_SHARE, _FEWEST = 0.3, 200  # of neighbours that a shift leaves
_WORSE = 2.0  # ratio of the variances that lines do not share, without and with a shift
_LEAST_S = 0.15  # a shorter shift is that of a spacing of the grid


class ClockShift(NamedTuple):
    """Shift of the places' clock with which neighbouring lines agree.

    ``s``: a reading at time t belongs to the place that the log has at t + s; 0 if the lines agree as they are.
    ``agreement`` and ``agreement_now``: share of the variance that neighbouring lines have in common, with the shift
    and without it.
    """

    s: float
    agreement: float
    agreement_now: float

    @property
    def is_leap(self) -> bool:
        """True for a shift that is no lag of an instrument."""
        return abs(self.s) > _SMALL_S[-1]

    @property
    def remark(self) -> str:
        """Agreement with the shift, and its probable cause."""
        cause = "" if not self.is_leap else ": GPS time?" if abs(self.s) < _LEAPS_S[1] else ": local time?"
        side = "later" if self.s > 0.0 else "earlier"
        return f"{100.0 * self.agreement:.0f} % with places {abs(self.s):.3g} s {side}{cause}"

    @property
    def warning(self) -> str:
        """Finding and cure."""
        cure = (
            f"state pose_latency_s = {self.s:g} in [columns], or time_offset_s = {self.s:g} beside positions of another"
            " file"
            if self.is_leap
            else "check the clocks of readings and places"
        )
        now = 100.0 * max(self.agreement_now, 0.0)
        return f"lines flown in opposite directions share {now:.0f} % of their anomalies, and {self.remark}: {cure}"


def clock_shift(
    time_s: FloatArray, place_m: FloatArray, values_T: FloatArray, lines: Sequence[FlightLine]
) -> ClockShift | None:
    """Return the shift of the places' clock with which neighbouring lines agree; None if the lines do not determine it.

    Anomalies of neighbouring lines stand beside each other if the clocks agree, and apart by twice the way in the
    time of the shift if they do not. The candidates are lags up to 1.5 s, 18 s and whole hours, both ways.

    Parameters
    ----------
    time_s, place_m, values_T : ndarray, shapes (n,), (n, 3) and (n,)
        Times, places, and modulus of the field without gaps.
    lines : sequence of FlightLine
        Lines of these rows.
    """
    if not covers_area(place_m[:, :2]) or len(lines) < 2:
        return None
    spacing_m = line_spacing(place_m[:, :2])
    rows = _rows(place_m[:, :2], spacing_m)
    line, direction = _lines(place_m[:, :2], lines)
    values = np.zeros(len(time_s))
    for own in (each.rows for each in lines):
        values[own] = values_T[own] - np.median(values_T[own])
    size = float(np.median(np.abs(values[line >= 0])))
    if not size > 0.0:
        return None
    values = np.arcsinh(values / (_SCALE * size))

    def neighbours(shift_s: float) -> tuple[FloatArray, FloatArray]:
        """Return distances (k,) of the nearest places on opposite lines, and the values (2, k) of both."""
        wanted_s = time_s[rows] + shift_s
        after = np.clip(np.searchsorted(time_s, wanted_s), 1, len(time_s) - 1)
        known = (wanted_s >= time_s[0]) & (wanted_s <= time_s[-1])
        known &= (line[after] == line[after - 1]) & (line[after] >= 0)
        at = vectors_at(wanted_s, time_s, place_m[:, :2])
        there, here = (np.flatnonzero(known & (direction[after] == sign)) for sign in (1.0, -1.0))
        if not len(there) or not len(here):
            return np.zeros(0), np.zeros((2, 0))
        near = [KDTree(at[others]).query(at[own]) for own, others in ((there, here), (here, there))]
        pairs = (rows[there], rows[here[near[0][1]]]), (rows[here], rows[there[near[1][1]]])
        return np.concatenate([near[0][0], near[1][0]]), values[np.concatenate(pairs, axis=1)]

    apart_now_m = neighbours(0.0)[0]
    usual_m = float(np.median(apart_now_m)) if len(apart_now_m) else 0.0

    def agreement(shift_s: float) -> tuple[float, int]:
        """Return the share of variance that lines have in common, and the number of neighbours."""
        apart_m, pairs = neighbours(shift_s)
        x, y = pairs[:, apart_m <= _NEAR * usual_m]
        return float(2.0 * np.sum(x * y) / max(np.sum(x * x + y * y), 1e-300)), len(x)

    now, most = agreement(0.0)
    if most < _FEWEST:
        return None
    best_s, best = 0.0, now
    leaps = _LEAPS_S[np.ptp(time_s) > _LEAPS_S]
    for shift_s in (*_SMALL_S.tolist(), *leaps.tolist(), *(-leaps).tolist()):
        share, left = agreement(shift_s)
        if share > best and left >= max(_FEWEST, _LEAST_SHARE * most):
            best_s, best = shift_s, share
    found = 1.0 - now > _WORSE * (1.0 - best) and abs(best_s) > _LEAST_S
    return ClockShift(best_s if found else 0.0, best if found else now, now)


def _rows(xy_m: FloatArray, spacing_m: float) -> IntArray:
    """Return the numbers of rows at equal steps along the way; the middle ones of a long survey."""
    way_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xy_m, axis=0), axis=1))])
    rows = np.flatnonzero(np.diff(np.floor(way_m / (_ALONG * spacing_m)), prepend=-1.0) > 0.0)
    first = max(0, (len(rows) - _MOST_ROWS) // 2)
    return rows[first : first + _MOST_ROWS]


def _lines(xy_m: FloatArray, lines: Sequence[FlightLine]) -> tuple[IntArray, FloatArray]:
    """Return the line of every row, -1 without one, and its direction along the usual course: 1, -1, or 0 across."""
    line, direction = np.full(len(xy_m), -1), np.zeros(len(xy_m))
    middles = np.array([_chord(xy_m[each.rows]) for each in lines])
    cosines = middles @ np.linalg.svd(middles, full_matrices=False)[2][0]
    for number, each in enumerate(lines):
        line[each.rows] = number
        direction[each.rows] = np.sign(cosines[number]) * (abs(cosines[number]) > _ALIGNED)
    return line, direction


def _chord(xy_m: FloatArray) -> FloatArray:
    """Return the unit vector along the middle half of a line; zero for one that stands."""
    chord = xy_m[3 * len(xy_m) // 4] - xy_m[len(xy_m) // 4]
    return np.asarray(chord / max(float(np.linalg.norm(chord)), 1e-9))
