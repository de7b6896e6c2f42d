"""Delay of the readings of a survey after their poses, estimated from its targets."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.interpolate import BSpline, make_lsq_spline
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from arrays.array import SensorArray
from arrays.typing import FloatArray, IntArray
from magloc.navigation.crossovers import ClockShift, clock_shift
from magloc.navigation.flight_lines import flight_lines
from magloc.navigation.poses import vectors_at
from magloc.readings import Readings
from magloc.surveying.fit.joint_fit import Sources
from magloc.surveying.piece import Piece, search_rounds
from magloc.surveying.preparation import field_moduli, without_ambient
from magloc.surveying.rounds import WHILE_SEARCHING

_STEP_M = 0.05  # step along the path for the curvature of the likelihood
_MOST_S = 1.2
_TOLERANCE = 0.1  # share of a step
_APART, _ROUNDS = 0.6, 3  # spacing of lags with a new search, in distances to the nearest sources, and rounds of each
_MOST_APART = 30  # lags on either side with a new search, which bounds its cost where the carrier is fast
_WRONG = 1.5  # χ² per reading above which sources may belong to another lag
_SETTLING = 8  # most repetitions of the search for a lag
_MISFIT, _SHARE = 2.0, 0.5  # largest χ² per reading, or share of that without a lag
_ROWS = 6  # rows per knot of a smooth track


class ClockLag(NamedTuple):
    """Delay of the readings in seconds, and its standard deviation."""

    s: float
    sigma_s: float


class Trial(NamedTuple):
    """Best sources at a lag, minus twice the log-likelihood, and χ² per reading."""

    lag_s: float
    sources: Sources
    cost: float
    chi2: float


def shift_of_places(array: SensorArray, readings: Readings) -> ClockShift | None:
    """Return the shift of the places' clock with which opposite lines agree; None if they do not determine it."""
    place_m = readings.array_position_m
    if place_m is None or not len(readings):
        return None
    values_T = without_ambient(readings, field_moduli(array, readings.values_T)).mean(axis=1)
    lines = flight_lines(readings.time_s, place_m, place_m[:, 2], readings.lines)
    return clock_shift(readings.time_s, place_m, values_T, lines)


def by_cost(one: Trial) -> float:
    """Return the cost of a trial, to sort by."""
    return one.cost


def estimate_lag(piece_at: Callable[[float], Piece], here: Trial | None = None, near: Trial | None = None) -> ClockLag:
    """Return the likeliest lag of a piece, 0 if it is not significant.

    ``piece_at`` returns the piece with the poses of an earlier time. ``here``: trial without a lag for comparison.
    ``near``: trial to search around; by default the search covers all lags.
    """
    piece = piece_at(0.0)
    model = piece.model()
    way = np.linalg.norm(np.diff(model.record.middles_m, axis=0), axis=1)
    speed = float(np.median(way / np.diff(model.record.time_s)))
    if not len(piece.known) or speed * _MOST_S < _STEP_M:
        return ClockLag(0.0, math.inf)
    step, apart = _STEP_M / speed, _APART * model.nearest_m / speed

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

    def beside(lag: Trial) -> tuple[float, float]:
        """Return slope and curvature of the cost."""
        before, after = (side.cost for side in sides(lag))
        return (after - before) / (2.0 * step), (before - 2.0 * lag.cost + after) / step**2

    here = fit_at_lag(piece_at, 0.0, piece.known) if here is None else here
    if near is None:
        slope, curvature = beside(here)
        if (
            here.chi2 < _WRONG
            and curvature > 0.0
            and slope**2 < 2.0 * curvature * model.threshold * max(1.0, here.chi2)
        ):
            return ClockLag(0.0, math.sqrt(2.0 / curvature))
        at = best_near(here)
        if at.chi2 > _WRONG:  # each source may be found twice, once for each direction of travel
            n = min(math.ceil(_MOST_S / apart), _MOST_APART)
            most_s = min(_MOST_S, n * apart)
            lags = np.linspace(-most_s, most_s, 2 * n + 1).tolist()
            new = [fit_at_lag(piece_at, lag_s, None) for lag_s in lags]
            here = min(here, new[n], key=by_cost)
            at = min(at, best_near(min(new, key=by_cost)), key=by_cost)
    else:
        at = best_near(near)
    here = min(here, fit_at_lag(piece_at, 0.0, at.sources), key=by_cost)  # a search may have found more
    explained = at.chi2 < max(_MISFIT, _SHARE * here.chi2)  # otherwise a lag imitates another error
    if not explained or here.cost - at.cost < model.threshold * max(1.0, at.chi2):
        return ClockLag(0.0, math.inf)
    for _ in range(_SETTLING):  # sources found at another lag bias the search
        again = best_near(min([fit_at_lag(piece_at, at.lag_s, None), *sides(at)], key=by_cost))
        settled = again.cost > at.cost - 1.0
        at = min(at, again, key=by_cost)
        if settled:
            break
    slope, curvature = beside(at)
    lag_s = at.lag_s - slope / curvature if curvature > 0.0 else math.inf
    return ClockLag(lag_s, math.sqrt(2.0 / curvature)) if abs(lag_s) < _MOST_S else ClockLag(0.0, math.inf)


def fit_at_lag(piece_at: Callable[[float], Piece], lag_s: float, start: Sources | None) -> Trial:
    """Fit sources at a lag, from given sources or from those of a new search."""
    piece = replace(piece_at(lag_s), known=Sources.none() if start is None else start)
    start = search_rounds(piece, _ROUNDS) if start is None else start
    model = piece.model()
    group = piece.groups(model.record, WHILE_SEARCHING * model.nearest_m)
    fit, background = model.refit(start, group)
    cost = fit.cost + background.noise_log_determinant + model.threshold * len(fit.sources)
    return Trial(lag_s, fit.sources, cost, fit.cost / fit.residual.size)


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
