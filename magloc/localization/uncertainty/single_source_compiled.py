"""Compiled uncertainty of the optima of one dipole: covariances, weights, ranges, and whether errors are Gaussian.

The readable twin is :func:`magloc.localization.uncertainty.covariance.known_of_one`, with
:class:`magloc.localization.uncertainty.ambiguity.Rivals`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from arrays.typing import BoolArray, FloatArray
from magloc.compilation import compiled, internal
from magloc.levels import CERTAIN_WEIGHT, DELTA_CHI2_95
from magloc.localization.uncertainty.ambiguity import LARGEST_BEND, LARGEST_GAUSSIAN_SIGMA
from magloc.localization.uncertainty.covariance_compiled import covariance_and_volume
from magloc.localization.uncertainty.range_profile_compiled import FlatFits, profile_rows
from magloc.measurement.whitened_compiled import LaneModel, ModelRow, ModelRows, Units, row_at, unit_basis

_N_BISECTIONS = 24
_N_SQUARINGS = 10
_OUTSIDE = 0.05


class Levels(NamedTuple):
    """Energy that is detected, χ² of a misfit, degrees of freedom, and the table of weak signals, both ascending.

    That of :func:`magloc.localization.uncertainty.range_interval.rise`: strengths a and -D(a).
    """

    detected: float
    misfit: float
    dof: float
    strength: FloatArray
    gained: FloatArray


class Certainties(NamedTuple):
    """Outputs: columns of :class:`magloc.localization.fit.columns.Solutions`.

    Covariances are NaN where singular. There is room for as many ranges as the row of most fits has of these.
    """

    position_m: FloatArray
    moment_Am2: FloatArray
    covariance: FloatArray
    weight: FloatArray
    gaussian: BoolArray
    ranges: FloatArray

    @classmethod
    def empty(cls, n_fits: int, most: int) -> Certainties:
        """Places for them."""
        position, moment, covariance = np.empty((n_fits, 1, 3)), np.empty((n_fits, 1, 3)), np.empty((n_fits, 6, 6))
        gaussian, ranges = np.empty((n_fits, 1), dtype=np.bool_), np.empty((n_fits, 1, most, 2))
        return cls(position, moment, covariance, np.empty(n_fits), gaussian, ranges)


@compiled
def certainty_rows(
    begin: int,
    end: int,
    fits: FlatFits,
    energy: FloatArray,
    y: FloatArray,
    signal: FloatArray,
    rows: ModelRows,
    model: LaneModel,
    units: Units,
    levels: Levels,
    out: Certainties,
) -> None:
    """What is known of the fits of rows begin to end."""
    n_fits = fits.first[end] - fits.first[begin]
    rise, understated = np.empty(end), np.empty(end)
    alpha, weighed = np.empty((fits.first[end], 2)), np.empty(n_fits)
    alpha[:] = math.nan
    for row in range(begin, end):
        first, last = fits.first[row], fits.first[row + 1]
        chi2 = fits.chi2[first] if last > first else 0.0
        understated[row] = chi2 / max(levels.dof, 1.0) if math.isfinite(chi2) and chi2 > levels.misfit else 1.0
        of_row = row_at(rows, row)
        for k in range(first, last):
            log_volume = covariance_and_volume(fits.q[k], fits.mu[k], of_row, understated[row], out.covariance[k])
            weighed[k - fits.first[begin]] = log_volume
        n = fits.first[begin]
        level = _weigh(fits.chi2[first:last], weighed[first - n : last - n], understated[row], out.weight[first:last])
        of_energy = energy[row] / understated[row]
        rise[row] = understated[row] * _rise(of_energy, chi2 / understated[row], level, levels)
    profile_rows(begin, end, signal, rise, model, fits, out.covariance, alpha)
    sets = np.empty(out.ranges.shape[2:])
    for row in range(begin, end):
        sets[:] = math.nan
        n_sets = _unite(alpha[fits.first[row] : fits.first[row + 1]], rise[row], sets)
        low, high = sets[0, 0], sets[max(n_sets, 1) - 1, 1]
        observable = low > 0.0 and high <= 2.0 * low
        of_row = row_at(rows, row)
        for k in range(fits.first[row], fits.first[row + 1]):
            covariance, q, gaussian = out.covariance[k], fits.q[k], False
            if not observable:
                _widen(q, low, high, covariance)
            elif n_sets == 1 and out.weight[k] >= CERTAIN_WEIGHT and fits.chi2[k] <= levels.misfit:
                gaussian = _is_gaussian(q, fits.mu[k], fits.chi2[k], covariance, y[row], of_row)
            out.gaussian[k, 0] = gaussian
            for i in range(len(sets)):
                out.ranges[k, 0, i, 0], out.ranges[k, 0, i, 1] = units.radius * sets[i, 0], units.radius * sets[i, 1]
            _in_units(q, fits.mu[k], units, out.position_m[k, 0], out.moment_Am2[k, 0], covariance)


@internal
def _in_units(
    q: FloatArray, mu: FloatArray, units: Units, position: FloatArray, moment: FloatArray, covariance: FloatArray
) -> None:
    """Position and moment of a fit, and its covariance."""
    unit = np.empty(6)
    for d in range(3):
        unit[d], unit[3 + d] = units.radius, units.moment
        position[d] = units.centroid[d] + units.radius * q[d] / q[3]
        moment[d] = units.moment * mu[d] / abs(q[3]) ** 3
    for i in range(6):
        for j in range(6):
            covariance[i, j] *= unit[i] * unit[j]


@internal
def _weigh(chi2: FloatArray, log_volume: FloatArray, understated: float, weight: FloatArray) -> float:
    """Weights of solutions, and the rise above the best one within which 95 % of all of them are."""
    best, lowest, total, several = -math.inf, math.inf, 0.0, 0
    for k in range(len(chi2)):
        if math.isfinite(log_volume[k]):
            best = max(best, log_volume[k] - 0.5 * chi2[k] / understated)
            lowest = min(lowest, chi2[k])
    for k in range(len(chi2)):
        value = log_volume[k] - 0.5 * chi2[k] / understated - best
        weight[k] = math.exp(value) if math.isfinite(log_volume[k]) else 0.0
        total += weight[k]
        several += weight[k] > 0.0
    for k in range(len(chi2)):
        weight[k] /= max(total, 1e-300)
    if several < 2:
        return DELTA_CHI2_95
    low = high = DELTA_CHI2_95
    for k in range(len(chi2)):
        if weight[k] > 0.0:
            high = max(high, DELTA_CHI2_95 + (chi2[k] - lowest) / understated)
    for _ in range(_N_BISECTIONS):
        middle, outside = 0.5 * (low + high), 0.0
        for k in range(len(chi2)):
            if weight[k] > 0.0:
                above = (chi2[k] - lowest) / understated
                outside += weight[k] * math.erfc(math.sqrt(0.5 * max(middle - above, 0.0)))
        if outside > _OUTSIDE:
            low = middle
        else:
            high = middle
    return high


@internal
def _interpolated(x: float, xs: FloatArray, ys: FloatArray) -> float:
    """Value at x of ys at xs that ascend; beyond their ends as at these."""
    low, high = 0, len(xs) - 1
    if not x > xs[low]:
        return ys[low]
    if x >= xs[high]:
        return ys[high]
    while high - low > 1:
        middle = (low + high) // 2
        if xs[middle] <= x:
            low = middle
        else:
            high = middle
    return ys[low] + (x - xs[low]) / (xs[high] - xs[low]) * (ys[high] - ys[low])


@internal
def _rise(energy: float, chi2: float, level: float, levels: Levels) -> float:
    """:func:`magloc.localization.uncertainty.range_interval.rise` of one row."""
    if not energy > levels.detected:
        return math.inf
    explained = max(energy - chi2, 0.0)
    strength = math.sqrt(explained)
    if strength > levels.strength[-1]:
        return level
    gained = _interpolated(strength, levels.strength, levels.gained) - level
    weakest = _interpolated(gained, levels.gained, levels.strength)
    return max(explained - weakest * weakest, level)


@internal
def _unite(alpha: FloatArray, rise: float, sets: FloatArray) -> int:
    """Disjoint ascending ranges, in radii, that stretches (n, 2) of α cover; everything where nothing bounds them.

    Put out is how many there are.
    """
    if not math.isfinite(rise):
        if len(alpha):
            sets[0, 0], sets[0, 1] = 0.0, math.inf
        return min(len(alpha), 1)
    n = 0
    for k in range(len(alpha)):
        first, last = alpha[k, 0], alpha[k, 1]
        if math.isnan(first) or math.isnan(last):
            continue
        nearest = max(last, -first)
        low = 1.0 / math.tan(nearest) if nearest < 0.5 * math.pi else 0.0
        high = 1.0 / math.tan(first) if first > 0.0 else math.inf
        place = n
        while place > 0 and sets[place - 1, 0] > low:
            sets[place, 0], sets[place, 1] = sets[place - 1, 0], sets[place - 1, 1]
            place -= 1
        sets[place, 0], sets[place, 1] = low, high
        n += 1
    kept = 0
    for k in range(n):
        low, high = sets[k, 0], sets[k, 1]
        if kept > 0 and low <= sets[kept - 1, 1]:
            sets[kept - 1, 1] = max(sets[kept - 1, 1], high)
        else:
            sets[kept, 0], sets[kept, 1] = low, high
            kept += 1
    for k in range(kept, n):
        sets[k, 0] = sets[k, 1] = math.nan
    return kept


@internal
def _widen(q: FloatArray, low: float, high: float, covariance: FloatArray) -> None:
    """:func:`magloc.localization.uncertainty.ambiguity.widened` of one covariance."""
    size = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2])
    distance = size / abs(q[3])
    sign = math.copysign(1.0, q[3]) / size
    following, variance = np.empty(6), 0.0
    for i in range(6):
        following[i] = sign * (covariance[i, 0] * q[0] + covariance[i, 1] * q[1] + covariance[i, 2] * q[2])
        variance += following[i] * sign * q[i] if i < 3 else 0.0
    farther = max(distance - low, high - distance) / math.sqrt(DELTA_CHI2_95)
    wanted = farther if math.isfinite(farther) else distance
    missing = max(wanted * wanted - variance, 0.0) / (variance * variance)
    if not math.isfinite(missing):
        return
    for i in range(6):
        for j in range(6):
            covariance[i, j] += missing * following[i] * following[j]


@internal
def _is_gaussian(
    q: FloatArray, mu: FloatArray, chi2: float, covariance: FloatArray, y: FloatArray, row: ModelRow
) -> bool:
    """Whether χ² is nearly a parabola over the ellipsoid of one σ, and that is small.

    :func:`magloc.localization.uncertainty.covariance.covariance_is_valid`. Powers of the matrix in units of range and
    moment turn all of its columns to its longest axis.
    """
    state, unit = np.empty(6), np.empty(6)
    for d in range(3):
        state[d], state[3 + d] = q[d] / q[3], mu[d] / abs(q[3]) ** 3
    for half in range(0, 6, 3):
        size2 = state[half] * state[half] + state[half + 1] * state[half + 1] + state[half + 2] * state[half + 2]
        unit[half] = unit[half + 1] = unit[half + 2] = math.sqrt(size2)
        variance = covariance[half, half] + covariance[half + 1, half + 1] + covariance[half + 2, half + 2]
        if not math.sqrt(variance) <= LARGEST_GAUSSIAN_SIGMA * unit[half]:
            return False
    power, square, largest = np.empty((6, 6)), np.empty((6, 6)), 0
    for i in range(6):
        for j in range(6):
            power[i, j] = covariance[i, j] / (unit[i] * unit[j])
    for _ in range(_N_SQUARINGS):
        trace = 0.0
        for i in range(6):
            trace += power[i, i]
        scale = 1.0 / (trace * trace)
        for i in range(6):
            for j in range(i, 6):
                t = 0.0
                for k in range(6):
                    t += power[i, k] * power[j, k]
                square[i, j] = square[j, i] = t * scale
        power, square = square, power
    for i in range(6):
        largest = i if power[i, i] > power[largest, largest] else largest
    norm2 = variance = 0.0
    for i in range(6):
        norm2 += power[i, largest] * power[i, largest]
        for j in range(6):
            variance += power[i, largest] * covariance[i, j] / (unit[i] * unit[j]) * power[j, largest]
    rho, basis = np.empty(4), np.empty((3, len(y)))
    rho[3] = 1.0
    for side in range(-1, 2, 2):
        step = side * math.sqrt(variance) / norm2
        for d in range(3):
            rho[d] = state[d] + step * unit[d] * power[d, largest]
        unit_basis(rho, row, basis)
        risen = -chi2
        for c in range(len(y)):
            left = y[c]
            for d in range(3):
                left -= (state[3 + d] + step * unit[3 + d] * power[3 + d, largest]) * basis[d, c]
            risen += left * left
        if not abs(risen - 1.0) <= LARGEST_BEND:
            return False
    return True
