"""Compiled profiles of χ² over the range.

The readable twin is :mod:`magloc.localization.uncertainty.range_profile`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from arrays.typing import FloatArray
from magloc.compilation import compiled, runtime_int
from magloc.linalg_compiled import put
from magloc.localization.fit.variable_projection_compiled import refine
from magloc.measurement.whitened_compiled import SMALLEST_S, ModelRow, ModelRows, row_at

# The same for the profile over the range, which is read at a rise of 3.84 to 0.01.
PROFILE_TOLERANCE = 1e-3
# No step of the profile is longer, in α: it would leap over what is between.
LARGEST_PROFILE_STEP = 0.2


@compiled
def _profile_end(
    q: FloatArray,
    chi2: float,
    rise: float,
    outward: bool,
    first_step: float,
    y: FloatArray,
    row: ModelRow,
) -> float:
    """Angle α where the profile χ² has risen by `rise`; π/2 inward or -π/2 outward where it never does.

    The angle α = atan2(s, |u|) is the coordinate: π/2 at the centroid, 0 at infinity, negative beyond it on the other
    side. The direction is re-optimised at every step, starting from the step before.
    """
    mu = np.empty(3)
    norm = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2])
    best, trial = np.empty(3), np.empty(3)
    for d in range(3):
        best[d] = q[d] / norm
    alpha = math.atan2(abs(q[3]), norm)
    if q[3] < 0.0:
        for d in range(3):
            best[d] = -best[d]
    toward = -1.0 if outward else 1.0
    bound = toward * (0.5 * math.pi - SMALLEST_S)
    inside, f_inside = alpha, -rise
    step = first_step
    outside, f_outside = alpha, 0.0
    found = False
    for _ in range(60):
        outside = inside + toward * step
        if toward * (outside - bound) > 0.0:
            outside = bound
        f_outside = _profile(best, trial, outside, y, row, mu) - chi2 - rise
        if f_outside > 0.0:
            found = True
            break
        if outside == bound:
            break
        put(best, trial)
        inside, f_inside = outside, f_outside
        step = min(1.7 * step, LARGEST_PROFILE_STEP)
    if not found:
        return toward * 0.5 * math.pi
    for _ in range(40):
        # The profile is nearly a parabola in α: interpolate its square root, with bisection as a guard.
        a, b = math.sqrt(max(f_inside + rise, 0.0)), math.sqrt(f_outside + rise)
        t = (math.sqrt(rise) - a) / (b - a) if b > a else 0.5
        t = min(max(t, 0.05), 0.95)
        middle = inside + t * (outside - inside)
        f = _profile(best, trial, middle, y, row, mu) - chi2 - rise
        if abs(f) < 0.01 or abs(outside - inside) < 1e-4 * min(abs(inside), abs(outside)):
            return middle
        if f > 0.0:
            outside, f_outside = middle, f
        else:
            inside, f_inside = middle, max(f, -rise)
            put(best, trial)
    return inside


@compiled
def _profile(
    direction: FloatArray,
    trial: FloatArray,
    alpha: float,
    y: FloatArray,
    row: ModelRow,
    mu: FloatArray,
) -> float:
    """Smallest χ² at one α, searched from a direction; trial becomes the best direction (unit u)."""
    if abs(alpha) < SMALLEST_S:
        alpha = math.copysign(SMALLEST_S, alpha)
    q = np.empty(4)
    for d in range(3):
        q[d] = direction[d] * math.cos(alpha)
    q[3] = math.sin(alpha)
    chi2, _, _ = refine(
        q, y, row, runtime_int(2), PROFILE_TOLERANCE, runtime_int(30), q.reshape(1, 4), mu, runtime_int(0), mu
    )  # fmt: skip
    for d in range(3):
        trial[d] = q[d] / math.cos(alpha)
    return chi2


@compiled
def _gaussian_step(q: FloatArray, covariance: FloatArray, rise: float) -> float:
    """Step in α where a Gaussian profile would rise by `rise`: dα = dρ / (1 + ρ²)."""
    rho = np.empty(3)
    rho2 = 0.0
    for d in range(3):
        rho[d] = q[d] / q[3]
        rho2 += rho[d] * rho[d]
    variance = 0.0
    for i in range(3):
        for j in range(3):
            variance += rho[i] * covariance[i, j] * rho[j]
    sigma = math.sqrt(max(variance, 0.0) / max(rho2, 1e-300))
    return min(max(math.sqrt(rise) * sigma / (1.0 + rho2), 1e-9), 0.2)


@compiled
def profile_rows(
    begin: int,
    end: int,
    y: FloatArray,
    rise: FloatArray,
    rows: ModelRows,
    q: FloatArray,
    chi2: FloatArray,
    counts: NDArray[np.int64],
    covariance: FloatArray,
    out_alpha: FloatArray,
) -> None:
    """Ends of the profiles of the optima of :func:`search_rows`, rows begin to end, into (rows, starts, 2).

    rise (rows,) is how far they may rise above the χ² of a row's first optimum. The least and the largest α of every
    optimum are left as they are where its own χ² is higher than that, or where rise is infinite: then nothing bounds
    the range. The scaled covariances serve for the first steps.
    """
    for row in range(begin, end):
        model = row_at(rows, row)
        for j in range(counts[row, 0]):
            left = rise[row] - (chi2[row, j] - chi2[row, 0])
            if not (left > 0.0 and math.isfinite(left)):
                continue
            first_step = _gaussian_step(q[row, j], covariance[row, j], left)
            if not math.isfinite(first_step):
                first_step = 0.05
            for side in range(2):
                out_alpha[row, j, side] = _profile_end(
                    q[row, j], chi2[row, j], left, side == 0, first_step, y[row], model
                )
