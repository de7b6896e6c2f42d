r"""What one row of readings says of the range: the set of ranges that it allows.

The set of 95 % has every range at which some source, of whatever direction and moment, fits the readings almost as well
as the best one does: the profile of χ² over the range, all solutions together, is within a rise of its least value. It
is followed as the angle :math:`\alpha = \mathrm{atan2}(s, |u|)` of homogeneous coordinates
(:mod:`magloc.measurement.whitened`): π/2 at the sensors' centroid, 0 at infinity, and negative beyond it, on the other
side. The rise is 3.84, the 95 % quantile of :math:`\chi^2_1`, where the signal is strong and has one solution. Two
things raise it.

Several solutions. A far source has a mirror image in another direction that fits as well, and each of the two has noise
of its own: the better one is often the wrong one. The rise c is such that the set holds 95 % of all solutions together,
each with its weight w (:mod:`magloc.localization.uncertainty.ambiguity`) and its :math:`\Delta\chi^2` above the best
one, :func:`levels`,

.. math:: \sum_i w_i \, P(\chi^2_1 > c - \Delta\chi^2_i) = 0.05.

Weak signals. A set is only given where something is detected, that is where the energy of the whitened differences
:math:`E = |y|^2` exceeds a threshold T. Of the sources near the limit only those are seen which noise makes look
stronger than they are, so that the likelihood of readings that are seen is that of all readings over the probability
:math:`P(E > T)` to see them at all,

.. math:: -2 \log L(h) = |y - h|^2 + 2 \log P(\chi'^2_k(|h|^2) > T),

with the k predicted differences h. Whatever their pattern, h may be of any strength: with the energy
:math:`C = E - \chi^2` that the best fit of a pattern explains, the best strength leaves

.. math:: E + D(\sqrt C), \qquad D(a) = \min_l [l^2 - 2 a l + 2 \log P(\chi'^2_k(l^2) > T)],

which falls with C: the best fit at every range stays the best one, and only the scale of χ² changes. :func:`rise` is by
how much χ² rises while D rises by c.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import chndtr, erfc

from arrays.typing import FloatArray
from magloc.chi_square import energy_threshold
from magloc.levels import DELTA_CHI2_95
from magloc.localization.fit.results import Intervals

# Signals so many standard deviations above the root of the threshold are seen for certain.
_CERTAIN = 8.0
_N_STRENGTHS = 1200
_OUTSIDE = 0.05
_N_BISECTIONS = 24


def is_detected(energy: ArrayLike, n_differences: int) -> NDArray[np.bool_]:
    """Whether readings stand out of noise, which alone makes them do so in one of a thousand rows.

    Parameters
    ----------
    energy : array_like, shape (...)
        Sums of squared whitened differences, as they are without a source.
    n_differences : int

    Returns
    -------
    ndarray of bool, shape (...)
    """
    return np.asarray(np.asarray(energy) > energy_threshold(n_differences))


def rise(energy: ArrayLike, chi2: ArrayLike, n_differences: int, level: ArrayLike = DELTA_CHI2_95) -> FloatArray:
    """By how much the profile of χ² may rise above the best solution's within the set of ranges.

    Parameters
    ----------
    energy : array_like, shape (...)
        Sums of squared whitened differences, as they are without a source.
    chi2 : array_like, shape (...)
        Of the best solutions.
    n_differences : int
    level : array_like, shape (...)
        Rise of -2 log L, as of :func:`levels`.

    Returns
    -------
    ndarray, shape (...)
        The level for strong signals, more for weak ones; infinite where nothing is detected.
    """
    of_energy, wanted_rise = np.asarray(energy, dtype=np.float64), np.asarray(level, dtype=np.float64)
    explained = np.maximum(of_energy - np.asarray(chi2, dtype=np.float64), 0.0)
    strength, left = _left_of_detected(n_differences)
    best = np.sqrt(explained)
    wanted = np.asarray(np.interp(best, strength, left)) + wanted_rise
    # The table falls: turned round it gives the strength that leaves so much.
    weakest = np.interp(wanted, left[::-1], strength[::-1])
    raised = explained - weakest * weakest
    raised = np.where(best > strength[-1], wanted_rise, np.maximum(raised, wanted_rise))
    result: FloatArray = np.where(is_detected(of_energy, n_differences), raised, np.inf)
    return result


@lru_cache(maxsize=64)
def _left_of_detected(n_differences: int) -> tuple[FloatArray, FloatArray]:
    """Strengths a, and D(a) of the module's docstring: it falls strictly, but for ties at the weakest."""
    threshold = energy_threshold(n_differences)
    largest = np.sqrt(threshold) + _CERTAIN
    strength = np.linspace(0.0, largest, _N_STRENGTHS)
    seen = 1.0 - chndtr(threshold, n_differences, strength**2)
    left = np.min(strength**2 - 2.0 * strength[:, None] * strength + 2.0 * np.log(seen), axis=1)
    return strength, np.minimum.accumulate(left)


def levels(chi2: FloatArray, weight: FloatArray) -> FloatArray:
    """Rise above the best of several solutions within which 95 % of all of them are, each having one of its own range.

    Parameters
    ----------
    chi2 : ndarray, shape (b, n)
        Infinite where there is no solution.
    weight : ndarray, shape (b, n)
        They add up to one.

    Returns
    -------
    ndarray, shape (b,)
        3.84 with one solution, more with several ones.
    """
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
        too_low = outside > _OUTSIDE
        low, high = np.where(too_low, middle, low), np.where(too_low, high, middle)
    result[several] = high
    return result


def ranges_of(alpha: FloatArray, unit_m: float = 1.0) -> FloatArray:
    """Ranges (..., 2) that stretches (..., 2) of α cover, least and largest: a stretch through infinity has two sides.

    Parameters
    ----------
    alpha : ndarray, shape (..., 2)
        Least and largest α, between -π/2 and π/2.
    unit_m : float
        Circumradius of the sensors [m].

    Returns
    -------
    ndarray, shape (..., 2)
        [m]; infinite where a stretch reaches infinity.
    """
    first, last = alpha[..., 0], alpha[..., 1]
    with np.errstate(invalid="ignore", divide="ignore"):
        nearest = np.where(np.maximum(last, -first) < 0.5 * np.pi, 1.0 / np.tan(np.maximum(last, -first)), 0.0)
        farthest = np.where(first > 0.0, 1.0 / np.tan(first), np.inf)
    ends: FloatArray = unit_m * np.stack([np.where(np.isnan(first), np.nan, nearest), farthest], axis=-1)
    ends[np.isnan(alpha).any(axis=-1)] = np.nan
    return ends


def gaussian_ranges(covariance: FloatArray, offset_m: FloatArray, unit_m: float) -> FloatArray:
    """95 % intervals (..., 2) of the range from a Gaussian of the position, symmetric in α.

    χ² is nearly a parabola in α and not at all one in the range: so does the interval open where the source is far.

    Parameters
    ----------
    covariance : ndarray, shape (..., n, n)
        Of the position, or of a state that begins with it [m²].
    offset_m : ndarray, shape (..., 3)
        Of the source from the sensors' centroid [m].
    unit_m : float
        Circumradius of the sensors [m].

    Returns
    -------
    ndarray, shape (..., 2)
        [m]; 0 and infinity where it is open.
    """
    alpha = np.arctan2(unit_m, np.linalg.norm(offset_m, axis=-1))
    sigma = np.sin(alpha) * np.cos(alpha) * relative_range_sigma(covariance, offset_m)
    reach = math.sqrt(DELTA_CHI2_95) * np.where(np.isfinite(sigma), sigma, np.inf)
    first, last = np.maximum(alpha - reach, -0.5 * np.pi), np.minimum(alpha + reach, 0.5 * np.pi)
    return ranges_of(np.stack([first, last], axis=-1), unit_m)


def union(ends: Sequence[Sequence[float]]) -> Intervals:
    """Disjoint intervals in ascending order, from pairs of ends that may overlap.

    Parameters
    ----------
    ends : sequence of (low, high)
        NaN for none, infinite for an open end.

    Returns
    -------
    tuple of (low, high)
        high is None where it is open.
    """
    merged: list[list[float]] = []
    for low, high in sorted([low, high] for low, high in ends if low == low):
        if merged and low <= merged[-1][1]:
            merged[-1][1] = max(merged[-1][1], high)
        else:
            merged.append([low, high])
    return tuple((low, high if high < np.inf else None) for low, high in merged)


def relative_range_sigma(covariance: FloatArray, offset_m: FloatArray) -> FloatArray:
    """Standard deviation of the range over the range, (...): of covariances (..., n, n) and offsets (..., 3)."""
    with np.errstate(invalid="ignore", divide="ignore"):
        variance = np.einsum("...i,...ij,...j->...", offset_m, covariance[..., :3, :3], offset_m)
        sigma: FloatArray = np.sqrt(variance) / np.sum(offset_m * offset_m, axis=-1)
    return sigma
