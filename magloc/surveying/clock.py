"""Delay of the readings of a survey after their poses, estimated from its targets."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.interpolate import BSpline, make_lsq_spline
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from arrays.typing import FloatArray, IntArray
from magloc.navigation.crossovers import ClockShift
from magloc.navigation.flight_lines import flight_lines
from magloc.navigation.poses import vectors_at
from magloc.readings import Readings
from magloc.surveying.fit.joint_fit import Sources
from magloc.surveying.piece import Piece, search_rounds
from magloc.surveying.rounds import WHILE_SEARCHING

_STEP_M = 0.05  # step along the path for the curvature of the likelihood
_MOST_S = 1.2
_TOLERANCE = 0.1  # share of a step
_APART, _ROUNDS = 0.6, 3  # spacing of lags with a new search, in distances to the nearest sources, and rounds of each
_MOST_APART = 30  # lags on either side with a new search, which bounds its cost where the carrier is fast
_WRONG = 1.5  # χ² per reading above which sources may belong to another lag
_SETTLING = 8  # most repetitions of the search for a lag
_MISFIT = 2.0  # largest χ² per reading of sources that show a lag: otherwise it imitates another error
_FEWEST_LINES = 4  # from whose differences the error of a lag follows
_OWN = 0.9  # largest share of the curvature by one line: the others would not determine a lag
_AGREE, _SIGNIFICANT = 2.0, 4.0  # standard deviations of the difference of two estimates, and of a lag
_ROWS = 6  # rows per knot of a smooth track


class ClockLag(NamedTuple):
    """Delay of the readings in seconds, its standard deviation, and why it is doubtful, or ""."""

    s: float
    sigma_s: float
    doubt: str = ""

    @property
    def is_significant(self) -> bool:
        """True if the readings and poses differ in time."""
        return self.s != 0.0 and abs(self.s) > _SIGNIFICANT * self.sigma_s


UNKNOWN = ClockLag(0.0, math.inf)


class Trial(NamedTuple):
    """Best sources at a lag, minus twice the log-likelihood, χ² per reading, and χ² of each group with its time."""

    lag_s: float
    sources: Sources
    cost: float
    chi2: float
    of_groups: FloatArray
    group_s: FloatArray


def lag_of_lines(clock: ClockShift | None) -> ClockLag:
    """Return the lag with which opposite lines agree; unknown for a leap, or without such lines."""
    return UNKNOWN if clock is None or clock.is_leap else ClockLag(-clock.s, clock.sigma_s)


def agreed_lag(lines: ClockLag, targets: ClockLag) -> ClockLag:
    """Return the lag by the targets if opposite lines agree with it, and that by the lines otherwise.

    Errors of the places that last a whole line, sources that are not found and other errors of the model make the fit
    of the targets certain of a wrong lag. The lines need no model.
    """
    if abs(targets.s - lines.s) >= _AGREE * math.hypot(targets.sigma_s, lines.sigma_s):
        return lines._replace(doubt=f"the targets show {_with_sigma(targets)} s, opposite lines {_with_sigma(lines)} s")
    if lines.sigma_s < targets.sigma_s:
        return lines
    if lines.is_significant or not targets.is_significant:
        return targets
    shown = f"give {_with_sigma(lines)} s" if math.isfinite(lines.sigma_s) else "do not determine a lag"
    return targets._replace(doubt=f"the targets alone show it, opposite lines {shown}")


def _with_sigma(lag: ClockLag) -> str:
    return f"{lag.s:.3f} ± {lag.sigma_s:.3f}"


def by_cost(one: Trial) -> float:
    """Return the cost of a trial, to sort by."""
    return one.cost


def estimate_lag(
    piece_at: Callable[[float], Piece],
    here: Trial | None = None,
    near: Trial | None = None,
    lines: ClockLag = UNKNOWN,
) -> ClockLag:
    """Return the likeliest lag of a piece, with its error from the differences of lines.

    ``piece_at`` returns the piece with the poses of an earlier time. ``here``: trial without a lag for comparison.
    ``near``: trial to search around; by default the search begins at the lag of opposite lines, or covers all lags.
    """
    piece = piece_at(0.0)
    model = piece.model()
    way = np.linalg.norm(np.diff(model.record.middles_m, axis=0), axis=1)
    speed = float(np.median(way / np.diff(model.record.time_s)))
    if not len(piece.known) or speed * _MOST_S < _STEP_M:
        return UNKNOWN
    step, apart = _STEP_M / speed, _APART * model.nearest_m / speed
    starts_s = _starts_of_lines(piece.readings)

    def best_near(lag: Trial) -> Trial:
        """Return the likeliest trial near another one, starting from its sources."""
        found = minimize_scalar(
            lambda lag_s: fit_at_lag(piece_at, float(lag_s), lag.sources).cost,
            bounds=(lag.lag_s - apart, lag.lag_s + apart),
            method="bounded",
            options={"xatol": _TOLERANCE * step},
        )
        return fit_at_lag(piece_at, float(found.x), lag.sources)

    def sides(lag: Trial) -> list[Trial]:
        """Return the trials one step before and after a trial."""
        return [fit_at_lag(piece_at, lag.lag_s + sign * step, lag.sources) for sign in (-1.0, 1.0)]

    here = fit_at_lag(piece_at, 0.0, piece.known) if here is None else here
    if near is not None:
        at = best_near(near)
    else:
        beside = _Parabola.of(here, sides(here), starts_s)
        if here.chi2 < _WRONG and beside.is_at_rest(model.threshold * max(1.0, here.chi2)) and not lines.is_significant:
            return ClockLag(-beside.slope / beside.curvature, beside.sigma_s)
        at = best_near(here)
        if lines.is_significant:
            at = min(at, best_near(fit_at_lag(piece_at, lines.s, None)), key=by_cost)
        elif at.chi2 > _WRONG:  # each source may be found twice, once for each direction of travel
            n = min(math.ceil(_MOST_S / apart), _MOST_APART)
            most_s = min(_MOST_S, n * apart)
            lags = np.linspace(-most_s, most_s, 2 * n + 1).tolist()
            new = [fit_at_lag(piece_at, lag_s, None) for lag_s in lags]
            here = min(here, new[n], key=by_cost)
            at = min(at, best_near(min(new, key=by_cost)), key=by_cost)
    here = min(here, fit_at_lag(piece_at, 0.0, at.sources), key=by_cost)  # a search may have found more
    if at.chi2 > _MISFIT or here.cost - at.cost < model.threshold * max(1.0, at.chi2):
        return UNKNOWN
    for _ in range(_SETTLING):  # sources found at another lag bias the search
        again = best_near(min([fit_at_lag(piece_at, at.lag_s, None), *sides(at)], key=by_cost))
        settled = again.cost > at.cost - 1.0
        at = min(at, again, key=by_cost)
        if settled:
            break
    beside = _Parabola.of(at, sides(at), starts_s)
    lag_s = at.lag_s - beside.slope / beside.curvature if beside.curvature > 0.0 else math.inf
    return ClockLag(lag_s, beside.sigma_s) if abs(lag_s) < _MOST_S else UNKNOWN


class _Parabola(NamedTuple):
    """Slope and curvature of the cost beside a lag, and the error of its lowest point."""

    slope: float
    curvature: float
    sigma_s: float

    @classmethod
    def of(cls, at: Trial, sides: Sequence[Trial], starts_s: FloatArray) -> _Parabola:
        """Return the parabola through a trial and those before and after it.

        The error is the larger one of that by the curvature and that by leaving out each line.
        """
        before, after = sides
        step = 0.5 * (after.lag_s - before.lag_s)
        costs = np.array([[trial.cost, *_cost_of_lines(trial, starts_s)] for trial in (before, at, after)])
        slopes, curvatures = (costs[2] - costs[0]) / (2.0 * step), (costs[0] - 2.0 * costs[1] + costs[2]) / step**2
        slope, curvature = float(slopes[0]), float(curvatures[0])
        n = len(starts_s)
        if curvature <= 0.0 or n < _FEWEST_LINES:
            return cls(slope, curvature, math.inf)
        left = curvature - np.minimum(curvatures[1:], _OWN * curvature)
        by_lines = math.sqrt((n - 1) / n * float(np.sum(((slopes[1:] - slopes[1:].mean()) / left) ** 2)))
        return cls(slope, curvature, max(math.sqrt(2.0 * max(1.0, at.chi2) / curvature), by_lines))

    def is_at_rest(self, least_gain: float) -> bool:
        """Return whether the lowest point gains less."""
        return self.curvature > 0.0 and self.slope**2 < 2.0 * self.curvature * least_gain


def _starts_of_lines(readings: Readings) -> FloatArray:
    """Return the times (L,) at which the lines of some rows begin."""
    place_m = readings.array_position_m
    assert place_m is not None
    lines = flight_lines(readings.time_s, place_m, place_m[:, 2], readings.lines)
    return np.array([readings.time_s[line.rows.start] for line in lines])


def _cost_of_lines(trial: Trial, starts_s: FloatArray) -> FloatArray:
    """Return χ² of each line (L,)."""
    line = np.maximum(np.searchsorted(starts_s, trial.group_s, "right") - 1, 0)
    return np.bincount(line, trial.of_groups, len(starts_s)).astype(np.float64)


def fit_at_lag(piece_at: Callable[[float], Piece], lag_s: float, start: Sources | None) -> Trial:
    """Fit sources at a lag, from given sources or from those of a new search."""
    piece = replace(piece_at(lag_s), known=Sources.none() if start is None else start)
    start = search_rounds(piece, _ROUNDS) if start is None else start
    model = piece.model()
    group = piece.groups(model.record, WHILE_SEARCHING * model.nearest_m)
    fit, background = model.refit(start, group)
    cost = fit.cost + background.noise_log_determinant + model.threshold * len(fit.sources)
    left = fit.residual * (fit.residual - background.Q @ (background.Q.T @ fit.residual))
    of_groups = left.reshape(background.white.n_groups, -1).sum(axis=1)
    first_s = model.record.time_s[background.white.starts[:-1]]
    return Trial(lag_s, fit.sources, cost, fit.cost / fit.residual.size, of_groups, first_s)


@dataclass(frozen=True, eq=False)
class SmoothTrack:
    """Smoothed track: least-squares cubic splines with a knot at every sixth row.

    Each piece without gaps has its own spline. A spline is a projection: the white errors that it keeps and those that
    it removes are independent, so that moving only the smooth part does not change the size of the errors.

    Attributes
    ----------
    readings : Readings
    first : ndarray of int
        First row of every piece.
    splines : list of BSpline
        Splines of places and quaternions against time, one per piece.
    """

    readings: Readings
    first: IntArray
    splines: list[BSpline]

    @classmethod
    def of(cls, readings: Readings) -> SmoothTrack:
        """Smooth the poses of readings in order of time."""
        time_s, step_s = readings.time_s, np.diff(readings.time_s)
        assert readings.array_position_m is not None
        assert readings.array_rotation is not None
        quaternion = readings.array_rotation.as_quat()
        same = np.concatenate([[1.0], np.sum(quaternion[1:] * quaternion[:-1], axis=1)])
        quaternion = quaternion * np.cumprod(np.where(same < 0.0, -1.0, 1.0))[:, None]  # -q and q are the same rotation
        rows = np.hstack([readings.array_position_m, quaternion])
        ends = np.flatnonzero(step_s > _ROWS * np.median(step_s)) + 1
        splines = []
        for own in np.split(np.arange(len(time_s)), ends):
            t, degree = time_s[own], min(3, len(own) - 1)
            knots = np.concatenate([np.full(degree + 1, t[0]), t[_ROWS:-_ROWS:_ROWS], np.full(degree + 1, t[-1])])
            flat = BSpline(np.array([t[0], t[0] + 1.0]), rows[own], 0)
            splines.append(make_lsq_spline(t, rows[own], knots, degree) if degree else flat)
        return cls(readings, np.concatenate([[0], ends]), splines)

    @cached_property
    def _ambient_in_world_T(self) -> FloatArray | None:
        ambient, turn = self.readings.ambient_T, self.readings.array_rotation
        return None if ambient is None or turn is None else np.asarray(turn.apply(ambient))

    def with_earlier_poses(self, lag_s: float, rows: IntArray | None = None) -> Readings:
        """Return readings with the poses of an earlier time, and the ambient field in these poses.

        Each pose changes by as much as the smooth track does in that time. Interpolation between two rows would average
        their errors and seem likelier for that reason alone. The modulus of the ambient field stays that of the row's
        own time, because a base station uses the clock of the readings.
        """
        rows = np.arange(len(self.readings)) if rows is None else rows
        own = self.readings[rows]
        if not lag_s:
            return own
        place, turn = own.array_position_m, own.array_rotation
        assert place is not None
        assert turn is not None
        now, earlier = self._at(own.time_s, rows), self._at(own.time_s - lag_s, rows)
        turned = turn * Rotation.from_quat(now[:, 3:]).inv() * Rotation.from_quat(earlier[:, 3:])
        posed = replace(own, array_position_m=place + earlier[:, :3] - now[:, :3], array_rotation=turned)
        if own.ambient_T is None or self._ambient_in_world_T is None:
            return posed
        # In the world frame the ambient field hardly changes between two rows.
        in_world = vectors_at(own.time_s - lag_s, self.readings.time_s, self._ambient_in_world_T)
        ambient = turned.inv().apply(in_world)
        as_read, then = (np.linalg.norm(field, axis=1, keepdims=True) for field in (own.ambient_T, ambient))
        return replace(posed, ambient_T=ambient * (as_read / then))

    def _at(self, wanted_s: FloatArray, rows: IntArray) -> FloatArray:
        """Return places and quaternions (m, 7) at other times.

        Beyond its ends a piece continues along a straight line.
        """
        out = np.empty((len(rows), 7))
        which = np.searchsorted(self.first, rows, "right") - 1
        ends = np.append(self.first[1:], len(self.readings)) - 1
        for piece in np.unique(which):
            spline, own = self.splines[piece], which == piece
            start_s, end_s = self.readings.time_s[[self.first[piece], ends[piece]]]
            inside = np.clip(wanted_s[own], start_s, end_s)
            beyond = (wanted_s[own] - inside)[:, None]
            out[own] = spline(inside)
            if beyond.any() and end_s > start_s:
                far = min(1.0, 2.0 * _ROWS / (ends[piece] - self.first[piece])) * (end_s - start_s)
                before, after = ((spline(at + far) - spline(at)) / far for at in (start_s, end_s - far))
                out[own] += np.where(beyond < 0.0, before, after) * beyond
        return out
