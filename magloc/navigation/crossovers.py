"""Agreement of lines flown in opposite directions: a clock of the places that is early or late shifts them apart."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from arrays.typing import FloatArray, IntArray
from magloc.navigation.flight_lines import FlightLine, covers_area, line_spacing, rows_of_turns

_ALONG = 0.1  # way between rows that are used, in spacings of lines
_MOST_ROWS = 20_000
_NEAR, _FAR = 1.5, 3.0  # distance of neighbouring lines in usual ones, and of their rows in spacings
_OVERLAP = 0.3  # least common part of neighbouring lines
_ALIGNED = 0.5  # least cosine between a line and the usual course
_SCALE = 4.5  # readings above so many usual moduli count by their logarithm, so that one anomaly does not decide
_LONGEST_S, _STEP_S, _COARSE_S = 1.6, 0.05, 0.4  # longest lag, and steps of lags and of shifts beside a leap
_LEAPS_S = (18.0, *(3600.0 * n for n in range(1, 13)))  # GPS time is 18 s ahead of UTC, local times whole hours
_NO_LEAPS_S = np.concatenate([np.arange(5.0, 14.0, 0.8), np.arange(22.0, 31.0, 0.8)])  # agreement by chance
_LEAST_SHARE, _FEWEST, _FEWEST_LINES = 0.3, 60, 4  # of neighbours that a shift leaves, and of lines
_WORST_SIGMA_S = 0.25  # a lag of larger σ is not determined
_EXACT_S = 0.1  # a leap this near to 18 s or an hour has no lag beside it
_SIGNIFICANT = 4.0  # σ of a lag: 1 % of t with 5 dof
_WORSE, _CLEARLY = 2.0, 1.5  # ratio of the variances that lines do not share, with a lag and by chance, and with a leap
_EXCHANGED, _GAIN = 1.3, 2.0  # the same ratio for exchanged sensors, and their gain in standard deviations


class ClockShift(NamedTuple):
    """Shift of the places' clock with which neighbouring lines agree.

    ``s``: a reading at time t belongs to the place that the log has at t + s; 0 if the lines do not determine it.
    ``sigma_s``: its standard deviation by leaving out each line; infinite if the lines do not determine it.
    ``agreement`` and ``agreement_now``: share of the variance that neighbouring lines have in common, with the shift
    and without it. ``others_s``: leaps with which the lines agree as well, so that none of them is certain.
    """

    s: float
    agreement: float
    agreement_now: float
    sigma_s: float = math.inf
    others_s: tuple[float, ...] = ()

    @property
    def is_leap(self) -> bool:
        """True for a shift that is no lag of an instrument."""
        return abs(self.s) > _LONGEST_S

    @property
    def is_significant(self) -> bool:
        """True if the lines disagree as they are."""
        return self.is_leap or bool(self.others_s) or abs(self.s) > _SIGNIFICANT * self.sigma_s

    @property
    def remark(self) -> str:
        """Agreement with the shift, and its probable cause."""
        share = f"{100.0 * self.agreement:.0f} % with places"
        if self.others_s:
            return f"{share} {' or '.join(map(_later, self.others_s))}: not determined"
        cause = "" if not self.is_leap else ": GPS time?" if abs(self.s) < _LEAPS_S[1] / 2.0 else ": local time?"
        return f"{share} {_later(self.s)}{cause}"

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


def _later(shift_s: float) -> str:
    return f"{abs(shift_s):.3g} s {'later' if shift_s > 0.0 else 'earlier'}"


class _Trial(NamedTuple):
    """Agreement of all lines with a shift, and of all but one (L,)."""

    shift_s: float
    share: float
    without: FloatArray


def jackknife_sigma(without: FloatArray) -> float:
    """Return the standard deviation of an estimate from those that leave out one of its parts each (L,)."""
    n = len(without)
    return math.sqrt((n - 1) / n * float(np.sum((without - without.mean()) ** 2)))


def clock_shift(
    time_s: FloatArray, place_m: FloatArray, values_T: FloatArray, lines: Sequence[FlightLine]
) -> ClockShift | None:
    """Return the shift of the places' clock with which neighbouring lines agree; None if the lines do not determine it.

    Anomalies of neighbouring lines stand beside each other if the clocks agree, and apart by twice the way in the
    time of the shift if they do not. The candidates are lags up to 1.6 s, 18 s and whole hours, both ways.

    Parameters
    ----------
    time_s, place_m, values_T : ndarray, shapes (n,), (n, 3) and (n,)
        Times, places, and modulus of the field, NaN where it is missing.
    lines : sequence of FlightLine
        Lines of these rows.
    """
    if not covers_area(place_m[:, :2]) or len(lines) < _FEWEST_LINES:
        return None
    pairs = _OppositeLines.of(time_s, place_m[:, :2], values_T, lines)
    now = None if pairs is None else pairs.agreement(0.0, _FEWEST)
    if pairs is None or now is None:
        return None
    fewest = max(_FEWEST, int(_LEAST_SHARE * pairs.count(0.0)))

    def trials(shifts_s: FloatArray) -> list[_Trial]:
        return [trial for s in shifts_s if (trial := pairs.agreement(float(s), fewest)) is not None]

    lags = trials(_around(0.0, _STEP_S))
    lag = max(lags, key=_share)
    shift_s, sigma_s = _peak_of(lags)
    is_known = sigma_s < _WORST_SIGMA_S and abs(shift_s) < _LONGEST_S - _STEP_S
    found = ClockShift(shift_s, lag.share, now.share, sigma_s) if is_known else ClockShift(0.0, now.share, now.share)
    leaps_s = [side * leap_s for leap_s in _LEAPS_S if np.ptp(time_s) > leap_s for side in (-1.0, 1.0)]
    leaps = [max(near, key=_share) for near in (trials(_around(leap_s, _COARSE_S)) for leap_s in leaps_s) if near]
    best = max([lag, *leaps], key=_share)
    if 1.0 - lag.share < _WORSE * (1.0 - best.share):
        return found
    by_chance = trials(np.concatenate([-_NO_LEAPS_S, _NO_LEAPS_S]))
    rivals = [t for t in (*leaps, *by_chance) if t is not best and 1.0 - t.share < _CLEARLY * (1.0 - best.share)]
    leap_s, sigma_s = _peak_of(trials(_around(best.shift_s, _STEP_S)))
    exact_s = min(leaps_s, key=lambda exact_s: abs(exact_s - leap_s))
    leap_s = exact_s if abs(exact_s - leap_s) < min(_SIGNIFICANT * sigma_s, _EXACT_S) else leap_s
    if rivals:
        return ClockShift(0.0, best.share, now.share, others_s=(leap_s, *(t.shift_s for t in rivals if t in leaps)))
    return ClockShift(leap_s, best.share, now.share, sigma_s)


def gain_of_exchange(
    time_s: FloatArray, sensors_m: Sequence[FloatArray], values_T: FloatArray, lines: Sequence[FlightLine]
) -> float:
    """Return the gain of agreement if two sensors (n, 3) with values (n, 2) change places; 0 if it is not significant.

    It is negative if the lines agree as they are.
    """
    if len(lines) < _FEWEST_LINES or not covers_area(sensors_m[0][:, :2]):
        return 0.0
    shares = []
    for order in ((0, 1), (1, 0)):
        both = []
        for channel, place in enumerate(order):
            pairs = _OppositeLines.of(time_s, sensors_m[place][:, :2], values_T[:, channel], lines)
            trial = None if pairs is None else pairs.agreement(0.0, _FEWEST)
            if trial is None:
                return 0.0
            both.append(np.array([trial.share, *trial.without]))
        if len(both[0]) != len(both[1]):
            return 0.0
        shares.append(0.5 * (both[0] + both[1]))
    as_is, exchanged = shares
    if len(as_is) != len(exchanged):
        return 0.0
    gain = exchanged - as_is
    is_large = 1.0 - as_is[0] > _EXCHANGED * (1.0 - exchanged[0])
    return float(gain[0]) if gain[0] < 0.0 or (is_large and gain[0] > _GAIN * jackknife_sigma(gain[1:])) else 0.0


def _around(middle_s: float, step_s: float) -> FloatArray:
    return middle_s + np.arange(-_LONGEST_S, _LONGEST_S + 0.5 * step_s, step_s)


def _share(trial: _Trial) -> float:
    return trial.share


def _peak_of(trials: Sequence[_Trial]) -> tuple[float, float]:
    """Return the shift of the best agreement of equidistant trials, and its standard deviation."""
    shifts_s = np.array([trial.shift_s for trial in trials])
    shares = np.array([[trial.share, *trial.without] for trial in trials])
    peaks_s = np.array([_peak(shifts_s, column) for column in shares.T])
    return float(peaks_s[0]), jackknife_sigma(peaks_s[1:])


def _peak(x: FloatArray, y: FloatArray) -> float:
    """Return the place of the largest value, refined by a parabola."""
    k = int(np.argmax(y))
    if not 0 < k < len(x) - 1:
        return float(x[k])
    before, after = y[k] - y[k - 1], y[k] - y[k + 1]
    return float(x[k] + 0.5 * (x[k + 1] - x[k]) * (before - after) / max(before + after, 1e-300))


class _OppositeLines(NamedTuple):
    """Rows on straight lines with compressed anomalies, places along and across the course, and pairs of lines."""

    time_s: FloatArray
    course_m: FloatArray
    rows: IntArray
    values: FloatArray
    line: IntArray
    pairs: list[tuple[int, int]]
    spacing_m: float

    @classmethod
    def of(
        cls, time_s: FloatArray, xy_m: FloatArray, values_T: FloatArray, lines: Sequence[FlightLine]
    ) -> _OppositeLines | None:
        """Return the rows of lines in opposite directions; None without an anomaly or without such lines."""
        chords = np.array([_chord(xy_m[each.rows]) for each in lines])
        axis = np.linalg.svd(chords, full_matrices=False)[2][0]
        course_m = xy_m @ np.array([axis, [-axis[1], axis[0]]]).T
        line = np.full(len(xy_m), -1)
        values = np.zeros(len(time_s))
        for number, each in enumerate(lines):
            known = each.rows.start + np.flatnonzero(np.isfinite(values_T[each.rows]))
            line[known] = number
            values[known] = values_T[known] - np.median(values_T[known]) if len(known) else 0.0
        line[rows_of_turns(xy_m)] = -1
        size = float(np.median(np.abs(values[line >= 0]))) if (line >= 0).any() else 0.0
        if not size > 0.0:
            return None
        spacing_m = line_spacing(xy_m)
        rows = _rows(xy_m, spacing_m)
        rows, values = rows[line[rows] >= 0], np.arcsinh(values / (_SCALE * size))
        pairs = _opposite_pairs(course_m, line, chords @ axis)
        return cls(time_s, course_m, rows, values, line, pairs, spacing_m) if pairs else None

    def count(self, shift_s: float) -> int:
        """Return the number of neighbours."""
        return self.neighbours(shift_s)[0].shape[1]

    def agreement(self, shift_s: float, fewest: int) -> _Trial | None:
        """Return the share of variance that neighbouring lines have in common; None with too few neighbours."""
        (here, there), (x, y) = self.neighbours(shift_s)
        used = np.unique(self.line[self.rows])
        if len(x) < fewest or len(used) < _FEWEST_LINES:
            return None
        common, both = 2.0 * x * y, x * x + y * y
        totals = [float(common.sum()), float(both.sum())]
        n = int(self.line.max()) + 1
        own = [np.bincount(here, each, n) + np.bincount(there, each, n) for each in (common, both)]
        common_left, both_left = (total - of_line[used] for total, of_line in zip(totals, own, strict=True))
        left = both_left > _LEAST_SHARE * both_left.max()
        return _Trial(shift_s, totals[0] / totals[1], np.where(left, common_left / np.where(left, both_left, 1.0), 0.0))

    def neighbours(self, shift_s: float) -> tuple[IntArray, FloatArray]:
        """Return the lines (2, k) and values (2, k) of readings and of those beside them on opposite lines."""
        wanted_s = self.time_s[self.rows] + shift_s
        after = np.clip(np.searchsorted(self.time_s, wanted_s), 1, len(self.time_s) - 1)
        there = np.where(self.line[after] == self.line[after - 1], self.line[after], -1)
        there[(wanted_s < self.time_s[0]) | (wanted_s > self.time_s[-1])] = -1
        along_m, across_m = (np.interp(wanted_s, self.time_s, axis) for axis in self.course_m.T)
        order = np.lexsort([along_m, there])
        ends = np.searchsorted(there[order], np.arange(self.line.max() + 2))
        lines, values = [np.zeros((2, 0), np.intp)], [np.zeros((2, 0))]
        for p, q in self.pairs:
            own, other = order[ends[p] : ends[p + 1]], order[ends[q] : ends[q + 1]]
            if len(other) < 2:
                continue
            k = np.clip(np.searchsorted(along_m[other], along_m[own]), 1, len(other) - 1)
            before, behind = other[k - 1], other[k]
            step_m = along_m[behind] - along_m[before]
            share = (along_m[own] - along_m[before]) / np.maximum(step_m, 1e-9)
            beside_m = across_m[before] + share * (across_m[behind] - across_m[before]) - across_m[own]
            near = (share >= 0.0) & (share <= 1.0) & (step_m < self.spacing_m) & (abs(beside_m) < _FAR * self.spacing_m)
            value, of_line = self.values[self.rows], self.line[self.rows]
            near &= of_line[own] != of_line[before]
            mean = value[before] + share * (value[behind] - value[before])
            lines.append(np.stack([of_line[own], of_line[before]])[:, near])
            values.append(np.stack([value[own], mean])[:, near])
        return np.concatenate(lines, axis=1), np.concatenate(values, axis=1)


def _opposite_pairs(course_m: FloatArray, line: IntArray, direction: FloatArray) -> list[tuple[int, int]]:
    """Return the pairs of neighbouring lines of opposite directions, each in both orders."""
    members = [np.flatnonzero(line == number) for number in range(len(direction))]
    extents = np.array([_extent(course_m[own]) for own in members])
    low, high, across = extents.T
    overlap = np.minimum(high[:, None], high) - np.maximum(low[:, None], low)
    is_opposite = (direction[:, None] * direction < 0.0) & (
        np.minimum(abs(direction[:, None]), abs(direction)) > _ALIGNED
    )
    is_beside = is_opposite & (overlap > _OVERLAP * np.minimum(high - low, (high - low)[:, None]))
    apart_m = np.where(is_beside, abs(across[:, None] - across), np.inf)
    nearest_m = apart_m.min(axis=1)
    if not np.isfinite(nearest_m).any():
        return []
    usual_m = float(np.median(nearest_m[np.isfinite(nearest_m)]))
    first, second = np.nonzero(apart_m <= _NEAR * usual_m)
    return list(zip(first.tolist(), second.tolist(), strict=True))


def _extent(course_m: FloatArray) -> tuple[float, float, float]:
    """Return the ends along the course and the place across it; NaN without rows."""
    if not len(course_m):
        return math.nan, math.nan, math.nan
    along_m, across_m = course_m.T
    return float(along_m.min()), float(along_m.max()), float(np.median(across_m))


def _rows(xy_m: FloatArray, spacing_m: float) -> IntArray:
    """Return the numbers of rows at equal steps along the way; the middle ones of a long survey."""
    way_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xy_m, axis=0), axis=1))])
    rows = np.flatnonzero(np.diff(np.floor(way_m / (_ALONG * spacing_m)), prepend=-1.0) > 0.0)
    first = max(0, (len(rows) - _MOST_ROWS) // 2)
    return rows[first : first + _MOST_ROWS]


def _chord(xy_m: FloatArray) -> FloatArray:
    """Return the unit vector along the middle half of a line; zero for one that stands."""
    chord = xy_m[3 * len(xy_m) // 4] - xy_m[len(xy_m) // 4]
    return np.asarray(chord / max(float(np.linalg.norm(chord)), 1e-9))
