r"""Set of ranges that one row of readings allows.

In the 95 % set the profile of χ² over the range, all solutions together, is within a limit above its minimum. The
coordinate of the range is the angle :math:`\alpha = \mathrm{atan2}(s, |u|)` of homogeneous coordinates: π/2 at the
sensors' centroid, 0 at infinity, and negative beyond it. The limit is 3.84 for a strong signal with one solution. It is
larger for several solutions, and for weak signals that are detected: docs/theory/range-interval.md.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import chndtr, erfc

from arrays.typing import FloatArray
from magloc.chi_square import energy_threshold
from magloc.levels import DELTA_CHI2_95

# Standard deviations above the root of the threshold at which signals are always detected.
_CERTAIN = 8.0
_N_STRENGTHS = 1200
OUTSIDE = 0.05
"""Probability of ranges outside a set."""
_N_BISECTIONS = 24


def is_detected(energy: ArrayLike, n_differences: int) -> NDArray[np.bool_]:
    """Return whether an energy is significant: noise alone exceeds the threshold in one of a thousand rows."""
    return np.asarray(np.asarray(energy) > energy_threshold(n_differences))


def rise(energy: ArrayLike, chi2: ArrayLike, n_differences: int, level: ArrayLike = DELTA_CHI2_95) -> FloatArray:
    """Return the rise of the χ² profile over the best solution within the set of ranges.

    It is the level of :func:`levels` for strong signals, larger for weak ones, and infinite without a detection.
    """
    of_energy, wanted_rise = np.asarray(energy, dtype=np.float64), np.asarray(level, dtype=np.float64)
    explained = np.maximum(of_energy - np.asarray(chi2, dtype=np.float64), 0.0)
    strength, left = detection_statistic(n_differences)
    best = np.sqrt(explained)
    wanted = np.asarray(np.interp(best, strength, left)) + wanted_rise
    # The table decreases; reversed it gives the strength for a value.
    weakest = np.interp(wanted, left[::-1], strength[::-1])
    raised = explained - weakest * weakest
    raised = np.where(best > strength[-1], wanted_rise, np.maximum(raised, wanted_rise))
    return np.where(is_detected(of_energy, n_differences), raised, np.inf)


@lru_cache(maxsize=64)
def detection_statistic(n_differences: int) -> tuple[FloatArray, FloatArray]:
    """Return strengths a, and the statistic D(a) of docs/theory/range-interval.md.

    D decreases strictly, except for ties at the weakest signals.
    """
    threshold = energy_threshold(n_differences)
    largest = np.sqrt(threshold) + _CERTAIN
    strength = np.linspace(0.0, largest, _N_STRENGTHS)
    seen = 1.0 - chndtr(threshold, n_differences, strength**2)
    left = np.min(strength**2 - 2.0 * strength[:, None] * strength + 2.0 * np.log(seen), axis=1)
    return strength, np.minimum.accumulate(left)


def levels(chi2: FloatArray, weight: FloatArray) -> FloatArray:
    """Return the rise (b,) over the best of solutions (b, n) for 95 % of all; 3.84 for one."""
    result = np.full(len(chi2), DELTA_CHI2_95)
    several = np.flatnonzero((weight > 0.0).sum(axis=1) > 1)
    if not several.size:
        return result
    above, share = chi2[several] - chi2[several].min(axis=1, keepdims=True), weight[several]
    above = np.where(share > 0.0, above, 0.0)
    low, high = np.full(several.size, DELTA_CHI2_95), DELTA_CHI2_95 + above.max(axis=1, initial=0.0)
    for _ in range(_N_BISECTIONS):
        middle = 0.5 * (low + high)
        # P(χ²_1 > x) = erfc(√(x/2)).
        outside = np.sum(share * erfc(np.sqrt(0.5 * np.maximum(middle[:, None] - above, 0.0))), axis=1)
        too_low = outside > OUTSIDE
        low, high = np.where(too_low, middle, low), np.where(too_low, high, middle)
    result[several] = high
    return result


def ranges_of(alpha: FloatArray, unit_m: float = 1.0) -> FloatArray:
    """Return ranges (..., 2) [m] of stretches (..., 2) of α.

    A stretch through infinity has two sides.
    """
    first, last = alpha[..., 0], alpha[..., 1]
    with np.errstate(invalid="ignore", divide="ignore"):
        nearest = np.where(np.maximum(last, -first) < 0.5 * np.pi, 1.0 / np.tan(np.maximum(last, -first)), 0.0)
        farthest = np.where(first > 0.0, 1.0 / np.tan(first), np.inf)
    ends: FloatArray = unit_m * np.stack([np.where(np.isnan(first), np.nan, nearest), farthest], axis=-1)
    ends[np.isnan(alpha).any(axis=-1)] = np.nan
    return ends


def gaussian_ranges(covariance: FloatArray, offset_m: FloatArray, unit_m: float) -> FloatArray:
    """Return 95 % intervals (..., 2) [m] of the range from a covariance, symmetric in α.

    The covariance begins with the position. χ² is nearly a parabola in α, but not in the range. For far sources the
    interval is therefore open, to 0 or infinity.
    """
    alpha = np.arctan2(unit_m, np.linalg.norm(offset_m, axis=-1))
    sigma = np.sin(alpha) * np.cos(alpha) * relative_range_sigma(covariance, offset_m)
    reach = math.sqrt(DELTA_CHI2_95) * np.where(np.isfinite(sigma), sigma, np.inf)
    first, last = np.maximum(alpha - reach, -0.5 * np.pi), np.minimum(alpha + reach, 0.5 * np.pi)
    return ranges_of(np.stack([first, last], axis=-1), unit_m)


def union(ends: FloatArray) -> FloatArray:
    """Return disjoint ascending intervals (b, i, 2) of pairs (b, n, 2); NaN for none."""
    n_rows, n = ends.shape[:2]
    each = np.arange(n_rows)[:, None]
    low, high = ends[each, np.argsort(ends[..., 0], axis=1)].transpose(2, 0, 1)
    reach = np.maximum.accumulate(np.where(np.isnan(low), -np.inf, high), axis=1)
    begins = ~np.isnan(low)
    begins[:, 1:] &= low[:, 1:] > reach[:, :-1]
    place = np.cumsum(begins, axis=1) - 1
    merged = np.full((n_rows, max(1, int(place.max(initial=0)) + 1), 2), np.nan)
    for k in range(n):
        row = np.flatnonzero(begins[:, k])
        merged[row, place[row, k], 0] = low[row, k]
        row = np.flatnonzero(~np.isnan(low[:, k]))
        merged[row, place[row, k], 1] = reach[row, k]
    return merged


def relative_range_sigma(covariance: FloatArray, offset_m: FloatArray) -> FloatArray:
    """Return the relative σ (...) of the range from covariances (..., n, n) and offsets (..., 3)."""
    with np.errstate(invalid="ignore", divide="ignore"):
        variance = np.einsum("...i,...ij,...j->...", offset_m, covariance[..., :3, :3], offset_m)
        sigma: FloatArray = np.sqrt(variance) / np.sum(offset_m * offset_m, axis=-1)
    return sigma
