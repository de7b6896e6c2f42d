"""Compiled profiles of χ² over the range.

The readable twin is :mod:`magloc.localization.uncertainty.range_profile`. Every end of a profile takes one step of its
search, then all that have not ended are refined side by side.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from arrays.typing import FloatArray, IntArray
from magloc.compilation import internal
from magloc.linalg_compiled import put
from magloc.localization.fit.variable_projection_compiled import Refined, Rules, refine
from magloc.measurement.whitened_compiled import SMALLEST_S, LaneModel

# Gauss-Newton gain in χ² at which a point of the profile is one: it is read at a rise of 3.84 to 0.01.
PROFILE_TOLERANCE = 1e-2
_SAME_RISE = 0.01
# No step of the profile is longer, in α: it would leap over what is between.
LARGEST_PROFILE_STEP = 0.2
_MOST_STEPS = 100
# Columns of the state of a search: its optimum's α and χ², the rise that is wanted, the direction of the search, the α
# that is tried, the last ones within and beyond the rise with their χ², less that, and the last step.
_OPTIMUM, _CHI2, _RISE, _TOWARD, _TRIED, _INSIDE, _F_INSIDE, _OUTSIDE, _F_OUTSIDE, _LAST_STEP, _COLUMNS = range(11)


class FlatFits(NamedTuple):
    """Fits of rows, one after the other: the first one of every row (n + 1,), q (f, 4), scaled moments (f, 3), χ²."""

    first: IntArray
    q: FloatArray
    mu: FloatArray
    chi2: FloatArray


@internal
def _begin(
    q: FloatArray, chi2: float, rise: float, toward: float, step: float, state: FloatArray, u: FloatArray
) -> None:
    """Search for the angle α where the profile has risen by `rise`: inward, where α rises, or outward.

    The angle α = atan2(s, |u|) is π/2 at the centroid, 0 at infinity, and negative beyond it on the other side.
    """
    norm = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2])
    sign = -1.0 if q[3] < 0.0 else 1.0
    for d in range(3):
        u[d] = sign * q[d] / norm
    alpha = math.atan2(abs(q[3]), norm)
    state[_OPTIMUM], state[_CHI2], state[_RISE], state[_TOWARD] = alpha, chi2, rise, toward
    state[_INSIDE], state[_F_INSIDE], state[_OUTSIDE], state[_F_OUTSIDE] = alpha, -rise, math.nan, math.nan
    state[_LAST_STEP] = step
    state[_TRIED] = _within_bound(alpha + toward * step, toward)


@internal
def _within_bound(alpha: float, toward: float) -> float:
    bound = toward * (0.5 * math.pi - SMALLEST_S)
    return bound if toward * (alpha - bound) > 0.0 else alpha


@internal
def _next(state: FloatArray, chi2: float) -> tuple[bool, bool]:
    """Whether a search has ended at the α that it tried, and whether that is within the rise; else the next α to try.

    The profile is nearly a parabola in α: its square root is inter- and extrapolated, with bisection as a guard. Where
    it never rises so much the end is π/2, or -π/2 outward.
    """
    rise, toward, tried = state[_RISE], state[_TOWARD], state[_TRIED]
    f = chi2 - state[_CHI2] - rise
    within = not f > 0.0
    if abs(f) < _SAME_RISE:
        return True, within
    if within:
        state[_INSIDE], state[_F_INSIDE] = tried, max(f, -rise)
    else:
        state[_OUTSIDE], state[_F_OUTSIDE] = tried, f
    inside, outside = state[_INSIDE], state[_OUTSIDE]
    if math.isnan(outside):
        if tried == toward * (0.5 * math.pi - SMALLEST_S):
            state[_TRIED] = toward * 0.5 * math.pi
            return True, within
        reached = abs(tried - state[_OPTIMUM])
        left = 1.05 * reached * (math.sqrt(rise / max(f + rise, 1e-3 * rise)) - 1.0)
        last = state[_LAST_STEP]
        step = min(max(left, 0.1 * last), 1.7 * last, LARGEST_PROFILE_STEP)
        state[_LAST_STEP] = step
        state[_TRIED] = _within_bound(inside + toward * step, toward)
        return False, within
    if abs(outside - inside) < 1e-4 * min(abs(inside), abs(outside)):
        return True, within
    a, b = math.sqrt(max(state[_F_INSIDE] + rise, 0.0)), math.sqrt(state[_F_OUTSIDE] + rise)
    t = (math.sqrt(rise) - a) / (b - a) if b > a else 0.5
    state[_TRIED] = inside + min(max(t, 0.05), 0.95) * (outside - inside)
    return False, within


@internal
def _place(direction: FloatArray, alpha: float, q: FloatArray) -> None:
    """Homogeneous coordinates at an α, but not at infinity."""
    if abs(alpha) < SMALLEST_S:
        alpha = math.copysign(SMALLEST_S, alpha)
    for d in range(3):
        q[d] = direction[d] * math.cos(alpha)
    q[3] = math.sin(alpha)


@internal
def _gaussian_step(q: FloatArray, covariance: FloatArray, rise: float) -> float:
    """Step in α where a Gaussian profile would rise by `rise`: dα = dρ / (1 + ρ²)."""
    rho2 = (q[0] * q[0] + q[1] * q[1] + q[2] * q[2]) / (q[3] * q[3])
    variance = 0.0
    for i in range(3):
        for j in range(3):
            variance += q[i] * covariance[i, j] * q[j] / (q[3] * q[3])
    sigma = math.sqrt(max(variance, 0.0) / max(rho2, 1e-300))
    step = math.sqrt(rise) * sigma / (1.0 + rho2)
    return min(max(step, 1e-9), LARGEST_PROFILE_STEP) if math.isfinite(step) else 0.05


@internal
def profile_rows(
    begin: int,
    end: int,
    signal: FloatArray,
    rise: FloatArray,
    model: LaneModel,
    fits: FlatFits,
    covariance: FloatArray,
    out_alpha: FloatArray,
) -> None:
    """Ends of the profiles of the fits of rows begin to end, into (f, 2).

    rise (rows,) is how far they may rise above the χ² of a row's first fit. The least and the largest α of every fit
    are left as they are where its own χ² is higher than that, or where rise is infinite: then nothing bounds the range.
    The scaled covariances serve for the first steps.
    """
    n = 2 * (fits.first[end] - fits.first[begin])
    state, direction, place = np.empty((n, _COLUMNS)), np.empty((n, 3)), np.empty((n, 3), np.intp)
    n = 0
    for row in range(begin, end):
        for k in range(fits.first[row], fits.first[row + 1]):
            left = rise[row] - (fits.chi2[k] - fits.chi2[fits.first[row]])
            if not (left > 0.0 and math.isfinite(left)):
                continue
            step = _gaussian_step(fits.q[k], covariance[k], left)
            for side in range(2):
                _begin(fits.q[k], fits.chi2[k], left, 2.0 * side - 1.0, step, state[n], direction[n])
                place[n, 0], place[n, 1], place[n, 2] = row, k, side
                n += 1
    live, n_live = np.arange(n), n
    starts, reading = np.empty((n, 4)), np.empty(n, np.intp)
    ends = Refined(
        np.empty((n, 4)), np.empty((n, 3)), np.empty(n), np.empty(n, np.intp), np.empty(n, np.bool_)
    )  # fmt: skip
    rules = Rules(PROFILE_TOLERANCE, 30.0, np.full(n, math.inf), True)
    for _ in range(_MOST_STEPS):
        if n_live == 0:
            break
        for i in range(n_live):
            k = live[i]
            reading[i] = place[k, 0]
            _place(direction[k], state[k, _TRIED], starts[i])
        refine(signal, reading[:n_live], starts[:n_live], model, 0.0, rules, ends)
        n_before, n_live = n_live, 0
        for i in range(n_before):
            k = live[i]
            ended, within = _next(state[k], ends.chi2[i])
            if ended:
                out_alpha[place[k, 1], place[k, 2]] = state[k, _TRIED]
                continue
            if within:
                put(direction[k], ends.q[i, :3])
                norm = math.sqrt(1.0 - ends.q[i, 3] * ends.q[i, 3])
                for d in range(3):
                    direction[k, d] /= norm
            live[n_live] = k
            n_live += 1
    for i in range(n_live):
        k = live[i]
        out_alpha[place[k, 1], place[k, 2]] = state[k, _INSIDE]
